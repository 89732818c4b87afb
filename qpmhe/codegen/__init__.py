"""C code to take away: a whole estimator as one file without dependencies."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from qpmhe_solvers.values import shown

from .._checks import flag
from ..errors import InvalidInputError, OptionError
from .ahead import Compiled, compile, engine_choice, system_of
from .needs import Needs

if TYPE_CHECKING:
    from ..estimation.estimator import MovingHorizonEstimator
    from .guard import Guarding

__all__ = ["Compiled", "Needs", "Written", "compile", "engine_choice", "write"]

# Headers that a compiler, or its own headers, would find in the place of a system's.
_SYSTEM_HEADERS = frozenset((
    "aio", "alloca", "assert", "complex", "ctype", "dirent", "dlfcn", "endian", "errno",
    "error", "fcntl", "features", "fenv", "float", "ftw", "getopt", "glob", "grp", "iconv",
    "ieee754", "inttypes", "iso646", "libgen", "libintl", "limits", "link", "locale", "malloc",
    "math", "memory", "monetary", "netdb", "new", "omp", "paths", "poll", "pthread", "pwd",
    "regex", "resource", "sched", "search", "semaphore", "setjmp", "signal", "spawn", "stab",
    "stdalign", "stdarg", "stdatomic", "stdbool", "stdbit", "stdckdint", "stddef", "stdint",
    "stdio", "stdlib", "stdnoreturn", "string", "strings", "syscall", "sysexits", "syslog",
    "termios", "tgmath", "threads", "time", "types", "uchar", "ucontext", "unistd", "utime",
    "values", "varargs", "version", "wait", "wchar", "wctype",
))
_LONGEST_NAME = 60


class Written(tuple[Path, ...]):
    """The paths of written files.

    Attributes
    ----------
    needs : Needs
        What a step takes at most.
    """

    needs: Needs

    def __new__(cls, paths: Iterable[Path], needs: Needs) -> Written:
        """The paths of an estimator's files, and its needs."""
        made = super().__new__(cls, paths)
        made.needs = needs
        return made

    def __getnewargs__(self) -> tuple[tuple[Path, ...], Needs]:
        return tuple(self), self.needs


