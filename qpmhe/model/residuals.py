"""Differences of outputs and states with angles among their components."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import integer, shown

from .._checks import numbers
from ..errors import InvalidInputError, ModelError, OptionError, SetError, ShapeError
from .expressions import import_casadi
from .functions import BatchedFunction, contained
from .sets import ConvexSet
from .tracing import Traced, traced

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
# Steps with which a user's function is tried, and how exactly it must follow them: as shares of
# the smallest difference that it moves, and of the step.
_STEP, _ACCURACY = 1e-7, 1e-3
_REMEDY = "For angles, take qpmhe.angles(indices)."


class Residual(ABC):
    """The difference a [-] b of two vectors: a - b, up to constants such as whole turns.

    Attributes
    ----------
    components : (k,) array
        The components that may be moved by such a constant; the others are a - b.
    periods : (k,) array or None
        What whole multiples of they are moved by; None of a user's function.
    """

    components: NDArray[np.intp]
    periods: Array | None = None

    @property
    def expression(self) -> Traced:
        """A user's function of (a, b) as CasADi has it."""
        return Traced(None, "it is no function")

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Array:
        """A [-] b, for arrays (..., d)."""
        a = np.asarray(a, np.float64)
        difference: Array = a - np.asarray(b, np.float64)
        self.wrap(difference, a)
        return difference

    @abstractmethod
    def wrap(self, differences: Array, minuends: Array) -> None:
        """Turn differences a - b (..., d) into a [-] b, in place; the minuends are a."""

    def aligned(self, points: Array, references: Array) -> Array:
        """Points (..., d), moved by whole turns so that their plain difference is the residual."""
        wrapped = self(points, references)
        moved = wrapped != points - references
        return np.where(moved, references + wrapped, points) if moved.any() else points

    @abstractmethod
    def check(self, name: str, dimension: int) -> None:
        """Raise unless it is for vectors of this dimension; ``name`` is for messages."""


def difference(residual: Residual | None, a: Array, b: Array) -> Array:
    """A [-] b, or a - b without a residual function; NaN where a user's raises."""
    if residual is None:
        return a - b
    try:
        return residual(a, b)
    except Exception:  # bad luck at run time, for which not every caller has a remedy
        return np.full_like(a - b, np.nan)


class Angles(Residual):
    """What `angles` returns.

    Attributes
    ----------
    components : (k,) array
        The components that are angles.
    periods : (k,) array
        Their periods.
    """

    def __init__(self, components: NDArray[np.intp], periods: Array) -> None:
        self.components = components
        self.periods: Array = periods
        # Neighbours are a slice, which is faster than an index.
        first = int(components[0])
        neighbours = np.array_equal(components, np.arange(first, first + components.size))
        self._place = slice(first, first + components.size) if neighbours else components

    def wrap(self, differences: Array, minuends: Array) -> None:
        """See `Residual.wrap`."""
        part = differences[..., self._place]
        turns = np.floor(part / self.periods + 0.5)
        if np.count_nonzero(turns):  # also for NaN
            differences[..., self._place] = part - turns * self.periods

    def check(self, name: str, dimension: int) -> None:
        """See `Residual.check`."""
        largest = int(self.components.max())
        if largest >= dimension:
            raise InvalidInputError(
                f"{name} names component {largest} as an angle; expected indices from 0 to "
                f"{dimension - 1}."
            )

    def __repr__(self) -> str:
        return f"angles({self.components.tolist()}, period={self.periods.tolist()})"


