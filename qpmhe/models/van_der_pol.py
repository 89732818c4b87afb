"""The van der Pol oscillator."""

from __future__ import annotations

import numpy as np

from ..model.sets import Box, Polytope
from ..model.system import System
from ..observers import HighGain
from .example import Array, Example, Selection, make_example

_MU, _DT = 1.0, 0.1
_MEASURED = Selection(2, slice(0, 1))


def _rate(x: Array) -> Array:
    first, second = x[..., 0], x[..., 1]
    value = np.empty(x.shape, x.dtype)
    value[..., 0] = second
    value[..., 1] = _MU * (1.0 - first * first) * second - first
    return value


def _rate_jacobian(x: Array) -> Array:
    first, second = x[..., 0], x[..., 1]
    slope = np.zeros((*x.shape, 2), x.dtype)
    slope[..., 0, 1] = 1.0
    slope[..., 1, 0] = -2.0 * _MU * first * second - 1.0
    slope[..., 1, 1] = _MU * (1.0 - first * first)
    return slope


def van_der_pol(method: str = "rk4") -> Example:
    r"""The van der Pol oscillator, whose position is measured.

    .. math::
        \dot x_1 = x_2, \quad \dot x_2 = \mu (1 - x_1^2)\, x_2 - x_1, \quad y = x_1

    with :math:`\mu = 1` and sampling time 0.1, all without unit. From (2, 0) it follows its limit
    cycle, with a period of about 6.7. Disturbances have standard deviations of 0.02 and 0.05 a
    step, the noise 0.1. The estimation starts at (0, 0), where the linearisation is unstable, and
    weighs the prior with I; N = 20.

    The observer is a high-gain one with time constant 0.4: its error decays although the
    oscillator drives it apart wherever :math:`|x_1| < 1`.

    Parameters
    ----------
    method : {"rk4", "euler"}
        Discretisation of the model.

    References
    ----------
    Khalil, Nonlinear Systems, 3rd edition, 2002, section 2.4.
    """
    system = System.from_ode(
        _rate, _MEASURED.output, dt=_DT, n=2, p=1, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_MEASURED.jacobian,
    )
    return make_example(
        system, HighGain(2, epsilon=0.4, dt=_DT), prior=[1.0, 1.0], disturbance=[0.02, 0.05],
        noise=[0.1], initial_state=[2.0, 0.0], initial_estimate=[0.0, 0.0], dt=_DT, horizon=20,
        steps=200, labels=("x1", "x2"), settling_time=3.0, title="Van der Pol oscillator",
        region=Box([-2.5, -3.5], [2.5, 3.5]) & Polytope([[0.8, 0.6], [-0.8, -0.6]], [2.4, 2.4]),
    )
