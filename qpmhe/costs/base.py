"""The interface of a cost: weights for the QP, values to accept or reject a trial."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import SINGULAR, Array, representation
from .._linalg import inverse, solve
from ..errors import InvalidInputError, OptionError
from .subspace import Subspace

Mask = NDArray[np.bool_]

# Weights for patterns of missing components are kept up to so many bytes, and a few in any case.
_KEPT_BYTES = 2**22
_KEPT_LEAST = 8
# In place of a variance of zero: its weight acts as infinity, and its square does not overflow.
_NO_VARIANCE = 2.0**-500
#: The default of `ObserverPrior`. A larger one would not change a weight by more than the rounding
#: of covariances that have shrunk from 1e10 standard deviations to one.
LARGEST_KAPPA = 1e32


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


class LossForm(NamedTuple):
    """A loss as the step in C computes it.

    Parameters
    ----------
    kind : {"quadratic", "huber", "power", "own"}
        The function of the quadratic form.
    parameter : float
        Its threshold or exponent.
    per_component : bool
        Whether it is applied to each component and summed.
    function : callable or None
        Of a user's "own" loss: forms q (K,) to rho(q) and rho'(q), (2, K).
    graduation : float
        Factor of its threshold at the first sample; see `Barron`.
    """

    kind: str = "quadratic"
    parameter: float = 0.0
    per_component: bool = False
    function: Callable[[Array], Array] | None = None
    graduation: float = 1.0


class CostForm(NamedTuple):
    """The matrices and the discount with which the step in C computes a cost.

    Parameters
    ----------
    prior, disturbance, noise : array
        Weights of the initial error (n, n), of w (n, n) and of v (p, p). The first is None
        where the observer's covariance gives it.
    discount : float
        gamma.
    losses : tuple of LossForm
        The functions of the three quadratic forms, in the same order.
    """

    prior: Array | None
    disturbance: Array
    noise: Array
    discount: float
    losses: tuple[LossForm, LossForm, LossForm] = (LossForm(), LossForm(), LossForm())


class ObserverPrior:
    r"""Weight the prior z(t-N) with the inverse of the observer's covariance at t-N.

    This is the rule where a cost is made without a prior. With a Kalman-type observer on a linear
    system, the estimator then equals the Kalman filter for every horizon. With P(t) the observer's
    covariance, P(0) that of the initial error and :math:`\kappa` a number, the weight is

    .. math::
        W(t) = \big(P(t) + \tfrac{2}{\kappa} P(0)\big)^{-1} + \tfrac{1}{\kappa} P(0)^{-1},
        \qquad
        \kappa^{-1} P(0)^{-1} \preceq W(t) \preceq \kappa\, P(0)^{-1}

    so that (eq:cond0) holds with constants in every unit, whatever becomes of P(t). The default is
    below rounding wherever the observer has not reduced a standard deviation to less than
    :math:`10^{-8}` of the initial one, and changes the weight by 2 parts in :math:`10^{12}` at
    :math:`10^{-10}`. Constants for a certificate that is of use need a smaller number.

    With D the standard deviations and C the correlations of a covariance, its inverse is
    :math:`D^{-1} C^{-1} D^{-1}`, where eigenvalues of C below 1e-12, which are rounding, are raised
    to 1e-12, or to 3e-9 if the disturbance has fewer directions than the state, so that C may be
    singular. Where a Kalman filter continues from a root of its covariance, and the window's data
    determine what a vague prior leaves open, the weight comes from this root instead, unraised.
    States that are known exactly in P(0) count with the typical variance of
    `Cost.prior_variances` in the bounds.

    Parameters
    ----------
    kappa : float
        :math:`\kappa`, between 4 and 1e32.

    Raises
    ------
    OptionError
        If ``kappa`` is outside of these bounds.
    """

    __slots__ = ("kappa",)

    def __init__(self, kappa: float = LARGEST_KAPPA) -> None:
        found = finite(kappa)
        if found is None or not 4.0 <= found <= LARGEST_KAPPA:
            raise OptionError(
                f"kappa is {shown(kappa)}; expected a number from 4 to {LARGEST_KAPPA:g}: the "
                "largest factor between the prior's weight and the initial one."
            )
        self.kappa = found

    def weight(self, covariance: Array, least: float = SINGULAR) -> Array:
        """The inverse of a covariance (n, n), without the bounds.

        Eigenvalues of its correlations below ``least`` count as that.
        """
        return _relative_inverse(covariance, least)


def _relative_inverse(covariance: Array, least: float) -> Array:
    """The inverse by standard deviations and correlations, whatever the units."""
    variances = covariance.diagonal()
    deviations = np.sqrt(np.maximum(variances, _NO_VARIANCE))
    products = np.multiply.outer(deviations, deviations)
    values, vectors = np.linalg.eigh(covariance / products)
    weight: Array = (vectors / np.maximum(values, least)) @ vectors.T
    return weight / products


def is_regular(covariance: Array) -> bool:
    """Whether the correlations of a covariance have no eigenvalue of the size of rounding."""
    variances = covariance.diagonal()
    if not (variances > 0.0).all():
        return False
    deviations = np.sqrt(variances)
    return bool(
        np.linalg.eigvalsh(covariance / np.multiply.outer(deviations, deviations))[0] > SINGULAR
    )


class Cost(ABC):
    r"""A cost :math:`\gamma^K \Gamma(x_0 - \bar x) + \sum_{i<K} \gamma^{K-1-i} l(w_i, v_i)`.

    Create a `QuadraticCost` or a `RobustCost`. The terms are functions of quadratic forms: one
    joint weight of the residual (w, v), of shape (n + p, n + p), describes a stage, and the QP uses
    the weights that majorise the terms at its linearisation.

    Parameters
    ----------
    prior, disturbance, noise : array
        Weights of the initial error (n, n), of w (r, r) and of v (p, p); the first may be an
        `ObserverPrior`, or None for the default one. r is n, or the number of columns of the
        system's ``disturbance_matrix``.
    discount : float
        gamma, 1 for none.

    Attributes
    ----------
    p : int
        Number of outputs.
    """

    #: Whether the terms are the quadratic forms themselves, which makes weights constant.
    quadratic: bool = False

    #: F (r, s) where the covariance of w is singular: w is F times what ``disturbance`` weighs.
    disturbance_factor: Array | None = None

    #: The directions of the disturbances, of a `LiftedCost`; None for all.
    space: Subspace | None = None

    #: The largest factor by which a loss is widened while the first window fills; see `Barron`.
    graduation: float = 1.0

    #: Smaller eigenvalues of the correlations in an observer's covariance count as this.
    least_correlation: float = SINGULAR

    _own_joint: Array | None = None  # the stage weight that a subclass has set

    def __init__(
        self, prior: Array | ObserverPrior | None, disturbance: Array, noise: Array,
        discount: float,
    ) -> None:
        factor = finite(discount)
        if factor is None or not 0.0 < factor <= 1.0:
            raise OptionError(f"discount is {shown(discount)}; expected a number in (0, 1].")
        self.discount = factor
        self.prior: Array | ObserverPrior = ObserverPrior() if prior is None else prior
        self.disturbance, self.noise = disturbance, noise
        self.p = noise.shape[0]
        # By pattern, the least recently used first. Estimators in several threads may share it:
        # each of its methods is atomic, and a matrix that two of them compute is the same.
        self._partial: OrderedDict[bytes, Array] = OrderedDict()
        size = len(disturbance) + len(noise)
        self._kept = max(_KEPT_LEAST, _KEPT_BYTES // (8 * size * size))

    def __repr__(self) -> str:
        factor = self.disturbance_factor
        if factor is None:
            return representation(self)
        # The weight alone belongs to the factor's directions.
        covariance = factor @ inverse(self.disturbance) @ factor.T
        return representation(self, disturbance=None, disturbance_covariance=covariance)

    @property
    def r(self) -> int:
        """Dimension of the disturbance w."""
        factor = self.disturbance_factor
        return len(self.disturbance if factor is None else factor)

    @property
    def n(self) -> int:
        """Number of states; with an `ObserverPrior`, which has none, the dimension of w."""
        return self.r if isinstance(self.prior, ObserverPrior) else len(self.prior)

    def directions(self, matrix: Array | None) -> Array | None:
        """The matrix that maps what ``disturbance`` weighs to states; None for the identity.

        Parameters
        ----------
        matrix : (n, r) array or None
            The system's ``disturbance_matrix``.
        """
        factor = self.disturbance_factor
        if matrix is None or factor is None:
            return factor if matrix is None else matrix
        return matrix @ factor

    @property
    def observer_prior(self) -> ObserverPrior | None:
        """The rule that takes the prior weight from the observer's covariance, if there is one."""
        return self.prior if isinstance(self.prior, ObserverPrior) else None

    def least_prior(self, covariance: Array | None) -> Array:
        """A lower bound (n, n) on the weight of the initial error.

        With an `ObserverPrior` it is relative to the observer's initial ``covariance``, and zero
        where that is singular.
        """
        if not isinstance(self.prior, ObserverPrior):
            return self.prior
        if covariance is None or not is_regular(covariance):
            return np.zeros((self.n, self.n))
        return np.asarray(self.initial_weight(covariance) / self.prior.kappa)

    def graduated(self, progress: float) -> Cost:
        """The surrogate cost when a share ``progress`` of the first window is full."""
        return self

    @property
    def c_form(self) -> CostForm | None:
        """The cost's data for the step in C; None if C cannot compute it."""
        return None

    def prior_deviations(self, covariance: Array | None, matrix: Array | None = None) -> Array:
        """Typical magnitudes of the states: roots of `prior_variances(covariance, matrix)`."""
        deviations: Array = np.sqrt(self.prior_variances(covariance, matrix))
        return deviations

    def prior_variances(self, covariance: Array | None, matrix: Array | None = None) -> Array:
        """Variances (n,) of the initial error, as typical squares of the states.

        The disturbance's variance replaces a smaller or missing one; 1 if both are missing.

        Parameters
        ----------
        covariance : (n, n) array or None
            The observer's covariance of the initial error, for an `ObserverPrior`.
        matrix : (n, r) array or None
            The system's ``disturbance_matrix``.
        """
        spread, directions = inverse(self.disturbance), self.directions(matrix)
        variances: Array = (
            spread.diagonal() if directions is None
            else np.einsum("ij,jk,ik->i", directions, spread, directions)
        )
        if not isinstance(self.prior, ObserverPrior):
            covariance = inverse(self.prior)
        if covariance is not None and covariance.shape == (variances.size, variances.size):
            initial = covariance.diagonal()
            variances = np.where(np.isfinite(initial), np.fmax(variances, initial), variances)
        return np.where(variances > 0.0, variances, 1.0)

    @property
    @abstractmethod
    def constants(self) -> CostConstants | None:
        """The constants of (eq:exp_bounds); None if the cost has none."""

    def constants_with(self, covariance: Array | None) -> CostConstants | None:
        """The constants with an observer of this initial covariance (n, n), None if it has none.

        The same as `constants`, except with an `ObserverPrior`: its bounds are relative to the
        covariance. None where that is singular.
        """
        rule = self.observer_prior
        if rule is None or covariance is None or not is_regular(covariance):
            return self.constants
        found = self._with_prior(self.initial_weight(covariance)).constants
        if found is None:
            return None
        low, high = found.prior
        return replace(found, prior=(low / rule.kappa, high * rule.kappa))

    def _with_prior(self, weight: Array) -> Cost:
        """The same cost with a constant weight of the prior."""
        other = copy(self)
        other.prior = weight
        return other

    @abstractmethod
    def stage_costs(self, residuals: Array, weights: Array) -> Array:
        """l(w, v) of residuals (w, v), (K, n + p), for the weights of all stages or of each."""

    @abstractmethod
    def majorise(self, residuals: Array, weights: Array) -> Array:
        """Weights W of quadratic forms that touch the stage costs at the residuals r.

        ``r^T W s`` is half the derivative of l at r in direction s; for exponents up to 2
        the form also lies above l, up to a constant. Residuals and weights are as for
        `stage_costs`; W has the shape of the weights, or (K, n + p, n + p).
        """

    @abstractmethod
    def prior_cost(self, offset: Array, weight: Array) -> float:
        """Gamma of an offset (n,), x_0 minus the prior, with the prior's weight (n, n)."""

    @abstractmethod
    def majorise_prior(self, offset: Array, weight: Array) -> Array:
        """The prior's counterpart of `majorise`, for offset and weight as of `prior_cost`."""

    def stage_hessian(self, residuals: Array, weights: Array) -> Array:
        """Second derivatives (K, n + p, n + p) of the stage costs; see `stage_costs`."""
        raise self._no_second_derivatives()

    def stage_weight_gradient(
        self, residuals: Array, directions: Array, weights: Array
    ) -> Array:
        """Derivatives by the weights of the slopes of the stage costs in some directions.

        ``directions`` are (..., K, n + p), and the derivatives symmetric (..., K, r + p, r + p), by
        ``weights`` of (w, v); for both and ``residuals`` see `stage_costs`.
        """
        raise self._no_second_derivatives()

    def prior_hessian(self, offset: Array, weight: Array) -> Array:
        """Second derivative (n, n) of the prior's cost; see `prior_cost`."""
        raise self._no_second_derivatives()

    def prior_weight_gradient(
        self, offset: Array, directions: Array, weight: Array
    ) -> Array:
        """The prior's counterpart: (..., n) to (..., n, n); see `stage_weight_gradient`."""
        raise self._no_second_derivatives()

    def _no_second_derivatives(self) -> InvalidInputError:
        return InvalidInputError(
            f"{type(self).__name__} has no second derivatives; use qpmhe.QuadraticCost or "
            "qpmhe.RobustCost, or implement stage_hessian, stage_weight_gradient, prior_hessian "
            "and prior_weight_gradient."
        )

    @property
    def stage_weight(self) -> Array:
        """The joint weight (r + p, r + p) of w and v; a subclass may set another one."""
        return self.joint_weight(self.noise) if self._own_joint is None else self._own_joint

    @stage_weight.setter
    def stage_weight(self, weight: Array) -> None:
        self._own_joint = weight

    def joint_weight(self, noise: Array | None, disturbance: Array | None = None) -> Array:
        """The weight of (w, v), of ``disturbance`` and ``noise``; None is the usual weight."""
        size = self.disturbance.shape[0]
        joint = np.zeros((size + self.p, size + self.p))
        joint[:size, :size] = self.disturbance if disturbance is None else disturbance
        joint[size:, size:] = self.noise if noise is None else noise
        return joint

    def with_weights(self, noise: Array | None, disturbance: Array | None) -> Cost:
        """The step's cost with other usual weights ``noise``, ``disturbance``; None keeps one."""
        other = copy(self)
        if noise is not None:
            other.noise = noise
        if disturbance is not None:
            other.disturbance = disturbance
        other._own_joint = None
        other._partial = OrderedDict()
        return other

    def initial_weight(self, covariance: Array | None) -> Array:
        """The weight of the initial error, given the observer's covariance of it if it has one."""
        if self.observer_prior is None or covariance is None:
            return np.asarray(self.prior)
        return self.observer_prior.weight(covariance, self.least_correlation)

    def check_weights(
        self, noise: Array | None, disturbance: Array | None
    ) -> None:
        """Raise a `WeightError` unless it can use ``noise`` and ``disturbance`` at a sample."""

    def partial_weight(
        self, observed: Mask, noise: Array | None = None, disturbance: Array | None = None
    ) -> Array:
        """The stage weight where only the observed components of y are there, (p,) bool.

        It is zero on the others; those there weigh the inverse of their block of the covariance
        of the noise. This sample may come with other weights, ``noise`` and ``disturbance``.
        """
        if noise is not None or disturbance is not None:
            return self.joint_weight(
                reduced(self.noise if noise is None else noise, observed), disturbance
            )
        key = observed.tobytes()
        joint = self._partial.pop(key, None)
        if joint is None:
            joint = self.joint_weight(reduced(self.noise, observed))
            joint.flags.writeable = False
        self._partial[key] = joint
        if len(self._partial) > self._kept:
            with suppress(KeyError):  # other threads may have emptied it meanwhile
                self._partial.popitem(last=False)
        return joint

    def reduction(self, observed: Mask, noise: Array | None = None) -> Array:
        """A matrix T (p, p) with T R T' the weight of the observed components of y alone.

        R is ``noise``, or the usual weight. To first order in changes of R, T is a constant.
        """
        weight, gone = self.noise if noise is None else noise, ~observed
        matrix = np.diag(observed.astype(np.float64))
        if gone.any() and observed.any():
            rest = solve(weight[np.ix_(gone, gone)], weight[np.ix_(gone, observed)])
            matrix[np.ix_(observed, gone)] = -rest.T
        return matrix


def reduced(weight: Array, observed: Mask) -> Array:
    """The weight (d, d) of the observed components alone, zero on the others."""
    found, there = np.zeros_like(weight), np.flatnonzero(observed)
    if there.size:
        block = inverse(weight)[np.ix_(there, there)]
        found[np.ix_(there, there)] = inverse(block)
    return found


def quadratic_form(residuals: Array, weights: Array) -> Array:
    """r^T W r of each row of residuals, for one weight or one a row."""
    if weights.ndim == 2:
        form: Array = np.einsum("ki,ki->k", residuals @ weights, residuals)
    else:
        form = np.einsum("ki,kij,kj->k", residuals, weights, residuals)
    return form


def both_ways(left: Array, right: Array) -> Array:
    """The symmetric matrices ``left right' + right left'`` of vectors (..., d)."""
    product = left[..., :, None] * right[..., None, :]
    return np.asarray(product + np.swapaxes(product, -1, -2))
