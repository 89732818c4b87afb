"""A quadrotor with twelve states."""

from __future__ import annotations

import numpy as np

from ..model.system import System
from ..observers import design_luenberger
from .example import Array, Example, Selection, make_example

_MASS, _GRAVITY = 0.65, 9.81  # kg, m/s^2
_INERTIA = np.array([7.5e-3, 7.5e-3, 1.3e-2])  # kg m^2
_GYRATION = (np.roll(_INERTIA, -1) - np.roll(_INERTIA, -2)) / _INERTIA
_DT = 0.05  # s
_MEASURED = Selection(12, [0, 1, 2, 6, 7, 8])


def _rate(x: Array, u: Array) -> Array:
    p, q, r = x[..., 9], x[..., 10], x[..., 11]
    s1, s2, s3, c1, c2, c3 = _circular(x)
    lift = u[..., 0] / _MASS
    turn = s1 * q + c1 * r
    value = np.empty(x.shape, x.dtype)
    value[..., :3] = x[..., 3:6]
    value[..., 3] = lift * (c1 * s2 * c3 + s1 * s3)
    value[..., 4] = lift * (c1 * s2 * s3 - s1 * c3)
    value[..., 5] = lift * c1 * c2 - _GRAVITY
    value[..., 6] = p + turn * s2 / c2
    value[..., 7] = c1 * q - s1 * r
    value[..., 8] = turn / c2
    value[..., 9] = _GYRATION[0] * q * r
    value[..., 10] = _GYRATION[1] * r * p
    value[..., 11] = _GYRATION[2] * p * q
    value[..., 9:] += u[..., 1:] / _INERTIA
    return value


def _circular(x: Array) -> tuple[Array, ...]:
    """Sines, then cosines, of roll, pitch and yaw."""
    sin, cos = np.sin(x[..., 6:9]), np.cos(x[..., 6:9])
    return sin[..., 0], sin[..., 1], sin[..., 2], cos[..., 0], cos[..., 1], cos[..., 2]


def _rate_jacobian(x: Array, u: Array) -> Array:
    p, q, r = x[..., 9], x[..., 10], x[..., 11]
    s1, s2, s3, c1, c2, c3 = _circular(x)
    lift = u[..., 0] / _MASS
    turn, other = s1 * q + c1 * r, c1 * q - s1 * r
    slope = np.zeros((*x.shape, 12), x.dtype)
    slope[..., [0, 1, 2], [3, 4, 5]] = 1.0

    slope[..., 3, 6] = lift * (c1 * s3 - s1 * s2 * c3)
    slope[..., 3, 7] = lift * c1 * c2 * c3
    slope[..., 3, 8] = lift * (s1 * c3 - c1 * s2 * s3)
    slope[..., 4, 6] = -lift * (s1 * s2 * s3 + c1 * c3)
    slope[..., 4, 7] = lift * c1 * c2 * s3
    slope[..., 4, 8] = lift * (c1 * s2 * c3 + s1 * s3)
    slope[..., 5, 6] = -lift * s1 * c2
    slope[..., 5, 7] = -lift * c1 * s2

    slope[..., 6, 6] = other * s2 / c2
    slope[..., 6, 7] = turn / (c2 * c2)
    slope[..., 6, 9] = 1.0
    slope[..., 6, 10] = s1 * s2 / c2
    slope[..., 6, 11] = c1 * s2 / c2
    slope[..., 7, 6] = -turn
    slope[..., 7, 10] = c1
    slope[..., 7, 11] = -s1
    slope[..., 8, 6] = other / c2
    slope[..., 8, 7] = turn * s2 / (c2 * c2)
    slope[..., 8, 10] = s1 / c2
    slope[..., 8, 11] = c1 / c2

    slope[..., 9, 10], slope[..., 9, 11] = _GYRATION[0] * r, _GYRATION[0] * q
    slope[..., 10, 9], slope[..., 10, 11] = _GYRATION[1] * r, _GYRATION[1] * p
    slope[..., 11, 9], slope[..., 11, 10] = _GYRATION[2] * q, _GYRATION[2] * p
    return slope


