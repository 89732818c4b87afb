"""Many independent estimators of one system: threads over the compiled step, or a loop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import Solver

from ._checks import count, numbers
from .costs import Cost
from .errors import InvalidInputError, OptionError, ShapeError, UnknownOptionError
from .estimation.engine import PythonEngine
from .estimation.estimate import Estimate, Status
from .estimation.estimator import MovingHorizonEstimator, check_start
from .estimation.settings import Settings
from .model.system import System
from .observers import Observer

if TYPE_CHECKING:
    from .codegen.members import CompiledMembers

__all__ = ["BatchEstimate", "BatchEstimator", "BatchRun"]

Array = NDArray[np.float64]
Flags = NDArray[np.int64]
Index = NDArray[np.intp]


class BatchEstimator:
    """K independent estimators of one system, for Monte Carlo studies and fleets.

    Member k is what a `qpmhe.MovingHorizonEstimator` with the same arguments is for the
    record of member k, with the same promise. With ``engine="compiled"`` threads share the
    members; otherwise the members take turns. A member whose model fails or whose measurement
    is missing falls back by itself.

    Parameters
    ----------
    system : System
        The model, which all members share.
    observer : Observer
        The auxiliary observer.
    cost : Cost
        The cost.
    members : int
        K >= 1.
    initial_states : (n,) or (K, n) array_like
        Initial estimate of all members, or of each; within the state set.
    threads : int, optional
        How many threads share the members where ``engine="compiled"``; one for each
        processor if left out.
    **options
        As for `qpmhe.MovingHorizonEstimator`: the horizon, and whatever else it takes. A
        time budget is that of each member.

    Attributes
    ----------
    members : int
        K.
    mode : str
        ``compiled``, or ``looped`` for a loop over Python's estimators.

    Raises
    ------
    InvalidInputError
        If anything does not fit; subclasses say what (see `qpmhe.errors`).

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> system, observer, cost, scenario = qpmhe.models.batch_reactor()
    >>> Y = np.array([scenario.simulate(seed).measurements for seed in range(3)])
    >>> batch = qpmhe.BatchEstimator(
    ...     system, observer, cost, members=3, horizon=10, initial_states=[3.0, 0.0])
    >>> run = batch.run(Y)
    >>> run.states.shape, batch.mode
    ((3, 151, 2), 'looped')
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        *,
        members: int,
        initial_states: ArrayLike,
        threads: int | None = None,
        **options: Any,
    ) -> None:
        self.members = count("members", members, 1)
        if not isinstance(system, System):
            raise InvalidInputError(f"system is {system!r}; expected a qpmhe.System.")
        if isinstance(options.get("backend"), Solver):
            raise OptionError(
                f"backend is {options['backend']!r}; expected the name of a backend, since each "
                "member of a batch has its own solver."
            )
        self._threads = None if threads is None else count("threads", threads, 1)
        if "initial_state" in options:
            raise UnknownOptionError(
                "BatchEstimator has no option 'initial_state'; pass initial_states, one for all "
                "members or one for each."
            )
        states = _starts(initial_states, self.members, system.n)
        self.system, self.observer, self.cost = system, observer, cost
        if isinstance(observer, Observer):
            self._checked(states)
        try:
            # The checks of all that members have in common are those of a single estimator.
            one = MovingHorizonEstimator(
                system, observer, cost, initial_state=states[0], **options
            )
            # Where C could not be compiled, the single estimator has warned.
            self.settings = replace(one.settings, engine=one.engine)
            self._initial_states = states
            self._engine = self._made(states)
        except MemoryError as error:
            raise OptionError(
                f"{self.members} members with a horizon of {options.get('horizon')} need more "
                f"memory than there is ({error}); take a shorter horizon, or fewer members at once."
            ) from error

    def _checked(self, states: Array) -> Array:
        """The initial states, if a single estimator takes each of them."""
        own = self.system.copy()
        for k in np.unique(states, axis=0, return_index=True)[1].tolist():
            check_start(own, self.observer, states[k], f"initial_states[{k}]")
        return states

    def _made(self, states: Array) -> _Looped | CompiledMembers:
        parts = self.system, self.observer, self.cost, self.settings
        if self.settings.engine == "compiled":
            from .codegen.members import CompiledMembers  # late: most programs do without it

            return CompiledMembers(*parts, states, self._threads)
        return _Looped(*parts, states)

    @property
    def mode(self) -> str:
        """``compiled`` or ``looped``."""
        return "compiled" if self.settings.engine == "compiled" else "looped"

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
            states = self._checked(_starts(initial_states, self.members, self.system.n))
        try:
            self._initial_states = states
            self._engine.reset(states)
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
        y = _measurements(Y, self.members, self.system.p)
        return self._step(y, _inputs(U, self.members, self.system.m))

    def _step(self, y: Array, u: Array) -> BatchEstimate:
        if isinstance(self._engine, _Looped):
            return self._engine.step(y, u)
        return BatchEstimate(**self._engine.step(y, u), delay=self.settings.delay)

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
        ys = _record(Y, self.members, self.system.p)
        us = _input_record(U, self.members, self.system.m, ys.shape[1])
        if not isinstance(self._engine, _Looped):
            return BatchRun(**self._engine.run(ys, us))
        found = (self._step(ys[:, t], us[:, t]) for t in range(ys.shape[1]))
        return BatchRun.of(self.states, found, ys.shape[1])

    def __getstate__(self) -> dict[str, Any]:
        saved = self.__dict__.copy()
        saved["_engine"] = self._engine.state_dict()
        return saved

    def __setstate__(self, saved: dict[str, Any]) -> None:
        state = saved.pop("_engine")
        self.__dict__.update(saved)
        self._engine = self._made(self._initial_states)
        self._engine.load_state_dict(state)

    def __repr__(self) -> str:
        return (
            f"BatchEstimator(members={self.members}, horizon={self.horizon}, "
            f"mode={self.mode!r}, time={self.time})"
        )


