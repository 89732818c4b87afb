"""Hypotheses that a filter has to judge: covariances, order, units and times of a record."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from .bank import Filtered, Hypothesis
from .faults import MOST_PARTS, UNIT_OFFSET, Evidence, Fault, with_factor
from .signatures import Signature, moments, removed

_FACTORS = (1 / 4096, 1 / 128, 1 / 16, 1 / 4, 4.0, 16.0, 128.0, 4096.0)
_STEPS = (0.5, 0.7, 0.85, 0.95, 1.05, 1.2, 1.5, 2.0)
# Delays in samples, at most this share of the record, and drifts of clocks until its end.
_SHIFTS, _SHARE = (1, 2, 4, 8, 16, 32), 0.1
_DRIFTS = (-16, -11, -8, -5, -3, -2, 2, 3, 5, 8, 11, 16)
# Exponents of the gains that are tried first, and how closely they are searched.
_NEAR = np.array([0.02, 0.05, 0.1, 0.2])
_GAINS, _CLOSELY = np.sort(np.concatenate((np.linspace(-7.0, 7.0, 29), _NEAR, -_NEAR))), 0.001
# They are tried where the mean square of a sensor's normalised innovations is not within these, on
# so many samples; the best ones are searched closely.
_SUSPICIOUS, _FEW, _BEST = (0.5, 2.0), 100, 3
# Offsets are first what so many samples say, and then found again so many times.
_SOON, _AGAIN = 5, 4
# Signs are tried beside factors of an input.
_INPUTS = (0.5, 0.8, 1.25, 2.0)


def noise(evidence: Evidence) -> Iterator[Fault]:
    """R of all sensors, and of each, multiplied."""
    return _scaled(evidence.base, "noise", evidence.base.usual_noise.diagonal())


def disturbance(evidence: Evidence) -> Iterator[Fault]:
    """Q of all states, and of each, multiplied."""
    return _scaled(evidence.base, "disturbance", evidence.base.disturbance.diagonal())


def _scaled(base: Hypothesis, kind: str, variances: np.ndarray) -> Iterator[Fault]:
    there = np.flatnonzero(variances)
    parts: list[tuple[int, ...]] = [()]
    if 1 < there.size <= MOST_PARTS:
        parts += [(int(i),) for i in there]
    for part in parts:
        for factor in _FACTORS:
            yield with_factor(base, kind, part, factor)


def step(evidence: Evidence) -> Iterator[Fault]:
    """Steps of another length."""
    for factor in _STEPS:
        yield with_factor(evidence.base, "step", (), factor)


def input_gain(evidence: Evidence) -> Iterator[Fault]:
    """Inputs that act more strongly or weakly."""
    for j in range(evidence.base.inputs.shape[1] - evidence.parameters):
        for factor in _INPUTS:
            yield with_factor(evidence.base, "input", (j,), factor)


def parameter(evidence: Evidence) -> Iterator[Fault]:
    """Parameters of the model that have another value."""
    m = evidence.base.inputs.shape[1]
    for j in range(m - evidence.parameters, m):
        for factor in _INPUTS:
            yield with_factor(evidence.base, "parameter", (j,), factor)


def sign(evidence: Evidence) -> Iterator[Fault]:
    """Inputs with the wrong sign."""
    for j in range(evidence.base.inputs.shape[1] - evidence.parameters):
        yield replace(with_factor(evidence.base, "sign", (j,), -1.0), again=None)


def swapped(evidence: Evidence) -> Iterator[Fault]:
    """Two sensors in each other's columns."""
    base = evidence.base
    p = base.measurements.shape[1]
    for pair in combinations(range(p), 2) if p <= MOST_PARTS else ():
        order = np.arange(p)
        order[list(pair)] = pair[::-1]
        yield Fault("swapped", 0.0, replace(base, measurements=base.measurements[:, order]), pair)


def outliers(evidence: Evidence) -> Iterator[Fault]:
    """Single measurements that are no evidence."""
    yield Fault("outliers", 1.0, replace(evidence.base, outliers=True))


def shift(evidence: Evidence) -> Iterator[Fault]:
    """Measurements, of all sensors or of one, that come late or early."""
    base, total = evidence.base, evidence.total
    p = base.measurements.shape[1]
    parts: list[tuple[int, ...]] = [()] if base.inputs.shape[1] else []  # late for what?
    if p > 1:
        parts += evidence.sensors
    for part in parts:
        for late in _SHIFTS:
            for way in (late, -late):
                if late <= max(2.0, _SHARE * total):
                    yield _shifted(base, part, way)


