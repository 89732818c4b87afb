"""The tables of docs/how-to-choose.md, made of a store's cells.

An error here is a ratio: the RMSE of each state, divided by that of the same state in the
converged estimate with the zoo's observer, weights and horizon on the record of the same seed;
of these the geometric mean over states and seeds. Units cancel, and 1 is that estimate.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from choice_studies import (
    BOUNDED,
    DISTANCES,
    HORIZONS,
    OBSERVED,
    OBSERVERS,
    ONE_SIDED,
    OUTLYING,
    named,
    observed,
    weighed,
)
from pandas import DataFrame, isna

from qpmhe.models import catalogue
from qpmhe.studies import Study

ALL, SETTLED = "rmse_states", "rmse_settled_states"
#: An error this many times the reference's is no estimate any more.
LOST = 100.0
#: How near to the error at the longest horizon is near enough.
NEAR = 1.05


class Figures:
    """What the cells of the studies say.

    Parameters
    ----------
    frame : pandas.DataFrame
        The store's.
    studies : iterable of Study
        Whose cells count; a store may have others.
    """

    def __init__(self, frame: DataFrame, studies: Iterable[Study]) -> None:
        keys = {cell.key for study in studies for cell in study.cells()}
        self._cells: dict[tuple[Any, ...], dict[int, Any]] = {}
        self.failures, self.count = 0, 0
        for row in frame[frame["key"].isin(keys)].itertuples():
            self.count += 1
            if row.outcome != "done":
                self.failures += 1
                continue
            qps = None if isna(row.qps) else int(row.qps)
            place = (row.model, qps, row.horizon, row.start)
            self._cells.setdefault(place, {})[row.seed] = row
        self.scenarios = {name: make().scenario for name, make in catalogue().items()}
        found = {place[0] for place in self._cells}
        self.models = tuple(name for name in self.scenarios if name in found)
        self.seeds = len({seed for cells in self._cells.values() for seed in cells})
        self._widest = 1.0

    def cells(
        self, zoo: str, qps: int | None, model: str | None = None, horizon: int | None = None,
        start: str = "candidate",
    ) -> dict[int, Any]:
        """The cells of a configuration by seed; N is the zoo's if left out."""
        place = (model or zoo, qps, horizon or self.scenarios[zoo].horizon, start)
        return self._cells.get(place, {})

    def error(
        self, zoo: str, qps: int | None, model: str | None = None, horizon: int | None = None,
        which: str = ALL, reference: str | None = None,
    ) -> float:
        """The error's ratio; infinite if the estimate was lost in any record."""
        mine = self.cells(zoo, qps, model, horizon)
        base = (
            self.cells(zoo, None) if reference is None else self.cells(zoo, qps, reference)
        )
        logs = []
        for seed in mine.keys() & base.keys():
            with np.errstate(all="ignore"):
                ratio = np.divide(getattr(mine[seed], which), getattr(base[seed], which))
                logs.append(np.log(ratio).mean())
        if not logs or any(np.isnan(logs)):
            return np.nan
        if max(logs) > np.log(LOST):
            return np.inf
        if len(logs) > 1:
            from scipy.stats import t as student

            half = student.ppf(0.975, len(logs) - 1) * np.std(logs, ddof=1) / len(logs) ** 0.5
            self._widest = max(self._widest, float(np.exp(half)))
        return float(np.exp(np.mean(logs)))

    def widest(self) -> float:
        """Upper 95 % limit over the mean, the largest of the errors since the last call."""
        widest, self._widest = self._widest, 1.0
        return widest

    def mean(self, column: str, zoo: str, qps: int | None, **place: Any) -> float:
        """The mean of a column over the seeds."""
        values = [getattr(row, column) for row in self.cells(zoo, qps, **place).values()]
        return float(np.mean(values)) if values else np.nan

    def time(self, zoo: str, qps: int | None, **place: Any) -> float:
        """Seconds of a step: the median over the samples of the least over the seeds.

        Where other programs run, a step of some milliseconds is interrupted more often than
        not, so that the median of one record has their time in it.
        """
        times = [row.times for row in self.cells(zoo, qps, **place).values()]
        return float(np.median(np.min(times, axis=0))) if times else np.nan


