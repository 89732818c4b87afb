"""The quadratic cost, a = 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import positive_definite
from .prior import ObserverPrior

__all__ = ["CostConstants", "QuadraticCost"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CostConstants:
    """The constants of Assumption ass:stagecosts, (eq:exp_bounds).

    Parameters
    ----------
    exponent : float
        a.
    prior, disturbance, noise : (float, float)
        Lower and upper constant c of each term: lower |s|^a <= cost(s) <= upper |s|^a.
    """

    exponent: float
    prior: tuple[float, float]
    disturbance: tuple[float, float]
    noise: tuple[float, float]


class QuadraticCost:
    r"""Quadratic prior weighting and stage cost.

    .. math::
        \Gamma(\chi, \bar x) = |\chi - \bar x|_P^2, \qquad
        l(\omega, \nu) = |\omega|_Q^2 + |\nu|_R^2

    as in (eq:costfunction) and the paper's example; P, Q, R are *weights*, that is
    inverse covariances.

    Parameters
    ----------
    prior : (n, n) array_like or ObserverPrior
        Weight P of the prior, symmetric positive definite, or the rule to take it from a
        Kalman-type observer.
    disturbance : (n, n) array_like
        Weight Q of the disturbance w, symmetric positive definite.
    noise : (p, p) array_like
        Weight R of the measurement noise v, symmetric positive definite.

    Raises
    ------
    WeightError, ShapeError
        If a weight is not square, symmetric and positive definite.

    Notes
    -----
    Where components of y are missing, the noise enters with the weight of the components
    that are there: the inverse of their block of the covariance R^{-1}.
    """

    def __init__(
        self, *, prior: ArrayLike | ObserverPrior, disturbance: ArrayLike, noise: ArrayLike
    ) -> None:
        self.disturbance: Array = positive_definite("disturbance", disturbance)
        self.noise: Array = positive_definite("noise", noise)
        self.n, self.p = self.disturbance.shape[0], self.noise.shape[0]
        self.prior: Array | ObserverPrior
        if isinstance(prior, ObserverPrior):
            self.prior = prior
        else:
            self.prior = positive_definite("prior", prior, self.n)
        # Of the joint residual (w, v), so that a stage costs one product.
        self.stage_weight: Array = np.zeros((self.n + self.p, self.n + self.p))
        self.stage_weight[: self.n, : self.n] = self.disturbance
        self.stage_weight[self.n :, self.n :] = self.noise
        self._partial: dict[bytes, Array] = {}

    @classmethod
    def from_covariances(
        cls, *, prior: ArrayLike | ObserverPrior, disturbance: ArrayLike, noise: ArrayLike
    ) -> QuadraticCost:
        """The same cost, given covariances instead of weights.

        Parameters
        ----------
        prior, disturbance, noise : array_like
            Covariances of the initial error, of w and of v, symmetric positive definite.

        Raises
        ------
        WeightError, ShapeError
            If a covariance is not square, symmetric and positive definite.
        """
        return cls(
            prior=(
                prior if isinstance(prior, ObserverPrior) else _inverse("prior covariance", prior)
            ),
            disturbance=_inverse("disturbance covariance", disturbance),
            noise=_inverse("noise covariance", noise),
        )

    @property
    def constants(self) -> CostConstants:
        """The constants of (eq:exp_bounds): extreme eigenvalues of the weights, a = 2."""
        if isinstance(self.prior, ObserverPrior):
            prior = (self.prior.minimum, self.prior.maximum)
        else:
            prior = _extremes(self.prior)
        return CostConstants(2.0, prior, _extremes(self.disturbance), _extremes(self.noise))

    def partial_weight(self, observed: NDArray[np.bool_]) -> Array:
        """The stage weight where only some components of y are there; zero on the others.

        Parameters
        ----------
        observed : (p,) bool array
            Which components are there.
        """
        key = observed.tobytes()
        if key not in self._partial:
            weight = self.stage_weight.copy()
            weight[self.n :, self.n :] = 0.0
            there = np.flatnonzero(observed)
            if there.size:
                block = np.linalg.inv(self.noise)[np.ix_(there, there)]
                place = self.n + there
                weight[np.ix_(place, place)] = np.linalg.inv(block)
            self._partial[key] = weight
        return self._partial[key]


def _inverse(name: str, covariance: ArrayLike) -> Array:
    inverse = np.linalg.inv(positive_definite(name, covariance))
    return np.asarray(0.5 * (inverse + inverse.T))


def _extremes(weight: Array) -> tuple[float, float]:
    values = np.linalg.eigvalsh(weight)
    return float(values[0]), float(values[-1])
