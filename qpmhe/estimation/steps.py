"""From times to steps: their lengths, and the samples that are missing between two lines."""

from __future__ import annotations

import math
from typing import NamedTuple

from .._checks import count, positive
from ..errors import InvalidInputError, OptionError
from ..model.system import System

# How far from a multiple of the usual step a discrete system's samples may be.
_JITTER = 0.3
# Steps that differ by less are equal: times are rounded.
_ROUNDING = 1e-6
# Milliseconds taken for seconds are gaps of 999.
MAX_GAP = 500
# Seconds taken for milliseconds are such a share of the usual step, or less.
_SHORT = 1 / 200


class Step(NamedTuple):
    """Length of each step for ``update``, None for the usual one; and samples to insert."""

    length: float | None
    inserted: int


class Steps:
    """The steps of a record: of any length (`any_length`), or multiples of the usual one.

    Without `max_gap`, gaps have the usual limit and no message names an option for it. Messages
    name the options `scaling` and `spacing`; the latter is empty where the user cannot give it.
    """

    def __init__(
        self, system: System, *, usual: float | None = None, scale: float = 1.0,
        equal: bool = False, max_gap: int | None = None, scaling: str = "--time-scale",
        spacing: str = "--dt",
    ) -> None:
        self._scaling, self._spacing = scaling, spacing
        self._scale = positive(scaling, scale)
        self.max_gap = MAX_GAP if max_gap is None else count("--max-gap", max_gap, 0)
        self._raise_it = "" if max_gap is None else "raise --max-gap, "
        self._steps = self._short = 0
        self.any_length = not equal and _takes_lengths(system)
        self.usual = system.dt if usual is None else positive("--dt", usual)
        if system.dt is not None and not math.isclose(
            self.usual or 0.0, system.dt, rel_tol=_ROUNDING
        ):
            raise OptionError(
                f"--dt is {usual!r}, but the model's step is {system.dt}; leave --dt out, or "
                "make the model with that step."
            )

    def between(self, spacing: float, digit: float) -> Step:
        """The step from one sample to the next, whose times differ by `spacing`.

        The last digit to which the times are rounded is `digit`. Raises ValueError, with the
        remedy, if it is not a step.
        """
        length = spacing * self._scale
        if self.usual is None:
            self.usual = length
        number = max(1, round(min(length / self.usual, 1e15)))
        if number - 1 > self.max_gap:
            raise ValueError(
                f"a gap of {length:.6g} is {number} steps of {self.usual:.6g}; at most "
                f"{self.max_gap} samples in a row may be missing. Split the record there, "
                f"{self._raise_it}or give {self._scaling} if the record's unit of time is not the "
                "model's"
            )
        each = length / number
        rounding = _ROUNDING * self.usual + digit * self._scale
        self._steps += 1
        self._short += each < _SHORT * self.usual
        if self.any_length:
            return Step(None if abs(each - self.usual) <= rounding else each, number - 1)
        if abs(length - number * self.usual) > _JITTER * self.usual + rounding:
            raise ValueError(
                f"a step of {length:.6g} is no multiple of the usual one, {self.usual:.6g}; "
                "resample the record, "
                + (f"give the usual step with {self._spacing} if it is another, "
                   if self._spacing else "")
                + "or make the model by System.from_ode, which takes steps of any length"
            )
        return Step(None, number - 1)


    @property
    def note(self) -> str:
        """What the user should know of the steps so far; usually nothing."""
        if 2 * self._short <= self._steps:
            return ""
        return (
            f"{self._short} of {self._steps} steps are shorter than {_SHORT:g} times the usual "
            f"one, {self.usual:.6g}; give {self._scaling} if the record's unit of time is not the "
            "model's."
        )


def _takes_lengths(system: System) -> bool:
    try:
        return system.timed is not None
    except InvalidInputError:
        return False
