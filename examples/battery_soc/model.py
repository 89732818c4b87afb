"""The cell as a system, its observers and its costs, all from the parameter file.

States x = (SOC, v1, v2, rho), input the current I (A, < 0 on discharge), output the mean terminal
voltage over the step, disturbances on all four states:

    SOC+ = SOC + I dt / (3600 Q)
    v_j+ = a_j v_j + rho R_j(SOC) (1 - a_j) I,    a_j = exp(-dt / tau_j)
    rho+ = rho
    y    = OCV(SOC) + rho R0(SOC) I + sum_j (m_j v_j + rho (1 - m_j) R_j(SOC) I)

m_j = tau_j (1 - a_j) / dt makes y the mean over a step of constant current, so that samples may be
means over some seconds. The factor rho follows the cell's temperature and age: all its resistances
fall by 1 to 2 % per kelvin. It is a random walk, because a cell at 25 degC tells nothing of how.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import qpmhe

Array = NDArray[np.float64]

PARAMETERS = Path(__file__).with_name("samsung_30t.json")
START = np.array([0.6, 0.0, 0.0, 1.0])

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
    """Tables of the parameter file, on a uniform grid of SOC; straight lines go on beyond it.

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
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        self.capacity = float(parameters["capacity_Ah"])
        circuit, voltage = parameters["circuit"], np.array(parameters["ocv"]["V"])
        self.tau: Array = np.array(circuit["tau_s"])
        self.steps = voltage.size - 1
        soc = np.linspace(0.0, 1.0, voltage.size)
        # The slope is interpolated and the voltage is its integral: exact derivatives.
        self._slopes = np.maximum(np.gradient(voltage, soc), 0.05)
        self._voltage = np.concatenate(
            [[0.0], np.cumsum(0.5 * (self._slopes[1:] + self._slopes[:-1])) / self.steps]
        )
        self._voltage += np.mean(voltage - self._voltage)
        resistances = np.array([
            np.interp(soc, circuit["soc"], circuit[name]) for name in ("R0_Ohm", "R1_Ohm", "R2_Ohm")
        ])
        rise = np.diff(resistances, axis=1, append=resistances[:, -1:]) * self.steps
        # (points, 3), so that one index picks a row.
        self._resistances, self._rises = resistances.T.copy(), rise.T.copy()

    @classmethod
    def read(cls, path: Path = PARAMETERS) -> "Cell":
        """The cell of a parameter file."""
        return cls(json.loads(path.read_text(encoding="utf-8")))

    def ocv(self, soc: Array) -> tuple[Array, Array]:
        """The open-circuit voltage and its slope (V), each of the shape of soc."""
        k, part = self._below(soc)
        last = np.minimum(k + 1, self.steps)
        slope = self._slopes[k] + np.clip(part, 0.0, 1.0) * (self._slopes[last] - self._slopes[k])
        return self._voltage[k] + 0.5 * (self._slopes[k] + slope) * part / self.steps, slope

    def resistances(self, soc: Array) -> tuple[Array, Array]:
        """R0, R1, R2 (..., 3) in Ohm and their slopes; constant beyond the grid."""
        k, part = self._below(soc)
        rise = self._rises[k] * ((part >= 0.0) & (part <= 1.0))[..., None]
        return self._resistances[k] + rise * (part / self.steps)[..., None], rise

    def _below(self, soc: Array) -> tuple[NDArray[np.intp], Array]:
        """Index of the grid point at or below, and how far above it, in grid steps."""
        place = soc * self.steps
        # Where the model is tried out at infinity, any index will do.
        k = np.clip(np.nan_to_num(place), 0, self.steps).astype(np.intp)
        return k, place - k


