"""The compiled engine: the generated C step, loaded into this process."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import check_problem, positive_definite
from ..costs import Cost
from ..errors import InvalidInputError
from ..estimation.covariance import window_covariances
from ..estimation.estimate import Estimate
from ..estimation.run import Run
from ..estimation.settings import Settings
from ..estimation.snapshot import (
    SET_NAMES,
    check_description,
    checked_array,
    described,
    mismatch,
    near,
    reading,
)
from ..model.system import System
from ..observers import Observer
from .estimate import CompiledEstimate
from .library import EstimatorLibrary

__all__ = ["CompiledEngine", "RunLog"]

Array = NDArray[np.float64]

# So that a long record can be interrupted, and its times are means of pieces.
_PIECE = 256


class RunLog:
    """Arrays for what `mhe_run` writes, and the structure that points to them."""

    def __init__(self, shape: tuple[int, ...], n: int) -> None:
        self.states, self.filtered, self.delayed = (np.empty((*shape, n)) for _ in range(3))
        self.costs, self.candidate_costs = np.empty(shape), np.empty(shape)
        self.flags, self.qps, self.iterations = (np.empty(shape, np.int32) for _ in range(3))

    def pointers(self, first: int) -> Any:
        """The C structure of pointers to the entries from an index on."""
        arrays = (
            self.states, self.filtered, self.delayed, self.costs, self.candidate_costs,
            self.flags, self.qps, self.iterations,
        )
        addresses = [array.ctypes.data + first * array.strides[0] for array in arrays]
        return (ctypes.c_void_p * len(addresses))(*addresses)


class CompiledEngine:
    """The loop body in C; in all else as `PythonEngine`."""

    name = "compiled"

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings,
        initial_state: Array,
    ) -> None:
        self._library = library = EstimatorLibrary(system, observer, cost, settings)
        self._system, self._cost, self._settings = system, cost, settings
        n, p, m, horizon = system.n, system.p, system.m, settings.horizon
        self._sizes, self._delay = (n, p, horizon), settings.delay
        self._workspace = library.workspace()
        self._memory = library.estimators(initial_state[None])
        self._y, self._u = np.zeros(p), np.zeros(max(m, 1))
        self._inputs = self._u[:m]
        self._out = np.zeros(1, library.estimate_type)
        reals = library.estimate_type.fields["time"][1] // 8  # type: ignore[index]
        self._block = self._out.view(np.float64)[:reals]
        self._numbers = self._out.view(np.int32)[2 * reals + 2 : 2 * reals + 8]
        self._before = np.empty_like(self._memory)  # before the last step
        memory, before, workspace, late, inputs, out = (
            ctypes.c_void_p(array.ctypes.data)
            for array in (
                self._memory, self._before, self._workspace, self._y, self._u, self._out
            )
        )
        self._arguments = memory, before, workspace, late, inputs
        self._usual, self._result = (*self._arguments, ctypes.c_double(0.0), None, out), out
        self._amending = memory, workspace
        self._call = library.update
        self._observer = observer
        sets = system.disturbances
        self._noise_free = sets.fixed_components if sets else np.empty(0, np.intp)
        self._time = self._memory["time"]

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""
        self._replace(self._library.estimators(initial_state[None]))

    def _replace(self, memory: NDArray[Any]) -> None:
        """Remember this in place of all that was; whole or, if interrupted, not at all."""
        before = self._memory.copy()
        try:
            self._memory[...] = memory
        except BaseException:
            self._memory[...] = before
            raise

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
    def length(self) -> int:
        """Number of samples in the window."""
        return int(self._memory[0]["length"])

    def step(
        self, y: Array, u: Array, dt: float | None, noise_weight: Array | None, began: float
    ) -> Estimate:
        """Take a sample in, and estimate."""
        time = self._time.item()
        try:
            self._y[...] = y
            self._inputs[...] = u
            if dt is None and noise_weight is None:
                self._call(*self._usual)
            else:
                weight = None if noise_weight is None else np.ascontiguousarray(noise_weight)
                self._call(
                    *self._arguments, ctypes.c_double(dt or 0.0),
                    None if weight is None else ctypes.c_void_p(weight.ctypes.data), self._result,
                )
            estimate = self._collect(time)
            estimate.step_time = perf_counter() - began
            return estimate
        except BaseException:  # an interrupt: the sample is not taken
            if self.time != time:
                self._memory[...] = self._before
            raise

    def _collect(self, time: int) -> CompiledEstimate:
        return CompiledEstimate(
            self._block.copy(), self._numbers.tolist(), time, self._sizes, self._delay
        )

    def amend(self, time: int, y: Array) -> Estimate:
        """Put a late measurement in its place, and estimate again."""
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
        """Take a whole record in without leaving C; times are means over some samples."""
        samples, n = len(ys), self._sizes[0]
        log, start = RunLog((samples,), n), self.state
        times = np.empty(samples)
        ys = np.ascontiguousarray(ys)
        us = None if us is None else np.ascontiguousarray(us)
        memory, workspace = self._memory.ctypes.data, self._workspace.ctypes.data
        for first in range(0, samples, _PIECE):
            count = min(_PIECE, samples - first)
            began = perf_counter()
            self._library.run(
                memory, 1, workspace, count, ys[first:].ctypes.data,
                None if us is None else us[first:].ctypes.data, log.pointers(first),
            )
            times[first : first + count] = (perf_counter() - began) / count
        return Run(
            states=np.vstack((start, log.states)), filtered=log.filtered, costs=log.costs,
            candidate_costs=log.candidate_costs, times=times,
            solve_times=np.full(samples, np.nan), qps=log.qps.astype(np.intp),
            solver_iterations=log.iterations.astype(np.intp), delayed=log.delayed,
            flags=log.flags,
        )

    def covariances(self) -> Array:
        """Covariances along the last estimate."""
        record = self._memory[0]
        if not record["has_trajectory"]:
            raise InvalidInputError("there is no estimate yet; update first.")
        length = self.length
        stages = record["stages"][(record["first"] + np.arange(length)) % self._sizes[2]]
        system, cost, count = self._system, self._cost, length
        irregular = bool(stages["is_irregular"].any())
        inputs = stages["u"][:, : system.m]
        weights = np.zeros((count, system.n + system.p, system.n + system.p))
        weights[:, : system.n, : system.n] = cost.disturbance
        weights[:, system.n :, system.n :] = stages["noise_weight"]
        factors = cost.discount ** np.append(count, np.arange(count - 1, -1, -1.0))
        with np.errstate(all="ignore"):
            return window_covariances(
                system.timed if irregular else system,
                record["trajectory"][: length + 1].copy(),
                np.column_stack((inputs, stages["step"])) if irregular else inputs,
                weights * factors[1:, None, None],
                np.asarray(cost.prior) * factors[0],
                self._noise_free,
            )

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt from measurements so far, as plain arrays and numbers."""
        memory = self._memory.view(np.uint8).copy()  # as bytes: padding is copied, too
        memory.view(self._memory.dtype)["settings"] = 0  # an address means nothing elsewhere
        return {
            "problem": self._size(), "engine": "compiled", "estimator": self._description(),
            "linearized": self._settings.qp_limit > 0, "memory": memory,
        }

    def _description(self) -> dict[str, Any]:
        return described(self._system, self._observer, self._cost, self._settings)

    def _size(self) -> tuple[int, ...]:
        system = self._system
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another estimator stopped."""
        check_problem(state, self._size())
        if str(state.get("engine")) != "compiled":
            raise InvalidInputError(
                "the state is of an estimator with another engine; expected 'compiled'."
            )
        with reading():
            check_description(state["estimator"], self._description())
            size, linearized = self._memory.itemsize, state["linearized"]
            memory = checked_array("memory", state["memory"], (size,), np.uint8)
            memory = memory.view(self._memory.dtype)
            if not isinstance(linearized, bool):
                raise TypeError(f"linearized is {linearized!r}")
            with np.errstate(all="ignore"):
                self._check(memory[0], linearized)
        memory["settings"] = self._library.settings.ctypes.data
        self._replace(memory)

    def _check(self, record: Any, linearized: bool) -> None:
        """Refuse a window that is impossible, or whose stages the model does not reproduce."""
        horizon, system, settings = self._sizes[2], self._system, self._library.settings
        time, length = int(record["time"]), int(record["length"])
        sets = sum(1 << k for k, name in enumerate(SET_NAMES) if getattr(system, name))
        if not (
            0 <= record["first"] < (horizon if length == horizon else 1)
            and 0 <= length == min(horizon, time)
            and record["newest"] == time % (horizon + 1)
            and record["has_trajectory"] == (time > 0)
            and record["dropped"] & ~sets == 0
        ):
            raise ValueError("its window is impossible")
        places = (int(record["first"]) + np.arange(length)) % horizon
        stages = record["stages"]
        z = np.vstack((stages["z"][places], record["z_end"]))
        trajectory, history = record["trajectory"][: length + 1], record["history"][: time + 1]
        if not all(np.isfinite(x).all() for x in (z, trajectory, history, record["last_good"])):
            raise ValueError("a state is not finite")
        if time and not np.array_equal(trajectory[-1], history[record["newest"]]):
            raise ValueError("history does not end where the trajectory does")
        sizes, wanted = np.abs(z).max(axis=0), self._settings.qp_limit > 0
        for k, place in enumerate(places):
            stage = stages[place]
            if not stage["is_irregular"] and stage["step"] != settings["sample_time"]:
                raise ValueError("a step's length is impossible")
            self._check_weight(stage)
            a, c = self._check_stage(stage, z[k + 1], sizes)
            terms = _terms(self._cost, stage, a, c)
            if linearized == wanted:
                if wanted:
                    self._check_terms(stage, terms, sizes)
            else:
                for name, value in terms.items():
                    stage["terms"][name] = value

    def _check_weight(self, stage: Any) -> None:
        flags = [int(stage[name]) for name in ("has_own_noise", "is_irregular", "is_complete")]
        observed = stage["is_observed"]
        if not (
            np.isin([*flags, *observed], (0, 1)).all() and flags[2] == observed.all()
            and np.isfinite(stage["y"]).all() and stage["cost"] >= 0.0
        ):
            raise ValueError("a stage is impossible")
        if flags[1] and not (0.0 < stage["step"] < np.inf and self._system.dt):
            raise ValueError("a step's length is impossible")
        p, weight = self._sizes[1], self._cost.noise
        if flags[0]:
            weight = positive_definite("noise_weight", stage["own_noise_weight"].reshape(p, p))
        if not flags[2]:
            weight = self._cost.partial_weight(observed != 0, weight)[-p:, -p:]
        if not near(stage["noise_weight"].reshape(p, p), weight, np.abs(weight).max()):
            raise mismatch("weight of the stages' cost")

    def _check_stage(self, stage: Any, following: Array, sizes: Array) -> tuple[Array, Array]:
        """Compare a stage with what the model makes of it; its Jacobians."""
        n, p, _ = self._sizes
        m, system = self._system.m, self._system
        x, u, seen = stage["z"], stage["u"][:m], stage["is_observed"] != 0
        if stage["is_irregular"]:
            system, u = system.timed, np.append(u, stage["step"])
        values = [np.full(size, np.nan) for size in (n, p, (n, n), (p, n))]
        functions: tuple[Callable[..., Any], ...] = (
            system.f, system.h, system.f_jacobian, system.h_jacobian
        )
        for value, function in zip(values, functions, strict=True):
            with suppress(Exception):  # outside of the model's domain: NaN, as in C
                value[...] = function(x, u)
        ahead, output, a, c = values
        error = np.where(seen, stage["y"] - output, 0.0)
        correction = self._library.settings["gain"].reshape(n, p).dot(error)
        reached, weights = ahead + correction, (self._cost.disturbance, stage["noise_weight"])
        weights = weights[0], weights[1].reshape(p, p)
        cost = sum(r.dot(w).dot(r) for r, w in zip((correction, error), weights, strict=True))
        size = sum(
            np.abs(r).dot(np.abs(w)).dot(np.abs(r))
            for r, w in zip((correction, error), weights, strict=True)
        )
        held = not np.isfinite(stage["cost"])
        if held != (not np.isfinite([reached.dot(reached), cost]).all()):
            raise mismatch("model")
        if held:
            if stage["w"].any() or stage["v"].any():
                raise ValueError("a failed stage has residuals")
            return np.eye(n), np.zeros((p, n))
        # Residuals that cancel are rounded as their terms are.
        error_size = np.abs(stage["y"]) + np.abs(error)
        sizes = np.maximum(sizes, np.abs(correction))
        if not near(stage["v"], error, error_size):
            raise mismatch("model (h)")
        if not near(stage["w"], correction, sizes):
            raise mismatch("observer")
        if not near(following, reached, sizes):
            raise mismatch("model (f)")
        w, v = stage["w"], stage["v"]
        kept = w.dot(weights[0]).dot(w) + v.dot(weights[1]).dot(v)
        if not near(stage["cost"], kept, size):
            raise mismatch("cost")
        finite = np.isfinite(a).all() and np.isfinite(c).all()
        return (a, c) if finite else (np.eye(n), np.zeros((p, n)))

    def _check_terms(self, stage: Any, terms: dict[str, Array], sizes: Array) -> None:
        found = stage["terms"]
        for name in ("f_jacobian", "h_jacobian"):
            steepest = np.abs(terms[name]).max(axis=1, keepdims=True)
            if not near(found[name].reshape(terms[name].shape), terms[name], steepest):
                raise mismatch("model (its Jacobians)")
        a, c = (found[name].reshape(terms[name].shape) for name in ("f_jacobian", "h_jacobian"))
        exact = _terms(self._cost, stage, a, c)
        bound = _terms(self._cost, stage, a, c, np.abs)
        for name in ("hessian", "coupling", "own", "following"):
            if not near(found[name], exact[name], np.abs(bound[name])):
                raise mismatch("weight of the stages' cost")


def _terms(
    cost: Cost, stage: Any, a: Array, c: Array, turned: Callable[[Array], Array] = np.asarray
) -> dict[str, Array]:
    """Jacobians and terms of a stage as C keeps them (`mhe_terms`), or bounds on them."""
    p, n = c.shape
    q, r = turned(cost.disturbance), turned(stage["noise_weight"].reshape(p, p))
    w, v, aa, cc = (turned(one) for one in (stage["w"], stage["v"], a, c))
    hessian = aa.T @ q @ aa + cc.T @ r @ cc
    # C fills a row from the register on that its diagonal is in.
    hessian[np.arange(n)[None] < (np.arange(n) & ~3)[:, None]] = 0.0
    return {
        "f_jacobian": a, "h_jacobian": c, "hessian": hessian, "coupling": -(aa.T @ q),
        "own": -(aa.T @ q @ w + cc.T @ r @ v), "following": q @ w,
    }

