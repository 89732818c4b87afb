"""The last N samples, and the observer along them, as samples come, change and leave."""

from __future__ import annotations

import math
from copy import copy
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..memory.record import MemoryRecord
from ..model.system import System
from ..observers import Observer
from ..terms.base import read_only
from ..terms.forms import WholeForm
from ..terms.hold import WindowHold
from .conditions import USUAL, Conditions
from .estimate import Status
from .limits import LARGER, LARGEST
from .observer_steps import OF_PROJECTION, ObserverSteps
from .running import RunningObservers

Array = NDArray[np.float64]

_MISSING, _RESTARTED = Status.MISSING.value, Status.RESTARTED.value
# Observers run side by side if they hold at most this many numbers; otherwise `replay` does it.
_MOST_RUNNING = 2**23


@cache
def larger(count: int) -> float:
    """By how much a sum of so many squares must be above another: a quantile of F."""
    from scipy.special import fdtri  # late: most programs do without

    return float(fdtri(count, count, LARGER)) if count else math.inf


class Window(ObserverSteps):
    """The last N samples with the observer along them: see `WindowSamples` and `ObserverSteps`.

    It takes samples and drops the oldest, fills in late ones, and starts the observer again.
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        horizon: int,
        initial_state: Array,
        with_terms: bool,
        projection: str | None,
        reinitialized: bool = False,
        usual: Conditions = USUAL,
        restarts: bool = False,
        form: WholeForm | None = None,
    ) -> None:
        super().__init__(
            system, observer, cost, horizon, initial_state, with_terms, projection, usual,
            restarts, form or WholeForm(system.n, system.p),
        )
        self._held = list(system.held)
        self.trust_start()
        # For the re-initialised candidate; None where `replay` has to make it.
        self._observers: RunningObservers | None = None
        gain, simple = observer.constant_gain, not observer.needs_jacobians
        small = horizon * horizon * (2 * system.n + system.p) <= _MOST_RUNNING
        simple = simple and self.covariance is None and self.memory is None
        if reinitialized and gain is not None and small and simple:
            self._observers = RunningObservers(gain, horizon, self._nearest, self._keep_inside)

    def moves_state(self, own: Conditions | None) -> bool:
        """Whether a sample with these conditions may project z(t) onto another X."""
        if own is None and not self.own:
            return False
        states = None if own is None else own.states
        return states is not self.own.get(self.time - 1, USUAL).states

    def push(
        self, y: Array, u: Array, dt: float | None = None, own: Conditions | None = None
    ) -> None:
        """Store the sample y(t), u(t), and advance the observer to z(t+1)."""
        if self.end == self.room:
            self.make_room()
        moves = self.projects and self.moves_state(own)
        failed = moves and self.time > 0 and self.newest_failed
        if self.trusted is not None:
            self.trusted = self.trusted[[1, 1]]
        k, m, time = self.end, self._m, self.time
        self.end, self.time = k + 1, time + 1
        view = self._stage_views[k]
        view.y[...] = y
        if m:
            view.u[...] = u
        if dt is not None:
            self.is_irregular[k] = self.unusual = True
            self.u[k, m] = dt
        if own is not None:
            self.own[time] = own
            if own.noise_weight is not None or own.disturbance_weight is not None:
                self._set_weight(k, time)
        if self._observers is not None and self._observers_ready:
            self._find_observed(k, time)
            if moves:
                self._advanced_to = min(self._advanced_to, time - 1)
        else:
            events = self._move_state(k, time, failed) if moves else 0
            self._compute_stage(k, time)
            self.events |= events
        if k + 1 - self.start > self.horizon:
            self.start += 1
            if self.own:
                self.own.pop(time - self.horizon, None)

    def _move_state(self, k: int, time: int, failed: bool) -> int:
        """Put z(t) into the X that has come with its sample; return flags of `Status`."""
        if time and not failed:
            self._compute_stage(k - 1, time - 1)
            return self.events & OF_PROJECTION
        self.enter_states(k, time)
        return 0

    def amend(self, time: int, y: Array) -> None:
        """Fill the finite components of y into a sample, and redo the stages from there on."""
        self._advanced_to = min(self._advanced_to, time)
        k = self.end - (self.time - time)
        new = np.abs(y) < LARGEST
        self.y[k, new] = y[new]
        self.is_observed[k] |= new
        self._set_weight(k, time)
        self.replay(self.time - time)

    def take_over(
        self, other: Window, changes: Conditions, parameters: Array | None
    ) -> None:
        """Take the samples of another window, with these changes, and process them again."""
        length, m = other.length, self._m
        kept = other.copies()
        for name in ("y", "u", "is_irregular", "is_observed"):
            self.rows[name][:length] = kept[name]
        self.history[: length + 1] = kept["history"]
        if parameters is not None:
            self.u[:length, m - parameters.size : m] = parameters
        for field in self.sizes.fields("python", "state"):
            self.rows[field.name][0] = kept[field.name][0]
        self.take_single(other)
        self.trajectory = None  # no estimate of the changed samples yet
        if self.metric is not None and other.metric is not None:
            self.metric.state = other.metric.state
        self.own = {time: own.without(changes) for time, own in other.own.items()}
        self.start, self.end, self.unusual = 0, length, True
        self.enter_states(0, self.time - length)
        for k in range(length):
            self._set_weight(k, self.time - length + k)
        self.replay(length)

    def replay(self, steps: int, state: Array | None = None) -> None:
        """Redo the last ``steps`` stages, from another state of the observer if one is given."""
        first = self.end - steps
        if state is not None:
            self.z[first] = state
            self.enter_states(first, self.time - steps)
        for k in range(first, self.end):
            self._compute_stage(k, self.time - (self.end - k))

    def reinitialize(self, estimates: Array) -> None:
        """Replay the window from its first estimate; the last ones are x(t-N), ..., x(t-1)."""
        if not self._observers_ready or not self._follow(estimates):
            self.replay(self.length, estimates[-self.length])

    def challenge(self) -> bool:
        """Let an observer that starts now at the window's first estimate take a worse one's place.

        It starts as the first one did, with the prior's covariance. Both have predicted the
        window's measurements, none of which this estimate has used: the errors decide, by an F-test
        of their sizes. The cost J does not: with another prior it is another function.
        """
        count, before, first = np.count_nonzero(self.observed), self.prediction_error, self.start
        undo, events, failure = self.undo_point(True), self.events, self.failure
        newest = copy(self._sample), self._filled, self._nearest
        self.z[first] = self.history[first]
        if self.covariance is not None:
            self.covariance[first], self.is_vague[first] = self._first_covariance, False
        if self.rejections is not None:
            self.rejections[first] = 0
        if self.memory is not None:
            self.memory[first] = self._first_memory
        self.enter_states(first, self.time - self.length)
        factor, after = larger(int(count)), 0.0
        for k in range(first, self.end):
            if not before > factor * after:
                break
            self._compute_stage(k, self.time - (self.end - k))
            after += self._prediction_error(k)
        if before > factor * after:
            self.events |= _RESTARTED
            self.restarted = self.time
            return True
        undo()
        self.events, self.failure = events, failure
        self._sample, self._filled, self._nearest = newest  # which `filtered` reads
        return False

    @property
    def prediction_error(self) -> float:
        """The window's squared weighted errors y - h(z); infinity where the model has failed."""
        if not np.isfinite(self.cost[self.start : self.end]).all():
            return math.inf
        v, weights = self.residuals[:, self._n :], self.weights[:, self._n :, self._n :]
        return float(np.einsum("ki,kij,kj->", v, weights, v))

    def _prediction_error(self, k: int) -> float:
        """The same of stage k."""
        view = self._stage_views[k]
        if not math.isfinite(self.cost[k]):
            return math.inf
        return float(view.error.dot(view.weight[self._n :, self._n :].dot(view.error)))

    @property
    def _observers_ready(self) -> bool:
        """Whether observers run side by side; not before their metric is final."""
        return self._observers is not None and (self.metric is None or self.metric.settled)

    def _follow(self, estimates: Array) -> bool:
        """Take the candidate from a running observer; False where `replay` has to make it."""
        observers, now, first = self._observers, self.time, self.time - self.length
        assert observers is not None
        # With samples that have changed, an observer that failed may work: run all of them again.
        if self._advanced_to < first or (self._advanced_to < now - 1 and observers.failed.any()):
            observers.failed[:], self._advanced_to = True, first
        for time in range(self._advanced_to, now):
            k = self.end - (now - time)
            self._fill_sample(k, time, self._find_observed(k, time))
            observers.nearest = self._nearest = self._projection(time + 1)
            observers.advance(time, self._in_states(estimates[time - now], time), self.y[k],
                              self._sample)
        self._advanced_to = now
        self.z[self.start : self.end + 1], self.residuals[...], self.events = (
            observers.trajectory(first, now)
        )
        self.failure = ""
        observed = self._sample.observed
        if observed is not None and self._is_missing(now - 1, observed):
            self.events |= _MISSING
        return not observers.failed[first % self.horizon] and self._set_all_stages()

    def _in_states(self, estimate: Array, time: int) -> Array:
        """An estimate of x(time) in the X that has come with its sample since."""
        nearest = self._projection(time)
        if nearest is None or self.metric is None or nearest.contains(estimate):
            return estimate
        return nearest(estimate, self.metric.covariance).point

    def _set_all_stages(self) -> bool:
        """Compute the Jacobians, terms and costs of all stages; whether all are finite."""
        view, weights = self.view, self.stage_weights
        residuals, states = read_only(view.residuals), view.candidate[:-1]
        try:
            if self._with_jacobians:
                self.terms.linearise(self.model.evaluation, states, self.inputs, self.start)
            if self._quadratic:
                view.costs[...] = checked = self.terms.set_all(self.length, weights, self.start)
            else:
                view.costs[...] = checked = self._evaluate_costs(residuals, read_only(weights))
                if self.has_terms:
                    weights = self._majorise(residuals, read_only(weights))
                    self.majorising_weight[self.start : self.end] = weights
                    checked = checked + self.terms.set_all(self.length, weights, self.start)
        except Exception:  # what the user wrote, at some stage
            return False
        return bool(np.isfinite(checked).all())

    def _restore(self, *saved: Any) -> None:
        """Undo all changes since an undo point; running observers start again."""
        self._advanced_to = -1
        super()._restore(*saved)

    def load_state_dict(self, *arguments: Any, **options: Any) -> None:
        """Load a snapshot; see `MemoryRecord.load_state_dict`."""
        super().load_state_dict(*arguments, **options)
        self.has_disturbance_weights = True

    def trust_start(self) -> None:
        """Trust the initial state's values of the parameters that are held."""
        if self._held:
            self.trusted = np.tile(self.z[0, self._held], (2, 1))

    def trust(self, hold: WindowHold, trajectory: Array | None) -> None:
        """Let the next window's trusted values follow an estimate; None leaves them."""
        following = hold.target
        if trajectory is not None:
            following = hold.followed(trajectory[int(self.length == self.horizon)])
        self.trusted = np.stack((hold.target, following))

    def adopt(self, record: MemoryRecord, residuals: Array) -> None:
        """Go on from another engine's record, with its joint residuals along the candidate."""
        self.copy_from(record)
        self.terms.residuals[: self.end] = residuals
        for k in range(self.end):
            self._set_weight(k, self.time - (self.end - k))
        self.restate()

    def restart(self, state: Array) -> None:
        """Set z(t), the observer's newest state, after a failed stage."""
        self.z[self.end] = state
