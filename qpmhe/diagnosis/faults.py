"""The faults that a record can have: each is a filter, judged by its likelihood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np

from .bank import Array, FilterBank, Filtered, Hypothesis
from .findings import Finding, Names, listed, number

_FACTORS = (1 / 4096, 1 / 256, 1 / 16, 1 / 4, 4.0, 16.0, 64.0, 256.0, 4096.0)
_STEPS = (0.5, 0.65, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.5, 2.0)
_SHIFTS = (-2, -1, 1, 2)
_DRIFTS = tuple(late for late in range(-16, 17) if abs(late) > 1)
# Exponents of the gains that are tried first, and how closely they are searched.
_GAINS, _CLOSELY = np.linspace(-7.0, 7.0, 29), 0.001
# They are tried where the mean square of a sensor's normalised innovations is not within these, on
# so many samples; the best ones are searched closely.
_SUSPICIOUS, _FEW, _BEST = (0.5, 2.0), 100, 3
# A factor, and an offset in deviations of the noise, that another unit explains.
_UNIT, _UNIT_OFFSET = 3.0, 30.0
# Offsets are first what so many samples say, and then found again so many times.
_SOON, _AGAIN = 5, 4
# Shares of the size that innovations show of a gain.
_AROUND = (0.5, 1.0, 1.5, 2.5)
# More components than this have no factors or pairs of their own.
_MOST = 8
# What a fault must gain in log likelihood: in all, up to twice that where measurements are missing;
# unless it is local, also for each measurement, and when no sample counts for more than the last.
LEAST_GAIN, _GAIN_EACH, _MOST_EACH = 12.0, 0.035, 3.0
# A further fault must gain this share of what the first did: what that has left may be its shadow.
_BESIDE = 0.05
_MOST_FAULTS = 3
# Factors of covariances are searched together until the logarithms' steps are this small, in so
# many runs at most. Where this factor more costs less than that in log likelihood, a factor has no
# upper end.
_FINE, _RUNS, _BEYOND, _COSTS = 0.04, 12, 16.0, 2.0


class _Kind(NamedTuple):
    """The least effect worth a word, what it is in words, the remedy, and whether it is local."""

    least: float
    text: str
    remedy: str
    local: bool = False


#: Kinds that multiply R or Q.
SCALED = ("noise", "disturbance")
# Effects: logarithms of factors, shares of a step or an input, deviations of a bias, samples.
_KINDS = {
    "noise": _Kind(
        np.log(2.0),
        "R{of} is too {small} by {about} {factor}: the measurements scatter {more} than it says.",
        "{Multiply} the covariance of the noise{of} by {factor}{or_more}, or let qpmhe.tune choose "
        "the weights.",
    ),
    "disturbance": _Kind(
        np.log(2.0),
        "Q{of} is too {small} by {about} {factor}: the states move {more} than the model and Q "
        "say.",
        "{Multiply} the covariance of the disturbance{of} by {factor}{or_more}, or let qpmhe.tune "
        "choose the weights; look for what the model lacks.",
    ),
    "gain": _Kind(
        np.log(1.05),
        "{sensors} read{s} about {value} times what the model expects.",
        "Check the units of the record and of the model's outputs, or correct the gain.",
        local=True,
    ),
    "bias": _Kind(
        0.5, "{sensors} {is} off by {sigmas} sigma ({value}){stretch}.",
        "{Calibrate} it, or estimate its bias as a further state.", local=True,
    ),
    "swapped": _Kind(0.0, "{sensors} are swapped.", "Exchange their columns."),
    "step": _Kind(
        0.02, "The true steps are about {value} times as long as the model's.",
        "Correct dt, or the unit of the record's times.",
    ),
    "sign": _Kind(
        0.1, "Input {input} has the wrong sign.", "Change its sign in the record, or in the model."
    ),
    "input": _Kind(
        0.1, "Input {input} acts about {value} times as strongly as the model says.",
        "Correct its unit or its gain, or estimate the gain as a parameter.",
    ),
    "shift": _Kind(
        0.3, "The measurements of {sensors} come {samples} too {late}.",
        "Shift them against the inputs, or add the delay to the model.",
    ),
    "clock": _Kind(
        0.5,
        "The sensors' clock drifts: at the end of the run their samples are {samples} {ahead} the "
        "inputs'.",
        "Synchronise the clocks, or resample the measurements at the inputs' times.",
    ),
    "outliers": _Kind(
        0.0, "There are outliers: {shares} beyond 4 sigma.",
        "Use a qpmhe.RobustCost, with qpmhe.Huber for the noise.", local=True,
    ),
}


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault that explains the record better than none.

    The value is a factor, the least one if there is no `upper` end; for a shift or a clock,
    samples; for a bias, in the sensor's unit.
    """

    kind: str
    value: float
    hypothesis: Hypothesis  # the record and its covariances without the fault
    subject: tuple[int, ...] = ()  # sensors, inputs or disturbances; all if empty
    span: tuple[int, int] | None = None  # first and last sample, if not the whole record
    gain: float = 0.0  # how much more likely the record is with it, as a logarithm
    upper: bool = True

    def in_words(self, names: Names, deviations: Array, outliers: Array) -> Finding:
        """The finding, with the noise's deviations and the shares of outliers of each sensor."""
        kind, value, subject = _KINDS[self.kind], self.value, self.subject
        of, sensors = "", "the sensors"
        if self.kind == "disturbance" and subject:
            of = f" of {listed([names.states[i] for i in subject])}"
        elif subject and self.kind not in ("disturbance", "sign", "input"):
            several = "s" * (len(subject) > 1)
            sensors = f"sensor{several} {listed([names.outputs[j] for j in subject])}"
            of = f" of {sensors}"
        first, last = self.span or (0, len(names.times) - 1)
        stretch = names.between(first, last)
        worst = [j for j in np.argsort(-outliers)[:3] if outliers[j] > 0.0]
        grows = value > 1.0
        words = {
            "of": of, "sensors": sensors, "s": "s" * bool(subject),
            "value": number(value) if self.is_wrong_unit or self.kind != "gain" else f"{value:.3g}",
            "factor": number(float(f"{max(value, 1.0 / value):.2g}")) if value > 0.0 else "",
            "about": "about" if self.upper else "a factor of more than",
            "or_more": "" if self.upper else " or more",
            "small": "small" if grows else "large", "more": "more" if grows else "less",
            "Multiply": "Multiply" if grows else "Divide",
            "input": names.inputs[subject[0]] if self.kind in ("sign", "input") else "",
            "sigmas": number(abs(value) / deviations[subject[0]]) if self.kind == "bias" else "",
            "is": "is" if len(subject) == 1 else "are",
            "Calibrate": "Check the unit and its zero (degrees C or K?), calibrate"
                         if self.is_wrong_unit else "Calibrate",
            "stretch": f" for {names.duration(first, last)},{stretch}" if stretch else "",
            "samples": names.samples(abs(value)), "late": "late" if value > 0.0 else "early",
            "ahead": "ahead of" if value > 0.0 else "behind",
            "shares": listed([f"{outliers[j]:.1%} of {names.outputs[j]}" for j in worst]),
        }
        text = kind.text.format(**words)
        where = None if self.span is None else names.span(first, last)
        return Finding(
            self.kind, text[:1].upper() + text[1:], kind.remedy.format(**words), "fault", where
        )

    @property
    def is_wrong_unit(self) -> bool:
        """Whether it is so large that a unit explains it: then much else may follow from it."""
        if self.kind == "bias":
            variance = float(self.hypothesis.noise[self.subject[0], self.subject[0]])
            return self.span is None and abs(self.value) > _UNIT_OFFSET * np.sqrt(variance)
        return self.kind in ("gain", "input") and not 1.0 / _UNIT < self.value < _UNIT

    @property
    def matters(self) -> bool:
        """Whether its effect is large enough to report."""
        size, noise = self.value, self.hypothesis.noise
        if self.kind in (*SCALED, "gain"):
            size = np.log(size)
        elif self.kind in ("step", "input"):
            size -= 1.0
        elif self.kind == "bias":
            size /= np.sqrt(noise[self.subject[0], self.subject[0]])
        return bool(abs(size) >= _KINDS[self.kind].least)


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
            hypothesis = _with_factor(
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
        *_linear(bank, base, null), *_gains(bank, base, null, starts),
        *_offsets(bank, base, null, starts),
    ]
    logs = bank.run([base, *(one.hypothesis for one in tried)]).logs
    refined = list(_refined(base, tried, logs.sum(axis=0)))
    if refined:
        further = bank.run([base, *(one.hypothesis for one in refined)]).logs[:, 1:]
        tried, logs = [*tried, *refined], np.hstack((logs, further))
    values, there = logs.sum(axis=0), np.isfinite(base.measurements)
    fails = not np.isfinite(values[0])  # then any filter that does not is better
    lowest = np.min(values, where=np.isfinite(values), initial=0.0) - 1e4
    gains = values[1:] - (lowest if fails else values[0])
    # Few samples that a filter mistakes, as after gaps, suit many faults: they are outvoted.
    votes = np.clip(logs[:, 1:] - logs[:, :1], -_MOST_EACH, _MOST_EACH).sum(axis=0)
    least = LEAST_GAIN * (2.0 - there.mean())
    enough = (gains > least + _GAIN_EACH * there.sum()) & (fails | (votes > least))
    best: Fault | None = None
    # By their values: where the record is impossible without any, differences have no digits left.
    for k in np.argsort(-values[1:], kind="stable").tolist():
        one, gain = tried[k], float(gains[k])
        if (gain > least if _KINDS[one.kind].local else enough[k]) and one.matters:
            best = replace(one, gain=gain)
            break
    has_no_ends = best is None or best.kind != "bias" or best.span is None
    return best if best is None or has_no_ends else _with_ends(bank, base, null, best)


