"""Distribution of the stored step times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .words import cap_words, qps_words

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Spread", "spreads"]


@dataclass(frozen=True)
class Spread:
    """Quantiles of all step times of one configuration.

    Parameters
    ----------
    backend, qps, cap, start : str
        The configuration in words.
    low, first, median, third, high, most : float
        Quantiles 1 %, 25 %, 50 %, 75 %, 99 % and the maximum, in seconds per step.
    steps : int
        Number of steps.
    """

    backend: str
    qps: str
    cap: str
    start: str
    low: float
    first: float
    median: float
    third: float
    high: float
    most: float
    steps: int


def spreads(frame: DataFrame) -> list[Spread]:
    """Quantiles over the steps of all seeds, for each backend, QPs per sample, cap and start.

    Parameters
    ----------
    frame : pandas.DataFrame
        Cells of one model and horizon, with their ``times``.
    """
    found = []
    for (backend, qps, cap, start), rows in frame.groupby(
        ["backend", "qps", "solver_iterations", "start"], dropna=False
    ):
        parts = [np.asarray(one, dtype=float) for one in rows["times"] if one is not None]
        parts = [one[np.isfinite(one)] for one in parts if one.ndim == 1]
        times = np.concatenate(parts) if parts else np.empty(0)
        if times.size == 0:
            continue
        low, first, median, third, high, most = np.quantile(
            times, (0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
        ).tolist()
        found.append(Spread(
            str(backend), qps_words(qps), cap_words(cap), str(start), low, first, median, third,
            high, most, times.size,
        ))
    return found
