"""Noise that is not what R says: it changes once, is of time stamps, or of rounding."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from .bank import Array, Hypothesis
from .faults import LEAST_GAIN, Evidence, Fault, times
from .sensor_memory import coloured

# Shares of a step by which times may be off.
_JITTERS = (0.05, 0.1, 0.2, 0.4, 0.8)
# Samples that both sides of a change have at least; beyond this, innovations count as this.
_LEAST, _FAR = 20, 4.0
# What the innovations must show of a change in log likelihood, as a share of what it must gain, and
# factors beside the one that they show.
_SHOWN = 0.25
_AROUND = (0.4, 1.0, 2.5)
# A grid of numbers: how far multiples may be off, how many distinct ones it has at most as a share
# of the samples, and the least step in deviations of the noise.
_ROUNDING, _DISTINCT, _STEP = 1e-3, 0.7, 0.7
# How long the error of rounding stays the same: shares that remain after a sample.
_KEPT = (0.5, 0.8, 0.92, 0.98)


def changing(evidence: Evidence) -> Iterator[Fault]:
    """R of a sensor, or of all, that is another one from some sample on."""
    if not np.isfinite(evidence.null.logs).all():
        return
    squares = np.clip(evidence.null.normalised, -_FAR, _FAR) ** 2
    p = squares.shape[1]
    for part in [*evidence.sensors, *([()] if p > 1 else [])]:
        columns = squares[:, list(part) or slice(None)]
        first, ratio = _change(columns)
        if first:
            for size in _AROUND:
                yield changed(evidence.base, part, first, ratio * size)


def _change(squares: Array) -> tuple[int, float]:
    """The sample from which on squares have another mean, most likely, and the ratio of means.

    The sample is 0 where they show none.
    """
    there = np.isfinite(squares)
    counts = np.cumsum(there.sum(axis=1))
    sums = np.cumsum(np.where(there, squares, 0.0).sum(axis=1))
    if counts[-1] < 2 * _LEAST:
        return 0, 1.0
    before, behind = sums / np.maximum(counts, 1), (sums[-1] - sums) / np.maximum(
        counts[-1] - counts, 1)
    fits = (counts >= _LEAST) & (counts[-1] - counts >= _LEAST) & (before > 0.0) & (behind > 0.0)
    if not fits.any():
        return 0, 1.0
    with np.errstate(all="ignore"):
        logs = -(counts * np.log(before) + (counts[-1] - counts) * np.log(behind))
    k = int(np.argmax(np.where(fits, logs, -np.inf)))
    whole = float(-counts[-1] * np.log(sums[-1] / counts[-1]))
    if 0.5 * (logs[k] - whole) < _SHOWN * LEAST_GAIN:
        return 0, 1.0
    return k + 1, float(behind[k] / before[k])


def changed(base: Hypothesis, part: tuple[int, ...], first: int, factor: float) -> Fault:
    """The record with R multiplied from a sample on."""
    total = len(base.measurements)
    noise = np.array(np.broadcast_to(base.noise, (total, *base.noise.shape[-2:])))
    noise[first:] = times(noise[first:], part, factor)
    return Fault(
        "change", factor, replace(base, noise=noise), part, (first, total - 1),
        again=lambda value: changed(base, part, first, value),
    )


def jittering(evidence: Evidence) -> Iterator[Fault]:
    """Measurements at times that are off by random shares of a step: noise where outputs move."""
    if not np.isfinite(evidence.null.logs).all():
        return
    _, moves = evidence.bank.moves(evidence.null.states, evidence.inputs)
    if not np.isfinite(moves).all():
        return

    def made(share: float) -> Fault:
        noise = evidence.base.noise + share**2 * moves[:, :, None] * moves[:, None, :]
        return Fault("jitter", share, replace(evidence.base, noise=noise), again=made)

    for share in _JITTERS:
        yield made(share)


def rounded(evidence: Evidence) -> Iterator[Fault]:
    """Sensors whose numbers are multiples of a step: its error is noise that R may lack."""
    for part in evidence.sensors:
        step = step_of(evidence.base, part[0])
        if step:
            variance = np.zeros_like(evidence.base.usual_noise)
            variance[part[0], part[0]] = step**2 / 12.0
            noise = evidence.base.noise + variance
            yield Fault("quantised", step, replace(evidence.base, noise=noise), part)
            for kept in _KEPT:
                share = float(variance[part[0], part[0]] / evidence.base.usual_noise[part * 2])
                other = coloured(evidence, part, kept, 1.0, share)
                yield replace(other, kind="quantised", value=step, again=None)


def step_of(base: Hypothesis, sensor: int) -> float:
    """The step of a sensor's numbers; zero if they have none that matters."""
    y = base.measurements[:, sensor] * (1.0 if base.gains is None else base.gains[sensor])
    values, counts = np.unique(y[np.isfinite(y)], return_counts=True)
    if len(values) < 3 or len(values) > _DISTINCT * counts.sum():
        return 0.0
    step = min(b - a for a, b in pairwise(values.tolist()))
    multiples = (values - values[0]) / step
    whole = (np.abs(multiples - np.rint(multiples)) < _ROUNDING).all()
    enough = step > _STEP * np.sqrt(base.usual_noise[sensor, sensor])
    return float(step) if whole and enough else 0.0
