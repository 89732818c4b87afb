"""The hold: a term that keeps parameters where they were while a window does not excite them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_of

from .._linalg import cholesky, inverse, solve
from ..costs import Cost
from ..model.system import System
from .base import FirstStateDerivative, FirstStateTerm, TermForm, Trial, WindowData, WindowView
from .information import prior_units, window_information

Array = NDArray[np.float64]


class Hold:
    r"""What holds the parameters of all windows, in deviations of the first prior.

    The window's data add :math:`\Lambda` to what the first prior, of covariance :math:`\Pi`, says
    of the window's first state. Of the held parameters, :math:`\theta = L \eta` with
    :math:`\Pi_{\theta\theta} = L L^\top`, this leaves the share

    .. math::
        E = L^{-1} \left[(\Pi^{-1} + \Lambda)^{-1}\right]_{\theta\theta} L^{-\top}
        = V \operatorname{diag}\Big(\frac{1}{1 + s_i}\Big) V^\top

    of the prior's variance: :math:`s_i` is the singular value of direction i, with the other
    states eliminated. See `WindowHold` for what is done with them.

    Parameters
    ----------
    held : mapping
        By the index of a state, within how many deviations of the prior it is held.
    prior : (n, n) array
        Covariance of the initial error.
    basis : (n, r) array
        The directions in which there are disturbances.
    disturbance : (n, n) array
        Weight of the disturbances.
    discount : float
        gamma.
    """

    name: ClassVar[str] = "held parameters"

    def __init__(
        self, held: Mapping[int, float], prior: Array, basis: Array, disturbance: Array,
        discount: float,
    ) -> None:
        self.discount = discount
        #: Which states are held.
        self.components = components = np.array(list(held), np.intp)
        self.stiffness: Array = 1.0 / np.array(list(held.values()))
        #: Of all states; the matrices below are in these.
        self.deviations: Array = np.sqrt(prior.diagonal())
        scaled = prior / np.multiply.outer(self.deviations, self.deviations)
        self.root, _ = prior_units(scaled)
        self.units, self.inverse_units = prior_units(prior[np.ix_(components, components)])
        rows = self.deviations[components, None] * self.root[components]
        self.pick: Array = self.inverse_units @ rows
        spread = cholesky(inverse(basis.T @ disturbance @ basis)) if basis.size else basis.T @ basis
        spread = basis @ spread / self.deviations[:, None]
        self.spread: Array = spread @ spread.T

    @staticmethod
    def belongs(system: System, cost: Cost) -> bool:
        """Whether the system holds parameters."""
        del cost
        return bool(system.held)

    @classmethod
    def of(cls, system: System, cost: Cost, prior: Array, basis: Array) -> Hold:
        """The hold of a system's parameters."""
        return cls(system.held, prior, basis, cost.disturbance, cost.discount)

    @property
    def c_form(self) -> TermForm:
        """The hold in C."""
        names = (
            "deviations", "root", "spread", "pick", "units", "inverse_units", "stiffness",
            "components",
        )
        return TermForm("hold", {name: getattr(self, name) for name in names})

    def of_window(self, window: WindowData, view: WindowView) -> WindowHold | None:
        """The hold of a window; None where no QP chooses the parameters."""
        if window.trusted is None or not window.has_terms:
            return None
        n, count = self.deviations.size, self.components.size
        noise = window.stage_weights[..., n:, n:]
        jacobian = view.span.minus_jacobian * -self.deviations
        a, c = jacobian[:, :n] / self.deviations[:, None], jacobian[:, n:]
        seen = c.transpose(0, 2, 1) @ noise @ c
        values, vectors = np.zeros(count), np.eye(count)  # of numbers beyond all measure
        with suppress(np.linalg.LinAlgError):
            matrix = self.root.T @ window_information(a, seen, self.spread) @ self.root
            left = self.pick @ np.linalg.solve(np.eye(n) + matrix, self.pick.T)
            if np.isfinite(left).all():
                left, vectors = np.linalg.eigh(0.5 * (left + left.T))
                values = (1.0 - left) / np.maximum(left, 0.0)
        factor = float(window.discounts[0]) if self.discount < 1.0 else 1.0
        return WindowHold(self, values, vectors, window.trusted[0], factor)


