"""What functions read besides their arguments, and whether that has changed.

A trace of a function holds the numbers of closures, globals and attributes as they were. Comparing
these with what they were costs microseconds; calling the function to compare its values costs
hundreds.
"""

from __future__ import annotations

import enum
import functools
import math
import sys
import sysconfig
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

# Of arrays of more bytes and lists of more items, so many are compared at a time, then the next.
_PIECE, _ITEMS = 4096, 128
# Values are followed no further than this: through so many others, and so many of them.
_DEEPEST, _MOST = 8, 10_000
# Values that are looked at in the time that one sample may take longer.
_SHARE = 8
# Comparisons for changed values that found no difference, after which looks become rarer.
_FRUITLESS = 4
# Samples from one call of the functions to the next, where the estimator may take that time.
_CALLS = 1000

_LIBRARIES = tuple(
    path for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_paths().get(name))
)
_NOTHING = object()
# What seldom changes, and how many looks at other values one look at these takes.
_CODE = types.FunctionType, types.BuiltinFunctionType, types.ModuleType, type, property, np.ufunc
_RARELY = 16
_Entries = dict[tuple[int, Any], tuple[Mapping[Any, Any], Any, object]]
_CONSTANT = (int, float, complex, str, bytes, bool, type(None), np.generic)


class Captured:
    """The values that functions read from closures, defaults, globals and attributes.

    Values are the same where they are the same objects or equal numbers; lists, dictionaries and
    arrays, which can change in place, where their contents are. Values within modules of the
    standard library and of installed packages are taken for constant.

    Parameters
    ----------
    functions : iterable of callable
        The functions, whose own functions are followed, too.
    """

    def __init__(self, functions: Iterable[Callable[..., Any]]) -> None:
        self._functions, self._turn = tuple(functions), 0
        self.renew()

    def renew(self) -> None:
        """Take the present values."""
        self._cells: list[tuple[types.CellType, object]] = []
        # By the identity of their owner and by key.
        self._entries: _Entries = {}
        self._code: _Entries = {}
        # By the identity of the list or array.
        self._lists: dict[int, tuple[list[Any], tuple[Any, ...]]] = {}
        self._long: dict[int, tuple[list[Any], tuple[Any, ...]]] = {}
        self._arrays: dict[int, tuple[np.ndarray[Any, Any], bytes]] = {}
        self._large: dict[int, tuple[np.ndarray[Any, Any], bytes]] = {}
        # Objects already followed, with the names that they were followed for.
        self._followed: dict[int, tuple[object, frozenset[str]]] = {}
        for function in self._functions:
            self._follow(function, frozenset(), 0)
        self._all = [*self._entries.values(), *self._code.values()]
        listed = sum(len(items) for _, items in self._lists.values())
        single = len(self._cells) + len(self._entries) + listed
        #: About how many single values `changed` looks at.
        self.count = (
            single + _ITEMS * len(self._long) + 2 * len(self._arrays) + 10 * len(self._large)
        )

    def changed(self) -> bool:
        """Whether a value is another than at the last call of `renew`.

        Functions, classes and modules are looked at in each sixteenth call.
        Of an array of more than 4096 bytes, each call compares the next 4096; of a list of more
        than 128 items, the next 128.
        """
        for cell, value in self._cells:
            if cell.cell_contents is not value and _differ(cell.cell_contents, value):
                return True
        self._turn += 1
        entries = self._entries.values() if self._turn % _RARELY else self._all
        for mapping, key, value in entries:
            found = mapping.get(key, _NOTHING)
            if found is not value and _differ(found, value):
                return True
        for one, items in self._lists.values():
            if len(one) != len(items) or any(a is not b for a, b in zip(one, items, strict=True)):
                return True
        for array, content in self._arrays.values():
            if array.tobytes() != content:
                return True
        for one, items in self._long.values():
            start = self._turn % -(-len(items) // _ITEMS) * _ITEMS
            some = slice(start, start + _ITEMS)
            if len(one) != len(items):
                return True
            if any(a is not b for a, b in zip(one[some], items[some], strict=True)):
                return True
        for array, content in self._large.values():
            pieces = -(-len(content) // _PIECE)
            first, size = self._turn % pieces * _PIECE, array.itemsize
            piece = array.flat[first // size : -(-(first + _PIECE) // size)].tobytes()
            start = first // size * size
            if piece != content[start : start + len(piece)]:
                return True
        return False

    def _watch(
        self, owner: object, mapping: Mapping[Any, Any], key: object, value: object,
        is_code: bool = False,
    ) -> None:
        """Note an entry of a mapping that belongs to this owner."""
        code = is_code or isinstance(value, _CODE)
        (self._code if code else self._entries)[id(owner), key] = mapping, key, value

    def _follow(self, value: object, names: frozenset[str], depth: int) -> None:
        """Note a value that a function reads which uses these names of attributes."""
        if isinstance(value, _CONSTANT) or depth > _DEEPEST or len(self._followed) > _MOST:
            return
        known = self._followed.get(id(value), (value, None))[1]
        if known is not None and names <= known:
            return
        self._followed[id(value)] = value, names | (known or frozenset())
        deeper = depth + 1
        if isinstance(value, types.FunctionType):
            self._follow_function(value, deeper)
            self._follow(getattr(value, "__wrapped__", None), names, deeper)
        elif isinstance(value, types.MethodType):
            own = names | _names(value.__func__)
            self._follow(value.__func__, names, deeper)
            self._follow(value.__self__, own, deeper)
        elif isinstance(value, functools.partial):
            for part in (value.func, value.args, value.keywords):
                self._follow(part, names, deeper)
        elif isinstance(value, np.ndarray):
            if value.dtype.kind in "fiubc":
                arrays = self._arrays if value.nbytes <= _PIECE else self._large
                arrays[id(value)] = value, value.tobytes()
        elif isinstance(value, list):
            lists = self._lists if len(value) <= _ITEMS else self._long
            lists[id(value)] = value, tuple(value)
            self._follow_all(value, names, deeper)
        elif isinstance(value, tuple):
            self._follow_all(value, names, deeper)
        elif isinstance(value, dict):
            for key, one in value.items():
                self._watch(value, value, key, one)
            self._follow_all(list(value.values()), names, deeper)
        elif not isinstance(value, types.ModuleType) or not _is_library(value.__dict__):
            called = frozenset(["__call__"] if callable(value) else [])
            self._follow_object(value, names | called, deeper)

    def _follow_all(self, values: Sequence[Any], names: frozenset[str], depth: int) -> None:
        if len(values) <= _MOST:
            for one in values:
                self._follow(one, names, depth)

    def _follow_function(self, function: types.FunctionType, depth: int) -> None:
        names, ours = _names(function), _is_library_name(function.__module__ or "")
        for cell in function.__closure__ or ():
            try:
                value = cell.cell_contents
            except ValueError:  # empty as yet
                continue
            if not ours:
                self._cells.append((cell, value))
            self._follow(value, names, depth)
        self._follow(function.__defaults__ or (), names, depth)
        self._follow(function.__kwdefaults__ or {}, names, depth)
        everything = function.__globals__
        if not _is_library(everything):
            for name in names & everything.keys():
                self._watch(everything, everything, name, everything[name])
                self._follow(everything[name], names, depth)

    def _follow_object(self, value: object, names: frozenset[str], depth: int) -> None:
        """Note the attributes of an object, a class or a module that have such names."""
        own: Mapping[str, Any] = getattr(value, "__dict__", {})
        ours = _is_library_name(type(value).__module__) and not isinstance(value, types.ModuleType)
        for name in names.intersection(own):
            if not ours:
                self._watch(own, own, name, own[name])
            self._follow(own[name], names, depth)
        for kind in () if isinstance(value, types.ModuleType) else type(value).__mro__:
            if _is_library_name(kind.__module__):
                continue
            shared = vars(kind)
            for name in names.intersection(shared):
                found = shared[name]
                self._watch(kind, shared, name, found)
                if name not in own:  # which would hide it
                    self._watch(own, own, name, _NOTHING, isinstance(found, _CODE))
                if isinstance(found, property):
                    found = found.fget
                if isinstance(found, types.FunctionType):
                    found = types.MethodType(found, value)
                self._follow(found, names, depth)


class Due(enum.Enum):
    """Where traces are to be compared with their functions."""

    NOWHERE = enum.auto()
    #: At the observer's state.
    HERE = enum.auto()
    #: There, and at points of several magnitudes: what the functions read has changed.
    EVERYWHERE = enum.auto()


class ComparisonTimes:
    """When traces are compared with their functions again.

    Where values that the functions read have changed, a comparison is due. Up to 8 values are
    looked at before each sample; more of them before every second one, third one and so on, so that
    no sample waits long. From the fifth comparison on that finds no difference, the next look comes
    after twice as many samples as the last: the values change at each sample. Functions may also
    depend on what cannot be seen, so they are called after each 1000 samples where the estimator is
    not bound to a time.

    Parameters
    ----------
    functions : iterable of callable
        The functions; without any, nothing is ever due.
    calls : bool
        Whether the functions may be called after each 1000 samples.

    Attributes
    ----------
    next : float
        The time of the next sample at which to ask `due`.
    """

    def __init__(self, functions: Iterable[Callable[..., Any]], calls: bool) -> None:
        known = tuple(functions)
        self._captured, self._calls = Captured(known), calls
        self.next: float = 0 if known else math.inf
        self._looks, self._called = max(1, self._captured.count // _SHARE), 0
        self._fruitless = 0

    def due(self, time: int) -> Due:
        """Where to compare before the sample of this time; call `compared` after it."""
        if self._captured.changed():
            self._fruitless += 1
            if self._fruitless > _FRUITLESS:
                self._looks = min(2 * self._looks, _CALLS)
            return Due.EVERYWHERE
        if self._calls and time // _CALLS > self._called:
            return Due.HERE
        self.next = time + self._looks if self._captured.count else self._next_call(time)
        return Due.NOWHERE

    def compared(self, time: int) -> None:
        """Note that the functions agreed with their traces before the sample of this time."""
        if self._captured.changed():  # before, or by the call itself
            self._captured.renew()
        self._called = time // _CALLS
        self.next = time + self._looks

    def _next_call(self, time: int) -> float:
        """The time of the next call of functions of which nothing can be seen."""
        return (time // _CALLS + 1) * _CALLS if self._calls else math.inf

    def restart(self, time: int = 0) -> None:
        """Go on from this time, which may be an earlier one."""
        self._called = time // _CALLS
        self.next = min(self.next, time)

    def end(self) -> None:
        """Compare no more: no trace is used any longer."""
        self.next = math.inf


def _differ(one: object, other: object) -> bool:
    """Whether objects differ that are not the same one; equal numbers do not."""
    return type(one) is not type(other) or not isinstance(one, _CONSTANT) or one != other


@functools.lru_cache(maxsize=1024)
def _names_in(code: types.CodeType) -> frozenset[str]:
    """The names of globals and attributes in a function's code, and in that of its own ones."""
    found = frozenset(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            found |= _names_in(constant)
    return found


def _names(function: object) -> frozenset[str]:
    code = getattr(function, "__code__", None)
    return _names_in(code) if isinstance(code, types.CodeType) else frozenset()


def _is_library(module: Mapping[str, Any]) -> bool:
    """Whether a module's names belong to the standard library, an installed package or this one."""
    name, file = module.get("__name__", ""), module.get("__file__")
    if file is None:
        return name not in ("", "__main__")  # built in, but for what a session runs in
    return _is_library_name(name) or str(file).startswith(_LIBRARIES)


@functools.lru_cache(maxsize=1024)
def _is_library_name(name: str) -> bool:
    first = name.partition(".")[0]
    if first == __name__.partition(".")[0] or first == "builtins":
        return True
    file = getattr(sys.modules.get(first), "__file__", None)
    return file is not None and file.startswith(_LIBRARIES)
