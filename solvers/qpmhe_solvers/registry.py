"""The registry of backends."""

from __future__ import annotations

import warnings
from importlib import metadata

from .active_set import ActiveSetSolver
from .auto import AutoSolver
from .backend import Backend, make_solver
from .banded import BandedSolver
from .dispatch import DISPATCHED
from .errors import BackendError, OptionError
from .native import NATIVE
from .options import SolverOptions
from .solver import Solver
from .values import shown

_REGISTRY: dict[str, Backend] = {}
_GROUP = "qpmhe.backends"
_looked = False


def register(backend: Backend) -> None:
    """Register a backend under its name.

    An installed package registers backends without being imported, by an entry point of the group
    ``qpmhe.backends`` to a `Backend`, or to a function without arguments that returns one or
    several. Entry points are loaded when a backend is first looked up.

    Parameters
    ----------
    backend : Backend
        Its name must be new.

    Raises
    ------
    BackendError
        If the name is taken, or ``backend`` is not a `Backend`.
    """
    if not isinstance(backend, Backend):
        raise BackendError(
            f"cannot register {backend!r}; expected a qpmhe.solvers.Backend, such as "
            "Backend('my_solver', MySolver, 'my method') for a class MySolver(Solver)."
        )
    if backend.name in _REGISTRY:
        raise BackendError(
            f"backend {backend.name!r} is registered already; choose another name or "
            "unregister it first."
        )
    _REGISTRY[backend.name] = backend


def unregister(name: str) -> None:
    """Remove the backend registered as ``name``.

    Raises
    ------
    BackendError
        If there is no backend of that name.
    """
    backend(name)
    del _REGISTRY[name]


def backends() -> tuple[Backend, ...]:
    """All registered backends, installed or not, in order of registration."""
    _look_for_plugins()
    return tuple(_REGISTRY.values())


def available() -> tuple[str, ...]:
    """Names of the installed backends."""
    _look_for_plugins()
    return tuple(name for name, known in _REGISTRY.items() if known.available)


def backend(name: str) -> Backend:
    """The backend registered as ``name``.

    Raises
    ------
    BackendError
        If there is no backend of that name; the message lists the known names.
    """
    _look_for_plugins()
    found = _REGISTRY.get(name) if isinstance(name, str) else None
    if found is None:
        raise BackendError(
            f"backend {shown(name)} is not known; expected one of {', '.join(_REGISTRY)}. Your "
            "own must be registered before, by qpmhe.solvers.register(...); on the command line, "
            "by the model's file."
        )
    return found


def create(
    name: str, options: SolverOptions | None = None, *, isolated: bool = False
) -> Solver:
    """Make a solver.

    Parameters
    ----------
    name : str
        A registered name.
    options : SolverOptions, optional
        Limits and accuracy; the defaults if left out.
    isolated : bool
        Whether it solves in a separate process: a crash then only fails the QP, and a time limit
        holds for every backend. It adds some tenths of a millisecond to each QP.

    Raises
    ------
    BackendError
        If the name is unknown, its package is not installed, its factory does not make a `Solver`,
        or it cannot be sent to another process.
    OptionError
        If ``options`` has another type.
    """
    if not isinstance(isolated, bool):
        raise OptionError(f"isolated is {shown(isolated)}; expected True or False.")
    found = backend(name)
    if options is not None and not isinstance(options, SolverOptions):
        raise OptionError(
            f"options is {shown(options)}; expected qpmhe.solvers.SolverOptions, such as "
            "SolverOptions(max_iterations=5), or None."
        )
    if not found.available:
        package = found.distribution or found.module
        raise BackendError(
            f"backend {name!r} needs the package {package}, which is not installed; "
            f"pip install {package}, or use one of {', '.join(available())}."
        )
    options = SolverOptions() if options is None else options
    if isolated:
        from .isolated import IsolatedSolver  # late: rarely used

        return IsolatedSolver(found, options)
    return make_solver(found, options)


def _look_for_plugins() -> None:
    """Register, once, what installed packages offer as entry points."""
    global _looked
    if _looked:
        return
    _looked = True
    for point in metadata.entry_points(group=_GROUP):
        try:
            given = point.load()
            found = given if isinstance(given, Backend) else given()
            for one in (found,) if isinstance(found, Backend) else tuple(found):
                register(one)
        except (Exception, SystemExit) as error:  # a broken package must not break ours
            warnings.warn(
                f"the entry point {point.name!r} ({point.value}) of the group {_GROUP!r} provides "
                f"no backend: {type(error).__name__}: {error}. Correct or uninstall its package.",
                stacklevel=3,
            )


register(Backend(  # the default one
    "auto", AutoSolver, "banded, then a QP", matrices="banded", iteration_cap=True,
    iterate_at_cap=True, time_limit=True, reports_infeasibility=True, keeps_workspace=True,
))
register(Backend(
    "banded", BandedSolver, "banded Cholesky", matrices="banded", inequalities=False,
    keeps_workspace=True,
))
register(Backend(
    "active_set", ActiveSetSolver, "active set", matrices="banded", iteration_cap=True,
    iterate_at_cap=True, time_limit=True, keeps_duals=True, reports_infeasibility=True,
))
for _one in sorted((*NATIVE.values(), *DISPATCHED), key=lambda backend: backend.name):
    register(_one)
