"""NumPy's functions in CasADi's operations, for symbols that carry expressions.

Only functions whose CasADi form gives the same numbers, NaN included, are here; any other ends
the trace.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import contractions
from .forms import forms
from .products import LEAST, Products
from .stand_ins import MakingRecord, with_symbols, without_symbols
from .symbols import INSTEAD, NUMBERS, NotTraceableError, Symbol, SymbolArray, flat, plain

Objects = NDArray[np.object_]

# A table with more points than this would be a long expression.
_MOST_POINTS = 200
_LOGICAL = {
    "less", "less_equal", "greater", "greater_equal", "equal", "not_equal", "logical_and",
    "logical_or", "logical_not", "logical_xor",
}
# What truth values become where both operands are some.
_OF_TRUTHS = {
    "add": "logical_or", "multiply": "logical_and", "maximum": "logical_or",
    "minimum": "logical_and", "bitwise_and": "logical_and", "bitwise_or": "logical_or",
    "bitwise_xor": "logical_xor", "invert": "logical_not", "absolute": "positive",
}
_NO_FORM = f"which has no CasADi form here{INSTEAD}"
_NUMBERS_ONLY = {"bitwise_and", "bitwise_or", "bitwise_xor", "invert"}


class ExpressionRecord(MakingRecord):
    """Symbols carry scalar expressions (casadi.SX)."""

    def __init__(self, casadi: Any, products: Products | None = None) -> None:
        super().__init__()
        self.casadi = casadi
        self._product = casadi.mtimes if products is None else products.of

    @without_symbols
    def symbols(self, column: Any) -> SymbolArray:
        """An array (size,) of the entries of a column."""
        entries = self.casadi.densify(column).elements()
        array = np.empty(len(entries), np.object_)
        array[:] = [Symbol(self, one) for one in entries]
        return self.array(array)

    def expression(self, value: Any) -> Any:
        """A symbol's expression, or a number's."""
        if isinstance(value, Symbol):
            if value.record is not self:
                raise self.refuse("a symbol that was kept from elsewhere")
            return value.value
        if isinstance(value, complex):
            raise self.refuse("complex numbers")
        if value is None or not isinstance(value, NUMBERS):
            raise self.refuse(f"a {type(value).__name__} among numbers")
        number: Any = value
        return self.casadi.SX(float(number))

    @without_symbols
    def column(self, values: Any) -> Any:
        """A dense column of the entries of an array, row by row."""
        entries = [self.expression(one) for one in _objects(values).ravel()]
        return self.casadi.densify(self.casadi.vertcat(self.casadi.SX(0, 1), *entries))

    @without_symbols
    def operate(self, ufunc: Any, operands: tuple[Any, ...]) -> Any:
        """See `TraceRecord.operate`."""
        if ufunc in _PARTS:
            return tuple(self.operate(one, operands) for one in _PARTS[ufunc])
        name = ufunc.__name__
        truths = [
            one.logical if isinstance(one, Symbol) else isinstance(one, (bool, np.bool_))
            for one in operands
        ]
        if not any(isinstance(one, Symbol) for one in operands):
            return ufunc(*operands)
        if all(truths):
            if name in ("negative", "subtract", "sign"):
                raise self.refuse(f"numpy.{name} of truth values")
            name = _OF_TRUTHS.get(name, name)
        elif name in _NUMBERS_ONLY:
            raise self.refuse(f"numpy.{name} of numbers")
        form = forms().get(name)
        if form is None or not _is_numpys(ufunc):
            raise self.refuse(f"{_full_name(ufunc)}, {_NO_FORM}")
        logical = name in _LOGICAL or (name == "positive" and all(truths))
        return self.symbol(form(*(self.expression(one) for one in operands)), logical)

    @without_symbols
    def apply(
        self, ufunc: Any, method: str, inputs: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        """See `TraceRecord.apply`."""
        options = dict(options)
        out, mask = options.pop("out", None), options.pop("where", True)
        kind = options.pop("dtype", None)
        if kind is not None and np.dtype(kind) not in (
            (np.bool_,) if ufunc.__name__ in _LOGICAL else (np.float64, np.object_)
        ):
            raise self.refuse(f"numpy.{ufunc.__name__} with dtype {kind}")
        for name in ("casting", "order", "subok"):  # of how the numbers lie in memory
            options.pop(name, None)
        out = None if out is None or out[0] is None else out[0]
        if method == "__call__" and ufunc is np.matmul:
            value = self.product(*inputs)
        elif ufunc.signature is not None:
            raise self.refuse(f"{_full_name(ufunc)}, {_NO_FORM}")
        elif method == "__call__" and not options:
            value = self._elementwise(ufunc, inputs)
        elif method == "outer" and not options:
            a, b = (_objects(one) for one in inputs)
            value = self._elementwise(ufunc, (a.reshape(a.shape + (1,) * b.ndim), b))
        elif method == "reduce":
            value = self._reduced(ufunc, *inputs, **options)
        elif method == "accumulate" and set(options) <= {"axis"}:
            value = self._accumulated(ufunc, _objects(inputs[0]), options.get("axis", 0))
        else:
            raise self.refuse(f"numpy.{ufunc.__name__}.{method}")
        if mask is not True:
            if out is None or method != "__call__":
                raise self.refuse(f"numpy.{ufunc.__name__} with where, but without out")
            value = self.choice(mask, value, plain(out).copy())
        if out is not None:
            if not isinstance(out, SymbolArray):
                raise self.refuse("symbols in an array of numbers, as out")
            plain(out)[...] = plain(value)
            return out
        return value

    def call(self, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """See `TraceRecord.call`."""
        form = _FUNCTIONS.get(function)
        if form is not None:
            try:
                return without_symbols(form)(self, *args, **kwargs)
            except TypeError as error:  # arguments that are rarely given
                raise self.refuse(f"numpy.{function.__name__} with such arguments") from error
        # NumPy's own code, which comes back here for each elementwise function.
        array = self.array(np.zeros(0))
        args, kwargs = self._in_arrays(args), self._in_arrays(kwargs)
        value = np.ndarray.__array_function__(
            array, function, (SymbolArray,), args, kwargs
        )
        return self.finished(value)

    @without_symbols
    def made(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        """An array that the function makes: of objects where it would be of real numbers."""
        if arguments and isinstance(arguments[0], SymbolArray):
            given = arguments[0]
            kind = options.get("dtype", arguments[1] if len(arguments) > 1 else None)
            return given.astype(np.float64 if kind is None else kind) if (
                kind is not None or function.__name__ == "array"
            ) else given
        before = self.reason
        try:
            value = function(*arguments, **options)
        except (NotTraceableError, ValueError):
            # With a dtype, say, or in a list of lists: what it would be without it.
            kind = options.get("dtype", arguments[1] if len(arguments) > 1 else None)
            if self.reason == before or kind is None or np.dtype(kind) != np.float64:
                raise
            value = function(arguments[0], dtype=np.object_)
            self.reason = before
        if isinstance(value, np.ndarray) and value.dtype in (np.float64, np.object_):
            return self.array(value.astype(np.object_))
        return value

    def _in_arrays(self, value: Any) -> Any:
        """The same with arrays of no dimension in place of symbols."""
        if isinstance(value, Symbol):
            return self.array(_objects(value))
        if isinstance(value, (tuple, list)):
            return type(value)(self._in_arrays(one) for one in value)
        if isinstance(value, dict):
            return {key: self._in_arrays(one) for key, one in value.items()}
        return value

    @without_symbols
    def finished(self, value: Any) -> Any:
        """What goes back to the function: arrays of this trace, and symbols alone."""
        if isinstance(value, (tuple, list)):
            return type(value)(self.finished(one) for one in value)
        if isinstance(value, np.dtype) and value == np.object_:
            return np.dtype(np.float64)
        if isinstance(value, np.ndarray) and value.dtype == np.object_:
            return value[()] if value.ndim == 0 else self.array(flat(value))
        return value

    def _elementwise(self, ufunc: Any, inputs: Sequence[Any]) -> Any:
        arrays = [_objects(one) for one in inputs]
        parts = _PARTS.get(ufunc)
        if parts is not None:
            return tuple(self._elementwise(one, inputs) for one in parts)
        if ufunc.nout != 1:
            raise self.refuse(f"{_full_name(ufunc)}, {_NO_FORM}")
        each = np.frompyfunc(lambda *one: self.operate(ufunc, one), len(arrays), 1)
        return self.finished(np.asarray(each(*arrays), np.object_))

    def _reduced(
        self, ufunc: Any, values: Any, axis: Any = 0, keepdims: bool = False, initial: Any = None,
    ) -> Any:
        array = _objects(values)
        axes = range(array.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
        chosen = sorted(one % array.ndim for one in axes) if array.ndim else []
        kept = [one for one in range(array.ndim) if one not in chosen]
        lead = tuple(array.shape[one] for one in kept)
        count = math.prod(array.shape[one] for one in chosen)
        moved = array.transpose(kept + chosen).reshape(*lead, count)
        if initial is None or initial is np._NoValue:
            initial = ufunc.identity
        start = [] if initial is None else [initial]
        found = np.empty(lead, np.object_)
        for index in np.ndindex(lead):
            entries = [*start, *moved[index]] if not count or ufunc.identity is None else (
                list(moved[index]) if initial == ufunc.identity else [*start, *moved[index]]
            )
            if not entries:
                raise self.refuse(f"numpy.{ufunc.__name__} of nothing")
            found[index] = functools.reduce(
                lambda a, b: self.operate(ufunc, (a, b)), self._counted(ufunc, entries)
            )
        if keepdims:
            found = found.reshape([
                1 if one in chosen else size for one, size in enumerate(array.shape)
            ])
        return self.finished(found)

    def _counted(self, ufunc: Any, entries: list[Any]) -> list[Any]:
        """Truth values as numbers, where they are added up or multiplied."""
        if ufunc not in (np.add, np.multiply):
            return entries
        return [
            Symbol(self, one.value) if isinstance(one, Symbol) else one for one in entries
        ]

    def _accumulated(self, ufunc: Any, array: Objects, axis: int) -> Any:
        moved = np.moveaxis(array, axis, -1)
        found = np.empty(moved.shape, np.object_)
        for index in np.ndindex(moved.shape[:-1]):
            entries = self._counted(ufunc, list(moved[index]))
            found[index] = list(
                itertools.accumulate(entries, lambda a, b: self.operate(ufunc, (a, b)))
            )
        return self.finished(np.moveaxis(found, -1, axis))

    @without_symbols
    def product(self, left: Any, right: Any) -> Any:
        """A matrix product."""
        a, b = _objects(left), _objects(right)
        if not (0 < a.ndim < 3 and 0 < b.ndim < 3):
            return self.finished(np.asarray(np.matmul(a, b), np.object_))
        if a.shape[-1] != b.shape[0]:
            raise ValueError(f"matmul of shapes {a.shape} and {b.shape}")
        shape = (*a.shape[:-1], *b.shape[1:])
        if not (a.size and b.size):
            return np.zeros(shape)
        # In CasADi itself: quicker than entry by entry.
        rows, columns = np.atleast_2d(a), b.reshape(b.shape[0], -1)
        found = self._product(self.matrix(rows), self.matrix(columns))
        return self.from_matrix(found, shape)

    @without_symbols
    def matrix(self, values: Any) -> Any:
        """A CasADi matrix of a 2-d array, sparse if it is of numbers."""
        array = _objects(values)
        if not any(isinstance(one, Symbol) for one in array.flat):
            return self.casadi.sparsify(self.casadi.DM(array.astype(np.float64)))
        return self.casadi.reshape(self.column(array.T), *array.shape)

    @without_symbols
    def from_matrix(self, matrix: Any, shape: tuple[int, ...]) -> Any:
        """An array of this shape with the entries of a CasADi matrix, or one symbol."""
        entries = self.symbols(self.casadi.vec(matrix.T))
        return self.finished(plain(entries).reshape(shape))

    @without_symbols
    def choice(self, condition: Any, chosen: Any, other: Any) -> Any:
        """See `TraceRecord.choice`."""
        def choose(truth: Any, a: Any, b: Any) -> Any:
            if not isinstance(truth, Symbol):
                return a if truth else b
            logical = all(
                one.logical if isinstance(one, Symbol) else isinstance(one, (bool, np.bool_))
                for one in (a, b)
            )
            is_true = truth.value if truth.logical else truth.value != 0
            value = self.casadi.if_else(is_true, self.expression(a), self.expression(b))
            return self.symbol(value, logical)

        each = np.frompyfunc(choose, 3, 1)
        arrays = (_objects(one) for one in (condition, chosen, other))
        return self.finished(np.asarray(each(*arrays), np.object_))


def _objects(value: Any) -> Objects:
    """A plain array of objects, each a symbol or a number of Python."""
    if isinstance(value, Symbol):
        array = np.empty((), np.object_)
        array[()] = value
        return array
    array = np.asarray(plain(value))
    if array.dtype == np.object_:
        return array
    if array.dtype.kind not in "fiub":
        return np.asarray(array, np.object_)
    return array.astype(np.object_)


def _is_numpys(ufunc: Any) -> bool:
    """Whether it is NumPy's function of its name, or SciPy's, and nobody's of the same name."""
    name = ufunc.__name__
    if getattr(np, name, None) is ufunc or (name == "clip" and ufunc.nin == 3):
        return True
    from scipy import special  # of whoever has passed us a ufunc that is not NumPy's

    return name in ("expit", "erf", "logit") and getattr(special, name) is ufunc


