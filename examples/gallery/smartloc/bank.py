"""Estimators from several starts, of which the one with the least cost is right in the end."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter

import numpy as np

import qpmhe

from ..problem import Array

# Starts on rings round the given one: radii in standard deviations of the prior, and how many.
RINGS = {0.0: 1, 1.0: 6, 2.0: 12}


@dataclass
class Taken:
    """Estimates of a record: with y of their own time, and with y of so many samples after it."""

    filtered: Array
    late: Array
    times: Array


class Bank:
    """Moving horizon estimation from several starts, halved in number as the first window fills.

    A loss that redescends has many minima: where most signals of the first seconds are reflected,
    an estimator stays near a wrong one for a window. The minimum with the least cost is found from
    several starts, and the least cost belongs to the trajectory with the most signals in
    agreement. At each sample the estimate is the one with the least cost so far.

    Parameters
    ----------
    make : callable
        make(start), a `qpmhe.MovingHorizonEstimator`.
    spread : (2,) array
        Standard deviations of the first two states.
    delay : int
        How many steps a late estimate lies before the window's end.
    compiled : bool
        Whether to compile the step.
    """

    def __init__(
        self, make: Callable[[Array], qpmhe.MovingHorizonEstimator], spread: Array, delay: int,
        compiled: bool,
    ) -> None:
        self._make, self._spread, self._delay, self._compiled = make, spread, delay, compiled
        self._taken: dict[bytes, Taken] = {}  # the causal and the late estimates are of one run

    def causal(self, start: Array) -> View:
        """Estimates at each sample's own time."""
        return View(self, start, late=False)

    def late(self, start: Array) -> View:
        """Estimates that have waited for the delay."""
        return View(self, start, late=True)

    def around(self, start: Array) -> list[Array]:
        """The start, and others on rings round it."""
        found = []
        for radius, count in RINGS.items():
            for angle in 2.0 * np.pi * np.arange(count) / count:
                moved = start.copy()
                moved[:2] += radius * self._spread * (np.cos(angle), np.sin(angle))
                found.append(moved)
        return found

    def member(self, start: Array) -> qpmhe.MovingHorizonEstimator:
        """One estimator, compiled where that is possible."""
        made = self._make(start)
        if self._compiled and made.engine != "compiled":
            with suppress(qpmhe.QpmheError):
                qpmhe.compile(made)
            made = self._make(start)
        return made

    def run(self, start: Array, y: Array, u: Array) -> Taken:
        """Estimates of a record from a start."""
        key = start.tobytes()
        if key not in self._taken:
            self._taken[key] = self._run(start, y, u)
        return self._taken[key]

    def _run(self, start: Array, y: Array, u: Array) -> Taken:
        members = [self.member(one) for one in self.around(start)]
        horizon = members[0].horizon
        # The number is halved whenever the window has doubled; one is left when it is full.
        halvings = int(np.ceil(np.log2(len(members))))
        cuts = {max(1, round(horizon / 2.0**one)) for one in range(halvings)}
        filtered, late = np.full((2, len(y), start.size), np.nan)
        times = np.zeros(len(y))
        for t in range(len(y)):
            began = perf_counter()
            found = [one.update(y[t], u[t]) for one in members]
            order = np.argsort([one.cost for one in found], kind="stable")
            best = found[order[0]]
            filtered[t] = best.filtered
            if self._delay < len(best.trajectory):
                # The trajectory ends at x(t + 1).
                late[t + 1 - self._delay] = best.trajectory[-1 - self._delay]
            if t + 1 in cuts:
                members = [members[k] for k in order[: (len(members) + 1) // 2]]
            times[t] = perf_counter() - began
        return Taken(filtered, late, times)


class View:
    """What the gallery runs: one kind of a bank's estimates.

    Parameters
    ----------
    bank : Bank
        Where they come from.
    start : (n,) array
        The initial state.
    late : bool
        Whether to take the late ones.
    """

    def __init__(self, bank: Bank, start: Array, late: bool) -> None:
        self._bank, self._start, self._late = bank, start, late
        self.engine = bank.member(start).engine

    def reset(self, start: Array) -> None:
        """Start anew."""
        self._start = start

    def run(self, y: Array, u: Array) -> Taken:
        """The estimates, of which the gallery judges ``filtered``."""
        taken = self._bank.run(self._start, y, u)
        return Taken(taken.late, taken.late, taken.times) if self._late else taken