def angles(indices: ArrayLike, period: ArrayLike = 2.0 * math.pi) -> Angles:
    r"""Declare components of an output or of a state as angles, for `System`.

    .. math::
        (a \ominus b)_j = a_j - b_j - k_j P_j \in [-P_j/2, P_j/2), \qquad k_j \in \mathbb Z

    for the named components; the others are plain differences. Differences within half a period do
    not change.

    Parameters
    ----------
    indices : int or (k,) array_like of int
        The components that are angles, counted from 0.
    period : float or (k,) array_like
        P, one for all or one for each, in the angle's unit: 360 for degrees.

    Returns
    -------
    Angles
        For ``output_residual`` or ``state_residual`` of a `System`. Called as ``residual(a, b)``
        on arrays (..., d), it returns the difference.

    Raises
    ------
    InvalidInputError
        If an index is not an integer >= 0, or occurs twice.
    OptionError, ShapeError
        If a period is not finite and above zero, or their number is not the number of indices.

    Examples
    --------
    >>> import qpmhe
    >>> bearing = qpmhe.angles([1], period=360.0)
    >>> bearing([2.0, 179.0], [1.0, -179.0]).tolist()
    [1.0, -2.0]
    """
    try:
        given = np.atleast_1d(np.asarray(indices))
        chosen = [integer(one) for one in given.tolist()]
    except (TypeError, ValueError):
        given, chosen = np.empty(0), []
    if given.ndim != 1 or not chosen or not all(one is not None and one >= 0 for one in chosen):
        raise InvalidInputError(
            f"indices is {shown(indices)}; expected one or more integers >= 0, the components "
            "that are angles. Without angles, leave out the residual function."
        )
    components = np.array(chosen, np.intp)
    if np.unique(components).size < components.size:
        raise InvalidInputError(
            f"indices is {components.tolist()}, which names a component twice; expected distinct "
            "indices."
        )
    periods = np.atleast_1d(numbers("period", period, finite=False))
    if periods.shape not in ((1,), components.shape):
        raise ShapeError(
            f"period has shape {periods.shape}; expected one number, or one for each of the "
            f"{components.size} angles."
        )
    if not (np.isfinite(periods).all() and (periods > 0.0).all()):
        raise OptionError(
            f"period is {periods.tolist()}; expected finite numbers > 0: 2 pi for radians, 360 "
            "for degrees."
        )
    return Angles(components, np.broadcast_to(periods, components.shape).copy())


