"""The search for the weights: a likelihood first, then the estimator itself; it can be resumed."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from scipy.optimize import minimize

from .._checks import Array, need
from ..errors import ModelError, QpmheError
from .likelihood import Likelihood
from .score import Score

_FORMAT = 2
# Seconds from checkpoint to checkpoint.
_EVERY = 1.0
_ITERATIONS, _REFINEMENTS = 200, 12
# In place of infinity, which no line search survives: far above any cost per sample.
_FAILED = 1e6
# What costs beside the score, which is about 1: a measurement that is less likely by a factor of e,
# and a change of all standard deviations by e. Where the score says little, as on a factor of all
# covariances, the likelihood decides; where that says nothing either, the weights stay.
_LIKELY, _STAY = 3e-2, 1e-3
#: Of a normal variable, within 95 %.
NORMAL = 1.959964
# Step of the score's differences; the estimator's iterations make it less smooth than a filter.
_STEP = 1e-2
# The search of the estimator ends where a step gains less than this share; a step is one that
# L-BFGS-B's line search takes: by how much the value falls, and the slope along it.
_ENDS, _ARMIJO, _WOLFE = 1e-5, 1e-3, 0.9
_HESSIAN_STEP = 3e-4
# Newton's steps at most, the gain (in the likelihood's logarithm) that is the last one, curvatures
# that are none, and how far off a Hessian is still the one of the minimum.
_STEPS, _GAIN, _FLAT, _NEAR = 20, 1e-6, 1e-3, 0.02
# How far beyond a point that is still within the limit the next one may be, upwards.
_FURTHER = 3.0
# What Newton's steps gain, in the likelihood's logarithm, that does not move an end of an interval,
# and the same as a share of the rise; how often a step is halved.
_CLOSE, _ROUGH, _HALVINGS = 0.02, 3e-3, 8
# How far a parabola may lead beyond the end of a way that the estimator's search took on a part.
_BEYOND = 4.0
# Length of a step that tells the curvature along a slope, and the largest unit of the next ones.
_TRIAL, _MOST_SPREAD = 0.2, 10.0
# Samples of the part of long records that is searched first: by the likelihood, and by the
# estimator. Its search ends there where a step gains less than the first share, altogether if it
# has gained less than the last, else where a step gains less than the second.
_SHORT, _PART, _ROUGHLY, _NEARLY, _MATTERS = 1000, 1500, 1e-3, 2e-4, 0.01


class TuningCheckpointError(QpmheError):
    """A checkpoint that is damaged, or belongs to another search."""


class _EndedError(Exception):
    """A search has ended."""


class SearchProgress:
    """Where each start of a search stands, in a JSON file; without a path, in memory only."""

    def __init__(self, path: Path | None, identity: str) -> None:
        self.path, self._identity, self._saved = path, identity, -np.inf
        #: What stands before the names of searches: which observer they are for.
        self.part = ""
        self.searches: dict[str, dict[str, Any]] = {}
        if path is None or not path.exists():
            return
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            found, self.searches = content["identity"], dict(content["searches"])
            is_ours = content["format"] == _FORMAT
        except OSError as error:
            raise TuningCheckpointError(
                f"cannot read the checkpoint {path}: {error.strerror or error}."
            ) from error
        except (KeyError, TypeError, ValueError):
            is_ours = False
        if not is_ours:
            raise TuningCheckpointError(
                f"{path} is no checkpoint of this version of qpmhe.tune, or it is damaged; remove "
                "it to start again, or name another file."
            )
        if found != identity:
            raise TuningCheckpointError(
                f"the checkpoint {path} belongs to another search: records, model or options "
                "differ. "
                "Remove it to start again, or name another file."
            )

    def note(self, name: str, theta: Array, value: float, done: bool) -> None:
        """Keep the best point of a search, and write it now and then."""
        self.searches[self.part + name] = {"theta": theta.tolist(), "value": value, "done": done}
        if self.path is not None and (done or monotonic() - self._saved > _EVERY):
            text = json.dumps(
                {"format": _FORMAT, "identity": self._identity, "searches": self.searches}
            )
            temporary = self.path.with_name(f"{self.path.name}.tmp")
            try:
                temporary.write_text(text, encoding="utf-8")
                os.replace(temporary, self.path)
            except OSError as error:
                raise TuningCheckpointError(
                    f"cannot write the checkpoint {self.path}: {error.strerror or error}."
                ) from error
            self._saved = monotonic()

    def known(self, name: str) -> tuple[Array | None, float, bool]:
        """The best point so far, its value, and whether the search has ended there."""
        one = self.searches.get(self.part + name)
        if one is None:
            return None, np.inf, False
        return np.array(one["theta"]), float(one["value"]), bool(one["done"])

    def remove(self) -> None:
        """Remove the file of a search that is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def identity_of(likelihood: Likelihood, value: float, options: Any) -> str:
    """A digest of what a search depends on; the likelihood's value stands for the model."""
    structure = likelihood.structure
    start = {
        name: one.tolist() if isinstance(one, np.ndarray) else one
        for name, one in vars(structure.first).items()
    }
    digest = hashlib.sha256(repr((structure.names, start, f"{value:.6e}", options)).encode())
    for one in likelihood.data:
        for array in (one.y, one.u, one.start, one.dt, one.truth, one.held):
            digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


