"""Measured quaternions that change their sign: q and -q are one attitude, but not one measurement.

No file says which columns are a quaternion: four in a row of length 1 that turn to the opposite
from one sample to the next are taken for one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._checks import Array

# A length is taken for 1 up to the first; two directions are taken for opposite where their cosine
# is below the second.
_LENGTH, _OPPOSITE = 0.1, -0.9


class SignChanges:
    """Counts, sample by sample, the changes of sign of every four outputs in a row."""

    def __init__(self, outputs: int) -> None:
        self._four = np.arange(max(0, outputs - 3))[:, None] + np.arange(4)
        self._last = np.full(self._four.shape, np.nan)
        self._counts: NDArray[np.intp] = np.zeros(len(self._last), np.intp)
        self._first: dict[int, str] = {}

    def look(self, y: Array, time: str) -> None:
        """Take the outputs of a sample."""
        if not len(self._four):
            return
        q = y[self._four]
        lengths = np.sqrt((q * q).sum(axis=1))
        seen = np.abs(lengths - 1.0) <= _LENGTH  # and not missing
        if not seen.any():
            return
        turned = seen & ((q * self._last).sum(axis=1) < _OPPOSITE)
        self._counts += turned
        for k in np.flatnonzero(turned).tolist():
            self._first.setdefault(k, time)
        self._last[seen] = q[seen] / lengths[seen, None]

    def notes(self, file: str, names: list[str]) -> list[str]:
        """What the user should know of outputs with these names."""
        found: list[int] = []
        for k in np.argsort(-self._counts, kind="stable").tolist():
            if self._counts[k] and all(abs(k - other) > 3 for other in found):
                found.append(k)
        return [
            f"{', '.join(names[k:k + 4])} of {file} change sign together at {self._counts[k]} "
            f"of the samples, first at time {self._first[k]}. If they are a quaternion, q and -q "
            "are the same attitude, but different measurements: keep it on one sign in the record. "
            "The page Angles has a function for that, under 'Attitude as a quaternion'."
            for k in found
        ]
