"""A cost in the dimension of the states, for disturbances of a lower one."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np

from .._checks import Array
from .base import Cost, CostConstants, CostForm, quadratic_form
from .subspace import Subspace

# Rounding of 1 / s in a prior's weight is as large as the error of s in place of an eigenvalue 0.
_LEAST = 3e-9


class LiftedCost(Cost):
    r"""The user's cost of w, as a cost of :math:`d = x^+ - f(x)`.

    With B, :math:`B^+` and N of a `Subspace`, it is the user's cost of :math:`(B^+ d, v)`. Its
    weight of d is :math:`B^{+\top} W B^+ + s N N^\top`: the last term, which makes it regular and
    is of the size of the first, is zero for every d in the range of B, and no other d is that of an
    estimate.

    Parameters
    ----------
    cost : Cost
        The user's.
    space : Subspace
        The directions of the disturbances.
    """

    least_correlation = _LEAST

    def __init__(self, cost: Cost, space: Subspace) -> None:
        self._cost, self.quadratic, self.graduation = cost, cost.quadratic, cost.graduation
        self.space: Subspace = space
        self._stand_in = _of_size(space, space.inverse.T @ cost.disturbance @ space.inverse)
        eye = np.eye(cost.p)
        self._lift, self._range = _blocks(space.inverse, eye), _blocks(space.directions, eye)
        weight = self._lifted(cost.disturbance)
        assert weight is not None
        super().__init__(cost.prior, weight, cost.noise, cost.discount)

    def __getattr__(self, name: str) -> Any:
        """What only the user's cost has, such as the numbers of a further term."""
        if name.startswith("_"):  # a copy that is being made has no user's cost yet
            raise AttributeError(name)
        return getattr(self._cost, name)

    def graduated(self, progress: float) -> Cost:
        """The user's surrogate; see `Cost.graduated`."""
        found = copy(self)
        found._cost = self._cost.graduated(progress)
        return found

    @property
    def c_form(self) -> CostForm | None:
        """The user's with the weight of d; None where the loss of w is not quadratic."""
        form = self._cost.c_form
        if form is None or form.losses[1].kind != "quadratic":
            return None
        return form._replace(disturbance=self.disturbance, noise=self.noise)

    @property
    def constants(self) -> CostConstants | None:
        """None: no number bounds the cost of a disturbance in a noise-free direction."""
        return None

    def stage_costs(self, residuals: Array, weights: Array) -> Array:
        """The user's cost of the disturbances; see `Cost.stage_costs`."""
        if self.quadratic:
            return quadratic_form(residuals, weights)
        return self._cost.stage_costs(residuals @ self._lift.T, self._lowered(weights))

    def majorise(self, residuals: Array, weights: Array) -> Array:
        """Forms that majorise the user's cost; see `Cost.majorise`."""
        if self.quadratic:
            return weights
        forms = self._cost.majorise(residuals @ self._lift.T, self._lowered(weights))
        lifted: Array = self._lift.T @ forms @ self._lift
        n = len(self._stand_in)
        lifted[..., :n, :n] += self._stand_in
        return lifted

    def _lowered(self, weights: Array) -> Array:
        """The user's weights (..., s + p, s + p), from those of d and v."""
        lowered: Array = self._range.T @ weights @ self._range
        return lowered

    def prior_cost(self, offset: Array, weight: Array) -> float:
        """The user's; see `Cost.prior_cost`."""
        return self._cost.prior_cost(offset, weight)

    def majorise_prior(self, offset: Array, weight: Array) -> Array:
        """The user's; see `Cost.majorise_prior`."""
        return self._cost.majorise_prior(offset, weight)

    def stage_hessian(self, residuals: Array, weights: Array) -> Array:
        """The user's, of d; see `Cost.stage_hessian`."""
        if self.quadratic:
            return self._cost.stage_hessian(residuals, weights)
        bent = self._cost.stage_hessian(residuals @ self._lift.T, self._lowered(weights))
        lifted: Array = self._lift.T @ bent @ self._lift
        n = len(self._stand_in)
        lifted[..., :n, :n] += 2.0 * self._stand_in
        return lifted

    def stage_weight_gradient(self, residuals: Array, directions: Array, weights: Array) -> Array:
        """By the user's weights; see `Cost.stage_weight_gradient`."""
        along = residuals @ self._lift.T, directions @ self._lift.T
        return self._cost.stage_weight_gradient(*along, self._lowered(weights))

    def prior_hessian(self, offset: Array, weight: Array) -> Array:
        """The user's; see `Cost.prior_hessian`."""
        return self._cost.prior_hessian(offset, weight)

    def prior_weight_gradient(self, offset: Array, directions: Array, weight: Array) -> Array:
        """The user's; see `Cost.prior_weight_gradient`."""
        return self._cost.prior_weight_gradient(offset, directions, weight)

    def joint_weight(self, noise: Array | None, disturbance: Array | None = None) -> Array:
        """The weight of (d, v) with a weight (r, r) of w; see `Cost.joint_weight`."""
        return super().joint_weight(noise, self._lifted(disturbance))

    def with_weights(self, noise: Array | None, disturbance: Array | None) -> Cost:
        """With another usual weight (r, r) of w; see `Cost.with_weights`."""
        return super().with_weights(noise, self._lifted(disturbance))

    def _lifted(self, disturbance: Array | None) -> Array | None:
        if disturbance is None:
            return None
        weight = self.space.inverse.T @ disturbance @ self.space.inverse + self._stand_in
        return np.asarray(0.5 * (weight + weight.T))


def lifted(cost: Cost, matrix: Array | None, covariance: Array | None) -> Cost:
    """The cost in the dimension of the states: itself, unless disturbances have a lower one.

    ``matrix`` is the system's ``disturbance_matrix``, ``covariance`` the observer's initial one.
    """
    directions = cost.directions(matrix)
    if directions is None:
        return cost
    return LiftedCost(
        cost, Subspace(directions, matrix, cost.prior_variances(covariance, matrix))
    )


def _of_size(space: Subspace, weight: Array) -> Array:
    """N N' times a power of two, of the size of the disturbances' weight in the same units.

    If it were of the prior's size, a vague prior would make the two together ill-conditioned.
    """
    scaled = weight * np.multiply.outer(space.scale, space.scale)
    exponent = np.frexp(scaled.diagonal().max(initial=0.0))[1]
    return np.asarray(np.ldexp(space.stand_in, exponent))


def _blocks(first: Array, second: Array) -> Array:
    """The block diagonal matrix of two."""
    (rows, columns), (more_rows, more_columns) = first.shape, second.shape
    joint = np.zeros((rows + more_rows, columns + more_columns))
    joint[:rows, :columns], joint[rows:, columns:] = first, second
    return joint