def search_likelihood(
    likelihood: Likelihood, begin: Array, note: Callable[[Array, float, bool], None]
) -> tuple[Array, float]:
    """The minimum of the likelihood near a start, and its value per sample.

    Of long records, a part is searched first: its minimum is nearby, where its Hessian tells the
    directions in which to search. Where that leads to a limit, below which nothing changes, the
    start's own way is tried as well.
    """
    start, hessian, short = begin, None, likelihood.shortened(_SHORT)
    if short is not None:
        begin = search_likelihood(short, begin, lambda *_: None)[0]
        hessian = likelihood.samples / short.samples * _curvature(short, begin)
    found = _minimum(likelihood, begin, note, hessian)
    low = np.array([pair[0] for pair in likelihood.structure.limits])
    if short is not None and (found[0] < low + _NEAR).any():
        found = min(found, _minimum(likelihood, start, note, None), key=lambda one: one[1])
    note(*found, True)
    return found


def _minimum(
    likelihood: Likelihood, begin: Array, note: Callable[[Array, float, bool], None],
    hessian: Array | None,
) -> tuple[Array, float]:
    """The minimum near a point, where a Hessian may be known, and its value per sample."""
    count, spread = likelihood.structure.seen, np.eye(len(begin))
    if hessian is not None:
        spread[:count, :count] = _alike(hessian)
    best: list[Any] = [begin.copy(), np.inf]

    def value_at(theta: Array) -> tuple[float, Array]:
        value, slope = likelihood.gradient(theta)
        if not np.isfinite(value):
            return _FAILED, np.zeros(len(theta))
        if value / likelihood.samples < best[1]:
            best[:] = theta.copy(), value / likelihood.samples
        return value / likelihood.samples, slope / likelihood.samples

    def value_along(part: Array) -> tuple[float, Array]:
        theta = begin + spread @ part
        inside = likelihood.structure.bounded(theta)
        value, slope = value_at(inside)
        return value, spread.T @ np.where(theta == inside, slope, 0.0)

    known = hessian is not None
    minimize(
        value_along if known else value_at, 0.0 * begin if known else begin, jac=True,
        method="L-BFGS-B", bounds=None if known else likelihood.structure.limits,
        callback=lambda _: note(best[0], best[1], False),
        options={"maxiter": _ITERATIONS, "ftol": 1e-9, "gtol": 1e-6},
    )
    return best[0], float(best[1])


