"""J as a sum of terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from .._linalg import cholesky
from ..costs import Cost
from ..errors import OptionError
from ..model.system import System
from .base import FirstStateTerm, Term, TermForm, Trial, WindowData, WindowView
from .forms import WholeForm
from .hold import Hold, WindowHold
from .prior import Prior, PriorCost
from .soft import Penalties
from .stages import StageCosts, Stages

Array = NDArray[np.float64]


class TermRule(Protocol):
    """A term of J for all windows of an estimator, which not every estimator has."""

    #: What it is of, in words, for those who do not have it.
    name: ClassVar[str]

    @staticmethod
    def belongs(system: System, cost: Cost) -> bool:
        """Whether an estimator of these has the term."""

    @classmethod
    def of(cls, system: System, cost: Cost, prior: Array, basis: Array) -> TermRule | None:
        """The term, with the covariance of the first prior and the basis of `CostSum`.

        None where it is always zero.
        """

    @property
    def c_form(self) -> TermForm | None:
        """The term as the step in C computes it; None if it cannot."""

    def of_window(self, window: WindowData, view: WindowView) -> Term | None:
        """The term of a window; None where it is zero for all trajectories."""


#: The terms that not every estimator has, in the order of the sum; a new one joins here.
KINDS: list[type[TermRule]] = [Hold, Penalties]


def further_terms(system: System, cost: Cost, known: Sequence[type[TermRule]] = ()) -> str:
    """What J has beside its stages, its prior and the terms known to the caller, in words.

    Who states something about J without its sum asks here, and refuses what it does not know.
    Blank where J has nothing else.

    Parameters
    ----------
    system, cost
        Those of the estimator.
    known : sequence of TermRule classes
        Terms that the caller has, or refuses itself.
    """
    return " and ".join(
        kind.name for kind in KINDS if kind not in known and kind.belongs(system, cost)
    )


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
    basis : callable
        Makes the directions (n, r) in which there are disturbances, where a term asks for them.
    form : WholeForm, optional
        How matrices are held.
    """

    def __init__(
        self, system: System, cost: Cost, prior: PriorCost, basis: Callable[[], Array],
        form: WholeForm | None = None,
    ) -> None:
        form = form or WholeForm(system.n, system.p)
        self._stages, self._prior = StageCosts(cost, form), prior
        #: The terms that not every estimator has, in the order of the sum.
        self._further: list[TermRule] = [
            one for kind in KINDS if kind.belongs(system, cost)
            if (one := kind.of(system, cost, prior.covariance, basis())) is not None
        ]
        #: The soft sets and soft constraints; None without any.
        self.penalties: Penalties | None = next(
            (one for one in self._further if isinstance(one, Penalties)), None
        )

    @property
    def c_forms(self) -> tuple[TermForm, ...]:
        """The terms that not every estimator has, as the step in C computes them.

        Raises an `OptionError` where it cannot compute one.
        """
        forms = []
        for one in self._further:
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
        for one in self._further:
            term = one.of_window(window, view)
            if term is not None:
                terms = (*terms, term)
                if isinstance(term, WindowHold):
                    hold = term
        return prior, hold, terms


def weight_of_first(terms: Sequence[Term], trial: Trial) -> Array:
    """Weight (n, n) of the first state in the form that majorises J near a trajectory."""
    found = np.zeros((trial.trajectory.shape[1],) * 2)
    for term in terms:
        weight = term.weight_of_first(trial)
        if weight is not None:
            found += weight
    return found


def diagonal_of_first(terms: Sequence[Term], trial: Trial) -> Array:
    """The diagonal (n,) of `weight_of_first`."""
    found = np.zeros(trial.trajectory.shape[1])
    for term in terms:
        diagonal = term.diagonal_of_first(trial)
        if diagonal is not None:
            found += diagonal
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