def write(
    estimator: MovingHorizonEstimator, directory: str | PathLike[str], *, name: str = "mhe",
    real: str = "double", fmu: bool = False, compiler: str | None = None,
    guard: Guarding | None = None,
) -> Written:
    """Write the estimator as a C99 header and source that need only libm.

    The source holds observer, growing window, candidate, Gauss-Newton QPs by a block-banded
    factorisation (active sets where inequalities bind), the check by the true cost, and the
    fallback, without allocation and with bounded loops. It is what ``engine="compiled"`` compiles,
    without what this estimator does not use. Gain, options and present weights and sets of the
    estimator become ``<name>_default_settings``; the top of the header says how to call it.
    Parameters are the last inputs of each sample.

    Parameters
    ----------
    estimator : MovingHorizonEstimator
        What to write: a traced system or one of `qpmhe.from_casadi`, whose nonlinear constraints
        are traced, too; an observer of the package's own classes; a `QuadraticCost` or a
        `RobustCost`, whose losses may be your own if their methods have no branch on a value. Its
        measurements so far are not written.
    directory : str or path
        The directory; made if it does not exist.
    name : str
        Name of the files and prefix of all public names: a C identifier of at most 60 letters,
        and not the name of a system's header, such as ``math``.
    real : {"double", "float"}
        Precision. In single precision inequalities are kept to 1e-5 of their scale, and
        tolerances are no smaller than what can be distinguished.
    fmu : bool
        Whether to write ``<name>.fmu`` beside them: a unit for co-simulation by FMI 2.0, with
        inputs y and u, the outputs state, filtered, cost, candidate_cost, status and qps, and the
        parameter initial_state. Its communication step is the sampling time, 1 for a model in
        discrete time. It holds the C sources, and a library for this kind of machine.
    compiler : str, optional
        The command of a C compiler on this machine, with options; a cross-compiler for the target,
        or any other. With it, header and ``needs`` also state memory, code and stack of the source
        as this command compiles it. Only GCC tells the stack, from version 10 on.
    guard : Monitor, optional
        A `qpmhe.certificates.Monitor` of this estimator with ``guard=True`` that has seen no
        sample. Its guard is written, too, as ``<name>_guard_start`` and ``<name>_guard_check``,
        with the bounds in advance from the first sample on; an FMU's outputs state and filtered are
        the guarded ones. Double precision only.

    Returns
    -------
    header, source : Path
        ``<name>.h`` and ``<name>.c``; with ``fmu``, also the path of the FMU. Its attribute
        ``needs`` says what a step takes at most, operations included: see `Needs`.

    Raises
    ------
    OptionError, CompilationError
        If something has no C form, or an option is unknown; if CasADi has no C code for the model,
        or an FMU is requested and there is no C compiler, or there is not the one that is named.
    InvalidInputError
        If this is no estimator, if the guard is none, or the directory cannot be written.
    CertificateError, MismatchError
        If nothing is proved for a guard of this estimator.
    """
    from ..estimation.estimator import MovingHorizonEstimator
    from .fmu import write_fmu
    from .guard import guarded_files
    from .library import generated
    from .needs import measured
    from .operations import bounded
    from .strip import stripped

    if not isinstance(estimator, MovingHorizonEstimator):
        raise InvalidInputError(
            f"estimator is {estimator!r}; expected a qpmhe.MovingHorizonEstimator."
        )
    _check_name(name)
    if real not in ("double", "float"):
        raise OptionError(f"real is {real!r}; expected 'double' or 'float'.")
    flag("fmu", fmu)
    if guard is not None and not callable(getattr(type(guard), "c_form", None)):
        raise InvalidInputError(
            f"guard is {shown(guard)}; expected a qpmhe.certificates.Monitor with guard=True."
        )
    if guard is not None and real != "double":
        raise OptionError(
            f"real is {real!r}, and a guard is proved for an observer in double precision; write "
            "it with real='double', or without a guard."
        )
    form = None if guard is None else guard.c_form(estimator)
    files, needs = generated(
        system_of(estimator), estimator.observer, estimator.cost, estimator.settings, name, real,
        estimator.usual,
    )
    if form is not None:
        files = guarded_files(files, name, form)
    files = dict(zip(files, stripped(*files.values()), strict=True))
    needs = replace(needs, **bounded("".join(files.values()), name, needs))
    if compiler is not None:
        needs = replace(needs, **measured(files, name, compiler))
    header, types = f"{name}.h", f"typedef {real} {name}_real;\n"
    files[header] = files[header].replace(types, f"{types}\n{needs.header(name)}", 1)
    suffixes = ("h", "c", "fmu") if fmu else ("h", "c")
    try:
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="ascii")
        if fmu:
            initial = estimator.initial_state
            write_fmu(
                folder / f"{name}.fmu", name, files, estimator.system, initial, form is not None
            )
    except (OSError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"directory is {directory!r}, which cannot be written ({error})."
        ) from error
    return Written((folder / f"{name}.{suffix}" for suffix in suffixes), needs)


def _check_name(name: str) -> None:
    """Raise where this is no name of C files."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise OptionError(
            f"name is {name!r}; expected a C identifier: letters, digits and underscores."
        )
    if len(name) > _LONGEST_NAME:
        raise OptionError(
            f"name has {len(name)} letters; expected at most {_LONGEST_NAME}, since compilers "
            "distinguish no more."
        )
    if name.lower() in _SYSTEM_HEADERS:
        raise OptionError(
            f"name is {name!r}, but <{name.lower()}.h> is a header of the system, which "
            f"{name}.h would hide; take another, such as 'mhe_{name}'."
        )
