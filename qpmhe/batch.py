"""Many independent estimators of one system: threads over the compiled step, or a loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import Solver

from ._checks import dimension, numbers
from .costs import Cost
from .errors import InvalidInputError, OptionError, ShapeError, UnknownOptionError
from .estimation.engine import PythonEngine
from .estimation.engines import ModelChangedError
from .estimation.estimate import Status
from .estimation.estimator import MovingHorizonEstimator
from .estimation.settings import Settings
from .estimation.start import check_start
from .model.system import System, checked_system
from .model.traces import warn_of
from .observers import Observer

if TYPE_CHECKING:
    from .codegen.members import CompiledMembers

Array = NDArray[np.float64]
Flags = NDArray[np.int64]
Index = NDArray[np.intp]


class BatchEstimator:
    """K independent estimators of one system, for Monte Carlo studies and fleets.

    Each member gives the estimates of a `qpmhe.MovingHorizonEstimator` with the same arguments, and
    falls back independently. With the compiled step, threads share the members; otherwise the
    members run one after another. ``engine="auto"`` chooses as for a single estimator.

    Parameters
    ----------
    system, observer, cost
        Shared by all members.
    members : int
        K >= 1.
    initial_states : (n,) or (K, n) array_like
        Initial estimate of all members, or of each.
    threads : int, optional
        Number of threads of the compiled step; by default one per processor.
    **options
        Options of `qpmhe.MovingHorizonEstimator`, such as the horizon. The time budget applies to
        each member.

    Raises
    ------
    InvalidInputError
        If an argument is invalid; the subclass says how (see `qpmhe.errors`).

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> system, observer, cost, scenario = qpmhe.models.batch_reactor()
    >>> Y = np.array([scenario.simulate(seed).measurements for seed in range(3)])
    >>> batch = qpmhe.BatchEstimator(
    ...     system, observer, cost, members=3, horizon=10, initial_states=[3.0, 0.0])
    >>> run = batch.run(Y)
    >>> run.states.shape
    (3, 151, 2)
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, *, members: int,
        initial_states: ArrayLike, threads: int | None = None, **options: Any,
    ) -> None:
        self.members = dimension("members", members, 1)
        checked_system(system)
        if isinstance(options.get("backend"), Solver):
            raise OptionError(
                f"backend is {options['backend']!r}; expected the name of a backend, since each "
                "member of a batch has its own solver."
            )
        self._threads = None if threads is None else dimension("threads", threads, 1)
        if "initial_state" in options:
            raise UnknownOptionError(
                "BatchEstimator has no option 'initial_state'; pass initial_states, one for all "
                "members or one for each."
            )
        if "parameters" in options:
            raise UnknownOptionError(
                "BatchEstimator has no option 'parameters'; pass them as the last inputs of each "
                "member."
            )
        states = _starts(initial_states, self.members, system.n)
        self.system, self.observer, self.cost = system, observer, cost
        if isinstance(observer, Observer):
            states = self._checked(states, options.get("projection_metric", "observer"))
        try:
            # A single estimator checks all that the members have in common.
            one = MovingHorizonEstimator(
                system, observer, cost, initial_state=states[0], **options
            )
            # The one engine of all members. Where C could not be compiled, `one` has warned.
            self.settings = replace(one.settings, engine=one.engine)
            self._initial_states = states
            self._engine = self._made(states)
        except MemoryError as error:
            raise OptionError(
                f"{self.members} members with a horizon of {options.get('horizon')} need more "
                f"memory than available ({error}); take a shorter horizon, or fewer members."
            ) from error

    def _checked(self, states: Array, metric: Any) -> Array:
        """The initial states, if a single estimator takes each of them."""
        own = self._own().as_written()
        _, first, which = np.unique(states, axis=0, return_index=True, return_inverse=True)
        checked = [
            check_start(
                own, self.observer, self.cost, states[k], f"initial_states[{k}]",
                metric=metric,
            )[0]
            for k in first.tolist()
        ]
        return np.array(checked)[which.ravel()]

    def _own(self) -> System:
        """The system as a single estimator evaluates it."""
        return _evaluated(self.system, self.cost, self.observer)

    def _made(self, states: Array) -> _Looped | CompiledMembers:
        parts = self.system, self.observer, self.cost, self.settings
        if self.settings.engine == "compiled":
            from .codegen.members import CompiledMembers  # late: most programs do without it

            return CompiledMembers(self._own(), *parts[1:], states, self._threads)
        return _Looped(*parts, states)

    def _leave_compiled(self, error: Exception) -> None:
        """Let the Python step take over, with the functions as they are written."""
        assert not isinstance(self._engine, _Looped)
        settings = replace(self.settings, engine="python")
        looped = _Looped(
            self.system, self.observer, self.cost, settings, self.states, traced=False
        )
        self._engine.hand_over(looped.engines)
        self._engine, self.settings = looped, settings
        warn_of(str(error), 4)

    @property
    def engine(self) -> str:
        """The engine in use, ``python`` or ``compiled``, also with ``engine="auto"``."""
        return self.settings.engine

    @property
    def mode(self) -> str:
        """``compiled``, or ``looped`` for a loop over Python estimators."""
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
        """The horizon N."""
        return self.settings.horizon

    def reset(self, initial_states: ArrayLike | None = None) -> None:
        """Forget all measurements and restart, at the former initial states if none are given.

        Parameters
        ----------
        initial_states : (n,) or (K, n) array_like, optional
            New initial estimates. Invalid ones raise an `InvalidInputError` and leave the estimator
            unchanged.
        """
        before = states = self._initial_states
        if initial_states is not None:
            given = _starts(initial_states, self.members, self.system.n)
            states = self._checked(given, self.settings.projection_metric)
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
        """Take the measurements y(t) and inputs u(t) of all members, and estimate x(t+1).

        See `MovingHorizonEstimator.update`. An update interrupted by Ctrl+C takes no member's
        sample; in compiled code it takes all or none: see ``time``.

        Parameters
        ----------
        Y : (K, p) array_like
            y(t) of each member, a row of None where a member has none; (K,) if p is 1.
        U : (K, m) or (m,) array_like, optional
            u(t) of each member, or of all.

        Returns
        -------
        BatchEstimate
            The estimates of all members.

        Raises
        ------
        ShapeError, InvalidInputError
            If an argument is invalid; the estimator stays unchanged.
        """
        y = _measurements(Y, self.members, self.system.p)
        return self._step(y, _inputs(U, (self.members, self.system.m), "update(Y, U)"))

    def _step(self, y: Array, u: Array) -> BatchEstimate:
        if isinstance(self._engine, _Looped):
            return self._engine.step(y, u)
        try:
            return BatchEstimate(**self._engine.step(y, u), engine=self.engine)
        except ModelChangedError as error:
            self._leave_compiled(error)
        return self._step(y, u)

    def run(self, Y: ArrayLike, U: ArrayLike | None = None) -> BatchRun:
        """Process whole records, starting at the current states.

        Parameters
        ----------
        Y : (K, T, p) array_like
            y(t), ..., y(t+T-1) of each member; (K, T) if p is 1. Pad shorter records with NaN.
        U : (K, T, m) or (T, m) array_like, optional
            The inputs at the same times, of each member or of all.

        Returns
        -------
        BatchRun
            Estimates, costs and statuses of all steps.

        Raises
        ------
        ShapeError, InvalidInputError
            If an argument is invalid; then no sample has been processed.
        """
        remedy = f"a record for each member, with a row for each sample. {_MISSING}"
        ys = _shaped("Y", Y, ((self.members, None, self.system.p),), remedy)
        shape, n = ys.shape[:2], self.system.n
        us = _inputs(U, (*shape, self.system.m), "run(Y, U)")
        if not isinstance(self._engine, _Looped):
            try:
                return BatchRun(**self._engine.run(ys, us), engine=self.engine)
            except ModelChangedError as error:
                self._leave_compiled(error)
        found = BatchRun(
            states=np.empty((shape[0], shape[1] + 1, n)), filtered=np.empty((*shape, n)),
            observer_states=np.empty((shape[0], shape[1] + 1, n)),
            costs=np.empty(shape), candidate_costs=np.empty(shape),
            statuses=np.empty(shape, np.int64), qps=np.empty(shape, np.intp),
            rejected_sensors=np.empty(
                (*shape, len(self.observer.sensors) * self.observer.rejects), np.bool_
            ),
        )
        found.states[:, 0] = self.states
        found.observer_states[:, 0] = self._engine.observer_states
        for t in range(shape[1]):
            one = self._step(ys[:, t], us[:, t])
            found.states[:, t + 1], found.filtered[:, t] = one.states, one.filtered
            found.observer_states[:, t + 1] = one.observer_states
            found.rejected_sensors[:, t] = one.rejected_sensors
            found.costs[:, t], found.candidate_costs[:, t] = one.costs, one.candidate_costs
            found.statuses[:, t], found.qps[:, t] = one.flags, one.qps
        return found

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
        self, system: System, observer: Observer, cost: Cost, settings: Settings, states: Array,
        traced: bool = True,
    ) -> None:
        own = _evaluated(system, cost, observer)
        if not traced:
            own = own.as_written()
        self.engines = [
            PythonEngine(own, observer, cost, settings, state.copy()) for state in states
        ]

    @property
    def states(self) -> Array:
        return np.array([engine.state for engine in self.engines])

    @property
    def observer_states(self) -> Array:
        return np.array([engine.observer_state for engine in self.engines])

    @property
    def time(self) -> int:
        return self.engines[0].time

    def state_dict(self) -> list[dict[str, Any]]:
        return [engine.state_dict() for engine in self.engines]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        for engine, own in zip(self.engines, state, strict=True):
            engine.load_state_dict(own)

    def reset(self, states: Array) -> None:
        before = [engine.memory for engine in self.engines]
        try:
            for engine, state in zip(self.engines, states, strict=True):
                engine.reset(state)
        except BaseException:  # an interrupt: all members or none
            for engine, memory in zip(self.engines, before, strict=True):
                engine.replace(*memory)
            raise

    def step(self, y: Array, u: Array) -> BatchEstimate:
        time = self.time
        try:
            found = [
                engine.step(y[k], u[k], None, None, perf_counter())
                for k, engine in enumerate(self.engines)
            ]
            return BatchEstimate(
                found[0].time,
                np.array([one.trajectory for one in found]),
                np.array([one.cost for one in found]),
                np.array([one.candidate for one in found]),
                np.array([one.candidate_cost for one in found]),
                np.array([one.status.value for one in found], np.int64),
                np.array([one.qps for one in found], np.intp),
                np.array([one.filtered for one in found]),
                np.array([one.observer_state for one in found]),
                np.array([one.rejected for one in found]),
            )
        except BaseException:
            for engine in self.engines:
                if engine.time > time:
                    engine.undo()
            raise


