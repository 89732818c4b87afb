"""The kinds of faults that a record can have, in words, and the record without one of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .bank import Array, Hypothesis
from .findings import Finding, Names, listed, number

# A factor, and an offset in deviations of the noise, that another unit explains.
_UNIT, UNIT_OFFSET = 3.0, 30.0
# More components than this have no factors or pairs of their own.
MOST_PARTS = 8
# What a fault must gain in log likelihood, up to twice that where measurements are missing.
LEAST_GAIN = 12.0


class _Kind(NamedTuple):
    """The least effect worth a word, what it is in words, the remedy, and whether it is local."""

    least: float
    text: str
    remedy: str
    local: bool = False


#: Kinds that multiply R or Q.
SCALED = ("noise", "disturbance")
# Effects: logarithms of factors, shares of a step or an input, deviations of a bias, samples.
_KINDS = {
    "noise": _Kind(
        np.log(2.0),
        "R{of} is too {small} by {about} {factor}: the measurements scatter {more} than it says.",
        "{Multiply} the covariance of the noise{of} by {factor}{or_more}, or let qpmhe.tune choose "
        "the weights.",
    ),
    "disturbance": _Kind(
        np.log(2.0),
        "Q{of} is too {small} by {about} {factor}: the states move {more} than the model and Q "
        "say.",
        "{Multiply} the covariance of the disturbance{of} by {factor}{or_more}, or let qpmhe.tune "
        "choose the weights; look for what the model lacks.",
    ),
    "gain": _Kind(
        np.log(1.05),
        "{sensors} read{s} about {value} times what the model expects.",
        "Check the units of the record and of the model's outputs, or correct the gain.",
        local=True,
    ),
    "bias": _Kind(
        0.5, "{sensors} {is} off by {sigmas} sigma ({value}){stretch}.",
        "{Calibrate} it, or estimate its bias as a further state.", local=True,
    ),
    "swapped": _Kind(0.0, "{sensors} are swapped.", "Exchange their columns."),
    "step": _Kind(
        0.02, "The true steps are about {value} times as long as the model's.",
        "Correct dt, or the unit of the record's times.",
    ),
    "sign": _Kind(
        0.1, "Input {input} has the wrong sign.", "Change its sign in the record, or in the model."
    ),
    "input": _Kind(
        0.1, "Input {input} acts about {value} times as strongly as the model says.",
        "Correct its unit or its gain, or estimate the gain as a parameter.",
    ),
    "shift": _Kind(
        0.3, "The measurements of {sensors} come {samples} too {late}.",
        "Shift them against the inputs, or add the delay to the model.",
    ),
    "clock": _Kind(
        0.5,
        "The sensors' clock drifts: at the end of the run their samples are {samples} {ahead} the "
        "inputs'.",
        "Synchronise the clocks, or resample the measurements at the inputs' times.",
    ),
    "outliers": _Kind(
        0.0, "There are outliers: {shares} beyond 4 sigma.",
        "Use a qpmhe.RobustCost, with qpmhe.Huber for the noise.", local=True,
    ),
}


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault that explains the record better than none.

    The value is a factor, the least one if there is no `upper` end; for a shift or a clock,
    samples; for a bias, in the sensor's unit.
    """

    kind: str
    value: float
    hypothesis: Hypothesis  # the record and its covariances without the fault
    subject: tuple[int, ...] = ()  # sensors, inputs or disturbances; all if empty
    span: tuple[int, int] | None = None  # first and last sample, if not the whole record
    gain: float = 0.0  # how much more likely the record is with it, as a logarithm
    upper: bool = True

    def in_words(self, names: Names, deviations: Array, outliers: Array) -> Finding:
        """The finding, with the noise's deviations and the shares of outliers of each sensor."""
        kind, value, subject = _KINDS[self.kind], self.value, self.subject
        of, sensors = "", "the sensors"
        if self.kind == "disturbance" and subject:
            of = f" of {listed([names.states[i] for i in subject])}"
        elif subject and self.kind not in ("disturbance", "sign", "input"):
            several = "s" * (len(subject) > 1)
            sensors = f"sensor{several} {listed([names.outputs[j] for j in subject])}"
            of = f" of {sensors}"
        first, last = self.span or (0, len(names.times) - 1)
        stretch = names.between(first, last)
        worst = [j for j in np.argsort(-outliers)[:3] if outliers[j] > 0.0]
        grows = value > 1.0
        words = {
            "of": of, "sensors": sensors, "s": "s" * bool(subject),
            "value": number(value) if self.is_wrong_unit or self.kind != "gain" else f"{value:.3g}",
            "factor": number(float(f"{max(value, 1.0 / value):.2g}")) if value > 0.0 else "",
            "about": "about" if self.upper else "a factor of more than",
            "or_more": "" if self.upper else " or more",
            "small": "small" if grows else "large", "more": "more" if grows else "less",
            "Multiply": "Multiply" if grows else "Divide",
            "input": names.inputs[subject[0]] if self.kind in ("sign", "input") else "",
            "sigmas": number(abs(value) / deviations[subject[0]]) if self.kind == "bias" else "",
            "is": "is" if len(subject) == 1 else "are",
            "Calibrate": "Check the unit and its zero (degrees C or K?), calibrate"
                         if self.is_wrong_unit else "Calibrate",
            "stretch": f" for {names.duration(first, last)},{stretch}" if stretch else "",
            "samples": names.samples(abs(value)), "late": "late" if value > 0.0 else "early",
            "ahead": "ahead of" if value > 0.0 else "behind",
            "shares": listed([f"{outliers[j]:.1%} of {names.outputs[j]}" for j in worst]),
        }
        text = kind.text.format(**words)
        where = None if self.span is None else names.span(first, last)
        return Finding(
            self.kind, text[:1].upper() + text[1:], kind.remedy.format(**words), "fault", where
        )

    @property
    def is_wrong_unit(self) -> bool:
        """Whether it is so large that a unit explains it: then much else may follow from it."""
        if self.kind == "bias":
            variance = float(self.hypothesis.noise[self.subject[0], self.subject[0]])
            return self.span is None and abs(self.value) > UNIT_OFFSET * np.sqrt(variance)
        return self.kind in ("gain", "input") and not 1.0 / _UNIT < self.value < _UNIT

    @property
    def is_local(self) -> bool:
        """Whether it may concern few samples alone."""
        return _KINDS[self.kind].local

    @property
    def matters(self) -> bool:
        """Whether its effect is large enough to report."""
        size, noise = self.value, self.hypothesis.noise
        if self.kind in (*SCALED, "gain"):
            size = np.log(size)
        elif self.kind in ("step", "input"):
            size -= 1.0
        elif self.kind == "bias":
            size /= np.sqrt(noise[self.subject[0], self.subject[0]])
        return bool(abs(size) >= _KINDS[self.kind].least)


def _times(covariance: Array, part: tuple[int, ...], factor: float) -> Array:
    """A covariance with the variances of some components, or of all, multiplied."""
    roots = np.ones(len(covariance))
    roots[list(part) if part else slice(None)] = np.sqrt(factor)
    scaled: Array = roots[:, None] * covariance * roots
    return scaled


def with_factor(base: Hypothesis, kind: str, part: tuple[int, ...], factor: float) -> Fault:
    """The record without a wrong factor of a covariance, the step, a sensor or an input."""
    where = list(part) if part else slice(None)
    match kind:
        case "step":
            changed = replace(base, step=base.step * factor)
        case "noise":
            changed = replace(base, noise=_times(base.noise, part, factor))
        case "disturbance":
            changed = replace(base, disturbance=_times(base.disturbance, part, factor))
        case "gain":
            y, gains = base.measurements.copy(), np.ones(base.measurements.shape[1])
            y[:, where] /= factor
            gains[where] = factor
            changed = replace(
                base, measurements=y, gains=gains * (1.0 if base.gains is None else base.gains)
            )
        case _:  # sign, input
            inputs = base.inputs.copy()
            inputs[:, where] *= factor
            changed = replace(base, inputs=inputs)
    return Fault(kind, factor, changed, part)