def _full_name(ufunc: Any) -> str:
    known = getattr(np, ufunc.__name__, None) is ufunc
    return f"numpy.{ufunc.__name__}" if known else ufunc.__name__


_PARTS: dict[Any, tuple[Any, ...]] = {np.divmod: (np.floor_divide, np.remainder)}


def _no_nan(record: ExpressionRecord, *_: Any, **__: Any) -> Any:
    # NumPy's own code takes objects for numbers that are never NaN.
    raise record.refuse(f"numpy.isnan, {_NO_FORM}")


def _like(record: ExpressionRecord, a: Any, value: Any, dtype: Any, shape: Any) -> Any:
    kind = np.dtype(np.float64 if dtype is None else dtype)
    size = np.shape(_objects(a)) if shape is None else shape
    if kind not in (np.float64, np.object_):
        return np.full(size, value, kind)
    found = np.empty(size, np.object_)
    found[...] = _objects(value)
    return record.array(found)


def _piecewise(
    record: ExpressionRecord, x: Any, condlist: Any, funclist: Any, *args: Any, **kw: Any
) -> Any:
    array = record.array(_objects(x))
    single = not isinstance(condlist, (list, tuple, np.ndarray)) or (
        array.ndim and not isinstance(condlist[0], (list, np.ndarray))
    )
    conditions = [condlist] if single else list(condlist)
    if len(funclist) - len(conditions) not in (0, 1):
        raise ValueError(f"{len(conditions)} conditions for {len(funclist)} functions")
    found = np.zeros(array.shape)
    # The last condition that holds decides, and the function without one where none holds.
    rest = funclist[len(conditions):] or [0.0]
    for condition, one in zip([True, *conditions], [*rest, *funclist], strict=False):
        value = with_symbols(record, one)(array, *args, **kw) if callable(one) else one
        found = record.choice(condition, value, found)
    return found


