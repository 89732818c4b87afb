"""What a backend can do, found out by small QPs and not by asking."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from .options import SolverOptions
from .qp import QP
from .registry import Backend, create
from .sample_qps import contradiction, sample
from .solution import Solution, SolveStatus

__all__ = ["CAPS", "PATIENCE", "Capabilities", "all_kinds", "measure", "tight"]

#: Caps at which backends are looked at.
CAPS = (1, 2, 5)
#: A cap for QPs without solution: some backends take all the time there is to give up.
PATIENCE = 200
#: A QP with all kinds of limits.
all_kinds = partial(sample, 7, 3, 2, bounds="part", sides="mixed")
# What counts as another iterate.
_OTHER = 1e-9
_CLAIMED = (SolveStatus.SOLVED, SolveStatus.INACCURATE)


@dataclass(frozen=True)
class Capabilities:
    """What a backend was seen to do; the names are those of `Backend`.

    Parameters
    ----------
    inequalities : bool
        Bounds and rows that bind are met.
    iteration_cap : bool
        A cap stops it.
    iterate_at_cap : bool
        It then has an iterate.
    warm_start : bool
        The start makes a difference.
    time_limit : bool
        A time that has passed at once stops it.
    keeps_duals : bool
        What was solved before makes a difference to a capped solve.
    reports_infeasibility : bool
        It calls a QP without feasible point infeasible.
    """

    inequalities: bool
    iteration_cap: bool
    iterate_at_cap: bool
    warm_start: bool
    time_limit: bool
    keeps_duals: bool
    reports_infeasibility: bool

    @staticmethod
    def declared(backend: Backend) -> Capabilities:
        """What a backend says of itself.

        Parameters
        ----------
        backend : Backend
            Its description.
        """
        names = [one.name for one in fields(Capabilities)]
        return Capabilities(**{name: getattr(backend, name) for name in names})


def measure(name: str) -> Capabilities:
    """Find out what a backend can do, whatever it says.

    Parameters
    ----------
    name : str
        A registered name.

    Raises
    ------
    BackendError
        If there is no such backend, or its package is not installed.
    """
    qp = all_kinds()
    inequalities = create(name, tight()).solve(qp).status in _CLAIMED
    if not inequalities:
        return Capabilities(*[False] * len(fields(Capabilities)))
    capped = [create(name, tight(cap)).solve(qp) for cap in CAPS]
    cap = capped[0].status not in _CLAIMED
    infeasible = create(name, SolverOptions(max_iterations=PATIENCE)).solve(contradiction())
    return Capabilities(
        inequalities=True,
        iteration_cap=cap,
        iterate_at_cap=cap and all(one.d is not None for one in capped),
        warm_start=_uses_a_start(name, qp),
        time_limit=_minds_the_time(name),
        keeps_duals=_keeps_duals(name),
        reports_infeasibility="infeasible" in infeasible.message.lower(),
    )


def tight(cap: int | None = None) -> SolverOptions:
    """Options with a tight tolerance."""
    return SolverOptions(cap, absolute_tolerance=1e-9)


def _uses_a_start(name: str, qp: QP) -> bool:
    """Whether any number of iterations ends elsewhere, started at the solution."""
    best = create(name, tight()).solve(qp).d
    return any(
        _differ(create(name, tight(cap)).solve(qp, best), create(name, tight(cap)).solve(qp))
        for cap in CAPS
    )


def _minds_the_time(name: str) -> bool:
    qp = sample(40, 3, 2, bounds="part", sides="mixed")
    hurried = create(name, SolverOptions(absolute_tolerance=1e-9, time_limit=1e-9)).solve(qp)
    return hurried.status not in _CLAIMED


def _keeps_duals(name: str) -> bool:
    """Whether what was solved before, and a shift since then, make a difference at a cap."""
    # From a QP where little binds, by steps that change little each.
    path = [all_kinds(around=0.0, push=push) for push in np.linspace(0.1, 5.0, 50)]
    for cap in CAPS:
        fresh, again, shifted = (create(name, tight(cap)) for _ in range(3))
        for qp in path[:-1]:
            again.solve(qp)
            shifted.solve(qp)
        shifted.shift()
        ends = [solver.solve(path[-1]) for solver in (fresh, again, shifted)]
        if _differ(ends[0], ends[1]) and _differ(ends[1], ends[2]):
            return True
    return False


def _differ(one: Solution, other: Solution) -> bool:
    if one.d is None or other.d is None:
        return (one.d is None) != (other.d is None)
    return float(np.abs(one.d - other.d).max()) > _OTHER
