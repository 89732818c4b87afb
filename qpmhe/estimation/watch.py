"""A watch on the observer: whether the estimates can rely on it for long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .limits import FAR

Array = NDArray[np.float64]


class ObserverWatch:
    """Counts consecutive samples in which the observer was far from the estimate, or rows dropped.

    Parameters
    ----------
    horizon : int
        Number of consecutive samples that count as long.
    """

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        #: Consecutive samples with the observer far away, and with rows dropped.
        self.counts: tuple[int, int] = (0, 0)
        self._warned = False

    def note(self, offset: Array, prior_weight: Array, dropped_rows: bool) -> bool:
        """Count a sample; return whether the observer has been far away for long.

        Parameters
        ----------
        offset : (n,) array
            The estimate minus the observer's state.
        prior_weight : (n, n) array
            Weight of an initial error of the observer.
        dropped_rows : bool
            Whether the step dropped rows.
        """
        far, dropped = self.counts
        # A comparison with NaN is false.
        far = far + 1 if offset.dot(prior_weight).dot(offset) > FAR**2 else 0
        self.counts = far, (dropped + 1 if dropped_rows else 0)
        return far >= self._horizon

    def warning(self) -> str | None:
        """The warning, once, as soon as it has a reason; None otherwise."""
        far, dropped = self.counts
        if self._warned or max(far, dropped) < self._horizon:
            return None
        self._warned = True
        if dropped >= self._horizon:
            return (
                f"inequalities were dropped in {dropped} consecutive samples, because the "
                "observer's candidate violates them and no better trajectory satisfies them all; "
                "see estimate.dropped. Widen these sets, raise max_qps, or use another observer."
            )
        return (
            f"the observer was far from the estimates in {far} consecutive samples (more than "
            f"{FAR:g} standard deviations of the prior); use another gain or observer, or "
            "candidate='reinitialized'."
        )
