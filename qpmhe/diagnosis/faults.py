"""The search for the faults of a record: each is a filter, judged by its likelihood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from .bank import Array, FilterBank, Filtered, Hypothesis, Mask
from .fault_kinds import LEAST_GAIN, MOST_PARTS, SCALED, UNIT_OFFSET, Fault, with_factor
from .signatures import Signature, additive_faults, moments, removed, with_ends

_FACTORS = (1 / 4096, 1 / 256, 1 / 16, 1 / 4, 4.0, 16.0, 64.0, 256.0, 4096.0)
_STEPS = (0.5, 0.65, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.5, 2.0)
_SHIFTS = (-2, -1, 1, 2)
_DRIFTS = tuple(late for late in range(-16, 17) if abs(late) > 1)
# Exponents of the gains that are tried first, and how closely they are searched.
_GAINS, _CLOSELY = np.linspace(-7.0, 7.0, 29), 0.001
# They are tried where the mean square of a sensor's normalised innovations is not within these, on
# so many samples; the best ones are searched closely.
_SUSPICIOUS, _FEW, _BEST = (0.5, 2.0), 100, 3
# Offsets are first what so many samples say, and then found again so many times.
_SOON, _AGAIN = 5, 4
# Beside LEAST_GAIN, a fault that is not local must gain this for each measurement, and LEAST_GAIN
# also when no sample counts for more than the second.
_GAIN_EACH, _MOST_EACH = 0.035, 3.0
# A further fault must gain this share of what the first did: what that has left may be its shadow.
_BESIDE = 0.05
_MOST_FAULTS = 3
# Factors of covariances are searched together until the logarithms' steps are this small, in so
# many runs at most. Where this factor more costs less than that in log likelihood, a factor has no
# upper end.
_FINE, _RUNS, _BEYOND, _COSTS = 0.04, 12, 16.0, 2.0


def search(
    bank: FilterBank, base: Hypothesis, null: Filtered, starts: Sequence[Array]
) -> tuple[list[Fault], Hypothesis]:
    """Faults, the one that explains most first, each given those before it.

    Also the record without them. `starts` are further states where a filter may start if
    those of the estimator are useless, as with wrong units.
    """
    found: list[Fault] = []
    for _ in range(_MOST_FAULTS):
        best = _best(bank, base, null, starts)
        if best is None or (found and best.gain < _BESIDE * found[0].gain):
            break
        base = best.hypothesis
        null = bank.run([base])
        same = [
            k for k, one in enumerate(found)
            if one.kind in (*SCALED, "gain", "step", "input")
            and (one.kind, one.subject) == (best.kind, best.subject)
        ]
        for k in same:
            best = replace(best, value=found[k].value * best.value, gain=found[k].gain + best.gain)
        found = [one for k, one in enumerate(found) if k not in same]
        found.insert(same[0] if same else len(found), best)
    return _together(bank, base, null, found)


def _together(
    bank: FilterBank, base: Hypothesis, null: Filtered, found: list[Fault]
) -> tuple[list[Fault], Hypothesis]:
    """Factors of covariances as the record is likeliest with all of them.

    Each was found given those before it alone: it may have made up for one that came later.
    """
    some = [k for k, one in enumerate(found) if one.kind in SCALED]
    if not some or not np.isfinite(null.logs).all():
        return found, base
    logs = np.log([found[k].value for k in some])

    def changed(moves: Sequence[float] | Array) -> Hypothesis:
        hypothesis = base
        for k, move in zip(some, moves, strict=True):
            one = found[k]
            hypothesis = with_factor(
                hypothesis, one.kind, one.subject, float(np.exp(move))
            ).hypothesis
        return hypothesis

    def likelihoods(moves: Array) -> Array:
        values = bank.run([base, *map(changed, moves)]).likelihoods[1:]
        return np.where(np.isfinite(values), values, -np.inf)

    at, steps = np.zeros(len(some)), 0.25 * np.abs(logs)
    # From none to all of each, and then around the best.
    tried = np.array(list(product(np.linspace(-1.0, 0.0, 5), repeat=len(some)))) * logs
    around = np.array(list(product((-1.0, 0.0, 1.0), repeat=len(some))))
    for _ in range(_RUNS):
        before, at = at, tried[int(np.argmax(likelihoods(tried)))]
        if np.array_equal(before, at):
            steps = 0.5 * steps
        if steps.max() < _FINE:
            break
        tried = at + steps * around
    signs, shares = np.sign(logs + at), np.linspace(0.0, 1.0, 17)
    ends, count = np.eye(len(some)), len(shares)
    tried = np.array([
        at,
        *(at + np.log(_BEYOND) * sign * end for sign, end in zip(signs, ends, strict=True)),
        *(at - share * (logs + at) * end for end in ends for share in shares),
    ])
    values = likelihoods(tried)
    fits = values[0] - values[1:] < _COSTS
    faults = list(found)
    for i, k in enumerate(some):
        total, upper = float(logs[i] + at[i]), not fits[i]
        if not upper:  # the least one that fits
            rows = fits[len(some) + i * count :][:count]
            total *= 1.0 - float(shares[np.flatnonzero(rows)[-1]])
        faults[k] = replace(found[k], value=float(np.exp(total)), upper=upper)
    base = changed(at)
    faults = [one for one in _disjoint(faults, base) if one.kind not in SCALED or one.matters]
    return faults, base


def _disjoint(found: list[Fault], base: Hypothesis) -> list[Fault]:
    """A factor of all components and one of some of them as factors of these and of the others."""
    faults = list(found)
    for k, whole in enumerate(found):
        if whole.kind not in SCALED or whole.subject:
            continue
        parts = [j for j, one in enumerate(found) if one.kind == whole.kind and one.subject]
        for j in parts:
            faults[j] = replace(found[j], value=found[j].value * whole.value)
        covariance = base.noise if whole.kind == "noise" else base.disturbance
        named = {i for j in parts for i in found[j].subject}
        others = [i for i in np.flatnonzero(covariance.diagonal()).tolist() if i not in named]
        if parts:
            # None are left where each component has its own.
            faults[k] = replace(whole, subject=tuple(others), value=whole.value if others else 1.0)
    return faults


def _best(
    bank: FilterBank, base: Hypothesis, null: Filtered, starts: Sequence[Array]
) -> Fault | None:
    tried = [
        *_scaled(base), *_exchanged(base), *_shifted(base), *_drifted(bank, base, null),
        *additive_faults(bank, base, null), *_gains(bank, base, null, starts),
        *_offsets(bank, base, null, starts),
    ]
    logs = bank.run([base, *(one.hypothesis for one in tried)]).logs
    refined = list(_refined(base, tried, logs.sum(axis=0)))
    if refined:
        further = bank.run([base, *(one.hypothesis for one in refined)]).logs[:, 1:]
        tried, logs = [*tried, *refined], np.hstack((logs, further))
    values = logs.sum(axis=0)
    gains, enough, least = _judged(base, logs)
    best: Fault | None = None
    # By their values: where the record is impossible without any, differences have no digits left.
    for k in np.argsort(-values[1:], kind="stable").tolist():
        one, gain = tried[k], float(gains[k])
        if (gain > least if one.is_local else enough[k]) and one.matters:
            best = replace(one, gain=gain)
            break
    has_no_ends = best is None or best.kind != "bias" or best.span is None
    return best if best is None or has_no_ends else with_ends(bank, base, null, best)


def _judged(base: Hypothesis, logs: Array) -> tuple[Array, Mask, float]:
    """What filters gain beside the first, whether that is enough for the whole record.

    Also what a local fault must gain.
    """
    values, there = logs.sum(axis=0), np.isfinite(base.measurements)
    fails = not np.isfinite(values[0])  # then any filter that does not is better
    lowest = np.min(values, where=np.isfinite(values), initial=0.0) - 1e4
    gains = values[1:] - (lowest if fails else values[0])
    # Few samples that a filter mistakes, as after gaps, suit many faults: they are outvoted.
    votes = np.clip(logs[:, 1:] - logs[:, :1], -_MOST_EACH, _MOST_EACH).sum(axis=0)
    least = LEAST_GAIN * (2.0 - there.mean())
    return gains, (gains > least + _GAIN_EACH * there.sum()) & (fails | (votes > least)), least


def explains(base: Hypothesis, own: Array, other: Array) -> bool:
    """Whether a filter's log likelihoods (T,) are enough better than the usual one's."""
    return bool(_judged(base, np.column_stack((own, other)))[1][0])


def _scaled(base: Hypothesis) -> Iterator[Fault]:
    for kind, covariance in (("noise", base.noise), ("disturbance", base.disturbance)):
        there = np.flatnonzero(covariance.diagonal())
        parts: list[tuple[int, ...]] = [()]
        if 1 < there.size <= MOST_PARTS:
            parts += [(int(i),) for i in there]
        for part in parts:
            for factor in _FACTORS:
                yield with_factor(base, kind, part, factor)
    for factor in _STEPS:
        yield with_factor(base, "step", (), factor)


def _refined(base: Hypothesis, tried: list[Fault], values: Array) -> Iterator[Fault]:
    """For each family of factors, the top of a parabola through the best ones."""
    families: dict[tuple[str, tuple[int, ...]], list[tuple[float, float]]] = {}
    for one, value in zip(tried, values[1:].tolist(), strict=True):
        if one.kind in (*SCALED, "gain", "step"):
            families.setdefault((one.kind, one.subject), [(0.0, float(values[0]))]).append(
                (float(np.log(one.value)), value)
            )
    for (kind, part), pairs in families.items():
        places, heights = np.array(sorted(pairs)).T
        k = int(np.argmax(heights))
        if not 0 < k < len(places) - 1 or not np.isfinite(heights[k - 1 : k + 2]).all():
            continue
        curve = np.polyfit(places[k - 1 : k + 2], heights[k - 1 : k + 2], 2)
        if curve[0] < 0.0:
            yield with_factor(base, kind, part, float(np.exp(-0.5 * curve[1] / curve[0])))


def _is_suspicious(null: Filtered) -> bool:
    """Whether innovations are so large or small that a sensor or an input may have another unit."""
    sizes = np.nanmean(null.normalised**2, axis=0)
    usual = (sizes > _SUSPICIOUS[0]) & (sizes < _SUSPICIOUS[1]) | np.isnan(sizes)
    return not (np.isfinite(null.logs).all() and usual.all())


def _beginnings(base: Hypothesis, starts: Sequence[Array]) -> tuple[Hypothesis, list[Hypothesis]]:
    """The first samples, and the same from each start.

    A wrong unit shows everywhere, also in the estimates from which the filters would begin.
    """
    short = replace(base, measurements=base.measurements[:_FEW], inputs=base.inputs[:_FEW])
    return short, [replace(short, start=one) for one in starts] or [short]


def _offsets(
    bank: FilterBank, base: Hypothesis, null: Filtered, starts: Sequence[Array]
) -> Iterator[Fault]:
    """Sensors with another zero, as of another unit, alone and together.

    Where it is far off, bounds or a lost linearisation hold the filter: the size is first what the
    start says, and then what filters of the corrected record say.
    """
    if not _is_suspicious(null):
        return
    total, p = base.measurements.shape
    parts: list[tuple[int, ...]] = [(j,) for j in range(p)]
    if 1 < p <= MOST_PARTS:
        parts += combinations(range(p), 2)
    if p > 2:
        parts.append(tuple(range(p)))
    for begin in _beginnings(base, starts)[1]:
        y, inputs = begin.measurements, bank.full_inputs(begin.inputs, begin.step)
        expected = bank.expected(np.tile(begin.start, (len(y), 1)), inputs)
        first = bank.errors(y, expected)[:_SOON]
        for part in parts:
            outputs = np.zeros((total, p))
            outputs[:, part] = 1.0
            whole = Signature("bias", part, outputs, np.zeros((total, bank.system.n)))
            one = replace(whole, outputs=outputs[:_FEW], states=whole.states[:_FEW])
            size = float(np.nanmedian(first[:, part]))
            if not abs(size) > UNIT_OFFSET * np.sqrt(base.noise[part[0], part[0]]):
                continue  # smaller ones need no such start
            for _ in range(_AGAIN):
                found = bank.run([removed(begin, one, size).hypothesis])
                against, own = moments([one], found)
                size += float(against[0] / own[0, 0])
            if np.isfinite(size):
                yield removed(replace(base, start=begin.start), whole, size)


def _gains(
    bank: FilterBank, base: Hypothesis, null: Filtered, starts: Sequence[Array]
) -> Iterator[Fault]:
    """Sensors and inputs in other units: of each, the factor that makes the record likeliest."""
    if not _is_suspicious(null):
        return
    p, m = base.measurements.shape[1], base.inputs.shape[1]
    parts: list[tuple[str, tuple[int, ...]]] = [("input", (j,)) for j in range(m)]
    parts += [("gain", (j,)) for j in range(p)] + [("gain", ())] * (p > 1)
    short, begins = _beginnings(base, starts)
    places = {(part, k): _GAINS for part in parts for k in range(len(begins))}
    spacing = _GAINS[1] - _GAINS[0]
    while True:
        tried = [
            (k, with_factor(begins[k], *part, float(10.0**at)))
            for (part, k), found in places.items() for at in found
        ]
        likelihoods = bank.run([short, *(one.hypothesis for _, one in tried)]).likelihoods[1:]
        tops: dict[tuple[str, tuple[int, ...]], tuple[int, Fault]] = {}
        for place in np.argsort(-likelihoods, kind="stable").tolist():
            k, one = tried[place]
            tops.setdefault((one.kind, one.subject), (k, one))
        best = list(tops.items())[:_BEST]
        if spacing < _CLOSELY:
            for part, (k, one) in best:
                whole = replace(base, start=begins[k].start)
                yield with_factor(whole, *part, one.value)
            return
        around = spacing * np.linspace(-1.0, 1.0, 9)
        places = {(part, k): np.log10(one.value) + around for part, (k, one) in best}
        spacing /= 4.0


def _exchanged(base: Hypothesis) -> Iterator[Fault]:
    p = base.measurements.shape[1]
    for pair in combinations(range(p), 2) if p <= MOST_PARTS else ():
        order = np.arange(p)
        order[list(pair)] = pair[::-1]
        yield Fault("swapped", 0.0, replace(base, measurements=base.measurements[:, order]), pair)
    for j in range(base.inputs.shape[1]):
        yield with_factor(base, "sign", (j,), -1.0)
    yield Fault("outliers", 1.0, replace(base, outliers=True))


def _shifted(base: Hypothesis) -> Iterator[Fault]:
    total, p = base.measurements.shape
    parts: list[tuple[int, ...]] = [()] if base.inputs.shape[1] else []  # late for what?
    if 1 < p <= MOST_PARTS:
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
