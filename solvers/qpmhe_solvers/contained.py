"""Containment of solvers of any origin: nothing that they do gets out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import count

import numpy as np

from .qp import QP, Array
from .solution import Residuals, Solution, SolveStatus
from .solver import Solver, as_count, as_iterate, as_multipliers, failure

__all__ = ["ContainedSolver"]

_NUMBERS = count(1)


class ContainedSolver:
    """A solver whose methods raise nothing but KeyboardInterrupt, whatever class it is of.

    `Solver.solve` contains what `Solver._solve` does. This contains the rest: a user's class may
    override `solve` itself, and its `shift`, `forget` and `prepare` may raise.

    Several of these may share one solver. Whenever it passes from one to another, it starts
    afresh: nothing that it keeps from one trajectory warm-starts the other.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self._number = next(_NUMBERS)
        is_contained = solver._builtin or type(solver).solve is Solver.solve
        self._is_trusted = is_contained and "solve" not in vars(solver)

    def solve(
        self, qp: QP, start: Array | None = None, time_limit: float | None = None
    ) -> Solution:
        """Solve a QP; see `Solver.solve`."""
        solver = self.solver
        try:
            if solver._user != self._number:
                self._take_over(solver)
            if time_limit is not None:
                solver.time_limit = time_limit
            if self._is_trusted:
                return solver.solve(qp, start)
            lent = None if start is None else start.copy()
            with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
                return _checked(solver.solve(qp.copy(), lent), qp)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a panic of compiled code is no Exception
            return failure(error)

    def _take_over(self, solver: Solver) -> None:
        if solver._user:
            _quietly(solver.forget)
            solver.time_limit = solver.options.time_limit
        solver._user = self._number

    def shift(self) -> None:
        """Say that the trajectory moved on by one stage; see `Solver.shift`."""
        if self.solver._user in (0, self._number):  # else it keeps nothing of this trajectory
            _quietly(self.solver.shift)

    def forget(self) -> None:
        """Drop what is kept from solve to solve; see `Solver.forget`."""
        if self.solver._user in (0, self._number):
            _quietly(self.solver.forget)

    def prepare(self, size: int) -> None:
        """Do beforehand what the first QPs would wait for; see `Solver.prepare`."""
        _quietly(self.solver.prepare, size)


def _quietly(method: Callable[..., None], *arguments: int) -> None:
    """Call a method whose failure changes nothing that anybody relies on."""
    try:
        method(*arguments)
    except KeyboardInterrupt:
        raise
    except BaseException:  # what a user's solver keeps is its own affair
        pass


def _checked(found: object, qp: QP) -> Solution:
    """What an overridden `solve` returned, if it is what it should be."""
    if not isinstance(found, Solution):
        message = f"the backend's solve returned {type(found).__name__}, not a Solution"
        return Solution(None, SolveStatus.FAILED, message=message)
    count = as_count(found.iterations)
    status: object = found.status
    if not isinstance(status, SolveStatus):
        message = f"the status of the backend's Solution is {type(status).__name__}"
        return Solution(None, SolveStatus.FAILED, count, message=f"{message}, not a SolveStatus")
    d, message = as_iterate(found.d, found.message, qp)
    if d is None or status is SolveStatus.FAILED:
        return Solution(None, SolveStatus.FAILED, count, message=message)
    residuals = found.residuals if isinstance(found.residuals, Residuals) else None
    return Solution(
        d, status, count, residuals, as_multipliers(found.bound_duals, qp.size),
        as_multipliers(found.row_duals, qp.stages * qp.rows), message,
    )