def _fly(t: int, x: Array) -> Array:
    """Thrust and torques of a cascaded controller that flies a rising and falling circle."""
    phase = t * _DT
    wanted = np.array([1.5 * np.cos(phase), 1.5 * np.sin(phase), 2.0 + 0.5 * np.sin(phase / 2)])
    moving = np.array([-1.5 * np.sin(phase), 1.5 * np.cos(phase), 0.25 * np.cos(phase / 2)])
    push = 2.0 * (wanted - x[:3]) + 2.4 * (moving - x[3:6])
    push[:2] -= wanted[:2]  # the centripetal acceleration, at 1 rad/s
    roll, pitch, yaw = x[6:9]
    along = np.cos(yaw) * push[0] + np.sin(yaw) * push[1]
    across = np.sin(yaw) * push[0] - np.cos(yaw) * push[1]
    tilt = np.clip([across / _GRAVITY, along / _GRAVITY, 0.5 * np.sin(phase / 3)], -0.5, 0.5)
    torques = _INERTIA * (36.0 * (tilt - x[6:9]) - 9.0 * x[9:])
    lift = _MASS * (_GRAVITY + push[2]) / (np.cos(roll) * np.cos(pitch))
    return np.array([np.clip(lift, 0.0, 2.0 * _MASS * _GRAVITY), *torques])


def quadrotor(method: str = "rk4") -> Example:
    r"""A quadrotor in flight, whose position and attitude are measured.

    .. math::
        \dot p = v, \quad
        \dot v = \tfrac{u_1}{m} R(\phi, \theta, \psi)\, e_3 - g e_3, \quad
        \begin{pmatrix} \dot\phi \\ \dot\theta \\ \dot\psi \end{pmatrix}
        = \begin{pmatrix}
        1 & \sin\phi \tan\theta & \cos\phi \tan\theta \\
        0 & \cos\phi & -\sin\phi \\
        0 & \sin\phi / \cos\theta & \cos\phi / \cos\theta
        \end{pmatrix} \omega, \quad
        I \dot\omega = (u_2, u_3, u_4)^\top - \omega \times I \omega

    State: position p (m) and velocity v (m/s) in a frame with :math:`e_3` upwards, roll,
    pitch and yaw (rad, R = R_z(psi) R_y(theta) R_x(phi)), and body rates omega (rad/s); n = 12.
    Inputs: thrust (N) and three torques (N m). Measured: p and the three angles. Mass and
    inertia are those of the OS4, m = 0.65 kg, I = diag(7.5, 7.5, 13) 10^{-3} kg m^2; drag,
    ground effect and rotor dynamics are left out.

    In the scenario, a cascaded controller that knows the state flies a circle of 1.5 m radius
    at 1 rad/s, going up and down and turning slowly to and fro. The sampling time is 0.05 s,
    N = 20; disturbances have standard deviations of 0.002 m, 0.05 m/s, 0.002 rad and 0.1
    rad/s a step, the noise 0.1 m and 0.02 rad. The estimation starts level and at rest, beside
    the vehicle; the prior's standard deviations are 0.5 m, 1 m/s, 0.2 rad and 0.5 rad/s.

    The observer has the constant gain of the stationary Kalman predictor about hovering at yaw
    0, for disturbances three times as large. In the flight, only the effect of angle errors on the
    velocity differs.

    Parameters
    ----------
    method : {"rk4", "euler"}
        Discretisation of the model.

    Notes
    -----
    The angles are singular at a pitch of 90 degrees; the controller tilts by 29 at most.

    No region is stated: noises of three standard deviations, all the same way at each sample,
    move the body rates by more than the flight does, so that no bound that holds for all of them
    is smaller than the rates themselves.

    References
    ----------
    Bouabdallah, Design and Control of Quadrotors with Application to Autonomous Flying, PhD
    thesis 3727, EPFL 2007. Mahony, Kumar and Corke, Multirotor aerial vehicles, IEEE Robotics
    and Automation Magazine 19 (2012).
    """
    system = System.from_ode(
        _rate, _MEASURED.output, dt=_DT, n=12, p=6, m=4, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_MEASURED.jacobian,
    )
    disturbance, noise = _each(0.002, 0.05, 0.002, 0.1), _each(0.1, 0.02)
    hover = np.array([_MASS * _GRAVITY, 0.0, 0.0, 0.0])
    observer = design_luenberger(
        system, np.zeros(12), hover, disturbance=9.0 * np.diag(disturbance**2),
        noise=np.diag(noise**2),
    )
    start, estimate = np.zeros((2, 12))
    start[[0, 2, 4]] = 1.5, 2.0, 1.5
    estimate[:3] = 1.0, 0.5, 1.5
    return make_example(
        system, observer, prior=_each(0.5, 1.0, 0.2, 0.5), disturbance=disturbance, noise=noise,
        initial_state=start, initial_estimate=estimate, dt=_DT, horizon=20, steps=200,
        labels=(
            "x (m)", "y (m)", "z (m)", "vx (m/s)", "vy (m/s)", "vz (m/s)",
            "roll (rad)", "pitch (rad)", "yaw (rad)", "p (rad/s)", "q (rad/s)", "r (rad/s)",
        ),
        inputs=_fly, settling_time=2.0, title="Quadrotor",
    )


def _each(*deviations: float) -> Array:
    """Standard deviations, each of three components."""
    return np.repeat(deviations, 3)
