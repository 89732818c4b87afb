"""How well a number of a certificate is founded."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

__all__ = ["Evidence", "weakest"]


class Evidence(Enum):
    """What a constant rests on, best first."""

    #: Holds on the whole stated set: shown in exact or outward-rounded arithmetic.
    PROVED = "proved"
    #: Held at every point that was tried; points in between may break it.
    SAMPLED = "sampled"
    #: Taken from the user, not looked at.
    ASSUMED = "assumed"

    def __str__(self) -> str:
        return self.value


_ORDER = (Evidence.PROVED, Evidence.SAMPLED, Evidence.ASSUMED)


def weakest(evidence: Iterable[Evidence]) -> Evidence:
    """What a number rests on that is computed from others: the weakest of theirs.

    Parameters
    ----------
    evidence : iterable of Evidence
        Theirs; nothing at all counts as proved.
    """
    return max(evidence, key=_ORDER.index, default=Evidence.PROVED)
