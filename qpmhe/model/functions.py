"""A user's function of state and input, made callable on one state and on many at once."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from copy import copy
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import shown

from ..errors import InvalidInputError, ModelError, QpmheError
from .tracing import trace, unmasked

Array = NDArray[Any]
Probes = list[tuple[NDArray[np.float64], NDArray[np.float64]]]

#: The input of a system without inputs.
NO_INPUT = np.zeros(0)
# Relative change of a number in its last six bits.
_LAST_DIGITS = 2.0**-46


class EvaluationError(QpmheError):
    """A model function ended the program, or returned no value, at some state.

    It never escapes from an estimator: the step falls back.
    """


class Trusted(NamedTuple):
    """A function of this package that takes (..., n) as well as (n,) and modifies no argument."""

    function: Callable[..., Any]


class Parametric(NamedTuple):
    """A user's f(x, u, theta), or f(x, theta), as one of x and (u, theta)."""

    function: Callable[..., Any]
    inputs: int
    takes_input: bool

    def by_rows(self, x: Array, known: Array) -> Any:
        """The value where the last axis counts components."""
        return self._called(x, known[..., : self.inputs], known[..., self.inputs :])

    def by_columns(self, x: Array, known: Array) -> Any:
        """The value where the first axis does."""
        return self._called(x, known[: self.inputs], known[self.inputs :])

    def _called(self, x: Array, u: Array, theta: Array) -> Any:
        return self.function(x, u, theta) if self.takes_input else self.function(x, theta)


