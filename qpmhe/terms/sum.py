"""J as a sum of terms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .._linalg import cholesky
from ..costs import Cost
from ..errors import OptionError
from ..model.system import System
from .base import FirstStateTerm, Term, TermForm, Trial, WindowData, WindowView
from .hold import Hold, WindowHold
from .prior import Prior, PriorCost
from .soft import Penalties
from .stages import StageCosts, Stages

Array = NDArray[np.float64]


class TermRule(Protocol):
    """A term of J for all windows of an estimator."""

    @property
    def c_form(self) -> TermForm | None:
        """The term as the step in C computes it; None if it cannot."""

    def of_window(self, window: WindowData, view: WindowView) -> Term:
        """The term of a window."""


class CostSum:
    r"""J of all windows of an estimator.

    .. math::
        J = \sum_{i<K} \gamma^{K-1-i} l(w_i, v_i) + \gamma^K \Gamma(x_0 - \bar x) + \dots

    Sums are made in the order of the terms: the stages, which alone say something about every
    state, come first; then the prior, the hold, and what only some estimators have.

    Parameters
    ----------
    system, cost
        Those of the estimator.
    prior : PriorCost
        The prior of its windows.
    basis : (n, r) array
        The directions in which there are disturbances.
    """

    def __init__(self, system: System, cost: Cost, prior: PriorCost, basis: Array) -> None:
        self._stages, self._prior = StageCosts(cost), prior
        self._hold: Hold | None = None
        if system.held:
            self._hold = Hold(
                system.held, prior.covariance, basis, cost.disturbance, cost.discount
            )
        penalties = Penalties(system, cost, prior.covariance)
        #: The soft sets and soft constraints; None without any.
        self.penalties: Penalties | None = penalties if penalties else None
        # What not every estimator has, in the order of the sum; a new term joins here.
        self._others: list[TermRule] = [one for one in (self.penalties,) if one is not None]

    @property
    def c_forms(self) -> tuple[TermForm, ...]:
        """The terms that not every estimator has, as the step in C computes them.

        Raises an `OptionError` where it cannot compute one.
        """
        rules: list[TermRule] = [*(() if self._hold is None else (self._hold,)), *self._others]
        forms = []
        for one in rules:
            form = one.c_form
            if form is None:
                raise OptionError(
                    f"the step in C has no {type(one).__name__}; take engine='python'."
                )
            forms.append(form)
        return tuple(forms)

    def of_window(
        self, window: WindowData, view: WindowView, weights: Array
    ) -> tuple[Prior, WindowHold | None, tuple[Term, ...]]:
        """The prior and the hold of a window, and all of its terms in the order of the sum.

        ``weights`` are its ``stage_weights``.
        """
        stages = Stages(self._stages, window, view, weights)
        prior, hold = self._prior.of_window(window, view), None
        terms: tuple[Term, ...] = (stages, prior)
        if self._hold is not None:
            hold = self._hold.of_window(window, view)
            if hold is not None:
                terms = (*terms, hold)
        for one in self._others:
            terms = (*terms, one.of_window(window, view))
        return prior, hold, terms


def weight_of_first(terms: Sequence[Term], trial: Trial) -> Array:
    """Weight (n, n) of the first state in the form that majorises J near a trajectory."""
    found = np.zeros((trial.trajectory.shape[1],) * 2)
    for term in terms:
        weight = term.weight_of_first(trial)
        if weight is not None:
            found += weight
    return found


def root_of_first(terms: Sequence[Term], trial: Trial) -> Array | None:
    """Rows (k, n) whose square is `weight_of_first`, where that has lost digits; else None."""
    roots = [term.root_of_first(trial) for term in terms]
    if all(root is None for root in roots):
        return None
    weights = [term.weight_of_first(trial) for term in terms]
    return np.concatenate([
        cholesky(weight).T if root is None else root
        for root, weight in zip(roots, weights, strict=True) if weight is not None
    ])


def rows_of_first(terms: Sequence[Term], trial: Trial) -> tuple[Array, Array]:
    """R (k, n) and s (k,) with which J has |R d + s|^2 near the first state of a trajectory."""
    found = [term.rows_of_first(trial) for term in terms if isinstance(term, FirstStateTerm)]
    return np.concatenate([rows for rows, _ in found]), np.concatenate([side for _, side in found])
