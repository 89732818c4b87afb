"""The default: a banded factorisation where it is exact, otherwise a QP solver."""

from __future__ import annotations

from contextlib import suppress
from itertools import chain
from time import perf_counter

from .backend import make_solver
from .banded import BandedSolver
from .native import NATIVE
from .options import SolverOptions
from .qp import QP, Array
from .solution import Solution, SolveStatus
from .solver import ContainedSolver, Solver

# daqp is the fastest up to about this many unknowns; sparse interior points win beyond.
_SMALL = 60
_SMALL_ORDER = ("daqp", "piqp", "clarabel", "proxqp", "osqp")
_LARGE_ORDER = ("piqp", "clarabel", "osqp", "proxqp")


class AutoSolver(Solver):
    """Solve by `BandedSolver`, or by a QP solver if the result violates an inequality."""

    _judges = True

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._banded = BandedSolver(options)
        self._others: dict[bool, list[ContainedSolver]] = {}
        self._shifts = 0  # of which the others do not know yet

    def __reduce__(self) -> tuple[type[AutoSolver], tuple[SolverOptions]]:
        return type(self), (self.options,)

    def _solve(self, qp: QP, start: Array | None) -> Solution:
        limit = remaining = self.time_limit
        began = 0.0 if limit is None else perf_counter()
        solution = self._banded._solve(qp, start)
        if solution.status is SolveStatus.SOLVED:
            return solution
        small = qp.size <= _SMALL
        if small not in self._others:
            self._others[small] = self._choose(small)
        if self._shifts:
            self._pass_shifts_on(qp.stages)
        for other in self._others[small]:
            if limit is not None:
                remaining = limit - (perf_counter() - began)
                if remaining <= 0.0:
                    break
            answer = other.solve(qp, start, remaining)
            if answer.status.usable:
                return answer
        return solution

    def forget(self) -> None:
        """Reset the QP solvers; see `Solver.forget`."""
        self._shifts = 0
        for other in chain.from_iterable(self._others.values()):
            other.forget()

    def shift(self) -> None:
        """Count the shift for the QP solvers, which most steps skip; see `Solver.shift`."""
        self._shifts += 1

    def _pass_shifts_on(self, stages: int) -> None:
        for other in chain.from_iterable(self._others.values()):
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
