"""Compile C source, check and load the library, and cache it on disk."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from .._version import __version__
from ..errors import CompilationError
from .folders import cache_folders, own_file, writable_folder

# Where a library keeps what is too large for the stack: see `model_source`.
_THREADS = "-DTHREAD_LOCAL=__thread"
# They keep infinities and NaN, and the order of operations: without contraction of a * b + c to
# one rounding, all levels give the same bits. The verdict compares costs that are stored, each
# computed once, so that it holds whichever way they were rounded.
_FLAGS = ("-std=c99", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno",
          "-fno-trapping-math", _THREADS)
# Tried in turn until the code is right. Without vectors, masked loads cannot go wrong.
_LEVELS = (("-O3", "-march=native"), ("-O2", "-fno-tree-vectorize"), ("-O0",))
# Folders of compilations in progress, in the cache; and the seconds after which none is.
_SCRATCH = "qpmhe-making-"
_STALE = 86400.0
NO_COMPILER = "there is no C compiler (cc, gcc or clang); install one, or set CC to its path."
# Seconds after which a compiler is taken to hang.
_PATIENCE = 600.0
# The note beside a library that could not be made, which counts for as long as _STALE.
_FAILED = "failed"
# Libraries that this process has checked: path and content.
_checked: set[tuple[str, str]] = set()


class WrongCodeError(CompilationError):
    """The compiled code does not pass its check at any level of optimisation."""


class NotCachedError(CompilationError):
    """The library is not in the cache, and the caller does not wait for a compiler."""


def find_compiler() -> list[str] | None:
    """The C compiler's command: ``$CC`` if set, else cc, gcc or clang; None without any."""
    named = os.environ.get("CC")
    if named is not None:
        try:
            command = shlex.split(named)
        except ValueError:  # quotation marks that do not close
            command = []
        path = shutil.which(command[0]) if command else None
        return [path, *command[1:]] if path else None
    for name in ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path is not None:
            return [path]
    return None


@lru_cache(maxsize=1)
def _processor() -> str:
    """What the machine code depends on: a home directory may serve several machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        lines = []
    wanted = {line for line in lines if line.startswith(("flags", "Features", "model name"))}
    return "\n".join((platform.machine(), platform.processor(), *sorted(wanted)))


def has_vectors() -> bool:
    """Whether the processor computes with four numbers at once, as ``factor_vectors.c`` does."""
    return " avx2" in _processor()


def compiled_library(
    files: dict[str, str] | Callable[[], dict[str, str]], main: str, key: str | None = None,
    check: Callable[[ctypes.CDLL], str] | None = None, patience: float | None = None,
) -> ctypes.CDLL:
    """Compile C source and load it; a library made before is loaded from the cache.

    With a key, which must differ where the source does, `files` may be a function that is called
    only to compile. Compilers make mistakes: if `check` finds one, the source is compiled again
    with less optimisation, and the cache remembers the level. With a `patience` in seconds, nobody
    has asked to compile: then all calls of the compiler take no longer, and where they have failed
    before, none is made for a day.
    """
    compiler = required_compiler()
    if key is None:
        files = files() if callable(files) else files
        key = "".join(f"{name}\0{files[name]}\0" for name in sorted(files))
    digest = _digest(compiler, main, key)
    for folder in cache_folders():
        if not os.access(folder, os.W_OK):
            ready = _loaded(folder, digest, check)
            if ready is not None:
                return ready
    folder = writable_folder()
    failed = folder / f"{digest}.{_FAILED}"
    if patience is not None and (before := _failure(failed)):
        raise CompilationError(f"{before.rstrip('.')}. It is not tried again; call qpmhe.compile.")
    try:
        library = _compiled(compiler, files, main, folder, digest, check, patience)
    except CompilationError as error:
        _replace(failed, f"{_checked_by()}\n{error}")
        raise
    failed.unlink(missing_ok=True)
    return library


def _compiled(
    compiler: list[str], files: dict[str, str] | Callable[[], dict[str, str]], main: str,
    folder: Path, digest: str, check: Callable[[ctypes.CDLL], str] | None, patience: float | None,
) -> ctypes.CDLL:
    """Compile with less and less optimisation, until the library is right."""
    deadline = None if patience is None else time.monotonic() + patience
    note = folder / f"{digest}.level"
    first, fault = _remembered(note)
    message = ""
    for level in range(first, len(_LEVELS)):
        path, seal = folder / f"{digest}-{level}.so", folder / f"{digest}-{level}.sha256"
        if not _intact(path, seal):
            files = files() if callable(files) else files
            try:
                message = _make(compiler, files, main, level, path, seal, deadline)
            except OSError as error:  # no output, no space left
                raise CompilationError(f"{path} cannot be made ({error}).") from error
            if message:  # not every compiler knows its machine by these flags
                continue
        try:
            library = ctypes.CDLL(str(path))
        except OSError as error:
            raise CompilationError(f"{path} cannot be loaded ({error}).") from error
        found = _fault(library, seal, check)
        if not found:
            if level > first:
                _remember(note, level, fault)
            return library
        fault = found
        _remember(note, level + 1, fault)
    if not fault:
        raise CompilationError(f"{' '.join(compiler)} failed: {message}")
    raise WrongCodeError(
        f"compiled by {' '.join(compiler)}, the step does not pass its check at any level of "
        f"optimisation ({fault}): the compiler is at fault, or rounding decides in this estimator. "
        "Take engine='python', or set CC to another compiler."
    )


def shared_library(sources: list[Path], target: Path) -> None:
    """Compile C sources to a shared library for any machine of this kind, beside the cache."""
    compiler = required_compiler()
    message = _run([*compiler, "-O2", "-fvisibility=hidden", _THREADS], (), sources, target, None)
    if message:
        raise CompilationError(f"{' '.join(compiler)} failed: {message}")


def cached_library(
    main: str, key: str, check: Callable[[ctypes.CDLL], str] | None = None
) -> ctypes.CDLL | None:
    """The library that `compiled_library` made for this key; None if it would compile."""
    compiler = find_compiler()
    if compiler is None:
        return None
    digest = _digest(compiler, main, key)
    for folder in cache_folders():
        found = _loaded(folder, digest, check)
        if found is not None:
            return found
    return None


def known_failure(main: str, key: str) -> str:
    """Why compiling the library of this key has failed in the last day; empty if it has not."""
    digest = _digest(required_compiler(), main, key)
    found = (_failure(folder / f"{digest}.{_FAILED}") for folder in cache_folders())
    return next(filter(None, found), "")


def cached_files(main: str) -> Iterator[Path]:
    """All libraries in the cache that were compiled from a file of this name."""
    for folder in cache_folders():
        yield from folder.glob(f"{Path(main).stem}-*.so")


def optimisation(library: Path) -> str:
    """The compiler's flags with which a library of the cache was found correct."""
    return " ".join(_LEVELS[int(library.stem.rpartition("-")[2])])


