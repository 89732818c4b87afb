"""Where the models of a study come from: the catalogue, or a function of the user's."""

from __future__ import annotations

import ast
import re
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
from .model_files import fingerprint, imported, module_file

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
        Digest of the file that it comes from, and of those that this imports from its own
        folder; empty for the catalogue.
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
    path: Path | None
    if place.endswith(".py"):
        path = (folder or Path()).joinpath(place).resolve()
        place = str(path)
    else:
        path = module_file(place)
    try:
        digest = "" if path is None else fingerprint(path)
    except OSError as error:
        raise StudyError(
            f"model {name!r}: cannot read {error.filename} ({error.strerror})."
        ) from error
    return Source(name, f"{place}:{function}", arguments, digest)


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
        If there is no such function, it raises, or returns anything but the four parts; or
        if its file is not the one that was found.
    """
    name = source.name
    function = _function(name, source.where, source.fingerprint)
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


def _function(name: str, where: str, digest: str = "") -> Callable[..., Any]:
    if ":" not in where:
        return catalogue()[where]
    place, _, attribute = where.rpartition(":")
    try:
        module, now = imported(place)
    except Exception as error:
        raise StudyError(
            f"model {name!r}: cannot import {place} ({type(error).__name__}: {error})."
        ) from error
    if digest and now != digest:
        raise StudyError(
            f"model {name!r}: {place}, or a file that it imports, is another here than where the "
            "study was started, or was changed since; bring the same files to all machines, and "
            "give the command again."
        )
    function = getattr(module, attribute, None)
    if not callable(function):
        raise StudyError(f"model {name!r}: {place} has no function {attribute}.")
    found: Callable[..., Any] = function
    return found
