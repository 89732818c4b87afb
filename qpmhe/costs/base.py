"""What every cost offers: weights for the QP, values for the verdict."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import finite, shown

from .._checks import Array
from ..errors import OptionError

__all__ = ["Cost", "CostConstants", "ObserverPrior", "quadratic_form"]

Mask = NDArray[np.bool_]

# Weights for patterns of missing components are kept up to so many bytes, and a few in any case.
_KEPT_BYTES = 2**22
_KEPT_LEAST = 8


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


class ObserverPrior:
    r"""Weigh the prior z(t-N) with the inverse of the observer's own covariance at t-N.

    With a Kalman-type observer on a linear system, the estimator then equals the Kalman
    filter for every horizon. The eigenvalues of the weight are clipped to stated bounds,
    so that (eq:cond0) holds with :math:`\underline c_p` and :math:`\overline c_p` equal
    to them.

    Parameters
    ----------
    minimum, maximum : float
        Bounds on the eigenvalues of the prior weight (inverse of squared state units); an
        `OptionError` is raised unless 0 < minimum < maximum < infinity.
    """

    __slots__ = ("maximum", "minimum")

    def __init__(self, minimum: float = 1e-12, maximum: float = 1e12) -> None:
        low, high = finite(minimum), finite(maximum)
        if low is None or high is None or not 0.0 < low < high:
            raise OptionError(
                f"minimum is {shown(minimum)} and maximum {shown(maximum)}; "
                "expected finite numbers with 0 < minimum < maximum."
            )
        self.minimum, self.maximum = low, high

    def weight(self, covariance: Array) -> Array:
        """The clipped inverse of a covariance (n, n)."""
        values, vectors = np.linalg.eigh(covariance)
        with np.errstate(divide="ignore"):
            inverse = np.where(values > 0.0, 1.0 / values, self.maximum)
        clipped = np.clip(inverse, self.minimum, self.maximum)
        weight: Array = (vectors * clipped) @ vectors.T
        return weight


class Cost(ABC):
    r"""A cost :math:`\gamma^K \Gamma(x_0 - \bar x) + \sum_{i<K} \gamma^{K-1-i} l(w_i, v_i)`.

    Make a `QuadraticCost` or a `RobustCost`. The terms are functions of quadratic forms, so
    that a stage is described by one joint weight of the residual (w, v), of shape
    (n + p, n + p), and the QP by the weights that majorise the terms where it is built.

    Parameters
    ----------
    prior, disturbance, noise : array
        Weights of the initial error (n, n) or the `ObserverPrior` for it, of w and of v (p, p).
    discount : float
        gamma, 1 for none.

    Attributes
    ----------
    n, p : int
        Numbers of states and outputs.
    stage_weight : (n + p, n + p) array
        The weights of w and v as one.
    """

    #: Whether the terms are the quadratic forms themselves, which makes weights constant.
    quadratic: bool = False

    def __init__(
        self, prior: Array | ObserverPrior, disturbance: Array, noise: Array, discount: float
    ) -> None:
        factor = finite(discount)
        if factor is None or not 0.0 < factor <= 1.0:
            raise OptionError(f"discount is {shown(discount)}; expected a number in (0, 1].")
        self.discount = factor
        self.prior, self.disturbance, self.noise = prior, disturbance, noise
        self.n, self.p = disturbance.shape[0], noise.shape[0]
        self.stage_weight = self.joint_weight(noise)
        # By pattern, the least recently used first. Estimators in several threads may share it:
        # each of its methods is atomic, and a matrix that two of them compute is the same.
        self._partial: OrderedDict[bytes, Array] = OrderedDict()
        self._kept = max(_KEPT_LEAST, _KEPT_BYTES // self.stage_weight.nbytes)

    @property
    def observer_prior(self) -> ObserverPrior | None:
        """The rule by which the observer's covariance gives the prior weight, if there is one."""
        return self.prior if isinstance(self.prior, ObserverPrior) else None

    @property
    @abstractmethod
    def constants(self) -> CostConstants | None:
        """The constants of (eq:exp_bounds), or None if the cost has none."""

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

    def joint_weight(self, noise: Array | None) -> Array:
        """The weight of (w, v) with this weight (p, p) of the noise v; None for the usual one."""
        joint = np.zeros((self.n + self.p, self.n + self.p))
        joint[: self.n, : self.n] = self.disturbance
        joint[self.n :, self.n :] = self.noise if noise is None else noise
        return joint

    def check_noise(self, noise: Array) -> None:  # noqa: B027 - most costs take any weight
        """Raise a `WeightError` unless the cost can use this noise weight (p, p) of one sample."""

    def partial_weight(self, observed: Mask, noise: Array | None = None) -> Array:
        """The stage weight where only the observed components of y are there, (p,) bool.

        It is zero on the others; those there weigh the inverse of their block of the covariance
        of the noise, of which this sample may have a weight of its own.
        """
        if noise is not None:
            return self._reduced(observed, noise)
        key = observed.tobytes()
        joint = self._partial.pop(key, None)
        if joint is None:
            joint = self._reduced(observed, self.noise)
            joint.flags.writeable = False
        self._partial[key] = joint
        if len(self._partial) > self._kept:
            with suppress(KeyError):  # other threads may have emptied it meanwhile
                self._partial.popitem(last=False)
        return joint

    def _reduced(self, observed: Mask, weight: Array) -> Array:
        reduced = np.zeros_like(weight)
        there = np.flatnonzero(observed)
        if there.size:
            block = np.linalg.inv(weight)[np.ix_(there, there)]
            reduced[np.ix_(there, there)] = np.linalg.inv(block)
        return self.joint_weight(reduced)


def quadratic_form(residuals: Array, weights: Array) -> Array:
    """r^T W r of each row of residuals, for one weight or one a row."""
    if weights.ndim == 2:
        form: Array = np.einsum("ki,ki->k", residuals @ weights, residuals)
    else:
        form = np.einsum("ki,kij,kj->k", residuals, weights, residuals)
    return form
