"""A watch on the observer: whether the estimates can rely on it for long."""

from __future__ import annotations

from .limits import FAR

#: The counts while the observer is near, and no rows are dropped.
NEAR = 0, 0


class ObserverWatch:
    """Counts consecutive samples in which the observer was far from the estimate, or rows dropped.

    Parameters
    ----------
    horizon : int
        Number of consecutive samples that count as long.
    """

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self._warned = False

    def counted(
        self, counts: tuple[int, int], distance: float, dropped_rows: bool
    ) -> tuple[int, int]:
        """The counts after a sample.

        Parameters
        ----------
        counts : (int, int)
            Consecutive samples with the observer far away, and with rows dropped, before it.
        distance : float
            Of the estimate from the observer's state, squared, in deviations of the prior.
        dropped_rows : bool
            Whether the step dropped rows.
        """
        far, dropped = counts
        # A comparison with NaN is false.
        far = far + 1 if distance > FAR**2 else 0
        return far, (dropped + 1 if dropped_rows else 0)

    def warning(self, counts: tuple[int, int]) -> str | None:
        """The warning, once, as soon as the counts are a reason; None otherwise."""
        far, dropped = counts
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
            "candidate='reinitialized' or restart=True."
        )
