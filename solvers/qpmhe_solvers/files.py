"""QPs on disk: one self-describing file each, with its origin."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, astuple, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInputError
from .options import SolverOptions
from .qp import ARRAYS, QP, Array
from .registry import backends
from .solution import Residuals, Solution, SolveStatus

_FORMAT = "qpmhe QP"
_VERSION = 1
_PROBLEM = (
    "min over d of 1/2 d'Hd + g'd subject to lower <= d[k] <= upper and "
    "row_lower <= row_own[k] d[k] + row_next[k] d[k+1] <= row_upper, k = 0 ... stages-1; "
    "band[k, c, o] = H[k n + c + o, k n + c]; g = gradient; arrays are indexed by stages first"
)


@dataclass(frozen=True, eq=False)
class StoredQP:
    """The contents of a file written by `dump`.

    ``path`` is the file; ``qp`` the problem, identical to the last bit; ``solution`` the answer of
    ``backend`` (None, and an empty name, if not stored) with ``options`` from ``start``, (K, n) or
    None; ``versions`` the versions of Python, this package and the solvers; and ``written`` the
    time in ISO 8601.
    """

    path: Path
    qp: QP
    solution: Solution | None
    backend: str
    options: SolverOptions | None
    start: Array | None
    versions: Mapping[str, str]
    written: str


def dump(
    qp: QP,
    path: str | os.PathLike[str],
    *,
    solution: Solution | None = None,
    backend: str = "",
    options: SolverOptions | None = None,
    start: Array | None = None,
) -> Path:
    """Write a QP to an ``.npz`` file, to solve it again elsewhere.

    NumPy alone reads the file: its entry ``header`` is a JSON text that explains the other arrays.
    Nothing is pickled. The write is atomic.

    Parameters
    ----------
    qp : QP
        The problem; it need not be finite.
    path : str or path
        The file, usually ``.npz``. An existing file is replaced.
    solution : Solution, optional
        A backend's answer.
    backend : str
        The backend's name.
    options : SolverOptions, optional
        The options of the solve.
    start : (K, n) array, optional
        The start of the solve.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InvalidInputError
        If an argument has another type, or the file cannot be written.
    """
    for name, value, kind, optional in (
        ("qp", qp, QP, False), ("solution", solution, Solution, True),
        ("backend", backend, str, False), ("options", options, SolverOptions, True),
    ):
        if not isinstance(value, kind) and not (optional and value is None):
            raise InvalidInputError(f"{name} is {value!r}; expected a {kind.__name__}.")
    arrays = {name: getattr(qp, name) for name in ARRAYS} | {"start": start}
    answer = None
    if solution is not None:
        answer = {
            "status": solution.status.name,
            "verdict": solution.status.value,
            "iterations": None if solution.iterations is None else int(solution.iterations),
            "message": str(solution.message),
        }
        arrays |= {name: getattr(solution, name) for name in ("d", "bound_duals", "row_duals")}
        if solution.residuals is not None:
            arrays["residuals"] = astuple(solution.residuals)
    header = {
        "format": _FORMAT, "version": _VERSION, "problem": _PROBLEM,
        "stages": qp.stages, "n": qp.n, "rows": qp.rows, "bounded": bool(qp.bounded),
        "backend": backend, "options": None if options is None else asdict(options),
        "answer": answer, "versions": _versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    target = Path(path)
    _write(target, header, _in_shape(qp, arrays))
    return target


def load(path: str | os.PathLike[str]) -> StoredQP:
    """Read a file written by `dump`.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    StoredQP
        The QP, and its stored origin.

    Raises
    ------
    InvalidInputError
        If the file does not exist, is damaged, or has another format or a newer version.
    """
    source = Path(path)
    header, arrays = _read(source)
    if header.get("format") != _FORMAT:
        raise _foreign(source)
    version = header.get("version")
    if isinstance(version, int) and version > _VERSION:
        raise InvalidInputError(
            f"{source} has version {version} of the format, but this qpmhe reads only up to "
            f"{_VERSION}; upgrade qpmhe."
        )
    try:
        if version != _VERSION:
            raise ValueError(f"version is {version!r}")
        return _stored(source, header, arrays)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise _damaged(source, error) from error


def qp_files(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """All QP files among these files, and inside these folders."""
    found: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            within = sorted(path.rglob("*.npz"))
            if not within:
                raise InvalidInputError(
                    f"the folder {path} holds no .npz file; expected files of "
                    "qpmhe.solvers.dump or Recording."
                )
            found += within
        elif path.exists():
            found.append(path)
        else:
            raise InvalidInputError(f"there is no file {path}; check the spelling.")
    return found


def _shapes(stages: int, n: int, rows: int) -> dict[str, tuple[int, ...]]:
    of_states, of_rows = (stages, n), (stages, rows)
    return {
        "band": (stages, n, 2 * n), "gradient": of_states, "lower": of_states, "upper": of_states,
        "row_own": (stages, rows, n), "row_next": (stages, rows, n),
        "row_lower": of_rows, "row_upper": of_rows, "start": of_states, "d": of_states,
        "residuals": (3,), "bound_duals": (stages * n,), "row_duals": (stages * rows,),
    }


def _in_shape(qp: QP, arrays: dict[str, Any]) -> dict[str, Array]:
    """The arrays of a file, each as it will be read again."""
    shapes, shaped = _shapes(qp.stages, qp.n, qp.rows), {}
    for name, values in arrays.items():
        if values is None:
            continue
        try:
            shaped[name] = np.asarray(values, np.float64).reshape(shapes[name])
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"{name} does not fit the QP ({error}); expected numbers of shape {shapes[name]}."
            ) from error
    return shaped


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    solvers = {one.distribution for one in backends() if one.distribution}
    for name in ("qpmhe", "numpy", "scipy", "qpsolvers", *sorted(solvers)):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _stored(source: Path, header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> StoredQP:
    stages, n, rows = (header[name] for name in ("stages", "n", "rows"))
    for name, expected in _shapes(stages, n, rows).items():
        array = arrays.get(name)
        # Before the QP is made: it is as large as the header says.
        if array is not None and (array.shape != expected or array.dtype != np.float64):
            raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}")
    qp = QP(stages, n, rows)
    for name in ARRAYS:
        setattr(qp, name, np.ascontiguousarray(arrays[name]))
    if not isinstance(header["bounded"], bool):
        raise TypeError(f"bounded is {header['bounded']!r}")
    # The numbers have the last word: a promise that they break was made by mistake, for example
    # by QPs of earlier versions, which made it on their own.
    qp.bounded = header["bounded"] or bool(
        (qp.lower != -np.inf).any() or (qp.upper != np.inf).any()
    )
    options = header["options"]
    return StoredQP(
        source, qp, _answer(header["answer"], arrays), str(header["backend"]),
        None if options is None else SolverOptions(**options), arrays.get("start"),
        {str(name): str(version) for name, version in dict(header["versions"]).items()},
        str(header["written"]),
    )


def _answer(stored: dict[str, Any] | None, arrays: dict[str, NDArray[Any]]) -> Solution | None:
    if stored is None:
        return None
    status, iterations = SolveStatus[stored["status"]], stored["iterations"]
    d = arrays.get("d")
    if status.usable != (d is not None):
        raise ValueError(f"status {status.name} does not go with the iterate")
    if iterations is not None and not isinstance(iterations, int):
        raise TypeError(f"iterations is {iterations!r}")
    residuals = arrays.get("residuals")
    return Solution(
        d, status, iterations,
        None if residuals is None else Residuals(*residuals.tolist()),
        arrays.get("bound_duals"), arrays.get("row_duals"), str(stored["message"]),
    )


def _write(target: Path, header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write header and arrays beside the target, then rename: it is there whole or not at all."""
    # NumPy's numbers are no JSON.
    members = {"header": np.array(json.dumps(header, default=lambda one: one.item())), **arrays}
    unfinished = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            with unfinished.open("wb") as file:
                np.savez(file, **members)  # type: ignore[arg-type]  # none is named as its options
            unfinished.replace(target)
        except BaseException:
            with contextlib.suppress(OSError):
                unfinished.unlink()
            raise
    except OSError as error:
        raise InvalidInputError(
            f"cannot write {target}: {error.strerror or error}; give a path in an existing, "
            "writable folder with free space."
        ) from error


