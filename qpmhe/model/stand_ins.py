"""Replacements for NumPy's array constructors and for `math` during a trace."""

from __future__ import annotations

import builtins
import contextlib
import dis
import functools
import inspect
import math
import operator
import sys
import threading
import types
import weakref
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from . import splines
from .symbols import Symbol, SymbolArray, TraceRecord, holds_symbols

# NumPy's functions that make arrays of numbers: during a trace, arrays that take symbols.
_MAKERS = (
    "zeros", "ones", "empty", "full", "eye", "identity", "array", "asarray", "asanyarray",
    "ascontiguousarray",
)
# Functions that do not take lists of symbols as they take lists of numbers.
_OF_LISTS = (
    "max", "min", "amax", "amin", "maximum", "minimum", "fmax", "fmin", "clip", "arctan2", "hypot",
    "interp", "sign", "heaviside",
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
# Whether each trace that runs goes deeper, and what both kinds have replaced.
_traces: dict[object, bool] = {}
_originals: dict[bool, dict[tuple[Any, str], Any]] = {False: {}, True: {}}


class MakingRecord(TraceRecord):
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


def with_symbols(record: MakingRecord, function: Callable[..., Any]) -> Callable[..., Any]:
    """A user's function that is called by one that `without_symbols` restored NumPy for."""

    def call(*arguments: Any, **options: Any) -> Any:
        _tracing.record = record
        try:
            return function(*arguments, **options)
        finally:
            _tracing.record = None

    return call


@contextlib.contextmanager
def numpy_on_symbols(record: MakingRecord, deeper: bool = False) -> Iterator[None]:
    """Let arrays that a function makes in this thread take symbols, and `math` too.

    NumPy does not dispatch ``numpy.zeros(2)``, into which a model then writes symbols, and
    ``math.sin`` does not dispatch on its argument. So code that this thread runs meanwhile finds
    others in these modules; any other thread finds what is there.

    Parameters
    ----------
    record : MakingRecord
        The trace.
    deeper : bool
        Whether to replace Python's ``max`` and ``min`` and SciPy's splines as well. For these there
        is no way but for all threads; for others they do what they always do.
    """
    before, token = getattr(_tracing, "record", None), object()
    try:
        with _swapping:
            _traces[token] = deeper
            for deep in {False, deeper}:
                for owner, name, stand_in in _places(deep):
                    # After an interrupt, what is there may be a stand-in already.
                    if (owner, name) not in _originals[deep]:
                        own = type(owner) if name == "__class__" else vars(owner).get(name)
                        _originals[deep][owner, name] = own
                        setattr(owner, name, stand_in)
        _tracing.record = record
        yield
    finally:
        _tracing.record = before
        with _swapping:
            _traces.pop(token, None)
            for deep, originals in _originals.items():
                if not any(one >= deep for one in _traces.values()):
                    for (owner, name), own in originals.items():
                        if own is not None:
                            setattr(owner, name, own)
                        elif name in vars(owner):  # inherited before
                            delattr(owner, name)
                    originals.clear()


def _places(deep: bool) -> list[tuple[Any, str, Any]]:
    """What is replaced: an attribute of a module or class, and by what."""
    if not deep:
        return [(module, "__class__", _Module) for module in (np, np.linalg, math)]
    extrema = [
        (builtins, "max", _extremum(_MAX, operator.gt)),
        (builtins, "min", _extremum(_MIN, operator.lt)),
    ]
    found = splines.forms() if "scipy.interpolate" in sys.modules else []
    return [*extrema, *((kind, "__call__", _table(kind, pieces)) for kind, pieces in found)]


class _Module(types.ModuleType):
    """A module in which a thread that traces finds stand-ins."""

    def __getattribute__(self, name: str) -> Any:
        # Not by `super`, which fails if the trace of another thread ends during this lookup.
        found = types.ModuleType.__getattribute__(self, name)
        record = getattr(_tracing, "record", None)
        if record is None or record.closed:
            return found
        stand_in = _STAND_INS.get((types.ModuleType.__getattribute__(self, "__name__"), name))
        return stand_in if stand_in and _is_looked_up(sys._getframe(1), name) else found


def _is_looked_up(frame: Any, name: str) -> bool:
    """Whether the Python code of a frame looks up this name itself.

    Not a compiled function that this code calls: it takes an array for what it has asked for,
    and writes numbers over objects. NumPy's random generators, whose calls have no frame of their
    own, ask for ``numpy.empty`` like this, and the process would crash: so the instruction decides,
    and not the names in the code. Nor a module that is imported and keeps what it finds.
    """
    code = frame.f_code
    if "from_buffer" in code.co_names:  # it may pass on the memory to others, unseen
        return False
    found = _looked_up.get(code)
    if found is None:
        instructions = list(dis.get_instructions(code))
        ends = [*(one.offset for one in instructions[1:]), len(code.co_code)]
        found = _looked_up[code] = {
            # A frame may stand at the instruction, or at the end of its cache.
            place: one.argval for one, end in zip(instructions, ends, strict=True)
            if one.opname in ("LOAD_ATTR", "LOAD_METHOD")
            or (one.opname == "IMPORT_FROM" and code.co_flags & inspect.CO_NEWLOCALS)
            for place in range(one.offset, end)
        }
    return found.get(frame.f_lasti) == name


_looked_up: weakref.WeakKeyDictionary[Any, dict[int, str]] = weakref.WeakKeyDictionary()


def _maker(function: Callable[..., Any]) -> Callable[..., Any]:
    """One of NumPy's makers of arrays, that makes arrays of symbols in a thread that traces."""

    @functools.wraps(function)
    def make(*arguments: Any, **options: Any) -> Any:
        record = getattr(_tracing, "record", None)
        if record is None or record.closed:
            return function(*arguments, **options)
        return record.made(function, arguments, options)

    return make


class _OfLists:
    """One of NumPy's functions, that takes lists of symbols in a thread that traces."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        record = getattr(_tracing, "record", None)
        if record is None or record.closed:
            return self._function(*arguments, **options)
        return self._function(*(
            record.made(np.array, (one,), {})
            if isinstance(one, (list, tuple)) and holds_symbols(one) else one for one in arguments
        ), **options)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._function, name)
        return _OfLists(found) if name in ("reduce", "accumulate", "outer") else found


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


_STAND_INS = {
    **{("numpy", name): _OfLists(getattr(np, name)) for name in _OF_LISTS},
    **{("numpy.linalg", name): _OfLists(getattr(np.linalg, name)) for name in ("inv", "det")},
    **{("numpy", name): _maker(getattr(np, name)) for name in _MAKERS},
    **{("math", name): _of_math(getattr(math, name), getattr(np, other))
       for name, other in _OF_MATH.items() if hasattr(math, name) and hasattr(np, other)},
}


_MAX, _MIN = max, min


def _extremum(function: Callable[..., Any], exceeds: Callable[..., Any]) -> Callable[..., Any]:
    """Python's ``max`` or ``min``, that takes symbols."""

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        record = getattr(_tracing, "record", None)
        if record is None or record.closed or options or not arguments:
            return function(*arguments, **options)
        values = list(arguments[0]) if len(arguments) == 1 else list(arguments)
        if not any(isinstance(one, Symbol) for one in values) or any(
            np.ndim(one) for one in values
        ):
            return function(values)
        return functools.reduce(
            lambda first, one: record.choice(exceeds(one, first), one, first), values
        )

    return call


def _table(kind: Any, pieces: Callable[..., Any]) -> Callable[..., Any]:
    """The call of one of SciPy's splines, that takes symbols."""
    own = kind.__call__

    @functools.wraps(own)
    def call(self: Any, x: Any, *arguments: Any, **options: Any) -> Any:
        record = getattr(_tracing, "record", None)
        if record is None or record.closed or not holds_symbols(x):
            return own(self, x, *arguments, **options)
        return without_symbols(pieces)(record, self, x, *arguments, **options)

    return call
