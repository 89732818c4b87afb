"""The backends that this package brings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib import import_module

from .auto import AutoSolver
from .banded import BandedSolver
from .dispatch import TRANSLATIONS, DispatchSolver
from .options import SolverOptions
from .registry import Backend
from .solver import Solver

__all__ = ["own_backends"]


def own_backends() -> Iterator[Backend]:
    """All of them; nothing of any solver is imported."""
    yield Backend(
        "auto", AutoSolver, "banded, then a QP", matrices="banded",
        iteration_cap=True, iterate_at_cap=True, time_limit=True, tells_infeasible=True,
        keeps_workspace=True,
    )
    yield Backend(
        "banded", BandedSolver, "banded Cholesky", matrices="banded", inequalities=False,
        keeps_workspace=True,
    )
    yield from sorted((*_native(), *_dispatched()), key=lambda entry: entry.name)


def _native() -> Iterator[Backend]:
    """Solvers that keep a workspace."""
    interior, lagrangian = "interior point", "augmented Lagrangian"
    capped = {"iteration_cap": True, "iterate_at_cap": True, "keeps_workspace": True}
    certain = {**capped, "tells_infeasible": True}
    for name, class_name, method, module, flags in (
        ("clarabel", "ClarabelSolver", interior, "clarabel", {**certain, "time_limit": True}),
        (
            "daqp", "DaqpSolver", "dual active set", "daqp",
            {**certain, "iterate_at_cap": False, "time_limit": True, "warm_start": True,
             "keeps_duals": True, "matrices": "dense"},
        ),
        (
            "osqp", "OsqpSolver", "ADMM", "osqp",
            {**certain, "time_limit": True, "warm_start": True, "keeps_duals": True},
        ),
        ("piqp", "PiqpSolver", interior, "piqp", certain),
        ("piqp_dense", "PiqpDenseSolver", interior, "piqp", {**certain, "matrices": "dense"}),
        ("proxqp", "ProxqpSolver", lagrangian, "proxsuite", {**certain, "matrices": "dense"}),
        ("proxqp_sparse", "ProxqpSparseSolver", lagrangian, "proxsuite", certain),
    ):
        yield Backend(
            name, partial(_make_native, name, class_name), method, module, module,
            **{"matrices": "csc", **flags},  # type: ignore[arg-type]
        )


def _make_native(name: str, class_name: str, options: SolverOptions) -> Solver:
    solver: Solver = getattr(import_module(f".native.{name}", __package__), class_name)(options)
    return solver


def _dispatched() -> Iterator[Backend]:
    """Solvers through qpsolvers; those that have a native form here carry its name before."""
    methods = {
        "clarabel": ("interior point", "clarabel", "clarabel"),
        "cvxopt": ("interior point", "cvxopt", "cvxopt"),
        "daqp": ("dual active set", "daqp", "daqp"),
        "ecos": ("interior point", "ecos", "ecos"),
        "highs": ("active set", "highspy", "highspy"),
        "osqp": ("ADMM", "osqp", "osqp"),
        "piqp": ("interior point", "piqp", "piqp"),
        "proxqp": ("augmented Lagrangian", "proxsuite", "proxsuite"),
        "qpalm": ("augmented Lagrangian", "qpalm", "qpalm"),
        "quadprog": ("dual active set", "quadprog", "quadprog"),
        "scs": ("ADMM", "scs", "scs"),
    }
    native = {entry.name for entry in _native()}
    for name, (method, module, distribution) in methods.items():
        how = TRANSLATIONS[name]
        yield Backend(
            f"qpsolvers:{name}" if name in native else name, partial(DispatchSolver, name),
            method, module, distribution,
            matrices=how.matrices,
            iteration_cap=how.cap is not None,
            iterate_at_cap=how.cap is not None and name != "daqp",
            warm_start=how.start,
            time_limit=how.time_limit is not None,
            tells_infeasible=how.tells_infeasible,
        )
