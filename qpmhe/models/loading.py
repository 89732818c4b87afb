"""A model, observer or estimator from a name that is known, from a module, or from a file."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from modulefinder import ModuleFinder
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, get_args, get_origin, get_type_hints

import qpmhe_solvers

from ..costs import Cost
from ..errors import ModelError, QpmheError
from ..estimation.estimator import MovingHorizonEstimator
from ..model.system import System
from ..observers import Observer
from . import catalogue
from .example import Example
from .scenario import Scenario

_FORM = re.compile(r"(?P<where>[^()]+)(?:\((?P<arguments>.*)\))?", re.DOTALL)
_PARTS = ((System, "system"), (Observer, "observer"), (Cost, "cost"), (Scenario, "scenario"))
_EXPECTED = "name(keyword=value), package.module:function or path/file.py:function"
_PACKAGES = (Path(__file__).parents[1], Path(qpmhe_solvers.__file__).parent)
# Of the names of modules that are users' files.
_PREFIX = "qpmhe_model_"
# Fingerprint at the time when this process imported a place.
_imported_as: dict[str, str] = {}


@dataclass(frozen=True)
class ModelSource:
    """Where a model comes from, or an observer or estimator to compare.

    Parameters
    ----------
    name : str
        As the user writes it, without superfluous blanks.
    where : str
        Name in the catalogue, or ``module:function``, or ``/absolute/file.py:function``.
    arguments : str
        Keyword arguments of the function, as ``key=value, key=value``.
    fingerprint : str
        Digest of the file and of those it imports from its folder; empty for the catalogue.
    kind : str
        What it makes, for messages: model, observer or estimator.
    """

    name: str
    where: str
    arguments: str = ""
    fingerprint: str = ""
    kind: str = "model"

    @property
    def is_file(self) -> bool:
        """Whether the model is named by the path of a file."""
        return self.where.rpartition(":")[0].endswith(".py")

    @property
    def file(self) -> Path | None:
        """The model's file; None for the catalogue, and for a module that is not imported."""
        place = self.where.rpartition(":")[0]
        if self.is_file:
            return Path(place)
        path = getattr(sys.modules.get(place), "__file__", None)
        return Path(path) if path else None


