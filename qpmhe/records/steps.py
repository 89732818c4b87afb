"""From times to steps: lengths of steps, and samples that are missing between two lines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import median

from .._checks import count, positive
from ..errors import InvalidInputError, OptionError
from ..system import System

__all__ = ["OnlyGapsError", "Step", "Steps"]

# How far from a multiple of the usual step a discrete system's samples may be.
_JITTER = 0.3
# Up to here a step is the usual one: times are rounded.
_SAME = 1e-6
# Most samples without measurement in a row, if nobody says.
_MOST = 1000
# So many steps at the record's beginning must not be gaps of one size, nor all steps of a
# record that is shorter; sizes so far apart are one.
_TRIAL, _SHORTEST, _ALIKE = 8, 3, 0.1


class OnlyGapsError(ValueError):
    """A record whose unit of time will be another one than the model's."""


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
    most : int, optional
        Most samples without measurement in a row. If left out, 1000, and a record that
        consists of nothing but such gaps is taken to be in another unit of time.

    Attributes
    ----------
    usual : float or None
        The usual length, as soon as it is known.
    measured : bool
        Whether steps have the lengths that the record says.
    most : int
        Most samples without measurement in a row.

    Raises
    ------
    OptionError
        If an option does not fit.
    """

    def __init__(
        self, system: System, *, usual: float | None = None, scale: float = 1.0,
        equal: bool = False, most: int | None = None,
    ) -> None:
        self._scale = positive("--time-scale", scale)
        self.most = _MOST if most is None else count("--max-gap", most, 0)
        # Numbers of steps from sample to sample, until it is clear that the unit fits.
        self._trial: list[int] | None = [] if most is None else None
        self.measured = not equal and _takes_lengths(system)
        self.usual = system.dt if usual is None else positive("--dt", usual)
        if system.dt is not None and not math.isclose(self.usual or 0.0, system.dt, rel_tol=_SAME):
            raise OptionError(
                f"--dt is {usual!r}, and the model's own step {system.dt}; leave it out, or make "
                "the model with the other."
            )

    @property
    def settled(self) -> bool:
        """Whether it is clear that the record's unit of time is the model's."""
        return self._trial is None

    def restore(self, usual: float | None) -> None:
        """Go on within a record.

        Parameters
        ----------
        usual : float or None
            The usual step so far.
        """
        self.usual, self._trial = usual, None

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
        OnlyGapsError
            If so far all of them were gaps of one size.
        """
        length = spacing * self._scale
        if self.usual is None:
            self.usual = length
        number = max(1, round(min(length / self.usual, 1e15)))
        if number - 1 > self.most:
            raise ValueError(
                f"a gap of {length:.6g} is {number} steps of {self.usual:.6g}; at most "
                f"{self.most} samples in a row may be missing. Split the record there, raise "
                "--max-gap, or give --time-scale if the record's unit of time is not the model's"
            )
        self._try(number)
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

    def finish(self) -> None:
        """Judge a record that had only a few steps.

        Raises
        ------
        OnlyGapsError
            If all of them are gaps of one size.
        """
        if self._trial:
            self._judge(_SHORTEST, exceptions=0)

    def _try(self, number: int) -> None:
        """Add a step to those that must not all be gaps, but for one; judge them in time."""
        if self._trial is None:
            return
        self._trial.append(number)
        if self._trial.count(1) > 1:
            self._trial = None
        elif len(self._trial) == _TRIAL:
            self._judge(_TRIAL, exceptions=1)
            self._trial = None

    def _judge(self, enough: int, exceptions: int) -> None:
        trial = self._trial or []
        size = int(median(trial))
        same = sum(abs(number - size) <= _ALIKE * size for number in trial)
        if size < 2 or len(trial) < enough or same < len(trial) - exceptions:
            return
        assert self.usual is not None
        raise OnlyGapsError(
            f"the record has nothing but gaps of about {size} usual steps, {self.usual:.6g} "
            f"each, from its beginning; give --time-scale {self._scale / size:.4g} or so if its "
            "unit of time is not the model's, or a model (or --dt) of another usual step; if "
            f"samples do come as seldom, say so by --max-gap {max(trial)}"
        )


def _takes_lengths(system: System) -> bool:
    try:
        return system.timed is not None
    except InvalidInputError:
        return False
