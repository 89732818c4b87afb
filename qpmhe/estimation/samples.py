"""The samples of a window, with their weights and conditions, and views of their stages."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..memory.fields import MemorySizes
from ..memory.record import MemoryRecord
from ..model.system import System
from ..terms.forms import WholeForm
from .conditions import USUAL, Conditions
from .limits import LARGEST, LEAST_DISCOUNT
from .stages import StageView, Views, WindowArrays

Array = NDArray[np.float64]

# Views are made in advance up to this horizon: beyond it they would take more memory than the
# arrays, and making them is a small part of a step.
_KEPT = 1000


class WindowSamples(MemoryRecord):
    """Samples y(t-N), ..., y(t-1) with the observer's states z(t-N), ..., z(t).

    Here t is ``time``, the number of samples taken: y(t-1) is the newest, and x(t) is estimated.
    """

    def __init__(
        self, system: System, cost: Cost, sizes: MemorySizes, initial_state: Array,
        covariance: Array | None, with_terms: bool, form: WholeForm,
    ) -> None:
        usual = form.usual_weight(cost)
        super().__init__(sizes, initial_state, covariance, system.dt or 0.0, usual)
        horizon, room = self.horizon, self.room
        self._system, self._cost, self._form, self._stage_weight = system, cost, form, usual
        #: Whether the stages have the terms of QPs.
        self.has_terms: bool = with_terms
        self._n, self._m = system.n, system.m
        self._quadratic = cost.quadratic
        self.terms = form.terms(room, self.linear, self.panel, self.gradient, self.next_gradient)
        # Views of each stage, and of each full window by its first stage.
        self._stage_views: Sequence[StageView] = Views(
            room, lambda k: StageView(self, self.terms, k)
        )
        self._window_views: Sequence[WindowArrays] = Views(
            room + 1 - horizon, lambda k: WindowArrays(self, self.terms, k, k + horizon)
        )
        if horizon <= _KEPT:
            self._stage_views = list(self._stage_views)
            self._window_views = list(self._window_views)
        #: Whether any stage may weigh its disturbance in its own way.
        self.has_disturbance_weights: bool = not cost.quadratic
        self._ones = np.ones(horizon)
        # gamma^N for the prior of a full window, then gamma^(N-1), ..., gamma^0 for its stages.
        self._discounts = (
            np.maximum(cost.discount ** np.arange(horizon, -1, -1.0), LEAST_DISCOUNT)
            if cost.discount < 1 else None
        )

    @property
    def view(self) -> WindowArrays:
        """The views of the present window, which has at least one stage."""
        if self.end - self.start < self.horizon:
            return WindowArrays(self, self.terms, self.start, self.end)
        return self._window_views[self.start]

    @property
    def newest_failed(self) -> bool:
        """Whether the newest stage could not be evaluated."""
        return not math.isfinite(self.cost[self.end - 1])

    @property
    def candidate(self) -> Array:
        """Candidate trajectory z(t-N), ..., z(t) (eq:warmstart): a view."""
        return self.z[self.start : self.end + 1]

    @property
    def residuals(self) -> Array:
        """Joint residuals (L(i), v_z(i)) of the candidate: a view."""
        return self.terms.residuals[self.start : self.end]

    @property
    def measurements(self) -> Array:
        """y, with any number where it is missing: a view."""
        return self.y[self.start : self.end]

    @property
    def weights(self) -> Array:
        """The stages' weights, usual or not: a view."""
        return self.weight[self.start : self.end]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which components of y are not missing: a view."""
        return self.is_observed[self.start : self.end]

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance at z(t-N), if it has one."""
        return None if self.covariance is None else self.covariance[self.start]

    @property
    def prior_root(self) -> Array | None:
        """A root of that covariance, where only the root has all digits."""
        return self.root_at(self.start)

    def root_at(self, k: int) -> Array | None:
        """The root of the observer's covariance before stage k, where it has one."""
        return self.root[k] if self.root is not None and self.is_vague[k] else None

    @property
    def last_covariance(self) -> Array | None:
        """The observer's covariance at z(t), if it has one."""
        return None if self.covariance is None else self.covariance[self.end]

    @property
    def initial_state(self) -> Array:
        """The first state of the window."""
        state: Array = self.z[self.start].copy()
        return state

    @property
    def has_special_weights(self) -> bool:
        """Whether some sample of the window came with another weight."""
        return self.unusual and bool(np.count_nonzero(self.is_special[self.start : self.end]))

    @property
    def has_irregular_steps(self) -> bool:
        """Whether some stage of the window has a step of unusual length."""
        return self.unusual and bool(np.count_nonzero(self.is_irregular[self.start : self.end]))

    @property
    def has_own_bounds(self) -> bool:
        """Whether some stage of the window has sets with other sides."""
        return bool(self.own) and any(own.has_bounds for own in self.own.values())

    @property
    def conditions(self) -> list[Conditions]:
        """The conditions of each stage."""
        return [self.own.get(t, USUAL) for t in range(self.time - self.length, self.time)]

    def _find_observed(self, k: int, time: int) -> NDArray[np.bool_] | None:
        """Mark the missing components of y at stage k; return which are there, or None for all."""
        y = self._stage_views[k].y
        if not math.isfinite(y.dot(y)):
            self.unusual = True  # first: undoing makes usual again what an interrupt leaves
            self.is_observed[k] = np.abs(y) < LARGEST  # False for NaN, too
            self._set_weight(k, time)
        elif not self.unusual or False not in self.is_observed[k].tolist():
            return None
        observed: NDArray[np.bool_] = self.is_observed[k]
        return observed

    def _is_missing(self, time: int, observed: NDArray[np.bool_]) -> bool:
        """Whether a component was sampled that is not there."""
        sampled = self.own.get(time, USUAL).sampled
        if sampled is None:
            return True
        return sampled.tobytes() != observed.tobytes() and bool((sampled & ~observed).any())

    def _set_weight(self, k: int, time: int) -> None:
        """Set the weight of stage k from its observed components and its own weights."""
        own, observed = self.own.get(time, USUAL), self.is_observed[k]
        weights = own.noise_weight, own.disturbance_weight
        if weights[1] is not None:
            self.has_disturbance_weights = True
        if False in observed.tolist():  # NumPy's `all` takes ten times as long
            self._stage_views[k].y[~observed] = 0.0  # any number: its weight is zero
            self.weight[k] = self._form.partial_weight(self._cost, observed, *weights)
            self.is_special[k] = self.unusual = True
            return
        weight = usual = self._stage_weight
        if any(one is not None for one in weights):
            weight = self._form.weight(self._cost, *weights)
        self.weight[k] = weight
        # A usual weight that was given as its own is as good as none.
        self.is_special[k] = weight is not usual and not np.array_equal(weight, usual)
        self.unusual |= bool(self.is_special[k])

    @property
    def observer_state(self) -> Array:
        """z(t), the observer's newest state: a view."""
        newest: Array = self.z[self.end]
        return newest

    @property
    def candidate_cost(self) -> float:
        """J of the candidate; its prior term is 0 exactly."""
        return self.candidate_cost_of(self.view)

    def candidate_cost_of(self, view: WindowArrays) -> float:
        """J of the candidate, from the window's present view."""
        costs = view.costs
        if self._discounts is None:
            return float(costs.dot(self._ones[: costs.size]))
        return float(costs.dot(self.discounts[1:]))

    @property
    def discounts(self) -> Array:
        """gamma^K for the prior's cost, then gamma^(K-1), ..., gamma^0 for the K stages'."""
        if self._discounts is None:
            return np.ones(self.length + 1)
        return self._discounts[self.horizon - self.length :]

    @property
    def inputs(self) -> Array:
        """The inputs u, and the step lengths in a last column if some are irregular: a view."""
        columns = None if self.has_irregular_steps else self._m
        return self.u[self.start : self.end, :columns]

    @property
    def model(self) -> System:
        """The system that takes `inputs`, step lengths included."""
        return self._system.timed if self.has_irregular_steps else self._system

    @property
    def stage_weights(self) -> Array:
        """One weight for all stages (q, q), or one for each where some is special."""
        return self.weights if self.has_special_weights else self._stage_weight

    @property
    def majorising_weights(self) -> Array:
        """`stage_weights` of the quadratic form that majorises the cost at the candidate."""
        if self._cost.quadratic:
            return self.stage_weights
        return self.majorising_weight[self.start : self.end]
