"""The backends that this package brings; none of their solvers is imported here."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from .auto import AutoSolver
from .backend import Backend
from .banded import BandedSolver
from .dispatch import DispatchSolver
from .native import NATIVE
from .translations import TRANSLATIONS


def builtin_backends() -> Iterator[Backend]:
    """All of them, the default one first."""
    yield Backend(
        "auto", AutoSolver, "banded, then a QP", matrices="banded",
        iteration_cap=True, iterate_at_cap=True, time_limit=True, reports_infeasibility=True,
        keeps_workspace=True,
    )
    yield Backend(
        "banded", BandedSolver, "banded Cholesky", matrices="banded", inequalities=False,
        keeps_workspace=True,
    )
    yield from sorted((*NATIVE.values(), *_dispatched()), key=lambda backend: backend.name)


def _dispatched() -> Iterator[Backend]:
    """Solvers through qpsolvers, with that name in front where there is a native one."""
    for name, how in TRANSLATIONS.items():
        yield Backend(
            f"qpsolvers:{name}" if name in NATIVE else name, partial(DispatchSolver, name),
            how.method, how.package, how.package,
            matrices=how.matrices,
            iteration_cap=how.cap is not None,
            iterate_at_cap=how.cap is not None and name != "daqp",
            warm_start=how.start,
            time_limit=how.time_limit is not None,
            reports_infeasibility=how.reports_infeasibility,
        )
