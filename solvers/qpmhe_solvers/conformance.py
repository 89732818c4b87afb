"""Check a backend on small QPs: its declared capabilities, and every backend's duties."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from .backend import Backend
from .options import SolverOptions
from .qp import ARRAYS, QP, Array
from .registry import backend, create
from .sample_qps import Bounds, Sides, contradiction, sample
from .solution import Solution, SolveStatus
from .solver import Solver
from .traps import CLAIMED, PATIENCE, SAME, TRAPS, printed_lines, tight

# Caps at which backends are tried.
_CAPS = (1, 2, 5)
# What counts as another iterate.
_OTHER = 1e-9
# A limit that is missed by more is ignored: the numbers of these QPs are of order one.
_MISSED = 1e-2
# The report lists at most this many faults of each check.
_TOLD = 3
# What is often behind a capability that is declared, and not there.
_HINTS = {
    "iteration_cap": "the cap is ignored, check the name of the solver's option: some solvers "
    "ignore a misspelt one",
    "warm_start": "the start is ignored",
    "time_limit": "the limit is ignored, check the name of the solver's option",
    "iterate_at_cap": "return the solver's iterate where it does not claim success, too",
}
_all_kinds = partial(sample, 7, 3, 2, bounds="part", sides="mixed")


@dataclass(frozen=True)
class Capabilities:
    """Capabilities, declared or measured; see `Backend` for the flags."""

    inequalities: bool
    iteration_cap: bool
    iterate_at_cap: bool
    warm_start: bool
    time_limit: bool
    keeps_duals: bool
    reports_infeasibility: bool

    @staticmethod
    def declared(backend: Backend) -> Capabilities:
        """The capabilities that a ``backend`` declares."""
        return Capabilities(*(getattr(backend, one.name) for one in fields(Capabilities)))


@dataclass(frozen=True)
class CheckOutcome:
    """The outcome of one ``check``: whether it ``passed``, and the ``detail`` of a failure."""

    check: str
    passed: bool
    detail: str = ""


@dataclass(frozen=True)
class Conformance:
    """Result of a backend's conformance check; ``print`` shows the failures.

    Parameters
    ----------
    name : str
        The backend.
    declared, measured : Capabilities
        Its declared and its measured capabilities.
    findings : tuple of CheckOutcome
        All checks, passed or not.
    """

    name: str
    declared: Capabilities
    measured: Capabilities
    findings: tuple[CheckOutcome, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed, and all capabilities are as declared."""
        return self.declared == self.measured and all(one.passed for one in self.findings)

    def __str__(self) -> str:
        lines = [f"{self.name}: {'conforms' if self.passed else 'does not conform'}"]
        for one in fields(Capabilities):
            says, does = getattr(self.declared, one.name), getattr(self.measured, one.name)
            if says != does:
                told = says and self.measured.inequalities and one.name in _HINTS
                hint = f": {_HINTS[one.name]}" if told else ""
                lines.append(f"  {one.name} is declared {says}, but measured {does}{hint}")
        lines += [f"  {one.check}: {one.detail}" for one in self.findings if not one.passed]
        return "\n".join(lines)


def check(name: str) -> Conformance:
    """Run all checks on the backend registered as ``name``, built in or your own.

    Besides wrong answers and capabilities, it looks for traps that a wrong answer does not name,
    such as multipliers of the other sign, a tolerance that does not arrive, or threads left behind.
    Lines that the solver prints once a process are seen if the process has not used it before.

    Raises
    ------
    BackendError
        If there is no such backend, or its package is not installed.
    """
    # First what a solver may print once a process.
    outcomes = {"printed lines": "; ".join(printed_lines(name))}
    measured = measure(name)
    for title, look in _CHECKS.items():
        if measured.inequalities or title in _WITHOUT_INEQUALITIES:
            outcomes[title] = _listed(look(name, measured))
    for title, trap in TRAPS.items():
        outcomes[title] = _listed(trap(name, measured.inequalities))
    findings = [CheckOutcome(title, not detail, detail) for title, detail in outcomes.items()]
    return Conformance(
        name, Capabilities.declared(backend(name)), measured, tuple(findings)
    )


def measure(name: str) -> Capabilities:
    """Measure the capabilities of the backend registered as ``name``.

    Raises
    ------
    BackendError
        If there is no such backend, or its package is not installed.
    """
    qp = _all_kinds()
    found = create(name, tight()).solve(qp)
    missed = math.inf if found.residuals is None else found.residuals.primal
    # Who ignores limits may claim success, and misses them by numbers of order one.
    if found.status not in CLAIMED or not missed < _MISSED:
        return Capabilities(*[False] * len(fields(Capabilities)))
    capped = [create(name, tight(cap)).solve(qp) for cap in _CAPS]
    cap = capped[0].status not in CLAIMED
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


def _listed(faults: Iterator[str]) -> str:
    """The first faults, and how many more there are."""
    told = list(faults)
    more = [f"and {len(told) - _TOLD} more"] * (len(told) > _TOLD)
    return "; ".join(told[:_TOLD] + more)


