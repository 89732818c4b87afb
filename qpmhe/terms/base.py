"""What a term of J is, and what it reads: the data of a window, and a trajectory along them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP
from qpmhe_solvers.qp import band_of

from .._linalg import cholesky
from ..costs import Cost
from ..model.sets import ConvexSet
from ..observers.roots import whitened
from .linearization import Span
from .rows import Rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class OwnSets(Protocol):
    """The sets with other sides of a stage; None where it has the usual ones."""

    @property
    def states(self) -> ConvexSet | None:
        """X."""

    @property
    def disturbances(self) -> ConvexSet | None:
        """W."""

    @property
    def noises(self) -> ConvexSet | None:
        """V."""


class WindowView(Protocol):
    """The candidate of a window, and what is computed from it alone; arrays may be views."""

    @property
    def candidate(self) -> Array:
        """The observer's trajectory (K + 1, n)."""

    @property
    def prior(self) -> Array:
        """Its first state (n,)."""

    @property
    def span(self) -> Span:
        """Its linearised stages; unknown without ``has_terms``."""


class WindowData(Protocol):
    """What terms read of a window of K stages; arrays may be views."""

    #: Whether there are QPs.
    has_terms: bool
    #: A mean (n,) of the prior in place of the observer's state.
    smoothed_prior: Array | None
    #: Trusted values (2, k) of the parameters that are held: of this window, and of the next.
    trusted: Array | None
    #: Whether any stage may weigh its disturbance in its own way.
    has_disturbance_weights: bool

    def candidate_cost_of(self, view: Any) -> float:
        """What the stages add to J of the candidate in a view."""

    @property
    def discounts(self) -> Array:
        """Factors of the prior's cost and of the stages', (K + 1,)."""

    @property
    def stage_weights(self) -> Array:
        """Weights of the stages' cost, before the discount; one, or one for each stage."""

    @property
    def majorising_weights(self) -> Array:
        """The same of the form that majorises the cost at the candidate."""

    @property
    def has_special_weights(self) -> bool:
        """Whether each stage has a weight."""

    @property
    def observed(self) -> Mask:
        """Which components of y are not missing, (K, p)."""

    @property
    def has_own_bounds(self) -> bool:
        """Whether some stage has sets with other sides."""

    @property
    def conditions(self) -> Sequence[OwnSets]:
        """The sets of each stage."""

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance (n, n) at its first state, if it has one."""

    @property
    def prior_root(self) -> Array | None:
        """A root U (n, n) of that covariance U'U, where only the root has all digits."""

    @property
    def last_covariance(self) -> Array | None:
        """The observer's covariance (n, n) at its last state, if it has one."""


@dataclass(slots=True)
class Trial:
    """A state trajectory, evaluated.

    Attributes
    ----------
    trajectory, residuals : array
        States (K + 1, n), and joint residuals (w, v) of the stages (K, n + p).
    weights : (n + p, n + p) or (K, n + p, n + p) array
        Weights of the quadratic form that majorises the stages' cost here, discount included.
    cost : float
        J, or infinity if a constraint is violated or the model fails. The candidate's is its
        true J in any case.
    violation : float
        The largest violation of a row in its scale (see `Rows`), infinity if the model fails.
    error : Exception or None
        What the model or the cost raised.
    values : (K + 1, T) array or None
        Values of the nonlinear constraints, if there are any; see `ConstraintFunctions.values`.
    penalty : float
        The part of the cost that soft sets and soft constraints add.
    """

    trajectory: Array
    residuals: Array
    weights: Array
    cost: float
    violation: float = 0.0
    error: Exception | None = None
    values: Array | None = None
    penalty: float = 0.0


class QuadraticModel:
    """Half of the quadratic form that majorises J near a trajectory: a QP, and what it is made of.

    Attributes
    ----------
    band, gradient : array
        (K + 1, n, 2n) and (K + 1, n), as of `QP`; the terms add theirs.
    first_band, earlier_band, last_band : array
        The band of the first state, of all but the last one, and of the last one: views.
    first_gradient, inner_gradient, last_gradient : array
        The gradient of the first state, of those between, and of the last one: views.
    span : Span
        The stages, linearised along the trajectory.
    is_candidate : bool
        Whether that is the candidate: the span then has the stages' terms without the discount.
    slopes : (array, array) or None
        Derivatives of the nonlinear constraints by each state and the next, (K + 1, T, n).
    """

    __slots__ = (
        "band", "earlier_band", "first_band", "first_gradient", "gradient", "inner_gradient",
        "is_candidate", "last_band", "last_gradient", "slopes", "span",
    )

    span: Span
    is_candidate: bool
    slopes: tuple[Array, Array] | None

    def __init__(self, qp: QP) -> None:
        self.band, self.gradient = band, gradient = qp.band, qp.gradient
        self.first_band, self.earlier_band, self.last_band = band[0], band[:-1], band[-1]
        self.first_gradient, self.inner_gradient = gradient[0], gradient[1:-1]
        self.last_gradient = gradient[-1]


class Derivatives:
    """Derivatives of J along a trajectory, by its states themselves and by its residuals.

    Attributes
    ----------
    on_states, on_residuals : (K + 1, n) and (K, q) array
        First derivatives.
    bent_states, bent_residuals : (K + 1, n, n) and (K, q, q) array
        Second derivatives.
    majorised_states, majorised_residuals : array
        Twice the weights of the quadratic forms that majorise the terms.
    aged_states, aged_residuals : array
        Derivatives of the first ones by the discount.
    """

    def __init__(self, count: int, n: int, q: int) -> None:
        self.on_states, self.aged_states = np.zeros((2, count + 1, n))
        self.on_residuals, self.aged_residuals = np.zeros((2, count, q))
        self.bent_states, self.majorised_states = np.zeros((2, count + 1, n, n))
        self.bent_residuals, self.majorised_residuals = np.zeros((2, count, q, q))


