"""The table of hypotheses: each cause that a diagnosis knows, how it is tried, and its words.

A further cause is one entry: a function that makes faults of the evidence, each with the record
as it is without this fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from .bank import Array
from .faults import Evidence, Fault
from .findings import Finding, Names, listed, number
from .noises import changing, jittering, rounded
from .proposals import (
    clock,
    disturbance,
    input_gain,
    noise,
    offsets,
    outliers,
    parameter,
    shift,
    sign,
    step,
    swapped,
    units,
)
from .rows import doubled, dropped
from .sensor_memory import coloured_variances, with_coloured_noise, with_lag
from .signatures import additive

# A finding lists at most so many rows.
_SHOWN_ROWS = 3
Maker = Callable[[Evidence], Iterable[Fault]]


class Cause(NamedTuple):
    """A hypothesis of a diagnosis.

    Parameters
    ----------
    makers : tuple of callable
        They make its faults of the evidence: of each value that is to be tried.
    size : str
        How a value is measured: the ``log`` of a factor; a ``share`` that it differs from one; in
        ``deviations`` of the sensor's noise; as it is (``plain``).
    least : float
        The least size worth a word.
    numbers : int
        How many numbers the record determines, beside the sensor or input.
    name, text, remedy : str
        What it is, in short and as a sentence, and what to do about it.
    local : bool
        Whether it may concern few samples alone.
    adds : bool
        Whether two of one kind and subject are one of their sum; else of their product.
    """

    makers: tuple[Maker, ...]
    size: str
    least: float
    numbers: int
    name: str
    text: str
    remedy: str
    local: bool = False
    adds: bool = False


#: By the kind of the finding.
CAUSES: dict[str, Cause] = {
    "noise": Cause(
        (noise,), "log", np.log(2.0), 1, "an R{of} too {small} by {about} {factor}",
        "R{of} is too {small} by {about} {factor}: the measurements scatter {more} than it says.",
        "{Multiply} the covariance of the noise{of} by {factor}{or_more}, or let qpmhe.tune choose "
        "the weights.",
    ),
    "disturbance": Cause(
        (disturbance,), "log", np.log(2.0), 1, "a Q{of} too {small} by {about} {factor}",
        "Q{of} is too {small} by {about} {factor}: the states move {more} than the model and Q "
        "say.",
        "{Multiply} the covariance of the disturbance{of} by {factor}{or_more}, or let qpmhe.tune "
        "choose the weights; look for what the model lacks.",
    ),
    "gain": Cause(
        (additive("gain"), units("gain")), "log", 0.96 * np.log(1.05), 1,
        "{sensors} that read {value} times",
        "{sensors} read{s} about {value} times what the model expects.",
        "Check the units of the record and of the model's outputs, or correct the gain.",
        local=True,
    ),
    "bias": Cause(
        (additive("bias"), offsets), "deviations", 0.5, 3,
        "{sensors} off by {sigmas} sigma{stretch}",
        "{sensors} {is} off by {sigmas} sigma ({value}){stretch}.",
        "{Calibrate} it, or estimate its bias as a further state.", local=True,
    ),
    "ramp": Cause(
        (additive("ramp"),), "deviations", 0.5, 2, "{sensors} that drift{s} by {rate}",
        "{sensors} drift{s} by {rate}{since}.",
        "Calibrate it, or estimate its bias as a further state that drifts.", local=True,
    ),
    "swapped": Cause(
        (swapped,), "plain", 0.0, 0, "{sensors} swapped",
        "{sensors} are swapped.", "Exchange their columns.",
    ),
    "step": Cause(
        (step,), "share", 0.02, 1, "steps {value} times as long",
        "The true steps are about {value} times as long as the model's.",
        "Correct dt, or the unit of the record's times.",
    ),
    "sign": Cause(
        (sign,), "plain", 0.1, 0, "the wrong sign of input {input}",
        "Input {input} has the wrong sign.", "Change its sign in the record, or in the model.",
    ),
    "input": Cause(
        (additive("input"), input_gain, units("input")), "share", 0.048, 1,
        "input {input} that acts {value} times as strongly",
        "Input {input} acts about {value} times as strongly as the model says.",
        "Correct its unit or its gain, or estimate the gain as a parameter.",
    ),
    "parameter": Cause(
        (additive("parameter"), parameter, units("parameter")), "share", 0.048, 1,
        "parameter {input} at {value} times its value",
        "Parameter {input} is about {value} times the value that the estimator has.",
        "Correct it, or let qpmhe.tune or a further state estimate it.",
    ),
    "shift": Cause(
        (additive("shift"), shift), "plain", 0.3, 1, "{sensors} {samples} too {late}",
        "The measurements of {sensors} come {samples} too {late}.",
        "Shift them against the inputs, or add the delay to the model.", adds=True,
    ),
    "lag": Cause(
        (with_lag,), "plain", 0.3, 1, "a lag of {sensors} of {samples}",
        "{sensors} follow{s} with a lag: {its} time constant is about {samples}.",
        "Add the lag to the model as a further state for each sensor.",
    ),
    "clock": Cause(
        (clock,), "plain", 0.5, 1, "a clock of the sensors that drifts by {samples}",
        "The sensors' clock drifts: at the end of the run their samples are {samples} {ahead} the "
        "inputs'.",
        "Synchronise the clocks, or resample the measurements at the inputs' times.", adds=True,
    ),
    "jitter": Cause(
        (jittering,), "plain", 0.0, 1, "times of the samples that scatter by {samples}",
        "The times of the samples scatter by about {samples}: the measurements are noisy where "
        "the outputs move.",
        "Record the true times and pass them as dt or as the record's index; until then, let R "
        "grow with the rate of the outputs.", local=True,
    ),
    "dropped": Cause(
        (dropped,), "plain", 0.0, 1, "{rows} missing",
        "{rows} {is_row} missing {places}: there the states move by more than one step.",
        "Insert them, with NaN for the measurements and the inputs that acted.", local=True,
        adds=True,
    ),
    "doubled": Cause(
        (doubled,), "plain", 0.0, 0, "{rows} that are there twice",
        "{rows} {is_row} there twice {places}: there the states do not move.",
        "Remove the repeated rows from the record.", local=True, adds=True,
    ),
    "outliers": Cause(
        (outliers,), "plain", 0.0, 1, "outliers",
        "There are outliers: {shares} beyond 4 sigma.",
        "Use a qpmhe.RobustCost, with qpmhe.Huber for the noise.", local=True,
    ),
    "coloured": Cause(
        (with_coloured_noise,), "plain", 0.0, 3,
        "noise of {sensors} that is correlated over {samples}",
        "The noise of {sensors} is correlated in time, over about {samples}.",
        "Estimate it as a further state: {augment}, with {white} for the variance{s_white} of the "
        "white noise that remains in R{of}; leave the rest of Q and R as they are.",
    ),
    "change": Cause(
        (changing,), "log", np.log(2.0), 2,
        "noise{of} that changes by a factor of {factor}{since}",
        "The noise{of} changes{since}: from there on R is too {small} by {about} {factor}.",
        "Find out what happened there; estimate both parts with covariances of their own.",
        local=True,
    ),
    "quantised": Cause(
        (rounded,), "plain", 0.0, 0, "{sensors} rounded to {value}",
        "{sensors} {is} rounded to multiples of {value}, which R does not allow for.",
        "Add the square of this step by 12 to the covariance of its noise, or use a sensor with a "
        "finer resolution.",
    ),
}


def matters(fault: Fault) -> bool:
    """Whether its effect is large enough to report."""
    size, cause, noises = fault.value, CAUSES[fault.kind], fault.hypothesis.usual_noise
    if cause.size == "log":
        size = float(np.log(size))
    elif cause.size == "share":
        size -= 1.0
    elif cause.size == "deviations":
        size /= float(np.sqrt(noises[fault.subject[0], fault.subject[0]]))
    if fault.kind == "ramp" and fault.span is not None:
        size *= fault.span[1] - fault.span[0]
    return bool(abs(size) >= cause.least)


def in_words(fault: Fault, names: Names, deviations: Array, outlying: Array) -> Finding:
    """The finding, with the noise's deviations and the shares of outliers of each sensor."""
    cause = CAUSES[fault.kind]
    words = _words(fault, names, deviations, outlying)
    text, remedy = cause.text.format(**words), cause.remedy.format(**words)
    where = None if fault.span is None else names.span(*fault.span)
    if fault.rows:
        where = names.span(fault.rows[0], fault.rows[-1])
    others = [
        CAUSES[one.kind].name.format(**_words(one, names, deviations, outlying))
        for one in fault.equals
    ]
    if others:
        others[-1] = f"or {others[-1]}" if len(others) > 1 else others[-1]
        alike = ", ".join(others) if len(others) > 2 else " ".join(others)
        text += f" The record cannot tell this from {alike}."
        remedy = f"Find out which of these it is before you correct it. {remedy}"
    return Finding(
        fault.kind, text[:1].upper() + text[1:], remedy, "fault", where,
        tuple(dict.fromkeys(one.kind for one in fault.equals if one.kind != fault.kind)),
    )


