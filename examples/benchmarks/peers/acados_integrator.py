"""acados' implicit integrator, where it is installed."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, ClassVar

from .acados_library import acados_library
from .base import Array

__all__ = ["AcadosIntegrator"]


class _Sizes(ctypes.Structure):
    _fields_: ClassVar = [
        *((name, ctypes.c_int) for name in ("n", "k", "m", "steps", "iterations", "reuses")),
        ("dt", ctypes.c_double), ("tolerance", ctypes.c_double),
    ]


class AcadosIntegrator:
    """Radau IIA steps of order 5 with forward sensitivities.

    Parameters
    ----------
    equations : casadi.Function
        (x and z, u) to the rates and the algebraic residuals below.
    n, m : int
        Numbers of states and inputs.
    dt, steps : float and int
        Time of a sample, and the steps in it.
    guess : sequence of float
        Where Newton's method starts for z; as many as there are.
    tolerance : float
        Newton's method ends at corrections of the rates below it.
    reuses : bool
        Whether one Jacobian serves all iterations of a sample.
    """

    def __init__(
        self, equations: Any, n: int, m: int, dt: float, steps: int, guess: Sequence[float],
        tolerance: float, reuses: bool,
    ) -> None:
        import casadi as ca

        k = len(guess)
        x, rate, u = ca.SX.sym("x", n), ca.SX.sym("rate", n), ca.SX.sym("u", m)
        z, t = ca.SX.sym("z", k), ca.SX.sym("t")
        residual = equations(ca.vertcat(x, z), u) - ca.vertcat(rate, ca.SX.zeros(k))
        by_x, by_rate, by_u, by_z = (ca.jacobian(residual, one) for one in (x, rate, u, z))
        given = [x, rate, u, z, t]
        self._library = acados_library([
            ca.Function("irk_residual", given, [residual]),
            ca.Function("irk_with_slopes", given, [residual, by_x, by_rate, by_z]),
            ca.Function("irk_slopes", given, [by_x, by_rate, by_u, by_z]),
        ], "acados_integrator.c")
        self._library.integrator_make.restype = ctypes.c_void_p
        sizes = _Sizes(n, k, m, steps, 50, reuses, dt, tolerance)
        self._made = ctypes.c_void_p(self._library.integrator_make(
            ctypes.byref(sizes), (ctypes.c_double * max(k, 1))(*guess)
        ))

    def steps(self, x: Array, u: Array, following: Array, slopes: Array) -> int:
        """Next states and transposed Jacobians, in place; how many steps failed."""
        pointers = (ctypes.c_void_p(one.ctypes.data) for one in (x, u, following, slopes))
        failed: int = self._library.integrator_steps(self._made, len(x), *pointers)
        return failed
