"""The arrays of a sliding window, and how they slide."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .._checks import positive_definite
from .linearization import Span, Stage, StageTerms
from .snapshot import check_size, other, taken

__all__ = ["Mark", "StageView", "Stages", "Views", "WindowView", "read_only"]

Array = NDArray[np.float64]
Mark = tuple[
    int, int, int, int, int, bool, "dict[int, Array] | None", "list[Array] | None"
]

# Views of longer windows are not kept: they would outweigh the arrays, and are little of a step.
_KEPT = 1000
View = TypeVar("View")


def read_only(array: Array) -> Array:
    """A view that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view


class StageView:
    """Views of one stage's entries in all arrays.

    Attributes
    ----------
    z, next : (n,) array
        State of the observer, and the one after it.
    arguments : tuple
        What the functions of the usual model take, read-only: z, and the inputs if there are any.
    error : (p,) array
        The fitting error, read-only.
    y, u : array
        The measurement (p,), and the input (m,).
    weight : (n + p, n + p) array
        The stage's.
    terms : Stage
        Its linear map and terms.
    """

    __slots__ = ("arguments", "error", "next", "terms", "u", "weight", "y", "z")

    def __init__(self, stages: Stages, k: int) -> None:
        self.z, self.next = stages._z[k], stages._z[k + 1]
        self.y, self.u = stages._y[k], stages._u[k, :-1]
        self.arguments: tuple[Array, ...] = tuple(
            read_only(one) for one in ((self.z, self.u) if self.u.size else (self.z,))
        )
        self.weight = stages._weight[k]
        self.terms = Stage(stages.terms, k)
        self.error = read_only(self.terms.noise)


