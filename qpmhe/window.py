"""The last N samples, the observer along them, and all that was already computed on them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .costs import QuadraticCost
from .linearization import StageTerms
from .observers import Observer
from .system import System

__all__ = ["Window"]

Array = NDArray[np.float64]


class Window:
    r"""Samples y(t-N), ..., y(t-1) with the observer's states z(t-N), ..., z(t).

    The observer's trajectory never changes once computed, so what depends on it alone is
    computed when a stage enters and kept while it stays: the residuals
    :math:`(L(i), v_z(i))`, their cost, the Jacobians and the Gauss-Newton terms.

    The arrays are longer than the window, which slides along them; at the end its stages
    move back to the front. Thus every window is a plain slice.

    Parameters
    ----------
    system, observer, cost
        The problem.
    horizon : int
        N >= 1.
    initial_state : (n,) array
        z(0), the prior of the first windows.
    linearized : bool
        Whether the Gauss-Newton terms are wanted at all.
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: QuadraticCost,
        horizon: int,
        initial_state: Array,
        linearized: bool,
    ) -> None:
        n, p, m = system.n, system.p, system.m
        self._system, self._observer, self._cost = system, observer, cost
        self._f, self._h = system.f, system.h
        self._n, self._linearized = n, linearized
        self._jacobians = linearized or observer.needs_jacobians
        self.horizon = horizon
        room = horizon + max(horizon, 64)
        self._room = room
        self._z = np.zeros((room + 1, n))
        self._y, self._u = np.zeros((room, p)), np.zeros((room, m))
        self._observed = np.ones((room, p), dtype=np.bool_)
        self._residuals = np.zeros((room, n + p))
        self._weight = np.zeros((room, n + p, n + p))
        self._stage_cost = np.zeros(room)
        self._terms = StageTerms(room, n, p)
        covariance = observer.initial_covariance()
        self._covariance = None if covariance is None else np.zeros((room + 1, n, n))
        self._z[0] = initial_state
        if self._covariance is not None:
            self._covariance[0] = covariance
        self.time = 0  # samples ever pushed: the window ends at x(time)
        self.start = self.end = 0
        self._last_partial = self._last_failure = -horizon - 1

    @property
    def length(self) -> int:
        """N_t, the number of stages in the window."""
        return self.end - self.start

    @property
    def has_missing(self) -> bool:
        """Whether any component of y is missing in the window."""
        return self.time - self._last_partial <= self.length

    def push(self, y: Array, u: Array) -> tuple[bool, bool]:
        """Take the sample y(t), u(t) in, and advance the observer to z(t+1).

        Returns
        -------
        missing, failed : bool
            Whether a component of y is not finite, and whether a model function raised or
            was not finite at z(t). A failed stage keeps its measurement; the observer holds
            its state, and the candidate's cost is infinite while the stage stays.
        """
        if self.end == self._room:
            self._move_to_front()
        k = self.end
        self._y[k], self._u[k] = y, u
        self._observed[k] = True
        self._weight[k] = weight = self._cost.stage_weight
        cost, missing = self._advance(k, weight, None), False
        if not math.isfinite(cost):
            observed = np.isfinite(y)
            missing = not observed.all()
            if missing:
                self._observed[k] = observed
                self._y[k, ~observed] = 0.0  # any number: its weight is zero
                self._weight[k] = weight = self._cost.partial_weight(observed)
                self._last_partial = self.time
                cost = self._advance(k, weight, observed)
        failed = not math.isfinite(cost)
        if failed:
            self._hold(k)
        self._stage_cost[k] = cost
        linear = not (self._linearized and not failed) or self._linearize(k, weight)
        self.end = k + 1
        self.time += 1
        if self.end - self.start > self.horizon:
            self.start += 1
        return missing, failed or not linear

    def _advance(self, k: int, weight: Array, observed: NDArray[np.bool_] | None) -> float:
        """Evaluate stage k at z and step the observer; the stage's cost, or infinity."""
        n, z, u, following = self._n, self._z[k], self._u[k], self._z[k + 1]
        residual = self._residuals[k]
        correction, error = residual[:n], residual[n:]
        try:
            drift = self._f(z, u)
            np.subtract(self._y[k], self._h(z, u), out=error)
            if observed is not None:
                error[~observed] = 0.0
            if self._jacobians:
                jacobian = self._terms.jacobian[k]
                jacobian[:n] = self._system.f_jacobian(z, u)
                jacobian[n:] = self._system.h_jacobian(z, u)
                a, c = jacobian[:n], jacobian[n:]
            else:
                a = c = None
            prior = None if self._covariance is None else self._covariance[k]
            correction[:], posterior = self._observer.correct(z, error, a, c, observed, prior)
            np.add(drift, correction, out=following)
        except Exception:  # a model function outside its domain: bad luck, not bad input
            return math.inf
        if self._covariance is not None:
            if posterior is None or not np.isfinite(posterior).all():
                return math.inf
            self._covariance[k + 1] = posterior
        if not math.isfinite(following.dot(following)):
            return math.inf
        cost = float(residual.dot(weight).dot(residual))
        return cost if math.isfinite(cost) else math.inf

    def _linearize(self, k: int, weight: Array) -> bool:
        residual = self._residuals[k]
        flat = self._terms.jacobian[k].reshape(-1)
        linear = math.isfinite(flat.dot(flat))
        if not linear:
            self._terms.jacobian[k] = np.eye(*self._terms.jacobian[k].shape)
        self._terms.set_stage(k, weight, residual, weight.dot(residual))
        return linear

    def _hold(self, k: int) -> None:
        """Fill a stage at which the model cannot be evaluated: x(t+1) about x(t)."""
        self._last_failure = self.time
        self._z[k + 1] = self._z[k]
        if self._covariance is not None:
            self._covariance[k + 1] = self._covariance[k]
        self._residuals[k] = 0.0
        self._terms.jacobian[k] = np.eye(*self._terms.jacobian[k].shape)
        if self._linearized:
            nothing = np.zeros_like(self._residuals[k])
            self._terms.set_stage(k, self._weight[k], nothing, nothing)

    def restart(self, state: Array) -> None:
        """Go on from another state after a failed stage, whose correction is void anyway."""
        self._z[self.end] = state

    def _move_to_front(self) -> None:
        keep, end = min(self.horizon, self.end - self.start), self.end
        for array in (
            self._y, self._u, self._observed, self._residuals, self._weight, self._stage_cost
        ):
            array[:keep] = array[end - keep : end]
        self._terms.keep_last(end, keep)
        for states in (self._z, self._covariance):
            if states is not None:
                states[: keep + 1] = states[end - keep : end + 1]
        self.start, self.end = 0, keep

    @property
    def candidate(self) -> Array:
        """Candidate trajectory z(t-N), ..., z(t) (eq:warmstart): a view."""
        return self._z[self.start : self.end + 1]

    @property
    def residuals(self) -> Array:
        """Joint residuals (L(i), v_z(i)) of the candidate: a view."""
        return self._residuals[self.start : self.end]

    @property
    def candidate_cost(self) -> float:
        """J of the candidate; its prior term is 0 exactly."""
        return float(np.add.reduce(self._stage_cost[self.start : self.end]))

    @property
    def measurements(self) -> Array:
        """y, with a number of no weight where it is missing: a view."""
        return self._y[self.start : self.end]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which components of y are there: a view."""
        return self._observed[self.start : self.end]

    @property
    def inputs(self) -> Array:
        """The inputs u: a view."""
        return self._u[self.start : self.end]

    @property
    def stage_weights(self) -> Array:
        """One weight for all stages (q, q), or one for each where y is missing in part."""
        if self.has_missing:
            return self._weight[self.start : self.end]
        return self._cost.stage_weight

    @property
    def prior_covariance(self) -> Array | None:
        """The observer's covariance at z(t-N), if it has one."""
        return None if self._covariance is None else self._covariance[self.start]

    @property
    def first(self) -> int:
        """Where the window's stages begin in `terms`."""
        return self.start

    @property
    def terms(self) -> StageTerms:
        """Gauss-Newton terms of the candidate, at `first` and on."""
        return self._terms
