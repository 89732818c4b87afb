"""What identifies generated C source, found in a millisecond and without generating it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from dataclasses import fields
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from .._version import __version__
from ..model.algebraic import AlgebraicStates
from ..model.expressions import CasadiModel, import_casadi
from ..model.flows import flow_pattern
from ..model.implicit_steps import ImplicitStep
from ..model.products import with_slope
from .layout import Layout

# Members of a model that are data of the generated code, not code.
_DATA = frozenset(("dt",))


def source_key(model: CasadiModel, layout: Layout | None = None) -> str | None:
    """A key that differs if the C source of a model, or of its estimator, differs.

    None where a function of the model cannot be written down, such as a callback.
    """
    parts = [_generator(), import_casadi().__version__]
    if layout is not None:
        parts += [repr(layout), repr(layout.header_values("mhe"))]
    for field in fields(model):
        if field.name not in _DATA:
            try:
                parts += [field.name, *_written(getattr(model, field.name))]
            except RuntimeError:  # CasADi's error of any kind
                return None
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _written(value: Any) -> Iterator[str]:
    if hasattr(value, "serialize"):
        yield value.serialize()
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _written(item)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield repr(name)
            yield from _written(item)
    else:
        yield repr(value)


@lru_cache(maxsize=1)
def _generator() -> str:
    """Digest of all that makes the source of a model: templates and generator."""
    digest = hashlib.sha256(__version__.encode())
    models = [
        Path(sys.modules[one.__module__].__file__ or "")
        for one in (AlgebraicStates, CasadiModel, ImplicitStep, flow_pattern, with_slope)
    ]
    here = files(__package__)
    for folder in (here, here.joinpath("c")):
        for file in sorted(folder.iterdir(), key=lambda one: one.name):
            if file.name.endswith((".py", ".c", ".h")):
                digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    for model_file in models:
        digest.update(model_file.read_bytes())
    return digest.hexdigest()
