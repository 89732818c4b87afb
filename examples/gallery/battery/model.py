"""The cell as a system, its observers and its weights, all from the parameter file.

States x = (SOC, v1, v2, rho), input the current I (A, < 0 on discharge), output the mean terminal
voltage over the step, disturbances on all four states:

    SOC+ = SOC + I dt / (3600 Q)
    v_j+ = a_j v_j + rho R_j(SOC) (1 - a_j) I,    a_j = exp(-dt / tau_j)
    rho+ = rho
    y    = OCV(SOC) + rho R0(SOC) I + sum_j (m_j v_j + rho (1 - m_j) R_j(SOC) I)

m_j = tau_j (1 - a_j) / dt makes y the mean over a step of constant current, so that samples may be
means over some seconds. The factor rho follows the cell's temperature and age: all its resistances
fall by 1 to 2 % per kelvin. It is a random walk, because all records
are at 25 degC and do not show how.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import qpmhe
from qpmhe.tuning import Weights

Array = NDArray[np.float64]

PARAMETERS = Path(__file__).with_name("samsung_30t.json")

# The circuit is wrong by some 15 mV, for about a minute at a time: hysteresis, current that it
# is not linear in, diffusion that is not an exponential. White noise that tells as little about
# the state has the same spectral density at low frequencies, in V^2 s.
_NOISE = 0.015**2 * 2.0 * 50.0
# What no such error reaches: beyond it a voltage is doubtful, however short the step.
_GROSS = 3.0 * 0.015
# The tester's current is good to 75 mA, 2.5 % of the charge in an hour: 0.04 % per root second.
_CHARGE = 0.025 / 60.0
# R1 and R2 are good to some 20 %: 5 mV in v1 and 10 mV in v2 at the currents of a drive.
_POLARISATION = np.array([0.005, 0.010])
# A fifth in two hours. A cell may warm faster; but a faster walk takes up other errors of the model
# while the current is steady, where rho and SOC look alike.
_RESISTANCE = 0.2 / np.sqrt(7200.0)
# Any SOC between 0 and 1 has a standard deviation of 0.3; resistances are good to 15 %.
PRIOR = np.diag([0.3, 0.010, 0.010, 0.15]) ** 2
# No more is plausible, whatever prior somebody states: all of SOC, three times the polarisation.
_LARGEST = np.array([0.3, 0.020, 0.030, 0.3])
# OCV rises by about 1 V from empty to full: a time constant of 200 s, a few of the model error's.
_GAIN_PER_SECOND = np.array([1 / 200.0, 0.0, 0.0, 0.0])
# Samples beyond the threshold after which the filter doubts its covariance: 6 s, which the model's
# faster time constant takes.
_PATIENCE = 3
HORIZON = 120.0  # s


class Cell:
    """Tables of the parameter file as functions of SOC, which go on as straight lines beyond them.

    Parameters
    ----------
    parameters : dict
        What `identify.py` writes.

    Attributes
    ----------
    capacity : float
        A h.
    tau : (2,) array
        s.
    hppc_charge_factor : float
        The charge in units of the C/20 test, over that which the HPPC test's counter shows.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        self.hppc_charge_factor = float(parameters["hppc_charge_factor"])
        self.capacity = float(parameters["capacity_Ah"])
        circuit, voltage = parameters["circuit"], np.array(parameters["ocv"]["V"])
        self.tau: Array = np.array(circuit["tau_s"])
        # The slope is interpolated and the voltage is its integral: a continuous derivative.
        self._soc = np.linspace(0.0, 1.0, voltage.size)
        slopes = np.maximum(np.gradient(voltage, self._soc), 0.05)
        self._slope, self._bends = slopes[0], _kinks(self._soc, slopes)
        rise = 0.5 * np.diff(self._soc) * (slopes[1:] + slopes[:-1])
        self._empty = float(np.mean(voltage - np.append(0.0, np.cumsum(rise))))
        self._knots = np.array(circuit["soc"])
        tables = np.array([circuit[name] for name in ("R0_Ohm", "R1_Ohm", "R2_Ohm")])
        self._first, self._kinks = tables[:, 0], _kinks(self._knots, tables)

    @classmethod
    def read(cls, path: Path = PARAMETERS) -> "Cell":
        """The cell of a parameter file."""
        return cls(json.loads(path.read_text(encoding="utf-8")))

    def ocv(self, soc: Array) -> Array:
        """The open-circuit voltage (V), of the shape of soc (..., 1)."""
        beyond = np.maximum(soc - self._soc, 0.0)
        bent = (self._bends * beyond * beyond).sum(axis=-1, keepdims=True)
        return self._empty + self._slope * soc + 0.5 * bent

    def resistance(self, soc: Array, which: int) -> Array:
        """R0, R1 or R2 in Ohm, of the shape of soc (..., 1); constant beyond the table."""
        kinked = self._kinks[which] * np.maximum(soc - self._knots, 0.0)
        return self._first[which] + kinked.sum(axis=-1, keepdims=True)