def _read(source: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of a file; nothing in it is executed."""
    try:
        with source.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise InvalidInputError(
            f"cannot read {source}: {error.strerror or error}; expected a file written by "
            "qpmhe.solvers.dump."
        ) from error
    if not magic.startswith(b"PK"):
        raise _foreign(source)
    try:
        with (
            warnings.catch_warnings(action="ignore"), source.open("rb") as file,
            np.load(file, allow_pickle=False) as opened,
        ):
            if "header" not in opened.files:
                raise _foreign(source)
            arrays = {name: opened[name] for name in opened.files}
        header = json.loads(str(arrays.pop("header")))
    except InvalidInputError:
        raise
    except Exception as error:  # NumPy's and zip's readers raise nearly anything on nonsense
        raise _damaged(source, error) from error
    if not isinstance(header, dict):
        raise _foreign(source)
    return header, arrays


def _foreign(source: Path) -> InvalidInputError:
    """The error for a file of another kind."""
    return InvalidInputError(
        f"{source} is not a QP file of qpmhe; expected a file written by qpmhe.solvers.dump or "
        "Recording."
    )


def _damaged(source: Path, error: Exception) -> InvalidInputError:
    """The error for a file whose contents do not fit together."""
    return InvalidInputError(
        f"{source} is damaged ({type(error).__name__}: {error}); copy or dump it again."
    )