def _times(covariance: Array, part: tuple[int, ...], factor: float) -> Array:
    """A covariance with the variances of some components, or of all, multiplied."""
    roots = np.ones(len(covariance))
    roots[list(part) if part else slice(None)] = np.sqrt(factor)
    scaled: Array = roots[:, None] * covariance * roots
    return scaled


def _with_factor(base: Hypothesis, kind: str, part: tuple[int, ...], factor: float) -> Fault:
    where = list(part) if part else slice(None)
    match kind:
        case "step":
            changed = replace(base, step=base.step * factor)
        case "noise":
            changed = replace(base, noise=_times(base.noise, part, factor))
        case "disturbance":
            changed = replace(base, disturbance=_times(base.disturbance, part, factor))
        case "gain":
            y, gains = base.measurements.copy(), np.ones(base.measurements.shape[1])
            y[:, where] /= factor
            gains[where] = factor
            changed = replace(
                base, measurements=y, gains=gains * (1.0 if base.gains is None else base.gains)
            )
        case _:  # sign, input
            inputs = base.inputs.copy()
            inputs[:, where] *= factor
            changed = replace(base, inputs=inputs)
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
            yield _with_factor(base, kind, part, float(np.exp(-0.5 * curve[1] / curve[0])))


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
    if 1 < p <= _MOST:
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
            whole = _Signature("bias", part, outputs, np.zeros((total, bank.system.n)))
            one = replace(whole, outputs=outputs[:_FEW], states=whole.states[:_FEW])
            size = float(np.nanmedian(first[:, part]))
            if not abs(size) > _UNIT_OFFSET * np.sqrt(base.noise[part[0], part[0]]):
                continue  # smaller ones need no such start
            for _ in range(_AGAIN):
                found = bank.run([_removed(begin, one, size).hypothesis])
                against, own = _moments([one], found)
                size += float(against[0] / own[0, 0])
            if np.isfinite(size):
                yield _removed(replace(base, start=begin.start), whole, size)


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
            (k, _with_factor(begins[k], *part, float(10.0**at)))
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
                yield _with_factor(whole, *part, one.value)
            return
        around = spacing * np.linspace(-1.0, 1.0, 9)
        places = {(part, k): np.log10(one.value) + around for part, (k, one) in best}
        spacing /= 4.0