def _where(record: ExpressionRecord, condition: Any, *chosen: Any) -> Any:
    if len(chosen) != 2:
        raise record.refuse("numpy.where with a condition alone; write numpy.where(mask, a, b)")
    return record.choice(condition, *chosen)


def _clipped(
    record: ExpressionRecord, a: Any, a_min: Any = None, a_max: Any = None, out: Any = None,
    *, min: Any = None, max: Any = None,
) -> Any:
    low, high = (min if a_min is None else a_min), (max if a_max is None else a_max)
    if low is not None:
        a = record.apply(np.maximum, "__call__", (a, low), {})
    if high is not None:
        a = record.apply(np.minimum, "__call__", (a, high), {})
    if out is not None:
        out[...] = a
        return out
    return a


def _selected(record: ExpressionRecord, conditions: Any, choices: Any, default: Any = 0) -> Any:
    found = default
    for condition, chosen in reversed(list(zip(conditions, choices, strict=True))):
        found = record.choice(condition, chosen, found)
    return found


def _rounded(record: ExpressionRecord, a: Any, decimals: int = 0, out: Any = None) -> Any:
    factor = 10.0**decimals
    if decimals == 0:
        found = record.apply(np.rint, "__call__", (a,), {})
    else:
        found = record.apply(np.rint, "__call__", (np.multiply(a, factor),), {}) / factor
    if out is not None:
        out[...] = found
        return out
    return found


