"""What became of a record."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["Summary"]


@dataclass
class Summary:
    """What became of a record.

    Parameters
    ----------
    samples : int
        Samples that were taken in, without those of a former run.
    before : int
        Samples of the former run that this one went on from.
    improved, incomplete : int
        How many of them improved on the observer, and how many lacked outputs.
    inserted : int
        Samples without measurement that were put into gaps.
    held : int
        Blank inputs that were replaced by the last value.
    repeated : int
        Lines that were passed over, since their time stood there already.
    notes : list of str
        What the user should know besides.
    """

    samples: int = 0
    before: int = 0
    improved: int = 0
    incomplete: int = 0
    inserted: int = 0
    held: int = 0
    repeated: int = 0
    notes: list[str] = field(default_factory=list)
