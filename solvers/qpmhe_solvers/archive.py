"""Arrays and a JSON header in one ``.npz`` file, without pickles."""

from __future__ import annotations

import contextlib
import json
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInputError

__all__ = ["damaged", "foreign", "read", "write"]


def write(target: Path, header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write header and arrays beside the target, then rename: it is there whole or not at all."""
    members = {"header": np.array(json.dumps(header)), **arrays}
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
            f"cannot write {target}: {error.strerror or error}; give a path in an existing "
            "folder that can be written to and has space left."
        ) from error


def read(source: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of a file; nothing in it is executed."""
    try:
        with source.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise InvalidInputError(
            f"cannot read {source}: {error.strerror or error}; expected a file of "
            "qpmhe.solvers.dump."
        ) from error
    if not magic.startswith(b"PK"):
        raise foreign(source)
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(source) as archive:
            warnings.simplefilter("ignore")
            if "header.npy" not in archive.namelist():
                raise foreign(source)
        with warnings.catch_warnings(), np.load(source, allow_pickle=False) as opened:
            warnings.simplefilter("ignore")
            arrays = {name: opened[name] for name in opened.files}
        header = json.loads(str(arrays.pop("header")))
    except InvalidInputError:
        raise
    except Exception as error:  # NumPy's and zip's readers raise nearly anything on nonsense
        raise damaged(source, error) from error
    if not isinstance(header, dict):
        raise foreign(source)
    return header, arrays


def foreign(source: Path) -> InvalidInputError:
    """The error for a file of another kind."""
    return InvalidInputError(
        f"{source} is no QP file of qpmhe; expected one of qpmhe.solvers.dump or Recording."
    )


def damaged(source: Path, error: Exception) -> InvalidInputError:
    """The error for a file whose contents do not fit together."""
    return InvalidInputError(
        f"{source} is damaged ({type(error).__name__}: {error}); copy or dump it again."
    )
