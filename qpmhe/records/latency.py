"""How long it takes from a line in to a line out, in constant memory."""

from __future__ import annotations

import math

import numpy as np

from .._checks import positive, representation

# Times are known to within 1 %: from a tenth of a microsecond to a day.
_SHORTEST, _LONGEST, _RATIO = 1e-7, 1e5, 1.01
_SHARES = {"median": 0.5, "99 %": 0.99, "99.9 %": 0.999}


class Latency:
    """Times from a line of a record in to its line of results out.

    Parameters
    ----------
    deadline : float, optional
        Seconds; longer times are counted as late.
    """

    def __init__(self, deadline: float | None = None) -> None:
        self.deadline = None if deadline is None else positive("--deadline", deadline)
        bins = math.ceil(math.log(_LONGEST / _SHORTEST) / math.log(_RATIO))
        self._counts = np.zeros(bins + 1, np.int64)
        self.samples = self.late = 0
        self.worst = 0.0

    def __repr__(self) -> str:
        return representation(self)

    def add(self, seconds: float) -> None:
        """Count a time."""
        self.samples += 1
        self.worst = max(self.worst, seconds)
        self.late += self.deadline is not None and seconds > self.deadline
        place = math.log(max(seconds, _SHORTEST) / _SHORTEST) / math.log(_RATIO)
        self._counts[min(math.ceil(place), len(self._counts) - 1)] += 1

    def quantile(self, share: float) -> float:
        """The least time, to within 1 %, that a share of the samples does not exceed."""
        if not self.samples:
            return math.nan
        rank = max(1, math.ceil(share * self.samples))
        place = int(np.searchsorted(np.cumsum(self._counts), rank))
        return min(_SHORTEST * _RATIO**place, self.worst)

    def __str__(self) -> str:
        """The report, on one line."""
        if not self.samples:
            return "line in to line out: no sample so far"
        found = [f"{name} {_text(self.quantile(share))}" for name, share in _SHARES.items()]
        found.append(f"worst {_text(self.worst)}")
        if self.deadline is not None:
            found.append(
                f"{self.late} late ({100 * self.late / self.samples:.3g} % over "
                f"{_text(self.deadline)})"
            )
        return f"line in to line out, {self.samples} samples: {', '.join(found)}"


def _text(seconds: float) -> str:
    return f"{1e6 * seconds:.3g} us" if seconds < 1e-3 else (
        f"{1e3 * seconds:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"
    )
