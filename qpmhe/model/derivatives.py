"""Jacobians of model functions: given, or by finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import copy
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .functions import NO_INPUT, BatchedFunction, Trusted, missing_input
from .points import Points
from .residuals import Residual
from .sets import ConvexSet

Array = NDArray[Any]

_DIFFERENCE_STEP = float(np.finfo(np.float64).eps) ** (1 / 3)
# Accuracy of differences: of each entry, of an entry beside the largest of its row, and of one
# beside the function's value, where it is rounding.
_ENTRY, _ROW, _VALUE = 1e-5, 1e-7, 5e-10
# A Jacobian is wrong where it is further off than differences with these many times the error.
_SLACK = 10.0
# Steps that must agree, not in phase with what oscillates, as shares of the first.
_PARTS = (1.0, 0.62, 0.23)
# An angle must turn by less than half its period within so many steps.
_FAR = 8.0
# How far inside a bound a Jacobian is taken that is not finite at it, as a share of the state's
# magnitude, and at most of the width.
_INWARD, _MOST_INWARD = 2.0**-10, 0.25
# How far beside a point where it is still not finite: shares of the magnitudes, of changing sign
# and size, since functions without a derivative at 0 have none along axes and diagonals, either.
_ASIDE, _GOLDEN = 2.0**-24, 0.6180339887498949
# Values of one state and of many at once may differ by the rounding of so many operations.
_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
# How often, and by how much, a step is shortened at most where differences curve within it.
_SHORTER = [2.0 ** (-4 * k) for k in range(11)]


def _agree(one: Array, other: Array) -> bool:
    """Whether two arrays of values are equal up to the rounding of a few operations."""
    same = np.abs(one - other) <= _ROUNDING * np.abs(other)
    same |= (one == other) | (np.isnan(one) & np.isnan(other))
    return bool(same.all())


def _finite_rows(array: Array) -> NDArray[np.bool_]:
    """Which rows (..., d, 1) have finite squares."""
    with np.errstate(over="ignore"):
        finite: NDArray[np.bool_] = np.isfinite(np.square(array).sum(axis=-1, keepdims=True))
    return finite


class Nearby:
    """Whether rows of a Jacobian were taken nearby since ``used`` was last set to False."""

    __slots__ = ("used",)

    def __init__(self) -> None:
        self.used = False


class Jacobian:
    """The Jacobian with respect to x of a `BatchedFunction` with vector values.

    Steps are fractions of the states' magnitudes, which are 1 until `use_scales` sets them; a given
    Jacobian is compared with differences only from then on. Rows that are not finite on a bound of
    X (a square root's at 0, for example) are taken a small step inside, and rows that are not
    finite there either (a range's at its beacon) a tiny step beside the point: one sensor without a
    derivative does not stop the others. A row is finite here if its square is.

    Attributes
    ----------
    method : str
        ``given``, or another word of who gives it, or ``finite differences``.
    inner : (2, n) array
        Bounds a small step inside those of X, infinite where X has none.
    aside : (n,) array
        The step beside a point without derivative.
    nearby : Nearby
        Whether rows were taken inside the bounds or beside the point: one for all that evaluate
        this Jacobian for one estimator.
    remedy : str
        Remedy for a wrong given Jacobian.
    """

    remedy = "Correct it, or leave it out to compute it automatically."

    def __init__(
        self,
        function: BatchedFunction,
        given: Callable[..., Any] | Trusted | None,
        inputs: int,
        probes: Points,
        states: ConvexSet | None = None,
        residual: Residual | None = None,
        method: str = "given",
        remedy: str = "",
    ) -> None:
        self.function, self._inputs, self._residual = function, inputs, residual
        n = probes[0][0].size
        self._n = n
        self._bounds = None if states is None else (states.lower, states.upper)
        self.inner: Array = np.array((np.full(n, -np.inf), np.full(n, np.inf)))
        self.aside: Array = np.zeros(n)
        self._outputs: Array = np.zeros(function.shape)
        self._scales: Array | None = None
        self.nearby = Nearby()
        self._set_scales(np.ones(n))
        self.method = "finite differences"
        # Whether differences call the function once for many states: see `_finds_at_once`.
        self._at_once = False
        self.batch: Callable[[Array, Array], Array] = self._differences
        self._given: BatchedFunction | None = None
        if given is not None:
            name = f"{function.name}_jacobian"
            self._given = BatchedFunction(name, given, (*function.shape, n), inputs, probes)
            self.method, self.batch = method, self._given_batch
            self.remedy = remedy or self.remedy

    def __call__(self, x: Array, u: Array = NO_INPUT) -> Array:
        """The Jacobian (d, n) at one state and input, which may be left out if m is 0."""
        if u is NO_INPUT and self._inputs:
            raise missing_input(f"{self.function.name}_jacobian", self._inputs)
        if self._given is not None:
            try:
                found: Array = self._given(x, u)
                # Of a trace, it is no number. No covariance is finite where a square is not.
                if found.dtype != np.float64 or math.isfinite(np.vdot(found, found)):
                    return found
            except Exception:
                found = np.full((*self.function.shape, x.size), np.nan)
            return self._beside(self._given, found, x, u)
        value: Array = self.batch(x[None], u[None])[0]
        return value

    @cached_property
    def _eye(self) -> Array:
        return np.eye(self._n)

    @property
    def direct(self) -> Callable[..., Any]:
        """A function of one state, and of the input where there are any."""
        return self if self._inputs else partial(self, u=NO_INPUT)

    def use_scales(
        self, scales: Array, outputs: Array | None, probes: Iterable[tuple[Array, Array]]
    ) -> None:
        """Take these magnitudes of states, and values if known; compare a given Jacobian anew.

        The probes must be of these magnitudes.
        """
        self._scales = scales
        if outputs is not None:
            self._outputs = outputs
        self._set_scales(scales)
        self._compare(probes)

    def _set_scales(self, scales: Array) -> None:
        # Powers of two: what a step divides by then costs no rounding, and depends on no other
        # digits of the scales.
        self._sizes = np.ldexp(1.0, np.frexp(scales)[1] - 1)
        self.aside = _ASIDE * self._sizes * (-_GOLDEN) ** np.arange(self._n)
        if self._bounds is not None and np.isfinite(self._bounds).any():
            lower, upper = self._bounds
            step = np.minimum(_INWARD * self._sizes, _MOST_INWARD * (upper - lower))
            self.inner = np.array((lower + step, upper - step))

    def _given_batch(self, x: Array, u: Array) -> Array:
        """A given Jacobian over a batch; see `_beside`."""
        assert self._given is not None
        try:
            found: Array = self._given.batch(x, u)
            if found.dtype != np.float64 or math.isfinite(np.vdot(found, found)):
                return found
        except Exception:
            found = np.full((*x.shape[:-1], *self.function.shape, x.shape[-1]), np.nan)
        return self._beside(self._given.batch, found, x, u)

    def _beside(
        self, given: Callable[[Array, Array], Any], found: Array, x: Array, u: Array
    ) -> Array:
        """Rows that are missing, from inside the bounds or, where it has none, from beside x."""
        places = [np.clip(x, *self.inner), np.clip(x + self.aside, *self.inner)]
        for place in places if np.isfinite(self.inner).any() else places[1:]:
            finite = _finite_rows(found)
            if finite.all():
                break
            with suppress(Exception):  # it raises there, too: what is missing stays so
                other = given(place, u)
                found = np.where(finite | ~_finite_rows(other), found, other)
                filled = _finite_rows(found).all(axis=-2) & ~finite.all(axis=-2)
                self.nearby.used |= bool(filled.any())
        if np.isnan(found).all():  # with the error of the place itself
            return np.asarray(given(x, u), np.float64)
        return found

    def _differences(self, x: Array, u: Array) -> Array:
        step = _DIFFERENCE_STEP * np.maximum(self._sizes, np.abs(x))
        return self._quotients(x, u, step, slice(None))

    def _quotients(self, x: Array, u: Array, step: Array, columns: slice) -> Array:
        """Columns of the Jacobian by central differences, or inward ones at a bound."""
        side, length = self._side(x, step), step[..., columns, None]
        moves, at = length * self._eye[columns], x[..., None, :]
        u_all = np.broadcast_to(u[..., None, :], (*moves.shape[:-1], u.shape[-1]))
        # Copies: a function may return one and the same array every time.
        if side is None:
            both = np.stack((at + moves, at - moves))
            ahead, behind = self._values(both, np.broadcast_to(u_all, (2, *u_all.shape)))
            behind = self._aligned(behind, ahead)
            return np.swapaxes((ahead - behind) / (2 * length), -1, -2)
        side = side[..., columns, None]
        central = side == 0.0
        value = np.array(self.function.batch(x, u))[..., None, :]
        near, far = self._values(
            np.stack((
                at + np.where(central, 1.0, side) * moves,
                at + np.where(central, -1.0, 2.0 * side) * moves,
            )), np.broadcast_to(u_all, (2, *u_all.shape)),
        )
        near, far = self._aligned(near, value), self._aligned(far, value)
        rise = np.where(central, near - far, side * (4.0 * near - far - 3.0 * value))
        return np.swapaxes(rise / (2 * length), -1, -2)

    def _values(self, x: Array, u: Array) -> Array:
        """The function at the states (..., n) of a difference, by one call where that may be.

        The first value is compared with that of a call of its own. Only derivatives come from
        here: J and all of its parts are evaluated state by state.
        """
        function = self.function
        if self._at_once:
            states, inputs = x.reshape(-1, x.shape[-1]), u.reshape(math.prod(x.shape[:-1]), -1)
            with suppress(Exception):  # a function of one state may do anything on many
                found = function.at_once(states, inputs)
                if _agree(found[:1], function.batch(states[:1], inputs[:1])):
                    return found.reshape(*x.shape[:-1], *function.shape)
            self._at_once = False
        return np.array(function.batch(x, u))

    def _finds_at_once(self, x: Array, u: Array) -> bool:
        """Whether the function takes many states at once, as functions of ``x[..., i]`` do.

        It must give the same, up to rounding, as one by one: at the states of a difference and at
        others as far away as the states are large, in two batches of different lengths.
        """
        if self.function.mode != "looped":
            return False
        far = x + self._sizes * np.array((-1.0, 1.0, -0.5))[:, None]
        step = _DIFFERENCE_STEP * np.maximum(self._sizes, np.abs(x))
        states = np.concatenate((x[None], far, x + step * self._eye))
        if self._bounds is not None:
            states = np.clip(states, *self._bounds)
        inputs = np.broadcast_to(u, (len(states), u.size))
        try:
            with np.errstate(all="ignore"):
                whole = self.function.at_once(states, inputs)
                some = self.function.at_once(states[1::2], inputs[1::2])
                # Last: most functions of one state have raised, or returned another shape.
                alone = self.function.batch(states, inputs)
                return _agree(whole, alone) and _agree(some, alone[1::2])
        except Exception:  # at one of these states, or of a function of one state
            return False

    def _aligned(self, values: Array, references: Array) -> Array:
        """Values on the turn of others nearby, where an angle may jump between them."""
        values = np.asarray(values)
        if self._residual is None:
            return values
        return self._residual.aligned(values, np.broadcast_to(references, values.shape))

    def _side(self, x: Array, step: Array) -> Array | None:
        """1 or -1 where a central difference would leave the bounds and this side has room."""
        if self._bounds is None:
            return None
        lower, upper = self._bounds
        below, above = x - step < lower, x + step > upper
        if not (below.any() or above.any()):
            return None
        side: Array = np.where(below & (x + 2.0 * step <= upper), 1.0, 0.0)
        side -= above & (x - 2.0 * step >= lower)
        return side

    def _measured(self, x: Array, u: Array) -> tuple[Array, Array, Array] | None:
        """Value (d,), differences (d, n) and sizes (n,) of the states at one state.

        A step that the function curves within is shortened, down to the state's own size. A
        column whose differences do not settle is NaN, its size the usual one. None where the
        function cannot be evaluated.
        """
        try:
            with np.errstate(all="ignore"):
                value = np.array(self.function(x, u), np.float64)
        except Exception:  # outside the function's domain
            return None
        if not np.isfinite(value).all():
            return None
        slope, sizes = np.full((*value.shape, x.size), np.nan), self._sizes.copy()
        pending = list(range(x.size))
        for share in _SHORTER:
            trial = share * self._sizes
            found = self._settled(x, u, value, np.maximum(trial, np.abs(x)), pending)
            for j, column in found.items():
                slope[:, j], sizes[j] = column, trial[j]
            pending = [j for j in pending if j not in found and trial[j] > abs(x[j])]
            if not pending:
                break
        return value, slope, sizes

    def _settled(
        self, x: Array, u: Array, value: Array, size: Array, columns: list[int]
    ) -> dict[int, Array]:
        """The columns that steps of this size and shorter ones agree on."""
        step = _DIFFERENCE_STEP * size
        found: dict[int, Array] = {}
        for j in columns:
            try:
                with np.errstate(all="ignore"):
                    found[j] = size[j] * np.array([
                        self._quotients(x[None], u[None], part * step[None], slice(j, j + 1))[0]
                        for part in _PARTS
                    ])[:, :, 0]
            except Exception:  # outside the function's domain
                continue
        if not found:
            return {}
        row = np.max([np.abs(slopes[-1]) for slopes in found.values()], axis=0)
        floor = _ROW * row + _VALUE * np.maximum(np.abs(value), self._outputs)
        return {
            j: slopes[0] / size[j] for j, slopes in found.items()
            if np.all(np.ptp(slopes, axis=0) <= _ENTRY * np.abs(slopes[-1]) + floor)
            and not self._turns_far(value, np.abs(slopes).max(axis=0) + floor)
        }

    def _turns_far(self, value: Array, scaled_slope: Array) -> bool:
        """Whether an angle may turn so far within a step that its differences say nothing."""
        if self._residual is None:
            return False
        reached = value + _FAR * _DIFFERENCE_STEP * scaled_slope
        return bool((self._residual.aligned(reached, value) != reached).any())

    def check(self, x: Array, u: Array) -> None:
        """Compare a given Jacobian at a state that will be used; find the steps of others there."""
        if self._given is not None:
            if self._scales is not None and self.method != "traced":
                self._compare([(x, u)])
            return
        self._at_once = self._finds_at_once(x, u)
        if self._scales is not None:
            self._set_scales(self._scales)
            measured = self._measured(x, u)
            if measured is not None:
                self._set_scales(measured[2])

    def evaluated_by(self, function: BatchedFunction, slope: Trusted, method: str) -> Jacobian:
        """The same Jacobian, of the same function, evaluated by other means."""
        other = copy(self)
        other.function, other.method = function, method
        size = self._n
        other._given = BatchedFunction(
            f"{function.name}_jacobian", slope, (*function.shape, size), self._inputs, []
        )
        other._given.mode = "batched"
        other.batch = other._given_batch
        return other

    def copy(self, function: BatchedFunction) -> Jacobian:
        """The same Jacobian, of a copy of its function; its method can change independently."""
        other = copy(self)
        other.function, other.nearby = function, Nearby()
        other.batch = other._differences
        if self._given is not None:
            other._given = self._given.copy()
            other.batch = other._given_batch
        return other

    def try_batched(self, x: Array, u: Array) -> None:
        """As `BatchedFunction.try_batched`."""
        (self.function if self._given is None else self._given).try_batched(x, u)

    def follow(self, other: Jacobian) -> None:
        """Note what is taken nearby where another one does."""
        self.nearby = other.nearby

    def _compare(self, probes: Iterable[tuple[Array, Array]]) -> None:
        """Raise where a given Jacobian is not the derivative."""
        given = self._given
        # Differences of values that are as accurate as an integrator's tolerances are no reference,
        # and what is made of differences itself is not the user's.
        if given is None or self.method in ("integrator", "finite differences"):
            return
        for x, u in probes:
            measured = self._measured(x, u)
            if measured is None:
                continue
            try:
                with np.errstate(all="ignore"):
                    found = np.asarray(given(x, u), dtype=np.float64)
            except Exception:  # outside its domain
                continue
            wrong = self._wrong(found, x, *measured)
            if wrong.any():  # at a kink, any slope between those of the two sides will do
                wrong &= ~self._between(found, x, u, *measured)
            if np.isfinite(found).all() and wrong.any():
                i, j = np.argwhere(wrong)[0]
                raise ModelError(
                    f"{given.name}[{i}, {j}] is {found[i, j]:.6g} at x = {x.tolist()}, but the "
                    f"derivative of the function there is {measured[1][i, j]:.6g}. {self.remedy}"
                )

    def _errors(self, slope: Array, x: Array, value: Array, sizes: Array) -> tuple[Array, Array]:
        """Accuracy of differences (d, n), times the states' sizes, and these (n,)."""
        size = np.maximum(sizes, np.abs(x))
        scaled = np.abs(np.nan_to_num(slope)) * size
        magnitude = np.maximum(np.abs(value), self._outputs)[:, None]
        row = scaled.max(axis=1, keepdims=True)
        return _SLACK * (_ENTRY * scaled + _ROW * row + _VALUE * magnitude), size

    def _wrong(self, found: Array, x: Array, value: Array, slope: Array, sizes: Array) -> Array:
        """Which entries (d, n) are not those of the differences."""
        allowed, size = self._errors(slope, x, value, sizes)
        wrong: Array = np.abs(found - slope) * size > allowed
        return wrong  # False where the differences are NaN

    def _between(
        self, found: Array, x: Array, u: Array, value: Array, slope: Array, sizes: Array
    ) -> Array:
        """Which entries lie between the forward and the backward difference."""
        allowed, size = self._errors(slope, x, value, sizes)
        sides = []
        for sign in (1.0, -1.0):
            side = np.full(slope.shape, np.nan)
            for j, step in enumerate(sign * _DIFFERENCE_STEP * size):
                try:
                    with np.errstate(all="ignore"):
                        ahead = self._aligned(self.function(x + step * self._eye[j], u), value)
                        side[:, j] = (ahead - value) / step
                except Exception:  # outside the function's domain
                    continue
            sides.append(side)
        slack = np.maximum(allowed, _SLACK * _ENTRY * np.abs(found) * size) / size
        between: Array = (np.fmin(*sides) - slack <= found) & (found <= np.fmax(*sides) + slack)
        return between
