"""Which fault explains a record best: each one a filter of its own, judged by its likelihood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from .filter_bank import FilterBank, Filtered, Hypothesis

Array = NDArray[np.float64]

_FACTORS = (1 / 4096, 1 / 256, 1 / 16, 1 / 4, 4.0, 16.0, 64.0, 256.0, 4096.0)
_STEPS = (0.5, 0.65, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.5, 2.0)
_SHIFTS = (-2, -1, 1, 2)
_DRIFTS = tuple(late for late in range(-16, 17) if abs(late) > 1)
# More components than this have no factors or pairs of their own.
_MOST = 8
# What a fault must gain in log likelihood: in all, and for each measurement unless it is local.
_GAIN, _GAIN_EACH, _LOCAL = 12.0, 0.035, ("bias", "outliers")
# A further fault must gain this share of what the first did: what that has left may be its shadow.
_BESIDE = 0.05
# The least effect worth a word: factors of covariances, deviations of a bias, shares of a step and
# of an input, samples.
_LEAST = {
    "noise": np.log(2.0), "disturbance": np.log(2.0), "bias": 0.5, "step": 0.02, "sign": 0.1,
    "input": 0.1, "shift": 0.3, "clock": 0.5, "outliers": 0.0, "swapped": 0.0,
}


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault that explains the record better than none.

    Parameters
    ----------
    kind : str
        One of the keys above.
    value : float
        Factor of a covariance, a step or an input; samples of a shift; the bias in the units of
        the sensor.
    hypothesis : Hypothesis
        The record and its covariances without the fault.
    subject : tuple of int
        The sensors, inputs or disturbances that it concerns; empty for all.
    span : (int, int) or None
        First and last sample, if not the whole record.
    gain : float
        How much more likely the record is with it, as a logarithm.
    """

    kind: str
    value: float
    hypothesis: Hypothesis
    subject: tuple[int, ...] = ()
    span: tuple[int, int] | None = None
    gain: float = 0.0


def search(
    bank: FilterBank, base: Hypothesis, most: int = 3
) -> tuple[list[Fault], list[Filtered]]:
    """Faults, the one that explains most first; each later one beside those before.

    Also the filters without any fault, and with each of these.
    """
    found: list[Fault] = []
    passes: list[Filtered] = []
    rounds = 0
    while True:
        null = bank.run([base])
        passes.append(null)
        if rounds == most:
            return found, passes
        best = _best(bank, base, null)
        if best is None or (found and best.gain < _BESIDE * found[0].gain):
            return found, passes
        base = best.hypothesis
        same = [k for k, one in enumerate(found) if _is_same(one, best)]
        for k in same:
            best = replace(best, value=found[k].value * best.value, gain=found[k].gain + best.gain)
        found = [one for k, one in enumerate(found) if k not in same]
        found.insert(same[0] if same else len(found), best)
        rounds += 1


def _is_same(one: Fault, other: Fault) -> bool:
    """Whether both are a factor of the same."""
    return (
        one.kind in ("noise", "disturbance", "step", "input")
        and (one.kind, one.subject) == (other.kind, other.subject)
    )


def _best(bank: FilterBank, base: Hypothesis, null: Filtered) -> Fault | None:
    tried = [
        *_scaled(base), *_exchanged(base), *_shifted(base), *_drifted(bank, base, null),
        *_linear(bank, base, null),
    ]
    likelihoods = bank.run([base, *(one.hypothesis for one in tried)]).likelihoods
    reference, values = likelihoods[0], likelihoods[1:]
    refined = list(_refined(base, tried, values, reference))
    if refined:
        further = bank.run([base, *(one.hypothesis for one in refined)]).likelihoods[1:]
        tried, values = [*tried, *refined], np.append(values, further)
    if not np.isfinite(reference):
        reference = -1e300
    each = _GAIN_EACH * np.isfinite(base.measurements).sum()
    ranked = [
        replace(one, gain=float(value - reference))
        for one, value in zip(tried, values, strict=True)
        if value - reference > _GAIN + each * (one.kind not in _LOCAL) and _matters(one, base)
    ]
    best = max(ranked, key=lambda one: one.gain, default=None)
    return best if best is None or best.kind != "bias" else _with_ends(bank, base, null, best)


