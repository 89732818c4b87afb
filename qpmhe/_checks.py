"""Checks of user input, each with one error text that names value, expectation and remedy."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import finite, integer, shown

from .errors import InvalidInputError, OptionError, ShapeError, WeightError

Array = NDArray[np.float64]


# The largest index, which counts, sizes and seeds must not exceed.
_MOST = 2**63 - 1

#: Eigenvalues of correlations below this are rounding.
SINGULAR = 1e-12


def numbers(name: str, value: ArrayLike, *, finite: bool = True) -> Array:
    """A float copy of value; real, and finite unless stated otherwise.

    NaN stands for None, pandas' NA and NaT, and what is masked.
    """
    try:
        array = _floats(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(
            f"{name} is {shown(value)}, which is not an array of real numbers ({error})."
        ) from error
    if finite and not np.isfinite(array).all():
        raise InvalidInputError(f"{name} is {array.tolist()}; expected finite numbers only.")
    return array


def _floats(value: ArrayLike) -> Array:
    masked = isinstance(value, np.ma.MaskedArray)
    array: NDArray[Any] = np.ma.asarray(value) if masked else np.array(value)
    if array.dtype == np.object_:
        array = array.copy()
        for place, item in np.ndenumerate(np.ma.getdata(array)):
            if _is_missing(item):
                array[place] = np.nan
            elif isinstance(item, (np.datetime64, np.timedelta64)):
                raise TypeError(_TIMES)
            elif isinstance(item, (str, bytes)):
                raise TypeError(f"{shown(item)} is {_TEXT}")
    elif array.dtype.kind in "SU":
        raise TypeError(_TEXT)
    elif array.dtype.kind in "mM":
        if not (np.isnat(np.ma.getdata(array)) | np.ma.getmaskarray(array)).all():
            raise TypeError(_TIMES)
        return np.full(array.shape, np.nan)
    elif array.dtype.kind == "c":
        raise TypeError("complex numbers")
    floats = array.astype(np.float64)
    return np.ma.filled(floats, np.nan) if masked else floats


_TEXT = "text; expected numbers, as float(...) or pandas.to_numeric make of it"
_TIMES = "dates or durations; for seconds, give (t - t[0]) / numpy.timedelta64(1, 's')"


def _is_missing(item: Any) -> bool:
    """Whether it is None, a NaT, or pandas' NA, which exist only where pandas has been imported."""
    if item is None:
        return True
    if isinstance(item, (np.datetime64, np.timedelta64)):
        return bool(np.isnat(item))
    pandas = sys.modules.get("pandas")
    return pandas is not None and any(
        item is getattr(pandas, name, None) for name in ("NA", "NaT")
    )


def vector(name: str, value: ArrayLike, size: int, *, finite: bool = True) -> Array:
    """A float copy of value of shape (size,); a scalar will do where size is 1."""
    array = numbers(name, value, finite=finite)
    if array.ndim == 0 and size == 1:
        array = array.reshape(1)
    if array.shape != (size,):
        raise ShapeError(f"{name} has shape {array.shape}; expected ({size},).")
    return array


def record(name: str, values: ArrayLike, width: int) -> Array:
    """A float copy of a record (T, width); (T,) will do where width is 1."""
    array = numbers(name, values, finite=False)
    if array.ndim == 1 and width == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ShapeError(f"{name} has shape {array.shape}; expected (T, {width}), a row a sample.")
    return array


def positive_definite(name: str, value: ArrayLike, size: int | None = None) -> Array:
    """A symmetric positive definite float copy of value; a scalar will do where size is 1."""
    matrix, smallest = _symmetric(name, value, size)
    if smallest <= 0.0:
        eigenvalue = float(np.linalg.eigvalsh(matrix)[0])
        remedy = "Give every direction a value above 0, if a small one."
        if name.startswith("disturbance"):
            remedy = (
                "For directions without disturbance give a singular covariance of the disturbance, "
                "or the system a disturbance_matrix."
            )
        raise WeightError(
            f"{name} has the eigenvalue {min(max(smallest, -1.0), eigenvalue):.3g}; expected a "
            f"positive definite matrix. {remedy}"
        )
    return matrix


def positive_semidefinite(
    name: str, value: ArrayLike, size: int | None = None
) -> tuple[Array, bool]:
    """A copy of a covariance, and whether it is singular."""
    matrix, smallest = _symmetric(name, value, size)
    if smallest < -SINGULAR:
        raise WeightError(
            f"{name} has the eigenvalue {float(np.linalg.eigvalsh(matrix)[0]):.3g}; expected a "
            "positive semidefinite matrix: no variance is below 0."
        )
    return matrix, smallest <= SINGULAR


def check_prior_size(prior: Array, least: int) -> Array:
    """The prior's weight, if it has a row for each state: no fewer than disturbances."""
    if prior.shape[0] < least:
        raise ShapeError(
            f"prior has shape {prior.shape}; expected ({least}, {least}), as the disturbance has, "
            "or more rows with a disturbance_matrix."
        )
    return prior


