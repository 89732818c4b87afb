"""A vehicle that sees beacons, their ranges and bearings."""

from __future__ import annotations

import math

import numpy as np

from ..model.residuals import angles
from ..model.sets import Box
from ..model.system import System
from ..observers import OutputInjection
from .example import Array, Example, make_example

_BEACONS = np.array([[9.0, -5.0], [10.0, 6.0]])  # m
_DT = 0.2  # s
_RANGE_NOISE, _BEARING_NOISE = 0.2, 0.05  # m, rad
_CORRECTION = 0.3


def _rate(x: Array, u: Array) -> Array:
    heading, speed = x[..., 2], u[..., 0]
    value = np.empty(x.shape, x.dtype)
    value[..., 0] = speed * np.cos(heading)
    value[..., 1] = speed * np.sin(heading)
    value[..., 2] = u[..., 1]
    return value


def _rate_jacobian(x: Array, u: Array) -> Array:
    heading, speed = x[..., 2], u[..., 0]
    slope = np.zeros((*x.shape, 3), x.dtype)
    slope[..., 0, 2] = -speed * np.sin(heading)
    slope[..., 1, 2] = speed * np.cos(heading)
    return slope


def _offsets(x: Array) -> Array:
    """From the vehicle to each beacon, (..., 2 beacons, 2 axes)."""
    return _BEACONS - x[..., None, :2]


def _output(x: Array) -> Array:
    offsets = _offsets(x)
    east, north = offsets[..., 0], offsets[..., 1]
    ranges = np.sqrt(east * east + north * north)
    return np.concatenate((ranges, np.arctan2(north, east) - x[..., 2:]), axis=-1)


def _output_jacobian(x: Array) -> Array:
    offsets = _offsets(x)
    squares = np.sum(offsets * offsets, axis=-1, keepdims=True)
    slope = np.zeros((*x.shape[:-1], 4, 3), x.dtype)
    slope[..., :2, :2] = -offsets / np.sqrt(squares)
    slope[..., 2:, 0] = offsets[..., 1] / squares[..., 0]
    slope[..., 2:, 1] = -offsets[..., 0] / squares[..., 0]
    slope[..., 2:, 2] = -1.0
    return slope


_ROOT_WEIGHTS = np.repeat([1.0 / _RANGE_NOISE, 1.0 / _BEARING_NOISE], 2)


def _correction(z: Array, v: Array) -> Array:
    """A share of the weighted least squares fix of the state by the measurement alone."""
    slope = _ROOT_WEIGHTS[:, None] * _output_jacobian(z)
    fix: Array = np.linalg.solve(slope.T @ slope, slope.T @ (_ROOT_WEIGHTS * v))
    return _CORRECTION * fix


def _drive(t: int, x: Array) -> Array:
    """Speed and turn rate of a driver that follows a point on a figure eight."""
    phase = 0.25 * t * _DT
    east, north = 5.0 * math.sin(phase) - x[0], 2.5 * math.sin(2.0 * phase) - x[1]
    turn = math.remainder(math.atan2(north, east) - x[2], 2.0 * math.pi)
    return np.array([min(math.hypot(east, north), 2.0), min(max(2.0 * turn, -1.5), 1.5)])


def vehicle(method: str = "rk4") -> Example:
    r"""A vehicle on the plane with odometry, which sees ranges and bearings of two beacons.

    .. math::
        \dot p_x = u_1 \cos\theta, \quad \dot p_y = u_1 \sin\theta, \quad \dot\theta = u_2,
        \quad y = (r_1, r_2, \beta_1, \beta_2), \quad r_j = |b_j - p|, \quad
        \beta_j = \operatorname{atan2}(b_{jy} - p_y, b_{jx} - p_x) - \theta

    State (position in m, heading in rad), inputs speed (m/s) and turn rate (rad/s), known
    beacons :math:`b_1 = (9, -5)` m and :math:`b_2 = (10, 6)` m. The driver of the scenario,
    who knows where he is, follows a figure eight of 10 m by 5 m. Heading and bearings are
    angles, recorded in :math:`[-\pi, \pi)`: both jump on the path, and `qpmhe.angles`
    declares them.

    The sampling time is 0.2 s, N = 20; disturbances have standard deviations of 0.02 m and
    0.02 rad a step, the noise 0.2 m and 0.05 rad. The estimation starts 1 m and 1.1 m beside
    the vehicle, and turned by 0.5 rad; the prior's standard deviations are 1 m and 0.5 rad.

    The observer corrects by 0.3 of the fix from linearised weighted least squares on the
    measurement alone: its error shrinks to 0.7 a step wherever the vehicle is.

    Parameters
    ----------
    method : {"rk4", "euler"}
        Discretisation of the model.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, sections 5.3 and 6.6.
    """
    system = System.from_ode(
        _rate, _output, dt=_DT, n=3, p=4, m=2, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_output_jacobian,
        output_residual=angles([2, 3]), state_residual=angles([2]),
    )
    return make_example(
        system, OutputInjection(_correction), prior=[1.0, 1.0, 0.5],
        disturbance=[0.02, 0.02, 0.02], noise=1.0 / _ROOT_WEIGHTS, initial_state=[0.0, 0.0, 0.8],
        initial_estimate=[-1.0, 1.1, 0.3], dt=_DT, horizon=20, steps=250,
        labels=("x (m)", "y (m)", "heading (rad)"), inputs=_drive, settling_time=5.0,
        title="Vehicle with ranges and bearings of two beacons",
        region=Box([-5.0, -3.0, -0.9], [5.0, 3.0, 0.9]), input_region=Box([0.0, -1.5], [2.0, 1.5]),
    )
