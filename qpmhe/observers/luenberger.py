"""The observer with a constant gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, numbers, positive_definite
from ..errors import ShapeError
from ..model.system import System
from .base import Observer, Sample


class Luenberger(Observer):
    r"""Constant gain: :math:`L(z, v) = K v`.

    (eq:kappa) holds with :math:`\kappa` the spectral norm of K. For an observer designed
    in continuous time and discretised by one Euler step, K is the step times its gain.

    Parameters
    ----------
    gain : (n, p) array_like
        K of the discrete-time observer, or a vector (n,) if p is 1. An `InvalidInputError` is
        raised if it is not finite; an estimator checks its shape.
    metric : (n, n) array_like, optional
        M, symmetric positive definite (a `WeightError` is raised otherwise), in which the error
        provably contracts: |x(t+1) - z(t+1)|_M <= rho |x(t) - z(t)|_M without noise. The observer
        is projected onto X in it; see `qpmhe.MovingHorizonEstimator`.
    """

    def __init__(self, gain: ArrayLike, metric: ArrayLike | None = None) -> None:
        given = numbers("gain", gain)
        self.gain: Array = given.reshape(-1, 1) if given.ndim < 2 else given
        self._metric = None if metric is None else positive_definite("metric", metric)

    def check(self, system: System, initial_state: Array) -> None:
        """Check that the gain has shape (n, p); see `Observer.check`."""
        shape = (system.n, system.p)
        if self.gain.shape != shape:
            raise ShapeError(
                f"gain has shape {self.gain.shape}; expected (n, p) = {shape}: "
                "one row for each state, one column for each output."
            )
        self._check_metric(system)

    @property
    def constant_gain(self) -> Array | None:
        """The gain K, unless a derived class corrects in another way."""
        return self.gain if type(self).correct is Luenberger.correct else None

    @property
    def kappa(self) -> float:
        """The constant of (eq:kappa)."""
        return float(np.linalg.norm(self.gain, 2))

    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, None]:
        """K v; see `Observer.correct`."""
        return self.gain.dot(v), None