def find(
    text: Any, folder: Path | None = None, kind: str = "model",
    known: Mapping[str, str] | None = None,
) -> ModelSource:
    """Find a model by its name, without importing its file.

    Parameters
    ----------
    text : str
        ``name``, ``name(keyword=value)``, ``package.module:function`` or
        ``path/file.py:function``. A `ModelError` is raised if it has another form, or there is
        no such model or file.
    folder : Path, optional
        What a file's path is relative to; the working directory if left out.
    kind : str
        What it makes: model, observer or estimator.
    known : mapping, optional
        Names without a colon, and ``package.module:function`` for each; those of the catalogue if
        left out.
    """
    names = catalogue() if known is None else known
    expected = f"expected one of {', '.join(names)}, or {_EXPECTED}"
    match = _FORM.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None:
        raise ModelError(f"the {kind} is {text!r}; {expected}.")
    written = match["where"].strip()
    given = _arguments(text, match["arguments"] or "", kind)
    arguments = ", ".join(f"{key}={value!r}" for key, value in given.items())
    name = f"{written}({arguments})" if arguments else written
    if ":" not in written:
        if written.endswith(".py"):
            raise ModelError(
                f"the {kind} is {text!r}, which names no function; "
                f"{_proposal((folder or Path()) / written, written, kind)}."
            )
        if written not in names:
            near = get_close_matches(written, names, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ModelError(f"{kind} {written!r} is not known; {expected}.{hint}")
        return ModelSource(name, written if known is None else known[written], arguments, "", kind)
    place, _, function = written.rpartition(":")
    if not function.isidentifier() or not place:
        raise ModelError(f"the {kind} is {text!r}; {expected}.")
    path: Path | None
    if place.endswith(".py"):
        path = (folder or Path()).joinpath(place).resolve()
        place = str(path)
    else:
        path = module_file(place)
    try:
        digest = "" if path is None else fingerprint(path)
    except OSError as error:
        raise ModelError(
            f"{kind} {name!r}: cannot read {error.filename} ({error.strerror})."
        ) from error
    return ModelSource(name, f"{place}:{function}", arguments, digest, kind)


def check_named_in_file(
    text: Any, folder: Path, kind: str = "model", returns: tuple[type, ...] = ()
) -> None:
    """Raise `ModelError` unless a study file in a folder may name this model.

    A model is code, and a study file comes from anywhere. It may name a model of the catalogue, a
    function that a Python file in its own folder defines, or a function of a module outside of the
    standard library whose annotation says that it returns a model. The function is not called. The
    same holds for observers and estimators, where ``returns`` are the classes that an annotation
    may name; such a class may itself be named.
    """
    match = _FORM.fullmatch(text.strip()) if isinstance(text, str) else None
    place, colon, name = (match["where"].strip() if match else "").rpartition(":")
    if not colon:  # of the catalogue, or of no form, which `find` reports
        return
    remedy = "put a file that defines the function beside the study, or give the study in Python"
    if place.endswith(".py"):
        path = folder.joinpath(place).resolve()
        if not path.is_relative_to(folder.resolve()):
            raise ModelError(
                f"{kind} {text!r} is a file outside of the study's folder {folder}; {remedy}."
            )
    elif place.partition(".")[0] in sys.stdlib_module_names:
        raise ModelError(
            f"{kind} {text!r} is in Python's standard library, which has no {kind}s; {remedy}."
        )
    source = find(text, folder, kind)
    if place.endswith(".py"):
        if not _defines(path, name):
            raise ModelError(
                f"{kind} {text!r}: {place} does not define {name} itself; a study may not name "
                "what the file imports."
            )
        return
    with _import_path(place):
        function = _function(source)
    if returns:
        found = function if isinstance(function, type) else _annotated(function)
        fits, such = isinstance(found, type) and issubclass(found, returns), returns[0]
        words = f"{such.__module__}.{such.__qualname__}"
    else:
        fits, words = _returns_model(function), "qpmhe.models.Example"
    if not fits:
        raise ModelError(
            f"{kind} {text!r}: nothing says that {name} returns a{'n' * (kind[0] in 'aeiou')} "
            f"{kind}; annotate it, as in def {name}(...) -> {words}, or {remedy}."
        )


def _defines(file: Path, name: str) -> bool:
    """Whether a file defines or assigns a name; `build` reports a file that cannot be read."""
    try:
        nodes = list(ast.walk(ast.parse(file.read_bytes())))
    except (OSError, SyntaxError, ValueError):
        return True
    return any(
        one.name == name if isinstance(one, (ast.FunctionDef, ast.ClassDef))
        else isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store) and one.id == name
        for one in nodes
    )


def _annotated(function: Any) -> Any:
    """What a function's annotation says that it returns; None for anything else."""
    if not isinstance(function, FunctionType):
        return None
    try:
        return get_type_hints(function).get("return")
    except Exception:  # names that cannot be resolved
        return None


def _returns_model(function: Any) -> bool:
    """Whether a function's annotation says that it returns a model, in any form that is read."""
    kind = _annotated(function)
    arguments = get_args(kind)
    wanted: Any = arguments[0] if get_origin(kind) is tuple and arguments else kind
    return isinstance(wanted, type) and issubclass(
        wanted, (Example, MovingHorizonEstimator) if wanted is kind else System
    )


def _proposal(file: Path, written: str, kind: str) -> str:
    """What to write for a file, by the functions that it defines; models need no argument."""
    try:
        body = ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return f"expected {written}:function"
    count = int(kind != "model")  # the problem
    names = [
        one.name for one in body
        if isinstance(one, ast.FunctionDef) and not one.name.startswith("_")
        and len(one.args.posonlyargs + one.args.args) - len(one.args.defaults) == count
    ]
    if not names:
        return f"expected {written}:function" + (
            ", and the file has no function without arguments" * (not count))
    return "expected " + " or ".join(f"{written}:{name}" for name in names[:5])


def build(source: ModelSource, *given: Any) -> Any:
    """Call the function of a source that `find` found, and return whatever it returns.

    ``given`` are arguments before those that the name has.

    A file can import the files beside it, as it can when Python runs it. A `ModelError` is
    raised if the file cannot be imported, has changed since it was found, or lacks the function,
    or if the function raises; the text names the line in the user's file.
    """
    with _import_path(source.where.rpartition(":")[0]):
        function = _function(source)
        try:
            return function(*given, **_arguments(source.name, source.arguments, source.kind))
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            raise _failure(source, " cannot be made", error) from error


