"""Points at which functions are tried and compared: of several magnitudes, within bounds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .sets import ConvexSet

Array = NDArray[np.float64]
Points = list[tuple[Array, Array]]

_SEED = 20210829
# Inputs of models grow no further than this.
_LARGEST_INPUT = 100.0


class Magnitude(NamedTuple):
    """The size of the numbers, and the least share of it: 0.2 for positive ones, -1 for all."""

    size: float
    least: float


#: Positive numbers first, where most models are defined; then all signs, where branches part.
FEW = tuple(Magnitude(*one) for one in (
    (1.0, 0.2), (1.0, -1.0), (3.0, 0.2), (0.3, 0.2), (10.0, -1.0),
))
#: Of usual sizes.
USUAL = tuple(Magnitude(*one) for one in ((1.0, 0.2), (1.0, -1.0), (3.0, -1.0), (0.1, 0.2)))
#: Of all sizes, usual ones first.
ALL = (*USUAL, *(Magnitude(*one) for one in (
    (10.0, -1.0), (100.0, 0.2), (1e-3, -1.0), (1e4, 0.2),
)))


def states_at(
    generator: np.random.Generator, one: Magnitude, shape: tuple[int, ...],
    bounds: ConvexSet | None = None, scales: Array | float = 1.0,
) -> Array:
    """Random states (..., n) of a magnitude, times the scales, moved within the bounds of X."""
    x = scales * (one.size * generator.uniform(one.least, 1.0, shape))
    if bounds is None:
        return x
    low, high = bounds.lower, bounds.upper
    both = np.isfinite(low) & np.isfinite(high)
    share = generator.uniform(0.2, 0.8, shape)
    with np.errstate(invalid="ignore"):
        return np.where(both, low + share * (high - low), np.clip(x, low, high))


def points(
    magnitudes: Iterable[Magnitude], n: int, m: int, bounds: ConvexSet | None = None,
    scales: Array | float = 1.0,
) -> Points:
    """A state (n,) and an input (m,) of each magnitude: the same for the same arguments.

    Parameters
    ----------
    magnitudes : sequence of Magnitude
        Such as `FEW`, `USUAL` or `ALL`.
    n, m : int
        Numbers of states and inputs.
    bounds : ConvexSet, optional
        X, within whose bounds the states are.
    scales : (n,) array, optional
        Typical magnitudes of the states, for others than one.
    """
    generator = np.random.default_rng(_SEED)
    return [
        (
            states_at(generator, one, (n,), bounds, scales),
            min(one.size, _LARGEST_INPUT) * generator.uniform(one.least, 1.0, m),
        )
        for one in magnitudes
    ]


def arguments(magnitudes: Iterable[Magnitude], sizes: tuple[int, ...]) -> Iterator[list[Array]]:
    """Vectors of these sizes, of each magnitude."""
    for x, u in points(magnitudes, sum(sizes), 0):
        del u
        yield np.split(x, np.cumsum(sizes)[:-1])