class _Looped:
    """Engines of single estimators that take turns."""

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings, states: Array
    ) -> None:
        self._delay = settings.delay
        self._engines = [
            PythonEngine(system.copy(), observer, cost, settings, state.copy())
            for state in states
        ]

    @property
    def states(self) -> Array:
        return np.array([engine.state for engine in self._engines])

    @property
    def time(self) -> int:
        return self._engines[0].time

    def state_dict(self) -> list[dict[str, Any]]:
        return [engine.state_dict() for engine in self._engines]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        for engine, own in zip(self._engines, state, strict=True):
            engine.load_state_dict(own)

    def reset(self, states: Array) -> None:
        before = [engine.memory for engine in self._engines]
        try:
            for engine, state in zip(self._engines, states, strict=True):
                engine.reset(state)
        except BaseException:  # an interrupt: all members or none
            for engine, memory in zip(self._engines, before, strict=True):
                engine.replace(*memory)
            raise

    def step(self, y: Array, u: Array) -> BatchEstimate:
        time = self.time
        try:
            return _collected([
                engine.step(y[k], u[k], None, None, perf_counter())
                for k, engine in enumerate(self._engines)
            ], self._delay)
        except BaseException:
            for engine in self._engines:
                if engine.time > time:
                    engine.undo()
            raise


def _collected(found: list[Estimate], delay: int) -> BatchEstimate:
    return BatchEstimate(
        found[0].time,
        np.array([one.trajectory for one in found]),
        np.array([one.cost for one in found]),
        np.array([one.candidate for one in found]),
        np.array([one.candidate_cost for one in found]),
        np.array([one.status.value for one in found], np.int64),
        np.array([one.qps for one in found], np.intp),
        delay,
    )