def check_any_cached(main: str) -> None:
    """Raise if the cache holds no such library, before anything is imported or traced."""
    required_compiler()
    if next(cached_files(main), None) is None:
        raise NotCachedError("its library is not in the cache; qpmhe.compile makes it.")


def required_compiler() -> list[str]:
    """The C compiler's command; raises `CompilationError` without any."""
    compiler = find_compiler()
    if compiler is None:
        raise CompilationError(NO_COMPILER)
    return compiler


def _digest(compiler: list[str], main: str, key: str) -> str:
    """Name of the library of a source in the cache."""
    stamp = os.stat(compiler[0])
    parts = (
        *compiler, str(stamp.st_size), str(stamp.st_mtime_ns), *_FLAGS, repr(_LEVELS),
        _processor(), key,
    )
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
    return f"{Path(main).stem}-{digest}"


def _loaded(
    folder: Path, digest: str, check: Callable[[ctypes.CDLL], str] | None
) -> ctypes.CDLL | None:
    """A library of a folder, at the level that it was found right at."""
    first, _ = _remembered(folder / f"{digest}.level")
    for level in range(first, len(_LEVELS)):
        path, seal = folder / f"{digest}-{level}.so", folder / f"{digest}-{level}.sha256"
        if not _intact(path, seal):
            continue
        try:
            library = ctypes.CDLL(str(path))
        except OSError:  # of another machine
            return None
        return None if _fault(library, seal, check) else library
    return None


def _fault(
    library: ctypes.CDLL, seal: Path, check: Callable[[ctypes.CDLL], str] | None
) -> str:
    """What is wrong with a library; an empty text if nothing is, or it was checked before."""
    if check is None:
        return ""
    content, _, checked = _seal(seal).partition("\n")
    if (library._name, content) in _checked or (content and checked == _checked_by()):
        return ""
    fault = check(library)
    if not fault and content:
        _checked.add((library._name, content))
        _replace(seal, f"{content}\n{_checked_by()}")
    return fault


