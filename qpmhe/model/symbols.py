"""Symbols in place of numbers, to trace what a function does for all values of its arguments.

A function that returns when it is called on symbols has no branch on a value, no loop over
values and no table look-up by one: it computes the same expression everywhere. What a symbol
carries is up to the record of the trace.
"""

from __future__ import annotations

import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_HERE = Path(__file__).parent
# Frames of these files and folders are never the user's code that asked for something.
_MACHINERY = (
    *(str(_HERE / f"{name}.py") for name in (
        "symbols", "operations", "stand_ins", "splines", "tracing", "functions",
    )),
    str(_HERE.parent / "adapters"), str(Path(np.__file__).parent),
)
_PACKAGE = str(_HERE.parent)
_LIBRARIES = (str(Path(np.__file__).parents[1]), str(Path(os.__file__).parent))


#: What to do about operations that have no symbolic form.
INSTEAD = "; write it with the functions of NumPy that the table in how-to/speed lists"


class NotTraceableError(Exception):
    """The function asks for the value of a symbol."""


def place(frame: Any) -> str:
    """File and line of the user's code that asked, from a frame outwards to the start of a trace.

    Blank if there is none. A library's own, where there is no other.
    """
    found = ""
    while frame is not None and frame.f_code is not run.__code__:
        name = frame.f_code.co_filename
        if not name.startswith(_MACHINERY):
            here = f"{name}:{frame.f_lineno}"
            if not name.startswith(_LIBRARIES) or name.startswith(_PACKAGE):
                return here
            found = found or here
        frame = frame.f_back
    return found