def _words(fault: Fault, names: Names, deviations: Array, outlying: Array) -> dict[str, str]:
    kind, value, subject = fault.kind, fault.value, fault.subject
    of, sensors = "", "the sensors"
    has_input = kind in ("sign", "input", "parameter")
    if kind == "disturbance" and subject:
        of = f" of {listed([names.states[i] for i in subject])}"
    elif subject and kind != "disturbance" and not has_input:
        several = "s" * (len(subject) > 1)
        sensors = f"sensor{several} {listed([names.outputs[j] for j in subject])}"
        of = f" of {sensors}"
    first, last = fault.span or (0, len(names.times) - 1)
    stretch = names.between(first, last)
    worst = [j for j in np.argsort(-outlying)[:3] if outlying[j] > 0.0]
    grows, count = value > 1.0, round(abs(value))
    return {
        "of": of, "sensors": sensors, "s": "s" * bool(subject),
        "value": f"{value:.3g}" if kind in ("gain", "step") and not fault.is_wrong_unit
                 else number(value),
        "factor": number(float(f"{max(value, 1.0 / value):.2g}")) if value > 0.0 else "",
        "about": "about" if fault.upper else "a factor of more than",
        "or_more": "" if fault.upper else " or more",
        "small": "small" if grows else "large", "more": "more" if grows else "less",
        "Multiply": "Multiply" if grows else "Divide",
        "input": names.inputs[subject[0]] if has_input else "",
        "sigmas": number(abs(value) / deviations[subject[0]]) if kind == "bias" else "",
        "is": "is" if len(subject) == 1 else "are",
        "its": "its" if len(subject) == 1 else "their",
        "Calibrate": "Check the unit and its zero (degrees C or K?), calibrate"
                     if fault.is_wrong_unit else "Calibrate",
        "stretch": f" for {names.duration(first, last)},{stretch}" if stretch else "",
        "since": f" from {names.at(first)} on" if first > 0 else "",
        "rate": names.rate(value),
        "samples": names.samples(abs(value)), "late": "late" if value > 0.0 else "early",
        "ahead": "ahead of" if value > 0.0 else "behind",
        "rows": f"{count} row{'s' * (count > 1)}", "is_row": "are" if count > 1 else "is",
        "places": _places(fault.rows, names),
        **(_augmented(fault, len(names.outputs)) if kind == "coloured" else {}),
        "shares": listed([f"{outlying[j]:.1%} of {names.outputs[j]}" for j in worst]),
    }


def _augmented(fault: Fault, p: int) -> dict[str, str]:
    """The call that makes states of coloured noise, and what remains white."""
    sensors, kept = list(fault.subject) or list(range(p)), float(np.exp(-1.0 / fault.value))
    sizes = np.sqrt(coloured_variances(fault.hypothesis, kept))
    white = fault.hypothesis.usual_noise.diagonal()[sensors]
    deviations = [float(f"{one:.3g}") for one in sizes]
    return {
        "augment": f"qpmhe.augment_noise(system, {sensors}, correlation={kept:.4g}, "
                   f"deviation={deviations})",
        "white": listed([f"{one:.3g}" for one in white]), "s_white": "s" * (len(white) > 1),
    }


def _places(rows: tuple[int, ...], names: Names) -> str:
    found = [names.at(row) for row in rows[:_SHOWN_ROWS]]
    if len(rows) > _SHOWN_ROWS:
        return f"at {len(rows)} places, first at {found[0]}"
    return f"at {listed(found)}"