def _uses_a_start(name: str, qp: QP) -> bool:
    """Whether any number of iterations ends elsewhere, started at the solution."""
    best = create(name, tight()).solve(qp).d
    return any(
        _differ(create(name, tight(cap)).solve(qp, best), create(name, tight(cap)).solve(qp))
        for cap in _CAPS
    )


def _minds_the_time(name: str) -> bool:
    qp = sample(40, 3, 2, bounds="part", sides="mixed")
    hurried = create(name, SolverOptions(absolute_tolerance=1e-9, time_limit=1e-9)).solve(qp)
    return hurried.status not in CLAIMED


def _keeps_duals(name: str) -> bool:
    """Whether what was solved before, and a shift since then, make a difference at a cap."""
    # From a QP where little binds, by steps that change little each.
    path = [_all_kinds(around=0.0, push=push) for push in np.linspace(0.1, 5.0, 50)]
    for cap in _CAPS:
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


def _judged(solver: Solver, qp: QP, what: str) -> tuple[Array | None, list[str]]:
    """The solution of a QP that has one, and what is wrong with it."""
    before = [getattr(qp, array).copy() for array in ARRAYS]
    solution = solver.solve(qp)
    faults = []
    if solution.status is not SolveStatus.SOLVED:
        found, why = solution.residuals, solution.message
        if not why and found is not None and math.isnan(found.dual):
            why = f"no multipliers to check the claim, limits missed by {found.primal:.0e}"
        faults.append(f"{what}: {solution.status.name}, {why or found}")
    for array, values in zip(ARRAYS, before, strict=True):
        if not np.array_equal(getattr(qp, array), values):
            faults.append(f"{what}: it wrote into {array}")
    faults += [
        f"{what}: it wrote into {array}, which is read-only; copy before scaling in place"
        for array in solver._wrote
    ]
    return solution.d, faults


def _wrong(solver: Solver, qp: QP, what: str) -> list[str]:
    return _judged(solver, qp, what)[1]


def _as_fresh(
    name: str, qps: list[QP], what: str, *, shift: bool = False, back: bool = False
) -> Iterator[str]:
    """Where one solver's answers to QPs in turn are not those of solvers made anew."""
    kept = create(name, tight())
    fresh = [create(name, tight()).solve(qp).d for qp in qps]
    for k in [*range(len(qps)), *reversed(range(len(qps) if back else 0))]:
        if shift:
            kept.shift()
        found, faults = _judged(kept, qps[k], f"{what} {k}")
        yield from faults
        anew = fresh[k]
        if anew is None or found is None or np.abs(anew - found).max() > SAME:
            yield f"{what} {k}: differs from the solution of a new solver"


def _each(qps: Callable[[Bounds, Sides], dict[str, QP]]) -> _Check:
    """A check of QPs, each by a fresh solver; of the kinds of limits that a backend can take."""
    def look(name: str, can: Capabilities) -> Iterator[str]:
        for what, qp in qps(*_kinds(can)).items():
            yield from _wrong(create(name, tight()), qp, what)

    return look


def _kinds(can: Capabilities) -> tuple[Bounds, Sides]:
    return ("all", "two") if can.inequalities else ("none", "none")


def _no_inequality(name: str, _: Capabilities) -> Iterator[str]:
    for stages, n, rows in ((6, 2, 0), (1, 1, 0), (4, 3, 2)):
        qp, what = sample(stages, n, rows), f"{stages} stages of {n}, {rows} rows"
        d, faults = _judged(create(name, tight()), qp, what)
        yield from faults
        exact = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
        if d is None or np.abs(d.ravel() - exact).max() > SAME * (1.0 + np.abs(exact).max()):
            yield f"{what}: not the minimiser"


def _equalities(bounds: Bounds, _: Sides) -> dict[str, QP]:
    rows = {"rows": sample(5, 3, 1, sides="equal")}
    if bounds == "none":
        return rows
    fixed = sample(4, 2, bounds="all")
    fixed.lower[:, 0] = fixed.upper[:, 0]
    return {**rows, "among others": _all_kinds(), "fixed unknowns": fixed}


def _unbounded(*_: str) -> dict[str, QP]:
    one, none = (sample(6, 3, bounds="all") for _ in range(2))
    one.lower[:, 1], one.upper[:, 1:] = -np.inf, np.inf
    none.lower[...], none.upper[...] = -np.inf, np.inf
    return {
        "one unknown without bounds": one, "all without bounds": none,
        "far away": sample(6, 3, bounds="part", push=100.0),
    }


def _degenerate(*_: str) -> dict[str, QP]:
    twice = sample(6, 2, 2, sides="two")
    for rows in (twice.row_own, twice.row_next, twice.row_lower, twice.row_upper):
        rows[:, 1] = rows[:, 0]
    touching = sample(5, 2, bounds="all", push=0.0)
    touching.lower[...], touching.upper[...] = 0.0, 1.0
    return {"each row twice": twice, "the solution on limits that do not push": touching}