class BatchEstimate:
    """The results of one `BatchEstimator.update`, after the measurements y(t) of K members.

    With N_t = min(t + 1, N) stages in the windows, the trajectories hold the estimates of
    x(t+1-N_t), ..., x(t+1).

    Attributes
    ----------
    time : int
        t, the index of the newest measurements; the first is 0.
    trajectories : (K, N_t + 1, n) array
        Estimates of all states in the windows.
    candidates : (K, N_t + 1, n) array
        The observers' trajectories, or their projections onto the sets.
    costs, candidate_costs : (K,) array
        True cost J of the estimates and of the candidates; costs <= candidate_costs.
    flags : (K,) int array
        Outcome and events as values of `Status`, whose sums of flags they are.
    qps : (K,) int array
        QPs solved.
    delayed : (K, n) array or None
        Estimates of x(t+1-k) for the estimator's delay k; None until the windows reach it.
    """

    def __init__(
        self,
        time: int,
        trajectories: Array,
        costs: Array,
        candidates: Array,
        candidate_costs: Array,
        flags: Flags,
        qps: Index,
        delay: int = 0,
    ) -> None:
        self.time = time
        self.trajectories, self.costs = trajectories, costs
        self.candidates, self.candidate_costs = candidates, candidate_costs
        self.flags, self.qps = flags, qps
        self.delayed: Array | None = None
        if delay < trajectories.shape[1]:
            self.delayed = trajectories[:, trajectories.shape[1] - 1 - delay]

    @property
    def states(self) -> Array:
        """Estimates of x(t+1), (K, n): predictions one step ahead of the measurements."""
        value: Array = self.trajectories[:, -1]
        return value

    @property
    def filtered(self) -> Array:
        """Estimates of x(t), (K, n), the last measured time."""
        value: Array = self.trajectories[:, -2]
        return value

    @cached_property
    def statuses(self) -> list[Status]:
        """Outcome and events of each member."""
        return statuses_of(self.flags)

    @property
    def improved(self) -> NDArray[np.bool_]:
        """Whose estimate is better than the candidate, (K,)."""
        return having(self.flags, Status.IMPROVED)

    def __len__(self) -> int:
        return self.costs.size

    def __repr__(self) -> str:
        return (
            f"BatchEstimate(time={self.time}, members={len(self)}, "
            f"improved={int(self.improved.sum())})"
        )


class BatchRun:
    """Results of T consecutive updates of K members, as arrays.

    Parameters
    ----------
    states : (K, T + 1, n) array
        Estimates of x(0), ..., x(T), each made before y of its own time: the first is the
        start.
    filtered : (K, T, n) array
        Estimates of x(0), ..., x(T-1), each made with y of its own time.
    delayed : (K, T, n) array
        Estimates with the estimator's delay, NaN where the windows did not reach that far.
    costs, candidate_costs : (K, T) array
        True cost J of estimates and candidates.
    statuses : (K, T) int array
        Outcome and events of each step as values of `Status`; ``Status(value)`` is the flag.
    qps : (K, T) int array
        QPs solved.
    """

    def __init__(
        self,
        *,
        states: Array,
        filtered: Array,
        delayed: Array,
        costs: Array,
        candidate_costs: Array,
        statuses: Flags,
        qps: Index,
    ) -> None:
        self.states, self.filtered, self.delayed = states, filtered, delayed
        self.costs, self.candidate_costs = costs, candidate_costs
        self.statuses, self.qps = statuses, qps

    @classmethod
    def of(cls, start: Array, estimates: Iterable[BatchEstimate], count: int) -> BatchRun:
        """Collect what single updates returned.

        Parameters
        ----------
        start : (K, n) array
            The estimates before the first update.
        estimates : iterable of BatchEstimate
            What the updates return; none is kept, as they hold whole windows.
        count : int
            How many there are.
        """
        members, n = start.shape
        # Time first while they are written, members first as they are read.
        states, filtered, delayed = (
            np.empty((count + more, members, n)) for more in (1, 0, 0)
        )
        costs, candidate_costs = np.empty((count, members)), np.empty((count, members))
        statuses, qps = np.empty((count, members), np.int64), np.empty((count, members), np.intp)
        states[0] = start
        for t, one in enumerate(estimates):
            states[t + 1], filtered[t] = one.states, one.filtered
            delayed[t] = np.nan if one.delayed is None else one.delayed
            costs[t], candidate_costs[t] = one.costs, one.candidate_costs
            statuses[t], qps[t] = one.flags, one.qps
        return cls(
            states=states.transpose(1, 0, 2), filtered=filtered.transpose(1, 0, 2),
            delayed=delayed.transpose(1, 0, 2), costs=costs.T,
            candidate_costs=candidate_costs.T, statuses=statuses.T, qps=qps.T,
        )

    def __len__(self) -> int:
        return int(self.costs.shape[1])

    def share(self, flag: Status) -> float:
        """The share of all members' steps whose status has this flag.

        Parameters
        ----------
        flag : Status
            The flag.
        """
        return float(having(self.statuses, flag).mean()) if self.statuses.size else 0.0


def having(flags: Flags, flag: Status) -> NDArray[np.bool_]:
    """Where values of `Status` have a flag."""
    return np.asarray((flags & flag.value) == flag.value)


def statuses_of(flags: Flags) -> list[Status]:
    """Each value of `Status` as the flag that it is."""
    known = {value: Status(value) for value in np.unique(flags).tolist()}
    return [known[value] for value in flags.tolist()]


