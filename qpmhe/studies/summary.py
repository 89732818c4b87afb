"""From the cells of a study to one row a configuration, with confidence limits over seeds."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import numbers
from ..errors import InvalidInputError, ShapeError
from .row import CONFIGURATION, HALVES, METRICS

if TYPE_CHECKING:
    from pandas import DataFrame, Series

#: What configurations must share to be compared with each other.
PROBLEM = ("model", "noise_level", "horizon", "steps")
_STATES = ("rmse_states", "rmse_settled_states")
_DERIVED = ("failed_steps", "rmse_excess")
_NEEDED = (
    *CONFIGURATION, "seed", "outcome", "reasons", "shared", *_STATES,
    *(name for name in METRICS if name not in _DERIVED),
)
_FAILED = ("SOLVER_FAILED", "MODEL_FAILED")
_CONFIDENCE = 0.95
#: RMSEs that agree within this part are equally accurate.
TOLERANCE = 1e-3
#: By what configurations are ranked: the first that is known.
RANKED_BY = {"rmse": "RMSE", "cost_ratio": "J / converged J", "cost": "mean J"}


def measure(rows: DataFrame) -> str:
    """The column by which rows of a summary are ranked; without true states, a cost."""
    known = (name for name in RANKED_BY if np.isfinite(rows[name].astype(float)).any())
    return next(known, "rmse")


def summarise(frame: DataFrame) -> DataFrame:
    r"""One row per configuration: means over seeds, their 95 % confidence limits, Pareto front.

    With :math:`n` finished seeds of mean :math:`\bar m` and standard deviation :math:`s`, the
    limits of a metric's mean are :math:`\bar m \pm t_{0.975, n-1}\, s / \sqrt n` (Student's),
    clipped to the range of the metric: shares to 0 and 1, errors and times to 0. One seed has no
    limits (NaN).

    Parameters
    ----------
    frame : pandas.DataFrame
        One row per cell, with the columns of the store.

    Returns
    -------
    pandas.DataFrame
        Sorted by `CONFIGURATION`, "converged" and "no cap" (NA) last, with the columns

        - of `CONFIGURATION`; ``seeds`` (cells), ``failures`` (cells that failed), ``shared``
          (whether any time was taken on shared cores);
        - of `METRICS`: the mean over finished cells, with ``_low`` and ``_high``. Times in
          seconds per step. ``failed_steps`` is the share of steps where solver or model failed.
          ``rmse_excess`` is ``rmse`` relative to the most accurate configuration of the same
          problem (`PROBLEM`), minus 1, seed by seed, so that what the seeds have in common
          cancels;
        - ``rmse_states`` and ``rmse_settled_states``: lists, one value per state in its unit, with
          ``_low`` and ``_high``;
        - ``reasons``: dict, share of the steps with each flag of `qpmhe.Status`;
        - ``pareto``: whether no configuration of the same problem is faster (``time_median``)
          and more accurate (``rmse``, by more than `TOLERANCE`; without true states,
          ``cost_ratio``). Only configurations without failed cells take part.

    Raises
    ------
    InvalidInputError
        If it is no data frame, or a column is missing.
    """
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise InvalidInputError(
            f"frame is {shown(frame)}; expected a pandas.DataFrame, as the store's frame() returns."
        )
    missing = [name for name in _NEEDED if name not in frame.columns]
    if missing:
        raise InvalidInputError(
            f"the frame lacks the column {', '.join(missing)}; expected what the store's frame() "
            "returns, one row per cell."
        )
    cells = frame.reset_index(drop=True)
    cells["done"], cells["shared"] = cells["outcome"] == "done", cells["shared"].eq(True)
    for name in METRICS:
        if name not in _DERIVED:
            cells[name] = pd.to_numeric(cells[name], errors="coerce").astype(float)
    cells["failed_steps"] = [
        _failed_share(reasons, steps)
        for reasons, steps in zip(cells["reasons"], cells["steps"], strict=True)
    ]
    keys = list(CONFIGURATION)
    groups = cells.groupby(keys, dropna=False, sort=True)
    summary = groups.agg(
        seeds=("seed", "size"), failures=("done", lambda done: int((~done).sum())),
        shared=("shared", "any"),
    )
    done = cells[cells["done"]]
    _add_means(summary, done, [name for name in METRICS if name != "rmse_excess"])
    summary["rmse_excess"] = np.nan
    done = done.assign(rmse_excess=_excess(done, summary.reset_index()))
    _add_means(summary, done, ["rmse_excess"])
    for name in _STATES:
        lists = done.groupby(keys, dropna=False)[name]
        for place, suffix in enumerate(("", "_low", "_high")):
            summary[f"{name}{suffix}"] = lists.agg(partial(_state_means, place=place))
    summary["reasons"] = groups[["reasons", "steps"]].apply(_reason_shares)
    summary = summary.reset_index().sort_values(keys, na_position="last", ignore_index=True)
    summary["pareto"] = False
    for _, rows in summary.groupby(list(PROBLEM), dropna=False):
        whole = rows[rows["failures"] == 0]
        summary.loc[whole.index, "pareto"] = pareto_front(
            whole["time_median"], whole[measure(rows)], TOLERANCE
        )
    return summary


def with_observers(frame: DataFrame) -> DataFrame:
    """The cells, with the observer in the backend's name if there are several observers."""
    own = frame["observer"].ne("")
    if frame.loc[own, "observer"].nunique() < 2:
        return frame
    names = frame["backend"] + " / " + frame["observer"]
    return frame.assign(backend=frame["backend"].where(~own, names))


