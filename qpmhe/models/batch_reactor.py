"""The paper's example: a batch reactor with the reaction 2A <-> B (ex:eq:sys)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..costs import QuadraticCost
from ..observers import Luenberger
from ..system import System
from .scenario import Scenario

__all__ = ["BatchReactor", "batch_reactor", "casadi_output", "casadi_rate"]

Array = NDArray[Any]

_K1, _K2 = 0.16, 0.64
_DT = 0.1
_STOICHIOMETRY = np.array([-2.0, 1.0])
# The Jacobian is x_1 times the first matrix, plus the second.
_SLOPE = 2.0 * _K1 * np.array([[-2.0, 0.0], [1.0, 0.0]])
_CONSTANT = np.array([[0.0, 2.0 * _K2], [0.0, -_K2]])


class BatchReactor(NamedTuple):
    """The example's parts.

    Parameters
    ----------
    system : System
        The reactor.
    observer : Luenberger
        The paper's observer.
    cost : QuadraticCost
        The paper's weights.
    scenario : Scenario
        How it is simulated, and where the estimation starts.
    """

    system: System
    observer: Luenberger
    cost: QuadraticCost
    scenario: Scenario


def _rate(x: Array) -> Array:
    first = x[..., 0]
    reaction = _K1 * first * first - _K2 * x[..., 1]
    value: Array = np.multiply.outer(reaction, _STOICHIOMETRY)
    return value


def _rate_jacobian(x: Array) -> Array:
    slope: Array = x[..., :1, None] * _SLOPE + _CONSTANT
    return slope


def _output(x: Array) -> Array:
    total: Array = x[..., :1] + x[..., 1:]
    return total


def _output_jacobian(x: Array) -> Array:
    return np.ones((*x.shape[:-1], 1, 2))


def casadi_rate(x: Any) -> Any:
    """The same right-hand side of (ex:eq:sys) for a CasADi column."""
    import casadi

    reaction = _K1 * x[0] ** 2 - _K2 * x[1]
    return casadi.vertcat(-2.0 * reaction, reaction)


def casadi_output(x: Any) -> Any:
    """The same output for a CasADi column."""
    return x[0] + x[1]


def batch_reactor(method: str = "euler") -> BatchReactor:
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

    Returns
    -------
    system, observer, cost, scenario
        Ready for `qpmhe.MovingHorizonEstimator`; ``scenario.simulate(seed)`` gives a record.

    Raises
    ------
    OptionError
        If the method is unknown.

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
    disturbance, noise = 0.1**2 * np.eye(2), 0.2**2 * np.eye(1)
    scenario = Scenario(
        system=system,
        initial_state=np.array([5.0, 2.0]),
        initial_estimate=np.array([3.0, 0.0]),
        disturbance_covariance=disturbance,
        noise_covariance=noise,
        dt=_DT,
        horizon=10,
        steps=150,
        labels=("x1 (A)", "x2 (B)"),
    )
    observer = Luenberger(_DT * np.array([[0.5], [0.5]]))
    cost = QuadraticCost.from_covariances(prior=np.eye(2), disturbance=disturbance, noise=noise)
    return BatchReactor(system, observer, cost, scenario)
