"""SciPy's splines and tables of one variable as piecewise polynomials of symbols."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .symbols import TraceRecord, flat, in_arrays

# A spline with more pieces than this would be a long expression.
_MOST_PIECES = 200


def forms() -> list[tuple[Any, Callable[..., Any]]]:
    """Classes of SciPy, and what their calls on symbols compute, with the record first."""
    from scipy import interpolate  # late: only a model that has imported it calls it

    return [
        (interpolate.PPoly, _polynomials), (interpolate.BSpline, _b_spline),
        (interpolate.interp1d, _table),
    ]


def _polynomials(
    record: TraceRecord, spline: Any, x: Any, nu: int = 0, extrapolate: Any = None
) -> Any:
    """A `scipy.interpolate.PPoly`: CubicSpline, PchipInterpolator and Akima1DInterpolator too."""
    outside = spline.extrapolate if extrapolate is None else extrapolate
    axis, spline = spline.axis, spline.derivative(nu) if nu else spline
    knots, low, high = spline.x, spline.x[0], spline.x[-1]
    if np.iscomplexobj(spline.c) or not low < high:
        raise record.refuse("a spline of complex numbers, or of decreasing points")
    at = _points(record, x, spline.c.ndim - 2)
    if outside == "periodic":
        at = low + np.remainder(at - low, high - low)
    pieces = [j for j in range(knots.size - 1) if knots[j] < knots[j + 1]]
    values = []
    for j in pieces:
        value: Any = spline.c[0, j]
        for coefficient in spline.c[1:, j]:
            value = value * (at - knots[j]) + coefficient
        values.append(value + 0.0 * at)
    found = _piecewise(record, at, knots[pieces[1:]], values, np.greater_equal)
    if not outside:
        found = _filled(record, at, found, (low, np.nan), (high, np.nan))
    return _moved(found, np.ndim(in_arrays(x)), axis)


def _b_spline(
    record: TraceRecord, spline: Any, x: Any, nu: int = 0, extrapolate: Any = None
) -> Any:
    """A `scipy.interpolate.BSpline`."""
    from scipy.interpolate import PPoly

    outside = spline.extrapolate if extrapolate is None else extrapolate
    knots = spline.t[spline.k : len(spline.t) - spline.k]  # the polynomials at the ends go on
    derivatives = [
        np.moveaxis(spline(knots[:-1], order), spline.axis, 0) / math.factorial(order)
        for order in range(spline.k, -1, -1)
    ]
    found = PPoly.construct_fast(np.array(derivatives), knots, outside, spline.axis)
    return _polynomials(record, found, x, nu)


def _table(record: TraceRecord, table: Any, x: Any) -> Any:
    """A `scipy.interpolate.interp1d`, of all kinds."""
    points, values = table.x, np.moveaxis(table.y, table.axis, 0)
    kind, rest = getattr(table, "_kind", ""), values.shape[1:]
    at, count = _points(record, x, len(rest)), np.ndim(in_arrays(x))
    if kind == "linear":
        slopes = np.diff(values, axis=0) / np.diff(points).reshape(-1, *[1] * len(rest))
        lines = [slopes[j] * (at - points[j]) + values[j] for j in range(points.size - 1)]
        found = _piecewise(record, at, points[1:-1], lines, np.greater)
    elif kind == "spline":
        found = np.reshape(_b_spline(record, table._spline, x), np.shape(at)[:count] + rest)
    elif kind in ("nearest", "nearest-up", "previous", "next"):
        limits = {"previous": points[1:], "next": points[:-1]}.get(kind)
        found = _piecewise(
            record, at, table.x_bds if limits is None else limits,
            [value + 0.0 * at for value in values],
            np.greater_equal if kind in ("nearest-up", "previous") else np.greater,
        )
    else:
        raise record.refuse("scipy.interpolate.interp1d of a kind that is not known here")
    fill = table.fill_value
    if not isinstance(fill, str):
        below, above = fill if isinstance(fill, tuple) and len(fill) == 2 else (fill, fill)
        if table.bounds_error:
            below = above = np.nan
        found = _filled(record, at, found, (points[0], below), (points[-1], above))
    return _moved(found, count, table.axis)


def _points(record: TraceRecord, x: Any, more: int) -> Any:
    """Where to evaluate, with more axes behind."""
    array = flat(np.array(in_arrays(x), np.object_))
    return record.array(array.reshape(array.shape + (1,) * more))


def _piecewise(
    record: TraceRecord, at: Any, limits: Sequence[float], values: Sequence[Any], beyond: Any
) -> Any:
    """The first of these values, and beyond each of the limits the next one."""
    if len(values) > _MOST_PIECES:
        raise record.refuse(f"a spline of {len(values)} pieces, more than {_MOST_PIECES}")
    found = values[0]
    for limit, value in zip(limits, values[1:], strict=True):
        found = record.choice(beyond(at, limit), value, found)
    return found


def _filled(
    record: TraceRecord, at: Any, found: Any, below: tuple[Any, Any], above: tuple[Any, Any]
) -> Any:
    """Other values below and above an interval."""
    found = record.choice(np.less(at, below[0]), below[1], found)
    return record.choice(np.greater(at, above[0]), above[1], found)


def _moved(found: Any, count: int, axis: int) -> Any:
    """The axes of the points in the place of the table's own, as SciPy has it."""
    axes = list(range(np.ndim(found)))
    order = axes[count : count + axis] + axes[:count] + axes[count + axis :]
    return np.transpose(found, order) if axis and count else found
