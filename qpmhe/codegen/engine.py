"""The compiled engine: the generated C step, loaded into this process."""

from __future__ import annotations

import ctypes
import math
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import check_problem, positive_definite
from ..costs import Cost
from ..costs.base import quadratic_form
from ..errors import InvalidInputError
from ..estimation.conditions import ConditionReader, Conditions, usual_conditions
from ..estimation.engine import PythonEngine
from ..estimation.engines import EngineChangeError
from ..estimation.estimate import DroppedRow, Estimate, Status
from ..estimation.problem import Solved
from ..estimation.run import Run
from ..estimation.settings import Settings
from ..estimation.snapshot import (
    check_description,
    check_root,
    checked_array,
    described,
    mismatch,
    near,
    reading,
)
from ..model.system import System
from ..model.traces import next_check
from ..observers import Observer
from .estimate import WATCHED, CompiledEstimate, CompiledWatch
from .handover import hand_over
from .layout import CHANGES, SET_NAMES, STAGE_FLAGS
from .library import EstimatorLibrary
from .sample import SampleRecord
from .watched import WatchedFunctions

Array = NDArray[np.float64]

_ROWS_DROPPED = Status.ROWS_DROPPED.value
# So that a long record can be interrupted, and its times are means of pieces.
_PIECE = 256


