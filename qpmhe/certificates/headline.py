"""The bound on an observer's error in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .._checks import Array
from .evidence import Evidence, at_most
from .sizes import intervals

if TYPE_CHECKING:
    from .observer_bound import ObserverBound


def headline(bound: ObserverBound) -> str:
    """The bounds on the observer and on estimates, in the states' units, in one line."""
    limit, after = bound.settled.box, bound.settling_samples
    each = ", ".join(f"|x{i + 1} - z{i + 1}| <= {at_most(b, 3)}" for i, b in enumerate(limit))
    when = f" and at most 10 % more from sample {after} on" if after else ""
    wide = " x ".join(f"{width:.3g}" for width in bound.widths)
    return (
        f"{each} in the limit{when} ({_shown(bound)}{_while(bound)}), on a region {wide} wide"
        f"{_nothing(bound, limit)}; {_of_estimates(bound)}"
    )


def condition(bound: ObserverBound) -> str:
    """Whether state and observer stay in the region, in words."""
    if bound.inner is not None:
        n, place = bound.region.n, bound.inner.region
        start = intervals("x", place.lower[:n], place.upper[:n])
        return (
            f"x and z stay in the region (proved) from {start} on, if the initial error is at "
            "most the limit"
        )
    found = "x stays in the region (proved)"
    if bound.invariance is None or not bound.invariance.holds:
        why = "" if bound.invariance is None else f": {bound.invariance}"
        found = f"it is not proved that x stays in the region{why}"
    return f"{found}; z is checked at each sample"


def _nothing(bound: ObserverBound, limit: Array) -> str:
    """Of which states bounds say nothing; blank if they say something of all."""
    vacuous = ", ".join(f"x{i + 1}" for i in np.flatnonzero(limit >= bound.widths))
    return f": it says nothing about {vacuous}" if vacuous else ""


def _while(bound: ObserverBound) -> str:
    """What must hold besides; blank if nothing must."""
    if bound.begins_within:
        return ", from an initial error within the limit on"
    stays = bound.invariance is not None and bound.invariance.holds
    return "" if stays else ", while x stays in the region"


def _shown(bound: ObserverBound) -> str:
    """The evidence, and for what."""
    compared = bound.stability.compared
    if not compared:
        return str(bound.evidence)
    return f"{bound.evidence} for the traced model, which agreed with f at {compared} points"


def _of_estimates(bound: ObserverBound) -> str:
    """What follows for an estimate x_hat."""
    offset = "|x_hat - z| + b"
    if bound.evidence is not Evidence.PROVED or bound.sizes.deviations:
        return f"x_hat is within {offset} along a run"
    limit = 2.0 * bound.settled.box
    twice = ", ".join(at_most(b, 3) for b in limit)
    return (
        f"guarded, x_hat is within min(2 b, {offset}) along a run, and in advance within 2 b = "
        f"{twice}{_nothing(bound, limit)}"
    )
