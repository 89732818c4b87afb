"""The arrays of a sliding window, and how they slide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .linearization import StageTerms
from .views import Frame, Place, Views, read_only

__all__ = ["Stages"]

Array = NDArray[np.float64]

# Views of longer windows are not kept: they would outweigh the arrays, and are little of a step.
_KEPT = 1000


class Stages:
    """Samples and what was computed on them, stage by stage.

    The arrays are longer than the window, which slides along them; at the end its stages
    move back to the front. Thus every window is a plain slice.

    Parameters
    ----------
    n, p, m : int
        Numbers of states, outputs and inputs.
    horizon : int
        Most stages of a window.
    initial_state : (n,) array
        z(0).
    covariance : (n, n) array or None
        The observer's, of z(0).
    stage_weight : (n + p, n + p) array
        Weight of a usual stage.
    quadratic : bool
        Whether the cost's weights majorise it themselves.
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
    ) -> None:
        self.horizon = horizon
        room = horizon + max(horizon // 4, 32)
        self._room = room
        self._z = np.zeros((room + 1, n))
        # The input of each stage, and behind it the length of its step where that is unusual.
        self._y, self._u = np.zeros((room, p)), np.zeros((room, m + 1))
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
        self._places: Sequence[Place] = Views(room, partial(Place, self))
        self._frames: Sequence[Frame] = Views(
            room + 1 - horizon, lambda k: Frame(self, k, k + horizon)
        )
        if horizon <= _KEPT:
            self._places, self._frames = list(self._places), list(self._frames)
        self.reset(initial_state, covariance)

    def reset(self, initial_state: Array, covariance: Array | None) -> None:
        """Forget all samples.

        Parameters
        ----------
        initial_state : (n,) array
            z(0).
        covariance : (n, n) array or None
            The observer's, of z(0).
        """
        self.time = 0  # samples ever pushed: the window ends at x(time)
        self.start = self.end = 0
        self._last_special = self._last_irregular = -self.horizon - 1
        # The last state at which the model worked, of the stages that are no longer here.
        self._earlier, self._earlier_covariance = initial_state, covariance
        self._z[0] = initial_state
        if self._covariance is not None:
            self._covariance[0] = covariance
        self._own_noise.clear()
        if self.unusual:
            self._make_usual(0)
            self.unusual = False

    def _make_usual(self, first: int) -> None:
        """Make the places from one on those of usual stages."""
        self._observed[first:], self._special[first:], self._irregular[first:] = True, False, False
        self._weight[first:] = self._stage_weight

    @property
    def length(self) -> int:
        """N_t, the number of stages in the window."""
        return self.end - self.start

    @property
    def frame(self) -> Frame:
        """The views of the present window, which has at least one stage."""
        if self.end - self.start < self.horizon:
            return Frame(self, self.start, self.end)
        return self._frames[self.start]

    @property
    def newest_is_held(self) -> bool:
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

    def _move_to_front(self) -> None:
        keep, end = self.end - self.start, self.end
        state, covariance = self._last_good(self.start)
        self._earlier = state.copy()
        self._earlier_covariance = None if covariance is None else covariance.copy()
        for array in self._per_stage():
            array[:keep] = array[end - keep : end]
        self.terms.keep_last(end, keep)
        for states in (self._z, self._covariance):
            if states is not None:
                states[: keep + 1] = states[end - keep : end + 1]
        if self.unusual:
            self._make_usual(keep)
            self.unusual = bool(self._special[:keep].any() or self._irregular[:keep].any())
        self.start, self.end = 0, keep

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

    def fits(self, state: dict[str, Any]) -> bool:
        """Whether a state is of a window like this one."""
        return (state["covariance"] is None) == (self._covariance is None) and len(
            state["stages"]
        ) == len(self._per_stage())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` of an equal window gave."""
        length = len(state["z"]) - 1
        self.start, self.end, self.time = 0, length, int(state["time"])
        self._z[: length + 1] = state["z"]
        if self._covariance is not None:
            self._covariance[: length + 1] = state["covariance"]
        self._earlier = np.array(state["earlier"], np.float64).reshape(self._z.shape[1])
        saved_covariance = state["earlier_covariance"]
        self._earlier_covariance = (
            None if saved_covariance is None
            else np.array(saved_covariance, np.float64).reshape(self._z.shape[1], -1)
        )
        for array, saved in zip(self._per_stage(), state["stages"], strict=True):
            array[:length] = saved
        for array, saved in zip(self.terms.arrays(), state["terms"], strict=True):
            array[:length] = saved
        self._own_noise = {time: weight.copy() for time, weight in state["own_noise"].items()}
        self.unusual = True
        self._last_special = int(state["last_special"])
        self._last_irregular = int(state["last_irregular"])

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
