"""The prior's term of J, and its weight from the observer's covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from .._linalg import cholesky, inverse
from ..costs import Cost
from ..model.functions import contained
from ..model.residuals import difference
from ..model.system import System
from ..observers import Observer
from ..observers.roots import triangle
from .base import FirstStateDerivative, FirstStateTerm, Trial, WindowData, WindowView
from .forms import WholeForm

Array = NDArray[np.float64]

#: A variance of the observer's below the first share of the typical one is none; in the prior's
#: weight it counts as the second share.
NO_VARIANCE, KNOWN = 1e-30, 1e-16


#: The weight comes from a root of the covariance where this loses fewer digits: always, where QPs
#: take its rows as they are, as an elimination does. Where they take its square: with r the least
#: variance of a component given those before it, as a share of its variance, and d the largest
#: factor by which the window's data reduce a variance, rounding of the weight has a share of
#: eps / (r d) in a variance behind the window, and the least eigenvalue l of an inverse one of l d.
_LOST = float(np.finfo(np.float64).eps)

#: A root whose r is below this is one of a singular covariance: it has only rounding in a
#: direction, and J would have nothing else.
_SINGULAR = 1e-26


class InitialWeight(NamedTuple):
    """The prior's weight, and one to judge its distance by.

    A state that is known exactly has a large weight in the first, and the weight of its typical
    magnitude in the second. The roots R are those of R'R, where only they have all digits.
    """

    weight: Array
    distance: Array
    root: Array | None = None
    distance_root: Array | None = None


class PriorWeights:
    """The rule by which the observer's covariance gives the prior's weight.

    Attributes
    ----------
    typical : (n,) array or None
        Typical variances of the states, where an observer's may be zero; None where it cannot.
    added, least : (n, n) array
        What `ObserverPrior` adds to each covariance, and to its inverse; zero for a constant
        weight.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self._cost, covariance = cost, observer.initial_covariance()
        self.typical: Array | None = None
        if covariance is not None and (cost.space is not None or not covariance.diagonal().all()):
            scales = system.scales
            self.typical = cost.prior_variances(covariance) if scales is None else scales * scales
        rule = cost.observer_prior
        self.added: Array = np.broadcast_to(0.0, (system.n, system.n))
        self.least = self.added
        self._varies = rule is not None and covariance is not None
        fixed = system.disturbances is not None and system.disturbances.fixed_components.size > 0
        # Whether there are noise-free directions, which are eliminated.
        self._takes_rows = fixed or (cost.space is not None and cost.space.noise_free.shape[1] > 0)
        if rule is not None and covariance is not None and covariance.shape == self.added.shape:
            _, first = self._regular(covariance)
            self.added = 2.0 / rule.kappa * first
            self.least = cost.initial_weight(first) / rule.kappa

    def __call__(
        self, covariance: Array | None, root: Array | None = None, later: Array | None = None
    ) -> InitialWeight:
        """The weights for an observer's covariance.

        With a root of it where that has more digits, and the covariance behind the window.
        """
        cost = self._cost
        if covariance is None or not self._varies:
            weight = cost.initial_weight(covariance)
            return InitialWeight(weight, weight)
        own = cholesky(covariance).T if root is None and self._takes_rows else root
        found = None if own is None else self._from_root(covariance, own, later, root is not None)
        if found is not None and found.distance_root is not None:
            return found
        nearly, regular = self._regular(covariance + self.added)
        if found is not None:
            return found._replace(distance=cost.initial_weight(regular) + self.least)
        weight = cost.initial_weight(nearly) + self.least
        if regular is nearly:
            return InitialWeight(weight, weight)
        return InitialWeight(weight, cost.initial_weight(regular) + self.least)

    def _from_root(
        self, covariance: Array, root: Array, later: Array | None, is_observers: bool
    ) -> InitialWeight | None:
        """From the root, unless the covariance's inverse is nearer: see `_LOST`.

        Without a root for the distance where this has no digits: in a direction of hardly any
        variance, rounding is none.
        """
        variances = self._variances(covariance + self.added)
        wider = [
            triangle(np.concatenate((root, cholesky(self.added + one).T)))
            for one in variances or (0.0,)
        ]
        is_sure = is_observers and later is not None and self._has_digits(wider[0], later)
        if not (self._is_regular(wider[0]) if self._takes_rows else is_sure):
            return None
        least = cholesky(self.least).T
        near, *others = (triangle(np.concatenate((np.linalg.inv(one).T, least))) for one in wider)
        far = others[0] if others else near
        return InitialWeight(near.T @ near, far.T @ far, near, far if is_sure else None)

    @staticmethod
    def _is_regular(root: Array) -> bool:
        """Whether a root has more than rounding in each direction."""
        return bool((root.diagonal() ** 2 / (root**2).sum(axis=0)).min() > _SINGULAR)

    def _has_digits(self, root: Array, later: Array) -> bool:
        """Whether a root's inverse keeps more digits than the covariance's: see `_LOST`."""
        own, behind = (root**2).sum(axis=0), later.diagonal()
        pivot = (root.diagonal() ** 2 / own).min()
        shrunk = (own / np.where(behind > 0.0, behind, np.inf)).max()
        return bool(pivot * self._cost.least_correlation * shrunk * shrunk > _LOST)

    def _regular(self, covariance: Array) -> tuple[Array, Array]:
        """The covariance with a small and with a typical variance of states known exactly."""
        variances = self._variances(covariance)
        if variances is None:
            return covariance, covariance
        return covariance + variances[0], covariance + variances[1]

    def _variances(self, covariance: Array) -> tuple[Array, Array] | None:
        """Small and typical variances (n, n) of states known exactly; None where there is none."""
        typical = self.typical
        if typical is None:
            return None
        known = covariance.diagonal() <= NO_VARIANCE * typical
        if not known.any():
            return None
        small, usual = (np.diag(np.where(known, one, 0.0)) for one in (KNOWN * typical, typical))
        return small, usual


