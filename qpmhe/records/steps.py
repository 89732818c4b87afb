"""From times to steps: lengths of steps, and samples that are missing between two lines."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .._checks import count, positive
from ..errors import InvalidInputError, OptionError
from ..system import System

__all__ = ["Step", "Steps"]

# How far from a multiple of the usual step a discrete system's samples may be.
_JITTER = 0.3
# Up to here a step is the usual one: times are rounded.
_SAME = 1e-6


@dataclass(frozen=True)
class Step:
    """What lies between two samples.

    Parameters
    ----------
    length : float or None
        Length of each step, for ``update``; None for the usual one.
    inserted : int
        Samples without measurement in between.
    """

    length: float | None
    inserted: int


class Steps:
    """The steps of a record.

    Parameters
    ----------
    system : System
        The model; made by `System.from_ode`, it can take steps of any length.
    usual : float, optional
        Usual length of a step, in the model's unit; that of the system if it has one, and
        otherwise that of the record's first step, if left out.
    scale : float
        The record's unit of time in the model's.
    equal : bool
        Whether to insist on equal steps where the system could take any.
    most : int
        Most samples without measurement in a row.

    Attributes
    ----------
    usual : float or None
        The usual length, as soon as it is known.
    measured : bool
        Whether steps have the lengths that the record says.

    Raises
    ------
    OptionError
        If an option does not fit.
    """

    def __init__(
        self, system: System, *, usual: float | None = None, scale: float = 1.0,
        equal: bool = False, most: int = 1000,
    ) -> None:
        self._scale, self._most = positive("--time-scale", scale), count("--max-gap", most, 0)
        self.measured = not equal and _takes_lengths(system)
        self.usual = system.dt if usual is None else positive("--dt", usual)
        if system.dt is not None and not math.isclose(self.usual or 0.0, system.dt, rel_tol=_SAME):
            raise OptionError(
                f"--dt is {usual!r}, and the model's own step {system.dt}; leave it out, or make "
                "the model with the other."
            )

    def between(self, spacing: float, magnitude: float) -> Step:
        """The step or steps from one sample to the next.

        Parameters
        ----------
        spacing : float
            Difference of their times, positive.
        magnitude : float
            Size of the times, which are rounded to some digits.

        Raises
        ------
        ValueError
            If it is no step; the text tells why and what to do.
        """
        length = spacing * self._scale
        if self.usual is None:
            self.usual = length
        number = max(1, round(min(length / self.usual, 1e15)))
        if number - 1 > self._most:
            raise ValueError(
                f"a gap of {length:.6g} is {number} steps of {self.usual:.6g}; at most "
                f"{self._most} samples in a row may be missing. Split the record there, raise "
                "--max-gap, or give --time-scale if the record's unit of time is not the model's"
            )
        each = length / number
        rounding = _SAME * self.usual + 4e-16 * magnitude * self._scale
        if self.measured:
            return Step(None if abs(each - self.usual) <= rounding else each, number - 1)
        if abs(length - number * self.usual) > _JITTER * self.usual + rounding:
            raise ValueError(
                f"a step of {length:.6g} is no multiple of the usual one, {self.usual:.6g}; "
                "resample the record, give the usual step by --dt if it is another, or make "
                "the model by System.from_ode, which takes steps of any length"
            )
        return Step(None, number - 1)


def _takes_lengths(system: System) -> bool:
    try:
        return system.timed is not None
    except InvalidInputError:
        return False
