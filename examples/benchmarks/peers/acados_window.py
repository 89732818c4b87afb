"""acados with HPIPM, where it is installed: its C interface, called by ``acados_window.c``."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from problems import Problem

from .acados_library import acados_library
from .base import Array, Peer, UnavailableError, WindowData

__all__ = ["Acados", "Bounds"]


class _Sizes(ctypes.Structure):
    _fields_: ClassVar = [
        *((name, ctypes.c_int) for name in (
            "stages", "n", "p", "m", "bounded", "controls", "bounded_last", "rows", "soft",
        )),
        ("linear", ctypes.c_double), ("quadratic", ctypes.c_double), ("capped", ctypes.c_int),
        ("smallest", ctypes.c_double),
    ]


class _Arrays(ctypes.Structure):
    _fields_: ClassVar = [(name, ctypes.c_void_p) for name in (
        "prior", "measurements", "inputs", "lower", "upper", "states", "disturbances",
    )]


class Bounds:
    """Boxes of a window.

    Parameters
    ----------
    states : sequence of int
        Bounded states.
    lower, upper : (K + 1, number) array
        Their bounds, which may be changed between updates.
    last : bool
        Whether the last stage has them, too.
    disturbance : (2, n) array, optional
        Lower and upper bounds of w.
    """

    def __init__(
        self, states: Sequence[int], lower: Array, upper: Array, last: bool = True,
        disturbance: Array | None = None,
    ) -> None:
        self.states, self.lower, self.upper, self.last = list(states), lower, upper, last
        self.disturbance = disturbance


class Acados(Peer):
    """SQP with the Gauss-Newton Hessian and HPIPM, the disturbances as controls.

    It starts at its own previous solution, shifted, or at the candidate, as CasADi's solvers do.

    Parameters
    ----------
    max_qps : {1, None}
        One QP is acados' real-time iteration; None converges.
    start : {"shifted", "candidate"}
        Where it starts.
    """

    #: Largest component of a step at which it has converged: J is the same within 1e-6.
    smallest = 3e-4
    limitations = (
        "acados: the one at ACADOS_SOURCE_DIR, by its C interface: discrete-time model of CasADi "
        "in C, linear least squares, PARTIAL_CONDENSING_HPIPM without condensing, SPEED_ABS; its "
        "time includes the shift. 1 QP: SQP_RTI, preparation and feedback together."
    )

    def __init__(self, max_qps: int | None, start: str = "shifted") -> None:
        self.capped, self.start, self.converges = max_qps is not None, start, max_qps is None
        self.name = f"acados, {'1 QP' if self.capped else 'converged'}"
        self._made: Any = None

    def setup(self, problem: Problem) -> None:
        """Compile the model and the calls, and make the solver."""
        self.build(
            problem.step, problem.output, problem.cost,
            (problem.horizon, problem.n, problem.p, problem.m),
        )

    def build(
        self, step: Any, output: Any, cost: Any, sizes: tuple[int, int, int, int],
        bounds: Bounds | None = None, rows: Any = None,
        penalty: tuple[float, float] | None = None,
    ) -> None:
        """The same of functions of CasADi columns, a quadratic cost and N, n, p and m.

        ``rows`` is a function of x whose values are at most 0. With a penalty, linear and
        quadratic, these rows and the bounds of states are soft.
        """
        count, n, p, m = sizes
        slope, self._offset = _linear(output, n)
        library, functions = _library(step, rows, n, m)
        bounds = bounds or Bounds((), np.zeros((count + 1, 0)), np.zeros((count + 1, 0)))
        self._states = np.zeros((count + 1, n))
        self._disturbances = np.zeros((count, n))
        self._prior, self._measurements = np.zeros(n), np.zeros((count, p))
        self._inputs = np.zeros((count, m))
        held = (
            self._prior, self._measurements, self._inputs, bounds.lower, bounds.upper,
            self._states, self._disturbances,
        )
        nothing, one = np.zeros((p, n)), np.eye(n)
        zero = np.zeros((n, n))
        # v, w and, at the first stage, the difference from the prior
        first = (
            np.vstack((slope, zero, one)), np.vstack((nothing, one, zero)),
            _diagonal(cost.noise, cost.disturbance, cost.prior),
        )
        other = (
            np.vstack((slope, zero)), np.vstack((nothing, one)),
            _diagonal(cost.noise, cost.disturbance),
        )
        box = np.zeros((2, n)) if bounds.disturbance is None else bounds.disturbance
        limited = np.flatnonzero(np.isfinite(box).any(axis=0))
        if bounds.disturbance is None:
            limited = limited[:0]
        made = _Sizes(
            count, n, p, m, len(bounds.states), len(limited),
            len(bounds.states) if bounds.last else 0, functions, penalty is not None,
            *(penalty or (0.0, 0.0)), self.capped, self.smallest,
        )
        library.window_make.restype = ctypes.c_void_p
        matrices = [_pointers([np.asfortranarray(a) for a in three]) for three in (first, other)]
        self._bounds, self._library = bounds, library
        self._made = ctypes.c_void_p(library.window_make(
            ctypes.byref(made), ctypes.byref(_Arrays(*(one.ctypes.data for one in held))),
            matrices[0][0], matrices[1][0], _numbers(bounds.states), _numbers(limited),
            _column(box[0, limited]), _column(box[1, limited]),
        ))
        if not self._made:
            raise UnavailableError("acados refuses the problem")
        self._solve = library.window_solve
        self._continues = False

    def restart(self) -> None:
        """Do not start at another record's solution."""
        self._continues = False

    def update(self, window: WindowData) -> Array:
        """Solve, and hand out the states."""
        if not (self._continues and self.start == "shifted"):
            self._states[:], self._disturbances[:] = window.candidate, window.disturbances
        self._prior[:] = window.prior
        np.subtract(window.measurements, self._offset, out=self._measurements)
        self._inputs[:] = window.inputs
        status = self._solve(self._made, self._continues and self.start == "shifted")
        if status not in (0, 3):  # neither solved nor a small step
            raise RuntimeError(f"acados' status {status}")
        self._continues = True
        return self._states.copy()

    def close(self) -> None:
        """Free the solver."""
        if self._made:
            self._library.window_free(self._made)
            self._made = None