def alone(rows: DataFrame) -> Series:
    """Which rows are those of an observer alone."""
    return ~sequential(rows) & rows["observer"].ne("")


def sequential(rows: DataFrame) -> Series:
    """Which rows solve QPs, and so are neither an observer's nor another estimator's."""
    return rows["qps"].ne(0).fillna(True).astype(bool)


def with_halves(summary: DataFrame) -> DataFrame:
    """A summary with half the width of the limits, for what tables show it of."""
    return summary.assign(**{
        f"{name}_half": (summary[f"{name}_high"] - summary[f"{name}_low"]) / 2 for name in HALVES
    })


def _failed_share(reasons: Any, steps: Any) -> float:
    if not isinstance(reasons, dict) or not steps:
        return np.nan
    # Whatever failed in a step is one failed step: solver and model rarely fail in the same one.
    failed = sum(
        number for flags, number in reasons.items() if set(str(flags).split("|")) & set(_FAILED)
    )
    return min(1.0, float(failed) / float(steps))


def _reason_shares(cells: DataFrame) -> dict[str, float]:
    counts: Counter[str] = Counter()
    for reasons in cells["reasons"]:
        counts.update(reasons if isinstance(reasons, dict) else {})
    steps = float(cells["steps"].sum()) or 1.0
    return {flag: number / steps for flag, number in counts.most_common()}


def _add_means(summary: DataFrame, done: DataFrame, names: list[str]) -> None:
    groups = done.groupby(list(CONFIGURATION), dropna=False)[names]
    mean, deviation, count = groups.mean(), groups.std(), groups.count()
    half = student(count) * deviation / np.sqrt(count)
    for name in names:
        low, high = mean[name] - half[name], mean[name] + half[name]
        if name != "rmse_excess":
            low = low.clip(lower=0.0)
        if METRICS[name].kind == "share":
            high = high.clip(upper=1.0)
        summary[name], summary[f"{name}_low"], summary[f"{name}_high"] = mean[name], low, high


def _excess(done: DataFrame, summary: DataFrame) -> Series:
    """How far each cell's RMSE is above the best configuration's on the same seed, relative."""
    import pandas as pd

    excess = pd.Series(np.nan, index=done.index, dtype=float)
    for _, rows in summary.groupby(list(PROBLEM), dropna=False):
        # A configuration that failed on the hard seeds must not be what others are measured by.
        ranked = rows.sort_values(["failures", "rmse"])
        if ranked.empty or not np.isfinite(ranked["rmse"].iloc[0]):
            continue
        best = cells_of(done, ranked.iloc[0], CONFIGURATION).groupby("seed")["rmse"].mean()
        mine = cells_of(done, ranked.iloc[0], PROBLEM)
        excess[mine.index] = mine["rmse"] / mine["seed"].map(best).astype(float) - 1.0
    return excess


def cells_of(cells: DataFrame, row: Any, keys: tuple[str, ...]) -> DataFrame:
    """The cells that have the same values as a row of the summary."""
    import pandas as pd

    chosen = np.ones(len(cells), dtype=bool)
    for key in keys:
        value, column = row[key], cells[key]
        same = column.isna() if pd.isna(value) else (column == value).fillna(False)
        chosen &= same.to_numpy(dtype=bool)
    return cells[chosen]


def student(count: Any) -> Any:
    """Half the width of the confidence interval of a mean, in standard errors."""
    from scipy.stats import t

    return t.ppf(0.5 + 0.5 * _CONFIDENCE, np.maximum(count - 1, 1))


def _state_means(lists: Series, place: int) -> list[float] | None:
    """The mean of each state's errors, its lower limit, or its upper limit."""
    rows = [np.asarray(one, dtype=float) for one in lists if one is not None]
    if not rows or len({row.shape for row in rows}) != 1:
        return None
    mean, count = np.mean(rows, axis=0), len(rows)
    half = np.full(mean.shape, np.nan)
    if count > 1:
        half = student(count) * np.std(rows, axis=0, ddof=1) / np.sqrt(count)
    values: list[float] = (mean, np.maximum(mean - half, 0.0), mean + half)[place].tolist()
    return values


def pareto_front(
    times: ArrayLike, errors: ArrayLike, tolerance: float = 0.0
) -> NDArray[np.bool_]:
    """Which points no other point beats: none is at least as good in both and better in one."""
    t, e = numbers("times", times, finite=False), numbers("errors", errors, finite=False)
    if t.ndim != 1 or t.shape != e.shape:
        raise ShapeError(
            f"times and errors have the shapes {t.shape} and {e.shape}; expected (k,) for both."
        )
    front = np.zeros(t.size, dtype=bool)
    least, its_time = np.finfo(float).max, np.nan
    for k in np.lexsort((e, t)):
        if not (np.isfinite(t[k]) and np.isfinite(e[k])):
            continue
        if e[k] < least - tolerance * abs(least):
            front[k], least, its_time = True, e[k], t[k]
        elif e[k] == least and t[k] == its_time:
            front[k] = True
    return front
