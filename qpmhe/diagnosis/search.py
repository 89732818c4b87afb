"""The search for the faults of a record: each is a filter, judged by its likelihood."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from .bank import Array, FilterBank, Filtered, Hypothesis, Mask
from .causes import CAUSES, matters
from .faults import LEAST_GAIN, SCALED, Evidence, Fault, with_factor
from .sensor_memory import colours
from .signatures import with_ends

# Beside LEAST_GAIN, a fault that is not local must gain this for each measurement, and LEAST_GAIN
# also when no sample counts for more than the second.
_GAIN_EACH, _MOST_EACH = 0.035, 3.0
# A further fault must gain this share of what the first did: what that has left may be its shadow.
_BESIDE = 0.05
_MOST_FAULTS = 3
# Causes cannot be told apart whose log likelihoods differ by less than the first, or by less than
# the second as a share of what the better one gains, up to the third: models are not exact.
_ALIKE, _SHARE, _MOST_ALIKE = 6.0, 0.03, 15.0
# Nothing else is looked for where means, squares and correlations over so few samples of the
# innovations are within so many standard errors; larger innovations count as the last.
_CALM, _SOON, _FAR = 2.5, 5, 4.0
# The first samples of records of so many times as many are filtered first. They contradict what
# makes them less likely by this, as a logarithm, and need show this share of what is enough. What
# that leaves must explain the record up to so many deviations of the innovations, of which the
# mean squares of the whole record are at most so many times those of the first samples.
_PART, _LONG, _LOSES, _HOPE, _WILD, _LIKE = 1000, 4, 30.0, 0.3, 0.15, 1.25
# Families of values that are searched twice.
_CLOSELY = 6
# A sensor with a memory looks like a wrong Q and R, and these like it: they are searched together
# where one of them alone gains this share.
_MEMORIES, _RIVAL = ("coloured", "lag"), 0.5
# Factors of covariances are searched together until the logarithms' steps are this small, in so
# many runs at most. Where this factor more costs less than that in log likelihood, a factor has no
# upper end.
_FINE, _RUNS, _BEYOND, _COSTS = 0.04, 12, 16.0, 2.0


def search(evidence: Evidence, kinds: Collection[str] = CAUSES) -> tuple[list[Fault], Hypothesis]:
    """Faults, the one that explains most first, each given those before it.

    Also the record without them. What explains the record as well stands in `Fault.equals`.
    """
    found: list[Fault] = []
    now = evidence
    for _ in range(_MOST_FAULTS):
        best, rivals = _best(now, kinds)
        if best is None or (found and best.gain < _BESIDE * found[0].gain):
            break
        if best.kind in _MEMORIES and rivals:
            factors = _factors(now, best)
            if factors is not None:
                found, now = [*found, *factors[0]], _given(now, factors[1])
                break
            best = _with_factors_alike(now, best)
        now = _given(now, best.hypothesis)
        found = _merged(found, best)
        # Signatures are those of the model's own state.
        if now.bank.n != evidence.bank.n or _is_explained(now):
            break
    if now.bank.n != evidence.bank.n:
        return found, now.base
    return _together(now.bank, now.base, now.null, found)


def _given(evidence: Evidence, base: Hypothesis) -> Evidence:
    """The evidence once this is the record."""
    bank = base.bank or evidence.bank
    return replace(evidence, bank=bank, base=base, null=bank.run([base]), shared={})


def _is_explained(evidence: Evidence, least: float = 0.0) -> bool:
    """Whether the innovations are as they should be: then nothing else is looked for.

    That is, up to chance, or to `least` in their deviations.
    """
    squares = evidence.null.normalised**2
    counts = np.maximum(np.isfinite(squares).sum(axis=0), 1)
    limit = np.maximum(_CALM, least * np.sqrt(counts))
    means = np.nanmean(np.minimum(squares, _FAR**2), axis=0) - 1.0
    return bool(
        np.isfinite(evidence.null.logs).all()
        and (np.abs(means) < limit * np.sqrt(2.0 / counts)).all()
        and (colours(evidence, _SOON) < limit).all()
        and (np.abs(np.nanmean(evidence.null.normalised, axis=0)) < limit / np.sqrt(counts)).all()
    )


def _merged(found: list[Fault], best: Fault) -> list[Fault]:
    """The faults with a further one; two of one kind and subject are one of both together."""
    cause = CAUSES[best.kind]
    if best.kind in ("bias", "ramp", "change"):
        return [*found, best]
    for k, one in enumerate(found):
        if (one.kind, one.subject) == (best.kind, best.subject):
            both = one.value + best.value if cause.adds else one.value * best.value
            whole = replace(
                best, value=both, gain=one.gain + best.gain,
                rows=tuple(sorted({*one.rows, *best.rows})), equals=one.equals,
            )
            return [*found[:k], whole, *found[k + 1 :]]
    return [*found, best]


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
    faults = [one for one in _disjoint(faults, base) if one.kind not in SCALED or matters(one)]
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
        covariance = base.usual_noise if whole.kind == "noise" else base.disturbance
        named = {i for j in parts for i in found[j].subject}
        others = [i for i in np.flatnonzero(covariance.diagonal()).tolist() if i not in named]
        if parts:
            # None are left where each component has its own.
            faults[k] = replace(whole, subject=tuple(others), value=whole.value if others else 1.0)
    return faults


def _best(evidence: Evidence, kinds: Collection[str]) -> tuple[Fault | None, bool]:
    """The best fault, and whether factors of R or Q alone explain much of what it does."""
    every = [one for kind in kinds for make in CAUSES[kind].makers for one in make(evidence)]
    some = _possible(evidence, every)
    found = _best_of(evidence, some)
    # What the first samples do not show may be behind them.
    if some is not every and not _is_explained(
        evidence if found[0] is None else _given(evidence, found[0].hypothesis), _WILD
    ):
        found = _best_of(evidence, every)
    return found


def _possible(evidence: Evidence, tried: list[Fault]) -> list[Fault]:
    """The faults that the first samples of a long record do not contradict.

    All, if it is short, or if the first samples are more like the model than the others.
    """
    base, bank = evidence.base, evidence.bank
    if evidence.total < _LONG * _PART or not np.isfinite(evidence.null.logs).all():
        return tried
    squares = np.minimum(evidence.null.normalised**2, _FAR**2)
    if not (np.nanmean(squares, axis=0) <= _LIKE * np.nanmean(squares[:_PART], axis=0)).all():
        return tried
    # Others may concern later samples.
    doubtful = [one for one in tried if one.span is None and (one.again or not _is_local(one))]
    values = bank.run(
        [base.first(_PART), *(one.hypothesis.first(_PART) for one in doubtful)]).likelihoods
    gains = np.nan_to_num(values[1:] - values[0], nan=-np.inf)
    share = _PART / evidence.total
    enough = share * _HOPE * (LEAST_GAIN + _GAIN_EACH * np.isfinite(base.measurements).sum())
    kept: set[int] = set()
    for some in _families(doubtful, gains).values():
        one, found = doubtful[some[0][2]], [*some]
        if _may_be_none(one):
            found.append((0.0, 0.0, -1))
        places, heights, which = map(np.array, zip(*sorted(found), strict=True))
        top = int(np.argmax(heights))
        peak = _peak(places, heights, top)
        # Where no value is contradicted, as of an input that rests, these samples say nothing.
        untold = heights.min() > -_LOSES
        highest = max(heights[top], -np.inf if peak is None else peak[1])
        if _is_local(one) or untold or highest > enough:
            chosen = heights > max(0.0, heights[top]) - _LOSES
            chosen[max(0, top - 1) : top + 2] = True
            kept.update(which[chosen].tolist())
    known = {id(one) for k, one in enumerate(doubtful) if k not in kept}
    return [one for one in tried if id(one) not in known]


def _is_local(one: Fault) -> bool:
    return CAUSES[one.kind].local


def _best_of(evidence: Evidence, tried: list[Fault]) -> tuple[Fault | None, bool]:
    """The best of these, and whether factors of R or Q alone explain much of what it does."""
    bank, base, null = evidence.bank, evidence.base, evidence.null
    logs = bank.run([base, *(one.hypothesis for one in tried)]).logs
    for most in (None, _CLOSELY):
        refined = list(_refined(tried, logs.sum(axis=0), most))
        if refined:
            further = bank.run([base, *(one.hypothesis for one in refined)]).logs[:, 1:]
            tried, logs = [*tried, *refined], np.hstack((logs, further))
    gains, enough, least = _judged(base, logs)
    scores = gains - np.array([_price(one, evidence.total) for one in tried])
    order = np.argsort(-scores, kind="stable").tolist()
    able = [
        k for k in order
        if (scores[k] > least if CAUSES[tried[k].kind].local else enough[k] and scores[k] > 0.0)
        and matters(tried[k])
    ]
    if not able:
        return None, False
    limit = scores[able[0]] - _margin(float(gains[able[0]]))
    tops: dict[tuple[str, tuple[int, ...]], Fault] = {}
    for k in able:
        if scores[k] >= limit:
            one = tried[k]
            tops.setdefault((one.kind, one.subject), replace(one, gain=float(gains[k])))
    # To change R or Q is no remedy while something else explains the record as well.
    alike = sorted(tops.values(), key=lambda one: one.kind in SCALED)
    best = alike[0]
    if best.kind == "bias" and best.span is not None:
        best = with_ends(bank, base, null, best)
    scaled = np.array([one.kind in SCALED for one in tried])
    rivals = bool((gains[scaled] > _RIVAL * best.gain).any())
    others = tuple(one for one in alike[1:] if _is_another(one, best))
    return replace(best, equals=others), rivals


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


def _price(one: Fault, total: int) -> float:
    """What the numbers of a fault that the record determines explain by chance."""
    rows = len(one.rows) if one.kind == "dropped" else 0
    return (0.5 * CAUSES[one.kind].numbers + rows) * float(np.log(total))


def _is_another(one: Fault, best: Fault) -> bool:
    """Whether it is more than the best one for more or fewer components."""
    return one.kind != best.kind or bool(
        one.subject and best.subject and not {*one.subject} & {*best.subject}
    )


def _factors(evidence: Evidence, best: Fault) -> tuple[list[Fault], Hypothesis] | None:
    """Factors of R and Q together, where they explain the record better than a memory."""
    factors, base, gain = _rival(evidence)
    return (factors, base) if factors and gain > best.gain + _margin(best.gain) else None


def _with_factors_alike(evidence: Evidence, best: Fault) -> Fault:
    """A memory, with the factors of R and Q that explain the record as well."""
    factors, _, gain = _rival(evidence)
    known = {one.kind for one in best.equals}
    if gain < best.gain - _margin(best.gain):
        return best
    return replace(
        best, equals=(*best.equals, *(one for one in factors if one.kind not in known))
    )


def _margin(gain: float) -> float:
    return min(max(_ALIKE, _SHARE * gain), _MOST_ALIKE)


def _rival(evidence: Evidence) -> tuple[list[Fault], Hypothesis, float]:
    """Factors of R and Q alone, and what they gain beyond their price."""
    if "rival" not in evidence.shared:
        factors, base = search(replace(evidence, shared={}), SCALED)
        gain = float(np.subtract(*evidence.bank.run([base, evidence.base]).likelihoods))
        evidence.shared["rival"] = factors, base, gain if np.isfinite(gain) else -np.inf
    found: tuple[list[Fault], Hypothesis, float] = evidence.shared["rival"]
    return found


def _families(
    tried: list[Fault], values: Array
) -> dict[tuple[object, ...], list[tuple[float, float, int]]]:
    """Faults that differ by a value alone: place on its scale, log likelihood and number.

    One that has no value is a family of its own.
    """
    found: dict[tuple[object, ...], list[tuple[float, float, int]]] = {}
    for k, (one, value) in enumerate(zip(tried, values.tolist(), strict=True)):
        at = float(np.log(one.value)) if _is_factor(one) else one.value
        has_value = one.again is not None and np.isfinite(one.value)
        key = one.kind, one.subject, one.family if has_value else ("alone", k)
        found.setdefault(key, []).append((at, value, k))
    return found


def _peak(places: Array, heights: Array, k: int) -> tuple[float, float] | None:
    """The top of a parabola through three neighbours, of which the middle one is the best."""
    if not 0 < k < len(places) - 1 or not np.isfinite(heights[k - 1 : k + 2]).all():
        return None
    (before, _, behind), (low, _, high) = (
        one[k - 1 : k + 2] - one[k] for one in (places, heights)
    )
    if not before < 0.0 < behind:
        return None
    curve = (low / before - high / behind) / (before - behind)
    if not curve < 0.0:
        return None
    slope = low / before - curve * before
    return float(places[k] - 0.5 * slope / curve), float(heights[k] - 0.25 * slope**2 / curve)


def _refined(tried: list[Fault], values: Array, most: int | None) -> Iterator[Fault]:
    """For each family of values, or the best ones, the top of a parabola through its best ones."""
    families = [
        some for some in _families(tried, values[1:]).values()
        if tried[some[0][2]].again is not None and np.isfinite(some[0][0])
    ]
    families.sort(key=lambda some: -max(value for _, value, _ in some))
    for some in families[:most]:
        one, pairs = tried[some[0][2]], {at: value for at, value, _ in some}
        if _may_be_none(one):
            pairs.setdefault(0.0, float(values[0]))
        places, heights = np.array(sorted(pairs.items())).T
        found = _peak(places, heights, int(np.argmax(heights)))
        if found is not None and one.again is not None:
            yield one.again(float(np.exp(found[0])) if _is_factor(one) else found[0])


def _may_be_none(one: Fault) -> bool:
    """Whether there is no fault at the place 0."""
    return one.again is not None and one.kind not in ("lag", "coloured", "jitter")


def _is_factor(one: Fault) -> bool:
    """Whether its values count by their logarithms."""
    cause = CAUSES[one.kind]
    return one.value > 0.0 and not (cause.adds or cause.size == "deviations")
