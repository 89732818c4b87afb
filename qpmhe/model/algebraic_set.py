"""A set of algebraic states, as nonlinear constraints of x and u."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .algebraic import AlgebraicStates, of_rows
from .constraint import Constraint
from .evaluation import Evaluator, VirtualMachine
from .expressions import import_casadi
from .sets import ConvexSet, SoftSet

if TYPE_CHECKING:
    from .system import System

Array = NDArray[np.float64]
_NOTHING: Array = np.zeros(0)


class AlgebraicSet:
    """The inequalities of a set of z, evaluated at z(x, u).

    Parameters
    ----------
    one : ConvexSet or SoftSet
        The set, with its penalties where it is soft.
    written : AlgebraicStates
        Solves the equations as they are written: until `system` is set, and where they cannot be
        traced.
    m : int
        Number of inputs.
    """

    def __init__(self, one: ConvexSet | SoftSet, written: AlgebraicStates, m: int) -> None:
        hard = one.convex if isinstance(one, SoftSet) else one
        matrix = np.vstack((np.eye(hard.dimension), hard.matrix))
        lower = np.append(hard.lower, hard.row_lower)
        upper = np.append(hard.upper, hard.row_upper)
        above, below = np.isfinite(upper), np.isfinite(lower)
        #: The inequalities ``matrix z <= limit``.
        self.matrix: Array = np.vstack((matrix[above], -matrix[below]))
        self.limit: Array = np.append(upper[above], -lower[below])
        self.penalties: dict[str, Array] = {}
        if isinstance(one, SoftSet):
            for name in ("linear", "quadratic"):
                given = getattr(one, name)
                self.penalties[name] = np.append(given[above], given[below])
        self._written, self._m = written, m
        #: The system, whose trace then solves the equations.
        self.system: System | None = None
        self._traced: tuple[Any, AlgebraicStates] | None = None

    @property
    def constraint(self) -> Constraint:
        """The inequalities as a constraint of a system."""
        function: Callable[..., Array] = self._of_state
        if self._m:
            function = self._of_both
        made = Constraint(function, len(self.limit), **self.penalties)
        made.algebraic = self
        return made

    def expression(self, z: Any) -> Any:
        """The inequalities' left sides of CasADi symbols z."""
        ca = import_casadi()
        return ca.mtimes(ca.sparsify(ca.DM(self.matrix)), z) - ca.DM(self.limit)

    def slopes(self, x: Array, u: Array = _NOTHING) -> Array:
        """Their derivatives by x (..., n), (..., rows, n): NaN where z has no solution."""
        solver = self._solver()

        def chained(w: Array, u: Array) -> Array:
            of_states = np.zeros((*self.matrix.shape[:1], x.shape[-1]))
            slope = np.concatenate((of_states, self.matrix), axis=1)
            return solver.chained(slope, w, u)

        return of_rows(chained, solver, x, u, (len(self.limit), x.shape[-1]))

    def _of_state(self, x: Array) -> Array:
        return self._of_both(x, np.empty(0))

    def _of_both(self, x: Array, u: Array) -> Array:
        states = np.asarray(x, np.float64)[None]
        inputs = np.asarray(u, np.float64)[None]
        z = self._solver().complete(states, inputs)[0, states.shape[1] :]
        found: Array = self.matrix @ z - self.limit
        return found

    def _solver(self) -> AlgebraicStates:
        tracing = None if self.system is None else self.system.tracing
        if tracing is None:
            return self._written
        now = tracing.now
        if self._traced is None or self._traced[0] is not now:
            solver, model = self._written, now.model
            if model is not None:
                one = Evaluator(VirtualMachine(model.equations, False)).one
                solver = AlgebraicStates(
                    partial(one, "f"), partial(one, "f_jacobian"), self._written.guess
                )
            self._traced = now, solver
        return self._traced[1]