def number(value: float, decimals: int = 2) -> str:
    """A figure of a table."""
    if np.isnan(value):
        return "-"
    if np.isinf(value):
        return "lost"
    return f"{value:.{decimals}f}" if value < 100.0 else f"{value:,.0f}"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of Markdown."""
    names = list(head)
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def pair(figures: Figures, zoo: str, qps: int | None, model: str | None = None) -> str:
    """Errors over all times and settled."""
    return " / ".join(
        number(figures.error(zoo, qps, model, which=which)) for which in (ALL, SETTLED)
    )


def at_all(figures: Figures) -> str:
    """Observer, filter and MHE."""
    rows = []
    for zoo in figures.models:
        extended, one = observed(zoo, "extended"), figures.time(zoo, 1)
        rows.append((
            f"`{zoo}`", pair(figures, zoo, 0), pair(figures, zoo, 0, extended),
            pair(figures, zoo, 1), pair(figures, zoo, 2, extended),
            number(figures.time(zoo, 0) / one), number(figures.time(zoo, 0, model=extended) / one),
        ))
    return table(
        ("model", "observer", "EKF", "MHE, 1 QP", "MHE on the EKF, 2 QPs", "time, observer",
         "time, EKF"),
        rows,
    )


def observers(figures: Figures) -> str:
    """Settled errors of observers, alone and with QPs."""
    rows: list[tuple[str, ...]] = []
    zoos = [zoo for zoo in figures.models if zoo in OBSERVED]
    if not zoos:
        return "None of these models took part."
    for kind, name in OBSERVERS.items():
        cells = (
            " / ".join(
                number(figures.error(zoo, qps, observed(zoo, kind), which=SETTLED))
                for qps in (0, 1, 2)
            )
            for zoo in zoos
        )
        times = [
            figures.time(zoo, 0, model=observed(zoo, kind))
            / figures.time(zoo, 0, model=observed(zoo, "constant"))
            for zoo in zoos
        ]
        span = dict.fromkeys(number(end, 1) for end in (min(times), max(times)))
        rows.append((name, *cells, " to ".join(span)))
    return table(("observer", *(f"`{zoo}`" for zoo in zoos), "time alone"), rows)


def starts_of_observers(figures: Figures) -> str:
    """Errors over all times from poor starts, and how many records were lost."""
    rows: list[tuple[str, ...]] = []
    zoos = [zoo for zoo in figures.models if zoo in OBSERVED]
    for kind, name in OBSERVERS.items():
        model = {zoo: observed(zoo, kind, DISTANCES["poor"]) for zoo in zoos}
        cells = (
            " / ".join(
                number(figures.error(zoo, qps, model[zoo], which=ALL)) for qps in (0, 1, 2)
            )
            for zoo in zoos
        )
        rows.append((name, *cells))
    return table(("observer", *(f"`{zoo}`" for zoo in zoos)), rows)


def outliers(figures: Figures) -> str:
    """Settled errors with outliers."""
    rows = []
    for zoo in figures.models:
        if zoo not in OUTLYING:
            continue
        model = {
            loss: named("outlying", zoo, loss=loss, observer="own")
            for loss in ("quadratic", "huber")
        }
        filters = named("outlying", zoo, loss="quadratic", observer="extended")
        chosen = [
            (0, model["quadratic"]), (0, filters), (5, model["quadratic"]),
            *((qps, model["huber"]) for qps in (1, 2, 5, None)),
        ]
        rows.append((f"`{zoo}`", *(
            number(figures.error(zoo, qps, name, which=SETTLED)) for qps, name in chosen
        )))
    return table(
        ("model", "observer", "EKF", "quadratic, 5 QPs", "Huber, 1 QP", "2", "5", "converged"),
        rows,
    )


def priors(figures: Figures) -> str:
    """Settled errors with an extended Kalman filter and two weights of the prior."""
    some = (2, 10, 40)
    rows = [
        (f"`{zoo}`", *(
            number(figures.error(zoo, 2, weighed(zoo, prior), horizon, SETTLED))
            for prior in ("constant", "observer") for horizon in some
        ))
        for zoo in figures.models
    ]
    heads = (f"{name}, N = {N}" for name in ("constant", "`ObserverPrior`") for N in some)
    return table(("model", *heads), rows)


def horizons(figures: Figures) -> str:
    """The horizon that is long enough, and what it takes."""
    rows = []
    for zoo in figures.models:
        n = catalogue()[zoo]().system.n
        errors = {N: figures.error(zoo, 1, horizon=N, which=SETTLED) for N in HORIZONS}
        longest = errors[HORIZONS[-1]]
        enough = [N for N in HORIZONS if errors[N] <= NEAR * longest]
        least = next(N for N in HORIZONS if n <= N)
        scenario = figures.scenarios[zoo]
        length = f"{min(enough) * scenario.dt:g} {scenario.time_unit}" if enough else "-"
        grown = (
            figures.time(zoo, qps, horizon=40) / figures.time(zoo, qps, horizon=2)
            for qps in (1, None)
        )
        rows.append((
            f"`{zoo}`", str(n), f"{number(errors[least] / longest)} ({least})",
            str(min(enough)) if enough else "-", length, *(number(value, 1) for value in grown),
        ))
    return table(
        ("model", "n", "error at N ≥ n, in units of that at 40", "N that is enough", "its length",
         "time, 1 QP", "time, converged"),
        rows,
    )


def caps(figures: Figures) -> str:
    """Costs, errors and times at caps on QPs."""
    rows = []
    for zoo in figures.models:
        one = figures.time(zoo, 1)
        rows.append((
            f"`{zoo}`",
            *(number(figures.mean("cost_ratio", zoo, qps)) for qps in (0, 1, 2, 5)),
            *(pair(figures, zoo, qps) for qps in (1, 2)),
            *(number(figures.time(zoo, qps) / one, 1) for qps in (2, 5, None)),
        ))
    improved = min((figures.mean("improved", zoo, 1) for zoo in figures.models), default=np.nan)
    return table(
        ("model", "J / J*: i = 0", "1", "2", "5", "error: 1", "2", "time: 2", "5", "converged"),
        rows,
    ) + (
        "\n\nSteps with one QP in which the estimate beats the candidate, least of the models: "
        f"{100.0 * improved:.1f} %."
    )


def starts(figures: Figures) -> str:
    """Where the sequence of QPs starts."""
    rows = []
    for zoo in figures.models:
        one = figures.time(zoo, 1)
        rows.append((
            f"`{zoo}`", number(figures.mean("cost_ratio", zoo, 1), 3),
            number(figures.mean("cost_ratio", zoo, 1, start="best"), 3),
            number(figures.mean("cost_ratio", zoo, 2), 3),
            number(figures.time(zoo, 1, start="best") / one, 1),
            number(figures.time(zoo, 2) / one, 1),
        ))
    return table(
        ("model", "J / J*: candidate, 1 QP", "best, 1 QP", "candidate, 2 QPs", "time: best, 1 QP",
         "candidate, 2 QPs"),
        rows,
    )


def sets(figures: Figures) -> str:
    """What it is worth to know a set, with two QPs."""
    chosen = [
        *((zoo, "X", zoo, named("without_states", zoo)) for zoo in BOUNDED),
        *(
            (zoo, "W: w ≥ 0", *(named("one_sided", zoo, known=known) for known in (True, False)))
            for zoo in ONE_SIDED
        ),
    ]
    rows = []
    for zoo, what, knows, ignores in chosen:
        if zoo not in figures.models:
            continue
        place = figures.cells(zoo, 2, knows).values()
        dropped = [row.reasons.get("ROWS_DROPPED", 0) / row.steps for row in place]
        errors = (
            number(figures.error(zoo, 2, knows, which=which, reference=ignores), 3)
            for which in (ALL, SETTLED)
        )
        time = figures.time(zoo, 2, model=knows) / figures.time(zoo, 2, model=ignores)
        rows.append((
            f"`{zoo}`", what, *errors,
            number(100.0 * float(np.mean(dropped)), 0) if dropped else "-", number(time, 1),
        ))
    return table(
        ("model", "set", "error, all times", "error, settled", "dropped, % of the steps", "time"),
        rows,
    )


def backends(page: Path) -> str:
    """Some lines of the table in comparison.md."""
    rows, header, seen = [], [""], set()
    fast = ("auto", "banded")
    shown = {"0": ("observer",), "1": fast, "2": (*fast, "piqp", "daqp", "osqp")}
    for line in page.read_text(encoding="utf-8").splitlines():
        words = re.split(r" {2,}", line.replace("*", "").strip())
        if words[0] == "backend":
            header = words
        cells = dict(zip(header, words, strict=False))
        name, qps = cells.get("backend"), cells.get("QPs")
        # Of each the first line, which is the fastest.
        if name in shown.get(qps or "", ()) and (name, qps) not in seen:
            seen.add((name, qps))
            columns = ("QPs", "cap", "RMSE", "conv.", "median")
            rows.append((f"`{name}`", *(cells[column] for column in columns)))
    return table(("backend", "QPs", "cap", "RMSE", "J / conv.", "median"), rows)