def _checked_by() -> str:
    """The last line of the seal of a library that was checked: by whom, and with which LAPACK."""
    return f"right by qpmhe {__version__} and scipy {version('scipy')}"


def _seal(path: Path) -> str:
    """The hash of a library's content, and whether it was checked; empty if there is none."""
    content = own_file(path)  # None while another process replaces it
    return "" if content is None else content.decode("ascii", "replace")


def _replace(path: Path, text: str) -> None:
    """Write a small file in one motion, where that is possible."""
    scratch = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        scratch.write_text(text, encoding="utf-8")
        scratch.chmod(0o600)
        os.replace(scratch, path)
    except OSError:
        scratch.unlink(missing_ok=True)


def _remembered(note: Path) -> tuple[int, str]:
    """The first level that is not known to fail, and what was wrong with those before.

    What another version found counts no more: its check may have been at fault.
    """
    try:
        level, judge, fault = note.read_text(encoding="utf-8").split("\n", 2)
        if judge != _checked_by():
            return 0, ""
        return min(max(int(level), 0), len(_LEVELS)), fault
    except (OSError, ValueError):  # there is none, or it is damaged
        return 0, ""


def _remember(note: Path, level: int, fault: str) -> None:
    """Write the note; without it the next process tries all levels again."""
    _replace(note, f"{level}\n{_checked_by()}\n{fault}")


def _failure(note: Path) -> str:
    """Why compiling has failed in the last day, by this version; empty if it has not."""
    judge, _, reason = (own_file(note) or b"").decode("utf-8", "replace").partition("\n")
    try:
        is_new = time.time() - note.stat().st_mtime < _STALE
    except OSError:
        return ""
    return reason if is_new and judge == _checked_by() else ""


def _make(
    compiler: list[str], files: dict[str, str], main: str, level: int, path: Path, seal: Path,
    deadline: float | None,
) -> str:
    """Put the library into the cache; the compiler's message if it fails, else nothing."""
    _remove_stale(path.parent)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=_SCRATCH) as scratch:
        for name, text in files.items():
            Path(scratch, name).write_text(text, encoding="ascii")
        made, sealed = Path(scratch, "library.so"), Path(scratch, "seal")
        message = _run(compiler, _LEVELS[level], [Path(scratch, main)], made, deadline)
        if not message:
            sealed.write_text(_content(path.name, made.read_bytes()), encoding="ascii")
            made.chmod(0o700)  # what others can write is not loaded
            sealed.chmod(0o600)
            # Each in one motion; a process that sees the one without the other compiles, too.
            os.replace(made, path)
            os.replace(sealed, seal)
        return message


def _remove_stale(folder: Path) -> None:
    """Remove what compilations that were killed have left."""
    for scratch in folder.glob(f"{_SCRATCH}*"):
        try:
            if time.time() - scratch.stat().st_mtime > _STALE:
                shutil.rmtree(scratch)
        except OSError:  # another process was quicker, or it is not ours
            continue


def _intact(library: Path, seal: Path) -> bool:
    """Whether a library in the cache is what was put there, under this name, by this user."""
    content = own_file(library)
    return content is not None and _content(library.name, content) == _seal(seal).partition("\n")[0]


def _content(name: str, library: bytes) -> str:
    """Hash of a library and its name: a damaged one, or that of another source, has another."""
    return hashlib.sha256(name.encode() + b"\0" + library).hexdigest()


def _run(
    compiler: list[str], options: tuple[str, ...], sources: list[Path], target: Path,
    deadline: float | None,
) -> str:
    """Compile; what went wrong, or nothing."""
    command = [*compiler, *_FLAGS, *options, "-o", str(target), *map(str, sources), "-lm"]
    patience = _PATIENCE if deadline is None else max(deadline - time.monotonic(), 0.0)
    try:
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, errors="replace", start_new_session=True,
        ) as process:
            try:
                output, errors = process.communicate(timeout=patience)
            except BaseException:  # too late, or an interrupt, which only we have got
                _end(process)
                raise
    except subprocess.TimeoutExpired as error:
        raise CompilationError(
            f"{' '.join(compiler)} did not end within {error.timeout:.3g} s; set CC to another "
            "compiler."
        ) from error
    except OSError as error:
        return str(error)
    if process.returncode == 0:
        return ""
    return (errors or output).strip()[-2000:] or f"exit status {process.returncode}"


def _end(process: subprocess.Popen[str]) -> None:
    """End a compiler and those that it has started, which do the work."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):  # ended by itself
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.communicate()