def _kinks(knots: Array, values: Array) -> Array:
    """How the slope of an interpolated table (..., K) changes at each knot; zero beyond them."""
    slopes = np.diff(values) / np.diff(knots)
    return np.diff(slopes, prepend=0.0, append=0.0)


def system_of(
    cell: Cell, dt: float, correction: Callable[[Array], Array] | None = None
) -> qpmhe.System:
    """The discrete-time system; its functions take x (..., 4) and u (..., 1).

    Parameters
    ----------
    cell : Cell
        The parameters.
    dt : float
        Sampling time in s.
    correction : callable, optional
        What y has beyond the circuit (V), of (SOC, v1, v2, I).
    """
    decay = np.exp(-dt / cell.tau)
    held = cell.tau * (1.0 - decay) / dt
    per_ampere = dt / (3600.0 * cell.capacity)

    def f(x: Array, u: Array) -> Array:
        soc, rho = x[..., :1], x[..., 3:]
        v1, v2 = (
            decay[j] * x[..., j + 1 : j + 2]
            + (1.0 - decay[j]) * rho * cell.resistance(soc, j + 1) * u
            for j in range(2)
        )
        return np.concatenate((soc + per_ampere * u, v1, v2, rho), axis=-1)

    def h(x: Array, u: Array) -> Array:
        soc, rho = x[..., :1], x[..., 3:]
        y = cell.ocv(soc) + rho * cell.resistance(soc, 0) * u
        for j in range(2):
            dropped = (1.0 - held[j]) * rho * cell.resistance(soc, j + 1) * u
            y = y + held[j] * x[..., j + 1 : j + 2] + dropped
        if correction is not None:
            y = y + correction(np.concatenate((x[..., :3], u), axis=-1))
        return y

    free = np.inf
    return qpmhe.System(
        f, h, n=4, p=1, m=1,
        states=qpmhe.Box([0.0, -free, -free, 0.3], [1.0, free, free, 3.0]),
    )


def disturbance(cell: Cell, dt: float) -> Array:
    """Covariance of w over a step: (4, 4), those of v_j such that they stay as large as stated."""
    polarisation = _POLARISATION**2 * (1.0 - np.exp(-2.0 * dt / cell.tau))
    return np.diag([_CHARGE**2 * dt, *polarisation, _RESISTANCE**2 * dt])


def noise(dt: float) -> Array:
    """Covariance of v: (1, 1)."""
    return np.array([[_NOISE / dt]])


def robust_kalman(*, prior: Array, disturbance: Array, noise: Array) -> qpmhe.ExtendedKalman:
    """An extended Kalman filter that neither outliers nor a wrong prior covariance lead astray.

    Innovations beyond what the model's error reaches count as Huber counts them, and the stated
    prior covariance is scaled back to what is plausible.

    Parameters
    ----------
    prior : (4, 4) array_like
        Covariance of the initial error.
    disturbance, noise : array_like
        As for `qpmhe.ExtendedKalman`.
    """
    scale = np.minimum(1.0, _LARGEST / np.sqrt(np.diag(prior)))
    return qpmhe.ExtendedKalman(
        prior=prior * np.outer(scale, scale), disturbance=disturbance, noise=noise,
        innovation=qpmhe.HuberInnovation(_threshold(np.asarray(noise)), reopen=_PATIENCE),
    )


def constant_gain(dt: float) -> qpmhe.Luenberger:
    """The simplest observer: it corrects the SOC alone, which makes A - K C triangular."""
    return qpmhe.Luenberger(dt * _GAIN_PER_SECOND)


def weights_of(cell: Cell, dt: float, prior: Array = PRIOR) -> Weights:
    """The covariances by hand, for a quadratic loss.

    Parameters
    ----------
    cell, dt
        As for `system_of`.
    prior : (4, 4) array
        Covariance of the initial error, as somebody states it.
    """
    return Weights(prior, disturbance(cell, dt), noise(dt), horizon=round(HORIZON / dt))


def robust_cost(weights: Weights, prior: Array | None = None) -> qpmhe.RobustCost:
    """Huber's loss of the noise beyond what the model's error reaches.

    Parameters
    ----------
    weights : Weights
        Covariances of disturbance and noise.
    prior : (4, 4) array, optional
        Weight of the prior; the observer's covariance gives it if left out.
    """
    return qpmhe.RobustCost(
        prior=prior, disturbance=np.linalg.inv(weights.disturbance),
        noise=qpmhe.Huber(np.linalg.inv(weights.noise), threshold=_threshold(weights.noise)),
    )


def _threshold(noise: Array) -> float:
    """Huber's threshold, in standard deviations of the white noise."""
    return _GROSS / float(np.sqrt(noise[0, 0]))