def _interpolated(
    record: ExpressionRecord, x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None
) -> Any:
    points, values = _objects(xp).ravel(), _objects(fp).ravel()
    if any(isinstance(one, Symbol) for one in points):
        raise record.refuse("numpy.interp with symbols as the points of its table")
    if not 0 < points.size <= _MOST_POINTS or points.size != values.size:
        raise record.refuse(f"numpy.interp in a table of {points.size} points")
    first = values[0] if left is None else left
    last = values[-1] if right is None else right
    # NaN stays: no comparison holds for it.
    found = record.choice(np.greater_equal(x, points[-1]), values[-1], x)
    found = record.choice(np.greater(x, points[-1]), last, found)
    for j in range(points.size - 2, -1, -1):
        slope = (values[j + 1] - values[j]) / (points[j + 1] - points[j])
        piece = slope * (x - points[j]) + values[j]
        found = record.choice(np.less(x, points[j + 1]), piece, found)
    return record.choice(np.less(x, points[0]), first, found)


def _norm(
    record: ExpressionRecord, x: Any, ord: Any = None, axis: Any = None,
    keepdims: bool = False,
) -> Any:
    array = record.array(_objects(x))
    if ord in (None, "fro") or (ord == 2 and (array.ndim == 1 or isinstance(axis, int))):
        return np.sqrt(np.sum(array * array, axis=axis, keepdims=keepdims))
    if array.ndim == 1 or isinstance(axis, int):
        if ord == 1:
            return np.sum(np.abs(array), axis=axis, keepdims=keepdims)
        if ord == np.inf:
            return np.max(np.abs(array), axis=axis, keepdims=keepdims)
    raise record.refuse(f"numpy.linalg.norm of order {ord}{INSTEAD}")


