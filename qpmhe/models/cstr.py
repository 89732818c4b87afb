"""A continuous stirred tank reactor with an exothermic reaction."""

from __future__ import annotations

import numpy as np

from ..model.sets import Box, ConvexSet, Polytope
from ..model.system import System
from ..observers import design_luenberger
from .example import Array, Example, Selection, make_example

_FLOW = 1.0  # 1/min, q/V = 100 L/min / 100 L
_FEED, _FEED_TEMPERATURE = 1.0, 350.0  # mol/L, K
_FREQUENCY, _ACTIVATION = 7.2e10, 8750.0  # 1/min, E/R in K
_HEAT = 5e4 / (1000.0 * 0.239)  # K L/mol, -dH / (rho C_p)
_COOLING = 5e4 / (100.0 * 1000.0 * 0.239)  # 1/min, UA / (V rho C_p)
_DT = 0.05  # min
_MEASURED = Selection(2, slice(1, 2))

# The controller's setpoint swings about the steady state.
_MEAN, _SWING, _PERIOD = 350.0, 8.0, 5.0  # K, K, min
_GAIN, _COOLANT = 6.0, (270.0, 330.0)


def _constant(temperature: Array) -> Array:
    """The rate constant k(T)."""
    return _FREQUENCY * np.exp(-_ACTIVATION / temperature)


def _rate(x: Array, u: Array) -> Array:
    concentration, temperature = x[..., 0], x[..., 1]
    reaction = _constant(temperature) * concentration
    value = np.empty(x.shape, x.dtype)
    value[..., 0] = _FLOW * (_FEED - concentration) - reaction
    value[..., 1] = _FLOW * (_FEED_TEMPERATURE - temperature) + _HEAT * reaction
    value[..., 1] += _COOLING * (u[..., 0] - temperature)
    return value


def _rate_jacobian(x: Array) -> Array:
    concentration, temperature = x[..., 0], x[..., 1]
    constant = _constant(temperature)
    warmer = constant * concentration * _ACTIVATION / (temperature * temperature)
    slope = np.empty((*x.shape, 2), x.dtype)
    slope[..., 0, 0] = -_FLOW - constant
    slope[..., 0, 1] = -warmer
    slope[..., 1, 0] = _HEAT * constant
    slope[..., 1, 1] = _HEAT * warmer - _FLOW - _COOLING
    return slope


def _coolant(t: int, x: Array) -> Array:
    """Proportional control about the coolant temperature of the setpoint's steady state."""
    wanted = _MEAN + _SWING * np.sin(2.0 * np.pi * t * _DT / _PERIOD)
    constant = _constant(wanted)
    heat = _HEAT * constant * _FLOW * _FEED / (_FLOW + constant)
    steady = wanted - (_FLOW * (_FEED_TEMPERATURE - wanted) + heat) / _COOLING
    coolant: Array = np.clip([steady + _GAIN * (wanted - x[1])], *_COOLANT)
    return coolant


def _about_the_steady_states() -> ConvexSet:
    """Within 12 K of the mean setpoint, and 0.15 mol/L of a line along its steady states."""
    slope, room = 0.021, 0.15  # mol/(L K), mol/L
    middle = 0.5 + slope * _MEAN
    strip = Polytope([[1.0, slope], [-1.0, -slope]], [middle + room, room - middle])
    return Box([0.0, _MEAN - 12.0], [_FEED, _MEAN + 12.0]) & strip


def cstr(method: str = "rk4") -> Example:
    r"""An exothermic reaction A -> B in a stirred tank with a cooling jacket.

    .. math::
        \dot c = \tfrac{q}{V} (c_f - c) - k(T)\, c, \quad
        \dot T = \tfrac{q}{V} (T_f - T) + \frac{-\Delta H}{\rho C_p} k(T)\, c
        + \frac{UA}{V \rho C_p} (u - T), \quad k(T) = k_0 e^{-E / (R T)}, \quad y = T

    State (c, T) in mol/L and K, input u the coolant's temperature in K, time in min. With
    q = 100 L/min, V = 100 L, :math:`c_f` = 1 mol/L, :math:`T_f` = 350 K,
    :math:`k_0 = 7.2 \cdot 10^{10}` 1/min, E/R = 8750 K, :math:`-\Delta H = 5 \cdot 10^4`
    J/mol, :math:`\rho` = 1000 g/L, :math:`C_p` = 0.239 J/(g K), UA = :math:`5 \cdot 10^4`
    J/(min K), the steady state (0.5, 350) at u = 300 K is unstable.

    In the scenario, a proportional controller that knows T follows 350 K plus a sine of 8 K
    and 5 min, with u between 270 and 330 K. The sampling time is 0.05 min, N = 20;
    disturbances have standard deviations of 0.005 mol/L and 0.3 K a step, the noise 0.5 K. The
    estimation starts at (0.65, 347); the prior's standard deviations are 0.3 mol/L and 5 K. States
    are bounded by what the reaction can reach, :math:`0 \le c \le c_f`, and by 250 K <= T <= 500 K.

    The observer has the constant gain of the stationary Kalman predictor about (0.5, 350), for
    disturbances of 1 K. It converges from within 0.3 mol/L and 5 K, not from everywhere: from a far
    too high concentration, its temperature runs away before the correction holds it, and only the
    projection onto X brings it back. The smaller gain for 0.3 K converges from fewer states.

    Parameters
    ----------
    method : {"rk4", "euler"}
        Discretisation of the model.

    References
    ----------
    Henson and Seborg, Nonlinear Process Control, Prentice Hall 1997. Seborg, Edgar,
    Mellichamp and Doyle, Process Dynamics and Control, 3rd edition, 2011, example 2.5.
    """
    system = System.from_ode(
        _rate, _MEASURED.output, dt=_DT, n=2, p=1, m=1, method=method,
        rate_jacobian=_rate_jacobian, h_jacobian=_MEASURED.jacobian,
        states=Box([0.0, 250.0], [_FEED, 500.0]),
    )
    observer = design_luenberger(
        system, [0.5, 350.0], [300.0], disturbance=np.diag([0.005**2, 1.0**2]), noise=[[0.5**2]]
    )
    return make_example(
        system, observer, prior=[0.3, 5.0], disturbance=[0.005, 0.3], noise=[0.5],
        initial_state=[0.5, 350.0], initial_estimate=[0.65, 347.0], dt=_DT, horizon=20, steps=200,
        labels=("c (mol/L)", "T (K)"), time_unit="min", inputs=_coolant, settling_time=1.0,
        title="Continuous stirred tank reactor, exothermic A -> B",
        region=_about_the_steady_states(), input_region=Box([_COOLANT[0]], [_COOLANT[1]]),
    )