class _Given(Residual):
    """A user's function (a, b)."""

    def __init__(self, name: str, function: Callable[..., Any], dimension: int) -> None:
        self._name, self._user, self._dimension = name, function, dimension
        self._expression: Traced | None = None
        rng = np.random.default_rng(20210829)
        pairs = [
            tuple(10.0**k * rng.uniform(-1.0, 1.0, (2, dimension))) for k in range(-12, 13)
        ]
        self._function: Any = contained(function)
        shape = self._checked(*pairs[12]).shape
        if shape != (dimension,) and (shape or dimension > 1):
            raise ModelError(
                f"{name} returned shape {shape} for two vectors of {dimension} numbers; expected "
                f"({dimension},), their difference."
            )
        self._function = BatchedFunction(name, function, (dimension,), dimension, pairs)
        self._check_zero(rng.uniform(-1.0, 1.0, dimension), 1.0)
        unit, moved = 1.0, np.zeros(dimension, np.bool_)
        for a, b in reversed(pairs):
            now = self._moved(self._checked(a, b), a - b, a)
            moved |= now
            if now.any():
                unit = float(np.abs(a - b)[now].min())
        self.components = np.flatnonzero(moved)
        for share in (0.01, 0.1, 1.0, 10.0):
            a, b = unit * share * rng.uniform(-1.0, 1.0, (2, dimension))
            self._check_slope(a, b, unit)

    def _checked(self, a: Array, b: Array) -> Array:
        try:
            with np.errstate(all="ignore"):
                value = np.asarray(self._function(a.copy(), b.copy()), np.float64)
        except Exception as error:
            raise ModelError(
                f"{self._name} raised {type(error).__name__}: {error} at a = {a.tolist()}, "
                f"b = {b.tolist()}; expected the difference a - b, up to whole turns."
            ) from error
        if not np.isfinite(value).all():
            raise ModelError(
                f"{self._name} is {value.tolist()} at a = {a.tolist()}, b = {b.tolist()}; "
                "expected finite numbers, the difference a - b up to whole turns."
            )
        return value

    def _check_zero(self, a: Array, unit: float) -> Array:
        value = self._checked(a, a.copy())
        if (np.abs(value) > 64.0 * _EPS * max(unit, np.abs(a).max())).any():
            raise ModelError(
                f"{self._name} is {value.tolist()} at a = b = {a.tolist()}; expected zeros, as for "
                f"a difference. {_REMEDY}"
            )
        return value

    def _check_slope(self, a: Array, b: Array, unit: float) -> None:
        """Check that it is zero at equality, and changes as a - b does nearby and far away."""
        rounding = 64.0 * _EPS * max(unit, np.abs(a).max(), np.abs(b).max())
        at_equality = self._check_zero(a, unit)
        steps = _STEP * unit * np.concatenate((np.eye(self._dimension), -np.eye(self._dimension)))
        for other, value in ((a, at_equality), (b, self._checked(a, b))):
            for ahead in a + steps:
                rise, taken = self._checked(ahead, other.copy()) - value, ahead - a
                if (np.abs(rise - taken) > _ACCURACY * _STEP * unit + rounding).any():
                    raise ModelError(
                        f"{self._name} changes by {rise.tolist()} where a = {a.tolist()}, b = "
                        f"{other.tolist()} and a changes by {taken.tolist()}; expected the same "
                        f"change: it must equal a - b up to constants. {_REMEDY}"
                    )

    @staticmethod
    def _moved(values: Array, plain: Array, minuends: Array) -> NDArray[np.bool_]:
        # Not by rounding. Also where a value is NaN.
        moved: NDArray[np.bool_] = ~(
            np.abs(values - plain) <= 0.5 * np.abs(plain) + 64.0 * _EPS * np.abs(minuends)
        )
        return moved

    def wrap(self, differences: Array, minuends: Array) -> None:
        """See `Residual.wrap`."""
        a = np.broadcast_to(minuends, differences.shape)
        values = self._function.batch(a, a - differences)
        moved = self._moved(values, differences, a)
        if moved.any():
            differences[moved] = values[moved]

    def check(self, name: str, dimension: int) -> None:
        """See `Residual.check`."""
        if dimension != self._dimension:
            raise ShapeError(f"{name} is for {self._dimension} components; expected {dimension}.")

    @property
    def expression(self) -> Traced:
        """See `Residual.expression`; found at the first use."""
        if self._expression is None:
            self._expression = traced(self._user, (self._dimension, self._dimension))
        return self._expression

    def __reduce__(self) -> tuple[Any, ...]:
        return _Given, (self._name, self._user, self._dimension)


class _Extended(Residual):
    """A residual of the first components of vectors that have plain ones behind."""

    def __init__(self, first: Residual, count: int, dimension: int) -> None:
        self._first, self._count, self._dimension = first, count, dimension
        self.components, self.periods = first.components, first.periods

    @property
    def expression(self) -> Traced:
        """See `Residual.expression`."""
        first, count = self._first.expression, self._count
        if first.function is None:
            return first
        ca = import_casadi()
        a, b = (ca.SX.sym(name, self._dimension) for name in "ab")
        joined = ca.vertcat(first.function(a[:count], b[:count]), a[count:] - b[count:])
        function = ca.Function("residual", [a, b], [joined])
        return Traced(function, "", (self._dimension,), made_of=first)

    def wrap(self, differences: Array, minuends: Array) -> None:
        """See `Residual.wrap`."""
        self._first.wrap(differences[..., : self._count], minuends[..., : self._count])

    def check(self, name: str, dimension: int) -> None:
        """See `Residual.check`."""
        if dimension != self._dimension:
            raise ShapeError(f"{name} is for {self._dimension} components; expected {dimension}.")


def extended(residual: Residual | None, count: int, dimension: int) -> Residual | None:
    """The residual for vectors of this dimension, of which it knows the first components."""
    if residual is None or count == dimension:
        return residual
    return _Extended(residual, count, dimension)