class Tools(NamedTuple):
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
        self._tools = Tools(usual_conditions(settings), system, directions.cost, library.settings)
        space = directions.cost.space
        self._to_disturbances = None if space is None else space.to_disturbances
        n, p, m, horizon = system.n, system.p, system.m, settings.horizon
        self._sizes = n, p, horizon
        self._workspace = library.workspace()
        self._memory = library.estimators(initial_state[None])
        self._y, self._u = np.zeros(p), np.zeros(max(m, 1))
        self._inputs = self._u[:m]
        self._out = np.zeros(1, library.estimate_type)
        reals = library.estimate_type.fields["time"][1] // 8  # type: ignore[index]
        self._block = self._out.view(np.float64)[:reals]
        self._numbers = self._out.view(np.int32)[2 * reals + 2 : 2 * reals + 8]
        self._before = np.empty_like(self._memory)  # before the last step
        # A sample as usual, and one with something of its own.
        self._plain, self._own = (
            SampleRecord(library.layout, directions, self._y, self._u) for _ in range(2)
        )
        memory, before, workspace, usual, special, out = (
            ctypes.c_void_p(array.ctypes.data)
            for array in (
                self._memory, self._before, self._workspace, self._plain.record, self._own.record,
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
        self._time = self._memory["time"]
        # Holds the present window where that is asked for.
        self._mirror: PythonEngine | None = None
        # The time of the next comparison of the trace with the functions that it stands for.
        self._traces = WatchedFunctions(system, observer, cost)
        self._next_check: float = 0 if self._traces else math.inf

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""
        tools = self._tools
        self._replace(self._library.estimators(initial_state[None], tools.record), tools)

    def _replace(self, memory: NDArray[Any], tools: Tools) -> None:
        """Remember this in place of all that was; whole or, if interrupted, not at all."""
        before = self._memory.copy(), self._tools
        self._held = tools, self._tools  # the memory points to a record of these
        next_check = self._next_check
        try:
            self._next_check = 0 if self._traces else math.inf
            self._memory[...], self._tools = memory, tools  # last: nothing behind it can fail
        except BaseException:
            self._next_check = next_check
            self._memory[...], self._tools = before
            raise

    def _tools_for(self, usual: Conditions) -> Tools:
        """What a step uses under these usual conditions."""
        system, cost = usual.applied(self._system, self._directions.cost)
        return Tools(usual, system, cost, self._library.settings_for(system, cost, usual))

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
        state: Array = record["history"][record["newest"]].copy()
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
        given = None if parameters is None else np.ascontiguousarray(parameters)
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
        if time >= self._next_check:
            self._check_trace(u)
        try:
            self._y[...] = y
            self._inputs[...] = u
            if dt is None and own is None:
                self._call(*self._usual)
            else:
                self._own.fill(dt, own)
                self._call(*self._special)
            estimate = self._collect(time)
            estimate.step_time = perf_counter() - began
            if self._numbers[1] & WATCHED:
                record = self._memory[0]
                self._watch.warn(int(record["far"]), int(record["dropped"]), 3)
            return estimate
        except BaseException:  # an interrupt, or a warning as an error: the sample is not taken
            if self.time != time:
                self._library.undo(*self._undoing)
            raise

    def _check_trace(self, u: Array, before: NDArray[Any] | None = None) -> None:
        """Compare trace and functions at z(t); where they differ, the Python step takes over.

        From an earlier memory, if there is one.
        """
        record = self._memory[0]
        self._next_check = next_check(int(record["time"]), self._sizes[2])
        fault = self._traces.fault(record["z_end"], u)
        if not fault:
            return
        if before is not None:
            self._memory[...] = before
        self._system.use_functions()
        record, state = self._memory[0], self._memory[0]["z_end"].copy()
        parts = self._system, self._observer, self._given_cost, self._settings
        engine = PythonEngine(*parts, state)
        hand_over(record, self._directions, self.usual, engine)
        raise EngineChangeError(engine, fault)

    def _collect(self, time: int) -> CompiledEstimate:
        block, numbers = self._block.copy(), self._numbers.tolist()
        dropped: tuple[DroppedRow, ...] = ()
        if numbers[1] & _ROWS_DROPPED:
            sides = self._out[0]["dropped"][: numbers[0] + 1]
            dropped = self._library.layout.dropped_rows(sides, time + 1 - numbers[0])
        rejected = None
        if self._rejects:
            rejected = self._out[0]["rejected"].astype(np.bool_)
        return CompiledEstimate(
            block, numbers, time, self._sizes, dropped, self._to_disturbances, rejected,
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
            estimate.step_time = perf_counter() - began
            return estimate
        except BaseException:
            self._memory[...] = before
            raise

    def run(self, ys: Array, us: Array | None) -> Run:
        """Process a whole record without leaving C; times are means over some samples."""
        samples = len(ys)
        log, start = self._library.log((samples,)), self.state
        observer_start = self.observer_state
        dropped = self._memory["dropped"][0].copy()
        times = np.empty(samples)
        ys = np.ascontiguousarray(ys)
        us = None if us is None else np.ascontiguousarray(us)
        memory, workspace = self._memory.ctypes.data, self._workspace.ctypes.data
        before = None if self._next_check == math.inf else self._memory.copy()
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
            parts = self._system.copy(traced=True), self._observer, self._given_cost
            self._mirror = PythonEngine(*parts, self._settings, self.state)
        with np.errstate(all="ignore"):
            hand_over(record, self._directions, self.usual, self._mirror)
        return self._mirror.solved()

    def forget_warm_start(self) -> None:
        """Nothing to do: what the C step keeps between QPs is in its memory."""

    def state_dict(self) -> dict[str, Any]:
        """All information from the measurements so far, as plain arrays and numbers."""
        memory = self._memory.view(np.uint8).copy()  # as bytes: padding is copied, too
        memory.view(self._memory.dtype)["settings"] = 0  # an address means nothing elsewhere
        return {
            "problem": self._size(), "engine": self.name, "estimator": self._description(),
            "linearized": self._settings.qp_limit > 0, "memory": memory,
            "usual": self.usual.state_dict(),
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
            size, linearized = self._memory.itemsize, state["linearized"]
            memory = checked_array("memory", state["memory"], (size,), np.uint8)
            memory = memory.view(self._memory.dtype)
            if not isinstance(linearized, bool):
                raise TypeError(f"linearized is {linearized!r}")
            memory["settings"] = tools.record.ctypes.data
            with np.errstate(all="ignore"):
                self._check(memory, linearized, tools)
        self._replace(memory, tools)

    def _check(self, memory: NDArray[Any], linearized: bool, tools: Tools) -> None:
        """Refuse a window that is impossible, or whose stages the model does not reproduce."""
        record, horizon = memory[0], self._sizes[2]
        time, length, first = (int(record[name]) for name in ("time", "length", "first"))
        if not (
            0 <= first < (horizon if length == horizon else 1)
            and 0 <= length == min(horizon, time)
            and record["newest"] == time % (horizon + 1)
            and record["has_trajectory"] == (time > 0)
            and 0 <= record["far"] <= time and 0 <= record["dropped"] <= time
        ):
            raise ValueError("its window is impossible")
        trajectory, history = record["trajectory"][: length + 1], record["history"][: time + 1]
        places = (first + np.arange(length)) % horizon
        z = np.vstack((record["stages"]["z"][places], record["z_end"]))
        if not all(np.isfinite(x).all() for x in (z, trajectory, history, record["last_good"])):
            raise ValueError("a state is not finite")
        ends = np.array_equal(trajectory[-1], history[record["newest"]])
        if time and not ends and self.cost.graduation == 1.0:  # else it may be a surrogate's
            raise ValueError("history does not end where the trajectory does")
        for stage in record["stages"][places]:
            self._check_flags(stage, tools)
        smoothed = self._settings.arrival == "smoothed" and time > horizon
        if record["has_smoothed"] != smoothed or not np.isfinite(record["smoothed"]).all():
            raise ValueError("there must be a smoothed prior once the window has moved on")
        if self._system.held and not np.isfinite(record["trusted"]).all():
            raise ValueError("a trusted value is not finite")
        self._check_metric(record)
        covariances = self._covariances_of(record, places)
        computed, usual = [self._recomputed(memory)], tools.record
        self._check_rejections(record, computed[0][0][0], places)
        if record["metric_settled"] and not usual["metric_settled"]:
            # Some stages may have been computed before the metric settled.
            before = memory.copy()
            before["metric"] = usual["metric"]
            computed.append(self._recomputed(before))
        sizes, wanted = np.abs(z).max(axis=0), self._settings.qp_limit > 0
        for k, place in enumerate(places):
            stage = record["stages"][place]
            weight = tools.cost.joint_weight(stage["noise_weight"], None)
            if stage["has_own_disturbance"]:
                n = self._sizes[0]
                weight[:n, :n] = stage["own_disturbance_weight"].reshape(n, n)
            for left, (again, reached, _) in zip(
                range(len(computed))[::-1], computed, strict=True
            ):
                fresh = again[0]["stages"][place]
                try:
                    self._check_stage(stage, fresh, z[k + 1], reached[k], sizes, weight)
                    break
                except InvalidInputError:
                    if not left:
                        raise
            if covariances is not None and np.isfinite(stage["cost"]):
                self._check_covariance(covariances[k + 1], computed[0][2][k])
            if linearized == wanted and wanted:
                self._check_terms(stage, fresh, sizes, np.abs(weight))
            else:
                stage["terms"] = fresh["terms"]

    def _recomputed(self, memory: NDArray[Any]) -> tuple[NDArray[Any], Array, Array]:
        """Stages as the model computes them now, and states and covariances behind them."""
        n, _, horizon = self._sizes
        again, reached, spread = memory.copy(), np.zeros((horizon, n)), np.zeros((horizon, n, n))
        self._library.recompute(again.ctypes.data, reached.ctypes.data, spread.ctypes.data)
        return again, reached, spread

    def _check_metric(self, record: Any) -> None:
        """Refuse a metric of the observer that is none."""
        if record["metric_settled"] not in (0, 1):
            raise ValueError("the observer's metric is impossible")
        if self._system.states is not None:
            n = self._sizes[0]
            positive_definite("metric", record["metric"].reshape(n, n))

    def _check_flags(self, stage: Any, tools: Tools) -> None:
        """Refuse a stage whose sample is impossible."""
        flags = {name: int(stage[name]) for name in STAGE_FLAGS}
        observed, step, sampled = stage["is_observed"], stage["step"], stage["is_sampled"]
        if not (
            np.isin([*flags.values(), *observed, *sampled], (0, 1)).all() and sampled.any()
            and flags["is_complete"] == observed.all() and np.isfinite(stage["y"]).all()
        ):
            raise ValueError("a stage is impossible")
        if not (
            0.0 < step < np.inf and self._system.dt if flags["is_irregular"]
            else step == tools.record["sample_time"]
        ):
            raise ValueError("a step's length is impossible")
        saved: dict[str, Any] = {}
        directions = self._directions
        if flags["has_own_noise"]:
            saved["noise_weight"] = stage["own_noise_weight"]
        if flags["has_own_disturbance"]:
            saved["disturbance_weight"] = directions.weight_of_w(stage["own_disturbance_weight"])
        for letter, name in zip("wvx", SET_NAMES, strict=True):
            if flags[f"has_own_{letter}"]:
                sides, built = stage[f"own_{letter}"], self._system.set_of(name)
                if built is None:
                    raise mismatch(f"set of {name}")
                saved[name] = directions.read_sides(name, sides, built)
        self._reader.load(saved, tools.usual)

    def _check_stage(
        self, stage: Any, fresh: Any, following: Array, reached: Array, sizes: Array,
        joint: Array,
    ) -> None:
        """Compare a stage with what the model makes of it now."""
        weight = fresh["noise_weight"]
        if not near(stage["noise_weight"], weight, np.abs(weight).max()):
            raise mismatch("weight of the stages' cost")
        for letter in "wvx":
            if stage[f"has_own_{letter}"]:  # all but the sides is computed
                stage[f"own_{letter}"] = fresh[f"own_{letter}"]
        if np.isfinite(stage["cost"]) != np.isfinite(fresh["cost"]):
            raise mismatch("model")
        w, v = stage["w"], stage["v"]
        sizes = np.maximum(sizes, np.abs(fresh["w"]))
        # Residuals that cancel are rounded as their terms are.
        if not near(v, fresh["v"], np.abs(stage["y"]) + np.abs(fresh["v"])):
            raise mismatch("model (h)")
        if not near(w, fresh["w"], sizes):
            raise mismatch("observer")
        if not np.isfinite(stage["cost"]):
            return  # the observer may have been restarted behind it
        if not near(following, reached, sizes):
            raise mismatch("model (f)")
        r = np.append(w, v)
        # In the dimension of C: the user's cost may be one of fewer disturbances.
        size = quadratic_form(np.abs(r)[None], np.abs(joint))[0]
        if not near(stage["cost"], fresh["cost"], max(size, fresh["cost"])):
            raise mismatch("cost")

    def _check_rejections(self, record: Any, again: Any, places: NDArray[np.intp]) -> None:
        """Compare the counts of its sensors with those that follow from the stages."""
        if not self._library.layout.sensors:
            return
        found, expected = (
            np.vstack((one["stages"]["rejections"][places], one["rejections_end"]))
            for one in (record, again)
        )
        if (found < 0).any():
            raise ValueError("a sensor's failures are fewer than none")
        if not np.array_equal(found, expected):
            raise mismatch("observer")

    def _covariances_of(self, record: Any, places: NDArray[np.intp]) -> Array | None:
        """The observer's covariances (K + 1, n, n) along the window; None if it has none."""
        if not self._library.layout.covariance:
            return None
        found = np.concatenate((
            record["stages"]["covariance"][places], record["covariance_end"][None]
        ))
        if not (np.isfinite(found).all() and np.isfinite(record["last_good_covariance"]).all()):
            raise ValueError("a covariance is not finite")
        if self._library.layout.roots:
            ends = (record["root_end"][None], record["is_vague_end"][None])
            parts = (record["stages"][name][places] for name in ("root", "is_vague"))
            roots, vague = (np.concatenate(pair) for pair in zip(parts, ends, strict=True))
            if not (np.isin(vague, (0, 1)).all() and np.isfinite(roots[vague > 0]).all()):
                raise ValueError("a root of a covariance is impossible")
            for root, covariance in zip(roots[vague > 0], found[vague > 0], strict=True):
                check_root(root, covariance)
        return found

    def _check_covariance(self, following: Array, reached: Array) -> None:
        """Compare the observer's covariance behind a stage with what follows from the stage."""
        deviations = np.sqrt(np.abs(reached.diagonal()))
        if not near(following, reached, np.outer(deviations, deviations)):
            raise mismatch("observer")

    def _check_terms(self, stage: Any, fresh: Any, sizes: Array, weight: Array) -> None:
        """Compare Jacobians and terms with what the model makes of them now."""
        n, found, expected = self._sizes[0], stage["terms"], fresh["terms"]
        for name in ("f_jacobian", "h_jacobian"):
            if not near(found[name], expected[name], np.abs(expected[name]).max(1, keepdims=True)):
                raise mismatch("model (its Jacobians)")
        sizes = np.append(np.maximum(sizes, np.abs(stage["w"])), np.abs(stage["y"]))
        sizes[n:] += np.abs(stage["v"])
        if self._library.layout.loss:
            scale = np.append(expected["disturbance_scale"], expected["noise_scale"])
            weight = weight * scale[:, None]
        slopes = np.abs(np.vstack((expected["f_jacobian"], expected["h_jacobian"])))
        bounds = {
            "hessian": slopes.T @ weight @ slopes, "coupling": slopes.T @ weight[:, :n],
            "own": slopes.T @ weight @ sizes, "following": weight[:n] @ sizes,
        }
        for name, bound in bounds.items():
            if name in (found.dtype.names or ()) and not near(found[name], expected[name], bound):
                raise mismatch("weight of the stages' cost")
