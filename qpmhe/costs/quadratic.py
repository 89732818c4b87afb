"""The quadratic cost, a = 2."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.errors import report_unknown_options

from .._checks import SINGULAR, Array, check_prior_size, positive_definite, positive_semidefinite
from .._linalg import inverse, unit_diagonal
from .base import Cost, CostConstants, CostForm, ObserverPrior, both_ways, quadratic_form


@report_unknown_options
class QuadraticCost(Cost):
    r"""Quadratic prior weighting and stage cost.

    .. math::
        \Gamma(\chi, \bar x) = |\chi - \bar x|_P^2, \qquad
        l(\omega, \nu) = |\omega|_Q^2 + |\nu|_R^2

    as in (eq:costfunction) and the paper's example; P, Q, R are *weights*, that is inverse
    covariances. If components of y are missing, the weight of the others is the inverse of their
    block of the covariance R^{-1}.

    Parameters
    ----------
    prior : (n, n) array_like or ObserverPrior, optional
        Weight P of the prior, symmetric positive definite. If left out, it comes from the
        covariance of a Kalman-type observer, as `ObserverPrior` says; another observer needs a
        weight here.
    disturbance, noise : (r, r) and (p, p) array_like
        Weights Q of the disturbance w and R of the noise v, symmetric positive definite. r is n,
        or the number of columns of the system's ``disturbance_matrix``.
    discount : float
        Factor in (0, 1] of a stage's cost per step of age, and of the prior's per step of the
        window; 1 gives the paper's cost.

    Raises
    ------
    WeightError, ShapeError
        If a weight is not square, symmetric and positive definite.
    OptionError
        If the discount is outside (0, 1].
    """

    quadratic = True

    def __init__(
        self, *, prior: ArrayLike | ObserverPrior | None = None, disturbance: ArrayLike,
        noise: ArrayLike, discount: float = 1.0,
    ) -> None:
        w = positive_definite("disturbance", disturbance)
        first: Array | ObserverPrior | None
        if prior is None or isinstance(prior, ObserverPrior):
            first = prior
        else:
            first = check_prior_size(positive_definite("prior", prior), w.shape[0])
        super().__init__(first, w, positive_definite("noise", noise), discount)

    @classmethod
    def from_covariances(
        cls, *, prior: ArrayLike | ObserverPrior | None = None, disturbance: ArrayLike,
        noise: ArrayLike, discount: float = 1.0,
    ) -> QuadraticCost:
        """The cost from the covariances of initial error, w and v; see `QuadraticCost`.

        The covariance of w may be singular: every estimate then follows the model exactly in the
        directions without variance.
        """
        covariance, singular = positive_semidefinite("disturbance covariance", disturbance)
        cost = cls(
            prior=(
                prior if prior is None or isinstance(prior, ObserverPrior)
                else _inverse("prior covariance", prior)
            ),
            disturbance=np.eye(len(covariance)) if singular else inverse(covariance),
            noise=_inverse("noise covariance", noise),
            discount=discount,
        )
        if singular:
            cost.disturbance_factor, cost.disturbance = _factor(covariance)
        return cost

    @property
    def c_form(self) -> CostForm | None:
        """The weights, unless a derived class computes another cost."""
        if type(self) is not QuadraticCost:
            return None
        prior = None if isinstance(self.prior, ObserverPrior) else self.prior
        return CostForm(prior, self.disturbance, self.noise, self.discount)

    @property
    def constants(self) -> CostConstants | None:
        """Constants of (eq:exp_bounds): extreme eigenvalues of the weights, a = 2.

        None with a discount, since the bounds then shrink with the age of a stage; with a singular
        covariance, since the cost in directions without variance is unbounded; and with an
        `ObserverPrior`, whose bounds `constants_with` finds from the observer's covariance.
        """
        if self.discount < 1.0 or self.disturbance_factor is not None:
            return None
        if isinstance(self.prior, ObserverPrior):
            return None
        return CostConstants(2.0, *map(_extremes, (self.prior, self.disturbance, self.noise)))

    def stage_costs(self, residuals: Array, weights: Array) -> Array:
        """The quadratic forms; see `Cost.stage_costs`."""
        return quadratic_form(residuals, weights)

    def majorise(self, residuals: Array, weights: Array) -> Array:
        """The weights themselves; see `Cost.majorise`."""
        return weights

    def prior_cost(self, offset: Array, weight: Array) -> float:
        """The quadratic form; see `Cost.prior_cost`."""
        return float(offset.dot(weight).dot(offset))

    def majorise_prior(self, offset: Array, weight: Array) -> Array:
        """The weight itself; see `Cost.majorise_prior`."""
        return weight

    def stage_hessian(self, residuals: Array, weights: Array) -> Array:
        """Twice the weights; see `Cost.stage_hessian`."""
        self._check_own()
        return np.broadcast_to(2.0 * weights, (len(residuals), *weights.shape[-2:]))

    def stage_weight_gradient(self, residuals: Array, directions: Array, weights: Array) -> Array:
        """See `Cost.stage_weight_gradient`."""
        return both_ways(directions, residuals)

    def prior_hessian(self, offset: Array, weight: Array) -> Array:
        """Twice the weight; see `Cost.prior_hessian`."""
        return 2.0 * weight

    def prior_weight_gradient(self, offset: Array, directions: Array, weight: Array) -> Array:
        """See `Cost.prior_weight_gradient`."""
        return both_ways(directions, offset)

    def _check_own(self) -> None:
        if type(self).stage_costs is not QuadraticCost.stage_costs:
            raise self._no_second_derivatives()


def _inverse(name: str, covariance: ArrayLike) -> Array:
    return inverse(positive_definite(name, covariance))


def _factor(covariance: Array) -> tuple[Array, Array]:
    """F (r, s) of full rank and a weight W with F W^-1 F' the covariance."""
    # By correlations: no unit matters.
    scaled, units, whole = unit_diagonal(covariance)
    sizes = np.sqrt(scaled.diagonal())
    scale = np.where(sizes > 0.0, sizes, 1.0)
    values, vectors = np.linalg.eigh(scaled / np.outer(scale, scale))
    there = values > SINGULAR
    factor: Array = np.ldexp(
        scale[:, None] * vectors[:, there] * np.sqrt(values[there]), units[:, None]
    )
    factor[sizes == 0.0] = 0.0
    return factor, np.ldexp(np.eye(factor.shape[1]), -whole)


def _extremes(weight: Array) -> tuple[float, float]:
    values = np.linalg.eigvalsh(weight)
    return float(values[0]), float(values[-1])