def _matters(fault: Fault, base: Hypothesis) -> bool:
    size, kind = fault.value, fault.kind
    if kind in ("noise", "disturbance"):
        size = np.log(size)
    elif kind in ("step", "input"):
        size -= 1.0
    elif kind == "bias":
        size /= np.sqrt(base.noise[fault.subject[0], fault.subject[0]])
    return bool(abs(size) >= _LEAST[kind])


def _times(covariance: Array, part: tuple[int, ...], factor: float) -> Array:
    """A covariance with the variances of some components, or of all, multiplied."""
    roots = np.ones(len(covariance))
    roots[list(part) if part else slice(None)] = np.sqrt(factor)
    scaled: Array = roots[:, None] * covariance * roots
    return scaled


def _with_factor(base: Hypothesis, kind: str, part: tuple[int, ...], factor: float) -> Fault:
    if kind == "step":
        changed = replace(base, step=base.step * factor)
    elif kind == "noise":
        changed = replace(base, noise=_times(base.noise, part, factor))
    else:
        changed = replace(base, disturbance=_times(base.disturbance, part, factor))
    return Fault(kind, factor, changed, part)


def _scaled(base: Hypothesis) -> Iterator[Fault]:
    for kind, covariance in (("noise", base.noise), ("disturbance", base.disturbance)):
        there = np.flatnonzero(covariance.diagonal())
        parts: list[tuple[int, ...]] = [()]
        if 1 < there.size <= _MOST:
            parts += [(int(i),) for i in there]
        for part in parts:
            for factor in _FACTORS:
                yield _with_factor(base, kind, part, factor)
    for factor in _STEPS:
        yield _with_factor(base, "step", (), factor)


def _refined(
    base: Hypothesis, tried: list[Fault], values: Array, reference: float
) -> Iterator[Fault]:
    """For each family of factors, the top of a parabola through the best ones."""
    families: dict[tuple[str, tuple[int, ...]], list[tuple[float, float]]] = {}
    for one, value in zip(tried, values, strict=True):
        if one.kind in ("noise", "disturbance", "step"):
            families.setdefault((one.kind, one.subject), [(0.0, reference)]).append(
                (float(np.log(one.value)), float(value))
            )
    for (kind, part), pairs in families.items():
        places, heights = np.array(sorted(pairs)).T
        k = int(np.argmax(heights))
        if not 0 < k < len(places) - 1 or not np.isfinite(heights[k - 1 : k + 2]).all():
            continue
        curve = np.polyfit(places[k - 1 : k + 2], heights[k - 1 : k + 2], 2)
        if curve[0] < 0.0:
            top = -0.5 * curve[1] / curve[0]
            yield _with_factor(base, kind, part, float(np.exp(top)))


def _exchanged(base: Hypothesis) -> Iterator[Fault]:
    p, m = base.measurements.shape[1], base.inputs.shape[1]
    if p <= _MOST:
        for pair in combinations(range(p), 2):
            order = np.arange(p)
            order[list(pair)] = pair[::-1]
            exchanged = replace(base, measurements=base.measurements[:, order])
            yield Fault("swapped", 0.0, exchanged, pair)
    for j in range(m):
        inputs = base.inputs.copy()
        inputs[:, j] *= -1.0
        yield Fault("sign", -1.0, replace(base, inputs=inputs), (j,))
    yield Fault("outliers", 1.0, replace(base, outliers=True))


def _shifted(base: Hypothesis) -> Iterator[Fault]:
    total, p = base.measurements.shape
    parts: list[tuple[int, ...]] = [()] if base.inputs.shape[1] else []  # late for what?
    if 1 < p <= _MOST:
        parts += [(j,) for j in range(p)]
    for part in parts:
        columns = list(part) if part else list(range(p))
        for late in _SHIFTS:
            y = base.measurements.copy()
            times = np.arange(total) + late
            there = (times >= 0) & (times < total)
            y[:, columns] = np.nan
            y[np.ix_(there, columns)] = base.measurements[np.ix_(times[there], columns)]
            yield Fault("shift", float(late), replace(base, measurements=y), part)


