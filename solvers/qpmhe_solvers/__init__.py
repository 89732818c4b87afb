"""QP backends for trajectories: convex QPs in, verified solutions out."""

from .backend import Backend
from .conformance import Capabilities, CheckOutcome, Conformance, check, measure
from .errors import BackendError, InvalidInputError, OptionError, QpmheError, ShapeError
from .files import StoredQP, dump, load
from .options import SolverOptions
from .qp import QP, band_index
from .recorder import Recording, RecordingWarning
from .registry import available, backend, backends, create, register, unregister
from .solution import RawSolution, Residuals, Solution, SolveStatus
from .solver import Solver

__all__ = [
    "QP",
    "Backend",
    "BackendError",
    "Capabilities",
    "CheckOutcome",
    "Conformance",
    "InvalidInputError",
    "OptionError",
    "QpmheError",
    "RawSolution",
    "Recording",
    "RecordingWarning",
    "Residuals",
    "ShapeError",
    "Solution",
    "SolveStatus",
    "Solver",
    "SolverOptions",
    "StoredQP",
    "available",
    "backend",
    "backends",
    "band_index",
    "check",
    "create",
    "dump",
    "load",
    "measure",
    "register",
    "unregister",
]
