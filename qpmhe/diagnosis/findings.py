"""The findings of a diagnosis, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a run, or worth knowing.

    Parameters
    ----------
    kind : str
        ``dead``, ``saturated``, ``missing``, ``failing``, ``noise``, ``disturbance``, ``gain``,
        ``bias``, ``ramp``, ``swapped``, ``step``, ``sign``, ``input``, ``parameter``, ``shift``,
        ``lag``, ``clock``, ``jitter``, ``dropped``, ``doubled``, ``outliers``, ``coloured``,
        ``change``, ``quantised``, ``discretization``, ``unseen``, ``apparent``, ``correlated``,
        ``estimator``; a note also has ``prior``, ``kept``, ``innovations``, ``drift``, ``record``
        or ``rejected``.
    text : str
        What it is, as a sentence.
    remedy : str
        What to do about it; blank where there is nothing to do.
    severity : str
        ``fault``: the record contradicts what the estimator assumes. ``warning``: it may harm the
        estimates. ``note``: worth knowing.
    where : (float, float) or None
        First and last time, if not the whole run.
    equals : tuple of str
        Kinds of other causes that explain the record as well; the text names them.
    """

    kind: str
    text: str
    remedy: str = ""
    severity: str = "fault"
    where: tuple[float, float] | None = None
    equals: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}".strip()


@dataclass(frozen=True, eq=False)
class Names:
    """Names of the signals of a run, its times (T,), and their unit, or ``samples``."""

    labels: Sequence[str]
    outputs: Sequence[str]
    inputs: Sequence[str]
    times: Array
    unit: str

    @property
    def states(self) -> list[str]:
        """Names of the states: their labels without units."""
        return [label.split(" (")[0] for label in self.labels]

    @property
    def step(self) -> float:
        """The usual length of a step."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0

    def span(self, first: int, last: int) -> tuple[float, float]:
        """Times of two samples, without the rounding of a sum of steps."""
        return float(f"{self.times[first]:.9g}"), float(f"{self.times[last]:.9g}")

    def between(self, first: int, last: int) -> str:
        """A stretch of samples in words; blank for all of them."""
        if first <= 0 and last >= len(self.times) - 1:
            return ""
        begin, end = self.span(first, last)
        step = abs(self.step)
        return f" between {_time(begin, step)} and {_time(end, step)} {self.unit}"

    def at(self, sample: int) -> str:
        """The time of a sample in words."""
        if self.unit == "samples":
            return f"sample {sample}"
        return f"{_time(self.span(sample, sample)[0], abs(self.step))} {self.unit}"

    def rate(self, change: float) -> str:
        """A change in each sample, in the time's unit."""
        one = "sample" if self.unit == "samples" else self.unit
        return f"{number(change / self.step)} per {one}"

    def samples(self, count: float) -> str:
        """A number of samples, and how long they take."""
        words = f"{number(count)} sample{'' if abs(count) == 1.0 else 's'}"
        return words if self.unit == "samples" else (
            f"{words} ({number(count * self.step)} {self.unit})"
        )

    def duration(self, first: int, last: int) -> str:
        """How long a stretch of samples is."""
        return f"{number((last - first + 1) * self.step)} {self.unit}"


def number(value: float) -> str:
    """Two significant digits, or all digits of a whole number."""
    if abs(value) < 1e6 and value == round(value):
        return f"{value:.0f}"
    text = f"{value:.2g}"
    return text if "e" not in text or abs(value) >= 1e5 or abs(value) < 1e-3 else f"{value:.0f}"


def percent(share: float) -> str:
    """A share in per cent; a share that is not zero is never written as 0 %."""
    return "less than 1 %" if share < 0.005 else f"{100.0 * share:.0f} %"


def _time(value: float, step: float) -> str:
    """A time with no more digits than the steps need."""
    digits = max(0, int(-np.floor(np.log10(step)))) if step > 0.0 else 2
    return f"{value:.{min(digits, 6)}f}"


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