def _square(record: ExpressionRecord, a: Any) -> Any:
    array = _objects(a)
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise record.refuse(f"linear algebra with a shape {array.shape}")
    return array


def _solved(record: ExpressionRecord, a: Any, b: Any) -> Any:
    matrix, right = _square(record, a), _objects(b)
    if right.ndim not in (1, 2):
        raise record.refuse(f"numpy.linalg.solve with a shape {right.shape}")
    columns = record.matrix(right.reshape(right.shape[0], -1))
    ca = record.casadi
    found = ca.solve(ca.SX(record.matrix(matrix)), ca.SX(columns))
    return record.from_matrix(found, right.shape)


def _inverse(record: ExpressionRecord, a: Any) -> Any:
    matrix = _square(record, a)
    return record.from_matrix(record.casadi.inv(record.matrix(matrix)), matrix.shape)


def _determinant(record: ExpressionRecord, a: Any) -> Any:
    return record.from_matrix(record.casadi.det(record.matrix(_square(record, a))), ())


def _dot(record: ExpressionRecord, a: Any, b: Any, out: Any = None) -> Any:
    left, right = _objects(a), _objects(b)
    if left.ndim and right.ndim and max(left.ndim, right.ndim) < 3:
        value = record.product(left, right)
    else:
        value = record.finished(np.asarray(np.dot(left, right), np.object_))
    if out is not None:
        out[...] = value
        return out
    return value


