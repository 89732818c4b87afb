"""The compiled engine: the generated C step, loaded into this process."""

from __future__ import annotations

import ctypes
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._checks import check_problem
from .codegen.library import EstimatorLibrary
from .compiled_estimate import CompiledEstimate, dropped_names
from .costs import Cost
from .covariance import window_covariances
from .errors import InvalidInputError
from .estimate import Estimate
from .observers import Observer
from .problem import Problem
from .run import Run
from .settings import Settings
from .system import System

__all__ = ["CompiledEngine", "RunLog"]

Array = NDArray[np.float64]

# So that a long record can be interrupted, and its times are means of pieces.
_PIECE = 256


class RunLog:
    """Arrays for what `mhe_run` writes, and the structure that points to them.

    Parameters
    ----------
    shape : tuple of int
        Leading dimensions: (samples,), or (members, samples).
    n : int
        Number of states.
    """

    def __init__(self, shape: tuple[int, ...], n: int) -> None:
        self.states, self.filtered, self.delayed = (np.empty((*shape, n)) for _ in range(3))
        self.costs, self.candidate_costs = np.empty(shape), np.empty(shape)
        self.flags, self.qps, self.iterations = (np.empty(shape, np.int32) for _ in range(3))

    def pointers(self, first: int) -> Any:
        """The C structure of pointers to the entries from an index on.

        Parameters
        ----------
        first : int
            Index along the first dimension.
        """
        arrays = (
            self.states, self.filtered, self.delayed, self.costs, self.candidate_costs,
            self.flags, self.qps, self.iterations,
        )
        addresses = [array.ctypes.data + first * array.strides[0] for array in arrays]
        return (ctypes.c_void_p * len(addresses))(*addresses)


class CompiledEngine:
    """The loop body in C; in all else as `PythonEngine`.

    Parameters
    ----------
    system, observer, cost, settings, initial_state
        The estimator's.

    Raises
    ------
    OptionError
        If something has no C form.
    CompilationError
        If there is no compiler, or it fails.
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        settings: Settings,
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
        self._arguments = [
            ctypes.c_void_p(array.ctypes.data)
            for array in (self._memory, self._workspace, self._y, self._u, self._out)
        ]
        self._call = library.update
        self._problem = Problem(system, cost)
        self.reset(initial_state)

    def reset(self, initial_state: Array) -> None:
        """Forget all measurements and start at this state."""
        start = np.ascontiguousarray(initial_state)
        self._library.reset(
            self._memory.ctypes.data, self._library.settings.ctypes.data, start.ctypes.data
        )
        self.time = 0

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
        self._y[...] = y
        self._inputs[...] = u
        if dt is None and noise_weight is None:
            self._call(*self._arguments)
        else:
            weight = None if noise_weight is None else np.ascontiguousarray(noise_weight)
            self._library.update_special(
                *self._arguments[:4], dt or 0.0,
                None if weight is None else weight.ctypes.data, self._arguments[4],
            )
        estimate = self._collect(self.time)
        self.time += 1
        estimate.step_time = perf_counter() - began
        return estimate

    def _collect(self, time: int) -> CompiledEstimate:
        return CompiledEstimate(
            self._block.copy(), self._numbers.tolist(), time, self._sizes, self._delay
        )

    def amend(self, time: int, y: Array) -> Estimate:
        """Put a late measurement in its place, and estimate again."""
        began = perf_counter()
        self._y[...] = y
        memory, workspace, late, _, out = self._arguments
        self._library.amend(memory, workspace, time, late, out)
        estimate = self._collect(self.time - 1)
        estimate.step_time = perf_counter() - began
        return estimate

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
            self.time += count
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
        with np.errstate(all="ignore"):
            _bind(self._problem, self._system, self._cost, stages)
            self._problem.leave_out(dropped_names(int(record["dropped"])))
            return window_covariances(self._problem, record["trajectory"][: length + 1].copy())

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt from measurements so far, as plain arrays and numbers."""
        memory = self._memory.view(np.uint8).copy()  # as bytes: padding is copied, too
        memory.view(self._memory.dtype)["settings"] = 0  # an address means nothing elsewhere
        return {"problem": self._size(), "engine": "compiled", "memory": memory}

    def _size(self) -> tuple[int, ...]:
        system = self._system
        return system.n, system.p, system.m, self._settings.horizon

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another estimator stopped."""
        check_problem(state, self._size())
        if state.get("engine") != "compiled":
            raise InvalidInputError(
                "the state is of an estimator with another engine; expected 'compiled'."
            )
        try:
            given = np.asarray(state["memory"])
            if given.dtype != np.uint8 or given.ndim != 1:
                raise TypeError(f"its memory is of type {given.dtype} and shape {given.shape}")
            memory = given.copy().view(self._memory.dtype)
            record = memory[0]
            horizon = self._sizes[2]
            sound = (
                0 <= record["first"] < horizon
                and 0 <= record["length"] <= min(horizon, record["time"])
                and 0 <= record["newest"] <= horizon
            )
        except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
            raise InvalidInputError(
                f"the state is damaged ({type(error).__name__}: {error}); expected what "
                "state_dict gave, unchanged."
            ) from error
        if not sound or memory.size != 1:
            raise InvalidInputError(
                "the state is damaged: its window is impossible; expected what state_dict "
                "gave, unchanged."
            )
        memory["settings"] = self._library.settings.ctypes.data
        self._memory[...] = memory
        self.time = int(record["time"])


def _bind(problem: Problem, system: System, cost: Cost, stages: NDArray[Any]) -> None:
    """Bind a problem to the stages of a C window."""
    count, m = len(stages), system.m
    irregular = bool(stages["is_irregular"].any())
    problem.model = system.timed if irregular else system
    inputs = stages["u"][:, :m]
    problem.inputs = np.column_stack((inputs, stages["step"])) if irregular else inputs
    problem.prior, problem.measurements = stages["z"][0].copy(), stages["y"]
    weights = np.zeros((count, system.n + system.p, system.n + system.p))
    weights[:, : system.n, : system.n] = cost.disturbance
    weights[:, system.n :, system.n :] = stages["noise_weight"]
    problem.stage_weights = weights
    problem.observed = stages["is_observed"] != 0
    if cost.discount < 1.0:
        problem.discounts = cost.discount ** np.append(count, np.arange(count - 1, -1, -1.0))
    problem.use_sets(system.states, system.disturbances, system.noises)
