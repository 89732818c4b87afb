"""The default: a banded factorisation where it is exact, otherwise a QP solver."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from time import perf_counter

from .active_set import ActiveSetSolver
from .backend import make_solver
from .banded import BandedSolver
from .native import NATIVE
from .options import SolverOptions
from .qp import QP, Array
from .solution import Solution, SolveStatus
from .solver import ContainedSolver, Solver

# daqp is the fastest up to about this many unknowns; beyond, the active set on the banded
# factorisation is, or a sparse interior point where that takes more exchanges than these.
_SMALL, _EXCHANGES = 60, 40
_SMALL_ORDER = ("daqp", "piqp", "clarabel", "proxqp", "osqp")
_LARGE_ORDER = ("piqp", "clarabel", "osqp", "proxqp")


class AutoSolver(Solver):
    """Solve by `BandedSolver`, or by a QP solver if the result violates an inequality.

    Without a cap, large QPs go to `ActiveSetSolver` first.
    """

    _judges, _takes_sparse = True, True

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._banded = BandedSolver(options)
        self._exact = None if options.max_iterations else ContainedSolver(
            ActiveSetSolver(options, most_exchanges=_EXCHANGES)
        )
        self._chooses = self._exact is not None
        self._active = False  # whether constraints were active at its last solution
        self._others: dict[bool, list[ContainedSolver]] = {}
        self._shifts = 0  # of which the others do not know yet

    def __reduce__(self) -> tuple[type[AutoSolver], tuple[SolverOptions]]:
        return type(self), (self.options,)

    def _solve(self, qp: QP, start: Array | None) -> Solution:
        limit = self.time_limit
        until = None if limit is None else perf_counter() + limit
        small = qp.size <= _SMALL
        exact = None if small else self._exact
        if exact is not None and self._active:  # the factorisation alone will not do
            answer = self._exactly(exact, qp, limit)
            if answer is not None:
                return answer
            exact = None
        solution = self._banded._solve(qp, start)
        if solution.status is SolveStatus.SOLVED or not (qp.bounded or qp.rows):
            # Without inequalities, no other solver finds more than rounding in a singular Hessian.
            return solution
        if exact is not None:
            answer = self._exactly(exact, qp, _left(until))
            if answer is not None:
                return answer
        if small not in self._others:
            self._others[small] = self._choose(small)
        self._pass_shifts_on(qp.stages)
        for other in self._others[small]:
            left = _left(until)
            if left is not None and left <= 0.0:
                break
            answer = other.solve(qp, start, left)
            if answer.status.usable:
                return answer
        return solution

    def _exactly(self, exact: ContainedSolver, qp: QP, limit: float | None) -> Solution | None:
        """The solution by the active set; None where it does not find it."""
        self._pass_shifts_on(qp.stages)
        answer = exact.solve(qp, None, limit)
        solved = answer.status is SolveStatus.SOLVED
        self._active = solved and any(
            duals is not None and duals.any() for duals in (answer.bound_duals, answer.row_duals)
        )
        return answer if solved else None

    @property
    def _kept(self) -> Iterator[ContainedSolver]:
        """The solvers that keep something between solves."""
        if self._exact is not None:
            yield self._exact
        yield from chain.from_iterable(self._others.values())

    def forget(self) -> None:
        """Reset the QP solvers; see `Solver.forget`."""
        self._shifts, self._active = 0, False
        for other in self._kept:
            other.forget()

    def shift(self) -> None:
        """Count the shift for the QP solvers, which most steps skip; see `Solver.shift`."""
        self._shifts += 1

    def _pass_shifts_on(self, stages: int) -> None:
        for other in self._kept if self._shifts else ():
            # After as many as there are stages, nothing that was kept belongs to any.
            for _ in range(min(self._shifts, stages)):
                other.shift()
        self._shifts = 0

    def prepare(self, size: int) -> None:
        """Make the QP solvers, whose import takes long."""
        for small in {True, size <= _SMALL}:
            self._others[small] = others = self._choose(small)
            for other in others:
                other.prepare(size)

    def _choose(self, small: bool) -> list[ContainedSolver]:
        """The two best solvers that can be made: the second where the first brings nothing."""
        options = self.options
        chosen: list[ContainedSolver] = []
        known = [NATIVE[name] for name in (_SMALL_ORDER if small else _LARGE_ORDER)]
        if options.time_limit is not None:
            known.sort(key=lambda backend: not backend.time_limit)
        for backend in known:
            fits = options.max_iterations is None or backend.iterate_at_cap
            if len(chosen) < 2 and fits and backend.available:
                # A package that is installed may not work: the next will do.
                with suppress(Exception):
                    chosen.append(ContainedSolver(make_solver(backend, options)))
        return chosen


def _left(until: float | None) -> float | None:
    """The seconds left until then."""
    return None if until is None else until - perf_counter()
