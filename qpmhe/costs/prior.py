"""The prior weight taken from a Kalman-type observer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._checks import Array
from ..errors import OptionError

__all__ = ["ObserverPrior"]


class ObserverPrior:
    r"""Weigh the prior z(t-N) with the inverse of the observer's own covariance at t-N.

    With a Kalman-type observer on a linear system, the estimator then equals the Kalman
    filter for every horizon. The eigenvalues of the weight are clipped to stated bounds,
    so that (eq:cond0) holds with :math:`\underline c_p` and :math:`\overline c_p` equal
    to them.

    Parameters
    ----------
    minimum, maximum : float
        Bounds on the eigenvalues of the prior weight (inverse of squared state units).

    Raises
    ------
    OptionError
        Unless 0 < minimum < maximum < infinity.
    """

    __slots__ = ("maximum", "minimum")

    def __init__(self, minimum: float = 1e-12, maximum: float = 1e12) -> None:
        if not _number(minimum) or not _number(maximum) or not 0 < minimum < maximum:
            raise OptionError(
                f"minimum is {minimum!r} and maximum {maximum!r}; "
                "expected finite numbers with 0 < minimum < maximum."
            )
        self.minimum, self.maximum = float(minimum), float(maximum)

    def weight(self, covariance: Array) -> Array:
        """The clipped inverse of a covariance (n, n)."""
        values, vectors = np.linalg.eigh(covariance)
        with np.errstate(divide="ignore"):
            inverse = np.where(values > 0.0, 1.0 / values, self.maximum)
        clipped = np.clip(inverse, self.minimum, self.maximum)
        weight: Array = (vectors * clipped) @ vectors.T
        return weight


def _number(value: Any) -> bool:
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool) and math.isfinite(value)
