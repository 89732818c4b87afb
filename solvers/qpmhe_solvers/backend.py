"""Description of a backend: its capabilities and its solver factory."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib import metadata
from importlib.util import find_spec

from .errors import BackendError, QpmheError, report_unknown_options
from .options import SolverOptions
from .solver import Solver

_NAME = re.compile(r"\w[\w.:+-]*")
_MATRICES = ("banded", "csc", "dense")


@report_unknown_options
@dataclass(frozen=True)
class Backend:
    """One QP backend and its capabilities.

    Parameters
    ----------
    name : str
        The public name: letters, digits, and any of ``_ . : + -``, the first one a letter, a digit
        or ``_``.
    factory : callable
        ``factory(options)`` makes a `Solver`. Called only if the backend is available.
    method : str
        The kind of algorithm, in a word or two.
    module : str or None
        The module that it requires; None if it needs no package.
    distribution : str or None
        The module's name for ``pip install``.
    matrices : str
        The view of the QP that it reads: ``banded``, ``csc`` or ``dense``.
    inequalities : bool
        Whether it handles bounds and rows.
    iteration_cap : bool
        Whether ``SolverOptions.max_iterations`` is honoured.
    iterate_at_cap : bool
        Whether it returns an iterate when the cap stops it.
    warm_start : bool
        Whether the start given to ``solve`` is used.
    time_limit : bool
        Whether ``SolverOptions.time_limit`` is honoured.
    keeps_duals : bool
        Whether the last multipliers, moved by ``Solver.shift``, start the next solve.
    reports_infeasibility : bool
        Whether its message says "infeasible" if a QP has no feasible point.
    keeps_workspace : bool
        Whether the solver is set up once and then updated, not set up for each QP.

    Raises
    ------
    BackendError
        If the name is not as above, the factory is not callable, or a value has the wrong type.
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
    reports_infeasibility: bool = False
    keeps_workspace: bool = False

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise BackendError(
                f"the name of a backend is {name!r}; expected letters, digits and any of "
                "_ . : + -, such as 'my_solver'."
            )
        if not callable(self.factory):
            raise BackendError(
                f"the factory of backend {name!r} is {self.factory!r}; expected a callable that "
                "makes a Solver of SolverOptions: give the class itself, not an instance of it."
            )
        if self.matrices not in _MATRICES:
            raise BackendError(
                f"matrices of backend {name!r} is {self.matrices!r}; expected one of "
                f"{', '.join(map(repr, _MATRICES))}: the view of the QP that it reads most."
            )
        for one in fields(self):
            value = getattr(self, one.name)
            if one.type == "bool" and not isinstance(value, bool):
                raise BackendError(
                    f"{one.name} of backend {name!r} is {value!r}; expected True or False."
                )
        for what in ("method", "module", "distribution"):
            value = getattr(self, what)
            if not (isinstance(value, str) and value) and (what == "method" or value is not None):
                raise BackendError(
                    f"{what} of backend {name!r} is {value!r}; expected a text"
                    + ("." if what == "method" else ", or None if it needs no package.")
                )

    @property
    def available(self) -> bool:
        """Whether its module can be found, without importing it."""
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


def make_solver(backend: Backend, options: SolverOptions) -> Solver:
    """Make the solver of a backend, registered or not, whose package is installed."""
    try:
        solver: object = backend.factory(options)
    except QpmheError:
        raise
    except (Exception, SystemExit) as error:
        remedy = (
            f"reinstall {backend.distribution}, or use another backend"
            if backend.distribution
            else "correct the factory: factory(options) must return a Solver"
        )
        raise BackendError(
            f"backend {backend.name!r} cannot be made: {type(error).__name__}: {error}; {remedy}."
        ) from error
    if not isinstance(solver, Solver):
        raise BackendError(
            f"the factory of backend {backend.name!r} made {solver!r}; expected an instance of a "
            "subclass of qpmhe.solvers.Solver."
        )
    if not isinstance(getattr(solver, "options", None), SolverOptions):
        raise BackendError(
            f"the solver of backend {backend.name!r} has no options; call "
            "super().__init__(options) in its __init__."
        )
    return solver
