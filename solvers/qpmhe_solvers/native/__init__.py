"""Solvers called directly, with a workspace that is updated from QP to QP."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib import import_module

from ..backend import Backend
from ..options import SolverOptions
from ..solver import Solver

__all__ = ["NATIVE"]

_METHODS = {
    "clarabel": "interior point", "daqp": "dual active set", "osqp": "ADMM",
    "piqp": "interior point", "proxsuite": "augmented Lagrangian",
}


def _native(
    name: str, file: str, class_name: str, package: str, matrices: str = "csc",
    *, iterate_at_cap: bool = True, starts: bool = False, time_limit: bool = False,
) -> Backend:
    return Backend(
        name, partial(_make, file, class_name), _METHODS[package], package, package, matrices,
        iteration_cap=True, iterate_at_cap=iterate_at_cap, warm_start=starts,
        time_limit=time_limit, keeps_duals=starts, reports_infeasibility=True,
        keeps_workspace=True,
    )


def _make(file: str, class_name: str, options: SolverOptions) -> Solver:
    # Late: solvers are optional, and their import takes long.
    solver: Solver = getattr(import_module(f".{file}", __package__), class_name)(options)
    return solver


#: The backends of this folder, by name.
NATIVE: Mapping[str, Backend] = {
    backend.name: backend
    for backend in (
        _native("clarabel", "clarabel", "ClarabelSolver", "clarabel", time_limit=True),
        _native(
            "daqp", "daqp", "DaqpSolver", "daqp", "dense", iterate_at_cap=False, starts=True,
            time_limit=True,
        ),
        _native("osqp", "osqp", "OsqpSolver", "osqp", starts=True, time_limit=True),
        _native("piqp", "piqp", "PiqpSolver", "piqp"),
        _native("piqp_dense", "piqp", "PiqpDenseSolver", "piqp", "dense"),
        _native("proxqp", "proxqp", "ProxqpSolver", "proxsuite", "dense"),
        _native("proxqp_sparse", "proxqp", "ProxqpSparseSolver", "proxsuite"),
    )
}
