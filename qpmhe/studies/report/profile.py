"""Performance profiles over problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..summary import CONFIGURATION, PROBLEM
from .words import configuration_words

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["SOLVED", "Profile", "last_ratio", "profiles"]

Array = NDArray[np.float64]

#: A problem counts as solved if J is on average within this part of the converged one.
SOLVED = 0.01


@dataclass(frozen=True)
class Profile:
    r"""Share of problems that a solver solves within a factor of the fastest one's time.

    :math:`\rho_s(\tau) = |\{p : t_{p,s} \le \tau \min_{s'} t_{p,s'}\}| / |P|`
    (Dolan and More, Mathematical Programming 91, 2002, doi 10.1007/s101070100263).

    Parameters
    ----------
    backend : str
        The solver.
    words : str
        Its configuration.
    ratios : (k,) array
        Sorted time ratios of the k problems that it solves.
    problems : int
        |P|.
    """

    backend: str
    words: str
    ratios: Array
    problems: int

    def steps(self, last: float) -> tuple[Array, Array]:
        """Corners of the curve up to the ratio ``last``: ratios and shares."""
        x = np.concatenate(([1.0], self.ratios, [last]))
        y = np.concatenate(([0.0], np.arange(1, self.ratios.size + 1), [self.ratios.size]))
        return x, y / self.problems


def profiles(frame: DataFrame) -> list[Profile]:
    """A profile for each backend over the problems: model, horizon, length of the record, and seed.

    A backend is represented by the one of its configurations that solves most problems, of
    several such by the one with the lowest geometric mean time. Solved means: the run
    finished and its J is on average within `SOLVED` of the converged one. The time is the
    median per step.

    Parameters
    ----------
    frame : pandas.DataFrame
        One row a cell.

    Returns
    -------
    list of Profile
        By backend; empty where fewer than two problems or no times are there.
    """
    problems = [*PROBLEM, "seed"]
    cells = frame[frame["backend"] != "observer"]
    names = [tuple(row) for row in cells[problems].astype(str).to_numpy()]
    count = len(set(names))
    if count < 2 or not cells["time_median"].notna().any():
        return []
    solved = (
        (cells["outcome"] == "done") & (cells["cost_ratio"].astype(float) <= 1 + SOLVED)
        & cells["time_median"].notna()
    )
    cells = cells.assign(problem=names, solved=solved, time=cells["time_median"].astype(float))
    # The same settings on different problems are one configuration here.
    keys = [key for key in CONFIGURATION if key not in problems]
    best: dict[str, tuple[tuple[float, float], Any, DataFrame]] = {}
    for _, rows in cells.groupby(keys, dropna=False):
        mine = rows[rows["solved"]]
        mean = float(np.log(mine["time"]).mean()) if len(mine) else np.inf
        rank = (-len(mine), mean)
        backend = str(rows["backend"].iloc[0])
        if backend not in best or rank < best[backend][0]:
            best[backend] = rank, rows.iloc[0], mine
    fastest: dict[Any, float] = {}
    for _, _, mine in best.values():
        for problem, time in zip(mine["problem"], mine["time"], strict=True):
            fastest[problem] = min(time, fastest.get(problem, np.inf))
    return [
        Profile(
            backend, configuration_words(row),
            np.sort([t / fastest[p] for p, t in zip(mine["problem"], mine["time"], strict=True)]),
            count,
        )
        for backend, (_, row, mine) in sorted(best.items())
    ]


def last_ratio(found: list[Profile]) -> float:
    """Where the axis of ratios ends: a little beyond the largest."""
    largest = max((float(one.ratios[-1]) for one in found if one.ratios.size), default=1.0)
    return max(2.0, 1.15 * largest)

