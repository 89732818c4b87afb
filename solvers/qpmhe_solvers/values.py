"""Read a caller's value as a number, and show it in messages."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

# Longer texts are shown by their beginning and end.
_LONGEST = 600


def finite(value: Any) -> float | None:
    """The value as a finite real number; None for anything else, such as booleans and arrays."""
    if isinstance(value, (bool, np.timedelta64)):  # NumPy's durations pass for integers
        return None
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        number = float(value)
    except OverflowError:  # an integer beyond all floats
        return None
    return number if math.isfinite(number) else None


def integer(value: Any) -> int | None:
    """The value as an integer; None for anything else, such as booleans and arrays."""
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(value, (int, np.integer)):
        return None
    return operator.index(value)


def shown(value: Any) -> str:
    """A value as text for a message; never raises."""
    try:
        text = repr(value)
    except Exception:  # a user's __repr__, or an integer of more digits than Python writes
        return f"a {type(value).__name__} that cannot be shown"
    if len(text) <= _LONGEST:
        return text
    return f"{text[:60]}...{text[-20:]} ({len(text)} characters)"
