"""A cost with selectable losses."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.errors import report_unknown_options

from .._checks import Array, check_prior_size, positive_definite, representation
from ..errors import InvalidInputError
from .base import Cost, CostConstants, CostForm, ObserverPrior
from .contracts import check_loss
from .losses import Loss, Quadratic


@report_unknown_options
class RobustCost(Cost):
    r"""A cost with a loss for each of prior, disturbance and noise.

    .. math::
        \Gamma(\chi, \bar x) = \rho_p(\chi - \bar x), \qquad
        l(\omega, \nu) = \rho_w(\omega) + \rho_v(\nu)

    Assumption ass:stagecosts requires one exponent a in all three terms. Otherwise `constants` is
    None, and the theorem does not apply.

    Parameters
    ----------
    prior : Loss, (n, n) array_like or ObserverPrior, optional
        Loss of the initial error; a matrix stands for `Quadratic`. If left out, the loss is
        quadratic, and its weight comes from the covariance of a Kalman-type observer, as
        `ObserverPrior` says; another observer needs a weight here.
    disturbance, noise : Loss or array_like
        Losses of w and v, such as `Huber` or `Power`; a matrix stands for `Quadratic`.
    discount : float
        As for `QuadraticCost`.

    Raises
    ------
    WeightError, ShapeError, OptionError
        If a weight is not symmetric positive definite, dimensions differ, or the discount is
        outside (0, 1].
    ModelError
        If a loss of your own returns a wrong shape, or a value or slope below zero.
    """

    def __init__(
        self, *, prior: Loss | ArrayLike | ObserverPrior | None = None,
        disturbance: Loss | ArrayLike, noise: Loss | ArrayLike, discount: float = 1.0,
    ) -> None:
        self.disturbance_loss = _loss("disturbance", disturbance)
        self.noise_loss = _loss("noise", noise)
        for loss in (self.disturbance_loss, self.noise_loss):
            check_loss(loss)
        r = self.disturbance_loss.dimension
        weight: Array | ObserverPrior | None
        if prior is None or isinstance(prior, ObserverPrior):
            weight = prior
            self.prior_loss: Loss = Quadratic(np.eye(r))
        else:
            self.prior_loss = _loss("prior", prior)
            check_loss(self.prior_loss)
            weight = check_prior_size(positive_definite("prior", self.prior_loss.weight), r)
        self.graduation = max(self.disturbance_loss.graduation, self.noise_loss.graduation)
        super().__init__(weight, self.disturbance_loss.weight, self.noise_loss.weight, discount)

    def __repr__(self) -> str:
        prior = self.prior if self.observer_prior is not None else self.prior_loss
        return representation(
            self, prior=prior, disturbance=self.disturbance_loss, noise=self.noise_loss
        )

    @property
    def c_form(self) -> CostForm | None:
        """Weights and losses; None where a derived class may compute another cost or loss."""
        prior, disturbance, noise = (
            loss.c_form for loss in (self.prior_loss, self.disturbance_loss, self.noise_loss)
        )
        if type(self) is not RobustCost:
            return None
        if prior is None or disturbance is None or noise is None:
            return None
        losses = prior, disturbance, noise
        weight = None if isinstance(self.prior, ObserverPrior) else self.prior
        return CostForm(weight, self.disturbance, self.noise, self.discount, losses)

    @property
    def constants(self) -> CostConstants | None:
        """The constants of (eq:exp_bounds), if all losses have one exponent, undiscounted.

        With an `ObserverPrior`, `constants_with` finds them.
        """
        if self.discount < 1.0 or isinstance(self.prior, ObserverPrior):
            return None
        losses = (self.prior_loss, self.disturbance_loss, self.noise_loss)
        exponent = self.noise_loss.exponent
        if exponent is None or any(loss.exponent != exponent for loss in losses):
            return None
        prior, disturbance, noise = (loss.constants() for loss in losses)
        if prior is None or disturbance is None or noise is None:
            return None
        return CostConstants(exponent, prior, disturbance, noise)

    def _with_prior(self, weight: Array) -> RobustCost:
        other = copy(self)
        other.prior, other.prior_loss = weight, Quadratic(weight)
        return other

    def stage_costs(self, residuals: Array, weights: Array) -> Array:
        """The losses of w and v added; see `Cost.stage_costs`."""
        r = self.r
        w_cost = self.disturbance_loss.cost(residuals[:, :r], weights[..., :r, :r])
        return np.add(w_cost, self.noise_loss.cost(residuals[:, r:], weights[..., r:, r:]))

    def majorise(self, residuals: Array, weights: Array) -> Array:
        """Reweighted forms; see `Cost.majorise`."""
        r, q = self.r, self.r + self.p
        joint = np.zeros((residuals.shape[0], q, q))
        joint[:, :r, :r] = self.disturbance_loss.majorise(residuals[:, :r], weights[..., :r, :r])
        joint[:, r:, r:] = self.noise_loss.majorise(residuals[:, r:], weights[..., r:, r:])
        return joint

    def check_weights(self, noise: Array | None, disturbance: Array | None) -> None:
        """Check that a weight is diagonal where its loss is per component; see `Cost`."""
        if noise is not None:
            self.noise_loss.check_weight(noise)
        if disturbance is not None:
            self.disturbance_loss.check_weight(disturbance)

    def graduated(self, progress: float) -> RobustCost:
        """The cost with widened losses; see `Cost.graduated`."""
        found = copy(self)
        for name in ("disturbance_loss", "noise_loss"):
            loss: Loss = getattr(self, name)
            setattr(found, name, loss.widened(loss.graduation ** (1.0 - progress)))
        return found

    def prior_cost(self, offset: Array, weight: Array) -> float:
        """The loss of the initial error; see `Cost.prior_cost`."""
        return float(self.prior_loss.cost(offset[None], weight)[0])

    def majorise_prior(self, offset: Array, weight: Array) -> Array:
        """A reweighted form; see `Cost.majorise_prior`."""
        value: Array = self.prior_loss.majorise(offset[None], weight)[0]
        return value

    def stage_hessian(self, residuals: Array, weights: Array) -> Array:
        """See `Cost.stage_hessian`."""
        if type(self).stage_costs is not RobustCost.stage_costs:
            raise self._no_second_derivatives()
        r, q = self.r, self.r + self.p
        joint = np.zeros((residuals.shape[0], q, q))
        joint[:, :r, :r] = self.disturbance_loss.hessian(residuals[:, :r], weights[..., :r, :r])
        joint[:, r:, r:] = self.noise_loss.hessian(residuals[:, r:], weights[..., r:, r:])
        return joint

    def stage_weight_gradient(self, residuals: Array, directions: Array, weights: Array) -> Array:
        """See `Cost.stage_weight_gradient`."""
        r, q = self.r, self.r + self.p
        joint = np.zeros((*directions.shape, q))
        for loss, part in ((self.disturbance_loss, slice(r)), (self.noise_loss, slice(r, q))):
            joint[..., part, part] = loss.weight_gradient(
                residuals[:, part], directions[..., part], weights[..., part, part]
            )
        return joint

    def prior_hessian(self, offset: Array, weight: Array) -> Array:
        """See `Cost.prior_hessian`."""
        value: Array = self.prior_loss.hessian(offset[None], weight)[0]
        return value

    def prior_weight_gradient(self, offset: Array, directions: Array, weight: Array) -> Array:
        """See `Cost.prior_weight_gradient`."""
        found = self.prior_loss.weight_gradient(offset[None], directions[..., None, :], weight)
        value: Array = found[..., 0, :, :]
        return value


def _loss(name: str, given: Loss | ArrayLike) -> Loss:
    if isinstance(given, Loss):
        return given
    if isinstance(given, ObserverPrior):
        raise InvalidInputError(f"{name} is {given!r}; expected a loss or a weight matrix.")
    return Quadratic(positive_definite(name, given))