def _drifted(bank: FilterBank, base: Hypothesis, null: Filtered) -> Iterator[Fault]:
    """The record as of clocks of the sensors that gain or lose samples until its end."""
    y, total = base.measurements, len(base.measurements)
    if not base.inputs.shape[1]:
        return  # there is no other clock: it would be the step
    _, moves = bank.moves(null.states, bank.full_inputs(base.inputs, base.step))
    for late in _DRIFTS:
        if abs(late) > total / 10:
            continue
        # Right at the beginning of the record, which may be before the filter's.
        times = np.arange(total)
        when = times + late * (times + bank.before) / (total + bank.before)
        before = np.floor(when).astype(np.intp)  # whose input acts at the time
        there = (before >= 0) & (before < total)
        before, when = before[there], when[there]
        moved = np.full_like(y, np.nan)
        moved[before] = y[there] - (when - before)[:, None] * moves[before]
        yield Fault("clock", float(late), replace(base, measurements=moved))


@dataclass(frozen=True, eq=False)
class _Signature:
    """How a fault of size one moves the outputs (T, p) and the states (T, n) of its sample."""

    kind: str
    subject: tuple[int, ...]
    outputs: Array
    states: Array
    span: tuple[int, int] | None = None


def _signatures(bank: FilterBank, base: Hypothesis, null: Filtered) -> Iterator[_Signature]:
    total, p = base.measurements.shape
    n = bank.system.n
    none_x = np.zeros((total, n))
    inputs = bank.full_inputs(base.inputs, base.step)
    # At each sample from those before it alone: else noise would look like a fault.
    expected, moves = bank.moves(null.states, inputs)
    if base.inputs.shape[1]:
        yield _Signature("shift", (), -moves, none_x)
    if 1 < p <= _MOST:
        for j in range(p):
            yield _Signature("shift", (j,), -moves * (np.arange(p) == j), none_x)
    reached = bank.model.f.batch(null.corrected, inputs)
    for j in range(base.inputs.shape[1]):
        without = inputs.copy()
        without[:, j] = 0.0
        yield _Signature(
            "input", (j,), expected - bank.model.h.batch(null.states, without),
            reached - bank.model.f.batch(null.corrected, without),
        )
    for j in range(p):
        for first, last in _blocks(total, p):
            yield _bias(bank, total, j, first, last)


def _bias(bank: FilterBank, total: int, sensor: int, first: int, last: int) -> _Signature:
    outputs = np.zeros((total, bank.system.p))
    outputs[first : last + 1, sensor] = 1.0
    return _Signature(
        "bias", (sensor,), outputs, np.zeros((total, bank.system.n)), (first, last)
    )


