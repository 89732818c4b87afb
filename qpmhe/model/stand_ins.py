"""Replacements for NumPy's array constructors and for `math` during a trace."""

from __future__ import annotations

import contextlib
import dis
import functools
import math
import sys
import threading
import weakref
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .symbols import Record, Symbol, SymbolArray

# NumPy's functions that make arrays of numbers: during a trace, arrays that take symbols.
_MAKERS = (
    "zeros", "ones", "empty", "full", "eye", "identity", "array", "asarray", "asanyarray",
    "ascontiguousarray",
)
# Python's functions of numbers, as NumPy calls them.
_OF_MATH = {
    "acos": "arccos", "acosh": "arccosh", "asin": "arcsin", "asinh": "arcsinh", "atan": "arctan",
    "atan2": "arctan2", "atanh": "arctanh", "pow": "power",
    **{name: name for name in (
        "ceil", "copysign", "cos", "cosh", "degrees", "exp", "exp2", "expm1", "fabs", "floor",
        "fmod", "hypot", "log", "log10", "log1p", "log2", "radians", "sin", "sinh", "sqrt", "tan",
        "tanh", "trunc", "cbrt",
    )},
}
_tracing = threading.local()
_swapping = threading.RLock()
_swaps = 0
_originals: dict[tuple[Any, str], Any] = {}


class MakingRecord(Record):
    """A record of a trace whose symbols may be written into new arrays."""

    @abstractmethod
    def made(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        """An array that the function makes: of objects where it would be of real numbers."""


def without_symbols(method: Callable[..., Any]) -> Callable[..., Any]:
    """Restore NumPy within a function or method; see `numpy_on_symbols`."""

    @functools.wraps(method)
    def call(*arguments: Any, **options: Any) -> Any:
        before = getattr(_tracing, "record", None)
        _tracing.record = None
        try:
            return method(*arguments, **options)
        finally:
            _tracing.record = before

    return call


@contextlib.contextmanager
def numpy_on_symbols(record: MakingRecord) -> Iterator[None]:
    """Let arrays that a function makes in this thread take symbols, and `math` too.

    NumPy does not dispatch ``numpy.zeros(2)``, into which a model then writes symbols, and
    ``math.sin`` does not dispatch on its argument. So both are replaced during a trace, in its
    thread.
    """
    global _swaps
    before = getattr(_tracing, "record", None)
    with _swapping:
        if not _swaps:
            _swap()
        _swaps += 1
    _tracing.record = record
    try:
        yield
    finally:
        _tracing.record = before
        with _swapping:
            _swaps -= 1
            if not _swaps:
                for (module, name), function in _originals.items():
                    setattr(module, name, function)
                _originals.clear()


def _swap() -> None:
    # After an interrupt, what is there may be a stand-in: the original is the one from before.
    for name in _MAKERS:
        original = _originals.setdefault((np, name), getattr(np, name))
        setattr(np, name, _maker(original))
    for name, other in _OF_MATH.items():
        if hasattr(math, name) and hasattr(np, other):
            original = _originals.setdefault((math, name), getattr(math, name))
            setattr(math, name, _of_math(original, getattr(np, other)))


def _maker(function: Callable[..., Any]) -> Callable[..., Any]:
    """One of NumPy's makers of arrays, that makes arrays of symbols in a thread that traces."""

    @functools.wraps(function)
    def make(*arguments: Any, **options: Any) -> Any:
        record = getattr(_tracing, "record", None)
        if record is None or record.closed or not _is_called_by(sys._getframe(1), name):
            return function(*arguments, **options)
        return record.made(function, arguments, options)

    name = function.__name__
    return make


def _is_called_by(frame: Any, name: str) -> bool:
    """Whether the Python code of a frame is calling a function of this name itself.

    Not a compiled function that this code calls: it takes an array for what it has asked for,
    and writes numbers over objects.
    """
    code = frame.f_code
    if "from_buffer" in code.co_names:  # it may pass on the memory to others, unseen
        return False
    try:
        called = _calls.get(code)
        if called is None:
            called = _calls[code] = _called_names(code)
    except Exception:  # without positions, nothing is known
        return False
    return called.get(frame.f_lasti) == name


_calls: weakref.WeakKeyDictionary[Any, dict[int, str]] = weakref.WeakKeyDictionary()


def _called_names(code: Any) -> dict[int, str]:
    """The name of what is called at each instruction that calls.

    That is the longest name or attribute that begins where the call's text does.
    """
    instructions = list(dis.get_instructions(code))
    ends = [one.offset for one in instructions[1:]] + [len(code.co_code)]
    names: dict[Any, list[tuple[Any, str]]] = {}
    for one in instructions:
        at = one.positions
        if one.opname.startswith("LOAD_") and isinstance(one.argval, str) and at is not None:
            names.setdefault((at.lineno, at.col_offset), []).append(
                ((at.end_lineno, at.end_col_offset), one.argval)
            )
    found = {}
    for one, end in zip(instructions, ends, strict=True):
        at = one.positions
        if one.opname.startswith("CALL") and at is not None:
            within = [
                name for name in names.get((at.lineno, at.col_offset), [])
                if name[0] < (at.end_lineno, at.end_col_offset)
            ]
            if within:
                # A frame may stand at the instruction, or at the end of its cache.
                found.update(dict.fromkeys(range(one.offset, end), max(within)[1]))
    return found


def _of_math(function: Callable[..., Any], ufunc: Any) -> Callable[..., Any]:
    """One of Python's functions of numbers, that takes symbols."""

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        symbols = [one for one in arguments if isinstance(one, (Symbol, SymbolArray))]
        if not symbols or symbols[0].record.closed:
            return function(*arguments)
        if ufunc is np.log and len(arguments) == 2:
            return np.log(arguments[0]) / np.log(arguments[1])
        if len(arguments) != ufunc.nin:
            raise symbols[0].record.refuse(f"math.{function.__name__} of {len(arguments)} numbers")
        value = ufunc(*arguments)
        if np.ndim(value):
            raise symbols[0].record.refuse(f"math.{function.__name__} of several numbers")
        return value

    return call
