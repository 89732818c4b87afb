"""Where the models of a study come from: the catalogue, or a function of the user's."""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..costs import Cost
from ..errors import QpmheError
from ..models import Example, Scenario, catalogue
from ..observers import Observer
from ..system import System
from .errors import StudyError

__all__ = ["Source", "find", "load"]

_FORM = re.compile(r"(?P<where>[^()]+)(?:\((?P<arguments>.*)\))?", re.DOTALL)
_PARTS = (
    (System, "system"), (Observer, "observer"), (Cost, "cost"), (Scenario, "scenario"),
)
_EXPECTED = (
    "expected a name of the catalogue, name(keyword=value), package.module:function or "
    "path/file.py:function"
)


@dataclass(frozen=True)
class Source:
    """One model of a study.

    Parameters
    ----------
    name : str
        As the user writes it, without superfluous blanks; rows bear it.
    where : str
        Catalogue name, or ``module:function``, or ``/absolute/file.py:function``.
    arguments : str
        Keyword arguments of the function, as ``key=value, key=value``.
    fingerprint : str
        Digest of the file that it comes from; empty for the catalogue and for modules.
    """

    name: str
    where: str
    arguments: str = ""
    fingerprint: str = ""


def find(text: Any, folder: Path | None = None) -> Source:
    """Read a model's name, without loading it.

    Parameters
    ----------
    text : str
        ``name``, ``name(keyword=value)``, ``package.module:function`` or
        ``path/file.py:function``.
    folder : Path, optional
        What a file's path is relative to; the working directory if left out.

    Raises
    ------
    StudyError
        If it has another form, or there is no such model or file.
    """
    match = _FORM.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None:
        raise StudyError(f"the model is {text!r}; {_EXPECTED}.")
    written = match["where"].strip()
    given = _arguments(text, match["arguments"] or "")
    arguments = ", ".join(f"{key}={value!r}" for key, value in given.items())
    name = f"{written}({arguments})" if arguments else written
    if ":" not in written:
        if written not in catalogue():
            raise StudyError(
                f"model {written!r} is not known; expected one of {', '.join(catalogue())}, or "
                "package.module:function, or path/file.py:function."
            )
        return Source(name, written, arguments)
    place, _, function = written.rpartition(":")
    if not function.isidentifier() or not place:
        raise StudyError(f"the model is {text!r}; {_EXPECTED}.")
    if not place.endswith(".py"):
        return Source(name, f"{place}:{function}", arguments)
    path = (folder or Path()).joinpath(place).resolve()
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise StudyError(f"model {name!r}: cannot read {path} ({error.strerror}).") from error
    return Source(name, f"{path}:{function}", arguments, digest)


def _arguments(text: str, inside: str) -> dict[str, Any]:
    try:
        call = ast.parse(f"f({inside})", mode="eval").body
        if not isinstance(call, ast.Call) or call.args:
            raise ValueError("a value without keyword")
        pairs = [(item.arg, ast.literal_eval(item.value)) for item in call.keywords]
        if any(key is None for key, _ in pairs):
            raise ValueError("two asterisks")
    except (SyntaxError, ValueError) as error:
        raise StudyError(
            f"the arguments of model {text!r} cannot be read ({error}); expected plain values "
            "by keyword, as in chain_of_masses(masses=2)."
        ) from error
    return {str(key): value for key, value in pairs}


@lru_cache(maxsize=16)
def load(source: Source) -> Example:
    """Make the model; the same object for the same source within a process.

    Parameters
    ----------
    source : Source
        Which.

    Raises
    ------
    StudyError
        If there is no such function, it raises, or returns anything but the four parts.
    """
    name = source.name
    function = _function(name, source.where)
    try:
        parts = function(**_arguments(name, source.arguments))
    except QpmheError as error:
        raise StudyError(f"model {name!r} cannot be made: {error}") from error
    except Exception as error:
        raise StudyError(
            f"model {name!r} cannot be made: {type(error).__name__}: {error}."
        ) from error
    if not isinstance(parts, tuple) or len(parts) != 4:
        raise StudyError(
            f"model {name!r} gave {type(parts).__name__}; expected (system, observer, cost, "
            "scenario), as qpmhe.models.Example."
        )
    for part, (kind, what) in zip(parts, _PARTS, strict=True):
        if not isinstance(part, kind):
            raise StudyError(
                f"model {name!r} gave a {type(part).__name__} for its {what}; expected "
                f"qpmhe's {kind.__name__}."
            )
    return Example(*parts)


def _function(name: str, where: str) -> Callable[..., Any]:
    if ":" not in where:
        return catalogue()[where]
    place, _, attribute = where.rpartition(":")
    try:
        module = _of_file(Path(place)) if place.endswith(".py") else _of_module(place)
    except Exception as error:
        raise StudyError(
            f"model {name!r}: cannot import {place} ({type(error).__name__}: {error})."
        ) from error
    function = getattr(module, attribute, None)
    if not callable(function):
        raise StudyError(f"model {name!r}: {place} has no function {attribute}.")
    found: Callable[..., Any] = function
    return found


def _of_module(place: str) -> Any:
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name != place.partition(".")[0] or "" in sys.path:
            raise
    # A console script has its own folder in the path, not the one it is called from.
    sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(place)
    finally:
        sys.path.remove(str(Path.cwd()))


def _of_file(path: Path) -> Any:
    name = f"qpmhe_study_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    try:
        specification.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