@lru_cache(maxsize=16)
def load(source: ModelSource) -> Example:
    """Make a model with its scenario; the same object for the same source within a process."""
    name, parts = source.name, build(source)
    if not isinstance(parts, tuple) or len(parts) != 4:
        raise ModelError(
            f"model {name!r} returned {_kind(parts)}; expected (system, observer, cost, scenario), "
            "as qpmhe.models.Example holds them."
        )
    options = isinstance(parts[3], dict)
    check_parts(
        name, parts, " A dict of options in its place is enough for a record." if options else ""
    )
    return Example(*parts)


def check_parts(name: str, parts: Sequence[Any], remedy: str = "") -> None:
    """Raise `ModelError` unless these are system, observer, cost and scenario, or the first few."""
    for part, (kind, what) in zip(parts, _PARTS, strict=False):
        if not isinstance(part, kind):
            raise ModelError(
                f"model {name!r} returned {_kind(part)} for its {what}; expected "
                f"qpmhe's {kind.__name__}.{remedy}"
            )


def _kind(value: Any) -> str:
    if value is None:
        return "None"
    name = type(value).__name__
    words = f"a{'n' * (name[0] in 'aeiouAEIOU')} {name}"
    return f"{words} of {len(value)}" if isinstance(value, tuple) else words


def code_place(error: BaseException, file: Path | None) -> str:
    """File and line of the user's code that raised an error, as ``file, line 3: ``."""
    chain: list[BaseException] = []
    one: BaseException | None = error
    while one is not None and one not in chain:
        chain.append(one)
        one = one.__cause__
    for one in reversed(chain):
        if isinstance(one, SyntaxError) and one.filename and one.lineno:
            return f"{one.filename}, line {one.lineno}: "
        frames = [
            frame for frame in traceback.extract_tb(one.__traceback__)
            if file is not None and _is_users(Path(frame.filename), file)
        ]
        if frames:
            return f"{frames[-1].filename}, line {frames[-1].lineno}: "
    return ""


def _is_users(code: Path, file: Path) -> bool:
    if any(code.is_relative_to(folder) for folder in _PACKAGES):
        return False
    if code == file:
        return True
    # A folder may have an environment with other people's packages in it.
    return code.is_relative_to(file.parent) and not (
        {"site-packages", "dist-packages"} & set(code.relative_to(file.parent).parts)
    )


def _arguments(text: str, inside: str, kind: str) -> dict[str, Any]:
    try:
        call = ast.parse(f"f({inside})", mode="eval").body
        if not isinstance(call, ast.Call) or call.args:
            raise ValueError("a value without keyword")
        pairs = [(item.arg, ast.literal_eval(item.value)) for item in call.keywords]
        if any(key is None for key, _ in pairs):
            raise ValueError("two asterisks")
    except (SyntaxError, ValueError) as error:
        raise ModelError(
            f"the arguments of {kind} {text!r} cannot be read ({error}); expected plain values "
            "by keyword, as in chain_of_masses(masses=2)."
        ) from error
    return {str(key): value for key, value in pairs}


def _function(source: ModelSource) -> Callable[..., Any]:
    name = source.name
    if ":" not in source.where:
        return catalogue()[source.where]
    place, _, attribute = source.where.rpartition(":")
    try:
        module, now = imported(place)
    except (Exception, SystemExit) as error:
        raise _failure(source, " cannot be imported", error) from error
    if source.fingerprint and now != source.fingerprint:
        raise ModelError(
            f"{source.kind} {name!r}: {place}, or a file that it imports, differs from the one "
            "that the study was started with; copy the same files to all machines, and give the "
            "command again."
        )
    function = getattr(module, attribute, None)
    if not callable(function):
        raise ModelError(f"{source.kind} {name!r}: {place} has no function {attribute}.")
    found: Callable[..., Any] = function
    return found


