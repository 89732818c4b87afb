"""Additive faults: how one moves outputs and states, and its size, which the innovations show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from .bank import Array, FilterBank, Filtered, Hypothesis
from .faults import LEAST_GAIN, MOST_PARTS, Evidence, Fault, with_factor

# Shares of the size that innovations show of a gain.
_AROUND = (0.5, 1.0, 1.5, 2.5)
# Places where a ramp may begin.
_RAMPS = 12
# By what share the evidence for ends must be larger.
_AS_GOOD = 1e-9
# Samples that are moved before products are taken.
_TOGETHER = 256


@dataclass(frozen=True, eq=False)
class Signature:
    """How a fault of size one moves the outputs (T, p) and, if at all, the states (T, n)."""

    kind: str
    subject: tuple[int, ...]
    outputs: Array
    states: Array | None = None
    span: tuple[int, int] | None = None


def _signatures(evidence: Evidence) -> Iterator[Signature]:
    bank, base, null, total = evidence.bank, evidence.base, evidence.null, evidence.total
    p, m, inputs = base.measurements.shape[1], base.inputs.shape[1], evidence.inputs
    # At each sample from those before it alone: else noise would look like a fault.
    expected, moves = bank.moves(null.states, inputs)
    if m:
        yield Signature("shift", (), -moves)
    if p > 1:
        for part in evidence.sensors:
            yield Signature("shift", part, -moves * (np.arange(p) == part[0]))
    for part in evidence.sensors:
        yield Signature("gain", part, expected * (np.arange(p) == part[0]))
    if p > 1:
        yield Signature("gain", (), expected)
    reached = bank.following(null.corrected, inputs)
    for j in range(m):
        without = inputs.copy()
        without[:, j] = 0.0
        yield Signature(
            "input" if j < m - evidence.parameters else "parameter", (j,),
            expected - bank.expected(null.states, without),
            reached - bank.following(null.corrected, without),
        )
    blocks = max(1, min(32 if p <= MOST_PARTS else 8, total // 4))
    edges = np.linspace(0, total, blocks + 1).astype(int).tolist()
    for j in range(p):
        for first, end in pairwise(edges):
            yield _bias(bank, total, j, first, end - 1)
    for part in evidence.sensors:
        for first in np.linspace(0, total, _RAMPS + 1).astype(int).tolist()[:-1]:
            outputs = np.zeros((total, p))
            outputs[first:, part[0]] = np.arange(total - first)
            yield Signature("ramp", part, outputs, None, (first, total - 1))


def _bias(bank: FilterBank, total: int, sensor: int, first: int, last: int) -> Signature:
    outputs = np.zeros((total, bank.system.p))
    outputs[first : last + 1, sensor] = 1.0
    return Signature("bias", (sensor,), outputs, None, (first, last))


def additive(kind: str) -> Callable[[Evidence], list[Fault]]:
    """What makes the additive faults of a kind; all kinds are looked for together."""

    def found(evidence: Evidence) -> list[Fault]:
        if "additive" not in evidence.shared:
            evidence.shared["additive"] = list(_additive_faults(evidence))
        return [one for one in evidence.shared["additive"] if one.kind == kind]

    return found


def _additive_faults(evidence: Evidence) -> Iterator[Fault]:
    """Additive faults, of the size that the innovations of the filter without them show.

    An additive fault moves the innovations by a signature that is linear in its size; they are
    white beside it, so that its size is a weighted mean.

    References
    ----------
    Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation
    of jumps in linear systems, IEEE Transactions on Automatic Control 21 (1976).
    """
    bank, base, null = evidence.bank, evidence.base, evidence.null
    if not np.isfinite(null.logs).all():
        return
    signatures = [
        one for one in _signatures(evidence)
        if np.isfinite(one.outputs).all()
        and (one.states is None or np.isfinite(one.states).all())
    ]
    if not signatures:
        return
    against, own = moments(signatures, null)
    best: dict[tuple[str, tuple[int, ...]], tuple[float, float, Signature]] = {}
    for one, size, gain in _candidates(bank, signatures, against, own):
        key = one.kind, one.subject
        if gain > 0.5 * LEAST_GAIN and gain > best.get(key, (0.0,))[0]:
            best[key] = gain, size, one
    for _, size, one in best.values():
        # A filter that follows the fault shows less of a gain, or more.
        for share in _AROUND if one.kind == "gain" else (1.0,):
            yield removed(base, one, share * size)


def _candidates(
    bank: FilterBank, signatures: list[Signature], against: Array, own: Array
) -> Iterator[tuple[Signature, float, float]]:
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


def moments(signatures: list[Signature], null: Filtered) -> tuple[Array, Array]:
    """Products of the signatures in the innovations with these (K,), and with each other (K, K).

    The latter for those of one kind and subject; they are 0 between others.
    """
    (total, n), k = null.states.shape, len(signatures)
    moved, against, own = np.zeros((n, k)), np.zeros(k), np.zeros((k, k))
    moving = [i for i, one in enumerate(signatures) if one.states is not None]
    keys = [(one.kind, one.subject) for one in signatures]
    alike = [np.flatnonzero([other == key for other in keys]) for key in dict.fromkeys(keys)]
    for first in range(0, total, _TOGETHER):  # all of a long record would not fit in a cache
        part = slice(first, first + _TOGETHER)
        there, c, gains = np.isfinite(null.innovations[part]), null.outputs[part], null.gains[part]
        errors, a = np.where(there, null.innovations[part], 0.0), null.transitions[part]
        shown = np.stack([one.outputs[part] for one in signatures], axis=2) * there[:, :, None]
        entering = -(a @ gains) @ shown
        entering[:, :, moving] += np.stack(
            [np.zeros((len(a), n)), *(one.states[part] for one in signatures
                                      if one.states is not None)], axis=2)[:, :, 1:]
        both = np.concatenate((c, a @ (np.eye(n) - gains @ c)), axis=1)
        for t in range(len(both)):
            found = both[t] @ moved
            shown[t] += found[:-n]
            moved = found[-n:] + entering[t]
        # All samples at once: W shown, and shown' W shown.
        weighted, shown = (one.reshape(-1, k) for one in (null.weights[part] @ shown, shown))
        for some in alike:
            own[np.ix_(some, some)] += shown[:, some].T @ weighted[:, some]
        against += errors.ravel() @ weighted
    return against, own


def with_ends(bank: FilterBank, base: Hypothesis, null: Filtered, bias: Fault) -> Fault:
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
        against, products = moments(signatures, null)
        sizes = against / products.diagonal()
        merits = sizes * against
        k = int(np.argmax(merits))
        # Ends beside missing samples are as good as others: rounding must not lead to and fro.
        own = [i for i, one in enumerate(signatures) if one.span == (first, last)]
        same = bool(own) and not merits[k] > (1.0 + _AS_GOOD) * merits[own[0]]
        k = own[0] if same else k
        first, last = signatures[k].span or (first, last)
        if same and step == 1:
            break
        step = max(1, step // 2) if same else step
    refined = removed(base, signatures[k], float(sizes[k]))
    values = bank.run([base, refined.hypothesis]).likelihoods
    gain = float(values[1] - values[0])
    return replace(refined, gain=gain) if gain > bias.gain else bias


def removed(base: Hypothesis, one: Signature, size: float) -> Fault:
    """The record without this fault."""
    if one.kind in ("input", "parameter"):
        return with_factor(base, one.kind, one.subject, 1.0 + size)
    if one.kind == "gain":
        return with_factor(base, "gain", one.subject, float(np.exp(size)))
    changed = replace(base, measurements=base.measurements - size * one.outputs)
    return Fault(
        one.kind, size, changed, one.subject, one.span,
        again=lambda value: removed(base, one, value), family=one.span,
    )
