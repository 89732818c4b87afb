"""Linear algebra whose results do not depend on the units of the components.

Pivots depend on units. So a positive definite matrix is first scaled by powers of two to a
diagonal of order one: a change of units, or of the whole, by powers of two then changes no
digit of a result.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Exponents = NDArray[np.int32]
_EPS = float(np.finfo(np.float64).eps)
# Negative eigenvalues of correlations up to this size are rounding; C has the same number.
_INDEFINITE = 1e-9


def unit_diagonal(matrix: Array) -> tuple[Array, Exponents, int]:
    """The matrix, scaled to a diagonal between 1/2 and 4, and the exponents that scale it back.

    ``matrix[i, j] = 2**(whole + units[i] + units[j]) * scaled[i, j]``, without rounding.
    """
    exponents = np.frexp(matrix.diagonal())[1]
    # The first component's unit takes the square root of the whole's: an odd power is left.
    whole = int(exponents[:1].sum()) % 2
    units: Exponents = (exponents - whole) // 2
    scaled: Array = np.ldexp(matrix, -whole - units[:, None] - units)
    return scaled, units, whole


def inverse(matrix: Array) -> Array:
    """The inverse of a symmetric positive definite matrix (d, d), exactly symmetric."""
    scaled, units, whole = unit_diagonal(matrix)
    found = np.linalg.inv(scaled)
    result: Array = np.ldexp(0.5 * (found + found.T), -whole - units[:, None] - units)
    return result


def least_pivot(matrix: Array) -> float:
    """The least variance of a component given those before it, as a share of its variance.

    Negative for what is no covariance: not finite or, beyond rounding, not positive semidefinite.
    """
    variances = matrix.diagonal()
    if not (np.isfinite(matrix).all() and variances.min() >= 0.0):
        return -1.0
    deviations = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    correlations = matrix / deviations / deviations[:, None]
    correlations.ravel()[:: deviations.size + 1] = 1.0 + _INDEFINITE
    try:
        pivot = np.linalg.cholesky(correlations).diagonal().min().item()
    except np.linalg.LinAlgError:
        return -1.0
    return pivot * pivot if math.isfinite(pivot) else -1.0


def solve(matrix: Array, side: Array) -> Array:
    """The solution (d, k) of ``matrix X = side``, for a symmetric positive definite matrix."""
    if matrix.shape[0] == 1:
        return np.asarray(side / matrix[0, 0])
    scaled, units, whole = unit_diagonal(matrix)
    found = np.linalg.solve(scaled, np.ldexp(side, -whole - units[:, None]))
    result: Array = np.ldexp(found, -units[:, None])
    return result


def cholesky(matrix: Array) -> Array:
    """A lower triangular S (d, d) with ``S S' = matrix``, positive semidefinite.

    In a singular matrix, pivots of the size of rounding give columns of zeros.
    """
    with suppress(np.linalg.LinAlgError):
        return np.asarray(np.linalg.cholesky(matrix))
    left, factor = matrix.copy(), np.zeros_like(matrix)
    least = matrix.shape[0] * _EPS * matrix.diagonal()
    for j, pivot in enumerate(least):
        if left[j, j] > pivot:
            factor[j:, j] = left[j:, j] / np.sqrt(left[j, j])
            left -= np.multiply.outer(factor[:, j], factor[:, j])
    return factor