def _scaled(bounds: Bounds, sides: Sides) -> dict[str, QP]:
    return {
        f"{decades} decades": sample(6, 2, 1, bounds=bounds, sides=sides, decades=float(decades))
        for decades in (2, 4)
    }


def _caps(name: str, can: Capabilities) -> Iterator[str]:
    qp = _all_kinds()
    for cap in _CAPS:
        solution = create(name, tight(cap)).solve(qp)
        if can.iteration_cap and (solution.iterations or 0) > cap:
            yield f"it reports {solution.iterations} iterations at the cap {cap}"
        if solution.d is None and can.iterate_at_cap:
            yield f"no iterate at the cap {cap}: {solution.message}"
    yield from _wrong(create(name, tight(5000)), qp, "at a cap of 5000")


def _infeasible(name: str, _: Capabilities) -> Iterator[str]:
    solver = create(name, SolverOptions(max_iterations=PATIENCE, absolute_tolerance=1e-9))
    crossed = sample(6, 2, 2, bounds="all", sides="two")
    crossed.lower[2, 0] = crossed.upper[2, 0] + 1.0
    for what, qp in {"contradicting rows": contradiction(), "crossed bounds": crossed}.items():
        yield from _wrong(solver, sample(6, 2, 2, sides="two", seed=8), f"before {what}")
        if solver.solve(qp).status is SolveStatus.SOLVED:
            yield f"{what}: solved"
        yield from _wrong(solver, sample(6, 2, 2, sides="two", seed=9), f"after {what}")


def _not_finite(name: str, _: Capabilities) -> Iterator[str]:
    solver, qp = create(name, tight()), sample(6, 2)
    yield from _wrong(solver, qp, "before it")
    qp.gradient[3, 1] = math.nan
    if solver.solve(qp).d is not None:
        yield "there is an iterate"
    yield from _wrong(solver, sample(6, 2, seed=1), "after it")


def _updates(name: str, can: Capabilities) -> Iterator[str]:
    bounds, sides = _kinds(can)
    return _as_fresh(name, [
        sample(6, 2, 2, bounds=bounds, sides=sides, seed=seed, decades=seed / 10)
        for seed in range(20)
    ], "QP")


def _patterns(name: str, _: Capabilities) -> Iterator[str]:
    qps = [sample(7, 3, 2, bounds="part", sides="two", seed=seed) for seed in range(6)]
    for k, qp in enumerate(qps):  # a measurement that is missing, and moves on
        for stage, row in ((5 - k, 1), (-1, slice(None))):
            qp.row_lower[stage, row], qp.row_upper[stage, row] = -np.inf, np.inf
    kinds: list[tuple[Bounds, Sides]] = [
        ("all", "equal"), ("all", "mixed"), ("all", "none"), ("none", "equal"), ("none", "mixed"),
        ("none", "none"),
    ]
    qps += [sample(7, 3, 2, bounds=bounds, sides=sides) for bounds, sides in kinds]
    return _as_fresh(name, qps, "pattern", back=True)


def _grows(name: str, can: Capabilities) -> Iterator[str]:
    bounds, sides = _kinds(can)
    lengths = (*range(1, 9), 8, 8, 1)
    qps = [sample(stages, 2, 1, bounds=bounds, sides=sides) for stages in lengths]
    return _as_fresh(name, qps, "window")


def _shifted(name: str, _: Capabilities) -> Iterator[str]:
    long = sample(16, 2, 1, bounds="all", sides="two", push=3.0)
    qps = []
    for first in range(10):
        qp, stages = QP(6, 2, 1), slice(first, first + 6)
        for array in ARRAYS:
            getattr(qp, array)[...] = getattr(long, array)[stages]
        # Nothing couples to what is beyond.
        qp.band[-1, 0, 2:], qp.band[-1, 1, 1:] = 0.0, 0.0
        qp.row_lower[-1], qp.row_upper[-1] = -np.inf, np.inf
        qps.append(qp)
    yield from _as_fresh(name, qps, "window", shift=True)
    solver = create(name, tight())
    for qp, what in zip(qps, ("before the first solve", "beyond its end"), strict=False):
        for _moved in range(9):
            solver.shift()
        yield from _wrong(solver, qp, f"shifted {what}")


_Check = Callable[[str, Capabilities], Iterator[str]]
_CHECKS: dict[str, _Check] = {
    "no inequality": _no_inequality,
    "equalities": _each(_equalities),
    "unbounded unknowns": _each(_unbounded),
    "degenerate limits": _each(_degenerate),
    "badly scaled weights": _each(_scaled),
    "caps 1, 2, 5": _caps,
    "an infeasible QP, then a good one": _infeasible,
    "numbers that are not finite": _not_finite,
    "20 QPs in turn": _updates,
    "limits that come and go": _patterns,
    "a window that grows": _grows,
    "a window that moves": _shifted,
}
_WITHOUT_INEQUALITIES = (
    "no inequality", "equalities", "badly scaled weights", "numbers that are not finite",
    "20 QPs in turn", "a window that grows",
)
