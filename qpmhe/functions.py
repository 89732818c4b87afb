"""A user's function of state and input, made callable on one state and on many at once."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ModelError
from .tracing import mixes_states

__all__ = ["BatchedFunction", "positional_arguments"]

Array = NDArray[Any]
Probes = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


class BatchedFunction:
    """g(x) or g(x, u), evaluated over leading dimensions whatever way it was written.

    Three ways of writing are told apart by trying them on a few points: functions that
    take (..., n) as NumPy's own do (``batched``); functions of one state that happen to
    work on columns, as ``np.array([x[1], -x[0]])`` does on an (n, B) array (``columns``);
    and everything else, which is called state by state (``looped``).

    Parameters
    ----------
    name : str
        What error texts call it.
    function : callable
        The user's function.
    shape : tuple of int
        Shape of its value at one state, such as (n,) or (p, n).
    inputs : int
        Length m of u; with 0, the function is called as g(x).
    probes : list of (x, u)
        Points to try; points where the function raises or is not finite are passed over.

    Attributes
    ----------
    mode : str
        ``batched``, ``columns``, ``looped``, or ``unknown`` where no probe could be used.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        shape: tuple[int, ...],
        inputs: int,
        probes: Probes,
    ) -> None:
        if not callable(function):
            raise ModelError(f"{name} is {function!r}; expected a function of the state.")
        self.name, self.shape = name, shape
        self._function, self._inputs = function, inputs
        self._takes_input = inputs > 0 and positional_arguments(name, function) != 1
        if inputs == 0 and _required_arguments(function) > 1:
            raise ModelError(
                f"{name} needs more than one argument, but the system has no inputs; "
                "pass m, the number of inputs, or make it a function of x alone."
            )
        # A scalar at one state is a value of shape (1,): p = 1 is written without brackets.
        self._short = False
        #: Whether it works on arrays that it cannot write to, as compiled code may not.
        self.reads_only = True
        self._returns_array = True
        self.mode = "unknown"
        self._detect(probes)

    def __call__(self, x: Array, u: Array) -> Array:
        """The value at one state x (n,) and input u (m,)."""
        value = self._function(x, u) if self._takes_input else self._function(x)
        return np.asarray(value).reshape(self.shape) if self._short else value

    def batch(self, x: Array, u: Array) -> Array:
        """The values at states x (..., n) and inputs u (..., m): shape (..., *shape)."""
        if x.ndim == 2 and self.mode == "batched" and not self._short:
            return np.asarray(self._function(x, u) if self._takes_input else self._function(x))
        lead = x.shape[:-1]
        if len(lead) != 1:
            # Functions that pass for batched on (B, n) may still mix axes up beyond.
            count = math.prod(lead)
            x, u = x.reshape(count, x.shape[-1]), u.reshape(count, u.shape[-1])
        if self.mode == "batched":
            value = self._function(x, u) if self._takes_input else self._function(x)
            value = np.asarray(value)
        elif self.mode == "columns":
            value = self._function(x.T, u.T) if self._takes_input else self._function(x.T)
            value = np.moveaxis(np.asarray(value), -1, 0)
        else:
            # Copied row by row: a function may return one and the same array every time.
            value = np.empty((x.shape[0], *self.shape), dtype=np.result_type(x, np.float64))
            for i in range(x.shape[0]):
                value[i] = self(x[i], u[i])
        shaped: Array = value.reshape(lead + self.shape)
        return shaped

    def _detect(self, probes: Probes) -> None:
        points, values = [], []
        for x, u in probes:
            value = self._probe(x, u)
            if value is not None:
                points.append((x, u))
                values.append(value)
        if not points:
            return
        # All points, and more than any dimension of the value, so that axes cannot be mixed up.
        size = max(len(points), 3, *(d + 1 for d in (*self.shape, points[0][0].size, self._inputs)))
        x = np.array([points[i % len(points)][0] for i in range(size)])
        u = np.array([points[i % len(points)][1] for i in range(size)])
        expected = np.array([values[i % len(points)] for i in range(size)])
        for mode in ("batched", "columns"):
            self.mode = mode
            try:
                with np.errstate(all="ignore"):
                    raw = self.batch(x, u)
                    found = np.asarray(raw, dtype=np.float64)
            except Exception:  # a function of one state may do anything on many
                continue
            same = found.shape == expected.shape and np.allclose(found, expected, rtol=1e-9)
            if same and not self._mixes(mode, x, u):
                return
        self.mode = "looped"

    def _mixes(self, mode: str, x: Array, u: Array) -> bool:
        """Whether the function, called in this mode, decides for a batch by some of it."""
        # No other dimension must have the batch's length.
        count = 7 + max(*self.shape, x.shape[1], u.shape[1])
        x, u = (np.resize(values, (count, values.shape[1])) for values in (x, u))
        arguments: tuple[Array, ...] = (x, u) if self._takes_input else (x,)
        if mode == "columns":
            arguments = tuple(values.T for values in arguments)
        with np.errstate(all="ignore"):
            return mixes_states(self._function, *arguments, batch=count)

    def _probe(self, x: Array, u: Array) -> Array | None:
        """The checked value at a probe; None where the function cannot be used there."""
        x_given, u_given = x.copy(), u.copy()
        try:
            raw = self._tried(x_given, u_given)
            value = np.array(raw, dtype=np.float64)  # a copy: it may be one buffer
        except Exception:  # outside its domain; the estimator checks at the initial state
            return None
        if isinstance(raw, np.ndarray) and raw.dtype == np.object_:
            self._function = _with_numbers(self._function)
        if not (np.array_equal(x_given, x) and np.array_equal(u_given, u)):
            raise ModelError(
                f"{self.name} changes its argument in place; copy x before writing to it."
            )
        short = self.shape[1:] if self.shape[0] == 1 else None
        if value.shape != self.shape and value.shape != short:
            raise ModelError(
                f"{self.name} returned shape {value.shape} at x = {x.tolist()}; "
                f"expected {self.shape}. Check n, p, m and the order of the arguments."
            )
        self._short = value.shape != self.shape
        self._returns_array = self._returns_array and isinstance(raw, np.ndarray)
        return value.reshape(self.shape) if np.isfinite(value).all() else None

    def _tried(self, x: Array, u: Array) -> Any:
        """The raw value, of arguments that it cannot change if it can do with such."""
        arguments = (x, u) if self._takes_input else (x,)
        with np.errstate(all="ignore"):
            if self.reads_only:
                for one in arguments:
                    one.flags.writeable = False
                try:
                    return self._function(*arguments)
                except (ValueError, TypeError):  # what writing, or wanting to, comes to
                    pass
                finally:
                    for one in arguments:
                        one.flags.writeable = True
            value = self._function(*arguments)
            self.reads_only = False
            return value

    def agrees(self, x: Array, u: Array, expected: Array, tolerance: float) -> bool:
        """Whether a batch gives what single states gave; if not, states are looped over.

        A function with a branch on its state (``if x[0] > 1``) can pass for one of many
        states until states on both sides of the branch meet in one batch.

        Parameters
        ----------
        x, u : (B, n) and (B, m) array
            States and inputs.
        expected : (B, ...) array
            Values at these, computed one by one.
        tolerance : float
            How far rounding may lead, absolute.
        """
        if self.mode == "looped":
            return True
        try:
            close = np.abs(self.batch(x, u) - expected) <= tolerance
            if close.all():
                return True
        except Exception:  # a function of one state may do anything on many
            pass
        self.mode = "looped"
        return False

    @property
    def direct(self) -> Callable[..., Any]:
        """A function of one state, and of the input where there are any: the user's if it may."""
        if not self._short and self._takes_input == (self._inputs > 0):
            return self._function
        return self if self._inputs else partial(self, u=np.zeros(0))

    @property
    def plain(self) -> bool:
        """Whether the user's function can be called as it is, on (..., n) and all inputs."""
        takes_all = self._takes_input or self._inputs == 0
        return self.mode == "batched" and takes_all and self._returns_array and not self._short

    def check(self, x: Array, u: Array) -> None:
        """Insist on a finite value of the right shape at a state that is to be used."""
        if self.mode == "unknown":
            self._detect([(x, u), (x * (1 + 1e-6) + 1e-9, u + 1e-3)])
        try:
            with np.errstate(all="ignore"):
                value = np.asarray(self(x, u), dtype=np.float64)
        except Exception as error:
            raise ModelError(
                f"{self.name} raised {type(error).__name__}: {error} at the initial state "
                f"{x.tolist()}; it must be defined where the estimation starts."
            ) from error
        if value.shape != self.shape:
            raise ModelError(
                f"{self.name} returned shape {value.shape} at the initial state; "
                f"expected {self.shape}."
            )
        if not np.isfinite(value).all():
            raise ModelError(
                f"{self.name} is {value.tolist()} at the initial state {x.tolist()}; "
                "expected finite numbers. Start elsewhere or bound the states."
            )


def _with_numbers(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose values are arrays of numbers, of one whose arrays hold objects."""

    def evaluate(*arguments: Array) -> Array:
        return np.array(np.asarray(function(*arguments)).tolist())

    return evaluate


def positional_arguments(name: str, function: Callable[..., Any]) -> int | None:
    """How many positional arguments function can take; None if it cannot be told."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    if any(q.kind is q.VAR_POSITIONAL for q in parameters):
        return None
    taken = sum(q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD) for q in parameters)
    if taken == 0:
        raise ModelError(f"{name} takes no argument; expected {name}(x) or {name}(x, u).")
    # f(x, scale=2.0) is a function of x: only a second argument without default is an input.
    second = [q for q in parameters if q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD)][1:2]
    if second and second[0].default is not inspect.Parameter.empty and second[0].name != "u":
        return 1
    return taken


def _required_arguments(function: Callable[..., Any]) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 0
    return sum(
        q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD)
        and q.default is inspect.Parameter.empty
        for q in parameters
    )