def _exchanged(base: Hypothesis) -> Iterator[Fault]:
    p = base.measurements.shape[1]
    for pair in combinations(range(p), 2) if p <= _MOST else ():
        order = np.arange(p)
        order[list(pair)] = pair[::-1]
        yield Fault("swapped", 0.0, replace(base, measurements=base.measurements[:, order]), pair)
    for j in range(base.inputs.shape[1]):
        yield _with_factor(base, "sign", (j,), -1.0)
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
    none_x = np.zeros((total, bank.system.n))
    inputs = bank.full_inputs(base.inputs, base.step)
    # At each sample from those before it alone: else noise would look like a fault.
    expected, moves = bank.moves(null.states, inputs)
    if base.inputs.shape[1]:
        yield _Signature("shift", (), -moves, none_x)
    if 1 < p <= _MOST:
        for j in range(p):
            yield _Signature("shift", (j,), -moves * (np.arange(p) == j), none_x)
    for j in range(p) if p <= _MOST else ():
        yield _Signature("gain", (j,), expected * (np.arange(p) == j), none_x)
    reached = bank.following(null.corrected, inputs)
    for j in range(base.inputs.shape[1]):
        without = inputs.copy()
        without[:, j] = 0.0
        yield _Signature(
            "input", (j,), expected - bank.expected(null.states, without),
            reached - bank.following(null.corrected, without),
        )
    blocks = max(1, min(32 if p <= _MOST else 8, total // 4))
    edges = np.linspace(0, total, blocks + 1).astype(int).tolist()
    for j in range(p):
        for first, end in pairwise(edges):
            yield _bias(bank, total, j, first, end - 1)


def _bias(bank: FilterBank, total: int, sensor: int, first: int, last: int) -> _Signature:
    outputs = np.zeros((total, bank.system.p))
    outputs[first : last + 1, sensor] = 1.0
    return _Signature(
        "bias", (sensor,), outputs, np.zeros((total, bank.system.n)), (first, last)
    )


def _linear(bank: FilterBank, base: Hypothesis, null: Filtered) -> Iterator[Fault]:
    """Additive faults, of the size that the innovations of the filter without them show.

    An additive fault moves the innovations by a signature that is linear in its size; they are
    white beside it, so that its size is a weighted mean.

    References
    ----------
    Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation
    of jumps in linear systems, IEEE Transactions on Automatic Control 21 (1976).
    """
    if not np.isfinite(null.logs).all():
        return
    signatures = [
        one for one in _signatures(bank, base, null)
        if np.isfinite(one.outputs).all() and np.isfinite(one.states).all()
    ]
    if not signatures:
        return
    against, own = _moments(signatures, null)
    best: dict[tuple[str, tuple[int, ...]], tuple[float, float, _Signature]] = {}
    for one, size, gain in _candidates(bank, signatures, against, own):
        key = one.kind, one.subject
        if gain > 0.5 * LEAST_GAIN and gain > best.get(key, (0.0,))[0]:
            best[key] = gain, size, one
    for _, size, one in best.values():
        # A filter that follows the fault shows less of a gain, or more.
        for share in _AROUND if one.kind == "gain" else (1.0,):
            yield _removed(base, one, share * size)


def _candidates(
    bank: FilterBank, signatures: list[_Signature], against: Array, own: Array
) -> Iterator[tuple[_Signature, float, float]]:
    """Signatures with size and gain: those given, and of biases the best row of stretches."""
    for k, one in enumerate(signatures):
        if one.kind != "bias" and own[k, k] > 0.0:
            yield one, against[k] / own[k, k], 0.5 * against[k] ** 2 / own[k, k]
    for j in range(bank.system.p):
        at = [k for k, one in enumerate(signatures) if (one.kind, one.subject) == ("bias", (j,))]
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
        first, last = signatures[at[i]].span, signatures[at[k - 1]].span
        if gains[i, k] > 0.0 and first is not None and last is not None:
            one = _bias(bank, len(signatures[0].outputs), j, first[0], last[1])
            yield one, float(top[i, k] / bottom[i, k]), float(gains[i, k])


def _moments(signatures: list[_Signature], null: Filtered) -> tuple[Array, Array]:
    """Products of the signatures in the innovations with these (K,), and with each other (K, K)."""
    outputs = np.stack([one.outputs for one in signatures], axis=2)
    states = np.stack([one.states for one in signatures], axis=2)
    there = np.isfinite(null.innovations)
    errors = np.where(there, null.innovations, 0.0)
    moved = np.zeros(states.shape[1:])
    against, own = np.zeros(len(signatures)), np.zeros((len(signatures), len(signatures)))
    for t in range(len(outputs)):
        shown = null.outputs[t] @ moved + outputs[t] * there[t][:, None]
        weighted = null.weights[t] @ shown
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
        signatures = [
            _bias(bank, total, bias.subject[0], begin, end)
            for begin in sorted({max(first + d, 0) for d in (-step, 0, step)})
            for end in sorted({min(last + d, total - 1) for d in (-step, 0, step)})
            if end - begin >= 2
        ]
        against, own = _moments(signatures, null)
        sizes = against / own.diagonal()
        k = int(np.argmax(sizes * against))
        same = signatures[k].span == (first, last)
        first, last = signatures[k].span or (first, last)
        if same and step == 1:
            break
        step = max(1, step // 2) if same else step
    refined = _removed(base, signatures[k], float(sizes[k]))
    values = bank.run([base, refined.hypothesis]).likelihoods
    gain = float(values[1] - values[0])
    return replace(refined, gain=gain) if gain > bias.gain else bias


def _removed(base: Hypothesis, one: _Signature, size: float) -> Fault:
    """The record without this fault."""
    if one.kind == "input":
        kind = "sign" if size < -1.0 else "input"
        return _with_factor(base, kind, one.subject, 1.0 + size)
    if one.kind == "gain":
        return _with_factor(base, "gain", one.subject, float(np.exp(size)))
    y = base.measurements - size * one.outputs
    return Fault(one.kind, size, replace(base, measurements=y), one.subject, one.span)