def system_of(cell: Cell, dt: float) -> qpmhe.System:
    """The discrete-time system; its functions take x (..., 4) and u (..., 1).

    Parameters
    ----------
    cell : Cell
        The parameters.
    dt : float
        Sampling time in s.
    """
    decay = np.exp(-dt / cell.tau)
    held = cell.tau * (1.0 - decay) / dt
    per_ampere = dt / (3600.0 * cell.capacity)
    into, through = 1.0 - decay, np.concatenate([[1.0], 1.0 - held])

    def f(x: Array, u: Array) -> Array:
        drop = x[..., 3:] * cell.resistances(x[..., 0])[0][..., 1:] * u
        return np.concatenate(
            [x[..., :1] + per_ampere * u, decay * x[..., 1:3] + into * drop, x[..., 3:]], axis=-1
        )

    def h(x: Array, u: Array) -> Array:
        resistance = cell.resistances(x[..., 0])[0] @ through
        y: Array = cell.ocv(x[..., 0])[0] + x[..., 1:3] @ held + x[..., 3] * resistance * u[..., 0]
        return y[..., None]

    def f_jacobian(x: Array, u: Array) -> Array:
        values, slopes = cell.resistances(x[..., 0])
        A = np.zeros((*x.shape, 4))
        A[..., 0, 0] = A[..., 3, 3] = 1.0
        A[..., 1, 1], A[..., 2, 2] = decay
        A[..., 1:3, 0] = x[..., 3:] * into * slopes[..., 1:] * u
        A[..., 1:3, 3] = into * values[..., 1:] * u
        return A

    def h_jacobian(x: Array, u: Array) -> Array:
        values, slopes = cell.resistances(x[..., 0])
        C = np.empty((*x.shape[:-1], 1, 4))
        C[..., 0, 0] = cell.ocv(x[..., 0])[1] + x[..., 3] * (slopes @ through) * u[..., 0]
        C[..., 0, 1:3] = held
        C[..., 0, 3] = (values @ through) * u[..., 0]
        return C

    free = np.inf
    return qpmhe.System(
        f, h, n=4, p=1, m=1, f_jacobian=f_jacobian, h_jacobian=h_jacobian,
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


def cost_of(cell: Cell, dt: float, prior: Array | qpmhe.ObserverPrior) -> qpmhe.RobustCost:
    """Inverse covariances, and Huber's loss of the noise beyond what the model's error reaches.

    Parameters
    ----------
    cell, dt
        As for `system_of`.
    prior : (4, 4) array or ObserverPrior
        Weight of the prior.
    """
    return qpmhe.RobustCost(
        prior=prior, disturbance=np.linalg.inv(disturbance(cell, dt)),
        noise=qpmhe.Huber(np.linalg.inv(noise(dt)), threshold=_threshold(noise(dt))),
    )


def _threshold(noise: Array) -> float:
    """Huber's threshold, in standard deviations of the white noise."""
    return _GROSS / float(np.sqrt(noise[0, 0]))


def estimator(
    cell: Cell,
    dt: float,
    *,
    max_qps: int | None,
    start: Array = START,
    prior: Array = PRIOR,
    observer: qpmhe.Observer | None = None,
) -> qpmhe.MovingHorizonEstimator:
    """The estimator of the study.

    Parameters
    ----------
    cell, dt
        As for `system_of`.
    max_qps : int or None
        As for `qpmhe.MovingHorizonEstimator`.
    start : (4,) array
        The initial estimate.
    prior : (4, 4) array
        Covariance of its error, as somebody states it.
    observer : Observer, optional
        Another one than `robust_kalman`; without a covariance, the prior's weight is constant.
    """
    weight: Array | qpmhe.ObserverPrior = qpmhe.ObserverPrior()
    if observer is None:
        observer = robust_kalman(
            prior=prior, disturbance=disturbance(cell, dt), noise=noise(dt)
        )
    if observer.initial_covariance() is None:
        weight = np.asarray(np.linalg.inv(prior), np.float64)
    return qpmhe.MovingHorizonEstimator(
        system_of(cell, dt), observer, cost_of(cell, dt, weight), horizon=round(HORIZON / dt),
        initial_state=start, max_qps=max_qps, engine="python",
    )
