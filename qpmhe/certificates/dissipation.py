r"""The search for the Lyapunov design: with the sum of squares, and the weights of a cost."""

from __future__ import annotations

import math

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from ..model.system import System
from .deadline import Deadline
from .inequalities import Form as Dissipation
from .regions import Region
from .search import Search
from .sizes import Sizes, sides_of

__all__ = ["DesignSearch", "Dissipation", "growth", "largest_sizes"]


def DesignSearch(  # noqa: N802
    system: System, region: Region, sizes: Sizes, horizon: int | None,
    seconds: float | Deadline,
) -> Search:
    """The search for weights whose limit for this horizon is smallest."""
    return Search(
        system, region, None, largest_sizes(sizes), seconds=seconds,
        growth=lambda rate: growth(rate * rate, horizon),
    )


def largest_sizes(sizes: Sizes) -> tuple[float | Array, float | Array]:
    """The largest disturbances and noises: lengths, or half-widths by component."""
    w, v = (
        np.abs(sides_of(name, given)).max(axis=0) if isinstance(given, ConvexSet) else given
        for name, given in (("disturbances", sizes.disturbance), ("noises", sizes.noise))
    )
    return w, v


def growth(gamma: float, horizon: int | None) -> float:
    r"""The square of the limit for a supply of 1: :math:`4 S / (1 - 4 \gamma^N)`, S its sum."""
    left = 0.0 if horizon is None else gamma**horizon
    if 4.0 * left >= 1.0:
        return math.inf
    return 4.0 * (1.0 - left) / ((1.0 - gamma) * (1.0 - 4.0 * left))
