"""Studies written as TOML files.

The keys are the parameters of `Study`. TOML has no None: ``"converged"`` stands for it in
``qps``, ``"none"`` in ``solver_iterations``, ``"default"`` in ``horizons``::

    models = ["batch_reactor", "chain_of_masses(masses=2)", "my_model.py:make"]
    backends = ["daqp", "osqp"]
    qps = [0, 1, 2, "converged"]
    solver_iterations = [1, 5, "none"]
    seeds = 20

Paths of models are relative to the file.
"""

from __future__ import annotations

import re
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from .errors import StudyError
from .grid import CHECKS, Study
from .sources import find, load

__all__ = ["WORDS", "read"]

#: What stands for None.
WORDS = {"qps": "converged", "solver_iterations": "none", "horizons": "default"}


def read(path: Path) -> Study:
    """Read a study; everything is checked before anything runs.

    Parameters
    ----------
    path : Path
        A TOML file.

    Raises
    ------
    StudyError
        If it cannot be read, names nothing, has an unknown key or a value that does not fit;
        the text has the file and the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StudyError(f"cannot read the study file {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise StudyError(f"the study file {path} is no text in UTF-8 ({error}).") from error
    lines = text.splitlines()
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        words = str(error).replace("end of document", f"line {len(lines)}, the end")
        raise StudyError(f"the study file {path} is no valid TOML: {words}.") from error
    for key in found:
        if key not in CHECKS:
            near = get_close_matches(key, CHECKS, 1)
            raise StudyError(
                f"{_at(path, lines, key)}: unknown key {key!r}; expected some of "
                f"{', '.join(CHECKS)}.{f' Did you mean {near[0]}?' if near else ''}"
            )
    if not found:
        raise StudyError(
            f"the study file {path} is empty; name at least one of {', '.join(CHECKS)}; "
            "what is left out has its default."
        )
    options = {key: _translated(key, value) for key, value in found.items()}
    for key, value in options.items():
        _check(path, lines, key, value)
    try:
        return Study.within(path.parent, **options)
    except InvalidInputError as error:
        raise StudyError(f"{path}: {error}") from error


def _translated(key: str, value: Any) -> Any:
    word = WORDS.get(key)
    if word is None:
        return value
    if isinstance(value, list):
        return [None if item == word else item for item in value]
    return [None if value == word else value]


def _check(path: Path, lines: list[str], key: str, value: Any) -> None:
    """Check one option, its items one by one so that the one at fault can be pointed at."""
    several = isinstance(value, list) and len(value) > 0
    for item in value if several else [value]:
        try:
            CHECKS[key]([item] if several else item)
            if key == "models":
                load(find(item, path.parent))
        except InvalidInputError as error:
            shown = str(error)
            if key in WORDS:
                shown = shown.replace(" None ", f' "{WORDS[key]}" ')
            raise StudyError(f"{_at(path, lines, key, item)}: {shown}") from error


def _at(path: Path, lines: list[str], key: str, item: Any = None) -> str:
    """File and line of a key, or of an item of its value; tomllib tells neither."""
    begins = re.compile(rf"""\s*(\[+\s*)?["']?{re.escape(key)}["']?\s*(=|\]|\.)""")
    other = re.compile(r"""\s*["']?[A-Za-z0-9_-]+["']?\s*=""")
    first = next((i for i, line in enumerate(lines) if begins.match(line)), None)
    if first is None:
        return str(path)
    value = item if isinstance(item, str) else repr(item).lower()
    for i in range(first, len(lines)):
        if i > first and other.match(lines[i]):
            break
        text = lines[i].partition("=")[2] if i == first else lines[i]
        if item is not None and re.search(rf"(?<![\w.]){re.escape(value)}(?![\w.])", text):
            return f"{path}, line {i + 1}"
    return f"{path}, line {first + 1}"