def _cross(
    record: ExpressionRecord, a: Any, b: Any, axisa: int = -1, axisb: int = -1, axisc: int = -1,
    axis: int | None = None,
) -> Any:
    ends = (axisa, axisb, axisc) if axis is None else (axis,) * 3
    left, right = (np.moveaxis(_objects(one), end, -1) for one, end in zip((a, b), ends[:2],
                                                                           strict=True))
    if not {left.shape[-1], right.shape[-1]} <= {2, 3}:
        raise ValueError(f"cross product of shapes {left.shape} and {right.shape}")
    (a0, a1, a2), (b0, b1, b2) = (
        [record.finished(np.asarray(one[..., k])) if k < one.shape[-1] else 0.0 for k in range(3)]
        for one in (left, right)
    )
    last = a0 * b1 - a1 * b0
    if left.shape[-1] == right.shape[-1] == 2:
        return last
    parts = np.broadcast_arrays(*map(_objects, (a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, last)))
    return record.finished(np.moveaxis(np.stack(parts, axis=-1), -1, ends[2]))


def _einsum(record: ExpressionRecord, *operands: Any, **options: Any) -> Any:
    options.pop("optimize", None)
    if options:
        raise TypeError
    arrays: Any = [one if isinstance(one, (str, list)) else _objects(one) for one in operands]
    found = None
    if len(arrays) == 3 and _holds_large(arrays[1:]):
        subscripts, left, right = arrays
        names = contractions.of_subscripts(subscripts, left, right)
        found = names and contractions.product(record.product, left, right, names)
    return record.finished(np.asarray(
        np.einsum(*arrays) if found is None else plain(found), np.object_
    ))


def _tensordot(record: ExpressionRecord, a: Any, b: Any, axes: Any = 2) -> Any:
    left, right = _objects(a), _objects(b)
    names = contractions.of_axes(axes, left, right)
    found = contractions.product(record.product, left, right, names)
    return record.finished(np.asarray(
        np.tensordot(left, right, axes) if found is None else plain(found), np.object_
    ))


def _inner(record: ExpressionRecord, a: Any, b: Any) -> Any:
    left, right = _objects(a), _objects(b)
    if left.ndim and right.ndim:
        return _tensordot(record, left, right, (-1, -1))
    return record.finished(np.asarray(np.inner(left, right), np.object_))


def _holds_large(arrays: Sequence[Any]) -> bool:
    """Whether one of two arrays is of symbols, and another one of many numbers."""
    symbolic = [any(isinstance(one, Symbol) for one in array.flat) for array in arrays]
    return any(symbolic) and any(
        array.size >= LEAST and not of for array, of in zip(arrays, symbolic, strict=True)
    )


# NumPy's other functions that have a form of their own, with the record as first argument.
_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: _where, np.clip: _clipped, np.select: _selected, np.round: _rounded,
    np.around: _rounded, np.interp: _interpolated, np.linalg.norm: _norm, np.dot: _dot,
    np.linalg.solve: _solved, np.linalg.inv: _inverse, np.linalg.det: _determinant,
    np.einsum: _einsum, np.tensordot: _tensordot, np.inner: _inner, np.cross: _cross,
    np.nan_to_num: _no_nan, np.piecewise: _piecewise,
    np.zeros_like: lambda record, a, dtype=None, *_, shape=None, **__: _like(
        record, a, 0.0, dtype, shape
    ),
    np.empty_like: lambda record, prototype, dtype=None, *_, shape=None, **__: _like(
        record, prototype, 0.0, dtype, shape
    ),
    np.ones_like: lambda record, a, dtype=None, *_, shape=None, **__: _like(
        record, a, 1.0, dtype, shape
    ),
    np.full_like: lambda record, a, fill_value, dtype=None, *_, shape=None, **__: _like(
        record, a, fill_value, dtype, shape
    ),
}