def _starts(value: ArrayLike, members: int, n: int) -> Array:
    """Initial states (K, n), a copy, from one for all (n,) or one for each (K, n)."""
    given = numbers("initial_states", _even("initial_states", value, "states", ""))
    if given.ndim == 0 and n == 1:
        given = given.reshape(1)
    if given.shape not in ((n,), (members, n)):
        raise ShapeError(
            f"initial_states has shape {given.shape}; expected ({members}, {n}), a row for each "
            f"member, or ({n},) for all of them."
        )
    return np.array(np.broadcast_to(given, (members, n)))


def _measurements(value: ArrayLike | None, members: int, p: int) -> Array:
    """Measurements (K, p) of one time; (K,) will do where p is 1, None is nothing at all."""
    if type(value) is np.ndarray and value.shape == (members, p) and value.dtype == np.float64:
        return value
    if value is None:
        return np.full((members, p), np.nan)
    if isinstance(value, (list, tuple)):
        nothing = np.nan if p == 1 and not any(map(np.ndim, _there(value))) else [np.nan] * p
        value = [nothing if row is None else row for row in value]
    given = numbers("Y", _even("Y", value, "components", _MISSING), finite=False)
    if given.shape == (members,) and p == 1:
        given = given[:, None]
    if given.shape != (members, p):
        raise ShapeError(
            f"Y has shape {given.shape}; expected ({members}, {p}), a row for each member. "
            "Rows of NaN stand for members without a measurement."
        )
    return given


def _inputs(value: ArrayLike | None, members: int, m: int) -> Array:
    """Inputs (K, m) of one time, from one for all (m,) or one for each (K, m)."""
    if _without_inputs(value, m, "update(Y, U)"):
        return np.zeros((members, 0))
    assert value is not None
    given = numbers("U", _even("U", value, "components", ""), finite=False)
    if given.ndim == 0 and m == 1:
        given = given.reshape(1)
    if given.shape not in ((m,), (members, m)):
        raise ShapeError(
            f"U has shape {given.shape}; expected ({members}, {m}), a row for each member, or "
            f"({m},) for all of them."
        )
    return np.array(np.broadcast_to(given, (members, m)))


def _record(value: ArrayLike, members: int, p: int) -> Array:
    """Measurements (K, T, p) of a record; (K, T) will do where p is 1."""
    given = numbers("Y", _even("Y", value, "samples", _MISSING), finite=False)
    if given.ndim == 2 and p == 1:
        given = given[:, :, None]
    if given.ndim != 3 or given.shape[::2] != (members, p):
        raise ShapeError(
            f"Y has shape {given.shape}; expected ({members}, T, {p}): a record for each member, "
            "with a row for each sample."
        )
    return given


def _input_record(value: ArrayLike | None, members: int, m: int, steps: int) -> Array:
    """Inputs (K, T, m) of a record, from one for all (T, m) or one for each (K, T, m)."""
    if _without_inputs(value, m, "run(Y, U)"):
        return np.zeros((members, steps, 0))
    assert value is not None
    given = numbers("U", _even("U", value, "samples", ""), finite=False)
    if given.ndim == 1 and m == 1:
        given = given[:, None]
    if given.shape not in ((steps, m), (members, steps, m)):
        raise ShapeError(
            f"U has shape {given.shape}; expected ({members}, {steps}, {m}), a record for each "
            f"member as long as its measurements, or ({steps}, {m}) for all of them."
        )
    return np.broadcast_to(given, (members, steps, m))


_MISSING = " Fill up with NaN, which stands for what was not measured."


def _there(rows: Any) -> list[Any]:
    return [row for row in rows if row is not None]


def _without_inputs(value: ArrayLike | None, m: int, call: str) -> bool:
    """Whether there are none, as it must be where the system has none."""
    if value is None and m:
        raise InvalidInputError(f"U is missing; the system has {m} inputs: {call}.")
    if value is not None and m == 0:
        raise InvalidInputError("U was given, but the system has no inputs; leave it out.")
    return value is None


def _even(name: str, value: ArrayLike, parts: str, remedy: str) -> ArrayLike:
    """The value, if it is no list of rows of different lengths."""
    if isinstance(value, (list, tuple)):
        lengths = sorted({len(row) for row in value if hasattr(row, "__len__")})
        if len(lengths) > 1:
            raise ShapeError(
                f"{name} has rows of {lengths[0]} to {lengths[-1]} {parts}; expected the same "
                f"number for every member.{remedy}"
            )
    return value
