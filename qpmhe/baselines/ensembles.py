"""Filters of samples: an ensemble that is corrected, and particles that are weighed."""

from __future__ import annotations

import numpy as np

from .._checks import Array, dimension, positive
from .._linalg import cholesky, solve
from ..model.system import System
from .base import Baseline, Mask, Problem, deviations, innovation


class _Sampled(Baseline):
    """A filter whose memory is samples (B, n) of the state, with weights (B,)."""

    def __init__(self, problem: Problem, size: int) -> None:
        self._size = size
        super().__init__(problem)

    def _begin(self) -> None:
        self._root = cholesky(self._disturbance).T
        self._random = np.random.default_rng(self.problem.seed)
        self._samples = self.state + self._drawn(cholesky(self.problem.prior).T)
        self._weights = np.full(self._size, 1.0 / self._size)

    def _drawn(self, root: Array) -> Array:
        """Normal samples of the covariance root' root."""
        return self._random.standard_normal((self._size, len(root))) @ root

    def _inputs(self, u: Array) -> Array:
        return np.tile(u, (self._size, 1))

    def _predict(self, system: System, u: Array) -> None:
        self._samples = system.f.batch(self._samples, self._inputs(u)) + self._drawn(self._root)
        self._summarise(system)

    def _summarise(self, system: System) -> Array:
        """Set state and covariance to those of the samples; return the deviations (B, n)."""
        self.state, apart = deviations(system, self._samples, self._weights)
        # Unbiased, for equal weights the division by B - 1.
        scale = 1.0 - self._weights @ self._weights
        self.covariance = (apart.T * self._weights) @ apart / max(scale, 1.0 / self._size)
        return apart


class EnsembleKalmanFilter(_Sampled):
    r"""The ensemble Kalman filter with perturbed observations.

    Each member is corrected by :math:`K (y + \epsilon - h(x_i))` with its own noise
    :math:`\epsilon`; K comes from the members' covariances.

    Parameters
    ----------
    problem : Problem
        What to estimate.
    members : int
        Size of the ensemble, at least 2.
    inflation : float
        Factor of the deviations from the mean before each correction.

    Raises
    ------
    OptionError
        If ``members`` is no integer >= 2, or the inflation not positive.

    References
    ----------
    Burgers, van Leeuwen and Evensen, Analysis scheme in the ensemble Kalman filter, Mon. Weather
    Rev. 126 (1998).
    """

    def __init__(self, problem: Problem, *, members: int = 100, inflation: float = 1.0) -> None:
        self._inflation = positive("inflation", inflation)
        super().__init__(problem, dimension("members", members, 2))

    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        if self._inflation != 1.0:
            self._samples = self.state + self._inflation * self._summarise(system)
        apart = self._summarise(system)
        noise = self.problem.noise[np.ix_(there, there)]
        left = innovation(system, y, system.h.batch(self._samples, self._inputs(u)))[:, there]
        outputs = left.mean(axis=0) - left
        scale = 1.0 / (self._size - 1)
        gain = solve(scale * outputs.T @ outputs + noise, scale * outputs.T @ apart).T
        self._samples = self._samples + (left + self._drawn(cholesky(noise).T)) @ gain.T
        self._summarise(system)


class BootstrapParticleFilter(_Sampled):
    r"""The bootstrap filter: particles follow the model, and the likelihood of y weighs them.

    They are drawn anew, systematically, where the effective number
    :math:`1 / \sum_i \omega_i^2` is below half of them. Particles at which the model fails weigh
    nothing.

    Parameters
    ----------
    problem : Problem
        What to estimate; the estimate is the weighted mean.
    particles : int
        Their number, at least 2.

    Raises
    ------
    OptionError
        If ``particles`` is no integer >= 2.

    References
    ----------
    Gordon, Salmond and Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation,
    IEE Proc. F 140 (1993).
    """

    def __init__(self, problem: Problem, *, particles: int = 1000) -> None:
        super().__init__(problem, dimension("particles", particles, 2))

    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        noise = self.problem.noise[np.ix_(there, there)]
        left = innovation(system, y, system.h.batch(self._samples, self._inputs(u)))[:, there]
        fit = -0.5 * np.einsum("ij,ij->i", left, solve(noise, left.T).T)
        logs = np.where(np.isfinite(fit), fit, -np.inf) + np.log(self._weights)
        best = logs.max()
        if not np.isfinite(best):  # none of them explains anything
            return
        weights = np.exp(logs - best)
        self._weights = weights / weights.sum()
        if self._size * (self._weights @ self._weights) > 2.0:
            self._resample()
        self._summarise(system)

    def _resample(self) -> None:
        places = (self._random.random() + np.arange(self._size)) / self._size
        chosen = np.searchsorted(np.cumsum(self._weights), places).clip(max=self._size - 1)
        self._samples = self._samples[chosen]
        self._weights = np.full(self._size, 1.0 / self._size)