@dataclass(eq=False, repr=False)
class BatchEstimate:
    """The results of one `BatchEstimator.update`: an `Estimate` with a leading member axis.

    Attributes
    ----------
    time : int
        t, the index of the newest measurements; the first is 0.
    trajectories, candidates : (K, N_t + 1, n) array
        Estimates of all states in the windows, and the candidates.
    costs, candidate_costs : (K,) array
        True cost J of each.
    flags, qps : (K,) int array
        Status values, and numbers of QPs solved.
    filtered : (K, n) array
        Estimates of x(t).
    observer_states : (K, n) array
        The observers' states z(t+1), from which they continue.
    rejected_sensors : (K, s) bool array
        Whether each observer's gate rejected each of its s sensors; s is 0 without a gate.
    engine : str
        The engine that ran the step: ``python`` or ``compiled``.
    """

    time: int
    trajectories: Array
    costs: Array
    candidates: Array
    candidate_costs: Array
    flags: Flags
    qps: Index
    filtered: Array
    observer_states: Array
    rejected_sensors: NDArray[np.bool_]
    engine: str = "python"

    @property
    def states(self) -> Array:
        """Estimates of x(t+1), (K, n)."""
        return self.trajectories[:, -1]

    @cached_property
    def statuses(self) -> list[Status]:
        """Outcome and events of each member."""
        return [Status(value) for value in self.flags.tolist()]

    @property
    def improved(self) -> NDArray[np.bool_]:
        """Which members' estimates are better than their candidates, (K,)."""
        return np.asarray((self.flags & Status.IMPROVED.value) != 0)

    def __len__(self) -> int:
        return self.costs.size

    def __repr__(self) -> str:
        return (
            f"BatchEstimate(time={self.time}, members={len(self)}, "
            f"improved={int(self.improved.sum())})"
        )


