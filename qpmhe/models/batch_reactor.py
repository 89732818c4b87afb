"""The paper's example: a batch reactor with the reaction 2A <-> B (ex:eq:sys)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..model.sets import Box
from ..model.system import System
from ..observers import Luenberger
from .example import Array, Example, make_example

_K1, _K2 = 0.16, 0.64
_DT = 0.1
_STOICHIOMETRY = np.array([-2.0, 1.0])
# The rate is linear in the squares of the states and in the states: few and large operations.
_OF_SQUARES = np.outer([_K1, 0.0], _STOICHIOMETRY)
_OF_STATES = np.outer([0.0, -_K2], _STOICHIOMETRY)
_SUM, _SUM_JACOBIAN = np.ones((2, 1)), np.ones((1, 2))
_SUM_JACOBIAN.flags.writeable = False
# The Jacobian is x_1 times the first matrix, plus the second.
_SLOPE = 2.0 * _K1 * np.array([[-2.0, 0.0], [1.0, 0.0]])
_CONSTANT = np.array([[0.0, 2.0 * _K2], [0.0, -_K2]])


def _rate(x: Array) -> Array:
    value: Array = (x * x).dot(_OF_SQUARES)
    value += x.dot(_OF_STATES)
    return value


def _rate_jacobian(x: Array) -> Array:
    slope: Array = x[..., :1, None] * _SLOPE + _CONSTANT
    return slope


def _output(x: Array) -> Array:
    total: Array = x.dot(_SUM)
    return total


def _output_jacobian(x: Array) -> Array:
    return _SUM_JACOBIAN if x.ndim == 1 else np.ones((*x.shape[:-1], 1, 2))


def casadi_rate(x: Any) -> Any:
    """The same right-hand side of (ex:eq:sys) for a CasADi column."""
    import casadi

    reaction = _K1 * x[0] ** 2 - _K2 * x[1]
    return casadi.vertcat(-2.0 * reaction, reaction)


def casadi_output(x: Any) -> Any:
    """The same output for a CasADi column."""
    return x[0] + x[1]


def batch_reactor(method: str = "euler") -> Example:
    r"""The reaction 2A <-> B in a constant-volume batch reactor, as in the paper's section 4.

    .. math::
        \dot x_1 = -2 k_1 x_1^2 + 2 k_2 x_2, \quad \dot x_2 = k_1 x_1^2 - k_2 x_2, \quad
        y = x_1 + x_2

    with k_1 = 0.16, k_2 = 0.64, x(0) = (5, 2), sampling time 0.1, Q = 0.1^2 I, R = 0.2^2;
    a Luenberger observer with L_1 = L_2 = 0.5 from (3, 0); cost weights Q^{-1}, R^{-1} and
    I for the prior; N = 10. The states are partial pressures, in the paper without unit.

    The paper does not say how it discretises; the gain of the discrete-time observer is
    the sampling time times L, as one Euler step gives it, for both methods.

    Parameters
    ----------
    method : {"euler", "rk4"}
        Discretisation of the model.

    References
    ----------
    Schiller, Knuefer, Mueller (2021), doi 10.1016/j.ifacol.2021.08.549, (ex:eq:sys).
    Tenny and Rawlings, Efficient moving horizon estimation and nonlinear model predictive
    control, American Control Conference 2002.
    """
    system = System.from_ode(
        _rate, _output, dt=_DT, n=2, p=1, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_output_jacobian,
    )
    return make_example(
        system, Luenberger(_DT * np.array([[0.5], [0.5]])), prior=[1.0, 1.0],
        disturbance=[0.1, 0.1], noise=[0.2], initial_state=[5.0, 2.0],
        initial_estimate=[3.0, 0.0], dt=_DT, horizon=10, steps=150,
        labels=("x1 (A)", "x2 (B)"), settling_time=2.0, title="Batch reactor, 2A <-> B",
        region=Box([0.1, -1.0], [9.0, 9.0]),
    )