def search_all(
    likelihood: Likelihood, starts: list[Array], checkpoint: SearchProgress, jobs: int,
    advance: Callable[[str], None],
) -> Array:
    """The best minimum of the likelihood over all starts; those known are not searched again."""
    waiting = []
    for k, begin in enumerate(starts):
        theta, _, done = checkpoint.known(f"start {k}")
        if not done:
            waiting.append((k, begin if theta is None else theta))
    if jobs > 1 and len(waiting) > 1:
        joblib = need("joblib", "a search in several processes")
        workers = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
        tasks = (joblib.delayed(_alone)(likelihood.recipe, k, begin) for k, begin in waiting)
        for k, theta, value in workers(tasks):
            checkpoint.note(f"start {k}", theta, value, True)
            advance(f"start {k + 1} of {len(starts)}")
    else:
        for k, begin in waiting:
            def note(theta: Array, value: float, done: bool, k: int = k) -> None:
                checkpoint.note(f"start {k}", theta, value, done)
                advance(f"start {k + 1} of {len(starts)}, {value:.6g} per sample")

            search_likelihood(likelihood, begin, note)
    found = [checkpoint.known(f"start {k}")[:2] for k in range(len(starts))]
    theta, value = min(found, key=lambda one: one[1])
    if theta is None or not np.isfinite(value):
        raise ModelError(
            f"the search found no weights at which the model works: {likelihood.failure}"
        )
    return theta


def _alone(recipe: tuple[Any, ...], k: int, begin: Array) -> tuple[int, Array, float]:
    """One search in a separate process."""
    likelihood = Likelihood(*recipe)
    likelihood.compile()
    return k, *search_likelihood(likelihood, begin, lambda *_: None)


def _curvature(likelihood: Likelihood, theta: Array) -> Array:
    """The Hessian by what the likelihood depends on, from differences to gradients ahead."""
    count, slope = likelihood.structure.seen, likelihood.gradient(theta)[1]
    moves = _HESSIAN_STEP * np.eye(len(theta))[:count]
    rows = [likelihood.gradient(theta + move)[1] - slope for move in moves]
    found = np.array(rows)[:, :count] / _HESSIAN_STEP
    return np.asarray(0.5 * (found + found.T))


def _alike(hessian: Array) -> Array:
    """Directions along which the likelihood curves alike, in columns."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1.0)))


def _descended(
    cost: Callable[[Array], tuple[float, Array]], x: Array, H: Array, enough: float,
    bounded: Callable[[Array], Array] = np.asarray, share: float = 0.0,
) -> tuple[Array, float, Array, Array]:
    """Newton's steps to a minimum: the point, its value, slope and Hessian.

    Slopes update the Hessian (BFGS). A step that leads up is halved. They end before one that
    gains less than enough, or than a share of the value.
    """
    value, slope = cost(x)
    for _ in range(_STEPS):
        step = _newton(H, slope)
        if -0.5 * (slope @ step) < enough + share * abs(value):
            break
        for _ in range(_HALVINGS):
            moved = bounded(x + step)
            reached, by = cost(moved)
            if reached < value:
                break
            step = 0.5 * step
        else:
            break
        s, change = moved - x, by - slope
        gain, x, value, slope = value - reached, moved, reached, by
        along = H @ s
        if s @ change > 0.0 and s @ along > 0.0:
            H = H + np.outer(change, change) / (s @ change) - np.outer(along, along) / (s @ along)
        if gain < enough + share * abs(value):
            break
    return x, value, slope, H


def _newton(H: Array, slope: Array) -> Array:
    """Newton's step, in the directions that have a curvature, of a limited length."""
    values, vectors = np.linalg.eigh(H)
    usable = vectors[:, values > _FLAT]
    step = -(usable / values[values > _FLAT]) @ (usable.T @ slope)
    return np.asarray(step / max(1.0, np.abs(step).max(initial=0.0)))


def polish(
    likelihood: Likelihood, theta: Array, hessian: Array | None = None
) -> tuple[Array, Array]:
    """Newton's steps to the minimum, and the Hessian there; one of nearby may be known."""
    structure, rest = likelihood.structure, theta[likelihood.structure.seen :]

    def whole(part: Array) -> Array:
        return np.concatenate((part, rest))

    def cost(part: Array) -> tuple[float, Array]:
        value, slope = likelihood.gradient(whole(part))
        return value, slope[: structure.seen]

    known = theta
    H = _curvature(likelihood, theta) if hessian is None else hessian
    part, *_ = _descended(
        cost, theta[: structure.seen], H, _GAIN,
        lambda part: structure.bounded(whole(part))[: structure.seen],
    )
    theta = whole(part)
    if hessian is not None or np.abs(theta - known).max() > _NEAR:
        H = _curvature(likelihood, theta)
    return theta, H


