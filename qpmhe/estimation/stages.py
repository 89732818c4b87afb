"""The arrays of a sliding window, and how they slide."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from .._checks import positive_definite
from ..observers.projection import ErrorMetric
from ..terms.base import read_only
from ..terms.linearization import Span, Stage, StageTerms
from .conditions import Conditions
from .snapshot import check_size, checked_array, mismatch

Array = NDArray[np.float64]

# Views are made in advance up to this horizon: beyond it they would take more memory than the
# arrays, and making them is a small part of a step.
_KEPT = 1000
# Inputs, and costs and terms where the model fails.
_MAY_OVERFLOW = ("u", "costs", *StageTerms.names)
View = TypeVar("View")


class Mark(NamedTuple):
    """A point to which a window can be rolled back: the data that a sample changes."""

    start: int
    end: int
    time: int
    unusual: bool
    own: dict[int, Conditions]
    smoothed_prior: Array | None
    trusted: Array | None
    metric: tuple[Array, bool] | None
    arrays: dict[str, Array] | None


class Stages:
    """Samples and the data computed from them, stage by stage.

    The arrays are longer than the window, which slides along them; at the end its stages
    move back to the front. Thus every window is a plain slice. Row k of an array belongs to
    stage k, or to the state before it; the window consists of the stages ``start`` to ``end - 1``.

    A stage is *special* if its weight is not the usual one, *irregular* if its step length is not,
    and *unusual* if either holds. Its conditions are stored by its time.
    """

    def __init__(
        self,
        n: int,
        p: int,
        m: int,
        horizon: int,
        initial_state: Array,
        covariance: Array | None,
        stage_weight: Array,
        quadratic: bool,
        step: float,
        sensors: int = 0,
        with_roots: bool = False,
    ) -> None:
        self.horizon, self._step = horizon, step
        room = horizon + max(horizon // 4, 32)
        self.room = room
        self._z = np.zeros((room + 1, n))
        # The input of each stage, and in the last column the length of its step.
        self._y, self._u = np.zeros((room, p)), np.zeros((room, m + 1))
        self._u[:, m] = step
        self._irregular = np.zeros(room, dtype=np.bool_)
        self._observed = np.ones((room, p), dtype=np.bool_)
        # Stages where y is missing in part, or that have weights of their own.
        self._special = np.zeros(room, dtype=np.bool_)
        self._own: dict[int, Conditions] = {}  # of samples taken with other than the usual
        self._usual_weight = stage_weight
        self._weights = np.tile(stage_weight, (room, 1, 1))
        #: Whether any stage may weigh its disturbance in its own way.
        self.has_disturbance_weights: bool = not quadratic
        #: Whether any stage may be unusual; those from ``end`` on never are.
        self.unusual: bool = False
        # Weights of the quadratic form that majorises the cost at the candidate.
        self._majorising_weights = self._weights if quadratic else np.zeros((room, n + p, n + p))
        self._stage_costs = np.zeros(room)
        self.terms = StageTerms(room, n, p)
        self._covariances = None if covariance is None else np.zeros((room + 1, n, n))  # of z
        # Roots of those that have lost digits, and which have.
        self._roots = np.zeros((room + 1, n, n)) if with_roots else None
        self._vague = np.zeros(room + 1, np.bool_)
        # How often in a row each of the observer's sensors has failed, before each stage.
        self._rejections = np.zeros((room + 1, sensors), np.int64) if sensors else None
        # For observers and losses: a user's code cannot write into the window.
        self._read_only_covariances = (
            None if self._covariances is None else read_only(self._covariances)
        )
        self._read_only_weights = read_only(self._weights)
        self._read_only_residuals = read_only(self.terms.residuals)
        # Views of each stage, and of each full window by its first stage.
        self._stage_views: Sequence[StageView] = Views(room, partial(StageView, self))
        self._window_views: Sequence[WindowView] = Views(
            room + 1 - horizon, lambda k: WindowView(self, k, k + horizon)
        )
        if horizon <= _KEPT:
            self._stage_views = list(self._stage_views)
            self._window_views = list(self._window_views)
        #: Metric of the projection onto X, where the observer has no covariance.
        self.metric: ErrorMetric | None = None
        #: Prior mean in place of z(t-N), with ``arrival="smoothed"``; replaced, never changed.
        self.smoothed_prior: Array | None = None
        #: Trusted values of held parameters, (2, k): of this window, and of the next; replaced,
        #: never changed. None where none is held.
        self.trusted: Array | None = None
        self.time = 0  # number of samples pushed: the window ends at x(time)
        self.start = self.end = 0
        # Time up to which running observers have taken the samples; -1 makes them start again.
        self._advanced_to = -1
        # Before the first stage in the arrays: the last state at which the model worked.
        self._earlier_state = initial_state.copy()
        self._earlier_covariance = None if covariance is None else covariance.copy()
        self._z[0] = initial_state
        if self._covariances is not None:
            self._covariances[0] = covariance

    @property
    def length(self) -> int:
        """N_t, the number of stages in the window."""
        return self.end - self.start

    @property
    def view(self) -> WindowView:
        """The views of the present window, which has at least one stage."""
        if self.end - self.start < self.horizon:
            return WindowView(self, self.start, self.end)
        return self._window_views[self.start]

    @property
    def newest_failed(self) -> bool:
        """Whether the newest stage could not be evaluated."""
        return not math.isfinite(self._stage_costs[self.end - 1])

    @property
    def candidate(self) -> Array:
        """Candidate trajectory z(t-N), ..., z(t) (eq:warmstart): a view."""
        return self._z[self.start : self.end + 1]

    @property
    def residuals(self) -> Array:
        """Joint residuals (L(i), v_z(i)) of the candidate: a view."""
        return self.terms.residuals[self.start : self.end]

    @property
    def measurements(self) -> Array:
        """y, with any number where it is missing: a view."""
        return self._y[self.start : self.end]

    @property
    def weights(self) -> Array:
        """The stages' weights, usual or not: a view."""
        return self._weights[self.start : self.end]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which components of y are not missing: a view."""
        return self._observed[self.start : self.end]

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance at z(t-N), if it has one."""
        return None if self._covariances is None else self._covariances[self.start]

    @property
    def initial_state(self) -> Array:
        """The first state of the window."""
        state: Array = self._z[self.start].copy()
        return state

    def _arrays(self) -> dict[str, Array]:
        """All arrays, with a row for each stage; those of states have one more."""
        found: dict[str, Any] = {
            "z": self._z, "y": self._y, "u": self._u, "irregular": self._irregular,
            "observed": self._observed, "special": self._special, "weights": self._weights,
            "costs": self._stage_costs, **self.terms.arrays(),
        }
        if self._majorising_weights is not self._weights:
            found["majorising_weights"] = self._majorising_weights
        if self._covariances is not None:
            found["covariance"] = self._covariances
        if self._roots is not None:
            found["root"], found["vague"] = self._roots, self._vague
        if self._rejections is not None:
            found["rejections"] = self._rejections
        return found

    def _last_good(self, before: int) -> tuple[Array, Array | None]:
        """State and covariance of the last stage before this one at which the model worked."""
        for k in range(before - 1, -1, -1):
            if math.isfinite(self._stage_costs[k]):
                return self._z[k], None if self._covariances is None else self._covariances[k]
        return self._earlier_state, self._earlier_covariance

    def make_room(self) -> None:
        """Move the window to the front if the arrays are full."""
        if self.end < self.room:
            return
        state, covariance = self._last_good(self.start)
        earlier = state.copy(), None if covariance is None else covariance.copy()
        kept = self._copies()
        try:
            self._move_to_front(kept, earlier)
        except BaseException:  # an interrupt: finish the move, half of it is no window
            self._move_to_front(kept, earlier)
            raise

    def _move_to_front(
        self, kept: dict[str, Array], earlier: tuple[Array, Array | None]
    ) -> None:
        self._earlier_state, self._earlier_covariance = earlier
        keep = len(kept["y"])
        self._write(kept, 0)
        if self.unusual:
            self._make_usual(keep)
            self.unusual = bool(self._special[:keep].any() or self._irregular[:keep].any())
        self.start, self.end = 0, keep

    def _make_usual(self, first: int) -> None:
        """Reset the stages from ``first`` on to usual ones."""
        self._observed[first:], self._special[first:], self._irregular[first:] = True, False, False
        self._weights[first:], self._u[first:, -1] = self._usual_weight, self._step

    def _copies(self) -> dict[str, Array]:
        """Copies of the window's part of all arrays."""
        start, end, room = self.start, self.end, self.room
        return {
            name: array[start : end + len(array) - room].copy()
            for name, array in self._arrays().items()
        }

    def _write(self, kept: dict[str, Array], first: int) -> None:
        """Write what `_copies` returned to the stages from ``first`` on."""
        for name, array in self._arrays().items():
            array[first : first + len(kept[name])] = kept[name]

    def mark(self, whole: bool) -> Mark:
        """What `roll_back` needs; all stages if ``whole``."""
        return Mark(
            self.start, self.end, self.time, self.unusual,
            self._own.copy() if self._own else {}, self.smoothed_prior, self.trusted,
            None if self.metric is None else self.metric.state,
            self._copies() if whole else None,
        )

    def roll_back(self, mark: Mark) -> None:
        """Undo all changes since a mark, which must be later than the last `make_room`."""
        self._advanced_to = -1
        self.start, self.end, self.time = mark.start, mark.end, mark.time
        self._own, self.smoothed_prior = mark.own, mark.smoothed_prior
        self.trusted = mark.trusted
        if self.metric is not None and mark.metric is not None:
            self.metric.state = mark.metric
        if mark.arrays is not None:
            self._write(mark.arrays, self.start)
        if self.unusual:
            self._make_usual(self.end)
        self.unusual = mark.unusual

    def state_dict(self) -> dict[str, Any]:
        """Copies of all data of the window."""
        earlier, covariance = self._last_good(self.start)
        metric = None if self.metric is None else self.metric.state
        return {
            **self._copies(),
            "earlier": earlier.copy(),
            "earlier_covariance": None if covariance is None else covariance.copy(),
            "time": self.time,
            "smoothed_prior": None if self.smoothed_prior is None else self.smoothed_prior.copy(),
            "trusted": None if self.trusted is None else self.trusted.copy(),
            "own": [(time, own.state_dict()) for time, own in self._own.items()],
            "metric": metric and (metric[0].copy(), metric[1]),
        }

    def load_state_dict(
        self, state: dict[str, Any], may_be_irregular: bool,
        read: Callable[[dict[str, Any]], Conditions],
    ) -> None:
        """Load what `state_dict` of an equal window returned into a new window.

        Raises any exception on a damaged state; the window is unusable then.
        """
        time = check_size("time", state["time"], lambda found: found >= 0)
        length, arrays = min(time, self.horizon), self._arrays()
        for name, what in (
            ("covariance", "observer"), ("root", "observer"), ("vague", "observer"),
            ("rejections", "observer"), ("majorising_weights", "cost"),
        ):
            if (name in arrays) != (name in state):
                raise mismatch(what)
        for name, array in arrays.items():
            rows = length + len(array) - self.room
            array[:rows] = checked_array(
                name, state[name], (rows, *array.shape[1:]), array.dtype, name not in _MAY_OVERFLOW
            )
        self._earlier_state = checked_array("earlier", state["earlier"], self._earlier_state.shape)
        if (prior := state["smoothed_prior"]) is not None:
            self.smoothed_prior = checked_array("smoothed_prior", prior, self._earlier_state.shape)
        if (self.trusted is None) != (state["trusted"] is None):
            raise ValueError("there must be trusted values if and only if parameters are held")
        if self.trusted is not None:
            self.trusted = checked_array("trusted", state["trusted"], self.trusted.shape)
        if self._covariances is not None:
            saved, shape = state["earlier_covariance"], self._covariances.shape[1:]
            self._earlier_covariance = checked_array("earlier_covariance", saved, shape)
        if self._rejections is not None and (self._rejections[: length + 1] < 0).any():
            raise ValueError("a sensor's failures are fewer than none")
        if not (self._stage_costs[:length] >= 0.0).all():
            raise ValueError("a stage's cost is not a number >= 0")
        steps, irregular = self._u[:length, -1], self._irregular[:length]
        if (steps[~irregular] != self._step).any() or (irregular.any() and not (
            may_be_irregular and np.isfinite(steps).all() and (steps > 0.0).all()
        )):
            raise ValueError("a step's length is impossible")
        if not isinstance(state["own"], list):
            raise TypeError(f"own is {state['own']!r}")
        for when, own in state["own"]:
            when = check_size("a sample's time", when, lambda t: time - length <= t < time)
            self._own[when] = read(own)
        if (self.metric is None) != (state["metric"] is None):
            raise mismatch("observer")
        if self.metric is not None:
            covariance, settled = state["metric"]
            if not isinstance(settled, bool):
                raise TypeError(f"metric is {settled!r}")
            checked = checked_array("metric", covariance, self.metric.covariance.shape)
            self.metric.state = positive_definite("metric", checked), settled
        self.start, self.end, self.time, self.unusual = 0, length, time, True
        self.has_disturbance_weights = True


