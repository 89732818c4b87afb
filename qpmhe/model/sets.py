"""The sets X, W and V of the estimation problem (eq:constraints)."""

from __future__ import annotations

import math
from copy import copy
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import numbers
from ..errors import SetError

Array = NDArray[np.float64]


class ConvexSet:
    r"""A closed polyhedron :math:`\{s : \ell \le s \le u,\ a \le M s \le b\}`.

    The base class of `Box` and `Polytope`; create one of these. ``&`` intersects two sets.

    Attributes
    ----------
    dimension : int
        Length of s.
    lower, upper : (d,) array
        Bounds on the components, infinite where there are none.
    matrix : (r, d) array
        M, one row for each general inequality.
    row_lower, row_upper : (r,) array
        a and b.
    """

    __slots__ = ("dimension", "lower", "matrix", "row_lower", "row_upper", "upper")

    def __init__(
        self, lower: Array, upper: Array, matrix: Array, row_lower: Array, row_upper: Array
    ) -> None:
        self.lower, self.upper, self.dimension = lower, upper, lower.size
        self.matrix, self.row_lower, self.row_upper = matrix, row_lower, row_upper

    @property
    def bounded_components(self) -> NDArray[np.intp]:
        """Components with a finite bound."""
        return np.flatnonzero(np.isfinite(self.lower) | np.isfinite(self.upper))

    @property
    def fixed_components(self) -> NDArray[np.intp]:
        """Components of zero width: equal lower and upper bounds."""
        return np.flatnonzero(self.lower == self.upper)

    def violation(
        self,
        points: Array,
        known: NDArray[np.bool_] | None = None,
        rounding: Array | float = 0.0,
    ) -> float:
        """The largest violation of a bound or a general inequality by points.

        Parameters
        ----------
        points : (..., d) array
            The points.
        known : (..., d) bool array, optional
            Known components; inequalities on others do not count.
        rounding : float or (..., 1) array
            Uncertainty of the points; violations up to this do not count.
        """
        missed = np.maximum(self.lower - points, points - self.upper) - rounding
        worst = float((missed if known is None else np.where(known, missed, 0.0)).max())
        if self.matrix.shape[0]:
            rows = points @ self.matrix.T
            missed = np.maximum(self.row_lower - rows, rows - self.row_upper) - rounding
            if known is not None:
                missed = np.where(self.touched(~known), 0.0, missed)
            worst = float(np.maximum(worst, missed.max()))
        # Comparisons with NaN are false: a NaN must not pass as a member.
        return math.inf if math.isnan(worst) else max(0.0, worst)

    def touched(self, components: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which general inequalities have a nonzero coefficient on these components.

        Parameters
        ----------
        components : (..., d) bool array
            The components.
        """
        touched: NDArray[np.bool_] = (components @ (self.matrix != 0.0).T.astype(np.intp)) > 0
        return touched

    def with_sides(
        self, lower: Array, upper: Array, row_lower: Array, row_upper: Array
    ) -> ConvexSet:
        """The same rows with other sides.

        Parameters
        ----------
        lower, upper, row_lower, row_upper : array
            The sides, with the shapes of this set's.

        Raises
        ------
        SetError
            If nothing is left.
        """
        other = copy(self)
        other.lower, other.upper = lower.copy(), upper.copy()
        other.row_lower, other.row_upper = row_lower.copy(), row_upper.copy()
        crossed = (lower > upper).any() or (row_lower > row_upper).any()
        if crossed or np.isnan(np.concatenate((lower, upper, row_lower, row_upper))).any():
            raise SetError(f"the set is empty: a lower bound is not below the upper ({other!r}).")
        if self.matrix.shape[0]:
            other._check_not_empty()
        return other

    def soften(
        self, *, linear: ArrayLike | None = None, quadratic: ArrayLike | None = None
    ) -> SoftSet:
        r"""Soften the set: its inequalities may be violated, at a cost.

        At each sample, every inequality j violated by :math:`s_j` then adds :math:`\rho_j s_j +
        \sigma_j s_j^2` to the cost J.

        Parameters
        ----------
        linear, quadratic : float or array_like, optional
            The penalties :math:`\rho` and :math:`\sigma` of each inequality, in cost per unit of
            the inequality and per unit squared; at least 0, and one of them above 0. One number for
            all, or an array: (d,) for the components of a box, (r,) for the rows of a polytope, (d
            + r,), components first, for a set with both.

        Raises
        ------
        SetError
            If a penalty is not a finite number >= 0, or an inequality has none.
        """
        bounded = np.isfinite(self.lower) | np.isfinite(self.upper)
        rows = self.matrix.shape[0]
        if rows and not bounded.any():
            made = penalties(linear, quadratic, np.ones(rows, np.bool_), "set")
            none = np.zeros(self.dimension)
            return SoftSet(self, np.append(none, made[0]), np.append(none, made[1]))
        counts = np.append(bounded, np.ones(rows, np.bool_))
        return SoftSet(self, *penalties(linear, quadratic, counts, "set"))

    def __and__(self, other: ConvexSet) -> ConvexSet:
        if not isinstance(other, ConvexSet):
            return NotImplemented
        if other.dimension != self.dimension:
            raise SetError(
                f"sets of dimensions {self.dimension} and {other.dimension} cannot be "
                "intersected; expected equal dimensions."
            )
        both = ConvexSet(
            np.maximum(self.lower, other.lower),
            np.minimum(self.upper, other.upper),
            np.vstack((self.matrix, other.matrix)),
            np.append(self.row_lower, other.row_lower),
            np.append(self.row_upper, other.row_upper),
        )
        both._check_not_empty()
        return both

    def _check_not_empty(self) -> None:
        from scipy.optimize import Bounds, LinearConstraint, milp

        # A linear program without objective, in numbers of order one: its solver drops small
        # coefficients, and takes large bounds for none. milp takes two-sided rows as they are.
        rows, columns = equilibrated(self.matrix)
        sides = [
            self.lower / columns, self.upper / columns, self.row_lower * rows,
            self.row_upper * rows,
        ]
        finite = np.concatenate([np.abs(side[np.isfinite(side)]) for side in sides])
        unit = float(finite.max(initial=0.0)) or 1.0
        lower, upper, row_lower, row_upper = (side / unit for side in sides)
        answer = milp(
            np.zeros(self.dimension),
            bounds=Bounds(lower, upper),
            constraints=(
                LinearConstraint(rows[:, None] * self.matrix * columns, row_lower, row_upper)
                if self.matrix.shape[0]
                else ()
            ),
        )
        if answer.status == 2:
            raise SetError(
                f"the set is empty: no point satisfies all of its inequalities ({self!r})."
            )

    def __repr__(self) -> str:
        box = f"lower={self.lower.tolist()}, upper={self.upper.tolist()}"
        rows = f", {self.matrix.shape[0]} rows" if self.matrix.shape[0] else ""
        return f"{type(self).__name__}({box}{rows})"


class SoftSet:
    """A set whose inequalities may be violated at a cost; made by `ConvexSet.soften`.

    Attributes
    ----------
    convex : ConvexSet
        The set without a violation.
    linear, quadratic : (d + r,) array
        Penalties of the d components and the r general inequalities.
    """

    __slots__ = ("convex", "linear", "quadratic")

    def __init__(self, convex: ConvexSet, linear: Array, quadratic: Array) -> None:
        self.convex, self.linear, self.quadratic = convex, linear, quadratic

    @property
    def dimension(self) -> int:
        """Length of a point."""
        return self.convex.dimension

    def __and__(self, other: object) -> NoReturn:
        raise SetError(
            f"{self!r} cannot be intersected; intersect sets first and soften the result, or pass "
            "the soft inequalities as a qpmhe.Constraint."
        )

    __rand__ = __and__

    def __repr__(self) -> str:
        return f"{self.convex!r}.soften(...)"


def penalties(
    linear: ArrayLike | None, quadratic: ArrayLike | None, counts: NDArray[np.bool_], what: str
) -> tuple[Array, Array]:
    """The checked penalties of rows, of which those that count need one."""
    made = []
    for name, given in (("linear", linear), ("quadratic", quadratic)):
        value = np.zeros(()) if given is None else numbers(name, given, finite=False)
        if value.shape not in ((), counts.shape):
            raise SetError(
                f"{name} has shape {value.shape}; expected one number, or {counts.size} of them, "
                f"one for each row of the {what}."
            )
        if not (np.isfinite(value) & (value >= 0.0)).all():
            raise SetError(f"{name} is {value.tolist()}; expected finite numbers >= 0.")
        made.append(np.broadcast_to(value, counts.shape).copy())
    free = counts & (made[0] == 0.0) & (made[1] == 0.0)
    if free.any():
        raise SetError(
            f"row {int(np.argmax(free))} of the soft {what} has no penalty (linear = "
            f"{shown(linear)}, quadratic = {shown(quadratic)}), so it "
            f"would have no effect; pass linear > 0 or quadratic > 0, or leave the {what} hard."
        )
    return made[0], made[1]


# Of a bound: beyond it, there is none.
_LARGEST = 1e150


class Box(ConvexSet):
    r"""A box :math:`\{s : \ell \le s \le u\}`, open-ended where a bound is infinite.

    Parameters
    ----------
    lower, upper : array_like
        Bounds of equal shape (d,), in the units of the vector that they bound; ``-inf`` and ``inf``
        where a component is unbounded. Bounds beyond 1e150, whose squares are not finite, count as
        none. Equal bounds fix a component: a disturbance in {0} makes its
        state free of process noise.

    Raises
    ------
    SetError
        If the shapes differ, a bound is NaN, or the box is empty.
    """

    __slots__ = ()

    def __init__(self, lower: ArrayLike, upper: ArrayLike) -> None:
        low = np.atleast_1d(numbers("lower", lower, finite=False))
        high = np.atleast_1d(numbers("upper", upper, finite=False))
        if low.ndim != 1 or low.shape != high.shape:
            raise SetError(
                f"lower has shape {low.shape} and upper {high.shape}; expected two vectors of "
                "equal length, with -inf and inf where a component is unbounded."
            )
        if np.isnan(low).any() or np.isnan(high).any():
            raise SetError(
                f"a bound is NaN (lower {low.tolist()}, upper {high.tolist()}); "
                "write -inf or inf where a component is unbounded."
            )
        # Differences of larger numbers overflow.
        low, high = np.where(low < -_LARGEST, -np.inf, low), np.where(high > _LARGEST, np.inf, high)
        empty = (low > high) | (low > _LARGEST) | (high < -_LARGEST)
        if empty.any():
            j = int(np.argmax(empty))
            raise SetError(
                f"the box is empty: component {j} has lower {low[j]} and upper {high[j]}; "
                "expected lower <= upper."
            )
        nothing = np.empty(0)
        super().__init__(low, high, np.empty((0, low.size)), nothing, nothing)


class Polytope(ConvexSet):
    r"""A polyhedron :math:`\{s : M s \le b\}`, bounded or not.

    Parameters
    ----------
    matrix : (r, d) array_like
        M, one row for each inequality.
    bound : (r,) array_like
        b, in the units of the rows.

    Raises
    ------
    SetError
        If the shapes do not fit, a row is zero, or the set is empty.
    InvalidInputError
        If an entry is not finite.
    """

    __slots__ = ()

    def __init__(self, matrix: ArrayLike, bound: ArrayLike) -> None:
        rows = np.atleast_2d(numbers("matrix", matrix))
        side = np.atleast_1d(numbers("bound", bound))
        if rows.ndim != 2 or side.shape != (rows.shape[0],) or rows.shape[1] == 0:
            raise SetError(
                f"matrix has shape {rows.shape} and bound {side.shape}; expected (r, d) and (r,)."
            )
        zero = ~rows.any(axis=1)
        if zero.any():
            raise SetError(
                f"row {int(np.argmax(zero))} of matrix is zero; leave out zero rows."
            )
        free = np.full(rows.shape[1], np.inf)
        super().__init__(-free, free, rows, np.full(side.size, -np.inf), side)
        self._check_not_empty()


def behind_free(count: int, one: ConvexSet | SoftSet) -> ConvexSet | SoftSet:
    """All (f, s) with any f (count,) and s in the set, as soft as that."""
    hard, free = one.convex if isinstance(one, SoftSet) else one, np.full(count, np.inf)
    wide = ConvexSet(
        np.append(-free, hard.lower), np.append(free, hard.upper),
        np.pad(hard.matrix, ((0, 0), (count, 0))), hard.row_lower, hard.row_upper,
    )
    if not isinstance(one, SoftSet):
        return wide
    none = np.zeros(count)
    return SoftSet(wide, np.append(none, one.linear), np.append(none, one.quadratic))


def equilibrated(matrix: Array) -> tuple[Array, Array]:
    """Factors of rows and columns that bring the geometric mean of each one's entries to 1."""
    there = matrix != 0.0
    exponents = np.log2(np.abs(matrix), where=there, out=np.zeros(matrix.shape))
    counts = np.maximum(there.sum(axis=1), 1), np.maximum(there.sum(axis=0), 1)
    rows, columns = (np.zeros(size) for size in matrix.shape)
    for _ in range(30):
        rows = -np.sum(exponents + np.where(there, columns, 0.0), axis=1) / counts[0]
        columns = -np.sum(exponents + np.where(there, rows[:, None], 0.0), axis=0) / counts[1]
    return np.exp2(np.round(rows)), np.exp2(np.round(columns))
