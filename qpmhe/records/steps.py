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
_MAX_GAP = 1000
# So many steps at the beginning must not be gaps of one size; sizes that differ by less are one.
_TRIAL, _SIZE_TOLERANCE = 3, 0.1


class OnlyGapsError(ValueError):
    """A record whose unit of time is probably not the model's."""


class Step(NamedTuple):
    """Length of each step for ``update``, None for the usual one; and samples to insert."""

    length: float | None
    inserted: int


class Steps:
    """The steps of a record: of any length (`any_length`), or multiples of the usual one."""

    def __init__(
        self, system: System, *, usual: float | None = None, scale: float = 1.0,
        equal: bool = False, max_gap: int | None = None,
    ) -> None:
        self._scale = positive("--time-scale", scale)
        self.max_gap = _MAX_GAP if max_gap is None else count("--max-gap", max_gap, 0)
        # Numbers of steps between samples, until it is clear that the unit of time fits.
        self._trial: list[int] | None = [] if max_gap is None else None
        self.any_length = not equal and _takes_lengths(system)
        self.usual = system.dt if usual is None else positive("--dt", usual)
        if system.dt is not None and not math.isclose(
            self.usual or 0.0, system.dt, rel_tol=_ROUNDING
        ):
            raise OptionError(
                f"--dt is {usual!r}, and the model's own step {system.dt}; leave --dt out, or "
                "make the model with that step."
            )

    @property
    def settled(self) -> bool:
        """Whether it is clear that the record's unit of time is the model's."""
        return self._trial is None

    def resume(self, usual: float | None) -> None:
        """Continue within a record, of which the usual step is known."""
        self.usual, self._trial = usual, None

    def between(self, spacing: float, magnitude: float) -> Step:
        """The step from one sample to the next, whose times differ by `spacing`.

        `magnitude` is the size of the times, which are rounded to some digits. Raises
        ValueError if it is no step, with what to do.
        """
        length = spacing * self._scale
        if self.usual is None:
            self.usual = length
        number = max(1, round(min(length / self.usual, 1e15)))
        if number - 1 > self.max_gap:
            raise ValueError(
                f"a gap of {length:.6g} is {number} steps of {self.usual:.6g}; at most "
                f"{self.max_gap} samples in a row may be missing. Split the record there, raise "
                "--max-gap, or give --time-scale if the record's unit of time is not the model's"
            )
        self._try(number)
        each = length / number
        rounding = _ROUNDING * self.usual + 4e-16 * magnitude * self._scale
        if self.any_length:
            return Step(None if abs(each - self.usual) <= rounding else each, number - 1)
        if abs(length - number * self.usual) > _JITTER * self.usual + rounding:
            raise ValueError(
                f"a step of {length:.6g} is no multiple of the usual one, {self.usual:.6g}; "
                "resample the record, give the usual step by --dt if it is another, or make "
                "the model by System.from_ode, which takes steps of any length"
            )
        return Step(None, number - 1)

    def _try(self, number: int) -> None:
        if self._trial is None:
            return
        self._trial.append(number)
        if len(self._trial) < _TRIAL:
            return
        trial, self._trial = self._trial, None
        size = sorted(trial)[_TRIAL // 2]
        if size < 2 or any(abs(one - size) > _SIZE_TOLERANCE * size for one in trial):
            return
        assert self.usual is not None
        raise OnlyGapsError(
            f"the record begins with nothing but gaps of about {size} usual steps, "
            f"{self.usual:.6g} each; give --time-scale {self._scale / size:.4g} or so if its unit "
            "of time is not the model's, or a model (or --dt) with another usual step; if the "
            f"samples really are that rare, give --max-gap {max(trial)} or more"
        )


def _takes_lengths(system: System) -> bool:
    try:
        return system.timed is not None
    except InvalidInputError:
        return False