class PriorCost:
    """The prior of all windows: its rule, and the cost of an offset.

    Parameters
    ----------
    system, observer, cost
        Those of the estimator.
    form : WholeForm, optional
        How matrices are held.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, form: WholeForm | None = None
    ) -> None:
        self.form = form or WholeForm(system.n, system.p)
        self.cost, self.residual = cost, system.state_residual
        self.quadratic, self.discounted = cost.quadratic, cost.discount < 1.0
        #: Whether the weight of a window is that of its quadratic form along all trajectories.
        self.is_constant = self.quadratic and not self.discounted
        #: Whether the observer's covariance gives the weight.
        self.follows = cost.observer_prior is not None
        self.evaluate = contained(cost.prior_cost)
        #: The weights of the initial error, for the observer's covariance.
        self.weights = PriorWeights(system, observer, cost)
        covariance = observer.initial_covariance()
        #: Weight of the initial error of the first window, and one to judge its distance by.
        self.first: InitialWeight = self.weights(covariance)
        self.first_band = self.form.band(self.first.weight)
        if self.form.by_entries:  # it has no root
            weight = self.form.symmetric(self.first.weight)
            self.first = InitialWeight(weight, weight)

    @property
    def covariance(self) -> Array:
        """Covariance of the initial error, regular."""
        return inverse(self.form.matrix(self.first.distance))

    def of_window(self, window: WindowData, view: WindowView) -> Prior:
        """The prior of a window."""
        prior = Prior(self, view)
        if self.follows and (covariance := window.prior_covariance) is not None:
            root = window.prior_root
            later = None if root is None else window.last_covariance
            prior.set_weight(self.weights(covariance, root, later))
        if self.discounted:
            prior.factor = float(window.discounts[0])
            if self.quadratic and not self.follows:
                prior.band = prior.factor * self.first_band
        if window.smoothed_prior is not None:
            prior.move(window.smoothed_prior)
        return prior


class Prior(FirstStateTerm):
    r"""The prior's cost :math:`\gamma^K \Gamma(x_0 - \bar x)` of one window.

    Attributes
    ----------
    mean : (n,) array
        z(t-N) or, with ``arrival="smoothed"``, another one.
    factor : float
        gamma^K.
    weight : (n, n) array
        Weight of the initial error, before discount and majorisation.
    """

    # Class attributes as defaults: few of them change in most steps.
    factor: float = 1.0
    _moved_cost: float = 0.0  # of the candidate, where the mean is another

    def __init__(self, rule: PriorCost, view: WindowView) -> None:
        self._rule, self.mean = rule, view.prior
        # The trajectory that is known to start at the mean, if there is one.
        self._zero: Array | None = view.candidate
        self._initial, self.weight = rule.first, rule.first.weight
        if rule.is_constant:
            self.band = rule.first_band

    def set_weight(self, initial: InitialWeight) -> None:
        """Set another weight."""
        self._initial, self.weight = initial, initial.weight
        if self._rule.is_constant:
            self.band = band_of(initial.weight)

    def distance(self, offset: Array) -> float:
        """The squared distance of two states, in deviations of the prior."""
        initial = self._initial
        if initial.distance_root is None:
            return float(initial.distance.dot(offset).dot(offset))
        seen = initial.distance_root.dot(offset)
        return float(seen.dot(seen))

    def move(self, mean: Array) -> None:
        """Take another mean, unless the candidate has no finite cost there."""
        rule = self._rule
        try:
            offset = difference(rule.residual, self.mean, mean)  # the candidate's
            cost = self._lost(offset)
            self._majorised(offset)
        except Exception:  # a user's loss or residual
            return
        if math.isfinite(cost):
            self.mean, self._zero, self._moved_cost = mean, None, self.factor * cost

    def offset(self, trial: Trial) -> Array:
        """The initial error x_0 [-] mean of a trajectory."""
        residual, first = self._rule.residual, trial.trajectory[0]
        if residual is not None:
            return difference(residual, first, self.mean)
        offset: Array = first - self.mean
        return offset

    def _lost(self, offset: Array) -> float:
        """Gamma of an offset. With a root, of what the root makes of it: no digits cancel then."""
        rule, root, evaluate = self._rule, self._initial.root, self._rule.evaluate
        if root is None:
            if rule.form.by_entries:  # of a quadratic cost alone
                return float(self.weight.dot(offset).dot(offset))
            return float(evaluate(offset, self.weight))
        return float(evaluate(root.dot(offset), np.eye(len(root))))

    def _majorised(self, offset: Array) -> Array:
        """The weight, discounted and majorised at an offset."""
        root = self._root(offset)
        if root is not None:
            return root.T @ root
        weight, cost = self.weight, self._rule.cost
        if not cost.quadratic:
            weight = cost.majorise_prior(offset, weight)
        return weight if self.factor == 1.0 else self.factor * weight

    def _root(self, offset: Array) -> Array | None:
        """A root of `_majorised`, where the weight has one."""
        root, cost = self._initial.root, self._rule.cost
        if root is not None and not cost.quadratic:
            root = cholesky(cost.majorise_prior(root.dot(offset), np.eye(len(root)))).T @ root
        return root if root is None or self.factor == 1.0 else math.sqrt(self.factor) * root

    def _force(self, offset: Array) -> Array:
        """Half the derivative of the cost."""
        root = self._root(offset)
        force: Array = (
            self._majorised(offset).dot(offset) if root is None else root.T.dot(root.dot(offset))
        )
        return force

    def cost(self, trial: Trial) -> float:
        """Gamma of the initial error; see `Term.cost`."""
        rule = self._rule
        offset = trial.trajectory[0] - self.mean if rule.residual is None else self.offset(trial)
        if rule.quadratic and self._initial.root is None:
            return self.factor * float(self.weight.dot(offset).dot(offset))
        return float(self.factor * self._lost(offset))

    def cost_of_candidate(self, candidate: Trial) -> float:
        """0 exactly, where the mean is the candidate's first state."""
        return self._moved_cost

    def weight_of_first(self, trial: Trial) -> Array:
        """See `FirstStateTerm.weight_of_first`."""
        return self._rule.form.matrix(self._majorised(self.offset(trial)))

    def diagonal_of_first(self, trial: Trial) -> Array:
        """See `Term.diagonal_of_first`."""
        return np.asarray(self._majorised(self.offset(trial)).diagonal())

    def root_of_first(self, trial: Trial) -> Array | None:
        """See `Term.root_of_first`."""
        return self._root(self.offset(trial))

    def rows_of_first(self, trial: Trial) -> tuple[Array, Array]:
        """See `FirstStateTerm.rows_of_first`."""
        offset = self.offset(trial)
        root = self._root(offset)
        if root is None:
            root = cholesky(self._majorised(offset)).T
        if trial.trajectory is self._zero:
            return root, np.zeros(len(root))
        return root, root.dot(offset)

    def force(self, trial: Trial) -> Array | None:
        """See `FirstStateTerm.force`; None for a candidate that starts at the mean."""
        if trial.trajectory is self._zero:
            return None
        rule = self._rule
        if rule.is_constant and rule.residual is None and self._initial.root is None:
            force: Array = self.weight.dot(trial.trajectory[0] - self.mean)
            return force
        return self._force(self.offset(trial))

    def add_weights(self, diagonal: Array) -> None:
        """See `Term.add_weights`."""
        diagonal[0] += self.factor * self.weight.diagonal()

    def magnitude(self, trial: Trial) -> float:
        """See `Term.magnitude`."""
        offset, root = abs(self.offset(trial)), self._initial.root
        if root is None:
            return float(offset @ abs(self.weight) @ offset)
        seen = abs(root) @ offset
        return float(seen @ seen)

    def derivative(self, trial: Trial) -> PriorDerivative:
        """See `Term.derivative`."""
        cost, offset, matrix = self._rule.cost, self.offset(trial), self._rule.form.matrix
        return PriorDerivative(
            cost, offset, matrix(self.weight), self.factor, self._force(offset),
            matrix(self._majorised(offset)), len(trial.residuals) / cost.discount,
        )


