"""From a contraction in a weighted norm to constants for Euclidean norms, rounded up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .verification import eigenvalue_bounds, rounded_up

__all__ = ["euclidean_constants"]

Array = NDArray[np.float64]


def euclidean_constants(P: Array, V: Array, rate: float) -> tuple[float, float, float]:
    r"""Constants of the sums in def:RGES and def:eIOSS.

    From :math:`|e^+|_P \le \rho |e|_P + |w|_P + |v|_V`, by induction,

    .. math::
        |e(t)|_P \le \rho^t |e_0|_P
        + \sum_{\tau=1}^t \rho^{\tau-1} (|w(t-\tau)|_P + |v(t-\tau)|_V) .

    With :math:`\sqrt{\underline\lambda(P)}\, |e| \le |e|_P \le \sqrt{\bar\lambda(P)}\, |e|`,
    the constants of the definitions, whose sums discount by :math:`\rho^\tau`, are

    .. math::
        c_p = \sqrt{\bar\lambda(P) / \underline\lambda(P)}, \quad c_w = c_p / \rho, \quad
        c_v = \sqrt{\bar\lambda(V) / \underline\lambda(P)} / \rho .

    Parameters
    ----------
    P, V : (n, n) and (p, p) array
        Symmetric; P positive definite, V at least positive semidefinite.
    rate : float
        rho or eta.

    Returns
    -------
    c_p, c_w, c_v : float
        Upper bounds: eigenvalues are bounded by verified numbers.
    """
    low, high = eigenvalue_bounds(P)
    size = 2.0 * float(np.linalg.norm(V))
    # Of V, the upper bound alone is needed; shifted, it has the lower one that is verified.
    output = eigenvalue_bounds(V + size * np.eye(V.shape[0]))[1] - size if size > 0.0 else 0.0
    output = max(output, 0.0) + 1e-15 * size
    c_p = rounded_up(math.sqrt(high / low))
    return c_p, rounded_up(c_p / rate), max(rounded_up(math.sqrt(output / low) / rate), 1e-300)
