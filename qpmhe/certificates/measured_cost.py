"""A bound on the estimate's error from its measured cost."""

from __future__ import annotations

import math

import numpy as np

from .._checks import Array
from ..costs import Cost
from .norms import largest_ratio
from .observer_bound import ObserverBound
from .properties import Detectability
from .sizes import OUTWARD, Sizes, lengths_of

_SUMS = 1.0 + 1e-9  # covers the rounding of a sum over a window, and of roots


class MeasuredCost:
    r"""The error bound from detectability, an estimate's cost and a bound on its prior's error.

    With detectability's norms P and V, a trajectory of k stages with the cost B is at most
    :math:`\alpha_k \sqrt B` from one without disturbances and noises that starts at its prior's
    mean z, and the true one at most :math:`d_k`. `docs/explanation/guarantees.md` derives both.
    The cost is quadratic, without discount, with weights of the prior of at least ``least_prior``
    (n, n); the bound is of the observer whose state is z.
    """

    def __init__(
        self, detectability: Detectability, cost: Cost, bound: ObserverBound, sizes: Sizes,
        least_prior: Array,
    ) -> None:
        P, W, V = detectability.P, detectability.entry, detectability.V
        assert P is not None
        assert W is not None
        assert V is not None
        self._eta = detectability.eta
        self._start, self._noise, self._disturbance = (
            largest_ratio(mine, theirs) ** 2
            for mine, theirs in ((P, least_prior), (V, cost.noise), (W, cost.disturbance))
        )
        self._entry = largest_ratio(P, bound.metric)
        self._length = largest_ratio(np.eye(len(P)), P)
        self._w = float(lengths_of("disturbance", sizes.disturbance, W))
        self._v = float(lengths_of("noise", sizes.noise, V))

    @staticmethod
    def applies(detectability: Detectability | None, cost: Cost) -> bool:
        """Whether there is such a bound."""
        return (
            detectability is not None and detectability.P is not None
            and detectability.V is not None and cost.quadratic and cost.discount == 1.0
        )

    def error(self, radius: float, stages: int, cost: float) -> float:
        """A bound of |x - x_hat| from the observer's bound at the window's start, and from J."""
        alpha, own = self._start, self._entry * radius
        for _ in range(stages):
            alpha = max(self._eta**2 * alpha, self._noise) + self._disturbance
            own = math.hypot(self._eta * own, self._v) + self._w
        root = math.sqrt(alpha * max(cost, 0.0))
        return self._length * (root + own) * _SUMS * OUTWARD