class PriorDerivative(FirstStateDerivative):
    """The derivatives of a prior, also by its mean and its weight."""

    data = ("prior", "prior_weight")

    def __init__(
        self, cost: Cost, offset: Array, weight: Array, factor: float, force: Array,
        majorised: Array, age: float,
    ) -> None:
        bent = factor * cost.prior_hessian(offset, weight)
        super().__init__(2.0 * force, bent, 2.0 * majorised, age)
        self._cost, self._offset, self._weight, self._factor = cost, offset, weight, factor

    def _by_weight(self, directions: Array) -> Array:
        return self._cost.prior_weight_gradient(self._offset, directions, self._weight)

    def by(self, name: str, states: Array, residuals: Array) -> Array:
        """See `TermDerivative.by`."""
        if name == "prior":
            return np.asarray(-(states[..., 0, :] @ self.bent))
        return self._factor * self._by_weight(states[..., 0, :])

    def change(self, data: Mapping[str, Array], states: Array, residuals: Array) -> None:
        """See `TermDerivative.change`."""
        states[..., 0, :] -= data["prior"] @ self.bent
        by_weight = self._by_weight(np.eye(self._offset.size))
        states[..., 0, :] += self._factor * np.einsum(
            "iab,...ab->...i", by_weight, data["prior_weight"]
        )
