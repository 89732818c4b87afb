"""The checkpoint beside the results: all that it takes to resume, written atomically."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._version import __version__
from ..errors import InvalidInputError, QpmheError

_FORMAT = 3


class CheckpointError(QpmheError):
    """A checkpoint that is damaged, or does not fit the record, the results or the options."""


class WriteError(InvalidInputError):
    """Results or a checkpoint that cannot be written; what was written before stays."""


def versions() -> dict[str, str]:
    """Of what computes the results."""
    return {"qpmhe": __version__, "numpy": np.__version__, "machine": platform.machine()}


@dataclass(frozen=True)
class Checkpoint:
    """Where an estimation stands after a number of samples.

    `identity` is the model and the options, which a run that resumes must share; `offset` is
    the length of the results; `time` and `inputs` are those of the last sample.
    """

    identity: dict[str, Any]
    every: int
    samples: int = 0
    offset: int = 0
    time: str = ""
    inputs: list[float] = field(default_factory=list)
    usual_step: float | None = None
    samples_digest: str = ""
    results_digest: str = ""
    state: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    versions: dict[str, str] = field(default_factory=versions)


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; whatever happens, the old or the new one is there.

    The file is an ``.npz`` of arrays, and a JSON text of everything else: nothing in it can run.
    """
    arrays: dict[str, Any] = {}
    content = vars(checkpoint) | {"state": _without_arrays(checkpoint.state, arrays)}
    text = json.dumps({"format": _FORMAT, **content})
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez(file, content=np.array(text), **arrays)
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
    """Read a checkpoint; None if there is no such file."""
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            content = json.loads(str(file["content"]))
            version = content.pop("format")
            if version != _FORMAT:
                raise CheckpointError(
                    f"the checkpoint {path} has format {version!r}; expected {_FORMAT}. Resume "
                    "with the version of qpmhe that made it, or start again by --overwrite."
                )
            content["state"] = _with_arrays(content["state"], file)
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


def _without_arrays(value: Any, arrays: dict[str, Any]) -> Any:
    """A tree of JSON in place of a value, with its arrays in `arrays`."""
    if isinstance(value, (np.ndarray, np.generic)):
        name = f"a{len(arrays)}"
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, dict):
        return {"dict": [[key, _without_arrays(item, arrays)] for key, item in value.items()]}
    if isinstance(value, (tuple, list)):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_without_arrays(item, arrays) for item in value]}
    return value


def _with_arrays(value: Any, arrays: Any) -> Any:
    """The value that `_without_arrays` was given."""
    if not isinstance(value, dict):
        return value
    (kind, content), = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "dict":
        return {key: _with_arrays(item, arrays) for key, item in content}
    items = [_with_arrays(item, arrays) for item in content]
    return tuple(items) if kind == "tuple" else items
