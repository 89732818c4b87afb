"""Traces of users' functions: the expressions that they compute, in CasADi.

Symbols refuse whatever asks for a value, even where the function catches the exception. A function
that tells symbols from numbers in another way, and then computes something else, is found by
comparison: estimators compare a trace with its function again and again, and certificates do so in
each cell of a proof.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import shown

from .operations import ExpressionRecord
from .points import ALL
from .points import arguments as arguments_at
from .products import MOST_OF_EACH, Products
from .stand_ins import numpy_on_symbols
from .symbols import INSTEAD, NotTraceableError, place, plain, run

Array = NDArray[np.float64]


class Traced(NamedTuple):
    """A function's CasADi form, or why it has none.

    Attributes
    ----------
    function : casadi.Function or None
        Of columns (size, 1), one for each argument, to one dense column: the entries of the
        function's value row by row. Of scalar operations (SX) alone, unless ``products`` were
        wanted (see `expressed`).
    reason : str
        Why there is no function; blank if there is one.
    shape : tuple of int
        The shape of the value; () without a function.
    original, points : callable and sequence, or None
        What was traced, and where it was compared.
    made_of : Traced or None
        The trace that this function was made of, if it is no trace itself.
    """

    function: Any
    reason: str
    shape: tuple[int, ...] = ()
    original: Callable[..., Any] | None = None
    points: Sequence[Sequence[Array]] | None = None
    made_of: Any = None

    @property
    def user_function(self) -> Callable[..., Any] | None:
        """What was traced, or what this function was made of."""
        one: Traced = self if self.made_of is None else self.made_of
        return one.original

    def fault(self, k: int | None) -> str:
        """Where the traced function now differs from its trace; blank if nowhere.

        Compares at one of the points, another one for each k, or at all without k.
        """
        one: Traced = self if self.made_of is None else self.made_of
        if one.function is None or one.original is None or not one.points:
            return ""
        points = one.points if k is None else [one.points[k % len(one.points)]]
        return difference(one, one.original, points)


def traced(
    function: Callable[..., Any],
    sizes: Sequence[int],
    points: Sequence[Sequence[Array]] | None = None,
    *,
    name: str = "traced",
) -> Traced:
    """The CasADi form of a function of NumPy vectors, if one gives the same numbers.

    The function is called once, with symbols. It is refused if it needs a symbol's value: in a
    branch, a loop or an index, in ``float()``, or in a function without CasADi form. Then trace and
    function are compared at many points, where both must agree up to rounding, or both fail or not
    be finite. This detects random numbers, the time, and states kept between calls. Never raises.

    Parameters
    ----------
    function : callable
        Of one vector for each of ``sizes``, to an array, a list or a number.
    sizes : sequence of int
        The lengths of its arguments, all of shape (size,).
    points : sequence, optional
        Where to compare: a sequence of arguments for each point, of usual magnitudes. Left out,
        random numbers of several magnitudes around one.
    name : str
        The name of the CasADi function.

    Examples
    --------
    >>> import numpy as np
    >>> traced(lambda x, u: np.array([x[1], u[0] - np.sin(x[0])]), (2, 1)).function
    Function(traced:(i0[2],i1)->(o0[2]) SXFunction)
    """
    found = expressed(function, sizes, name)
    if found.function is None:
        return found
    points = list(arguments_at(ALL, tuple(sizes))) if points is None else points
    reason = difference(found, function, points)
    return Traced(None, reason) if reason else found._replace(original=function, points=points)


def expressed(
    function: Callable[..., Any], sizes: Sequence[int], name: str = "traced",
    products: bool = False,
) -> Traced:
    """The expression that a function computes from symbols, not compared with the function yet.

    With ``products``, a product with a large constant matrix is one operation.
    """
    import casadi  # late: `import qpmhe` does without

    columns = [casadi.SX.sym(f"a{k}", size) for k, size in enumerate(sizes)]
    for deeper in (False, True):  # a model that needs no more is traced without
        made = Products()
        record = ExpressionRecord(casadi, made if products else None)
        record.most_operations = max(record.most_operations, MOST_OF_EACH * sizes[0])
        with numpy_on_symbols(record, deeper):
            value, error = run(record, function, [record.symbols(one) for one in columns])
        if error is None and not record.refused:
            break
        record.closed = not deeper
    try:
        if error is not None and not record.refused:
            return Traced(None, _failure(error))
        if not record.refused:
            if isinstance(value, np.ma.MaskedArray):
                return Traced(None, "it returns a masked array; write numpy.where(mask, a, b)")
            values = np.asarray(plain(value))
            if values.dtype.kind not in "fiubO":
                return Traced(None, f"it returns {values.dtype}; expected numbers")
            column = record.column(values)
    except Exception:  # of a ragged list, or of entries that are no numbers
        if value is None or not record.refused:
            return Traced(None, f"it returns a {type(value).__name__} that is no array of numbers")
    finally:
        record.closed = True
    if record.refused:
        return Traced(None, record.reason)
    return Traced(made.function(name, columns, column), "", values.shape)


def _failure(error: BaseException) -> str:
    """What a function raised on symbols, and where."""
    if isinstance(error, NotTraceableError):
        return str(error)
    frames = [one for one, _ in traceback.walk_tb(error.__traceback__)]
    where = place(frames[-1]) if frames else ""
    text = f"raises {type(error).__name__} on symbols: {error}{INSTEAD}"
    return f"{where} {text}" if where else f"it {text}"


# Relative change of the arguments that shows how rounding spreads, its weight, and the share of
# a value that is rounding in any case.
_NUDGE, _WEIGHT, _ROUNDING = 1e-13, 300.0, 1e-11


def difference(
    found: Traced, function: Callable[..., Any], points: Sequence[Sequence[Array]]
) -> str:
    """Where a trace and its function differ by more than rounding; blank where they do not."""
    nudge, repeated = np.random.default_rng(0), False
    for point in points:
        arguments = [np.asarray(one, np.float64) for one in point]
        mine = np.array(found.function(*arguments)).reshape(found.shape)
        theirs = _called(function, arguments)
        finite = theirs is not None and bool(np.isfinite(theirs).all())
        if finite == bool(np.isfinite(mine).all()):
            if not finite:
                continue
            assert theirs is not None
            again = theirs if repeated else _called(function, arguments)
            repeated = True
            if again is None or not np.array_equal(theirs, again):
                return f"it returns other values when it is called again at {_shown(arguments)}"
            if theirs.shape == mine.shape:
                gap = np.abs(mine - theirs)
                if (gap <= _ROUNDING * np.abs(theirs)).all():
                    continue
                moved = [one * (1.0 + _NUDGE * nudge.uniform(-1, 1, one.size)) for one in arguments]
                other = _called(function, moved)
                spread = np.inf if other is None else np.abs(other - theirs)
                if (gap <= _ROUNDING * np.abs(theirs) + _WEIGHT * np.nan_to_num(spread)).all():
                    continue
        result = "an error" if theirs is None else shown(theirs.tolist())
        return (
            f"it returns {result} at {_shown(arguments)}, but the same expression of symbols is "
            f"{shown(mine.tolist())}: it depends on more than its arguments, or on their types"
        )
    return ""


def unmasked(value: Any) -> Any:
    """The same with NaN for what is masked: there is no value."""
    if not isinstance(value, np.ma.MaskedArray):
        return value
    return value if value.dtype == np.object_ else np.ma.filled(value.astype(np.float64), np.nan)


def _shown(arguments: Sequence[Array]) -> str:
    return ", ".join(shown(one.tolist()) for one in arguments if one.size)


def _called(function: Callable[..., Any], arguments: Sequence[Array]) -> Array | None:
    """The function's value, a copy; None where it raises."""
    try:
        with np.errstate(all="ignore"):
            return np.array(unmasked(function(*(one.copy() for one in arguments))), np.float64)
    except KeyboardInterrupt:
        raise
    except BaseException:  # outside of its domain
        return None