class StageView:
    """Views of stage k's entries in all arrays.

    Attributes
    ----------
    z, z_next : (n,) array
        States of the observer before and after the stage.
    arguments : tuple
        Arguments of f and h of the usual model, read-only: z, and u if the system has inputs.
    error : (p,) array
        The fitting error y - h(z), read-only.
    y, u : array
        The measurement (p,), and the input (m,).
    weight : (n + p, n + p) array
        Weight of the joint residual.
    terms : Stage
        Linearised residual and terms of the QP.
    """

    __slots__ = ("arguments", "error", "terms", "u", "weight", "y", "z", "z_next")

    def __init__(self, stages: Stages, k: int) -> None:
        self.z, self.z_next = stages._z[k], stages._z[k + 1]
        self.y, self.u = stages._y[k], stages._u[k, :-1]
        self.arguments: tuple[Array, ...] = tuple(
            read_only(one) for one in ((self.z, self.u) if self.u.size else (self.z,))
        )
        self.weight = stages._weights[k]
        self.terms = Stage(stages.terms, k)
        self.error = read_only(self.terms.noise)


class WindowView:
    """Views of a whole window.

    Attributes
    ----------
    candidate : (K + 1, n) array
        The observer's trajectory.
    prior : (n,) array
        z(t-N), its first state.
    residuals, measurements, inputs : array
        (K, n + p), (K, p) and (K, m).
    costs : (K,) array
        The stages' costs.
    span : Span
        The stages' terms.
    """

    __slots__ = ("candidate", "costs", "inputs", "measurements", "prior", "residuals", "span")

    def __init__(self, stages: Stages, first: int, last: int) -> None:
        self.candidate, self.prior = stages._z[first : last + 1], stages._z[first]
        self.residuals = stages.terms.residuals[first:last]
        self.measurements, self.inputs = stages._y[first:last], stages._u[first:last, :-1]
        self.costs = stages._stage_costs[first:last]
        self.span = Span(stages.terms, first, last - first)


class Views(Sequence[View]):
    """Views made on demand; only the last one is kept."""

    def __init__(self, count: int, make: Callable[[int], View]) -> None:
        self._count, self._make = count, make
        self._k = -1
        self._view: View | None = None

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if k >= self._count:
            raise IndexError(k)
        if k != self._k:
            self._k, self._view = k, self._make(k)
        return self._view
