"""A way to simulate a system from stated initial states and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..system import System

__all__ = ["Record", "Scenario"]

Array = NDArray[np.float64]


class Record(NamedTuple):
    """A simulated record.

    Parameters
    ----------
    states : (T + 1, n) array
        x(0), ..., x(T).
    measurements : (T, p) array
        y(0), ..., y(T-1).
    """

    states: Array
    measurements: Array


@dataclass(frozen=True)
class Scenario:
    """How a system is simulated and how its estimation starts.

    Parameters
    ----------
    system : System
        The system, without inputs.
    initial_state : (n,) array
        x(0) of the simulation.
    initial_estimate : (n,) array
        Where the estimation starts.
    disturbance_covariance, noise_covariance : array
        Covariances of w (n, n) and v (p, p), which are normal and white.
    dt : float
        Sampling time.
    horizon : int
        N of the published or recommended setting.
    steps : int
        Samples of a usual record.
    labels : tuple of str
        Names of the states with units, for figures.
    time_unit : str
        Unit of dt.
    """

    system: System
    initial_state: Array
    initial_estimate: Array
    disturbance_covariance: Array
    noise_covariance: Array
    dt: float
    horizon: int
    steps: int
    labels: tuple[str, ...]
    time_unit: str = "s"

    def simulate(self, seed: int, steps: int | None = None) -> Record:
        """Simulate x(t+1) = f(x(t)) + w(t), y(t) = h(x(t)) + v(t).

        Parameters
        ----------
        seed : int
            Seed of the random numbers; the same seed gives the same record.
        steps : int, optional
            Number T of measurements; ``self.steps`` if left out.

        Returns
        -------
        Record
            States (T + 1, n) and measurements (T, p).
        """
        count = self.steps if steps is None else steps
        generator = np.random.default_rng(seed)
        n, p, nothing = self.system.n, self.system.p, np.zeros(0)
        w = generator.standard_normal((count, n)) @ np.linalg.cholesky(
            self.disturbance_covariance
        ).T
        v = generator.standard_normal((count, p)) @ np.linalg.cholesky(self.noise_covariance).T
        states, measurements = np.empty((count + 1, n)), np.empty((count, p))
        states[0] = self.initial_state
        for t in range(count):
            measurements[t] = self.system.h(states[t], nothing) + v[t]
            states[t + 1] = self.system.f(states[t], nothing) + w[t]
        return Record(states, measurements)
