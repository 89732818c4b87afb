"""Symbols in place of numbers: what a function does with its arguments whatever their values are.

A function that returns when it is called on symbols has no branch on a value, no loop over
values and no table look-up by one: it computes the same expression everywhere. Symbols carry
labels, which shows in addition whether it keeps the states of a batch apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.uint64]

# A function that does more with single symbols than this is not traced any further.
_MOST_OPERATIONS = 200_000


class NotTraceableError(Exception):
    """The function asks for the value of a symbol."""


class _Record:
    """What happened during one trace, which all of its symbols share."""

    def __init__(self) -> None:
        #: Whether a value was asked for. It stays so, whatever the function catches.
        self.refused = False
        #: Whether the trace is over: a symbol that the function kept then acts as NaN.
        self.closed = False
        self._operations = 0

    def refuse(self) -> NotTraceableError:
        self.refused = True
        return NotTraceableError("a symbol has no value")

    def symbol(self, labels: int) -> Symbol:
        self._operations += 1
        if self._operations > _MOST_OPERATIONS:
            raise self.refuse()
        return Symbol(self, labels)

    def symbols(self, labels: Any) -> Any:
        """A symbol, or an array of symbols, with these labels."""
        labels = np.asarray(labels)
        if labels.ndim == 0:
            return Symbol(self, int(labels))
        array = np.frompyfunc(lambda one: Symbol(self, one), 1, 1)(labels).view(SymbolArray)
        array.record = self
        return array


_NUMBERS = (bool, int, float, complex, np.generic)


def _operation(self: Symbol, *others: Any) -> Any:
    labels = self.labels
    for other in others:
        if isinstance(other, Symbol):
            labels |= other.labels
        elif not isinstance(other, _NUMBERS):
            return NotImplemented
    return float("nan") if self.record.closed else self.record.symbol(labels)


def _comparison(self: Symbol, other: Any) -> Any:
    return False if self.record.closed else _operation(self, other)


def _value(self: Symbol, *_: Any) -> float:
    if self.record.closed:
        return float("nan")
    raise self.record.refuse()


class Symbol:
    """A number without a value; `labels` says which arguments it was computed from."""

    __slots__ = ("labels", "record")

    def __init__(self, record: _Record, labels: int) -> None:
        self.record, self.labels = record, labels

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _operation
    __truediv__ = __rtruediv__ = __floordiv__ = __rfloordiv__ = __mod__ = __rmod__ = _operation
    __pow__ = __rpow__ = __neg__ = __pos__ = __abs__ = __invert__ = _operation
    __and__ = __rand__ = __or__ = __ror__ = __xor__ = __rxor__ = _operation
    conjugate = item = _operation
    __lt__ = __le__ = __gt__ = __ge__ = _comparison
    __eq__ = __ne__ = _comparison
    __float__ = _value
    __int__ = __index__ = __complex__ = __round__ = __trunc__ = _value
    __floor__ = __ceil__ = __hash__ = __reduce__ = _value  # type: ignore[assignment]

    def __bool__(self) -> bool:
        return bool(_value(self))

    def __copy__(self) -> Symbol:
        return self

    def __deepcopy__(self, memo: Any) -> Symbol:
        return self

    @property
    def real(self) -> Symbol:
        """Return the symbol itself: a state is real."""
        return self

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply(self.record, ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _call(self.record, function, args, kwargs)


class SymbolArray(np.ndarray[Any, Any]):
    """An array of symbols, which NumPy's functions take and return."""

    record: _Record = _Record()

    def __array_finalize__(self, source: Any) -> None:
        self.record = getattr(source, "record", SymbolArray.record)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply(self.record, ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _call(self.record, function, args, kwargs)

    def __getitem__(self, key: Any) -> Any:
        if not self.record.closed and _holds_symbols(key):
            raise self.record.refuse()
        return _wrapped(self.record, _plain(self)[key])

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self.record.closed and _holds_symbols(key):
            raise self.record.refuse()
        _plain(self)[key] = _plain(value)

    def dot(self, other: Any, out: Any = None) -> Any:
        """Return `np.dot(self, other)`, which the symbol records."""
        return np.dot(self, other) if out is None else np.dot(self, other, out)

    def _refuse(self, *_: Any) -> Any:
        raise self.record.refuse()

    tobytes: Any = _refuse
    tofile: Any = _refuse
    __reduce__: Any = _refuse
    __array_interface__: Any = property(_refuse)
    data: Any = property(_refuse)


def _holds_symbols(value: Any) -> bool:
    if isinstance(value, (tuple, list)):
        return any(_holds_symbols(item) for item in value)
    return isinstance(value, Symbol) or getattr(value, "dtype", None) == np.object_


def _plain(value: Any) -> Any:
    if isinstance(value, SymbolArray):
        return value.view(np.ndarray)
    if isinstance(value, (tuple, list)):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value


def _as_arrays(value: Any) -> Any:
    """The same in plain arrays, which NumPy's functions do not hand back to a symbol."""
    if isinstance(value, Symbol):
        array = np.empty((), np.object_)
        array[()] = value
        return array
    if isinstance(value, (tuple, list)):
        return type(value)(_as_arrays(item) for item in value)
    return _plain(value)


def _as_nan(value: Any) -> Any:
    """The same with NaN for symbols, of a trace that is over."""
    if isinstance(value, Symbol):
        return float("nan")
    if isinstance(value, SymbolArray):
        return np.full(value.shape, np.nan)
    if isinstance(value, (tuple, list)):
        return type(value)(_as_nan(item) for item in value)
    if isinstance(value, dict):
        return {key: _as_nan(item) for key, item in value.items()}
    return value


def _wrapped(record: _Record, value: Any) -> Any:
    if isinstance(value, (tuple, list)):
        return type(value)(_wrapped(record, item) for item in value)
    if isinstance(value, np.ndarray) and value.dtype == np.object_:
        value = value.view(SymbolArray)
        value.record = record
    return value


_labels_of = np.frompyfunc(lambda one: one.labels if isinstance(one, Symbol) else 0, 1, 1)


def _labels(value: Any) -> Labels:
    array = np.asarray(_plain(value))
    if array.dtype == np.object_:
        return np.asarray(_labels_of(array), dtype=np.uint64)
    return np.zeros(array.shape, np.uint64)


def _together(values: Sequence[Any]) -> Any:
    """Labels of what is computed elementwise from all of these."""
    found: Any = np.uint64(0)
    for value in values:
        found = found | _labels(value)
    return found


def _contracted(record: _Record, left: Any, right: Any) -> Any:
    """Labels of a matrix product."""
    a, b = _labels(left), _labels(right)
    if a.ndim == 0 or b.ndim == 0 or a.shape[-1] != b.shape[-2 if b.ndim > 1 else -1]:
        raise record.refuse()
    rows = np.bitwise_or.reduce(a, axis=-1)
    columns = np.bitwise_or.reduce(b, axis=-2 if b.ndim > 1 else -1)
    if a.ndim > 1 and b.ndim > 1:
        rows, columns = rows[..., :, None], columns[..., None, :]
    return rows | columns


def _apply(
    record: _Record, ufunc: Any, method: str, inputs: tuple[Any, ...], options: dict[str, Any]
) -> Any:
    """Apply one of NumPy's elementwise functions, or a matrix product."""
    if record.closed:
        return getattr(ufunc, method)(*_as_nan(inputs), **_as_nan(options))
    out = options.get("out")
    if options.get("where", True) is not True:
        raise record.refuse()
    if method == "__call__" and ufunc is np.matmul:
        labels = _contracted(record, *inputs)
    elif ufunc.signature is not None:
        raise record.refuse()
    elif method == "__call__":
        labels = _together(inputs)
    elif method == "reduce":
        axis, keepdims = options.get("axis", 0), options.get("keepdims", False)
        labels = np.bitwise_or.reduce(_labels(inputs[0]), axis=axis, keepdims=keepdims)
    elif method == "accumulate":
        labels = np.bitwise_or.accumulate(_labels(inputs[0]), axis=options.get("axis", 0))
    elif method == "outer":
        labels = np.bitwise_or.outer(*(_labels(one) for one in inputs))
    else:
        raise record.refuse()
    value = record.symbols(labels)
    if out is not None and any(one is not None for one in out):
        if ufunc.nout > 1 or not isinstance(out[0], SymbolArray):
            raise record.refuse()
        out[0][...] = value
        return out[0]
    return value if ufunc.nout == 1 else (value,) * ufunc.nout


def _select(condlist: Any, choicelist: Any, default: Any = 0) -> Any:
    return _together((*condlist, *choicelist, default))


def _interp(x: Any, xp: Any, fp: Any, left: Any = 0, right: Any = 0, period: Any = 0) -> Any:
    table = np.bitwise_or.reduce(_together((xp, fp)), axis=None)
    return _together((x, left, right, period)) | table


def _norm(x: Any, *_: Any, axis: Any = None, keepdims: Any = False, **__: Any) -> Any:
    return np.bitwise_or.reduce(_labels(x), axis=axis, keepdims=keepdims)


# Functions that decide by values, element by element: the labels of what they return.
_ELEMENTWISE: dict[Any, Callable[..., Any]] = {
    np.where: lambda condition, x, y: _together((condition, x, y)),
    np.clip: lambda a, a_min=0, a_max=0, **_: _together(
        [0 if one is None else one for one in (a, a_min, a_max)]
    ),
    np.round: lambda a, *_, **__: _labels(a),
    np.nan_to_num: lambda x, **_: _labels(x),
    np.select: _select,
    np.interp: _interp,
    np.linalg.norm: _norm,
}


def _call(
    record: _Record, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """Call any other function of NumPy."""
    if record.closed:
        return function(*_as_nan(args), **_as_nan(kwargs))
    if function in _ELEMENTWISE:
        try:
            labels = _ELEMENTWISE[function](*args, **kwargs)
        except TypeError as error:  # arguments that are rarely given
            raise record.refuse() from error
        return record.symbols(labels)
    if function is np.dot and not kwargs and len(args) == 2 and all(
        0 < np.ndim(_plain(one)) < 3 for one in args
    ):
        return record.symbols(_contracted(record, *args))
    # On plain arrays, NumPy's own code moves symbols about, and computes with them one by one.
    return _wrapped(
        record,
        function(*_as_arrays(args), **{key: _as_arrays(one) for key, one in kwargs.items()}),
    )


def trace(function: Callable[..., Any], arguments: Sequence[Labels]) -> Labels | None:
    """Call a function on symbols."""
    record = _Record()
    given = [record.symbols(labels) for labels in arguments]
    before = [one.view(np.ndarray).copy() for one in given]
    for one in given:
        one.flags.writeable = False
    try:
        with np.errstate(all="ignore"):
            value = function(*given)
        labels = _labels(value)
    except KeyboardInterrupt:
        raise
    except BaseException:  # whatever it does with symbols, it may work on numbers
        return None
    finally:
        record.closed = True
    unchanged = all(
        all(a is b for a, b in zip(old.flat, new.view(np.ndarray).flat, strict=True))
        for old, new in zip(before, given, strict=True)
    )
    return labels if unchanged and not record.refused else None