def _symmetric(name: str, value: ArrayLike, size: int | None) -> tuple[Array, float]:
    """A symmetric copy, and the smallest eigenvalue of its correlations."""
    given = numbers(name, value)
    if given.ndim == 1 and given.size > 1:
        raise ShapeError(
            f"{name} has shape {given.shape}; expected a square matrix. For a diagonal one, give "
            "np.diag of the vector."
        )
    matrix = np.atleast_2d(given)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ShapeError(f"{name} has shape {matrix.shape}; expected a square matrix.")
    if size is not None and matrix.shape != (size, size):
        raise ShapeError(f"{name} has shape {matrix.shape}; expected ({size}, {size}).")
    # Rows may be in units of any size: each entry has its own, and so has the definiteness.
    difference, entries = np.abs(matrix - matrix.T), np.abs(matrix)
    sizes = np.sqrt(np.abs(matrix.diagonal()))
    allowed = 1e-10 * np.maximum(np.maximum(entries, entries.T), np.multiply.outer(sizes, sizes))
    if (difference > allowed).any():
        raise WeightError(
            f"{name} is not symmetric: it differs from its transpose by {difference.max():.3g}. "
            "Pass (M + M.T) / 2 if that is what is meant."
        )
    matrix = 0.5 * (matrix + matrix.T)
    if matrix[sizes == 0.0].any():  # a variance of zero, but correlated: indefinite in any unit
        return matrix, -np.inf
    sizes[sizes == 0.0] = 1.0
    with np.errstate(all="ignore"):
        correlations = matrix / np.multiply.outer(sizes, sizes)
    return matrix, float(np.linalg.eigvalsh(correlations)[0])


def count(name: str, value: Any, least: int, remedy: str = "", most: int = _MOST) -> int:
    """An integer no less than least."""
    found = integer(value)
    if found is None or found < least:
        raise OptionError(f"{name} is {shown(value)}; expected an integer >= {least}.{remedy}")
    if found > most:
        raise OptionError(
            f"{name} is {shown(value)}; expected an integer >= {least} and <= {most}.{remedy}"
        )
    return found


def dimension(name: str, value: Any, least: int) -> int:
    """A length of arrays."""
    return count(name, value, least, most=2**31 - 1)


def positive(name: str, value: Any) -> float:
    """A finite number above zero."""
    number = finite(value)
    if number is None or number <= 0.0:
        raise OptionError(f"{name} is {shown(value)}; expected a finite number > 0.")
    return number


def flag(name: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool):
        raise OptionError(f"{name} is {shown(value)}; expected True or False.")
    return value


def choice(name: str, value: Any, known: Sequence[str]) -> str:
    """One of the known words."""
    if not (isinstance(value, str) and value in known):
        words = ", ".join(repr(one) for one in known)
        raise OptionError(f"{name} is {shown(value)}; expected one of {words}.")
    return value


def check_problem(state: Any, mine: tuple[int, ...]) -> None:
    """Check that a snapshot is of a problem of these sizes: (n, p, m, horizon)."""
    found = state.get("problem") if isinstance(state, dict) else state
    if (
        not isinstance(found, (tuple, list))
        or len(found) != len(mine)
        or not all(isinstance(size, (int, np.integer)) for size in found)
        or tuple(found) != mine
    ):
        raise InvalidInputError(
            "the state is a snapshot of another problem: (n, p, m, horizon) = "
            f"{shown(tuple(found) if isinstance(found, list) else found)}; expected {mine}."
        )


def label_list(labels: Sequence[str], n: int | None = None) -> list[str]:
    """The labels, one for each of the n states, checked."""
    given = list(labels) if np.iterable(labels) and not isinstance(labels, str) else None
    if given is None or not all(isinstance(label, str) for label in given):
        raise InvalidInputError(
            f"labels are {shown(labels)}; expected a sequence of strings, one per state."
        )
    if len(given) != n if n is not None else not given:
        raise ShapeError(
            f"labels are {given}; expected {'at least 1' if n is None else n}, one per state."
        )
    return list(map(str, given))


def need(module: str, purpose: str, extra: str = "studies") -> ModuleType:
    """Import an optional package, or raise with the extra that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise InvalidInputError(
            f"{purpose} needs {package}, which is not installed; pip install 'qpmhe[{extra}]'."
        ) from error


def checked_path(name: str, value: Any) -> Path:
    """The name of a file or folder."""
    if not isinstance(value, (str, Path)):
        raise InvalidInputError(f"{name} is {shown(value)}; expected the name of a file or folder.")
    return Path(value)


def make_folder(path: str | Path) -> Path:
    """Make a folder where there is none."""
    try:
        checked_path("the folder", path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot make the folder {path}: {error.strerror}.") from error
    return Path(path)


# Arrays of more entries are shown by their shape.
_SHOWN = 9


def representation(thing: Any, **others: Any) -> str:
    """What ``repr`` says of an object: its type, and the arguments that are not the defaults.

    Parameters
    ----------
    thing : object
        One that keeps each argument of its constructor under its name, or with an underscore.
    **others
        What to show in place of an attribute, or beside the arguments.
    """
    found: dict[str, Any] = {}
    for name, parameter in inspect.signature(type(thing)).parameters.items():
        value = getattr(thing, name, getattr(thing, f"_{name}", None))
        if value is not None and not (isinstance(value, float | str | bool | int) and (
            value == parameter.default
        )):
            found[name] = value
    parts = ", ".join(
        f"{name}={_brief(value)}" for name, value in (found | others).items() if value is not None
    )
    return f"{type(thing).__name__}({parts})"


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if value.size > _SHOWN:
            return f"<{' x '.join(map(str, value.shape))}>"
        return " ".join(np.array2string(value, precision=4, separator=", ").split())
    if isinstance(value, float):
        return f"{value:.6g}"
    if callable(value) and hasattr(value, "__qualname__"):
        return f"<{value.__qualname__}>"
    return repr(value)
