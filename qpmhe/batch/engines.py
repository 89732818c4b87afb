"""What carries out the steps of a batch."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .results import BatchEstimate

__all__ = ["BatchEngine"]

Array = NDArray[np.float64]


class BatchEngine(Protocol):
    """The loop body of all members; everything that it is given was checked before."""

    @property
    def states(self) -> Array:
        """The current estimates (K, n), a copy."""
        ...

    @property
    def time(self) -> int:
        """Number of samples taken so far."""
        ...

    def reset(self, states: Array) -> None:
        """Forget all samples and start at these states.

        Parameters
        ----------
        states : (K, n) array
            The initial estimates, which the engine may keep.
        """
        ...

    def step(self, y: Array, u: Array) -> BatchEstimate:
        """Take a sample of each member in, and estimate.

        Parameters
        ----------
        y, u : (K, p) and (K, m) array
            Measurements, not finite where they are missing, and inputs; read only.
        """
        ...
