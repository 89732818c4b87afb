"""Options of the estimator, validated once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from qpmhe_solvers import Solver, SolverOptions

from .._checks import choice, count, dimension, flag, positive
from ..errors import BackendError, OptionError
from .limits import PATIENCE

Infeasible = Literal["drop_rows", "restore"]
Candidate = Literal["observer", "reinitialized"]
Arrival = Literal["observer", "smoothed"]
ProjectionMetric = Literal["observer", "diagonal"]
Engine = Literal["auto", "python", "compiled"]

# Bounds the sequence of QPs with max_qps=None where it does not converge.
_SAFETY_LIMIT = 100
_SOLVER_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Settings:
    """Options of `MovingHorizonEstimator`, which documents each."""

    horizon: int
    backend: str | Solver = "auto"
    max_qps: int | None = 1
    max_solver_iterations: int | None = None
    solver_tolerance: float = _SOLVER_TOLERANCE
    tolerance: float = 1e-9
    engine: str = "auto"
    project_observer: bool = True
    projection_metric: str = "observer"
    infeasible: str = "drop_rows"
    warm_start: bool = False
    candidate: str = "observer"
    time_budget: float | None = None
    isolated: bool = False
    arrival: str = "observer"
    parameters: tuple[float, ...] = ()
    restart: bool = False

    def __post_init__(self) -> None:
        # Stored as Python's int: not all code that reads them accepts NumPy's integers.
        object.__setattr__(self, "horizon", dimension("horizon", self.horizon, 1))
        if self.max_qps is not None:
            count("max_qps", self.max_qps, 0, " None iterates to convergence.")
        if self.max_solver_iterations is not None:
            count(
                "max_solver_iterations", self.max_solver_iterations, 1,
                " None leaves the solver's default; max_qps=0 skips the QPs.",
            )
        positive("solver_tolerance", self.solver_tolerance)
        positive("tolerance", self.tolerance)
        if self.time_budget is not None:
            positive("time_budget", self.time_budget)
        for name in ("project_observer", "warm_start", "isolated", "restart"):
            flag(name, getattr(self, name))
        for name, choices in (
            ("engine", get_args(Engine)),
            ("projection_metric", get_args(ProjectionMetric)),
            ("infeasible", get_args(Infeasible)),
            ("candidate", get_args(Candidate)),
            ("arrival", get_args(Arrival)),
        ):
            choice(name, getattr(self, name), choices)
        if self.restart and self.candidate == "reinitialized":
            raise OptionError(
                "restart is True, but candidate='reinitialized' restarts the observer at each "
                "sample; leave one of them out."
            )
        if self.isolated and self.engine == "compiled":
            raise OptionError(
                "isolated is True, but engine='compiled' solves its QPs itself, without a "
                "backend; take engine='python', or leave isolated out."
            )
        if isinstance(self.backend, Solver):
            self._take_limits_of(self.backend)

    def _take_limits_of(self, solver: Solver) -> None:
        """Take the limits of a solver, and reject settings that contradict them."""
        options = getattr(solver, "options", None)
        if not isinstance(options, SolverOptions):
            raise BackendError(
                f"the solver {type(solver).__name__} has no options; call "
                "super().__init__(options) in its __init__."
            )
        if self.engine == "compiled":
            raise OptionError(
                f"backend is {solver!r}, but engine='compiled' solves its QPs itself; take "
                "engine='python', or leave backend out."
            )
        if self.isolated:
            raise OptionError(
                f"isolated is True, but backend is {solver!r}, an existing solver; make it with "
                "qpmhe.solvers.create(name, options, isolated=True)."
            )
        tolerance = float(self.solver_tolerance)
        for name, value, default, option in (
            ("max_solver_iterations", self.max_solver_iterations, None, "max_iterations"),
            ("solver_tolerance", tolerance, _SOLVER_TOLERANCE, "absolute_tolerance"),
        ):
            own = getattr(options, option)
            if value not in (default, own):
                raise OptionError(
                    f"{name} is {value!r}, but the solver given as backend has {option}={own!r}; "
                    f"leave {name} out, or make the solver with "
                    f"SolverOptions({option}={value!r})."
                )
            object.__setattr__(self, name, own)
        if None not in (self.time_budget, options.time_limit) and (
            self.time_budget != options.time_limit
        ):
            raise OptionError(
                f"time_budget is {self.time_budget!r}, but the solver given as backend has "
                f"time_limit={options.time_limit!r}; leave one of them out: with a budget, each "
                "QP gets the time that remains."
            )

    @property
    def solver_options(self) -> SolverOptions:
        """Limits and accuracy of a solver that is made for these settings."""
        return SolverOptions(
            max_iterations=self.max_solver_iterations,
            absolute_tolerance=float(self.solver_tolerance),
            time_limit=None if self.time_budget is None else float(self.time_budget),
        )

    @property
    def needs_python(self) -> bool:
        """Whether these settings ask for a QP solver, which only the Python step uses."""
        is_own = isinstance(self.backend, str) and self.backend in ("auto", "banded")
        return self.isolated or not is_own

    @property
    def projection(self) -> str | None:
        """The metric in which the observer is projected onto X; None where it is not."""
        return self.projection_metric if self.project_observer else None

    @property
    def patience(self) -> int:
        """QPs in a row that may stay unsolved; 0 for any number, where a cap asks for that."""
        own_cap = self.max_solver_iterations is not None or self.time_budget is not None
        return 0 if self.max_qps is not None or own_cap else PATIENCE

    @property
    def backend_name(self) -> str:
        """The backend, as messages name it."""
        return self.backend if isinstance(self.backend, str) else type(self.backend).__name__

    @property
    def qp_limit(self) -> int:
        """Largest number of QPs in one step."""
        return _SAFETY_LIMIT if self.max_qps is None else self.max_qps
