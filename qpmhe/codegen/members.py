"""Many estimators in compiled code, spread over threads."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..estimation.conditions import usual_conditions
from ..estimation.engine import PythonEngine
from ..estimation.engines import ModelChangedError
from ..estimation.settings import Settings
from ..estimation.start import with_scaled_constraints
from ..model.captured import Due
from ..model.system import System
from ..observers import Observer
from .estimate import WATCHED, CompiledWatch
from .exchange import hand_over
from .rehearsal import checked_library
from .watched import WatchedFunctions

Array = NDArray[np.float64]

# Fewer members than this are not worth waking a thread for.
_LEAST = 16
# Members at whose states a model is compared with its trace.
_COMPARED = 4


class CompiledMembers:
    """The generated C step for each member of a batch."""

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings, states: Array,
        threads: int | None,
    ) -> None:
        # The units of nonlinear constraints depend on where a member starts.
        system = with_scaled_constraints(system, observer, cost, states[0])
        each = [system]
        if system.constraints is not None:
            each += [
                with_scaled_constraints(system, observer, cost, state) for state in states[1:]
            ]
        self._library = library = checked_library(system, observer, cost, settings)
        usual = usual_conditions(settings)
        self._records = [library.settings, *(
            library.settings_for(one, library.directions.cost, usual) for one in each[1:]
        )]
        self._traces = WatchedFunctions(system, observer, cost, settings.time_budget is None)
        self._settings = settings
        self._m, self._horizon = system.m, settings.horizon
        self._watch = CompiledWatch(settings.horizon)
        count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        wanted = min(threads or count or 1, max(1, len(states) // _LEAST))
        ends = np.linspace(0, len(states), wanted + 1).astype(int).tolist()
        self._parts = [slice(a, b) for a, b in pairwise(ends)]
        self._workspaces = [library.workspace() for _ in self._parts]
        self._pool = ThreadPoolExecutor(wanted) if wanted > 1 else None
        self.reset(states)

    def reset(self, states: Array) -> None:
        """Forget all samples and start at these states."""
        self._memory = self._library.estimators(states)
        self._memory["settings"] = self._addresses
        self._traces.times.restart()

    @property
    def _addresses(self) -> list[int]:
        return [record.ctypes.data for record in self._records]

    @property
    def time(self) -> int:
        """Number of samples taken so far."""
        return int(self._memory["time"][0])

    def state_dict(self) -> dict[str, Any]:
        """All information from the measurements so far."""
        memory = self._memory.view(np.uint8).copy()  # as bytes: padding is copied, too
        memory.view(self._memory.dtype)["settings"] = 0  # an address means nothing elsewhere
        return {"memory": memory}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where an engine with the same arguments stopped."""
        self._memory = state["memory"].copy().view(self._memory.dtype)
        self._memory["settings"] = self._addresses

    def hand_over(self, engines: Sequence[PythonEngine]) -> None:
        """Let new Python engines, one for each member, continue where these members stand."""
        usual, library = usual_conditions(self._settings), self._library
        for record, engine in zip(self._memory, engines, strict=True):
            hand_over(record, library.layout, library.directions, usual, engine, True)

    def _check_trace(self, u: Array) -> None:
        """Compare traces and functions at z(t) of some members; raise where they differ."""
        times, count = self._traces.times, len(self._memory)
        due = times.due(self.time)
        if due is Due.NOWHERE:
            return
        members = np.linspace(0, count - 1, min(count, _COMPARED)).astype(int)
        fault = self._traces.fault(due, ((self._memory["z_end"][k], u[k]) for k in members))
        if fault:
            raise ModelChangedError(fault)
        times.compared(self.time)

    @property
    def states(self) -> Array:
        """The current estimates (K, n)."""
        states: Array = self._memory["history_end"].copy()
        return states

    @property
    def observer_states(self) -> Array:
        """The states (K, n) from which the observers continue."""
        states: Array = self._memory["z_end"].copy()
        return states

    def step(self, y: Array, u: Array) -> dict[str, Any]:
        """Take in a sample of each member, and estimate."""
        ys, us = np.ascontiguousarray(y), np.ascontiguousarray(u)
        if self._memory["time"][0] >= self._traces.times.next:
            self._check_trace(us)
        found = np.empty(len(ys), self._library.estimate_type)

        def work(part: slice, workspace: NDArray[np.uint8]) -> None:
            self._library.update_members(
                self._memory[part].ctypes.data, part.stop - part.start, workspace.ctypes.data,
                ys[part].ctypes.data, us[part].ctypes.data, found[part].ctypes.data,
            )

        self._share(work)
        if (found["status"] & WATCHED).any():
            far, dropped = self._memory["watched"].max(axis=0).tolist()
            self._watch.warn(far, dropped, 4)
        states = slice(0, int(found["length"][0]) + 1)
        return {
            "time": self.time - 1, "filtered": found["filtered"],
            "observer_states": found["observer_state"],
            "trajectories": found["trajectory"][:, states], "costs": found["cost"],
            "candidates": found["candidate"][:, states],
            "candidate_costs": found["candidate_cost"],
            "flags": found["status"].astype(np.int64), "qps": found["qps"].astype(np.intp),
            "rejected_sensors": self._rejecting(
                found["rejected"] if self._library.layout.sensors else np.zeros((len(ys), 0))
            ),
        }

    def run(self, y: Array, u: Array) -> dict[str, Any]:
        """Process records (K, T, p) and (K, T, m) without leaving C."""
        ys, us, start = np.ascontiguousarray(y), np.ascontiguousarray(u), self.states
        observers = self.observer_states
        samples, dropped = ys.shape[1], self._memory["watched"][:, 1].copy()
        before = None if self._traces.times.next == math.inf or not samples else self._memory.copy()
        log = self._library.log(ys.shape[:2])

        def work(part: slice, workspace: NDArray[np.uint8]) -> None:
            self._library.run(
                self._memory[part].ctypes.data, part.stop - part.start, workspace.ctypes.data,
                samples, ys[part].ctypes.data, us[part].ctypes.data if self._m else None,
                log.pointers(part.start),
            )

        if before is not None:
            self._check_trace(us[:, 0])
        self._share(work)
        if before is not None:
            try:
                self._check_trace(us[:, -1])
            except ModelChangedError:
                self._memory[...] = before
                raise
        self._watch.warn(*log.watched(self._horizon, dropped), 3)
        return {
            "states": np.concatenate((start[:, None], log.states), axis=1),
            "filtered": log.filtered,
            "observer_states": np.concatenate((observers[:, None], log.observer_states), axis=1),
            "costs": log.costs, "candidate_costs": log.candidate_costs,
            "statuses": log.flags.astype(np.int64), "qps": log.qps.astype(np.intp),
            "rejected_sensors": self._rejecting(log.rejected),
        }

    def _rejecting(self, rejected: NDArray[Any]) -> NDArray[np.bool_]:
        """Which sensors of a gate were rejected; none without a gate."""
        found = rejected.astype(np.bool_)
        return found if self._library.observer.rejects else found[..., :0]

    def _share(self, work: Callable[[slice, NDArray[np.uint8]], None]) -> None:
        """Do the work on all members, a part a thread; C runs without the interpreter's lock."""
        pending = set(range(len(self._parts)))
        done = [Event() for _ in pending]

        def do(k: int) -> None:
            try:
                pending.remove(k)
            except KeyError:  # somebody else has begun it
                return
            try:
                work(self._parts[k], self._workspaces[k])
            finally:
                done[k].set()

        try:
            if self._pool is None:
                work(self._parts[0], self._workspaces[0])
            else:
                list(self._pool.map(do, range(len(self._parts))))
        except BaseException:
            if self._pool is not None:
                for k, one in enumerate(done):
                    do(k)
                    one.wait()
            raise
