"""What observers that carry a covariance from sample to sample have in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, positive_definite
from ..errors import ShapeError
from ..model.system import System
from .base import Observer, Sample

__all__ = ["KalmanType"]


class KalmanType(Observer):
    """An observer with covariances of the initial error, the disturbance and the noise.

    Parameters
    ----------
    prior, disturbance, noise : array_like
        Covariances (n, n), (n, n) and (p, p).
    """

    def __init__(self, *, prior: ArrayLike, disturbance: ArrayLike, noise: ArrayLike) -> None:
        self._prior = positive_definite("prior covariance", prior)
        self._disturbance = positive_definite("disturbance covariance", disturbance)
        self._noise = positive_definite("noise covariance", noise)

    def check(self, system: System, initial_state: Array) -> None:
        """Insist on covariances of the system's dimensions; see `Observer.check`."""
        for name, matrix, size in (
            ("prior", self._prior, system.n),
            ("disturbance", self._disturbance, system.n),
            ("noise", self._noise, system.p),
        ):
            if matrix.shape[0] != size:
                raise ShapeError(
                    f"{name} covariance has shape {matrix.shape}; expected ({size}, {size})."
                )

    def initial_covariance(self) -> Array:
        """P(0)."""
        return self._prior

    def _noise_of(self, sample: Sample) -> Array:
        """The covariance of this sample's noise."""
        if sample.noise_weight is None:
            return self._noise
        return np.asarray(np.linalg.inv(sample.noise_weight), np.float64)
