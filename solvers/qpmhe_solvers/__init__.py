"""QP backends for trajectories: convex QPs in, judged solutions out, estimation unknown."""

from .errors import BackendError, InvalidInputError, OptionError, QpmheError, ShapeError
from .options import SolverOptions
from .qp import QP, band_index
from .registry import Backend, available, backend, backends, create, register, unregister
from .solution import RawSolution, Residuals, Solution, SolveStatus
from .solver import Solver

__all__ = [
    "QP",
    "Backend",
    "BackendError",
    "InvalidInputError",
    "OptionError",
    "QpmheError",
    "RawSolution",
    "Residuals",
    "ShapeError",
    "Solution",
    "SolveStatus",
    "Solver",
    "SolverOptions",
    "available",
    "backend",
    "backends",
    "band_index",
    "create",
    "register",
    "unregister",
]
