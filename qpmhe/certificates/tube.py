"""Bounds on an observer's error, in the norm of P and by component: at one time, along a run."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class Band:
    """The bound along a run, at the times 0, ..., T.

    Attributes
    ----------
    radius : (T + 1,) array
        b(t), which bounds |x(t) - z(t)|_P; NaN once the bound no longer holds.
    lower, upper : (T + 1, n) array
        Sides of a box that holds the true state.
    error : (T + 1,) array
        Upper bound on |x(t) - x_hat(t)|.
    lost : int or None
        The sample after which it no longer holds.
    reason : str
        Why; empty while it holds.
    """

    radius: Array
    lower: Array
    upper: Array
    error: Array
    lost: int | None = None
    reason: str = ""

    def __str__(self) -> str:
        if self.lost is None:
            return f"the bound holds at all {len(self.radius) - 1} samples"
        return f"the bound holds up to sample {self.lost}: there {self.reason}"


def across(box: Array, metric: Array) -> float:
    """The largest |e|_P of the errors e in a box, rounded up."""
    n = box.size
    if n > _MOST_SIGNS:
        return float(weighted_lengths(box, np.abs(metric)))
    negative = (np.arange(2 ** (n - 1))[:, None] >> np.arange(n)) & 1
    return float(weighted_lengths(np.where(negative, -box, box), metric).max())
