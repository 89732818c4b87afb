"""The QP backends, as `qpmhe.solvers`: the public names of the package ``qpmhe_solvers``."""

from qpmhe_solvers import (
    QP,
    Backend,
    RawSolution,
    Residuals,
    Solution,
    Solver,
    SolverOptions,
    SolveStatus,
    available,
    backend,
    backends,
    create,
    register,
    unregister,
)

__all__ = [
    "QP",
    "Backend",
    "RawSolution",
    "Residuals",
    "Solution",
    "SolveStatus",
    "Solver",
    "SolverOptions",
    "available",
    "backend",
    "backends",
    "create",
    "register",
    "unregister",
]
