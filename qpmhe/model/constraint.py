"""A nonlinear constraint g(x, u, w, v) <= 0, alone and of a system's joint s = (x, w, v)."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import integer, shown

from ..errors import ModelError, SetError, ShapeError
from .derivatives import Jacobian
from .functions import BatchedFunction, Trusted, raised
from .points import ALL, FEW, USUAL, Points, points
from .sets import Box, ConvexSet, penalties
from .traces import depends, evaluated_alone, of_both
from .tracing import Traced, difference, traced

if TYPE_CHECKING:
    from .algebraic_set import AlgebraicSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NAMES = ("x", "u", "w", "v")
# Multiples of the standard deviations within which the scale of a row is looked for.
_REACHES = (1.0, 10.0, 100.0, 1000.0)
# Step of second derivatives, as a share of the standard deviations.
_MOVE = 2.0**-12


@report_unknown_options
class Constraint:
    r"""Nonlinear inequalities :math:`g(x, u, w, v) \le 0` at every sample, hard or soft.

    Without penalties they are hard: the estimator treats them like the sets W and V. With penalties
    they are soft: for each row j of g and each sample, the cost J gains

    .. math::
        \rho_j s + \sigma_j s^2, \qquad s = \max(0, g_j(x, u, w, v))

    with the discount of the sample's stage.

    Parameters
    ----------
    g : callable
        A function of any of x (n,), u (m,), w (r,) and v (p,), with these parameter names, that
        returns ``size`` numbers, or a number if ``size`` is 1. A function of x alone also holds for
        the newest state x(t+1); any other holds for the samples of the window.
    size : int
        Number of rows.
    linear, quadratic : float or (size,) array_like, optional
        The penalties :math:`\rho`, in cost per unit of the row, and :math:`\sigma`, in cost per
        unit squared; at least 0, and one of them above 0 for each row.

    Raises
    ------
    ModelError
        If g is not a function, or has other parameters.
    ShapeError
        If the size is not a positive integer.
    SetError
        If a penalty is not a finite number >= 0, or a row of a soft constraint has none.

    Examples
    --------
    >>> import qpmhe
    >>> inside_circle = qpmhe.Constraint(lambda x: x[0] ** 2 + x[1] ** 2 - 4.0)
    >>> preferred = qpmhe.Constraint(lambda x, u: x[0] - u[0], linear=10.0)
    """

    #: The set of z that g makes an inequality of x and u; None where g is written by users.
    algebraic: AlgebraicSet | None = None

    def __init__(
        self, g: Callable[..., Any], size: int = 1, *, linear: ArrayLike | None = None,
        quadratic: ArrayLike | None = None,
    ) -> None:
        if not callable(g):
            raise ModelError(
                f"g is {shown(g)}; expected a function of x, u, w or v, for g <= 0."
            )
        rows = integer(size)
        if rows is None or rows < 1:
            raise ShapeError(f"size is {shown(size)}; expected an integer >= 1, the rows of g.")
        self.g, self.size, self.names = g, rows, _parameters(g)
        #: Penalties of each row, two arrays (size,); None for a hard constraint.
        self.penalty: tuple[Array, Array] | None = None
        if linear is not None or quadratic is not None:
            self.penalty = penalties(linear, quadratic, np.ones(rows, np.bool_), "constraint")

    def __repr__(self) -> str:
        kind = "hard" if self.penalty is None else "soft"
        return f"Constraint(g({', '.join(self.names)}), size={self.size}, {kind})"


def _parameters(g: Callable[..., Any]) -> tuple[str, ...]:
    """The names among x, u, w and v that g takes."""
    remedy = "write it with parameters named x, u, w and v, such as lambda x, v: ..."
    try:
        parameters = inspect.signature(g).parameters.values()
    except (TypeError, ValueError) as error:
        raise ModelError(f"the parameters of g, {shown(g)}, have no names; {remedy}") from error
    for one in parameters:
        by_name = one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
        known = by_name and (one.name in _NAMES or one.default is not one.empty)
        if not known:
            raise ModelError(
                f"g has the parameter {one}; expected only x, u, w and v, which can be passed by "
                f"name: {remedy} Bind others with functools.partial or a default value."
            )
    names = tuple(one.name for one in parameters if one.name in _NAMES)
    if not set(names) - {"u"}:
        raise ModelError(
            f"g takes {' and '.join(names) or 'no argument'}, so that no estimate can change it; "
            f"{remedy}"
        )
    return names


class BoundConstraint:
    """A constraint of a system, as a function of the joint argument s of x, w and v.

    Attributes
    ----------
    function, jacobian : BatchedFunction, Jacobian
        g(s) or g(s, u), (size,), and its derivative with respect to s.
    parts : dict
        The slice of s for each of x, w and v that g takes.
    on_state : bool
        Whether g is a function of x alone.
    """

    def __init__(
        self, index: int, constraint: Constraint, sizes: dict[str, int],
        bounds: dict[str, ConvexSet | None],
    ) -> None:
        self.size, self._names, self._written = constraint.size, constraint.names, constraint.g
        name, m = f"constraints[{index}]", sizes["u"]
        if "u" in self._names and not m:
            raise ModelError(
                f"{name} takes u, but the system has no inputs; leave u out, or pass m."
            )
        self.algebraic = constraint.algebraic
        self.on_state = self._names == ("x",)
        self.parts: dict[str, slice] = {}
        self._d = 0
        lower, upper = [], []
        for part in ("x", "w", "v"):
            if part in self._names:
                self.parts[part] = slice(self._d, self._d + sizes[part])
                self._d += sizes[part]
                one, free = bounds[part], np.full(sizes[part], np.inf)
                lower.append(-free if one is None else one.lower)
                upper.append(free if one is None else one.upper)
        self._box = Box(np.concatenate(lower), np.concatenate(upper))
        self._inputs = m
        self._takes_input = "u" in self._names
        probes = points(FEW, self._d, m, self._box)
        try:
            self.function = BatchedFunction(
                name, self._with_input if self._takes_input else self._without_input,
                (self.size,), m, probes,
            )
        except ModelError as error:
            raise ModelError(f"{error} A constraint's size is the number of its rows.") from error
        given = None if self.algebraic is None else Trusted(self.algebraic.slopes)
        self.jacobian = Jacobian(self.function, given, m, probes, self._box)
        self._deviations: Array = np.empty(0)  # none yet
        self._user = self.function, self.jacobian
        #: The expression of g that is evaluated in its place; None where it is called as written,
        #: and why.
        self.trace: Traced | None = None
        self.untraced = ""

    def _without_input(self, s: Array) -> Any:
        return self._written(**self._split(s))

    def _with_input(self, s: Array, u: Array) -> Any:
        return self._written(**self._split(s), u=u)

    def _split(self, s: Array) -> dict[str, Array]:
        if len(self.parts) == 1:
            return dict.fromkeys(self.parts, s)
        return {name: s[part] for name, part in self.parts.items()}

    def copy(self) -> BoundConstraint:
        """The same, whose functions may come to be called in other ways."""
        other = copy(self)
        other.function = self.function.copy()
        other.jacobian = self.jacobian.copy(other.function)
        if self.trace is None:
            other._user = other.function, other.jacobian
        return other

    def joined(self, values: dict[str, Array]) -> Array:
        """s, of values of x, w and v along the same stages."""
        if len(self.parts) == 1:
            return values[next(iter(self.parts))]
        return np.concatenate([values[name] for name in self.parts], axis=-1)

    def use_scales(self, deviations: Array) -> None:
        """Take the typical magnitudes of s."""
        if np.array_equal(deviations, self._deviations):
            return
        self._deviations = deviations
        function, jacobian = self._user
        jacobian = jacobian.copy(function)
        jacobian.use_scales(deviations, None, ())
        self._user = self.function, self.jacobian = function, jacobian
        where = points(USUAL, self._d, self._inputs, self._box, deviations)
        found = self._traced([*where, *points(ALL, self._d, self._inputs, self._box)])
        self.trace, self.untraced = (found, "") if found.function else (None, found.reason)
        if self.trace is not None:
            self.function, self.jacobian = evaluated_alone(
                function, jacobian, self.trace, self._d, self._inputs
            )

    def _traced(self, where: Points) -> Traced:
        """The expression of g, if it has one that gives the same."""
        if self.algebraic is not None:
            return Traced(None, "it solves the algebraic equations")
        found = traced(of_both(self._user[0]), (self._d, self._inputs), where, name="g")
        if found.function is not None and found.function.numel_out(0) != self.size:
            return Traced(None, f"it returns shape {found.shape} of symbols")
        return found

    @property
    def written(self) -> Callable[[Array, Array], Any]:
        """G as the user wrote it, of (s, u)."""
        return of_both(self._user[0])

    def fault(self, where: Points) -> str:
        """How g differs from its expression at these points; blank if it does not."""
        return "" if self.trace is None else difference(self.trace, self.written, where)

    def as_written(self) -> BoundConstraint:
        """The same, with g called as it is written."""
        other = copy(self)
        (other.function, other.jacobian), other.trace = self._user, None
        other.untraced = "it has changed since it was traced"
        return other

    def scale(self, start: Array, deviations: Array, typical: Array, u: Array) -> Array:
        """The largest change (size,) of each row within a standard deviation around a start.

        A vague prior would make this change too large to judge a violation by. So the result is
        at most the change within the typical magnitudes, or the row's value if that is greater.
        """
        far, size = self._change(start, deviations, u)
        near, _ = self._change(start, typical, u)
        near = np.maximum(near, size)
        # A constant row holds everywhere or nowhere: any scale will do.
        far = np.where(far > 0.0, far, np.where(size > 0.0, size, 1.0))
        return np.where(near > 0.0, np.minimum(near, far), far)

    def _change(self, start: Array, deviations: Array, u: Array) -> tuple[Array, Array]:
        """The largest change of each row within deviations, and its value's size; 0 if unknown."""
        moves = np.vstack((np.eye(self._d), -np.eye(self._d), np.ones(self._d), -np.ones(self._d)))
        for inputs, reach in product((u, np.full_like(u, 0.5)), _REACHES):
            points = np.vstack((start, start + reach * deviations * moves))
            values = self.values(points, np.tile(inputs, (len(points), 1)))
            change, size = np.abs(values[1:] - values[0]), np.abs(values[0])
            change = np.where(np.isfinite(change), change, 0.0).max(axis=0) / reach
            if (change > 0.0).all():
                break
        return change, np.where(np.isfinite(size), size, 0.0)

    def values(self, s: Array, u: Array) -> Array:
        """Values along points s (K, d), (K, size); infinity where it raises or is not finite."""
        found = _along(self.function, (self.size,), s, u)
        return np.where(np.isfinite(found), found, np.inf)

    def derivatives(self, s: Array, u: Array) -> Array:
        """The derivative along points s (K, d), (K, size, d); NaN where it raises."""
        return _along(self.jacobian, (self.size, self._d), s, u)

    def curvature(self, s: Array, u: Array, forces: Array) -> Array:
        """The convex part of the second derivative of ``forces g`` (K, d, d) along points s."""
        pushed, d = forces.any(axis=1), self._d
        curvature = np.zeros((len(s), d, d))
        if not pushed.any():
            return curvature
        moves = np.diag(_MOVE * self._deviations)
        points = s[pushed][:, None] + np.concatenate((moves, -moves))
        inputs = np.repeat(u[pushed], 2 * d, axis=0)
        slopes = self.derivatives(points.reshape(-1, d), inputs).reshape(-1, 2, d, self.size, d)
        change = np.einsum("kj,kejd->ked", forces[pushed], slopes[:, 0] - slopes[:, 1])
        # In units of the deviations, so that what is convex does not depend on units.
        change *= self._deviations / (2.0 * _MOVE)
        change = 0.5 * (change + change.transpose(0, 2, 1))
        change[~np.isfinite(change).all(axis=(1, 2))] = 0.0
        values, vectors = np.linalg.eigh(change)
        convex = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.transpose(0, 2, 1)
        curvature[pushed] = convex / np.outer(self._deviations, self._deviations)
        return curvature

    def failure(self, s: Array, u: Array) -> str:
        """What g raised at the first point at which it has no finite value."""
        for one, known in zip(s, u, strict=True):
            try:
                found = np.asarray(self.function(one, known), np.float64)
            except Exception as error:
                return raised(self.function.name, error, one)
            if not np.isfinite(found).all():
                return f"{self.function.name} is {found.tolist()} at {one.tolist()}."
        return ""

    def probed(self, k: int) -> Array:
        """Values (size,) at a fixed point; infinity where it raises or is not finite."""
        s, u = points(FEW, self._d, self._inputs)[k]
        with np.errstate(all="ignore"):
            values: Array = self.values(s[None], u[None])[0]
        return values

    def touched(self, p: int) -> Mask:
        """Which rows depend on each component of v (size, p); all where that is not known."""
        if "v" not in self.parts:
            return np.zeros((self.size, p), np.bool_)
        found = self.trace or self._traced(points(USUAL, self._d, self._inputs, self._box))
        if found.function is None:
            return np.ones((self.size, p), np.bool_)
        touched: Mask = depends(found)[:, self.parts["v"]]
        return touched


def _along(
    function: BatchedFunction | Jacobian, shape: tuple[int, ...], s: Array, u: Array
) -> Array:
    """Values along points; NaN where the function raises."""
    with suppress(Exception):  # outside of its domain at some point
        found = np.array(function.batch(s, u), np.float64)
        if found.shape == (len(s), *shape):
            return found
    found = np.full((len(s), *shape), np.nan)
    for k in range(len(s)):
        with suppress(Exception):
            found[k] = np.asarray(function(s[k], u[k]), np.float64).reshape(shape)
    return found


def checked_constraints(value: Any) -> tuple[Constraint, ...]:
    """The nonlinear constraints that a system was given."""
    if value is None:
        return ()
    if isinstance(value, Constraint):
        return (value,)
    listed = value if isinstance(value, (list, tuple)) else [value]
    for one in listed:
        if not isinstance(one, Constraint):
            raise SetError(
                f"constraints holds {shown(one)}; expected a list of qpmhe.Constraint, such as "
                "[qpmhe.Constraint(lambda x: x[0] - 1.0)]."
            )
    return tuple(listed)
