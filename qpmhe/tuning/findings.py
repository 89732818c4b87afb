"""What a diagnosis says, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .faults import Fault

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a run, or worth knowing.

    Parameters
    ----------
    kind : str
        ``dead``, ``saturated``, ``missing``, ``failing``, ``noise``, ``disturbance``, ``bias``,
        ``swapped``, ``step``, ``sign``, ``input``, ``shift``, ``clock``, ``outliers``, ``unseen``,
        ``correlated``, ``estimator``; a note also has ``prior``, ``kept``, ``innovations``,
        ``drift`` or ``record``.
    text : str
        What it is, as a sentence.
    remedy : str
        What to do about it; blank where there is nothing to do.
    severity : str
        ``fault``: the record contradicts what the estimator assumes. ``warning``: it may harm the
        estimates. ``note``: worth knowing.
    where : (float, float) or None
        First and last time, if not the whole run.
    """

    kind: str
    text: str
    remedy: str = ""
    severity: str = "fault"
    where: tuple[float, float] | None = None

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}".strip()


@dataclass(frozen=True, eq=False)
class Names:
    """How the signals of a run are called, and its times.

    Parameters
    ----------
    labels : sequence of str
        Of the states, with units.
    outputs, inputs : sequence of str
        Names, one for each.
    times : (T,) array
        Of the samples.
    unit : str
        Of the times; ``samples`` where the length of the step is not known.
    """

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

    def samples(self, count: float) -> str:
        """A number of samples, and how long they take."""
        words = f"{number(count)} sample{'s' * (abs(count) != 1.0)}"
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
    """A share in per cent, without a zero that is none."""
    return "less than 1 %" if share < 0.005 else f"{100.0 * share:.0f} %"


def _time(value: float, step: float) -> str:
    """A time with no more digits than the steps need."""
    digits = max(0, int(-np.floor(np.log10(step)))) if step > 0.0 else 2
    return f"{value:.{min(digits, 6)}f}"


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)


def describe(fault: Fault, names: Names, deviations: Array, outliers: Array) -> Finding:
    """A fault of the search as a finding.

    Parameters
    ----------
    deviations : (p,) array
        Standard deviations of the noise.
    outliers : (p,) array
        Shares of outlying samples by sensor.
    """
    value, subject = fault.value, fault.subject
    sensors = "the sensors"
    if subject and fault.kind in ("noise", "bias", "swapped", "shift"):
        sensors = listed([f"sensor {names.outputs[j]}" for j in subject])
    where = None if fault.span is None else names.span(*fault.span)
    factor = number(max(value, 1.0 / value)) if value > 0.0 else ""
    size = "small" if value > 1.0 else "large"
    text = remedy = ""
    match fault.kind:
        case "noise":
            whose = f" of {sensors}" if subject else ""
            text = f"R{whose} is too {size} by about {factor}: the measurements scatter "
            text += "more than it says." if value > 1.0 else "less than it says."
            remedy = (
                f"{'Multiply' if value > 1 else 'Divide'} the covariance of the noise by {factor}, "
                "or let qpmhe.tune choose the weights."
            )
        case "disturbance":
            whose = f" of {listed([names.states[i] for i in subject])}" if subject else ""
            text = f"Q{whose} is too {size} by about {factor}"
            text += (
                ": the states move more than the model and Q explain." if value > 1.0
                else ": the states move less than Q says."
            )
            remedy = (
                f"{'Multiply' if value > 1 else 'Divide'} the covariance of the disturbance by "
                f"{factor}, or let qpmhe.tune choose the weights; look for what the model lacks."
            )
        case "bias":
            sigmas = abs(value) / deviations[subject[0]]
            first, last = fault.span or (0, len(names.times) - 1)
            stretch = names.between(first, last)
            text = f"{sensors} is off by {number(sigmas)} sigma ({number(value)})"
            text += f" for {names.duration(first, last)},{stretch}." if stretch else "."
            remedy = "Calibrate it, or estimate its bias as a further state."
        case "swapped":
            text = f"{sensors} are swapped."
            remedy = "Exchange their columns."
        case "step":
            text = f"The true steps are about {number(value)} times as long as the model's."
            remedy = "Correct dt, or the unit of the record's times."
        case "sign":
            text = f"Input {names.inputs[subject[0]]} has the wrong sign."
            remedy = "Change its sign in the record, or in the model."
        case "input":
            text = (
                f"Input {names.inputs[subject[0]]} acts about {number(value)} times as strongly as "
                "the model says."
            )
            remedy = "Correct its unit or its gain, or estimate the gain as a parameter."
        case "shift":
            word = "late" if value > 0.0 else "early"
            text = f"The measurements of {sensors} come {names.samples(abs(value))} too {word}."
            remedy = "Shift them against the inputs, or add the delay to the model."
        case "clock":
            word = "ahead of" if value > 0.0 else "behind"
            text = (
                f"The sensors' clock drifts: at the end of the run their samples are "
                f"{names.samples(abs(value))} {word} the inputs'."
            )
            remedy = "Synchronise the clocks, or resample the measurements at the inputs' times."
        case "outliers":
            worst = np.argsort(-outliers)[:3]
            shares = [
                f"{outliers[j]:.1%} of {names.outputs[j]}" for j in worst if outliers[j] > 0.0
            ]
            text = f"There are outliers: {listed(shares)} beyond 4 sigma."
            remedy = "Take a qpmhe.RobustCost, with qpmhe.Huber for the noise."
    return Finding(fault.kind, text[:1].upper() + text[1:], remedy, "fault", where)