def _blocks(total: int, sensors: int) -> list[tuple[int, int]]:
    """First and last samples of stretches that make up the record."""
    count = max(1, min(32 if sensors <= _MOST else 8, total // 4))
    edges = np.linspace(0, total, count + 1).astype(int)
    return [(int(first), int(end) - 1) for first, end in pairwise(edges)]


def _linear(bank: FilterBank, base: Hypothesis, null: Filtered) -> Iterator[Fault]:
    """Additive faults, of the size that the innovations of the filter without them show.

    An additive fault moves the innovations by a signature that is linear in its size; they are
    white beside it, so that its size is a weighted mean.

    References
    ----------
    Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation
    of jumps in linear systems, IEEE Transactions on Automatic Control 21 (1976).
    """
    listed = [
        one for one in _signatures(bank, base, null)
        if np.isfinite(one.outputs).all() and np.isfinite(one.states).all()
    ]
    if not listed or not np.isfinite(null.likelihoods[0]):
        return
    against, own = _moments(listed, null)
    best: dict[tuple[str, tuple[int, ...]], tuple[float, float, _Signature]] = {}
    for one, size, gain in _candidates(bank, listed, against, own):
        key = one.kind, one.subject
        if gain > 0.5 * _GAIN and gain > best.get(key, (0.0,))[0]:
            best[key] = gain, size, one
    for _, size, one in best.values():
        yield _removed(base, one, size)


def _candidates(
    bank: FilterBank, listed: list[_Signature], against: Array, own: Array
) -> Iterator[tuple[_Signature, float, float]]:
    """Signatures with size and gain: those listed, and of biases the best row of stretches."""
    for k, one in enumerate(listed):
        if one.kind != "bias" and own[k, k] > 0.0:
            yield one, against[k] / own[k, k], 0.5 * against[k] ** 2 / own[k, k]
    for j in range(bank.system.p):
        at = [k for k, one in enumerate(listed) if one.kind == "bias" and one.subject == (j,)]
        if not at:
            continue
        # Signatures add up: sums over rows of stretches by prefix sums.
        sums = np.append(0.0, np.cumsum(against[at]))
        squares = np.zeros((len(at) + 1, len(at) + 1))
        squares[1:, 1:] = np.cumsum(np.cumsum(own[np.ix_(at, at)], axis=0), axis=1)
        diagonal = squares.diagonal()
        top = sums[None, :] - sums[:, None]  # from stretch i up to k, without k
        bottom = diagonal[None, :] + diagonal[:, None] - squares - squares.T
        gains = np.where(np.triu(bottom, 1) > 0.0, 0.5 * top**2 / bottom, 0.0)
        i, k = divmod(int(np.argmax(gains)), len(gains))
        if gains[i, k] > 0.0:
            first, last = (listed[at[i]].span or (0, 0))[0], (listed[at[k - 1]].span or (0, 0))[1]
            one = _bias(bank, len(listed[0].outputs), j, first, last)
            yield one, float(top[i, k] / bottom[i, k]), float(gains[i, k])


def _moments(listed: list[_Signature], null: Filtered) -> tuple[Array, Array]:
    """Products of the signatures in the innovations with these (K,), and with each other (K, K)."""
    outputs = np.stack([one.outputs for one in listed], axis=2)
    states = np.stack([one.states for one in listed], axis=2)
    there = np.isfinite(null.innovations)
    errors = np.where(there, null.innovations, 0.0)
    weights = np.linalg.inv(null.innovation_covariances)
    moved = np.zeros(states.shape[1:])
    against, own = np.zeros(len(listed)), np.zeros((len(listed), len(listed)))
    for t in range(len(outputs)):
        shown = null.outputs[t] @ moved + outputs[t] * there[t][:, None]
        weighted = weights[t] @ shown
        against += errors[t] @ weighted
        own += shown.T @ weighted
        moved = null.transitions[t] @ (moved - null.gains[t] @ shown) + states[t]
    return against, own


def _with_ends(bank: FilterBank, base: Hypothesis, null: Filtered, bias: Fault) -> Fault:
    """A bias with the first and last sample under which the record is most likely."""
    total = len(base.measurements)
    first, last = bias.span or (0, total - 1)
    step = max(1, total // 64)
    while True:
        listed = [
            _bias(bank, total, bias.subject[0], begin, end)
            for begin in sorted({max(first + d, 0) for d in (-step, 0, step)})
            for end in sorted({min(last + d, total - 1) for d in (-step, 0, step)})
            if end - begin >= 2
        ]
        against, own = _moments(listed, null)
        sizes = against / own.diagonal()
        k = int(np.argmax(sizes * against))
        same, (first, last) = listed[k].span == (first, last), listed[k].span or (first, last)
        if same and step == 1:
            break
        step = max(1, step // 2) if same else step
    refined = _removed(base, listed[k], float(sizes[k]))
    values = bank.run([base, refined.hypothesis]).likelihoods
    gain = float(values[1] - values[0])
    return replace(refined, gain=gain) if gain > bias.gain else bias


def _removed(base: Hypothesis, one: _Signature, size: float) -> Fault:
    """The record without this fault."""
    if one.kind == "input":
        inputs = base.inputs.copy()
        inputs[:, one.subject[0]] *= 1.0 + size
        kind = "sign" if size < -1.0 else "input"
        return Fault(kind, 1.0 + size, replace(base, inputs=inputs), one.subject)
    y = base.measurements - size * one.outputs
    return Fault(one.kind, size, replace(base, measurements=y), one.subject, one.span)
