"""Linear algebra whose results do not depend on the units of the components."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["inverse"]

Array = NDArray[np.float64]


def inverse(matrix: Array) -> Array:
    """The inverse of a symmetric positive definite matrix.

    Scaled to a unit diagonal first: pivots then do not depend on units, and the results for
    units that differ by powers of two differ by these powers exactly.
    """
    scale = np.sqrt(matrix.diagonal())
    outer = np.outer(scale, scale)
    found = np.linalg.inv(matrix / outer)
    return np.asarray(0.5 * (found + found.T) / outer)