class TermDerivative(ABC):
    """The derivatives of one term along a trajectory: copies, which outlive the step.

    Attributes
    ----------
    data : tuple of str
        What the term depends on, by the names of `Gradient`.
    """

    data: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def add_to(self, sums: Derivatives) -> None:
        """Add the derivatives by states and residuals."""

    def by(self, name: str, states: Array, residuals: Array) -> Array:
        """The derivative by some data of the term's slope in some directions.

        The directions are (..., K + 1, n) of the states, and (..., K, q) of the residuals that
        change with them.
        """
        raise NotImplementedError

    def change(
        self, data: Mapping[str, Array], states: Array, residuals: Array
    ) -> None:
        """Add the change (..., K + 1, n), (..., K, q) of the first derivatives with the data."""


class TermForm(NamedTuple):
    """A term in the first state as the step in C computes it: by ``codegen/c/NAME.c``.

    That part has three functions: ``mhe_NAME_begin`` before a step, ``mhe_NAME_cost``, and
    ``mhe_NAME_add``, which adds weight and force to the QP.

    Attributes
    ----------
    name : str
        NAME; the numbers are ``settings->NAME`` there.
    data : mapping
        The numbers: real ones, or integers of 32 bits.
    """

    name: str
    data: Mapping[str, NDArray[Any]]


class SoftRows(NamedTuple):
    """Rows that a term penalises, along a trajectory: (K, r) or (K + 1, r) arrays.

    Attributes
    ----------
    rows : Rows
        Their set.
    values, lower, upper : array
        Their values and sides.
    linear, quadratic : array
        What a miss and its square cost.
    """

    rows: Rows
    values: Array
    lower: Array
    upper: Array
    linear: Array
    quadratic: Array


class Term(ABC):
    """One term of J for one window, fixed before the step."""

    @abstractmethod
    def cost(self, trial: Trial) -> float:
        """The term's value along a trajectory; may raise what a user's functions raise."""

    def cost_of_candidate(self, candidate: Trial) -> float:
        """Its value for the candidate."""
        return self.cost(candidate)

    @abstractmethod
    def add_model(self, model: QuadraticModel, trial: Trial) -> None:
        """Add half of the quadratic form that majorises the term near a trajectory."""

    @abstractmethod
    def magnitude(self, trial: Trial) -> float:
        """The sum of the absolute values that cancel in the term, as far as it is a square."""

    def add_weights(self, diagonal: Array) -> None:
        """Add the term's weights of x_0 and w, untouched by a loss, to a diagonal (K + 1, n)."""

    def with_cost(self, cost: Cost) -> Term:
        """The term with another cost of the stages."""
        return self

    def weight_of_first(self, trial: Trial) -> Array | None:
        """Weight (n, n) of the form that majorises a term in the first state; None of others."""
        return None

    def diagonal_of_first(self, trial: Trial) -> Array | None:
        """The diagonal (n,) of that weight."""
        weight = self.weight_of_first(trial)
        return None if weight is None else weight.diagonal()

    def root_of_first(self, trial: Trial) -> Array | None:
        """A root R (n, n) of that weight R'R, where only the root has all digits."""
        return None

    def derivative(self, trial: Trial) -> TermDerivative | None:
        """The derivatives along a trajectory; None of soft rows, see `soft_rows`."""
        return None

    def soft_rows(self, trial: Trial) -> Iterator[SoftRows]:
        """The rows that the term penalises."""
        yield from ()


class FirstStateTerm(Term):
    """A term in the first state of the window, with the discount of the prior.

    Attributes
    ----------
    band : (n, 2n) array or None
        The panel of its weight, where that is the same along all trajectories.
    """

    band: Array | None = None

    @abstractmethod
    def weight_of_first(self, trial: Trial) -> Array:
        """Weight (n, n) of the quadratic form that majorises the term."""

    @abstractmethod
    def force(self, trial: Trial) -> Array | None:
        """Half the derivative (n,) of the term by the state; None where it is zero."""

    def rows_of_first(self, trial: Trial) -> tuple[Array, Array]:
        """R (k, n) and s (k,): the quadratic form is |R d + s|^2, and a constant."""
        root, force = cholesky(self.weight_of_first(trial)).T, self.force(trial)
        return root, np.zeros(len(root)) if force is None else whitened(root, force)

    def add_model(self, model: QuadraticModel, trial: Trial) -> None:
        """Add weight and force; see `Term.add_model`."""
        band, mine, force = model.first_band, self.band, self.force(trial)
        band += band_of(self.weight_of_first(trial)) if mine is None else mine
        if force is not None:
            model.first_gradient += force


class FirstStateDerivative(TermDerivative):
    """The derivatives of a term in the first state.

    Parameters
    ----------
    force, bent, majorised : array
        First derivative (n,), second one and twice the weight (n, n).
    age : float
        By which the derivative by the discount exceeds the first one.
    """

    def __init__(self, force: Array, bent: Array, majorised: Array, age: float) -> None:
        self.force, self.bent, self.majorised, self.age = force, bent, majorised, age

    def add_to(self, sums: Derivatives) -> None:
        """Add to the first state; see `TermDerivative.add_to`."""
        sums.on_states[0] += self.force
        sums.bent_states[0] += self.bent
        sums.majorised_states[0] += self.majorised
        sums.aged_states[0] += self.age * self.force


def read_only(array: Array) -> Array:
    """A view that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view