class TraceRecord(ABC):
    """What happened during one trace, which all of its symbols share."""

    #: A function that does more with single symbols than this is not traced any further.
    most_operations = 50_000

    def __init__(self) -> None:
        #: Why it was refused, the first time; blank if never. Whatever the function catches.
        self.reason = ""
        #: Whether the trace is over: a symbol that the function kept then acts as NaN.
        self.closed = False
        self._operations = 0

    @property
    def refused(self) -> bool:
        """Whether a value was asked for."""
        return bool(self.reason)

    def refuse(self, asked: str) -> NotTraceableError:
        """The error to be raised: the function asks for this."""
        if not self.reason:
            where = place(sys._getframe(1))
            self.reason = f"{where} asks for {asked}" if where else f"it asks for {asked}"
        return NotTraceableError(self.reason)

    def symbol(self, value: Any, logical: bool = False) -> Symbol:
        """One more symbol."""
        self._operations += 1
        if self._operations > self.most_operations:
            raise self.refuse(f"more than {self.most_operations} operations on single numbers")
        return Symbol(self, value, logical)

    def array(self, values: Any) -> SymbolArray:
        """An array of this trace from an array of objects."""
        array = np.asarray(values, np.object_).view(SymbolArray)
        array.record = self
        return array

    @abstractmethod
    def operate(self, ufunc: Any, operands: tuple[Any, ...]) -> Any:
        """Apply an elementwise function to symbols and numbers."""

    @abstractmethod
    def apply(
        self, ufunc: Any, method: str, inputs: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        """Apply one of NumPy's elementwise functions, or a matrix product, to arrays."""

    @abstractmethod
    def call(self, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call any other function of NumPy."""

    @abstractmethod
    def choice(self, condition: Any, chosen: Any, other: Any) -> Any:
        """One or the other, entry by entry."""


NUMBERS = (bool, int, float, complex, np.generic)


def _unary(ufunc: Any) -> Callable[[Symbol], Any]:
    def operation(self: Symbol) -> Any:
        return float("nan") if self.record.closed else self.record.operate(ufunc, (self,))

    return operation


def _binary(
    ufunc: Any, swapped: bool = False, after: Any = float("nan")
) -> Callable[[Symbol, Any], Any]:
    def operation(self: Symbol, other: Any, *more: Any) -> Any:
        if more or not isinstance(other, (Symbol, *NUMBERS)):
            return NotImplemented
        if self.record.closed:
            return after
        operands = (other, self) if swapped else (self, other)
        return self.record.operate(ufunc, operands)

    return operation


def _value(asked: str) -> Callable[..., Any]:
    def refuse(self: Symbol, *_: Any) -> float:
        if self.record.closed:
            return float("nan")
        raise self.record.refuse(asked)

    return refuse


class Symbol:
    """A number without a value.

    ``value`` is what the trace knows instead: an expression. ``logical`` says whether
    NumPy would have a truth value there.
    """

    __slots__ = ("logical", "record", "value")

    def __init__(self, record: TraceRecord, value: Any, logical: bool = False) -> None:
        self.record, self.value, self.logical = record, value, logical

    __add__, __radd__ = _binary(np.add), _binary(np.add, True)
    __sub__, __rsub__ = _binary(np.subtract), _binary(np.subtract, True)
    __mul__, __rmul__ = _binary(np.multiply), _binary(np.multiply, True)
    __truediv__, __rtruediv__ = _binary(np.divide), _binary(np.divide, True)
    __floordiv__, __rfloordiv__ = _binary(np.floor_divide), _binary(np.floor_divide, True)
    __mod__, __rmod__ = _binary(np.remainder), _binary(np.remainder, True)
    __divmod__, __rdivmod__ = _binary(np.divmod), _binary(np.divmod, True)
    __pow__, __rpow__ = _binary(np.power), _binary(np.power, True)
    __and__, __rand__ = _binary(np.bitwise_and), _binary(np.bitwise_and, True)
    __or__, __ror__ = _binary(np.bitwise_or), _binary(np.bitwise_or, True)
    __xor__, __rxor__ = _binary(np.bitwise_xor), _binary(np.bitwise_xor, True)
    __neg__, __pos__, __abs__ = _unary(np.negative), _unary(np.positive), _unary(np.absolute)
    __invert__ = _unary(np.invert)
    __lt__, __le__ = _binary(np.less, after=False), _binary(np.less_equal, after=False)
    __gt__, __ge__ = _binary(np.greater, after=False), _binary(np.greater_equal, after=False)
    __eq__ = _binary(np.equal, after=False)
    __ne__ = _binary(np.not_equal, after=False)
    __float__ = _value(
        "float() of a symbol, or to store it in an array of numbers; write no float(), and "
        "numpy.sin(...) or numpy.zeros(...) by these names, not sin or zeros imported alone"
    )
    __int__ = _value(
        "int() of a symbol; write numpy.floor for a number, numpy.interp for a table"
    )
    __index__ = _value("an index from a symbol; write numpy.interp or numpy.select for a table")
    __complex__, __round__ = _value("complex() of a symbol"), _value(
        "round() of a symbol; write numpy.round"
    )
    __trunc__ = __floor__ = __ceil__ = _value("an integer from a symbol")
    __hash__ = _value("the hash of a symbol")
    __reduce__ = _value("a pickle of a symbol")

    def __bool__(self) -> bool:
        return bool(_value(
            "the truth of a comparison: a branch or a loop on a value; write numpy.where, "
            "numpy.clip or numpy.select"
        )(self))

    def _text(self, *_: Any) -> str:
        return str(_value("the text of a symbol")(self))

    __str__ = __repr__ = __format__ = _text

    def __copy__(self) -> Symbol:
        return self

    def __deepcopy__(self, memo: Any) -> Symbol:
        return self

    # As of a number of NumPy: what holds for an array of no dimension.
    __iter__ = None

    def __getitem__(self, key: Any) -> Any:
        return wrapped(self.record, in_arrays(as_nan(self) if self.record.closed else self)[key])

    def conjugate(self) -> Any:
        """Return the symbol itself: a state is real."""
        return float("nan") if self.record.closed else self

    def item(self, *_: Any) -> Any:
        """Return the symbol itself, as a number of NumPy does."""
        return self.conjugate()

    @property
    def real(self) -> Symbol:
        """Return the symbol itself: a state is real."""
        return self

    @property  # type: ignore[misc]  # NumPy asks for it, but never sets it, as one can of an object
    def __class__(self) -> Any:
        """The type of an array's entry, for who asks by ``isinstance``."""
        return np.bool_ if self.logical else np.float64

    def __getattr__(self, name: str) -> Any:
        if name == "dtype" and not sys._getframe(1).f_code.co_filename.startswith(_MACHINERY):
            return np.dtype(self.__class__)
        if name in _OF_ARRAYS:
            found = getattr(self.record.array(in_arrays(self)), name)
            return _numbers(found) if callable(found) else found
        # NumPy's compiled code asks for how the number lies in memory, and takes no for an answer.
        if (
            hasattr(np.float64, name) and not name.startswith("__array") and not self.record.closed
            and not sys._getframe(1).f_code.co_filename.startswith(_MACHINERY)
        ):
            self.record.refuse(f"the attribute {name} of a symbol")
        raise AttributeError(f"a symbol has no attribute {name}")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply(self.record, ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _call(self.record, function, args, kwargs)


# Attributes of NumPy's numbers that are those of an array of no dimension.
_OF_ARRAYS = frozenset((
    "reshape", "ravel", "flatten", "squeeze", "transpose", "T", "ndim", "shape", "size", "copy",
     "astype", "sum", "mean", "min", "max", "prod", "clip", "round", "repeat", "any", "all",
))


def _numbers(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of an array that returns numbers in place of arrays of no dimension."""

    def call(*arguments: Any, **options: Any) -> Any:
        value = method(*arguments, **options)
        return value[()] if isinstance(value, SymbolArray) and not value.ndim else value

    return call


# NumPy calls methods of these names on the entries of plain arrays of objects.
for _ufunc in (
    np.sin, np.cos, np.tan, np.arcsin, np.arccos, np.arctan, np.sinh, np.cosh, np.tanh,
    np.arcsinh, np.arccosh, np.arctanh, np.exp, np.exp2, np.expm1, np.log, np.log2, np.log10,
    np.log1p, np.sqrt, np.cbrt, np.rint, np.fabs, np.degrees, np.radians, np.deg2rad, np.rad2deg,
):
    setattr(Symbol, _ufunc.__name__, _unary(_ufunc))


_BY_SYMBOLS = (
    "an entry by a symbol as index, or by a mask of symbols; write numpy.where(mask, a, b) or "
    "numpy.interp"
)


class SymbolArray(np.ndarray[Any, Any]):
    """An array of symbols and numbers, which NumPy's functions take and return."""

    record: TraceRecord

    def __array_finalize__(self, source: Any) -> None:
        if hasattr(source, "record"):
            self.record = source.record

    @property
    def dtype(self) -> Any:
        """Double precision, for the user's code, where that is what the array stands for."""
        if not sys._getframe(1).f_code.co_filename.startswith(_MACHINERY):
            return np.dtype(np.float64)
        return np.ndarray.dtype.__get__(self)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply(self.record, ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _call(self.record, function, args, kwargs)

    def __getitem__(self, key: Any) -> Any:
        if not self.record.closed and holds_symbols(key):
            raise self.record.refuse(_BY_SYMBOLS)
        return wrapped(self.record, plain(self)[key])

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self.record.closed and not self.flags.writeable:
            raise self.record.refuse("a change of its argument; write x = x.copy() first")
        if not self.record.closed and holds_symbols(key):
            # One number under a mask is a choice for each entry.
            if np.shape(key) != self.shape or np.ndim(plain(value)) or not _is_mask(key):
                raise self.record.refuse(_BY_SYMBOLS)
            key, value = ..., self.record.choice(key, value, self)
        plain(self)[key] = plain(value)

    def dot(self, other: Any, out: Any = None) -> Any:
        """Return `np.dot(self, other)`, which the symbol records."""
        return np.dot(self, other) if out is None else np.dot(self, other, out)

    def astype(self, dtype: Any, *options: Any, **more: Any) -> Any:
        """Return a copy, as of an array of double precision, which it stands for."""
        if self.record.closed:
            return as_nan(self).astype(dtype, *options, **more)
        if np.dtype(dtype) not in (np.float64, np.object_):
            raise self.record.refuse(f"symbols as {np.dtype(dtype)}")
        return self.copy()

    def _refuse(self, *_: Any) -> Any:
        raise self.record.refuse("the bytes of an array of symbols")

    __bytes__: Any = _refuse
    tobytes: Any = _refuse
    tofile: Any = _refuse
    __reduce__: Any = _refuse
    __array_interface__: Any = property(_refuse)
    __array_struct__: Any = property(_refuse)
    data: Any = property(_refuse)
    ctypes: Any = property(_refuse)


def holds_symbols(value: Any) -> bool:
    """Whether it is a symbol, or a list or an array that holds objects."""
    if isinstance(value, (tuple, list)):
        return any(holds_symbols(item) for item in value)
    return isinstance(value, Symbol) or getattr(value, "dtype", None) == np.object_


def _is_mask(key: Any) -> bool:
    entries = np.asarray(plain(key), np.object_).ravel()
    return all(
        one.logical if isinstance(one, Symbol) else isinstance(one, (bool, np.bool_))
        for one in entries
    )


def plain(value: Any) -> Any:
    """The same in plain arrays of objects."""
    if isinstance(value, SymbolArray):
        return value.view(np.ndarray)
    if isinstance(value, (tuple, list)):
        return type(value)(plain(item) for item in value)
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return value


def in_arrays(value: Any) -> Any:
    """The same in plain arrays, which NumPy's functions do not hand back to a symbol."""
    if isinstance(value, Symbol):
        array = np.empty((), np.object_)
        array[()] = value
        return array
    if isinstance(value, (tuple, list)):
        return type(value)(in_arrays(item) for item in value)
    return plain(value)


def as_nan(value: Any) -> Any:
    """The same with NaN for symbols, of a trace that is over."""
    if isinstance(value, Symbol):
        return float("nan")
    if isinstance(value, SymbolArray):
        return np.full(value.shape, np.nan)
    if isinstance(value, (tuple, list)):
        return type(value)(as_nan(item) for item in value)
    if isinstance(value, dict):
        return {key: as_nan(item) for key, item in value.items()}
    return value


def wrapped(record: TraceRecord, value: Any) -> Any:
    """The same with arrays of this trace in place of arrays of objects."""
    if isinstance(value, (tuple, list)):
        return type(value)(wrapped(record, item) for item in value)
    if isinstance(value, np.ndarray) and value.dtype == np.object_:
        return record.array(flat(value))
    return value


def flat(values: Any) -> Any:
    """An array of objects with the entries of arrays of no dimension that NumPy left in it."""
    if any(isinstance(one, np.ndarray) for one in values.flat):
        for index, one in np.ndenumerate(values):
            if isinstance(one, np.ndarray) and not one.ndim:
                values[index] = one[()]
    return values


def _apply(
    record: TraceRecord, ufunc: Any, method: str, inputs: tuple[Any, ...], options: dict[str, Any]
) -> Any:
    if record.closed:
        return getattr(ufunc, method)(*as_nan(inputs), **as_nan(options))
    return record.apply(ufunc, method, inputs, options)


def _call(record: TraceRecord, function: Any, args: Any, kwargs: Any) -> Any:
    if record.closed:
        return function(*as_nan(args), **as_nan(kwargs))
    return record.call(function, args, kwargs)


def run(
    record: TraceRecord, function: Callable[..., Any], arguments: Sequence[SymbolArray]
) -> tuple[Any, BaseException | None]:
    """What the function returns for symbols, or what it raises.

    Its exceptions do not matter: it may work on numbers. The record shows whether the trace was
    refused, or writes into an argument.
    """
    before = [plain(one).copy() for one in arguments]
    for one in arguments:
        one.flags.writeable = False
    try:
        with np.errstate(all="ignore"):
            value = function(*arguments)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return None, error
    for old, new in zip(before, arguments, strict=True):
        if not all(a is b for a, b in zip(old.flat, plain(new).flat, strict=True)):
            record.refuse("a change of its argument")
    return value, None
