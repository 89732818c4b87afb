"""What the data of a window say about its first state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def window_information(
    transitions: Sequence[Array] | Array, information: Sequence[Array] | Array, disturbance: Array
) -> Array:
    """Information of the windows' data on their first states, (..., n, n).

    ``transitions`` and ``information`` are, stage by stage, those of `observability`, (..., n, n);
    ``disturbance`` is the covariance (n, n) of all stages' disturbances, or one of each.
    """
    eye, each = np.eye(disturbance.shape[-1]), disturbance.ndim > 2
    found = np.zeros_like(information[0])
    for k in range(len(transitions) - 1, -1, -1):
        spread = disturbance[k] if each else disturbance
        later = np.linalg.solve(eye + found @ spread, found)
        found = information[k] + transitions[k].swapaxes(-1, -2) @ later @ transitions[k]
        found = 0.5 * (found + found.swapaxes(-1, -2))
    return found


def prior_units(covariance: Array) -> tuple[Array, Array]:
    """L with L L^T the covariance, and its inverse, regularised if singular."""
    units = np.sqrt(covariance.diagonal())
    units = np.where(units > 0.0, units, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.multiply.outer(units, units))
    roots = np.sqrt(np.maximum(values, np.finfo(float).eps))
    root: Array = units[:, None] * ((vectors * roots) @ vectors.T)
    inverse: Array = ((vectors / roots) @ vectors.T) / units
    return root, inverse
