"""How long a search may take."""

from __future__ import annotations

import math
import time
from typing import Any

from ..errors import OptionError

# For a whole certificate, and for one of its ingredients asked for by itself.
DEFAULT_SECONDS, PART_SECONDS = 60.0, 30.0
# What a part of a time that is over still has: enough to find out that it is over.
LEAST_SECONDS = 1e-9


class Deadline:
    """A moment on the monotonic clock, after which searches stop and return what they have."""

    def __init__(self, seconds: float) -> None:
        number = isinstance(seconds, (int, float)) and not isinstance(seconds, bool)
        if not number or not seconds > 0.0:
            raise OptionError(
                f"seconds is {seconds!r}; expected a number > 0, or math.inf for no limit."
            )
        self.seconds = float(seconds)
        self._end = time.monotonic() + self.seconds

    @classmethod
    def of(cls, value: Any) -> Deadline:
        """The deadline itself, or one after so many seconds from now."""
        return value if isinstance(value, Deadline) else cls(value)

    @property
    def left(self) -> float:
        """How many seconds are left, zero if none are."""
        return math.inf if math.isinf(self.seconds) else max(self._end - time.monotonic(), 0.0)

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return self.left == 0.0

    def part(self, share: float) -> Deadline:
        """A deadline that leaves some of the time for what comes after."""
        return Deadline(max(share * self.left, LEAST_SECONDS))