def _shifted(base: Hypothesis, part: tuple[int, ...], late: float) -> Fault:
    total, p = base.measurements.shape
    columns, samples = list(part) or list(range(p)), round(late)
    y = base.measurements.copy()
    times = np.arange(total) + samples
    there = (times >= 0) & (times < total)
    y[:, columns] = np.nan
    y[np.ix_(there, columns)] = base.measurements[np.ix_(times[there], columns)]
    return Fault(
        "shift", float(samples), replace(base, measurements=y), part,
        again=lambda value: _shifted(base, part, value), family="whole",
    )


def clock(evidence: Evidence) -> Iterator[Fault]:
    """The record as of clocks of the sensors that gain or lose samples until its end."""
    base, bank = evidence.base, evidence.bank
    y, total = base.measurements, evidence.total
    if not base.inputs.shape[1]:
        return  # there is no other clock: it would be the step
    _, moves = bank.moves(evidence.null.states, evidence.inputs)

    def made(late: float) -> Fault:
        # Right at the beginning of the record, which may be before the filter's.
        times = np.arange(total)
        when = times + late * (times + bank.before) / (total + bank.before)
        before = np.floor(when).astype(np.intp)  # whose input acts at the time
        there = (before >= 0) & (before < total)
        before, when = before[there], when[there]
        moved = np.full_like(y, np.nan)
        moved[before] = y[there] - (when - before)[:, None] * moves[before]
        return Fault("clock", late, replace(base, measurements=moved), again=made)

    for late in _DRIFTS:
        if abs(late) <= total / 10:
            yield made(float(late))


def _is_suspicious(null: Filtered) -> bool:
    """Whether innovations are so large or small that a sensor or an input may have another unit."""
    sizes = np.nanmean(null.normalised**2, axis=0)
    usual = (sizes > _SUSPICIOUS[0]) & (sizes < _SUSPICIOUS[1]) | np.isnan(sizes)
    return not (np.isfinite(null.logs).all() and usual.all())


def _beginnings(evidence: Evidence) -> tuple[Hypothesis, list[Hypothesis]]:
    """The first samples, and the same from each start.

    A wrong unit shows everywhere, also in the estimates from which the filters would begin.
    """
    base = evidence.base
    short = replace(base, measurements=base.measurements[:_FEW], inputs=base.inputs[:_FEW])
    return short, [replace(short, start=one) for one in evidence.starts] or [short]


def offsets(evidence: Evidence) -> Iterator[Fault]:
    """Sensors with another zero, as of another unit, alone and together.

    Where it is far off, bounds or a lost linearisation hold the filter: the size is first what the
    start says, and then what filters of the corrected record say.
    """
    bank, base = evidence.bank, evidence.base
    if not _is_suspicious(evidence.null):
        return
    total, p = base.measurements.shape
    parts: list[tuple[int, ...]] = [(j,) for j in range(p)]
    if 1 < p <= MOST_PARTS:
        parts += combinations(range(p), 2)
    if p > 2:
        parts.append(tuple(range(p)))
    for begin in _beginnings(evidence)[1]:
        y, inputs = begin.measurements, bank.full_inputs(begin.inputs, begin.step)
        expected = bank.expected(np.tile(begin.start, (len(y), 1)), inputs)
        first = bank.errors(y, expected)[:_SOON]
        for part in parts:
            outputs = np.zeros((total, p))
            outputs[:, part] = 1.0
            whole = Signature("bias", part, outputs)
            one = replace(whole, outputs=outputs[:_FEW])
            size = float(np.nanmedian(first[:, part]))
            if not abs(size) > UNIT_OFFSET * np.sqrt(base.usual_noise[part[0], part[0]]):
                continue  # smaller ones need no such start
            for _ in range(_AGAIN):
                found = bank.run([removed(begin, one, size).hypothesis])
                against, own = moments([one], found)
                size += float(against[0] / own[0, 0])
            if np.isfinite(size):
                yield removed(replace(base, start=begin.start), whole, size)


def units(kind: str) -> Callable[[Evidence], list[Fault]]:
    """What makes the faults of a kind that are wrong units; all kinds compete at first."""

    def found(evidence: Evidence) -> list[Fault]:
        if "units" not in evidence.shared:
            evidence.shared["units"] = list(_units(evidence))
        return [one for one in evidence.shared["units"] if one.kind == kind]

    return found


def _units(evidence: Evidence) -> Iterator[Fault]:
    """Sensors and inputs in other units: of each, the factor that makes the record likeliest."""
    bank, base = evidence.bank, evidence.base
    if not _is_suspicious(evidence.null):
        return
    p, m = base.measurements.shape[1], base.inputs.shape[1]
    parts: list[tuple[str, tuple[int, ...]]] = [
        ("input" if j < m - evidence.parameters else "parameter", (j,)) for j in range(m)
    ]
    parts += [("gain", (j,)) for j in range(p)] + [("gain", ())] * (p > 1)
    short, begins = _beginnings(evidence)
    places = {(part, k): _GAINS for part in parts for k in range(len(begins))}
    spacing = float(_GAINS[1] - _GAINS[0])
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