@dataclass(eq=False, repr=False, kw_only=True)
class BatchRun:
    """Results of T consecutive updates of K members: a `Run` with a leading member axis.

    Attributes
    ----------
    states : (K, T + 1, n) array
        Estimates of x(0), ..., x(T); the estimate of x(t) does not use y(t).
    observer_states : (K, T + 1, n) array
        The observers' own states z(0), ..., z(T).
    filtered : (K, T, n) array
        Estimates of x(t) that use y(t).
    costs, candidate_costs : (K, T) array
        True cost J of estimates and candidates.
    statuses, qps : (K, T) int array
        Status values (``Status(value)`` makes a flag), and numbers of QPs solved.
    rejected_sensors : (K, T, s) bool array
        Whether each observer's gate rejected each of its s sensors.
    engine : str
        The engine that ran the steps: ``python`` or ``compiled``.
    """

    states: Array
    observer_states: Array
    filtered: Array
    costs: Array
    candidate_costs: Array
    statuses: Flags
    qps: Index
    rejected_sensors: NDArray[np.bool_]
    engine: str = "python"

    def __len__(self) -> int:
        return int(self.costs.shape[1])

    def share(self, flag: Status) -> float:
        """The share of all members' steps whose status has this ``flag``."""
        has = (self.statuses & flag.value) == flag.value
        return float(has.mean()) if has.size else 0.0


