"""Families: faults of one kind and subject that differ by a value alone, and its best one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .bank import Array
from .causes import CAUSES
from .faults import Fault

# Kinds that are none at no value.
_NEVER_NONE = ("lag", "coloured", "jitter")
#: By kind, subject and what else they share: place on the scale, log likelihood, and the fault.
Families = dict[tuple[object, ...], list[tuple[float, float, Fault]]]


def families(tried: list[Fault], values: Array) -> Families:
    """The faults with their log likelihoods by families; where there is no value, each is one."""
    found: Families = {}
    for k, (one, value) in enumerate(zip(tried, values.tolist(), strict=True)):
        has_value = one.again is not None and np.isfinite(one.value)
        key = one.kind, one.subject, one.family if has_value else ("single", k)
        found.setdefault(key, []).append((_place(one), value, one))
    return found


def refined(tried: list[Fault], values: Array, most: int | None = None) -> Iterator[Fault]:
    """For each family of values, or the best ones, the top of a parabola through its best ones.

    The first of the log likelihoods is the one without a fault.
    """
    best = sorted(
        families(tried, values[1:]).values(), key=lambda some: -max(value for _, value, _ in some)
    )
    for some in [one for one in best if one[0][2].again is not None][:most]:
        pairs = {at: value for at, value, _ in some}
        if some[0][2].kind not in _NEVER_NONE:
            pairs.setdefault(0.0, float(values[0]))
        places, heights = np.array(sorted(pairs.items())).T
        k = int(np.argmax(heights))
        if not 0 < k < len(places) - 1 or not np.isfinite(heights[k - 1 : k + 2]).all():
            continue
        near = slice(k - 1, k + 2)
        scale = float(np.ptp(places[near]))
        curve = np.polyfit((places[near] - places[k]) / scale, heights[near], 2)
        again = some[0][2].again
        if curve[0] < 0.0 and again is not None:
            top = float(places[k]) - 0.5 * scale * float(curve[1] / curve[0])
            yield again(float(np.exp(top)) if _is_factor(some[0][2]) else top)


def _place(one: Fault) -> float:
    return float(np.log(one.value)) if _is_factor(one) else one.value


def _is_factor(one: Fault) -> bool:
    """Whether its values count by their logarithms."""
    cause = CAUSES[one.kind]
    return one.value > 0.0 and not (cause.adds or cause.size == "deviations")
