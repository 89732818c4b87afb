"""Many estimators of one system, run together."""

from __future__ import annotations

import pickle
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.errors import report_unknown_options

from .._checks import count
from ..costs import Cost, QuadraticCost
from ..errors import InvalidInputError, OptionError
from ..estimation.estimator import MovingHorizonEstimator
from ..model.system import System
from ..observers import Luenberger, Observer
from .calls import Calls
from .engines import BatchEngine
from .looped import LoopedEngine
from .results import BatchEstimate, BatchRun
from .shapes import (
    check_starts,
    input_record,
    inputs_of,
    measurements_of,
    record_of,
    starts_of,
)
from .vectorised import VectorisedEngine, obstacles

if TYPE_CHECKING:
    from .compiled import CompiledBatchEngine

__all__ = ["BatchEstimator"]

Array = NDArray[np.float64]


@report_unknown_options
class BatchEstimator:
    r"""K independent estimators of one system, for Monte Carlo studies and fleets.

    Member k is what a `qpmhe.MovingHorizonEstimator` with the same arguments is for the
    record of member k: the same estimates, costs and statuses up to rounding, and the same
    promise, member by member. With ``engine="compiled"`` the members are shared among
    threads of compiled code; else the work of all is done together, on vectors of members,
    where system, observer, cost and options allow it (see ``mode``): a `Luenberger`
    observer, a `QuadraticCost` with constant prior weight, no sets, and the backend
    ``auto`` or ``banded``. A member whose model fails or whose measurement is missing falls
    back by itself.

    Parameters
    ----------
    system : System
        The model, which all members share. One that takes (..., n) is called once for all.
    observer : Observer
        The auxiliary observer.
    cost : Cost
        The cost.
    members : int
        K >= 1.
    horizon : int
        N >= 1.
    initial_states : (n,) or (K, n) array_like
        Initial estimate of all members, or of each; within the state set.
    backend, max_qps, max_solver_iterations, solver_tolerance, tolerance, engine, outside
        As for `qpmhe.MovingHorizonEstimator`.
    start, candidate, subproblem, time_budget, delay
        As there; the time budget is that of each member.
    threads : int, optional
        How many threads share the members where ``engine="compiled"``; one for each
        processor if left out.

    Attributes
    ----------
    members : int
        K.
    mode : str
        How the steps are carried out: ``compiled`` in generated C code, ``vectorised``, or
        ``looped`` for a loop over single estimators.
    mode_reason : str
        Why it is looped, "" otherwise.

    Raises
    ------
    InvalidInputError
        If anything does not fit; subclasses tell what (see `qpmhe.errors`).

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> system, observer, cost, scenario = qpmhe.models.batch_reactor()
    >>> Y = np.array([scenario.simulate(seed).measurements for seed in range(100)])
    >>> batch = qpmhe.BatchEstimator(
    ...     system, observer, cost, members=100, horizon=10, initial_states=[3.0, 0.0])
    >>> run = batch.run(Y)
    >>> run.states.shape, batch.mode
    ((100, 151, 2), 'vectorised')
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        *,
        members: int,
        horizon: int,
        initial_states: ArrayLike,
        backend: str = "auto",
        max_qps: int | None = 1,
        max_solver_iterations: int | None = None,
        solver_tolerance: float = 1e-7,
        tolerance: float = 1e-9,
        engine: str = "python",
        outside: str = "drop",
        start: str = "candidate",
        candidate: str = "observer",
        subproblem: str = "qp",
        time_budget: float | None = None,
        delay: int = 0,
        threads: int | None = None,
    ) -> None:
        self.members = count("members", members, 1)
        if not isinstance(system, System):
            raise InvalidInputError(f"system is {system!r}; expected a qpmhe.System.")
        states = starts_of(initial_states, self.members, system.n)
        # For this estimator alone, which may change how the model is called.
        own = system._private()
        if isinstance(observer, Observer):
            check_starts(own, observer, states)
        self.system, self.observer, self.cost = system, observer, cost
        self._initial_states = states
        self._threads = None if threads is None else count("threads", threads, 1)
        try:
            # The checks of all that members have in common are those of a single estimator.
            one = MovingHorizonEstimator(
                system, observer, cost, horizon=horizon, initial_state=states[0],
                backend=backend, max_qps=max_qps, max_solver_iterations=max_solver_iterations,
                solver_tolerance=solver_tolerance, tolerance=tolerance, engine=engine,
                outside=outside, start=start, candidate=candidate, subproblem=subproblem,
                time_budget=time_budget, delay=delay,
            )
            # Where it could not be compiled, that was told once.
            self.settings = replace(one.settings, engine=one.engine)
            self._make_engine(one.engine, own)
        except MemoryError as error:
            raise OptionError(
                f"{self.members} members with a horizon of {horizon} need more memory than there "
                f"is ({error}); take a shorter horizon, or fewer members at once."
            ) from error

    def _make_engine(self, engine: str, system: System) -> None:
        observer, cost, states = self.observer, self.cost, self._initial_states
        found = obstacles(system, observer, cost, self.settings)
        self.mode = "looped" if found else "vectorised"
        self.mode_reason = "; ".join(found)
        self._engine: BatchEngine
        self._compiled: CompiledBatchEngine | None = None
        if engine == "compiled":
            from .compiled import CompiledBatchEngine  # late: most programs do without it

            self.mode, self.mode_reason = "compiled", ""
            self._engine = self._compiled = CompiledBatchEngine(
                system, observer, cost, self.settings, states, self._threads
            )
        elif isinstance(observer, Luenberger) and isinstance(cost, QuadraticCost) and not found:
            self._engine = VectorisedEngine(
                system, observer, cost, self.settings, states.copy()
            )
        else:
            self._engine = LoopedEngine(system, observer, cost, self.settings, states.copy())

    @property
    def states(self) -> Array:
        """The current estimates of x(t+1), (K, n); the initial ones before any measurement."""
        return self._engine.states

    @property
    def time(self) -> int:
        """Number of samples taken so far."""
        return self._engine.time

    @property
    def horizon(self) -> int:
        """N."""
        return self.settings.horizon

    def reset(self, initial_states: ArrayLike | None = None) -> None:
        """Forget all measurements and start again.

        Parameters
        ----------
        initial_states : (n,) or (K, n) array_like, optional
            New initial estimates; the former ones if left out.

        Raises
        ------
        InvalidInputError
            If they do not fit; the estimator is left as it was.
        """
        before = states = self._initial_states
        if initial_states is not None:
            states = starts_of(initial_states, self.members, self.system.n)
            check_starts(self.system._private(), self.observer, states)
        try:
            self._initial_states = states
            self._engine.reset(states.copy())
        except BaseException:
            self._initial_states = before
            raise

    @property
    def initial_states(self) -> Array:
        """The initial estimates (K, n), a copy."""
        return self._initial_states.copy()

    def update(self, Y: ArrayLike | None, U: ArrayLike | None = None) -> BatchEstimate:
        """Take the measurements y(t) and inputs u(t) of all members in, and estimate x(t+1).

        Parameters
        ----------
        Y : (K, p) array_like
            y(t) of each member; what is not finite (or so large that its square is not) or
            None is missing, of that member alone. (K,) will do where p is 1.
        U : (K, m) or (m,) array_like, optional
            u(t) of each member, or of all. Needed exactly if the system has inputs.

        Returns
        -------
        BatchEstimate
            The estimates of all members.

        Raises
        ------
        ShapeError, InvalidInputError
            If an argument does not fit; the estimator is left as it was.

        Notes
        -----
        An update that is interrupted (Ctrl+C) has taken the samples of no member; in compiled
        code, of all or of none: see ``time``.
        """
        y = measurements_of(Y, self.members, self.system.p)
        return self._engine.step(y, inputs_of(U, self.members, self.system.m))

    def run(self, Y: ArrayLike, U: ArrayLike | None = None) -> BatchRun:
        """Take whole records, sample by sample, going on from the present states.

        Parameters
        ----------
        Y : (K, T, p) array_like
            y(t), ..., y(t+T-1) of each member; (K, T) will do where p is 1. Shorter records
            are filled up with NaN.
        U : (K, T, m) or (T, m) array_like, optional
            The inputs of the same times, of each member or of all.

        Returns
        -------
        BatchRun
            Estimates, costs and statuses of all steps.

        Raises
        ------
        ShapeError, InvalidInputError
            If a shape is wrong; no sample has been taken then.
        """
        ys = record_of(Y, self.members, self.system.p)
        us = input_record(U, self.members, self.system.m, ys.shape[1])
        if self._compiled is not None:
            return self._compiled.run(ys, us)
        steps = ys.shape[1]
        estimates = (self._engine.step(ys[:, t], us[:, t]) for t in range(steps))
        return BatchRun.of(self.states, estimates, steps)

    def __getstate__(self) -> dict[str, Any]:
        saved, engine = self.__dict__.copy(), self._engine
        del saved["_engine"], saved["_compiled"]
        if self._compiled is not None:
            saved["state"] = self._compiled.state_dict()
        elif isinstance(engine, LoopedEngine):
            saved["state"] = [one.state_dict() for one in engine._engines]
        else:
            memory = BytesIO()
            _Pickler(memory).dump(engine)
            saved["state"] = memory.getvalue()
        return saved

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self.__dict__.update(saved)
        state = self.__dict__.pop("state")
        if isinstance(state, bytes):
            own = self.system._private()
            self._engine, self._compiled = _Unpickler(BytesIO(state), own).load(), None
            return
        self._make_engine(self.settings.engine, self.system._private())
        if self._compiled is not None:
            self._compiled.load_state_dict(state)
        elif isinstance(self._engine, LoopedEngine):
            for one, own in zip(self._engine._engines, state, strict=True):
                one.load_state_dict(own)

    def __repr__(self) -> str:
        return (
            f"BatchEstimator(members={self.members}, horizon={self.horizon}, "
            f"mode={self.mode!r}, time={self.time})"
        )


class _Pickler(pickle.Pickler):
    """Leaves the calls of the system out, which is pickled by itself."""

    def persistent_id(self, one: Any) -> str | None:
        return "calls" if isinstance(one, Calls) else None


class _Unpickler(pickle.Unpickler):
    """Puts the calls of a system in."""

    def __init__(self, file: BytesIO, system: System) -> None:
        super().__init__(file)
        self._system = system

    def persistent_load(self, _: Any) -> Calls:
        return Calls(self._system)
