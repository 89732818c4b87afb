"""The checkpoint beside the results: all that a resumed run needs, written atomically."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._version import __version__
from ..errors import InvalidInputError, QpmheError

_FORMAT = 4


class CheckpointError(QpmheError):
    """A checkpoint that is damaged, or does not fit the record, the results or the options."""


class WriteError(InvalidInputError):
    """Results or a checkpoint that cannot be written; what was written before stays."""


def versions() -> dict[str, str]:
    """Versions of the software that computes the results."""
    return {"qpmhe": __version__, "numpy": np.__version__, "machine": platform.machine()}


@dataclass(frozen=True)
class Checkpoint:
    """Where an estimation stands after a number of samples.

    `identity` is the model and the options, which a resumed run must share; `offset` is the length
    of the results; `time` and `inputs` are those of the last sample.
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
    bound: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    versions: dict[str, str] = field(default_factory=versions)


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; after any interruption the old or the new one is complete.

    The file is a digest, and a JSON text with all bits of arrays: nothing in it can run.
    """
    text = json.dumps({"format": _FORMAT, **vars(checkpoint)}, default=_packed)
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(f"{_digest(text)}\n{text}")
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
        digest, _, text = path.read_text(encoding="utf-8").partition("\n")
        if digest != _digest(text):
            raise ValueError("it is damaged, or of another version of qpmhe")
        content = json.loads(text, object_hook=_unpacked)
        version = content.pop("format")
        if version != _FORMAT:
            raise ValueError(f"it has format {version!r}, and this qpmhe reads {_FORMAT}")
        return Checkpoint(**content)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"the checkpoint {path} cannot be read ({error}); start again with --overwrite, or "
            "resume with the version of qpmhe that made it."
        ) from error


def plain(identity: dict[str, Any]) -> dict[str, Any]:
    """The identity as a checkpoint restores it; objects become the name of their type."""
    found: dict[str, Any] = json.loads(json.dumps(identity, default=_named))
    return found


def _named(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else type(value).__name__


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _packed(value: Any) -> Any:
    if not isinstance(value, (np.ndarray, np.generic)):
        raise TypeError(f"a snapshot cannot hold a {type(value).__name__}")
    array = np.ascontiguousarray(value)
    content = base64.b64encode(array.tobytes()).decode()
    return {"array": content, "dtype": array.dtype.str, "shape": np.shape(value)}


def _unpacked(found: dict[str, Any]) -> Any:
    if set(found) != {"array", "dtype", "shape"}:
        return found
    content = bytearray(base64.b64decode(found["array"]))
    return np.frombuffer(content, found["dtype"]).reshape(found["shape"])
