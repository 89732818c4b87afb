"""All members at once, by operations on vectors of members."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import Solver, SolverOptions, create
from qpmhe_solvers.auto import AutoSolver
from qpmhe_solvers.banded import BandedSolver

from ..costs import Cost, ObserverPrior, QuadraticCost
from ..estimation.estimate import Status
from ..estimation.settings import Settings
from ..model.system import System
from ..observers import Luenberger, Observer
from .problems import Problems
from .results import BatchEstimate
from .sequence import Outcome, Sequence
from .windows import Windows

__all__ = ["VectorisedEngine", "obstacles"]

Array = NDArray[np.float64]


def obstacles(system: System, observer: Observer, cost: Cost, settings: Settings) -> list[str]:
    """What stands against `VectorisedEngine`, in words; nothing where it can be used.

    Parameters
    ----------
    system, observer, cost, settings
        The estimators'.
    """
    found = []
    if any((system.states, system.disturbances, system.noises)):
        found.append("the system has sets")
    if type(observer) is not Luenberger:
        found.append(f"the observer is a {type(observer).__name__}, not a Luenberger")
    if type(cost) is not QuadraticCost:
        found.append(f"the cost is a {type(cost).__name__}, not a QuadraticCost")
    elif isinstance(cost.prior, ObserverPrior):
        found.append("the prior weight comes from the observer")
    if type(_solver(settings)) not in (AutoSolver, BandedSolver):
        found.append(f"the backend is {settings.backend!r}, neither 'auto' nor 'banded'")
    if settings.subproblem != "qp":
        found.append(f"subproblem is {settings.subproblem!r}")
    if settings.candidate != "observer":
        found.append(f"candidate is {settings.candidate!r}")
    if settings.time_budget is not None:
        found.append("there is a time budget, which is each member's own")
    return found


def _solver(settings: Settings) -> Solver:
    return create(
        settings.backend,
        SolverOptions(
            max_iterations=settings.max_solver_iterations,
            absolute_tolerance=float(settings.solver_tolerance),
            warm_start=False,  # the last QP was another member's
        ),
    )


class VectorisedEngine:
    """The step of `qpmhe.estimation.engine.PythonEngine` for all members; see `BatchEngine`.

    Parameters
    ----------
    system, observer, cost, settings
        What the members have in common, without `obstacles`.
    states : (K, n) array
        The initial estimates.
    """

    def __init__(
        self,
        system: System,
        observer: Luenberger,
        cost: QuadraticCost,
        settings: Settings,
        states: Array,
    ) -> None:
        self._best, self._delay = settings.start == "best", settings.delay
        self._windows = Windows(
            system, observer, cost, settings.horizon, states, settings.qp_limit > 0
        )
        problems = Problems(self._windows, cost)
        self._sequence = Sequence(
            self._windows, problems, cost, _solver(settings), settings
        )
        self._states = states.copy()
        self._before: Array | None = None  # the last estimates' trajectories

    def reset(self, states: Array) -> None:
        """See `qpmhe.batch.engines.BatchEngine.reset`."""
        before = self._states, self._before
        try:
            self._states, self._before = states.copy(), None
            self._windows.reset(states)
        except BaseException:
            self._states, self._before = before
            raise

    @property
    def states(self) -> Array:
        """See `qpmhe.batch.engines.BatchEngine.states`."""
        return self._states.copy()

    @property
    def time(self) -> int:
        """See `qpmhe.batch.engines.BatchEngine.time`."""
        return self._windows.time

    def step(self, y: Array, u: Array) -> BatchEstimate:
        """See `qpmhe.batch.engines.BatchEngine.step`."""
        windows = self._windows
        windows.make_room()
        mark, before = windows.mark(), (self._states, self._before)
        try:
            return self._step(y, u)
        except BaseException:  # an interrupt: the samples are not taken
            windows.roll_back(mark)
            self._states, self._before = before
            raise

    def _step(self, y: Array, u: Array) -> BatchEstimate:
        windows = self._windows
        with np.errstate(all="ignore"):
            windows.push(y, u)
            outcome = self._sequence.improve(self._shifted() if self._best else None)
            candidate, candidate_cost = windows.candidate.copy(), windows.candidate_cost
        trajectory = outcome.trajectory
        if trajectory is None:
            trajectory = candidate.copy()
        self._note(outcome, candidate_cost)
        self._states = trajectory[-1].copy()
        if self._best:
            self._before = trajectory.copy()
        if windows.held is not None:
            members = np.flatnonzero(windows.held & outcome.improved)
            windows.restart(members, self._states[members])
        return BatchEstimate(
            windows.time - 1,
            trajectory.transpose(1, 0, 2),
            outcome.cost,
            candidate.transpose(1, 0, 2),
            candidate_cost,
            outcome.flags,
            outcome.qps,
            self._delay,
        )

    def _note(self, outcome: Outcome, candidate_cost: Array) -> None:
        """Add to the flags what the windows and the outcomes tell."""
        windows, flags = self._windows, outcome.flags
        flags |= np.where(outcome.improved, Status.IMPROVED.value, Status.CANDIDATE.value)
        if windows.missing is not None:
            flags[windows.missing] |= Status.MISSING.value
        failed = np.zeros(flags.size, np.bool_)
        for some in (windows.held, windows.flat):
            if some is not None:
                failed |= some
        flags[failed] |= Status.MODEL_FAILED.value
        void = ~np.isfinite(candidate_cost)
        if void.any():
            flags[void & ~failed] |= Status.FAILED_STAGE.value
            flags[void] &= ~Status.NO_DECREASE.value  # no solver is to blame there

    def _shifted(self) -> Array | None:
        """The previous estimates, moved on by one step of the model to the present windows."""
        windows, before = self._windows, self._before
        if before is None:
            return None
        ahead = windows.calls.f.at(before[-1], windows.inputs[-1])
        shifted = np.concatenate((before, ahead[None]))
        return shifted[shifted.shape[0] - 1 - windows.length :]