def refit(likelihood: Likelihood, theta: Array, hessian: Array) -> tuple[Array, Array]:
    """The minimum near theta over all samples, also those that have judged; and the Hessian there.

    From here on, the likelihood is that of all samples.
    """
    if all(mask.all() for mask in likelihood.tuned):
        return theta, hessian
    tuned = likelihood.samples
    likelihood.tuned = [np.ones_like(mask) for mask in likelihood.tuned]
    hessian = likelihood.samples / tuned * hessian
    return polish(likelihood, theta, hessian)


def limit(
    likelihood: Likelihood, theta: Array, hessian: Array, k: int, sign: float
) -> float | None:
    """Value of component k, on one side, where the likelihood's minimum reaches the 95 % limit.

    The minimum is over the others. None if it stays below within the component's range.
    """
    structure = likelihood.structure
    least, end = likelihood.value(theta), structure.limits[k][1 if sign > 0 else 0]
    if end == theta[k]:
        return None
    others = [j for j in range(structure.seen) if j != k]
    H = hessian[np.ix_(others, others)]
    # The furthest point within the limit, the curvature there, and where the others go from there.
    nearest, slant = theta.copy(), _newton(H, hessian[others, k])

    def rise(to: float) -> float:
        """The rise in standard deviations at the point where the others are best."""
        nonlocal nearest, slant, H

        def at(part: Array) -> Array:
            whole = theta.copy()
            whole[k], whole[others] = to, part
            return structure.bounded(whole)

        def cost(part: Array) -> tuple[float, Array]:
            value, slope = likelihood.gradient(at(part))
            return value - least, slope[others]

        begin, further = nearest[others], to - nearest[k]
        for ahead in (begin + np.clip(slant * further, -1.0, 1.0), begin):
            part, value, slope, curved = _descended(cost, ahead, H, _CLOSE, share=_ROUGH)
            if np.isfinite(value):
                break
        step = _newton(curved, slope)
        gain = -0.5 * float(slope @ step)
        if not np.isfinite(value):
            return _FAILED
        if gain < _CLOSE:
            part, value = part + step, value - gain
        found = float(np.sqrt(2.0 * max(value, 0.0)))
        if found < NORMAL:
            nearest, H = at(part), curved
            slant = (nearest - theta)[others] / (to - theta[k])
        return found

    # The rise is about a power of the distance, which is one of variances where k is a logarithm:
    # also where the least cost is at a variance of 0, behind a long way on which nothing changes.
    is_log, at = structure.is_log(k), float(theta[k])

    def distance(to: float) -> float:
        return abs(float(np.expm1(2.0 * (to - at)))) if is_log else abs(to - at)

    def place(size: float) -> float:
        if not is_log:
            return at + sign * size
        return at + 0.5 * float(np.log1p(sign * size)) if sign * size > -1.0 else -np.inf

    inside, outside = at, sign * np.inf
    known: list[tuple[float, float]] = []
    to = at + sign * NORMAL / np.sqrt(max(hessian[k, k], 1.0))
    for _ in range(12):
        to = min(to, end) if sign > 0 else max(to, end)
        found = rise(to)
        if found < NORMAL and to == end:
            return None
        if abs(found - NORMAL) < 0.03:
            break
        inside, outside = (to, outside) if found < NORMAL else (inside, to)
        known = [*known, (math.log(distance(to)), math.log(max(found, 1e-3)))][-2:]
        (before, low), (last, high) = known[0], known[-1]
        power = (high - low) / (last - before) if len(known) > 1 and last != before else 1.0
        wanted = place(math.exp(last + (math.log(NORMAL) - high) / min(max(power, 0.3), 3.0)))
        if np.isfinite(outside):
            middle, half = 0.5 * (inside + outside), 0.45 * abs(outside - inside)
            to = float(np.clip(wanted, middle - half, middle + half))
        else:
            to = wanted if sign < 0 else min(wanted, to + _FURTHER)
    return float(to)