class WindowHold(FirstStateTerm):
    r"""The hold of one window, fixed before its step.

    With the singular values s of `Hold`, their directions V and the deviations D, J of every
    trajectory, the candidate's too, has the term :math:`|\theta_0 - \bar\theta|_H^2`, discounted as
    the prior is, with

    .. math::
        H = L^{-\top} D^{-1} \Phi^2 D^{-1} L^{-1}, \qquad
        \Phi = V \operatorname{diag}(\min(1, 1/s_i)) V^\top

    What the data see no better than the first prior is held fully, and what they see well is free.
    There, the trusted value follows the estimate, with more caution: while excitation fades, the
    last windows know less and less.

    .. math::
        \bar\theta^+ = \bar\theta + L (I + D^{-1} \Phi D^{-1})^{-1} (I - \Phi) L^{-1}
        (\hat\theta - \bar\theta)

    Attributes
    ----------
    components : (k,) array of int
        The states that are held.
    target : (k,) array
        The trusted values, in the parameters' units.
    values : (k,) array
        Singular values s, the best seen direction first.
    shares : (k,) array
        Fraction of the full hold on each parameter: 0 where the window sees it well, 1 where it
        does not.
    weight : (k, k) array
        H.
    """

    def __init__(
        self, hold: Hold, values: Array, vectors: Array, target: Array, factor: float
    ) -> None:
        self.components, self.target, self.values = hold.components, target, values
        self._factor, self._discount = factor, hold.discount
        # Whatever is not a number above 1 is not seen.
        unseen = 1.0 / np.where(values > 1.0, values, 1.0)
        inner, held = ((vectors * one) @ vectors.T for one in (unseen, unseen * unseen))
        self.shares: Array = held.diagonal().copy()
        eye, stiff = np.eye(unseen.size), np.multiply.outer(hold.stiffness, hold.stiffness)
        self.weight: Array = hold.inverse_units.T @ (stiff * held) @ hold.inverse_units
        self._follow = hold.units @ solve(eye + stiff * inner, eye - inner) @ hold.inverse_units
        n = hold.deviations.size
        # H among the weights of all states, discounted.
        self._whole: Array = np.zeros((n, n))
        self._whole[np.ix_(self.components, self.components)] = factor * self.weight
        self.band = band_of(self._whole)

    def _offset(self, trial: Trial) -> Array:
        offset: Array = trial.trajectory[0, self.components] - self.target
        return offset

    def cost(self, trial: Trial) -> float:
        """See `Term.cost`."""
        offset = self._offset(trial)
        return self._factor * float(offset.dot(self.weight).dot(offset))

    def weight_of_first(self, trial: Trial) -> Array:
        """See `FirstStateTerm.weight_of_first`."""
        return self._whole

    def force(self, trial: Trial) -> Array:
        """See `FirstStateTerm.force`."""
        found = np.zeros(len(self._whole))
        found[self.components] = self._factor * self.weight.dot(self._offset(trial))
        return found

    def magnitude(self, trial: Trial) -> float:
        """See `Term.magnitude`."""
        offset = abs(self._offset(trial))
        return float(offset @ abs(self.weight) @ offset)

    def derivative(self, trial: Trial) -> FirstStateDerivative:
        """Without that of the data: weight and trusted values are fixed before the step."""
        bent = 2.0 * self.weight_of_first(trial)
        age = len(trial.residuals) / self._discount
        return FirstStateDerivative(2.0 * self.force(trial), bent, bent, age)

    def followed(self, estimate: Array) -> Array:
        """The trusted values after an estimate (n,) of the next window's first state."""
        moved: Array = self.target + self._follow.dot(estimate[self.components] - self.target)
        return moved
