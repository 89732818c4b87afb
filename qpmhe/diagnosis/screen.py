"""Which hypotheses stretches of a long record leave to be filtered over all of it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from .bank import Array, FilterBank, Hypothesis
from .families import families, refined
from .faults import Evidence, Fault

# So many stretches of so many samples: half of them are spread evenly, and half are those least
# like the model; their first samples are no evidence. A record of so many times more is long.
_STRETCHES, _LENGTH, _SETTLING, _LONG = 4, 150, 20, 4
# What contradicts a value, in log likelihood; the share of the best family's gain that others must
# reach; and their values, beside the best one, that are filtered over the whole record.
_LOSES, _OF_BEST, _BESIDE = -30.0, 0.3, 2


def screened(
    evidence: Evidence, tried: list[Fault], local: Collection[str], least: float
) -> list[Fault]:
    """Those of the faults that may explain the record: all, unless it is long.

    What is ``local`` may concern samples between the stretches, and stays; a value that is one of
    the whole record only if the stretches do not contradict it. Of other kinds, a family stays that
    gains ``least`` for each measurement of the stretches, by its best values.
    """
    if evidence.total < _LONG * _STRETCHES * _LENGTH or not np.isfinite(evidence.null.logs).all():
        return tried
    stretches = _Stretches(evidence)
    found = [one for one in tried if one.kind in local and not _is_everywhere(one)]
    steady = [one for one in tried if one.kind in local and _is_everywhere(one)]
    found += [
        one for one, gain in zip(steady, stretches.gains(steady), strict=True) if gain > _LOSES]
    doubtful, gains = stretches.likely([one for one in tried if one.kind not in local])
    for _ in range(2):
        better = list(refined(doubtful, np.append(0.0, gains)))
        if better:
            doubtful, gains = [*doubtful, *better], np.append(gains, stretches.gains(better))
    enough = max(least * stretches.measured, _OF_BEST * max(gains, default=0.0))
    return found + [one for _, one in _best_values(doubtful, gains, _BESIDE, enough)]


def _best_values(
    tried: list[Fault], gains: Array, beside: int, least: float = -np.inf
) -> list[tuple[float, Fault]]:
    """Of families that gain more than the least: the best value with those beside it, and gains."""
    found = []
    for some in families(tried, gains).values():
        if max(gain for _, gain, _ in some) > least:
            some.sort(key=lambda one: one[0])
            k = max(range(len(some)), key=lambda i: some[i][1])
            found += [(gain, one) for _, gain, one in some[max(0, k - beside) : k + beside + 1]]
    return found


def _is_everywhere(one: Fault) -> bool:
    return one.again is not None and one.span is None


class _Stretches:
    """Stretches of a record, from the states of the filter that is there."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        squares = np.nan_to_num(np.clip(evidence.null.normalised, -4.0, 4.0) ** 2).sum(axis=1)
        begins = np.arange(0, evidence.total - _LENGTH + 1, _LENGTH)
        half = _STRETCHES // 2
        even = np.linspace(0, len(begins) - 1, half).round().astype(int)
        sums = np.add.reduceat(squares[: begins[-1] + _LENGTH], begins)
        sums[even] = -np.inf
        worst = np.argsort(-sums, kind="stable")[: _STRETCHES - half]
        self._begins = begins[np.append(even, worst)].tolist()
        judged = np.concatenate([np.arange(k + _SETTLING, k + _LENGTH) for k in self._begins])
        #: How many measurements judge.
        self.measured = int(np.isfinite(evidence.null.innovations[judged]).sum())

    def likely(self, tried: list[Fault]) -> tuple[list[Fault], Array]:
        """Of each family, the values that half of the stretches prefer, and what they gain."""
        half = self.gains(tried, self._begins[::2])
        kept = _best_values(tried, half, _BESIDE, -np.inf)
        some = [one for _, one in kept]
        return some, np.array([gain for gain, _ in kept]) + self.gains(some, self._begins[1::2])

    def gains(self, tried: list[Fault], begins: list[int] | None = None) -> Array:
        """What each gains in log likelihood on the stretches, or on some of them."""
        base, sums = self._evidence.base, np.zeros(len(tried))
        for begin in self._begins if begins is None else begins:
            banks: dict[int, FilterBank] = {}
            x = self._evidence.null.states[begin]
            parts = [self._part(one, begin, x, banks) for one in (
                base, *(each.hypothesis for each in tried))]
            bank = banks[id(self._evidence.bank)]
            logs = bank.run(parts).logs[_SETTLING:].sum(axis=0)
            sums += np.where(np.isfinite(logs[1:]), logs[1:] - logs[0], -np.inf)
        return sums

    def _part(
        self, one: Hypothesis, begin: int, x: Array, banks: dict[int, FilterBank]
    ) -> Hypothesis:
        own = one.bank or self._evidence.bank
        if id(own) not in banks:
            banks[id(own)] = own.part(begin, _LENGTH, self._evidence.total)
        bank, found = banks[id(own)], one.part(begin, _LENGTH)
        return replace(
            found, start=bank.started(found, x), bank=None if one.bank is None else bank)