class WindowView:
    """Views of a whole window.

    Attributes
    ----------
    candidate : (K + 1, n) array
        The observer's trajectory.
    prior : (n,) array
        Its first state.
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
        self.costs = stages._stage_cost[first:last]
        self.span = Span(stages.terms, first, last - first)


class Views(Sequence[View]):
    """Views that are made when they are wanted, of which only the last is kept."""

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


class Stages:
    """Samples and what was computed on them, stage by stage.

    The arrays are longer than the window, which slides along them; at the end its stages
    move back to the front. Thus every window is a plain slice.
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
    ) -> None:
        self.horizon, self._step = horizon, step
        room = horizon + max(horizon // 4, 32)
        self.room = room
        self._z = np.zeros((room + 1, n))
        # The input of each stage, and behind it the length of its step.
        self._y, self._u = np.zeros((room, p)), np.zeros((room, m + 1))
        self._u[:, m] = step
        self._irregular = np.zeros(room, dtype=np.bool_)
        self._observed = np.ones((room, p), dtype=np.bool_)
        # Stages whose weight is not the cost's own, because y is missing or has its own noise.
        self._special = np.zeros(room, dtype=np.bool_)
        self._own_noise: dict[int, Array] = {}  # by time
        self._stage_weight = stage_weight
        self._weight = np.tile(stage_weight, (room, 1, 1))
        #: Whether any stage may be special or irregular; the places to come never are.
        self.unusual: bool = False
        # With a cost that is not quadratic: the weights that majorise it at the candidate.
        self._majorising = self._weight if quadratic else np.zeros((room, n + p, n + p))
        self._stage_cost = np.zeros(room)
        self.terms = StageTerms(room, n, p)
        self._covariance = None if covariance is None else np.zeros((room + 1, n, n))
        # What observers and losses get: foreign code cannot write into the window.
        self._covariance_seen = None if self._covariance is None else read_only(self._covariance)
        self._weight_seen, self._residuals_seen = (
            read_only(array) for array in (self._weight, self.terms.residuals)
        )
        # By stage; and of the full windows, by their first stage.
        self._stage_views: Sequence[StageView] = Views(room, partial(StageView, self))
        self._window_views: Sequence[WindowView] = Views(
            room + 1 - horizon, lambda k: WindowView(self, k, k + horizon)
        )
        if horizon <= _KEPT:
            self._stage_views = list(self._stage_views)
            self._window_views = list(self._window_views)
        self.time = 0  # samples ever pushed: the window ends at x(time)
        self.start = self.end = 0
        self._last_special = self._last_irregular = -self.horizon - 1
        # The last state at which the model worked, of the stages that are no longer here.
        self._earlier = initial_state.copy()
        self._earlier_covariance = None if covariance is None else covariance.copy()
        self._z[0] = initial_state
        if self._covariance is not None:
            self._covariance[0] = covariance

    def _make_usual(self, first: int) -> None:
        """Make the places from one on those of usual stages."""
        self._observed[first:], self._special[first:], self._irregular[first:] = True, False, False
        self._weight[first:], self._u[first:, -1] = self._stage_weight, self._step

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
        return not math.isfinite(self._stage_cost[self.end - 1])

    def _per_stage(self) -> tuple[Array, ...]:
        arrays: tuple[Array | Any, ...] = (
            self._y, self._u, self._irregular, self._observed, self._special,
            self._weight, self._stage_cost,
        )
        return arrays if self._majorising is self._weight else (*arrays, self._majorising)

    def _last_good(self, before: int) -> tuple[Array, Array | None]:
        """State and covariance of the last stage before this one at which the model worked."""
        for k in range(before - 1, -1, -1):
            if math.isfinite(self._stage_cost[k]):
                return self._z[k], None if self._covariance is None else self._covariance[k]
        return self._earlier, self._earlier_covariance

    def make_room(self) -> None:
        """Move the stages to the front where there is no place for another one."""
        if self.end < self.room:
            return
        state, covariance = self._last_good(self.start)
        earlier = state.copy(), None if covariance is None else covariance.copy()
        kept = self._kept()
        try:
            self._settle(kept, earlier)
        except BaseException:  # an interrupt: of half a move nothing could be told
            self._settle(kept, earlier)
            raise

    def _settle(self, kept: list[Array], earlier: tuple[Array, Array | None]) -> None:
        self._earlier, self._earlier_covariance = earlier
        keep = len(kept[0])
        self._put(kept, 0)
        if self.unusual:
            self._make_usual(keep)
            self.unusual = bool(self._special[:keep].any() or self._irregular[:keep].any())
        self.start, self.end = 0, keep

    def _kept(self) -> list[Array]:
        """Copies of the window's part of all arrays."""
        stages, points = slice(self.start, self.end), slice(self.start, self.end + 1)
        arrays = [array[stages].copy() for array in (*self._per_stage(), *self.terms.arrays())]
        arrays.append(self._z[points].copy())
        if self._covariance is not None:
            arrays.append(self._covariance[points].copy())
        return arrays

    def _put(self, kept: list[Array], first: int) -> None:
        """Put what `_kept` gave into the places from one on."""
        arrays = [*self._per_stage(), *self.terms.arrays(), self._z]
        if self._covariance is not None:
            arrays.append(self._covariance)
        for array, part in zip(arrays, kept, strict=True):
            array[first : first + len(part)] = part

    def mark(self, whole: bool) -> Mark:
        """What `roll_back` needs."""
        return (
            self.start, self.end, self.time, self._last_special, self._last_irregular,
            self.unusual, self._own_noise.copy() if self._own_noise else None,
            self._kept() if whole else None,
        )

    def roll_back(self, mark: Mark) -> None:
        """Undo all that was done since a mark, except for a move to the front."""
        (
            self.start, self.end, self.time, self._last_special, self._last_irregular,
            unusual, own_noise, kept,
        ) = mark
        self._own_noise = own_noise or {}
        if kept is not None:
            self._put(kept, self.start)
        if self.unusual:
            self._make_usual(self.end)
        self.unusual = unusual

    def state_dict(self) -> dict[str, Any]:
        """All that the window knows, as copies of arrays and numbers."""
        stages = slice(self.start, self.end)
        points = slice(self.start, self.end + 1)
        earlier, covariance = self._last_good(self.start)
        return {
            "earlier": earlier.copy(),
            "earlier_covariance": None if covariance is None else covariance.copy(),
            "time": self.time,
            "z": self._z[points].copy(),
            "covariance": None if self._covariance is None else self._covariance[points].copy(),
            "stages": [array[stages].copy() for array in self._per_stage()],
            "terms": [array[stages].copy() for array in self.terms.arrays()],
            "own_noise": {time: weight.copy() for time, weight in self._own_noise.items()},
            "last_special": self._last_special,
            "last_irregular": self._last_irregular,
        }

    def load_state_dict(self, state: dict[str, Any], irregular: bool) -> None:
        """Take over what `state_dict` of an equal window gave, into a fresh window.

        Raises whatever comes of a state that is damaged; the window is void then.
        """
        time = check_size("time", state["time"], lambda found: found >= 0)
        length = min(time, self.horizon)
        points = [("z", self._z, state["z"]), ("covariance", self._covariance, state["covariance"])]
        for name, mine, saved in points:
            if (mine is None) != (saved is None):
                raise other("observer")
            if mine is not None:
                mine[: length + 1] = taken(name, saved, (length + 1, *mine.shape[1:]))
        self._earlier = taken("earlier", state["earlier"], self._earlier.shape)
        if self._covariance is not None:
            saved, shape = state["earlier_covariance"], self._covariance.shape[1:]
            self._earlier_covariance = taken("earlier_covariance", saved, shape)
        if len(state["stages"]) != len(self._per_stage()):
            raise other("cost")
        for arrays, part, loose in (
            # Inputs, costs and terms where the model fails need not be finite.
            (self._per_stage(), state["stages"], (self._u, self._stage_cost)),
            (self.terms.arrays(), state["terms"], self.terms.arrays()),
        ):
            for array, saved in zip(arrays, part, strict=True):
                finite = not any(array is one for one in loose)
                array[:length] = taken(
                    "a stage", saved, (length, *array.shape[1:]), array.dtype, finite
                )
        if not (self._stage_cost[:length] >= 0.0).all():
            raise ValueError("a stage's cost is not a number >= 0")
        steps, odd = self._u[:length, -1], self._irregular[:length]
        if (steps[~odd] != self._step).any() or (odd.any() and not (
            irregular and np.isfinite(steps).all() and (steps > 0.0).all()
        )):
            raise ValueError("a step's length is impossible")
        p = self._y.shape[1]
        for when, weight in state["own_noise"].items():
            when = check_size("a sample's time", when, lambda t: time - length <= t < time)
            self._own_noise[when] = positive_definite(
                "noise_weight", taken("noise_weight", weight, (p, p))
            )
        latest = [
            time - length + int(np.flatnonzero(flags[:length])[-1]) if flags[:length].any()
            else -self.horizon - 1
            for flags in (self._special, self._irregular)
        ]
        self._last_special = check_size(
            "last_special", state["last_special"], lambda t: latest[0] <= t < time
        )
        self._last_irregular = check_size(
            "last_irregular", state["last_irregular"], lambda t: latest[1] <= t < time
        )
        self.start, self.end, self.time, self.unusual = 0, length, time, True

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
        """y, with a number of no weight where it is missing: a view."""
        return self._y[self.start : self.end]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which components of y are there: a view."""
        return self._observed[self.start : self.end]

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance at z(t-N), if it has one."""
        return None if self._covariance is None else self._covariance[self.start]