def _failure(source: ModelSource, what: str, error: BaseException) -> ModelError:
    if isinstance(error, SystemExit):
        said = (
            f"it ends the program; put what is not the {source.kind} behind "
            "if __name__ == '__main__'"
        )
    elif isinstance(error, QpmheError):
        said = str(error)
    elif isinstance(error, SyntaxError):  # its text would repeat file and line
        where = f" in {error.text.strip()!r}" if error.text else ""
        said = f"{type(error).__name__}: {error.msg}{where}"
    else:
        said = f"{type(error).__name__}: {error}"
    place = code_place(error, source.file)
    return ModelError(f"{place}{source.kind} {source.name!r}{what}: {said.rstrip('.')}.")


def module_file(place: str) -> Path | None:
    """The file of a module, found without importing it; packages above it are imported.

    None for our own: their version identifies them.
    """
    if place.partition(".")[0] in (one.name for one in _PACKAGES):
        return None
    importlib.invalidate_caches()
    try:
        with _import_path(place):
            specification = importlib.util.find_spec(place)
    except Exception:  # importing the module reports what is wrong
        return None
    if specification is None or not specification.has_location or specification.origin is None:
        return None
    path = Path(specification.origin).resolve()
    return path if path.is_file() else None


def fingerprint(path: Path) -> str:
    """Digest of a file, and of the files in its folder that it imports."""
    digest = hashlib.sha256(path.read_bytes())
    for file in sorted(_files(path)[1:]):
        digest.update(f"\0{file.relative_to(path.parent).as_posix()}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def imported(place: str) -> tuple[ModuleType, str]:
    """Import a module as its files are now, again if they have changed in this process."""
    path = Path(place) if place.endswith(".py") else module_file(place)
    now = "" if path is None else fingerprint(path)
    if path is not None and _imported_as.get(place, now) != now:
        _forget(set(_files(path)))
    _imported_as[place] = now
    if place.endswith(".py"):
        return _import_file(Path(place)), now
    with _import_path(place):
        return importlib.import_module(place), now


def _files(path: Path) -> list[Path]:
    """A file, first, and those of its folder that it imports, at whatever depth."""
    top = next(one for one in path.parents if not (one / "__init__.py").is_file())
    # These packages import no model: in a checkout of them, they would be read for nothing.
    others = [
        one.name for one in _PACKAGES
        if not (path.is_relative_to(one) or one.is_relative_to(path.parent))
    ]
    finder = ModuleFinder([str(top), str(path.parent)], excludes=others)
    *packages, _ = parts = path.relative_to(top).with_suffix("").parts
    for depth in range(1, len(packages) + 1):  # whose own code is not the model's
        package: Any = finder.add_module(".".join(packages[:depth]))
        package.__path__ = [str(top.joinpath(*packages[:depth]))]
    with contextlib.suppress(Exception):  # the import reports it
        if packages:
            finder.import_hook(".".join(parts))
        else:
            finder.run_script(str(path))
    places = (getattr(one, "__file__", None) for one in finder.modules.values())
    found = {Path(place).resolve() for place in places if place} - {path}
    return [path, *(
        one for one in found if one.suffix == ".py" and one.is_relative_to(path.parent)
    )]


def _forget(files: set[Path]) -> None:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and Path(file).resolve() in files:
            del sys.modules[name]


@contextlib.contextmanager
def _import_path(place: str) -> Iterator[None]:
    """Let a file import those beside it; a module may lie in the working directory."""
    is_file = place.endswith(".py")
    folder = str(Path(place).parent if is_file else Path.cwd())
    # A console script has its own folder in the path, not the one it is called from.
    if not is_file and ("" in sys.path or folder in sys.path):
        yield
        return
    sys.path.insert(0 if is_file else len(sys.path), folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # the model may have changed the path
            sys.path.remove(folder)


def file_of(thing: Any) -> Path | None:
    """The file of a user that defines a function or class, if it was imported as a model's is."""
    name = str(getattr(thing, "__module__", ""))
    module = sys.modules.get(name) if name.startswith(_PREFIX) else None
    return None if module is None else Path(str(module.__file__))


def import_file(path: Path) -> None:
    """Import a file of a user, whose functions another process may know, with those beside it."""
    with _import_path(str(path)):
        _import_file(path)


def _import_file(path: Path) -> ModuleType:
    name = f"{_PREFIX}{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
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
