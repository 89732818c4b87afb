"""The checkpoint of a record: all that it takes to go on, in one file, written atomically."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import CheckpointError, WriteError

__all__ = ["Checkpoint", "load", "save"]

Array = NDArray[Any]

_FORMAT = 2


@dataclass(frozen=True)
class Checkpoint:
    """Where an estimation stands after a number of samples.

    Parameters
    ----------
    identity : dict
        Model and options; whoever goes on must have the same ones.
    every : int
        Checkpoints are taken each time that this many samples were taken in.
    samples : int
        Samples taken in.
    offset : int
        Bytes of the results that belong to them.
    time : str
        Time of the last one; blank before the first.
    inputs : list of float
        Its inputs.
    usual : float or None
        The usual step.
    digest, written : str
        Of all samples so far, and of the results that belong to them.
    finished : bool
        Whether the record had come to its end.
    versions : dict
        Of what computed it.
    state : dict
        The estimator's ``state_dict``.
    """

    identity: dict[str, Any]
    every: int
    samples: int
    offset: int
    time: str
    inputs: list[float]
    usual: float | None
    digest: str
    written: str
    finished: bool
    versions: dict[str, str]
    state: dict[str, Any]


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; whatever happens, the former or the new one is there.

    An ``.npz`` file without pickled objects: arrays, and all else as one JSON text.

    Parameters
    ----------
    path : Path
        The file.
    checkpoint : Checkpoint
        What to write.

    Raises
    ------
    WriteError
        If it cannot be written.
    """
    arrays: dict[str, Array] = {}
    content = {field.name: getattr(checkpoint, field.name) for field in fields(checkpoint)}
    content["state"] = _flat(checkpoint.state, arrays)
    text = json.dumps({"format": _FORMAT, **content})
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez(file, content=np.array(text), **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise WriteError(
            f"cannot write the checkpoint {path}: {error.strerror or error}."
        ) from error


def load(path: Path) -> Checkpoint | None:
    """Read a checkpoint.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Checkpoint or None
        None if there is no such file.

    Raises
    ------
    CheckpointError
        If it is damaged, or of another version.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            content = json.loads(str(file["content"]))
            version = content.pop("format")
            if version != _FORMAT:
                raise CheckpointError(
                    f"the checkpoint {path} is of format {version!r}; expected {_FORMAT}. Go on "
                    "with the version of qpmhe that made it, or start again by --overwrite."
                )
            content["state"] = _full(content["state"], file)
            return Checkpoint(**content)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (
        OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile
    ) as error:
        raise CheckpointError(
            f"the checkpoint {path} cannot be read ({type(error).__name__}: {error}); start "
            "again by --overwrite."
        ) from error


def _flat(value: Any, arrays: dict[str, Array]) -> Any:
    """A tree of JSON, with its arrays gathered beside it."""
    if isinstance(value, (np.ndarray, np.generic)):
        name = f"a{len(arrays)}"
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, dict):
        return {"dict": [[key, _flat(item, arrays)] for key, item in value.items()]}
    if isinstance(value, (tuple, list)):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_flat(item, arrays) for item in value]}
    return value


def _full(value: Any, arrays: Any) -> Any:
    """What `_flat` was given."""
    if not isinstance(value, dict):
        return value
    (kind, content), = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "dict":
        return {key: _full(item, arrays) for key, item in content}
    items = [_full(item, arrays) for item in content]
    return tuple(items) if kind == "tuple" else items
