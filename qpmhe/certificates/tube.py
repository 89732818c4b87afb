"""Bounds on an observer's error at one time: in the norm of P, and by component."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .._checks import Array
from .sizes import weighted_lengths

# Boxes of more states are bounded by sums over their sides.
_MOST_SIGNS = 10


class Tube(NamedTuple):
    """Bounds at one time: |x - z|_P <= radius, and |x_i - z_i| <= box[i].

    And |g (x - z)| <= oblique[j] for the directions g that no projection moves, of a system with
    an X (`Faces`); empty where they follow from the box alone.
    """

    radius: float
    box: Array
    oblique: Array = np.zeros(0)


def across(box: Array, metric: Array) -> float:
    """The largest |e|_P of the errors e in a box, rounded up."""
    n = box.size
    if n > _MOST_SIGNS:
        return float(weighted_lengths(box, np.abs(metric)))
    negative = (np.arange(2 ** (n - 1))[:, None] >> np.arange(n)) & 1
    return float(weighted_lengths(np.where(negative, -box, box), metric).max())
