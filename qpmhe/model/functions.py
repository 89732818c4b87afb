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
from .points import Points
from .tracing import unmasked

Array = NDArray[Any]

#: The input of a system without inputs.
NO_INPUT = np.zeros(0)
# So many points must have a value, where the shape of values is checked.
_ENOUGH = 2


class EvaluationError(QpmheError):
    """A model function ended the program, or returned no value, at some state.

    It never escapes from an estimator: the step falls back.
    """


class Trusted(NamedTuple):
    """A function of this package that takes (..., n) as well as (n,) and modifies no argument."""

    function: Callable[..., Any]


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
    """g(x) or g(x, u) of one state, evaluated over leading dimensions.

    A user's function is called state by state, with a copy of each argument. Only functions of this
    package are called once for many states; so are expressions, which stand in the place of users'
    functions in estimators.

    Attributes
    ----------
    mode : str
        ``batched`` or ``looped``.
    takes_input : bool
        Whether it is a function of u as well.
    reads_only : bool
        Whether it writes into no argument, which a trace proves, so that it needs no copies.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any] | Trusted,
        shape: tuple[int, ...],
        inputs: int,
        probes: Points,
    ) -> None:
        self.reads_only = isinstance(function, Trusted)
        self.mode = "batched" if self.reads_only else "looped"
        if isinstance(function, Trusted):
            function = function.function
        if not callable(function):
            raise ModelError(f"{name} is {shown(function)}; expected a function of the state.")
        self.name, self.shape = name, shape
        self._inputs, self.has_inputs = inputs, inputs > 0
        self.takes_input = takes_input(name, function, inputs)
        #: What is called: the user's function, contained.
        self.function = contained(function)
        # A scalar at one state is a value of shape (1,): p = 1 is written without brackets.
        self._short = False
        #: At how many points it had a value, so far.
        self.known = 0
        for x, u in probes:
            self.known += self._try(x, u)
            if self.known == _ENOUGH:
                break

    def __call__(self, x: Array, u: Array = NO_INPUT) -> Array:
        """The value at one state x (n,) and input u (m,), which may be left out if m is 0."""
        if u is NO_INPUT and self._inputs:
            raise missing_input(self.name, self._inputs)
        if self.reads_only:
            value = self.function(x, u) if self.takes_input else self.function(x)
            return np.asarray(value).reshape(self.shape) if self._short else value
        raw = self.function(x.copy(), u.copy()) if self.takes_input else self.function(x.copy())
        if type(raw) is np.ndarray and raw.dtype == np.float64 and raw.shape == self.shape:
            return raw
        if x.dtype == np.object_:
            return self._as_symbols(raw)
        return self._as_value(raw)

    def _as_symbols(self, raw: Any) -> Array:
        """The value of a user's function of the symbols of a trace."""
        found: Array = np.asarray(raw, np.object_).reshape(self.shape)
        return found

    def _as_value(self, raw: Any) -> Array:
        """The checked value of a user's function."""
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
        else:
            # Copied row by row: a function may return one and the same array every time.
            value = np.empty((x.shape[0], *self.shape), dtype=np.result_type(x, np.float64))
            function, usual, as_value = self.function, value.shape[1:], self._as_value
            if value.dtype == np.object_:  # symbols of a trace come back as such
                as_value = self._as_symbols
            rows = zip(x.copy(), u.copy(), strict=True) if self.takes_input else zip(x.copy())
            for i, arguments in enumerate(rows):
                raw = function(*arguments)
                is_usual = type(raw) is np.ndarray and raw.shape == usual
                value[i] = raw if is_usual and raw.dtype == np.float64 else as_value(raw)
        shaped: Array = value.reshape(lead + self.shape)
        return shaped

    def at_once(self, x: Array, u: Array) -> Array:
        """The values at states (K, n) and inputs (K, m) by one call; raises if it returns others.

        They may be wrong: a function of one state may do anything on many.
        """
        raw = self.function(x.copy(), u.copy()) if self.takes_input else self.function(x.copy())
        shape = (len(x), *self.shape)
        if type(raw) is not np.ndarray or raw.dtype != np.float64 or (
            raw.shape != shape and not (self._short and raw.shape == shape[:1])
        ):
            raise EvaluationError(f"{self.name} is a function of one state")
        return raw.reshape(shape).copy()

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

    def _try(self, x: Array, u: Array) -> bool:
        """Check the function at a point; whether it has a finite value there."""
        x_given, u_given = x.copy(), u.copy()
        try:
            with np.errstate(all="ignore"):
                raw = self.function(*((x_given, u_given) if self.takes_input else (x_given,)))
            value = np.array(unmasked(raw), dtype=np.float64)  # a copy: it may be one buffer
        except Exception:  # outside its domain; the estimator checks at the initial state
            return False
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
        return bool(np.isfinite(value).all())

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

    def check(self, x: Array, u: Array) -> None:
        """Check that the value is finite and of the right shape at a state that will be used."""
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

    The second positional parameter is the input, whatever its name is.
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
        check_default(name, second)
    return True


def check_inputs(m: int, **takes_input: bool) -> None:
    """Reject inputs that no function of the model takes."""
    if m and not any(takes_input.values()):
        names = list(takes_input)
        raise ModelError(
            f"m is {m}, but neither {names[0]} nor {names[1]} takes an input; write "
            f"{names[0]}(x, u) or {names[1]}(x, u), or leave m out."
        )


def check_default(name: str, parameter: inspect.Parameter) -> None:
    """Reject a default where the input stands, which would take its place; None says nothing."""
    default = parameter.default
    if parameter.name == "u" or default is parameter.empty or default is None:
        return
    raise ModelError(
        f"{name} has the parameter {parameter.name}={shown(default)} in the place of the input u. "
        f"If it is a constant, bind it: functools.partial({name}, {parameter.name}=...); if it is "
        "the input, name it u, or leave out its default."
    )
