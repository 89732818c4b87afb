"""The last N samples, the observer along them, and all that was already computed on them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..model.functions import contained
from ..model.system import Function, System
from ..observers import Observer, Sample
from .limits import LARGEST
from .linearization import Stage, StageTerms
from .snapshot import near, other
from .stages import Stages, WindowView

__all__ = ["Window"]

Array = NDArray[np.float64]


class Window(Stages):
    """Samples y(t-N), ..., y(t-1) with the observer's states z(t-N), ..., z(t).

    The observer's trajectory changes only where a late measurement or a restart makes it,
    so what depends on it alone is computed when a stage enters and kept while it stays: the
    residuals :math:`(L(i), v_z(i))`, their cost, the Jacobians and the Gauss-Newton terms.
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: Cost,
        horizon: int,
        initial_state: Array,
        linearized: bool,
    ) -> None:
        n, p, m = system.n, system.p, system.m
        self._system, self._observer, self._cost = system, observer, cost
        self._n, self._m, self._linearized = n, m, linearized
        self._quadratic = cost.quadratic
        self._jacobians = linearized or observer.needs_jacobians
        super().__init__(
            n, p, m, horizon, initial_state, observer.initial_covariance(), cost.stage_weight,
            cost.quadratic, system.dt or 0.0,
        )
        self._sample = Sample(system, np.zeros(m))
        self._correct = contained(observer.correct)
        self._stage_costs, self._majorise = contained(cost.stage_costs), contained(cost.majorise)
        self._read = system.f.direct, system.h.direct
        self._slopes = system.f_jacobian.direct, system.h_jacobian.direct
        self._linear = True  # whether the stage that enters has Jacobians
        self._no_jacobian = -np.eye(n + p, n)  # what stands in for them, with the minus of `linear`
        self._ones = np.ones(horizon)
        # gamma^0, gamma^1, ... from the newest stage backwards, and the prior's behind.
        self._ages = cost.discount ** np.arange(horizon, -1, -1.0) if cost.discount < 1 else None

    @property
    def has_special_weights(self) -> bool:
        """Whether some stage of the window has a weight of its own."""
        return self.time - self._last_special <= self.length

    @property
    def has_irregular_steps(self) -> bool:
        """Whether some stage of the window has a step of unusual length."""
        return self.time - self._last_irregular <= self.length

    def push(
        self, y: Array, u: Array, dt: float | None = None, noise_weight: Array | None = None
    ) -> tuple[bool, bool, bool]:
        """Take the sample y(t), u(t) in, and advance the observer to z(t+1)."""
        if self.end == self.room:
            self.make_room()
        k, m = self.end, self._m
        view = self._stage_views[k]
        view.y[...] = y
        if m:
            view.u[...] = u
        if dt is not None:
            self._irregular[k] = self.unusual = True
            self._u[k, m] = dt
            self._last_irregular = self.time
        if noise_weight is not None:
            self._own_noise[self.time] = noise_weight
            self._set_weight(k, self.time)
        outcome = self._enter(k, self.time)
        self.end = k + 1
        self.time += 1
        if self.end - self.start > self.horizon:
            self.start += 1
            if self._own_noise:
                self._own_noise.pop(self.time - self.horizon - 1, None)
        return outcome

    def amend(self, time: int, y: Array) -> None:
        """Put the finite components of y into a sample of the window, and redo the rest."""
        k = self.end - (self.time - time)
        new = np.abs(y) < LARGEST
        self._y[k, new] = y[new]
        self._observed[k] |= new
        self._set_weight(k, time)
        self.replay(self.time - time)

    def replay(self, steps: int, state: Array | None = None) -> tuple[bool, bool, bool]:
        """Redo the last stages, from another state of the observer if one is given.

        What `push` tells is told of the newest one.
        """
        first = self.end - steps
        if state is not None:
            self._z[first] = state
        outcome = False, False, False
        for k in range(first, self.end):
            outcome = self._enter(k, self.time - (self.end - k))
        return outcome

    def _enter(self, k: int, time: int) -> tuple[bool, bool, bool]:
        """Compute stage k from z(k) and its sample; what `push` tells."""
        y = self._stage_views[k].y
        observed: NDArray[np.bool_] | None = None
        if not math.isfinite(y.dot(y)):
            self._observed[k] = observed = np.abs(y) < LARGEST  # false for NaN, too
            self._set_weight(k, time)
        elif self.unusual and not self._observed[k].all():
            observed = self._observed[k]
        cost = self._advance(k, time, observed)
        if not math.isfinite(cost) and observed is None:
            there = np.abs(y) < LARGEST
            if not there.all():
                self._observed[k] = observed = there
                self._set_weight(k, time)
                cost = self._advance(k, time, observed)
        model_failed = not math.isfinite(cost)
        if model_failed:
            self._hold(k)
        self._stage_cost[k] = cost
        jacobian_failed = not model_failed and self._linearized and not self._linear
        return observed is not None, model_failed, jacobian_failed

    def _set_weight(self, k: int, time: int) -> None:
        """The weight of stage k, at this time, from what is observed of it and its noise."""
        own, observed = self._own_noise.get(time), self._observed[k]
        complete = observed.all()
        self._special[k] = own is not None or not complete
        if not self._special[k]:
            self._weight[k] = self._stage_weight
            return
        self.unusual = True
        self._last_special = max(self._last_special, time)
        self._y[k, ~observed] = 0.0  # any number: its weight is zero
        if complete:
            self._weight[k] = self._cost.joint_weight(own)
        else:
            self._weight[k] = self._cost.partial_weight(observed, own)

    def _advance(self, k: int, time: int, observed: NDArray[np.bool_] | None) -> float:
        """Evaluate stage k at z and step the observer; the stage's cost, or infinity."""
        view = self._stage_views[k]
        z, following, u, terms = view.z, view.next, view.u, view.terms
        model, error, sample = self._system, terms.noise, self._sample
        try:
            if self.unusual and self._irregular[k]:
                model, u = self._system.timed, self._u[k]
            kernel = model.kernel if self._jacobians else None
            if kernel is None:
                usual = model is self._system
                arguments = view.arguments if usual else (view.arguments[0], u)
                f, h = self._read if usual else (model.f, model.h)
                # Used up at once: the functions may return one array every time.
                np.subtract(view.y, h(*arguments), error)
                if self._jacobians:
                    slopes = self._slopes if usual else (model.f_jacobian, model.h_jacobian)
                    self._differentiate(terms, slopes, arguments)
            else:
                ahead, output, slope = kernel.stage(z, u)
                np.subtract(view.y, output, error)
                np.negative(slope, terms.linear[:, 1:])
            if observed is not None:
                error[~observed] = 0.0
            sample.system, sample.u, sample.observed = model, u, observed
            if self._observer.needs_jacobians:
                sample.f_jacobian, sample.h_jacobian = -terms.minus_f, -terms.minus_h
            if self._own_noise or sample.noise_weight is not None:
                sample.noise_weight = self._own_noise.get(time)
            if self._covariance_seen is not None:
                sample.covariance = self._covariance_seen[k]
            correction, posterior = self._correct(view.arguments[0], view.error, sample)
            terms.disturbance[...] = correction
            np.add(f(*arguments) if kernel is None else ahead, correction, following)
        except Exception:  # a model function outside its domain: bad luck, not bad input
            return math.inf
        if self._covariance is not None:
            if posterior is None or not np.isfinite(posterior).all():
                return math.inf
            self._covariance[k + 1] = posterior
        if not math.isfinite(following.dot(following)):
            return math.inf
        self._linear = True
        if self._quadratic:
            # Even where no terms are wanted: so the cost is the same to the last digit.
            cost = self.terms.set_stage(terms, view.weight)
            if math.isfinite(cost):
                return cost
        return self._weigh(k)

    @staticmethod
    def _differentiate(
        terms: Stage, slopes: tuple[Function, Function], arguments: tuple[Array, ...]
    ) -> None:
        f_jacobian, h_jacobian = slopes
        try:
            np.negative(f_jacobian(*arguments), terms.minus_f)
            np.negative(h_jacobian(*arguments), terms.minus_h)
        except Exception:  # a user's Jacobian outside its domain
            # An observer that never reads it goes on; `_weigh` sees the NaN.
            terms.linear[:, 1:] = np.nan

    def _weigh(self, k: int) -> float:
        """The cost of stage k, or infinity, and its Gauss-Newton terms; where they are unusual."""
        weight, stage = self._weight_seen[k], self._stage_views[k].terms
        terms, residual = self.terms, self._residuals_seen[k]
        try:
            cost = float(self._stage_costs(residual[None], weight)[0])
            if not math.isfinite(cost):
                return math.inf
            if self._linearized and not self._quadratic:
                self._majorising[k] = self._majorise(residual[None], weight)[0]
                weight = self._majorising[k]
        except Exception:  # a loss of the user's own
            return math.inf
        if self._linearized:
            slopes = stage.linear[:, 1:].ravel()
            # Terms that overflow otherwise are left to the QP, whose data are then not finite.
            cost_of_terms = terms.set_stage(stage, weight)
            if not (math.isfinite(cost_of_terms) or math.isfinite(slopes.dot(slopes))):
                self._linear = False
                stage.linear[:, 1:] = self._no_jacobian
                terms.set_stage(stage, weight)
        return cost

    def _hold(self, k: int) -> None:
        """Fill a stage at which the model cannot be evaluated: x(t+1) about x(t)."""
        self._z[k + 1], covariance = self._last_good(k)
        if self._covariance is not None:
            self._covariance[k + 1] = covariance
        stage = self._stage_views[k].terms
        stage.linear[:, 0], stage.linear[:, 1:] = 0.0, self._no_jacobian
        self._majorising[k] = self._weight[k]
        if self._linearized:
            self.terms.set_stage(stage, self._weight[k])

    def restart(self, state: Array) -> None:
        """Go on from another state after a failed stage, whose correction is void anyway."""
        self._z[self.end] = state

    def check_stages(self, kept: Window, terms: bool) -> None:
        """Compute the stages of an equal window once more, and insist on what was kept of them.

        Afterwards this window is that one with all of it computed here.
        """
        n, count, first = self._n, self.end, self.time - self.end
        with np.errstate(all="ignore"):
            for k in range(count):
                self._set_weight(k, first + k)
                self._enter(k, first + k)
                there = math.isfinite(kept._stage_cost[k])
                if there != math.isfinite(self._stage_cost[k]):
                    raise other("model")
                if there:
                    self._check_stage(k, kept, terms)
                elif kept.terms.residuals[k, :n].any():  # there is no correction
                    raise other("model")
                # A failed stage is followed by a restart; all else has been compared.
                self._z[k + 1] = kept._z[k + 1]
                if self._covariance is not None and kept._covariance is not None:
                    self._covariance[k + 1] = kept._covariance[k + 1]
        self._last_special, self._last_irregular = kept._last_special, kept._last_irregular

    def _check_stage(self, k: int, kept: Window, terms: bool) -> None:
        n, mine, saved = self._n, self.terms, kept.terms
        if not (
            np.array_equal(self._special[k], kept._special[k])
            and np.array_equal(self._observed[k], kept._observed[k])
            and near(kept._weight[k], self._weight[k], np.abs(self._weight[k]).max())
        ):
            raise other("weight of the stages' cost")
        y, fitting = np.abs(self._y[k]), mine.residuals[k, n:]
        seen = y + np.abs(fitting)
        if not near(saved.residuals[k, n:], fitting, seen):
            raise other("model (h)")
        sizes = np.abs(kept._z[: self.end + 1]).max(axis=0)
        correction = mine.residuals[k, :n]
        reached = np.maximum(sizes, np.abs(correction))
        if not near(saved.residuals[k, :n], correction, reached):
            raise other("observer")
        if not near(kept._z[k + 1], self._z[k + 1], reached):
            raise other("model (f)")
        if self._covariance is not None and kept._covariance is not None:
            found, expected = kept._covariance[k + 1], self._covariance[k + 1]
            spread = np.sqrt(np.abs(expected.diagonal()))
            if not near(found, expected, np.outer(spread, spread)):
                raise other("observer")
        r, weight = saved.residuals[k], kept._weight[k]
        cost = float(self._stage_costs(r[None], weight)[0])
        size = np.abs(r).dot(np.abs(weight)).dot(np.abs(r)) if self._quadratic else cost
        if not near(kept._stage_cost[k], cost, size):
            raise other("cost")
        if not (terms and (self._linearized or self._quadratic)):
            return
        slopes = mine.linear[k, :, 1:]
        steepest = np.nan_to_num(np.abs(slopes)).max(axis=1, keepdims=True)
        if not near(saved.linear[k, :, 1:], slopes, steepest):
            raise other("model (its Jacobians)")
        if not near(kept._majorising[k], self._majorising[k], np.abs(self._majorising[k]).max()):
            raise other("cost")
        exact, bound = StageTerms(1, n, r.size - n), StageTerms(1, n, r.size - n)
        exact.linear[0], weight = saved.linear[k], kept._majorising[k]
        bound.linear[0] = np.abs(exact.linear[0])
        exact.set_all(1, weight)
        bound.set_all(1, np.abs(weight))
        for found, expected, size in zip(
            saved.arrays(), exact.arrays(), bound.arrays(), strict=True
        ):
            if not near(found[k], expected[0], size[0]):
                raise other("weight of the stages' cost")

    @property
    def candidate_cost(self) -> float:
        """J of the candidate; its prior term is 0 exactly."""
        return self.cost_over(self.view)

    def cost_over(self, view: WindowView) -> float:
        """The same, of the window's present view."""
        costs = view.costs
        if self._ages is None:
            return float(costs.dot(self._ones[: costs.size]))
        cost = float(costs.dot(self.discounts[1:]))
        # A failed stage whose factor has underflowed makes 0 times infinity of it.
        return math.inf if math.isnan(cost) else cost

    @property
    def discounts(self) -> Array:
        """Factors of the prior, in front, and of the stages' costs; ones without discount."""
        if self._ages is None:
            return np.ones(self.length + 1)
        # gamma^K for the prior, gamma^(K-1), ..., gamma^0 for the stages.
        return self._ages[self.horizon - self.length :]

    @property
    def usual_inputs(self) -> Array:
        """The inputs u alone: a view."""
        return self._u[self.start : self.end, : self._m]

    @property
    def inputs(self) -> Array:
        """The inputs u, with the steps' lengths behind them if some are irregular."""
        if not self.has_irregular_steps:
            return self.usual_inputs
        return self._u[self.start : self.end]

    @property
    def model(self) -> System:
        """The system that takes these `inputs`."""
        return self._system.timed if self.has_irregular_steps else self._system

    @property
    def stage_weights(self) -> Array:
        """One weight for all stages (q, q), or one for each where some is special."""
        if self.has_special_weights:
            return self._weight[self.start : self.end]
        return self._cost.stage_weight

    @property
    def majorising_weights(self) -> Array:
        """Weights that majorise the cost at the candidate, of all stages or of each."""
        if self._cost.quadratic:
            return self.stage_weights
        return self._majorising[self.start : self.end]