def _evaluated(system: System, cost: object, observer: Observer) -> System:
    """The system as a single estimator evaluates it."""
    scales = None
    if isinstance(cost, Cost):  # the single estimator refuses any other
        scales = cost.prior_deviations(observer.initial_covariance(), system.disturbance_matrix)
    return system.evaluated_by(system.model(scales))


def _starts(value: ArrayLike, members: int, n: int) -> Array:
    """Initial states (K, n), a copy."""
    shapes = (n,), (members, n)
    remedy = f"a row for each member, or ({n},) for all of them."
    given = _shaped("initial_states", value, shapes, remedy, finite=True)
    return np.array(np.broadcast_to(given, (members, n)))


def _measurements(value: ArrayLike | None, members: int, p: int) -> Array:
    """Measurements (K, p) of one time; None stands for a missing row, or for all."""
    if type(value) is np.ndarray and value.shape == (members, p) and value.dtype == np.float64:
        return value
    if value is None:
        return np.full((members, p), np.nan)
    if isinstance(value, (list, tuple)):
        like = next((row for row in value if row is not None), [np.nan] * p)
        nothing = np.full(np.shape(like), np.nan).tolist()
        value = [nothing if row is None else row for row in value]
    remedy = f"a row for each member. {_MISSING}"
    return _shaped("Y", value, ((members, p),), remedy)


def _inputs(value: ArrayLike | None, shape: tuple[int, ...], call: str) -> Array:
    """Inputs of the shape (K, ..., m), the same for all members if given without K."""
    m, common = shape[-1], shape[1:]
    if value is None and m:
        raise InvalidInputError(f"U is missing; the system has {m} input{'s' * (m != 1)}: {call}.")
    if value is None:
        return np.zeros(shape)
    if m == 0:
        raise InvalidInputError("U was given, but the system has no inputs; leave it out.")
    remedy = f"inputs for each member and each sample of Y, or {common} for all members."
    return np.array(np.broadcast_to(_shaped("U", value, (common, shape), remedy), shape))


_MISSING = "Use NaN for missing measurements."


def _shaped(
    name: str, value: ArrayLike, shapes: tuple[tuple[int | None, ...], ...], remedy: str,
    *, finite: bool = False,
) -> Array:
    """The value in one of the shapes, of which None is any length and a last 1 may be left out."""
    if isinstance(value, (list, tuple)):
        lengths = sorted({len(row) for row in value if hasattr(row, "__len__")})
        if len(lengths) > 1:
            parts = "samples" if len(shapes[-1]) == 3 else "states" if finite else "components"
            raise ShapeError(
                f"{name} has rows of {lengths[0]} to {lengths[-1]} {parts}; expected the same "
                f"number for every member: {remedy}"
            )
    given = numbers(name, value, finite=finite)
    for one, shape in product((given, given[..., None]), shapes):
        if one.ndim == len(shape) and all(
            size in (length, None) for length, size in zip(one.shape, shape, strict=True)
        ):
            return one
    expected = str(shapes[-1]).replace("None", "T")
    raise ShapeError(f"{name} has shape {given.shape}; expected {expected}, {remedy}")