def contained(function: Callable[..., Any]) -> Callable[..., Any]:
    """Contain foreign code: it can only raise an Exception or be interrupted."""

    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except (Exception, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise EvaluationError(f"{type(error).__name__}: {error}") from error

    return call


def raised(what: str, error: Exception, x: Array) -> str:
    """An exception of the model, the observer or the cost at a state, as a message."""
    kind = type(error).__name__
    try:
        text = f"{kind}: {error}" if str(error) else kind
        if isinstance(error, EvaluationError):
            if error.__cause__ is None:  # a wrong value: the text says whose
                return f"{error} at x = {x.tolist()}."
            text = str(error)
    except Exception:  # its text raises, too
        text = kind
    return f"{what} raised {text} at x = {x.tolist()}."


def raised_along(
    error: Exception, functions: Mapping[str, Callable[..., Any]], states: Array, inputs: Array
) -> str:
    """An exception of functions on a trajectory: evaluates them again to find out where."""
    for x, u in zip(states, inputs, strict=False):
        for what, function in functions.items():
            try:
                function(x, u)
            except Exception as found:
                return raised(what, found, x)
    return raised("the model or the cost", error, states[0])


class BatchedFunction:
    """g(x) or g(x, u), evaluated over leading dimensions however it was written.

    A function is called state by state (``looped``), with a copy of each argument, unless a
    trace proves that it needs neither: called on symbols, it returns without asking for a
    value, writes into no argument, and computes each state's value from this state alone.
    Then it is called once for many states, as NumPy's own functions are (``batched``), or
    with the states as columns (``columns``), which suits ``np.array([x[1], -x[0]])``.

    Attributes
    ----------
    mode : str
        ``batched``, ``columns``, ``looped``, or ``unknown`` where no probe could be used.
    takes_input : bool
        Whether it is a function of u as well.
    reads_only : bool
        Whether a trace proved that it writes into no argument and returns one kind of value.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any] | Trusted | Parametric,
        shape: tuple[int, ...],
        inputs: int,
        probes: Probes,
    ) -> None:
        self._trusted = isinstance(function, Trusted)
        by_columns = None
        if isinstance(function, Trusted):
            function = function.function
        elif isinstance(function, Parametric):
            by_columns, function = contained(function.by_columns), function.by_rows
        if not callable(function):
            raise ModelError(f"{name} is {shown(function)}; expected a function of the state.")
        self.name, self.shape = name, shape
        self._inputs = inputs
        self.takes_input = takes_input(name, function, inputs)
        #: What is called: the user's function, contained.
        self.function = contained(function)
        self._by_columns = by_columns or self.function
        # A scalar at one state is a value of shape (1,): p = 1 is written without brackets.
        self._short = False
        self.reads_only = self._trusted
        self._returns_array = True
        self._is_odd = False  # returns objects, or masks
        self.mode = "unknown"
        self._detect(probes)

    def __call__(self, x: Array, u: Array = NO_INPUT) -> Array:
        """The value at one state x (n,) and input u (m,), which may be left out if m is 0."""
        if u is NO_INPUT and self._inputs:
            raise missing_input(self.name, self._inputs)
        if self.reads_only:
            value = self.function(x, u) if self.takes_input else self.function(x)
            return np.asarray(value).reshape(self.shape) if self._short else value
        raw = self.function(x.copy(), u.copy()) if self.takes_input else self.function(x.copy())
        if x.dtype == np.object_:  # symbols of a trace come back as such
            return np.asarray(raw, np.object_).reshape(self.shape)
        return self._as_value(raw)

    def _as_value(self, raw: Any) -> Array:
        """The checked value of a function that was not traced."""
        value = np.asarray(unmasked(raw))
        if value.dtype == np.object_:
            value = np.array(value.tolist())
        if value.dtype.kind not in "fciub":
            raise EvaluationError(f"{self.name} returned {value.dtype}; expected numbers")
        if value.shape != self.shape:
            if not (self._short and value.shape == self.shape[1:]):
                raise EvaluationError(
                    f"{self.name} returned shape {value.shape}; expected {self.shape}"
                )
            value = value.reshape(self.shape)
        return value

    def batch(self, x: Array, u: Array) -> Array:
        """The values at states x (..., n) and inputs u (..., m): shape (..., *shape)."""
        lead = x.shape[:-1]
        if len(lead) != 1:
            # Functions that pass for batched on (B, n) may still mix axes up beyond.
            count = math.prod(lead)
            x, u = x.reshape(count, x.shape[-1]), u.reshape(count, u.shape[-1])
        if self.mode == "batched":
            value = np.asarray(self.function(x, u) if self.takes_input else self.function(x))
            if len(lead) == 1 and not self._short:
                return value
        elif self.mode == "columns":
            value = self._by_columns(x.T, u.T) if self.takes_input else self._by_columns(x.T)
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
        states, inputs = points[0][0].size, self._inputs
        self.reads_only = self._trusted or (
            not self._is_odd and self._same_everywhere(states)
        )
        # All points, and more than any dimension of the value, so that axes cannot be mixed up.
        size = max(len(points), 3, *(d + 1 for d in (*self.shape, states, inputs)))
        x = np.array([points[i % len(points)][0] for i in range(size)])
        u = np.array([points[i % len(points)][1] for i in range(size)])
        expected = np.array([values[i % len(points)] for i in range(size)])
        for mode in ("batched", "columns") if self.reads_only else ():
            self.mode = mode
            try:
                with np.errstate(all="ignore"):
                    found = np.asarray(self.batch(x.copy(), u.copy()), dtype=np.float64)
            except Exception:  # a function of one state may do anything on many
                continue
            if found.shape != expected.shape:
                continue
            # A function of this package is believed.
            if self._trusted or (
                self._equal_but_for_rounding(found, expected, x, u)
                and self._keeps_apart(mode, states)
            ):
                return
        self.mode = "looped"

    def _equal_but_for_rounding(self, found: Array, expected: Array, x: Array, u: Array) -> bool:
        """Whether values at states x (K, n) agree, each beside its component's largest one.

        In odd units a probe may be so large that the rounding of a sum of states shows in a sine
        of it: also allowed is what a change of the states in the last digits makes.
        """
        room, off = 1e-9 * np.abs(expected).max(axis=0), np.abs(found - expected)
        if (off <= room).all():
            return True
        signs = (-1.0) ** np.arange(x.shape[1])
        try:
            with np.errstate(all="ignore"):
                for change in (_LAST_DIGITS, _LAST_DIGITS * signs):
                    pairs = zip(x * (1.0 + change), u, strict=True)
                    moved = np.array([self(*pair) for pair in pairs])
                    room = np.maximum(room, np.abs(moved - expected))
        except Exception:  # outside its domain
            return False
        return bool((off <= room).all())

    def try_again(self, probes: Probes) -> None:
        """Find out how it may be called, if probes of other magnitudes have not shown it."""
        if self.mode == "unknown" or (self.mode == "looped" and self.reads_only):
            self._detect(probes)

    def try_batched(self, x: Array, u: Array) -> None:
        """Call it once for many states from now on, if that gives the same at these (K, n).

        Evidence, but no proof: for what may be wrong without harm.
        """
        if self.mode != "looped":
            return
        try:
            expected = self.batch(x, u)
            self.mode = "batched"
            found = self.batch(x.copy(), u.copy())
            agrees = found.shape == expected.shape and np.allclose(found, expected, 1e-9, 0.0)
        except Exception:  # a function of one state may do anything on many
            agrees = False
        self.mode = "batched" if agrees else "looped"

    def _labelled(self, *labels: Array) -> list[Array]:
        return list(labels if self.takes_input else labels[:1])

    def _same_everywhere(self, states: int) -> bool:
        """Whether it computes the same expression at every state, and writes into no argument."""
        ones = (np.ones(size, np.uint64) for size in (states, self._inputs))
        return trace(self.function, self._labelled(*ones)) is not None

    def _keeps_apart(self, mode: str, states: int) -> bool:
        """Whether, called in this mode, each value comes from its own state alone."""
        # No other dimension must have the batch's length.
        count = 7 + max(*self.shape, states, self._inputs)
        bits = np.left_shift(np.uint64(1), np.arange(count, dtype=np.uint64) % np.uint64(64))
        arguments = self._labelled(
            *(np.repeat(bits[:, None], size, axis=1) for size in (states, self._inputs))
        )
        function = self.function
        if mode == "columns":
            arguments, function = [labels.T for labels in arguments], self._by_columns
        found = trace(function, arguments)
        if found is None or found.size != count * math.prod(self.shape):
            return False
        own = bits if mode == "columns" else bits.reshape(-1, *[1] * (found.ndim - 1))
        return found.shape[-1 if mode == "columns" else 0] == count and not np.any(found & ~own)

    def _probe(self, x: Array, u: Array) -> Array | None:
        """The checked value at a probe; None where the function cannot be used there."""
        x_given, u_given = x.copy(), u.copy()
        try:
            with np.errstate(all="ignore"):
                raw = self.function(*((x_given, u_given) if self.takes_input else (x_given,)))
            value = np.array(unmasked(raw), dtype=np.float64)  # a copy: it may be one buffer
        except Exception:  # outside its domain; the estimator checks at the initial state
            return None
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
        self._is_odd |= (
            isinstance(raw, np.ma.MaskedArray) or getattr(raw, "dtype", None) == np.object_
        )
        return value.reshape(self.shape) if np.isfinite(value).all() else None

    def evaluated_by(self, function: Trusted) -> BatchedFunction:
        """The same function, evaluated by other means that take (..., n)."""
        other = BatchedFunction(self.name, function, self.shape, self._inputs, [])
        other.mode = "batched"
        return other

    def copy(self) -> BatchedFunction:
        """The same function, whose mode can change independently."""
        return copy(self)

    @property
    def direct(self) -> Callable[..., Any]:
        """A function of one state, and of the input where there are any: the user's if it may."""
        if self.reads_only and not self._short and self.takes_input == (self._inputs > 0):
            return self.function
        return self if self._inputs else partial(self, u=NO_INPUT)

    @property
    def plain(self) -> bool:
        """Whether the user's function can be called directly, on (..., n) and all inputs."""
        takes_all = self.takes_input or self._inputs == 0
        return self.mode == "batched" and takes_all and self._returns_array and not self._short

    def check(self, x: Array, u: Array) -> None:
        """Check that the value is finite and of the right shape at a state that will be used."""
        if self.mode == "unknown":
            self._detect([(x, u), (x * (1 + 1e-6), u * (1 + 1e-3))])
        try:
            with np.errstate(all="ignore"):
                value = np.asarray(self(x, u), dtype=np.float64)
        except Exception as error:
            raise ModelError(
                f"{self.name} raised {type(error).__name__}: {error} at the initial state "
                f"{x.tolist()}; it must be defined there."
            ) from error
        if value.shape != self.shape:
            raise ModelError(
                f"{self.name} returned shape {value.shape} at the initial state; "
                f"expected {self.shape}."
            )
        if not np.isfinite(value).all():
            raise ModelError(
                f"{self.name} is {value.tolist()} at the initial state {x.tolist()}; "
                "expected finite numbers. Change the initial state or bound the states."
            )


def missing_input(name: str, inputs: int) -> InvalidInputError:
    """The error of a call without u of a function of a system with inputs."""
    return InvalidInputError(
        f"u is missing: the system has {inputs} input{'s' * (inputs != 1)}; call {name}(x, u)."
    )


def takes_input(name: str, function: Callable[..., Any], inputs: int) -> bool:
    """Whether a model function is one of x and u, by its parameters.

    The second positional parameter is the input, whatever its name and default are.
    """
    if isinstance(function, np.ufunc):
        if function.nin > 1 + (inputs > 0):
            raise ModelError(f"{name} is {function!r}, a function of {function.nin} arguments; "
                             f"expected {name}(x) or {name}(x, u).")
        return function.nin == 2
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # compiled functions have no signature: pass all arguments
        return inputs > 0
    positional = [q for q in parameters if q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD)]
    rest = any(q.kind is q.VAR_POSITIONAL for q in parameters)
    if not positional and not rest:
        raise ModelError(f"{name} takes no argument; expected {name}(x) or {name}(x, u).")
    for q in parameters:
        if q.kind is q.KEYWORD_ONLY and (q.default is q.empty or (q.name == "u" and inputs > 0)):
            raise ModelError(
                f"{name} takes {q.name} by keyword only, but is called as {name}(x) or {name}(x, "
                "u); make it the second positional parameter, or bind it with functools.partial."
            )
    required = sum(q.default is q.empty for q in positional)
    if required > 1 + (inputs > 0):
        raise ModelError(
            f"{name} needs {required} arguments, but the system has "
            + ("no inputs; pass m, the number of inputs, or make it a function of x alone."
               if inputs == 0 else f"{inputs} inputs: expected {name}(x, u). Bind the others with "
               "functools.partial.")
        )
    if inputs == 0:
        return False
    if len(positional) < 2:
        return rest
    second = positional[1]
    if second.name != "u":
        if any(q.name == "u" for q in positional[2:]):
            raise ModelError(
                f"{name} has a parameter u, but its second one is {second.name}; make u the "
                "second parameter, or bind the other with functools.partial."
            )
        if second.default is not second.empty and not _may_be_input(second.default, inputs):
            raise ModelError(
                f"{name} is called as {name}(x, u), but the default of its second parameter, "
                f"{second.name} = {second.default!r}, is no input of {inputs} numbers. Make u the "
                f"second parameter, or bind {second.name} with functools.partial."
            )
    return True


def check_inputs(m: int, **takes_input: bool) -> None:
    """Reject inputs that no function of the model takes."""
    if m and not any(takes_input.values()):
        names = list(takes_input)
        raise ModelError(
            f"m is {m}, but neither {names[0]} nor {names[1]} takes an input; write "
            f"{names[0]}(x, u) or {names[1]}(x, u), or leave m out."
        )


def _may_be_input(default: Any, inputs: int) -> bool:
    """Whether a default could be an input: None, a number, or m of them."""
    if default is None:
        return True
    try:
        array = np.asarray(default, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return array.ndim == 0 or array.shape == (inputs,)
