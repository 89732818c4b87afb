"""A fault that a record can have, and the record without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .bank import Array, FilterBank, Filtered, Hypothesis

# A factor, and an offset in deviations of the noise, that another unit explains.
_UNIT, UNIT_OFFSET = 3.0, 30.0
# More components than this have no factors or pairs of their own.
MOST_PARTS = 8
# What a fault must gain in log likelihood, up to twice that where measurements are missing.
LEAST_GAIN = 12.0
#: Kinds that multiply R or Q.
SCALED = ("noise", "disturbance")


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault that explains the record better than none.

    The value is a factor, the least one if there is no `upper` end; for a shift, a clock, a lag or
    coloured noise, samples; for a bias, in the sensor's unit, for a ramp in this unit a sample.
    """

    kind: str
    value: float
    hypothesis: Hypothesis  # the record and its covariances without the fault
    subject: tuple[int, ...] = ()  # sensors, inputs or disturbances; all if empty
    span: tuple[int, int] | None = None  # first and last sample, if not the whole record
    gain: float = 0.0  # how much more likely the record is with it, as a logarithm
    upper: bool = True
    again: Callable[[float], Fault] | None = None  # the same fault of another value
    family: Any = None  # what those with the same `again` share, beside kind and subject
    rows: tuple[int, ...] = ()  # of the record, where it concerns single ones
    equals: tuple[Fault, ...] = ()  # what explains the record as well

    @property
    def is_wrong_unit(self) -> bool:
        """Whether it is so large that a unit explains it: then much else may follow from it."""
        if self.kind == "bias":
            variance = float(self.hypothesis.usual_noise[self.subject[0], self.subject[0]])
            return self.span is None and abs(self.value) > UNIT_OFFSET * np.sqrt(variance)
        return self.kind in ("gain", "input") and not 1.0 / _UNIT < self.value < _UNIT


@dataclass(frozen=True, eq=False)
class Evidence:
    """What hypotheses are made from: the record as it is believed to be, and its filter."""

    bank: FilterBank
    base: Hypothesis
    null: Filtered
    starts: Sequence[Array]  # further states where a filter may start
    parameters: int = 0  # how many of the last inputs are parameters of the model
    shared: dict[str, Any] = field(default_factory=dict)  # by those who make hypotheses

    @property
    def total(self) -> int:
        """Number of samples."""
        return len(self.base.measurements)

    @property
    def sensors(self) -> list[tuple[int, ...]]:
        """The sensors that are judged one by one."""
        p = self.base.measurements.shape[1]
        return [(j,) for j in range(p)] if p <= MOST_PARTS else []

    @property
    def inputs(self) -> Array:
        """The inputs as the model takes them."""
        return self.bank.full_inputs(self.base.inputs, self.base.step)


def times(covariance: Array, part: tuple[int, ...], factor: float) -> Array:
    """A covariance with the variances of some components, or of all, multiplied."""
    roots = np.ones(covariance.shape[-1])
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
            changed = replace(base, noise=times(base.noise, part, factor))
        case "disturbance":
            changed = replace(base, disturbance=times(base.disturbance, part, factor))
        case "gain":
            y, gains = base.measurements.copy(), np.ones(base.measurements.shape[1])
            y[:, where] /= factor
            gains[where] = factor
            changed = replace(
                base, measurements=y, gains=gains * (1.0 if base.gains is None else base.gains)
            )
        case _:  # sign, input, parameter
            inputs = base.inputs.copy()
            inputs[:, where] *= factor
            changed = replace(base, inputs=inputs)
    return Fault(
        kind, factor, changed, part, again=lambda value: with_factor(base, kind, part, value)
    )
