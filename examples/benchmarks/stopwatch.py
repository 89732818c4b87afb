"""Time of one call on a machine that others use, too."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter, process_time
from typing import TypeVar

__all__ = ["timed"]

Given = TypeVar("Given")
Taken = TypeVar("Taken")


def timed(
    call: Callable[[Given], Taken], argument: Given, outside: bool = False
) -> tuple[Taken, float, float]:
    """Call, and tell how long it took.

    Another process that has the processor meanwhile makes long steps longer and hardly ever
    meets short ones, so that ratios of the wall clock's times are wrong on a busy machine. The
    processor's clock does not see such waits, but takes long to read. So it counts only where
    it tells less than the wall clock, which it surrounds.

    Parameters
    ----------
    call, argument
        What to time.
    outside : bool
        Whether it computes in a process of its own, so that only the wall clock sees it.

    Returns
    -------
    answer, seconds, waited
        The call's result, its time, and the time that it waited for the processor (s).
    """
    busy = process_time()
    began = perf_counter()
    answer = call(argument)
    elapsed = perf_counter() - began
    busy = process_time() - busy
    own = elapsed if outside else min(elapsed, busy)
    return answer, own, elapsed - own
