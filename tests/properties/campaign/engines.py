"""The Python step beside the step in C: each step of both begins at the same memory.

A difference is explained, in this order: by the tolerance of the sequence, where both have
converged and J is the same up to it; by a fall, where J is 1e-11 of the candidate's, or the
estimates differ by so much of the step from it; by lost digits, where the candidate is 1e12 of its
units away, so that numbers keep less than four digits of a unit; by a flat J, where the J of two
trajectories agree to 11 digits; by rounding, where an engine differs as much from itself when its
memory and its data change in their last digits; by the tolerance of QPs, where one step follows
the other once it solves them to 1e-12; by the rounding of the Hessian, where the Python step
differs as much from itself when the QPs change in their last digits; by a cap or by a QP that a
method has not solved, mostly since it has no feasible point; by the tolerance of QPs with active
rows, where J is the same up to 1e-6. What is left is a fault.
`docs/how-to/speed.md` lists these reasons.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from qpmhe import QpmheError, Status
from qpmhe.codegen.exchange import hand_over, record_of
from qpmhe_solvers import RawSolution, Solver, SolveStatus, create
from qpmhe_solvers.options import SolverOptions

from .judge import nudged

CLOSE = 1e-6  # of two estimates in units, and of their J as a share
CONVERGED = 1e-9  # the default of `tolerance`
FALL = 1e-11
LOST = 1e12
STOPPED = Status.SOLVER_STOPPED
# Fields of the memory in C that are no data.
_KEPT = ("metric", "damping", "u")
# Differences of a kind that are explained, of each estimator: all without an active row.
_MEASURED = {"quiet": np.inf, "active": 8}
_TRIES = 6
_TIGHT = (
    {"solver_tolerance": 1e-12}, {"backend": "daqp", "solver_tolerance": 1e-12},
    {"backend": "quadprog"}, {"backend": "piqp", "solver_tolerance": 1e-12},
)


class Difference(NamedTuple):
    """How two estimates of the same window differ, and why."""

    kind: str  # candidate, status, estimate or memory
    rows: str  # "active" or "quiet"
    reason: str
    better: str  # the engine with the lower J, "neither"
    detail: Any

    def __str__(self):
        return f"{self.kind} ({self.rows}): {self.reason}, {self.better} better"


class Nudging(Solver):
    """Solves QPs whose numbers it has changed in their last digits."""

    def __init__(self):
        super().__init__(SolverOptions())
        self.unsolved = False
        self.r, self.inner = np.random.default_rng(4), create(
            "auto", SolverOptions(absolute_tolerance=1e-12)
        )

    def _solve(self, qp, start):
        other = qp.copy()
        for part in (other.band, other.gradient):
            part[...] = nudged(self.r, part)
        found = self.inner.solve(other)
        solved = found.status is SolveStatus.SOLVED
        self.unsolved |= not solved  # also one of a correction, which no status tells
        return RawSolution(found.d, solved, found.iterations, found.bound_duals, found.row_duals)


def _same(numbers):
    return numbers


def _nudge(r, record):
    """Change the numbers of a record of the step in C in their last digits."""
    for name in record.dtype.names:
        part = record[name]
        if part.dtype.names is not None:
            _nudge(r, part)
        elif part.dtype == np.float64 and name not in _KEPT:
            part[...] = nudged(r, part)


class Beside:
    """A Python estimator that repeats each step of a compiled one."""

    def __init__(self, case, compiled):
        self.case, self.compiled = case, compiled
        self.python, self.exact, self.explained = case.estimator("python"), None, Counter()
        self.nudging = self.memory = self.tools = self.far = None

    def begin(self, compiled):
        """The next step of both begins here."""
        self.compiled = compiled
        self.memory, self.tools = compiled._engine._memory.copy(), compiled._engine._tools
        self._hand_over(self.python)

    def _begin_again(self, *pythons):
        """The step is to be done again, also one that has changed the usual conditions."""
        engine = self.compiled._engine
        engine._memory[...], engine._tools = self.memory, self.tools
        for python in pythons:
            self._hand_over(python)

    def _hand_over(self, python):
        engine = self.compiled._engine
        library = engine._library
        hand_over(
            engine._memory[0], library.layout, library.directions, engine.usual, python._engine,
            False,
        )

    def compare(self, estimate, act):
        """The Python step's estimate, and a `Difference` or None.

        ``act(mhe, change)`` does what the compiled estimator has done, with changed numbers.
        """
        other = act(self.python, _same)
        x, J = self._apart(other, estimate)
        units = self.case.x_units
        size = units * (1.0 + np.abs(other.candidate / units).max())
        candidate = np.abs((other.candidate - estimate.candidate) / size).max()
        same = (other.status & ~STOPPED) == (estimate.status & ~STOPPED)
        if candidate > 1e-9:
            kind = "candidate"
        elif x > CLOSE and J > CLOSE:
            kind = "estimate"
        elif not same:
            kind = "status"
        elif (kept := self._far_from(self._kept(), self.python._engine._window)) > CLOSE:
            kind, x = "memory", kept
        else:
            return other, None
        quiet = not (estimate.solver_iterations or other.solver_iterations
                     or estimate.dropped or other.dropped)
        rows = "quiet" if quiet else "active"
        better = "neither"
        if J > 1e-9:
            better = "compiled" if estimate.cost < other.cost else "python"
        self.explained[kind, rows] += 1
        reason = "not examined"
        if self.explained[kind, rows] <= _MEASURED[rows]:
            reason = self._reason(estimate, other, kind, x, J, act, not quiet)
        detail = (
            f"x {x:.1e}, J {J:.1e}, candidate {candidate:.1e}, by rounding {self.far}",
            estimate.cost, other.cost, estimate.candidate_cost, str(estimate.status),
            str(other.status),
        )
        return other, Difference(kind, rows, reason, better, detail)

    def _kept(self):
        """What the compiled estimator has kept of the step."""
        engine = self.compiled._engine
        library = engine._library
        return record_of(engine._memory[0], library.layout, library.directions)

    def _far_from(self, one, other):
        """By how much what was kept of a step differs, in units."""
        units = self.case.x_units
        if (one.trajectory is None) != (other.trajectory is None):
            return np.inf
        pairs = [(one.z[one.end], other.z[other.end])]
        if one.trajectory is not None:
            pairs.append((one.trajectory, other.trajectory))
        return max(
            float(np.abs((a - b) / (units * (1.0 + np.abs(b / units).max()))).max())
            for a, b in pairs
        )

    def _apart(self, one, other):
        units = self.case.x_units
        size = units * (1.0 + np.abs(one.trajectory / units).max())
        with np.errstate(all="ignore"):
            x = float(np.abs((one.trajectory - other.trajectory) / size).max())
        if one.cost == other.cost:  # also infinite ones
            return x, 0.0
        return x, abs(one.cost - other.cost) / (abs(one.cost) + 1e-300)

    def _reason(self, estimate, other, kind, x, J, act, is_active):
        if Status.CONVERGED in estimate.status & other.status and J <= CONVERGED:
            return "tolerance of the sequence"
        if kind != "candidate" and self._is_fall(estimate, other):
            return "a fall of 12 digits"
        if np.abs(estimate.candidate / self.case.x_units).max() > LOST:
            return "lost digits"
        # What was kept differs where J is the same up to `CLOSE`: see `compare`.
        same = kind == "memory" and self._observers_agree()
        if same and J <= FALL:
            return "flat J"
        engine = self.compiled._engine
        after, tools = engine._memory.copy(), engine._tools
        kept = self._kept() if kind == "memory" else None
        try:
            if self._is_rounding(estimate, other, kind, x, J, act):
                return "rounding"
            if self._is_tolerance(estimate, x, act, kept) or self._is_tolerance_in_c(kind, x, act):
                return "tolerance of QPs"
            if self._is_hessian(x, act):
                return "rounding of the Hessian"
        finally:
            engine._memory[...], engine._tools = after, tools
        solver = self.nudging.settings.backend
        if "max_solver_iterations" in self.case.options:
            return "cap"
        if solver.unsolved or STOPPED & (estimate.status | other.status):
            return "unsolved QP"
        # QPs with active rows are solved to a tolerance, and J of their solutions is.
        return "flat J, by the tolerance of QPs" if same and is_active and J <= CLOSE else "open"

    def _observers_agree(self):
        ours, theirs = self._kept(), self.python._engine._window
        size = self.case.x_units * (1.0 + np.abs(theirs.z[theirs.end] / self.case.x_units).max())
        return bool((np.abs(ours.z[ours.end] - theirs.z[theirs.end]) <= CLOSE * size).all())

    def _is_fall(self, estimate, other):
        """Whether J or the estimate has left the candidate by all digits that a number has."""
        if max(estimate.cost, other.cost) <= FALL * estimate.candidate_cost < np.inf:
            return True
        units, one = self.case.x_units, estimate.trajectory
        moved = np.abs((one - estimate.candidate) / units)
        return bool((np.abs((one - other.trajectory) / units) <= FALL * moved.max(axis=0)).all())

    def _is_rounding(self, estimate, other, kind, x, J, act):
        r, engine = np.random.default_rng(3), self.compiled._engine
        far, statuses, first, far_kept = np.zeros(2), set(), {}, 0.0
        for k in range(_TRIES):
            self._begin_again()
            if k:  # the first one repeats the step
                _nudge(r, engine._memory)
            self._hand_over(self.python)
            for one in (self.compiled, self.python):
                again = act(one, partial(nudged, r) if k else _same)
                statuses.add(again.status & ~STOPPED)
                far = np.maximum(far, self._apart(first.setdefault(one, again), again))
            kept = self._kept()
            far_kept = max(far_kept, self._far_from(first.setdefault("kept", kept), kept))
        if kind == "status" and {estimate.status & ~STOPPED, other.status & ~STOPPED} <= statuses:
            return True
        self.far = far
        if kind == "memory":
            return x <= 10.0 * far_kept
        return bool((np.array([x, J]) <= 10.0 * far + (0.0, 1e-9)).all())

    def _is_hessian(self, x, act):
        """Whether the Python step moves as far when its QPs change in their last digits."""
        if self.nudging is None:
            self.nudging = self.case.estimator(
                "python", backend=Nudging(), max_solver_iterations=None
            )
        found, solver = [], self.nudging.settings.backend
        solver.unsolved = False
        for _ in range(_TRIES):
            self._begin_again(self.nudging)
            found.append(act(self.nudging, _same))
        return x <= 10.0 * max(self._apart(found[0], one)[0] for one in found)

    def _is_tolerance(self, estimate, x, act, kept):
        if self.exact is None:
            self.exact = [
                self.case.estimator("python", max_solver_iterations=None, **tight)
                for tight in _TIGHT
            ]
        for python in self.exact:
            self._begin_again(python)
            # Where a QP has many minimisers, what its solver has kept decides.
            python.forget_warm_start()
            try:
                again = act(python, _same)
            except QpmheError:  # a backend that cannot solve such QPs
                continue
            away, J = self._apart(estimate, again)
            if kept is not None:
                away, J = self._far_from(kept, python._engine._window), np.inf
            same = (again.status & ~STOPPED) == (estimate.status & ~STOPPED)
            if away <= max(1e-7, 0.02 * x) or (J <= 1e-9 and same):
                return True
        return False

    def _is_tolerance_in_c(self, kind, x, act):
        """Whether the step in C follows: what its active sets leave to the interior point."""
        settings = self.tools.record["solver_tolerance"]
        usual = settings.copy()

        def follows(tolerance, python):
            settings[...] = tolerance
            self._begin_again(python)
            again, other = act(self.compiled, _same), act(python, _same)
            away = self._apart(other, again)[0]
            if kind == "memory":
                away = self._far_from(self._kept(), python._engine._window)
            return away <= max(1e-7, 0.02 * x)

        try:
            return not follows(usual, self.python) and any(
                follows(tolerance, python)
                for tolerance in (1e-9, 1e-12) for python in (self.python, self.exact[0])
            )
        finally:
            settings[...] = usual