def refine(
    score: Score, likelihood: Likelihood, theta: Array, checkpoint: SearchProgress,
    advance: Callable[[str], None],
) -> Array:
    """The minimum of the estimator's score, by differences of runs, with a share of the likelihood.

    It starts at the likelihood's weights or, if these are worse, at the start weights. Of long
    records, a part is searched first, and all of them only if what that finds matters on them.
    """
    known, value, done = checkpoint.known("estimator")
    if done and known is not None:
        return known
    sought = _Sought(score, likelihood, theta)
    anchor = sought.anchor
    most = score.seconds * sum(map(len, likelihood.data)) * 2 * len(theta) * _REFINEMENTS
    advance(f"estimator, at most about {most:.2g} s")

    def note(point: Array, value: float) -> None:
        checkpoint.note("estimator", point, value, False)

    begin, enough, spread = anchor if known is None else known, False, 1.0
    short = score.shortened(_PART)
    if short is not None and not sought.plain(anchor, short) < _FAILED:
        short = None  # it compares nothing, as in a gap
    if short is not None and known is None:
        descent = _Descent(sought, short, anchor, np.inf, lambda *_: None, _ROUGHLY, advance)
        spread = descent.unit()
        found, _ = descent.lowest(spread)
        begin, value, enough = _along(sought.whole, anchor, found - anchor)
    if not enough:
        ends = _ENDS if short is None else _NEARLY
        descent = _Descent(sought, score, begin, value, note, ends, advance)
        begin, value = descent.lowest(spread)
    checkpoint.note("estimator", begin, value, True)
    return begin


class _Sought:
    """What the estimator's search makes small: a score, a share of the likelihood, and changes.

    Attributes
    ----------
    anchor : array
        The likelihood's weights or, if these are worse, the start weights; changes are from there.
    """

    def __init__(self, score: Score, likelihood: Likelihood, theta: Array) -> None:
        self._score, self.likelihood = score, likelihood
        self.structure, self._least = likelihood.structure, likelihood.value(theta)
        self._share = _LIKELY / sum(
            int(one.observed[mask].sum())
            for one, mask in zip(likelihood.data, likelihood.tuned, strict=True)
        )
        self.anchor = min((theta, self.structure.start), key=self.plain)

    def plain(self, point: Array, some: Score | None = None) -> float:
        """A score alone."""
        weights = self.structure.weights(self.structure.bounded(point))
        return (self._score if some is None else some).total(weights)

    def total(self, point: Array, some: Score) -> float:
        """A score and what the change costs."""
        change = _STAY * float(np.sum((point - self.anchor) ** 2))
        return min(self.plain(point, some) + change, _FAILED)

    def value(self, point: Array, some: Score) -> float:
        """All of it, with a score of some samples."""
        unlikely = self._share * (self.likelihood.value(point) - self._least)
        return self.total(point, some) + unlikely

    def whole(self, point: Array) -> float:
        """All of it."""
        return min(self.value(point, self._score), _FAILED)

    def with_slope(self, point: Array, some: Score) -> tuple[float, float, Array]:
        """A score, all with it, and the likelihood's share of the slope."""
        alone, (unlikely, slope) = self.total(point, some), self.likelihood.gradient(point)
        value = min(alone + self._share * (unlikely - self._least), _FAILED)
        return alone, value, self._share * slope