def checked_residual(name: str, value: Any, dimension: int) -> Residual | None:
    """The residual for vectors of this dimension, from `angles`, a function, or None."""
    if value is None:
        return None
    if not (isinstance(value, Residual) or callable(value)):
        raise ModelError(
            f"{name} is {shown(value)}; expected qpmhe.angles(indices), a function of a and b, "
            "or None."
        )
    residual = value if isinstance(value, Residual) else _Given(name, value, dimension)
    residual.check(name, dimension)
    return residual


class Turns:
    """Moves angles that X bounds into the turn whose middle is the middle of their bounds.

    Attributes
    ----------
    states : ConvexSet or None
        X without bounds that are a whole period apart or more; None if it has no others.
    """

    def __init__(self, residual: Residual, states: ConvexSet) -> None:
        lower, upper, which = states.lower.copy(), states.upper.copy(), residual.components
        angle = np.zeros(states.dimension, np.bool_)
        angle[which] = True
        one_sided = angle & (np.isfinite(lower) != np.isfinite(upper))
        if one_sided.any():
            j = int(np.argmax(one_sided))
            raise SetError(
                f"states bounds component {j}, an angle, by lower {lower[j]} and upper "
                f"{upper[j]}; expected two finite bounds or none: on a circle, one bound alone "
                "has no effect."
            )
        rows = states.touched(angle)
        if rows.any():
            raise SetError(
                f"row {int(np.argmax(rows))} of the matrix of states has a coefficient of an "
                f"angle, one of the components {which.tolist()}; expected angles only in component "
                "bounds (qpmhe.Box): with whole turns added, a sum has no meaning."
            )
        bounded = angle & np.isfinite(lower)
        self._residual = residual
        ends = np.where(bounded, (lower, upper), 0.0)
        middle = 0.5 * ends[0] + 0.5 * ends[1]
        # The residual moves what is half a period from the middle or more.
        free = bounded & (residual.aligned(ends, middle) != ends)[1]
        lower[free], upper[free] = -np.inf, np.inf
        self._middle, self._bounded = middle, bounded & ~free
        self.states: ConvexSet | None = states
        if free.any():
            self.states = ConvexSet(
                lower, upper, states.matrix, states.row_lower, states.row_upper
            )
            if not (self.states.bounded_components.size or self.states.matrix.size):
                self.states = None

    def __bool__(self) -> bool:
        return bool(self._bounded.any())

    @property
    def middle(self) -> Array:
        """The middle of the bounds of each angle; infinity for components without."""
        return np.where(self._bounded, self._middle, np.inf)

    def sides(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Other bounds of the states, moved by whole turns into this turn.

        Raises
        ------
        SetError
            If they do not fit into it, or an angle has one bound only.
        """
        given = np.isfinite(lower) & np.isfinite(upper) & self._bounded
        ends = np.where(given, (lower, upper), 0.0)
        middle = 0.5 * ends[0] + 0.5 * ends[1]
        ends += np.where(given, self(np.where(given, middle, self._middle)) - middle, 0.0)
        inside = (self(np.where(given, ends, self._middle)) == ends).all(axis=0)
        wrong = self._bounded & ~np.where(given, inside, lower == -upper)
        if wrong.any():
            j = int(np.argmax(wrong))
            raise SetError(
                f"component {j} of the states, an angle, has the new bounds lower {lower[j]} and "
                f"upper {upper[j]}; expected two bounds less than half a period from "
                f"{self._middle[j]}, the middle of the system's bounds, up to whole turns."
            )
        return np.where(given, ends[0], lower), np.where(given, ends[1], upper)

    def __call__(self, points: Array) -> Array:
        """Points (..., n) in this turn; the same array where all are or a residual raises."""
        try:
            return self._residual.aligned(points, np.where(self._bounded, self._middle, points))
        except Exception:
            return points
