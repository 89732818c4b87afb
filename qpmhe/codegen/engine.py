"""The compiled engine: the generated C step, loaded into this process."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import check_problem
from ..costs import Cost
from ..errors import InvalidInputError
from ..estimation.conditions import ConditionReader, Conditions, usual_conditions
from ..estimation.description import check_description, described
from ..estimation.engine import PythonEngine
from ..estimation.engines import EngineChangeError
from ..estimation.estimate import DroppedRow, Estimate, Status
from ..estimation.problem import Solved
from ..estimation.run import Run
from ..estimation.settings import Settings
from ..memory.snapshot import reading
from ..model.captured import Due
from ..model.system import System
from ..observers import Observer
from .estimate import WATCHED, CompiledEstimate, CompiledWatch
from .exchange import (
    empty_record,
    hand_over,
    own_fields,
    record_of,
    sample_arrays,
    write,
    write_sample,
)
from .failure import FAILED, Failure
from .layout import CHANGES
from .library import EstimatorLibrary
from .watched import WatchedFunctions

Array = NDArray[np.float64]

_ROWS_DROPPED, _OUTSIDE = Status.ROWS_DROPPED.value, Status.CANDIDATE_OUTSIDE.value
_TIME_UP, _NEVER = Status.TIME_UP.value, np.zeros(1, np.uint8)
# So that a long record can be interrupted, and its times are means of pieces.
_PIECE = 256


class CompiledTools(NamedTuple):
    """What a step uses; made again when the usual conditions change."""

    usual: Conditions
    system: System
    cost: Cost
    record: NDArray[Any]


class CompiledEngine:
    """The loop body in C; otherwise as `PythonEngine`."""

    name = "compiled"

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings,
        initial_state: Array, library: EstimatorLibrary,
    ) -> None:
        self._library = library
        self._system, self._given_cost, self._settings = system, cost, settings
        self._reader = ConditionReader(system, cost)
        self._directions = directions = library.directions
        self._tools = CompiledTools(
            usual_conditions(settings), system, directions.cost, library.settings
        )
        space = directions.cost.space
        self._to_disturbances = None if space is None else space.to_disturbances
        n, p, m, horizon = system.n, system.p, system.m, settings.horizon
        self._sizes = n, p, horizon
        self._workspace = library.workspace()
        self._memory = library.estimators(initial_state[None])
        self._y, self._u = np.zeros(p), np.zeros(max(m, 1))
        self._inputs = self._u[:m]
        self._out = np.zeros(1, library.estimate_type)
        fields = library.estimate_type.fields
        assert fields is not None
        reals = fields["time"][1] // 8
        self._block = self._out.view(np.float64)[:reals]
        self._numbers = self._out.view(np.int32)[2 * reals + 2 : 2 * reals + 8]
        self._before = np.empty_like(self._memory)  # before the last step
        # A sample as usual, and one with something of its own.
        self._samples = np.zeros(2, library.sample_type)
        self._samples["y"], self._samples["u"] = self._y.ctypes.data, self._u.ctypes.data
        self._own = self._samples[1], sample_arrays(library.layout)
        memory, before, workspace, usual, special, out = (
            ctypes.c_void_p(array.ctypes.data)
            for array in (
                self._memory, self._before, self._workspace, self._samples[:1], self._samples[1:],
                self._out,
            )
        )
        self._usual, self._special = (
            (memory, before, workspace, sample, out) for sample in (usual, special)
        )
        self._amending, self._undoing, self._result = (memory, workspace), (memory, before), out
        self._call = library.update
        self._observer, self._watch = observer, CompiledWatch(horizon)
        self._rejects = observer.rejects
        # Whether a nonlinear constraint has failed along a trial, where there are any.
        self._trial_failed = self._out["trial_failed"] if library.layout.constraints else _NEVER
        self._time = self._memory["time"]
        # Holds the present window where that is asked for.
        self._mirror: PythonEngine | None = None
        self._traces = WatchedFunctions(system, observer, cost, settings.time_budget is None)
        self._times = self._traces.times

    def reset(self, initial_state: Array, system: System | None = None) -> None:
        """Forget all measurements and start at this state."""
        tools = self._tools
        self._replace(self._library.estimators(initial_state[None], tools.record), tools)
        if system is not None:
            self._system, self._mirror = self._system.evaluated_like(system), None

    def _replace(self, memory: NDArray[Any], tools: CompiledTools) -> None:
        """Remember this in place of all that was; whole or, if interrupted, not at all."""
        before = self._memory.copy(), self._tools
        self._held = tools, self._tools  # the memory points to a record of these
        try:
            self._times.restart(int(memory["time"].item()))
            self._memory[...], self._tools = memory, tools  # last: nothing behind it can fail
        except BaseException:
            self._memory[...], self._tools = before
            raise

    def _tools_for(self, usual: Conditions) -> CompiledTools:
        """What a step uses under these usual conditions."""
        system, cost = usual.applied(self._system, self._directions.cost)
        return CompiledTools(usual, system, cost, self._library.settings_for(system, cost, usual))

    @property
    def usual(self) -> Conditions:
        """The conditions of a sample that comes without any."""
        return self._tools.usual

    @property
    def system(self) -> System:
        """The system with its present sets."""
        return self._tools.system

    @property
    def cost(self) -> Cost:
        """The cost with its present weights."""
        return self._tools.cost

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return int(self._time.item())

    @property
    def state(self) -> Array:
        """The current estimate."""
        record = self._memory[0]
        state: Array = record["history_end"].copy()
        return state

    @property
    def observer_state(self) -> Array:
        """The state from which the observer continues."""
        state: Array = self._memory[0]["z_end"].copy()
        return state

    @property
    def length(self) -> int:
        """Number of samples in the window."""
        return int(self._memory[0]["length"])

    def set(self, changes: Conditions, parameters: Array | None) -> Estimate | None:
        """Apply other conditions at all samples of the window and from now on."""
        began, memory, before = perf_counter(), self._memory.copy(), self._tools
        usual = changes.over(self.usual)
        if parameters is not None:
            usual = usual._replace(parameters=parameters)
        tools = self._tools_for(usual)
        self._held = tools, before
        bits = sum(1 << k for k, name in enumerate(CHANGES) if getattr(changes, name) is not None)
        given = None if parameters is None else np.array(parameters, np.float64)
        try:
            self._library.set(
                *self._amending, ctypes.c_void_p(tools.record.ctypes.data), bits,
                None if given is None else ctypes.c_void_p(given.ctypes.data),
                0 if given is None else given.size, self._result,
            )
            self._tools = tools
            if not self.length:
                return None
            estimate = self._collect(self.time - 1)
            if self._numbers[1] & FAILED or self._trial_failed[0]:
                estimate.failure = self._failure(
                    memory, before.usual, lambda engine: engine.set(changes, given)
                )
            estimate.step_time = perf_counter() - began
            return estimate
        except BaseException:
            self._memory[...], self._tools = memory, before
            raise

    def step(
        self, y: Array, u: Array, dt: float | None, own: Conditions | None, began: float
    ) -> Estimate:
        """Take in a sample, and estimate."""
        time = self._time.item()
        if time >= self._times.next:
            self._check_trace(u)
        try:
            self._y[...] = y
            self._inputs[...] = u
            if dt is None and own is None:
                self._call(*self._usual)
            else:
                write_sample(*self._own, self._directions, dt, own)
                self._call(*self._special)
            estimate = self._collect(time)
            if self._numbers[1] & FAILED or self._trial_failed[0]:
                inputs = y.copy(), u.copy(), dt, own
                memory = self._memory.copy()
                self._library.undo(ctypes.c_void_p(memory.ctypes.data), self._undoing[1])
                estimate.failure = self._failure(
                    memory, self.usual, lambda engine: engine.step(*inputs, math.nan)
                )
            estimate.step_time = perf_counter() - began
            if self._numbers[1] & WATCHED:
                far, dropped = self._memory[0]["watched"].tolist()
                self._watch.warn(far, dropped, 3)
            return estimate
        except BaseException:  # an interrupt, or a warning as an error: the sample is not taken
            if self.time != time:
                self._library.undo(*self._undoing)
            raise

    def _check_trace(self, u: Array, before: NDArray[Any] | None = None) -> None:
        """Compare traces and functions if it is time to."""
        due = self._times.due(self.time)
        if due is not Due.NOWHERE:
            self._compare(due, u, before)

    def verify(self, u: Array) -> bool:
        """Compare traces and functions now; raises where they differ, as a step does."""
        self._compare(Due.EVERYWHERE, u)
        return True

    def _compare(self, due: Due, u: Array, before: NDArray[Any] | None = None) -> None:
        """Compare traces and functions at z(t); where they differ, the Python step takes over.

        From an earlier memory, if there is one.
        """
        fault = self._traces.fault(due, [(self._memory[0]["z_end"], u)])
        if not fault:
            self._times.compared(self.time)
            return
        if before is not None:
            self._memory[...] = before
        system = self._system.as_written()
        record, state = self._memory[0], self._memory[0]["z_end"].copy()
        parts = system, self._observer, self._given_cost, self._settings
        engine = PythonEngine(*parts, state)
        hand_over(record, self._library.layout, self._directions, self.usual, engine, True)
        raise EngineChangeError(engine, fault)

    def _collect(self, time: int) -> CompiledEstimate:
        block, numbers = self._block.copy(), self._numbers.tolist()
        dropped: tuple[DroppedRow, ...] = ()
        missed, layout = dropped, self._library.layout
        if numbers[1] & _ROWS_DROPPED:
            sides = self._out[0]["dropped"][: numbers[0] + 1]
            dropped = layout.dropped_rows(sides, time + 1 - numbers[0])
        if layout.restores and numbers[1] & _OUTSIDE:
            sides = self._out[0]["missed"][: numbers[0] + 1]
            missed = layout.dropped_rows(sides, time + 1 - numbers[0])
        rejected = None
        if self._rejects:
            rejected = self._out[0]["rejected"].astype(np.bool_)
        return CompiledEstimate(
            block, numbers, time, self._sizes, dropped, self._to_disturbances, rejected, missed,
        )

    def _rejecting(self, rejected: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        """Which sensors of a gate were rejected; None without a gate."""
        return rejected.astype(np.bool_) if self._rejects else None

    def amend(self, time: int, y: Array) -> Estimate:
        """Insert a late measurement, and estimate again."""
        began = perf_counter()
        before = self._memory.copy()
        try:
            self._y[...] = y
            self._library.amend(
                *self._amending, time, ctypes.c_void_p(self._y.ctypes.data), self._result
            )
            estimate = self._collect(self.time - 1)
            if self._numbers[1] & FAILED or self._trial_failed[0]:
                late = y.copy()
                estimate.failure = self._failure(
                    before, self.usual, lambda engine: engine.amend(time, late)
                )
            estimate.step_time = perf_counter() - began
            return estimate
        except BaseException:
            self._memory[...] = before
            raise

    def _failure(
        self, memory: NDArray[Any], usual: Conditions,
        step: Callable[[PythonEngine], Estimate | None],
    ) -> Failure:
        settings = replace(self._settings, time_budget=None)
        if self._numbers[1] & _TIME_UP:  # after as many QPs
            settings = replace(settings, max_qps=int(self._numbers[2]))
        parts = self._system, self._observer, self._given_cost, settings
        return Failure(parts, self._library, usual, memory, step)

    def run(self, ys: Array, us: Array | None) -> Run:
        """Process a whole record without leaving C; times are means over some samples."""
        samples = len(ys)
        log, start = self._library.log((samples,)), self.state
        observer_start = self.observer_state
        dropped = self._memory["watched"][0, 1].copy()
        times = np.empty(samples)
        ys = np.ascontiguousarray(ys)
        us = None if us is None else np.ascontiguousarray(us)
        memory, workspace = self._memory.ctypes.data, self._workspace.ctypes.data
        before = None if self._times.next == math.inf else self._memory.copy()
        nothing = np.zeros(0)
        for first in range(0, samples, _PIECE):
            count = min(_PIECE, samples - first)
            if before is not None:
                self._check_trace(nothing if us is None else us[first], before)
            began = perf_counter()
            self._library.run(
                memory, 1, workspace, count, ys[first:].ctypes.data,
                None if us is None else us[first:].ctypes.data, log.pointers(first),
            )
            times[first : first + count] = (perf_counter() - began) / count
        self._watch.warn(*log.watched(self._settings.horizon, dropped), 3)
        return Run(
            states=np.vstack((start, log.states)), filtered=log.filtered, costs=log.costs,
            candidate_costs=log.candidate_costs, times=times,
            solve_times=np.full(samples, np.nan), qps=log.qps.astype(np.intp),
            solver_iterations=log.iterations.astype(np.intp), flags=log.flags,
            engine=self.name, rejected_sensors=self._rejecting(log.rejected),
            observer_states=np.vstack((observer_start, log.observer_states)),
        )

    def covariances(self) -> Array:
        """Covariances along the last estimate, as the Python step has them."""
        self.solved()
        assert self._mirror is not None
        return self._mirror.covariances()

    def solved(self) -> Solved:
        """The last step's problem and its estimate, as the Python step has them."""
        record = self._memory[0]
        if not record["has_trajectory"]:
            raise InvalidInputError("there is no estimate yet; call update first.")
        if self._mirror is None:
            parts = self._system, self._observer, self._given_cost
            self._mirror = PythonEngine(*parts, self._settings, self.state)
        with np.errstate(all="ignore"):
            hand_over(
                record, self._library.layout, self._directions, self.usual, self._mirror, False
            )
        return self._mirror.solved()

    def forget_warm_start(self) -> None:
        """Nothing to do: what the C step keeps between QPs is in its memory."""

    def state_dict(self) -> dict[str, Any]:
        """All information from the measurements so far, as plain arrays and numbers."""
        record, layout = self._memory[0], self._library.layout
        return {
            "problem": self._size(), "engine": self.name, "estimator": self._description(),
            "linearized": self._settings.qp_limit > 0, "usual": self.usual.state_dict(),
            "window": record_of(record, layout, self._directions).state_dict(),
            "compiled": own_fields(record, layout.sizes),
        }

    def _description(self) -> dict[str, Any]:
        return described(self._system, self._observer, self._given_cost, self._settings)

    def _size(self) -> tuple[int, ...]:
        system = self._system
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped."""
        check_problem(state, self._size())
        if str(state.get("engine")) != "compiled":
            raise InvalidInputError(
                f"the state is of an estimator with engine={state.get('engine')!r}; expected "
                "'compiled', the engine of this one: make this one with the engine of the state."
            )
        with reading():
            check_description(state["estimator"], self._description())
            tools = self._tools_for(self._reader.load(state["usual"], self.usual))
            linearized, layout = state["linearized"], self._library.layout
            if not isinstance(linearized, bool):
                raise TypeError(f"linearized is {linearized!r}")
            record = empty_record(layout, self._directions)
            record.load_state_dict(
                state["window"], lambda own: self._reader.load(own, tools.usual),
                may_be_irregular=bool(self._system.dt),
                is_smoothed=self._settings.arrival == "smoothed",
                # A graduated loss may leave the trajectory of a widened one.
                ends_alike=self.cost.graduation == 1.0,
            )
            memory = self._library.estimators(record.z[:1], tools.record)
            write(memory[0], layout.sizes, record, state["compiled"])
            if self._settings.qp_limit and not linearized:
                self._library.recompute(memory.ctypes.data)
        self._replace(memory, tools)
