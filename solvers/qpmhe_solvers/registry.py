"""The backends that there are, what they can do, and the door through which users add theirs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec

from .errors import BackendError
from .options import SolverOptions
from .solver import Solver

__all__ = ["Backend", "available", "backend", "backends", "create", "register", "unregister"]


@dataclass(frozen=True)
class Backend:
    """One QP backend and its capabilities.

    Parameters
    ----------
    name : str
        The name that users write.
    factory : callable
        ``factory(options)`` makes a `Solver`. Called only if the backend is available.
    method : str
        The kind of algorithm, in a word or two.
    module : str or None
        The module whose presence makes it available; None if nothing more is needed.
    distribution : str or None
        What ``pip install`` calls that module.
    matrices : str
        The view of the QP that it reads: ``banded``, ``csc`` or ``dense``.
    inequalities : bool
        Whether it handles bounds and rows.
    iteration_cap : bool
        Whether ``SolverOptions.max_iterations`` is honoured.
    iterate_at_cap : bool
        Whether there is an iterate to judge when the cap stops it.
    warm_start : bool
        Whether the start given to ``solve`` is used.
    time_limit : bool
        Whether ``SolverOptions.time_limit`` is honoured.
    keeps_duals : bool
        Whether multipliers of the last solve start the next one, moved by ``Solver.shift``.
    tells_infeasible : bool
        Whether its message says "infeasible" where a QP has no feasible point.
    keeps_workspace : bool
        Whether the solver is set up once and updated from then on, not anew for each QP.
    """

    name: str
    factory: Callable[[SolverOptions], Solver]
    method: str
    module: str | None = None
    distribution: str | None = None
    matrices: str = "dense"
    inequalities: bool = True
    iteration_cap: bool = False
    iterate_at_cap: bool = False
    warm_start: bool = False
    time_limit: bool = False
    keeps_duals: bool = False
    tells_infeasible: bool = False
    keeps_workspace: bool = False

    @property
    def available(self) -> bool:
        """Whether its module can be found; nothing is imported to find out."""
        if self.module is None:
            return True
        try:
            return find_spec(self.module) is not None
        except (ImportError, ValueError):  # a parent package that is missing or broken
            return False

    @property
    def version(self) -> str:
        """The installed version, or an empty string."""
        try:
            return metadata.version(self.distribution) if self.distribution else ""
        except metadata.PackageNotFoundError:
            return ""


_REGISTRY: dict[str, Backend] = {}
_GROUP = "qpmhe.backends"
_looked = False


def register(entry: Backend) -> None:
    """Add a backend, so that its name can be used wherever a backend is named.

    An installed package adds its own without being imported by anyone: by an entry point of
    the group ``qpmhe.backends`` to a `Backend`, or to a function without arguments that
    returns one, or several. These are loaded when a backend is first looked up.

    Parameters
    ----------
    entry : Backend
        Its name must be new.

    Raises
    ------
    BackendError
        If the name is taken.
    """
    if entry.name in _REGISTRY:
        raise BackendError(
            f"backend {entry.name!r} is registered already; choose another name or "
            "unregister it first."
        )
    _REGISTRY[entry.name] = entry


def unregister(name: str) -> None:
    """Take a backend off the list.

    Parameters
    ----------
    name : str
        A registered name.

    Raises
    ------
    BackendError
        If there is none of that name.
    """
    backend(name)
    del _REGISTRY[name]


def backends() -> tuple[Backend, ...]:
    """All registered backends, installed or not, in order of registration."""
    _look_for_plugins()
    return tuple(_REGISTRY.values())


def available() -> tuple[str, ...]:
    """Names of the backends that can be used here."""
    _look_for_plugins()
    return tuple(name for name, entry in _REGISTRY.items() if entry.available)


def backend(name: str) -> Backend:
    """Look up a registered backend.

    Parameters
    ----------
    name : str
        A registered name.

    Raises
    ------
    BackendError
        If there is none of that name; the text lists the names there are.
    """
    _look_for_plugins()
    entry = _REGISTRY.get(name) if isinstance(name, str) else None
    if entry is None:
        raise BackendError(
            f"backend {name!r} is not known; expected one of {', '.join(_REGISTRY)}."
        )
    return entry


def create(name: str, options: SolverOptions | None = None) -> Solver:
    """Make a solver.

    Parameters
    ----------
    name : str
        A registered name.
    options : SolverOptions, optional
        Limits and accuracy; the defaults if left out.

    Raises
    ------
    BackendError
        If the name is unknown, or its package is not installed.
    """
    entry = backend(name)
    if not entry.available:
        package = entry.distribution or entry.module
        raise BackendError(
            f"backend {name!r} needs the package {package}, which is not installed; "
            f"pip install {package}, or use one of {', '.join(available())}."
        )
    return entry.factory(options if options is not None else SolverOptions())


def _look_for_plugins() -> None:
    """Register, once, what installed packages offer as entry points."""
    global _looked
    if _looked:
        return
    _looked = True
    for point in metadata.entry_points(group=_GROUP):
        try:
            given = point.load()
            given = given if isinstance(given, Backend) else given()
            for entry in (given,) if isinstance(given, Backend) else tuple(given):
                if not isinstance(entry, Backend):
                    raise TypeError(f"expected a Backend, got {type(entry).__name__}")
                register(entry)
        except Exception as error:  # a package that is broken must not break ours
            warnings.warn(
                f"the entry point {point.name!r} ({point.value}) of the group {_GROUP!r} brings "
                f"no backend: {type(error).__name__}: {error}. Mend or uninstall its package.",
                stacklevel=3,
            )


def _register_own() -> None:
    from .own import own_backends

    for entry in own_backends():
        register(entry)


_register_own()
