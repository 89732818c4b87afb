"""One member's QP, for the backend itself, where the common factorisation fails."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP
from qpmhe_solvers.qp import band_index, band_of

from .terms import Terms

__all__ = ["member_qp"]

Array = NDArray[np.float64]


def member_qp(
    terms: Terms,
    slots: Sequence[int],
    member: int,
    weights: tuple[Array, Array],
    discounts: Array | None,
    prior_gradient: Array | None,
) -> QP:
    """The QP of one member as a single estimator would have it.

    Parameters
    ----------
    terms, slots, discounts, prior_gradient
        As for `qpmhe.batch.factor.BlockCholesky.solve`.
    member : int
        Which of the members that the terms hold.
    weights : ((n, n) array, (n, n) array)
        Weights of the initial error and of the disturbances.
    """
    prior, disturbance = weights
    n, count = prior.shape[0], len(slots)
    factors = np.ones(count + 1) if discounts is None else discounts
    qp, index = QP(count + 1, n), band_index(n)
    qp.bounded = False
    flat = np.zeros(2 * n * n + 1)
    for i, slot in enumerate(slots):
        flat[: n * n] = terms.square[slot, :, :, member].ravel()
        flat[n * n : -1] = terms.below[slot, :, :, member].ravel()
        qp.band[i] = factors[i + 1] * flat[index]
        qp.gradient[i] += factors[i + 1] * terms.own[slot, :, member]
        qp.gradient[i + 1] = factors[i + 1] * terms.following[slot, :, member]
    qp.band[0] += factors[0] * band_of(prior)
    qp.band[1:] += factors[1:, None, None] * band_of(disturbance)
    if prior_gradient is not None:
        qp.gradient[0] += prior_gradient[:, member]
    return qp