def _linear(output: Any, n: int) -> tuple[Array, Array]:
    """C and c of an output C x + c."""
    import casadi as ca

    x = ca.SX.sym("x", n)
    value = output(x)
    slope = ca.jacobian(value, x)
    if ca.symvar(slope):
        raise UnavailableError("an output that is not linear")
    at = ca.Function("h", [x], [value, slope])(np.zeros(n))
    return at[1].full(), at[0].full().ravel()


def _library(step: Any, rows: Any, n: int, m: int) -> tuple[ctypes.CDLL, int]:
    """The model's functions and the calls of acados, compiled together, and the number of rows."""
    import casadi as ca

    x, w, u, z = ca.SX.sym("x", n), ca.SX.sym("w", n), ca.SX.sym("u", m), ca.SX.sym("z", 0)
    moved = step(x, u) + w
    row = ca.SX.zeros(1) if rows is None else ca.vertcat(rows(x))
    slopes = [ca.densify(ca.jacobian(one, ca.vertcat(w, x)).T) for one in (moved, row)]
    return acados_library([
        ca.Function("window_step", [x, w, u], [moved]),
        ca.Function("window_step_jac", [x, w, u], [moved, slopes[0]]),
        ca.Function("window_rows", [x, w, z, u], [row]),
        ca.Function("window_rows_jac", [x, w, z, u], [row, slopes[1], ca.SX.zeros(0, row.numel())]),
    ], "acados_window.c"), 0 if rows is None else row.numel()


def _diagonal(*blocks: Array) -> Array:
    size = sum(len(one) for one in blocks)
    whole, first = np.zeros((size, size)), 0
    for one in blocks:
        last = first + len(one)
        whole[first:last, first:last], first = one, last
    return whole


def _pointers(arrays: list[Array]) -> tuple[Any, list[Array]]:
    """A C array of pointers, and what they point to."""
    return (ctypes.c_void_p * len(arrays))(*(one.ctypes.data for one in arrays)), arrays


def _numbers(values: Sequence[int] | Array) -> Any:
    return (ctypes.c_int * len(values))(*(int(one) for one in values))


def _column(values: Array) -> Any:
    return (ctypes.c_double * len(values))(*values)
