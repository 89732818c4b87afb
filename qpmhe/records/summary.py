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
    failed, stale : int
        Steps at which the model failed (``MODEL_FAILED``), and others whose window still has
        such a step in it (``FAILED_STAGE``).
    failure : str
        Where it failed first, and why; blank if it did not.
    model_is_wrong : bool
        Whether it failed by a mistake, such as a value of another shape, rather than at
        states where it has no value.
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
    failed: int = 0
    stale: int = 0
    failure: str = ""
    model_is_wrong: bool = False
    notes: list[str] = field(default_factory=list)