class _Descent:
    """A search from a point at which all may be known, to where a step gains less than a share."""

    def __init__(
        self, sought: _Sought, some: Score, begin: Array, value: float,
        note: Callable[[Array, float], None], ends: float, advance: Callable[[str], None],
    ) -> None:
        self._sought, self._some, self._begin = sought, some, begin
        self._note, self._ends, self._advance = note, ends, advance
        self._is_rough = ends > _STEP**2  # the bias of differences ahead is far below
        self._best: list[Any] = [begin, value]
        # The newest point with a gradient, and the one at which the search stands.
        self._newest: list[Any] = []
        self._here: list[Any] = []

    def _total(self, point: Array) -> float:
        return self._sought.total(point, self._some)

    def _difference(self, point: Array, move: Array) -> float:
        return (self._total(point + move) - self._total(point - move)) / (2 * _STEP)

    def _cost(self, point: Array) -> tuple[float, Array]:
        """The value and the slope; ends the search where a step is the last one."""
        if self._here and point is self._begin:
            return self._here[1], self._here[2]
        alone, value, slope = self._sought.with_slope(point, self._some)
        if value == _FAILED:
            return _FAILED, np.zeros(len(point))
        if value < self._best[1]:
            self._best[:] = point.copy(), value
        if self._here:
            self._end(point, value, slope)
        for k, move in enumerate(_STEP * np.eye(len(point))):
            slope[k] += (
                (self._total(point + move) - alone) / _STEP if self._is_rough
                else self._difference(point, move)
            )
            self._advance(f"estimator, score {self._best[1]:.5g}")
        self._note(self._best[0], self._best[1])
        self._newest[:] = point.copy(), value, slope
        if not self._here:
            self._here[:] = self._begin, value, slope
        return value, slope

    def _end(self, point: Array, value: float, slope: Array) -> None:
        """End where the search is going to end; the slope along its way tells."""
        at, before, by = self._here
        way, gain = point - at, before - value
        size = float(np.linalg.norm(way))
        if not size:
            raise _EndedError
        largest = self._ends * max(abs(before), abs(value), 1.0)
        if -_ARMIJO * (by @ way) <= gain <= largest:
            along = slope @ way + size * self._difference(point, _STEP / size * way)
            # The first step, which has a largest length, may end where it still descends.
            if (along if at is self._begin else abs(along)) <= _WOLFE * abs(by @ way):
                raise _EndedError

    def unit(self) -> float:
        """The unit of a step, by the curvature along the first slope."""
        first, slope = self._cost(self._begin)
        size = float(np.linalg.norm(slope))
        if not size:
            return 1.0
        trial = self._sought.structure.bounded(self._begin - _TRIAL / size * slope)
        moved = self._sought.value(trial, self._some)
        bend = 2.0 * (moved - first + _TRIAL * size) / _TRIAL**2
        return float(1.0 / np.sqrt(np.clip(bend, 1.0 / _MOST_SPREAD**2, 1.0)))

    def lowest(self, unit: float) -> tuple[Array, float]:
        """The best point, and its value."""
        begin = self._begin

        def scaled(part: Array) -> tuple[float, Array]:
            value, slope = self._cost(begin + unit * part if part.any() else begin)
            return value, unit * slope

        limits = [tuple((np.array(pair) - at) / unit)
                  for pair, at in zip(self._sought.structure.limits, begin, strict=True)]
        with suppress(_EndedError):
            minimize(
                scaled, np.zeros(len(begin)), jac=True, method="L-BFGS-B", bounds=limits,
                callback=lambda _: self._here.__setitem__(slice(None), self._newest),
                options={"maxiter": _REFINEMENTS, "ftol": self._ends},
            )
        return self._best[0], self._best[1]


def _along(whole: Callable[[Array], float], anchor: Array, way: Array) -> tuple[Array, float, bool]:
    """The best point along a way, by a parabola, its value, and whether it hardly matters."""
    first = whole(anchor)
    found = [(first, 0.0)]
    if np.abs(way).max(initial=0.0) > _STEP:
        half, end = whole(anchor + 0.5 * way), whole(anchor + way)
        found += [(half, 0.5), (end, 1.0)]
        slope, bend = 4.0 * half - 3.0 * first - end, first - 2.0 * half + end
        top = -0.25 * slope / bend if bend > 0.0 else 0.0
        if top > 0.0:
            top = min(top, _BEYOND)
            found.append((whole(anchor + top * way), top))
    value, place = min(found)
    return anchor + place * way, value, first - value < _MATTERS * abs(first)
