"""The sets X, W and V of the estimation problem (eq:constraints)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._checks import numbers
from .errors import SetError

__all__ = ["Box"]

Array = NDArray[np.float64]


class Box:
    r"""A box :math:`\{s : \ell \le s \le u\}`, open-ended where a bound is infinite.

    Parameters
    ----------
    lower, upper : array_like
        Bounds of equal shape (d,), in the units of the vector that they bound; ``-inf`` and
        ``inf`` where a component is unbounded.

    Raises
    ------
    SetError
        If the shapes differ, a bound is NaN, or the box is empty.
    """

    __slots__ = ("dimension", "lower", "upper")

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        low = np.atleast_1d(numbers("lower", lower, finite=False))
        high = np.atleast_1d(numbers("upper", upper, finite=False))
        if low.ndim != 1 or low.shape != high.shape:
            raise SetError(
                f"lower has shape {low.shape} and upper {high.shape}; expected two vectors of "
                "equal length, with -inf and inf where a component is unbounded."
            )
        if np.isnan(low).any() or np.isnan(high).any():
            raise SetError(
                f"a bound is NaN (lower {low.tolist()}, upper {high.tolist()}); "
                "write -inf or inf where a component is unbounded."
            )
        empty = (low > high) | (low == np.inf) | (high == -np.inf)
        if empty.any():
            j = int(np.argmax(empty))
            raise SetError(
                f"the box is empty: component {j} has lower {low[j]} and upper {high[j]}; "
                "expected lower <= upper."
            )
        self.lower: Array = low
        self.upper: Array = high
        self.dimension: int = low.size

    def violation(self, points: Array) -> float:
        """The largest distance by which a component of points, (..., d), leaves the box."""
        outside = np.maximum(self.lower - points, points - self.upper)
        return max(0.0, float(outside.max()))

    def __repr__(self) -> str:
        return f"Box({self.lower.tolist()}, {self.upper.tolist()})"
