"""A damped pendulum with an encoder."""

from __future__ import annotations

import numpy as np

from ..model.sets import Box
from ..model.system import System
from ..observers import HighGain
from .example import Array, Example, Selection, make_example

_STIFFNESS, _DAMPING = 9.81 / 0.5, 0.2  # 1/s^2, 1/s
_DT = 0.02  # s
_COUNT = 2.0 * np.pi / 64  # rad
_MEASURED = Selection(2, slice(0, 1))


def _rate(x: Array) -> Array:
    angle, speed = x[..., 0], x[..., 1]
    value = np.empty(x.shape, x.dtype)
    value[..., 0] = speed
    value[..., 1] = -_STIFFNESS * np.sin(angle) - _DAMPING * speed
    return value


def _rate_jacobian(x: Array) -> Array:
    slope = np.zeros((*x.shape, 2), x.dtype)
    slope[..., 0, 1] = 1.0
    slope[..., 1, 0] = -_STIFFNESS * np.cos(x[..., 0])
    slope[..., 1, 1] = -_DAMPING
    return slope


def pendulum(method: str = "rk4") -> Example:
    r"""A damped pendulum whose angle is read from an incremental encoder.

    .. math::
        \dot \theta = \omega, \quad
        \dot \omega = -\tfrac{g}{l} \sin\theta - c\,\omega, \quad
        y = \delta \operatorname{round}(\theta / \delta)

    State (angle from hanging, angular velocity) in rad and rad/s, with g = 9.81 m/s^2,
    l = 0.5 m, c = 0.2 1/s, and a coarse encoder of 64 counts a turn,
    :math:`\delta = 2\pi / 64` rad. Its error is not normal; the cost weighs it like normal noise of
    the same variance, :math:`\delta^2 / 12`. The sampling time is 0.02 s, N = 30; disturbances have
    standard deviations of 0.001 rad and 0.02 rad/s a step. The pendulum starts at rest at 2.5 rad,
    the estimation hanging; the prior's standard deviations are 1 rad and 5 rad/s.

    The observer is a high-gain one with time constant 0.1 s: :math:`1 / 0.1^2 > g / l`, so that
    its error decays at any angle, upright included.

    Parameters
    ----------
    method : {"rk4", "euler"}
        Discretisation of the model.

    References
    ----------
    Khalil, Nonlinear Systems, 3rd edition, 2002, section 1.2.1.
    """
    system = System.from_ode(
        _rate, _MEASURED.output, dt=_DT, n=2, p=1, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_MEASURED.jacobian,
    )
    return make_example(
        system, HighGain(2, epsilon=0.1, dt=_DT), prior=[1.0, 5.0], disturbance=[0.001, 0.02],
        noise=[_COUNT / 12.0**0.5], initial_state=[2.5, 0.0], initial_estimate=[0.0, 0.0], dt=_DT,
        horizon=30, steps=300, labels=("angle (rad)", "speed (rad/s)"), settling_time=1.0,
        title="Damped pendulum with encoder", resolution=[_COUNT],
        region=Box([-3.2, -12.0], [3.2, 12.0]),
    )
