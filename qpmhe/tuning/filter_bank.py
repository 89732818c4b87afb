"""Extended Kalman filters side by side, each with its own idea of what a record means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.system import Function, System

Array = NDArray[np.float64]

# Outliers have a Cauchy distribution, as they may be anything: their share, and its width.
_SHARE, _WIDTH = 0.02, 8.0
# Beyond this an innovation in its own deviations is an outlier rather than noise.
_OUTLIER = 4.0
# Samples without any measurement that make a gap, and measured ones after it that are no evidence.
_GAP = 10


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What one filter takes the record for.

    Parameters
    ----------
    measurements, inputs : (T, p) and (T, m) array
        y, NaN where it is missing, and u.
    noise, disturbance : (p, p) and (n, n) array
        Covariances R, and Q of what the disturbance adds to the state.
    step : float
        The length of each step, as a multiple of what the record says.
    outliers : bool
        Whether single measurements may be outliers, which the filter then leaves out.
    """

    measurements: Array
    inputs: Array
    noise: Array
    disturbance: Array
    step: float = 1.0
    outliers: bool = False


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filters have found.

    Attributes
    ----------
    likelihoods : (H,) array
        Log likelihood of the record under each hypothesis, for as many measurements as the first
        has; -infinity where the filter failed.
    states, corrected : (T, n) array
        Of the first filter: estimates before and after each measurement.
    innovations, innovation_covariances : (T, p) and (T, p, p) array
        Of the first filter: y(t) - h(x(t)), NaN where missing or left out, and the covariances.
    covariances : (T, n, n) array
        Of the first filter: of the estimates after each measurement.
    transitions, outputs, gains : array
        Of the first filter: A (T, n, n), C (T, p, n), and the measurement update's K (T, n, p).
    """

    likelihoods: Array
    states: Array
    corrected: Array
    innovations: Array
    innovation_covariances: Array
    covariances: Array
    transitions: Array
    outputs: Array
    gains: Array


class FilterBank:
    """Runs filters over one record.

    Parameters
    ----------
    system : System
        The model.
    steps : (T,) array or None
        Lengths of the steps; None for the usual one.
    start, prior : (n,) and (n, n) array
        The first estimate and its covariance.
    before : int
        Samples before this record, with the same clocks.
    """

    def __init__(
        self, system: System, steps: Array | None, start: Array, prior: Array, before: int = 0
    ) -> None:
        self.before = before
        self.system, self._start, self._prior = system, start, prior
        #: Whether the model knows steps of other lengths exactly.
        self.is_timed: bool
        #: Takes the length of the step as its last input where it can.
        self.model = system if system.make_timed is None else system.timed
        self.is_timed = self.model is not system
        self._steps = steps
        if self.is_timed and steps is None:
            self._steps = np.array([float(system.dt or 1.0)])
        self._tried = False
        states = system.states
        self._low = None if states is None else states.lower
        self._high = None if states is None else states.upper

    def _try_batched(self, inputs: Array) -> None:
        """Let functions that no trace has proved to take many states do so if it looks like it."""
        self._tried = True
        if "looped" not in (self.model.f.mode, self.model.h.mode):
            return
        self.model = self.model.copy(traced=True)
        generator, count = np.random.default_rng(0), 2 * self.system.n + 7
        spread = 0.1 * np.sqrt(self._prior.diagonal())
        x = self._start + spread * generator.standard_normal((count, self.system.n))
        if self._low is not None:
            x = np.clip(x, self._low, self._high)
        u = inputs[np.arange(count) % len(inputs)]
        for one in (
            self.model.f, self.model.h, self.model.f_jacobian, self.model.h_jacobian
        ):
            one.try_batched(x, u)

    def full_inputs(self, inputs: Array, step: float = 1.0) -> Array:
        """The inputs of `model`: with the length of the step behind them where it takes one."""
        if not self.is_timed or self._steps is None:
            return inputs
        lengths = np.broadcast_to(step * self._steps, (len(inputs),))
        return np.column_stack((inputs, lengths))

    def moves(self, states: Array, inputs: Array) -> tuple[Array, Array]:
        """Expected outputs (T, p) at states (T, n), and how far they move within a step."""
        expected = _values(self.model.h.batch, states, inputs, (self.system.p,))
        following = _values(self.model.f.batch, states, inputs, (self.system.n,))
        later = _values(self.model.h.batch, following, inputs, (self.system.p,))
        moves = later - expected
        if self.system.output_residual is not None:
            self.system.output_residual.wrap(moves, later)
        return expected, moves

    def run(self, hypotheses: Sequence[Hypothesis]) -> Filtered:
        """Filter the record under all hypotheses at once."""
        system, count = self.system, len(hypotheses)
        y = np.array([one.measurements for one in hypotheses])
        u = np.array([self.full_inputs(one.inputs, one.step) for one in hypotheses])
        if not self._tried:
            self._try_batched(u[0])
        model = self.model
        there = np.isfinite(y)
        y = np.where(there, y, 0.0)
        noise = np.array([one.noise for one in hypotheses])
        disturbance = np.array([one.disturbance for one in hypotheses])
        outliers = np.array([one.outliers for one in hypotheses])
        scale = np.array([1.0 if self.is_timed else one.step for one in hypotheses])[:, None]
        total, (n, p) = y.shape[1], (system.n, system.p)
        eye_n, eye_p = np.eye(n), np.eye(p)
        x = np.tile(self._start, (count, 1))
        covariance = np.tile(self._prior, (count, 1, 1))
        alive = np.ones(count, np.bool_)
        likelihoods = np.zeros(count)
        first = Filtered(
            likelihoods, np.empty((total, n)), np.empty((total, n)), np.full((total, p), np.nan),
            np.empty((total, p, p)), np.empty((total, n, n)), np.empty((total, n, n)),
            np.empty((total, p, n)), np.empty((total, n, p)),
        )
        # Outputs count in deviations of the usual noise, whatever their units.
        unit = np.sqrt(hypotheses[0].noise.diagonal())
        noise = noise / np.multiply.outer(unit, unit)
        extreme = np.log(_SHARE / _WIDTH * np.sqrt(2.0 / np.pi))  # beside a normal distribution
        usual, any_outliers = np.log1p(-_SHARE), outliers.any()
        recovers = _recovering(there[0].any(axis=1))
        for t in range(total):
            now, seen = u[:, t], there[:, t]
            known = likelihoods.copy() if recovers[t] else None
            c = _values(model.h_jacobian.batch, x, now, (p, n)) / unit[:, None]
            e = y[:, t] - _values(model.h.batch, x, now, (p,))
            if system.output_residual is not None:
                system.output_residual.wrap(e, y[:, t])
            e = e / unit
            transposed = covariance @ c.transpose(0, 2, 1)
            spread = c @ transposed
            if any_outliers:
                own = np.einsum("hii->hi", spread + noise)
                far = outliers[:, None] & seen & (e * e > _OUTLIER**2 * own)
                tail = np.log1p(e * e / own / _WIDTH**2) + 0.5 * np.log(own)
                seen = seen & ~far
                likelihoods += np.where(far, extreme - tail, 0.0).sum(axis=1)
                likelihoods += usual * (outliers * seen.sum(axis=1))
            if not seen.all():
                both = seen[:, :, None] & seen[:, None, :]
                spread = np.where(both, spread + noise, eye_p)
                c, e = np.where(seen[:, :, None], c, 0.0), np.where(seen, e, 0.0)
                transposed = np.where(seen[:, None, :], transposed, 0.0)
            else:
                spread = spread + noise
            good = alive & np.isfinite(x).all(axis=1) & np.isfinite(e).all(axis=1)
            good &= np.isfinite(spread).all(axis=(1, 2)) & np.isfinite(c).all(axis=(1, 2))
            if not good.all():
                alive = good
                x[~good], covariance[~good] = self._start, self._prior
                e[~good], c[~good], spread[~good] = 0.0, 0.0, eye_p
                transposed[~good] = 0.0
            inverse = _inverses(spread, alive)
            gain = transposed @ inverse
            likelihoods -= 0.5 * (
                np.einsum("hi,hij,hj->h", e, inverse, e) + np.linalg.slogdet(spread)[1]
            )
            first.states[t], first.outputs[t], first.gains[t] = x[0], c[0], gain[0]
            first.innovations[t] = np.where(seen[0] & ~recovers[t], e[0], np.nan)
            if known is not None:
                likelihoods[...] = known
            first.innovation_covariances[t] = spread[0]
            x = x + np.einsum("hij,hj->hi", gain, e)
            closed = eye_n - gain @ c
            covariance = closed @ covariance @ closed.transpose(0, 2, 1)
            covariance += gain @ noise @ gain.transpose(0, 2, 1)
            if self._low is not None:
                if system.turns is not None:
                    x = system.turns(x)
                x = np.clip(x, self._low, self._high)
            first.corrected[t], first.covariances[t] = x[0], covariance[0]
            a = _values(model.f_jacobian.batch, x, now, (n, n))
            following = _values(model.f.batch, x, now, (n,))
            if (scale != 1.0).any():
                following = x + scale * (following - x)
                a = eye_n + scale[:, :, None] * (a - eye_n)
            first.transitions[t] = a[0]
            x = following
            covariance = a @ covariance @ a.transpose(0, 2, 1) + disturbance
        # A shifted record lacks some samples, which must make no difference.
        counts = there.sum(axis=(1, 2))
        likelihoods *= counts[0] / np.maximum(counts, 1)
        likelihoods[~alive | ~np.isfinite(likelihoods)] = -np.inf
        first.innovations[...] *= unit
        first.innovation_covariances[...] *= np.multiply.outer(unit, unit)
        first.outputs[...] *= unit[:, None]
        first.gains[...] /= unit
        return first


def _recovering(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Samples soon after a long gap: a linearised filter is as uncertain there as at the start."""
    found, missing, left = np.zeros(len(seen), np.bool_), 0, 0
    for t, there in enumerate(seen):
        if there and missing >= _GAP:
            left = _GAP
        missing = 0 if there else missing + 1
        found[t] = left > 0
        left -= int(there and left > 0)
    # Where measurements are always that rare, they are the evidence.
    usual = 2 * (found & seen).sum() <= seen.sum()
    return found if usual else np.zeros_like(found)


def _inverses(matrices: Array, alive: NDArray[np.bool_]) -> Array:
    """The inverses; the filter of a singular one is dead, and has the identity."""
    try:
        return np.asarray(np.linalg.inv(matrices), np.float64)
    except np.linalg.LinAlgError:
        singular = np.linalg.slogdet(matrices)[0] <= 0.0
        alive[singular] = False
        matrices[singular] = np.eye(matrices.shape[-1])
        return np.asarray(np.linalg.inv(matrices), np.float64)


def _values(function: Function, x: Array, u: Array, shape: tuple[int, ...]) -> Array:
    """A model function's values at all states; NaN where it raises."""
    try:
        return np.asarray(function(x, u))
    except Exception:
        found = np.full((len(x), *shape), np.nan)
        for i in range(len(x)):
            try:
                found[i] = function(x[i : i + 1], u[i : i + 1])[0]
            except Exception:
                continue
        return found
