"""The files that users' models come from: found, told apart by content, imported."""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

__all__ = ["fingerprint", "imported", "module_file"]

# Fingerprint at the time when this process imported a place.
_IMPORTED: dict[str, str] = {}


def module_file(place: str) -> Path | None:
    """The file of a module, which is not imported for that; packages above it are.

    Parameters
    ----------
    place : str
        Such as ``package.module``.

    Returns
    -------
    Path or None
        None where there is no such module, or it has no file of its own.
    """
    importlib.invalidate_caches()
    try:
        with _called_from():
            specification = importlib.util.find_spec(place)
    except Exception:  # whoever imports it tells what is wrong
        return None
    if specification is None or not specification.has_location or specification.origin is None:
        return None
    path = Path(specification.origin).resolve()
    return path if path.is_file() else None


def fingerprint(path: Path) -> str:
    """Digest of a file, and of the files of its own folder that it imports.

    Parameters
    ----------
    path : Path
        The file. Only statements ``import`` and ``from ... import`` are followed.

    Raises
    ------
    OSError
        If a file cannot be read.
    """
    digest = hashlib.sha256(path.read_bytes())
    for file in sorted(_files(path)[1:]):
        digest.update(f"\0{file.relative_to(path.parent).as_posix()}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def imported(place: str) -> tuple[ModuleType, str]:
    """Import a module as its files are now.

    Where this process imported it from files that were different, those are imported anew.

    Parameters
    ----------
    place : str
        ``package.module``, or the absolute path of a file in .py.

    Returns
    -------
    module : ModuleType
        The module.
    fingerprint : str
        Of its file; empty if it has none.

    Raises
    ------
    Exception
        Whatever the import raises.
    """
    path = Path(place) if place.endswith(".py") else module_file(place)
    now = "" if path is None else fingerprint(path)
    if path is not None and _IMPORTED.get(place, now) != now:
        _forget(set(_files(path)))
    _IMPORTED[place] = now
    if place.endswith(".py"):
        return _of_file(Path(place)), now
    with _called_from():
        return importlib.import_module(place), now


def _files(path: Path) -> list[Path]:
    """A file, first, and those of its folder that it imports, at whatever depth."""
    roots = {path.parent, _top(path)}
    found, waiting = [path], [path]
    while waiting:
        for candidate in _candidates(waiting.pop(), roots):
            if (
                candidate not in found
                and candidate.is_relative_to(path.parent) and candidate.is_file()
            ):
                found.append(candidate)
                waiting.append(candidate)
    return found


def _top(path: Path) -> Path:
    """The folder that absolute imports of a file's package begin at."""
    return next(one for one in path.parents if not (one / "__init__.py").is_file())


def _candidates(file: Path, roots: set[Path]) -> Iterator[Path]:
    """Where the modules would be that a file imports."""
    try:
        nodes = list(ast.walk(ast.parse(file.read_bytes()))) if file.suffix == ".py" else []
    except (SyntaxError, ValueError):  # the import tells
        return
    for node in nodes:
        bases = roots
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module or ''}.{alias.name}" for alias in node.names]
            if node.level:
                bases = set(file.parents[node.level - 1 : node.level])
        else:
            continue
        for base in bases:
            for name in names:
                place = base
                for part in filter(None, name.split(".")):
                    yield place / f"{part}.py"
                    place /= part
                    yield place / "__init__.py"


def _forget(files: set[Path]) -> None:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and Path(file).resolve() in files:
            del sys.modules[name]


@contextmanager
def _called_from() -> Iterator[None]:
    """A console script has its own folder in the path, not the one it is called from."""
    here = str(Path.cwd())
    if "" in sys.path or here in sys.path:
        yield
        return
    sys.path.append(here)
    try:
        yield
    finally:
        sys.path.remove(here)


def _of_file(path: Path) -> ModuleType:
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
