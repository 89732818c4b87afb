"""What every backend is put through: small QPs, each of which once went wrong somewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from .capabilities import CAPS, PATIENCE, Capabilities, all_kinds, tight
from .options import SolverOptions
from .qp import ARRAYS, QP
from .registry import create
from .sample_qps import Bounds, Sides, contradiction, sample
from .solution import SolveStatus
from .solver import Solver

__all__ = ["run_cases"]

Array = NDArray[np.float64]

# Error in d that counts as the same solution.
_SAME = 1e-4


def run_cases(name: str, can: Capabilities) -> Iterator[tuple[str, str]]:
    """Put a backend through all parts of the battery that it can take."""
    for part, look in _CASES.items():
        if can.inequalities or part in _WITHOUT_INEQUALITIES:
            yield part, "; ".join(look(name, can))


def _wrong(solver: Solver, qp: QP, what: str) -> Iterator[str]:
    """What is wrong with the solution of a QP that has one."""
    yield from _judged(solver, qp, what)[1]


def _judged(solver: Solver, qp: QP, what: str) -> tuple[Array | None, list[str]]:
    """The solution of a QP that has one, and what is wrong with it."""
    before = [getattr(qp, array).copy() for array in ARRAYS]
    solution = solver.solve(qp)
    faults = []
    if solution.status is not SolveStatus.SOLVED:
        faults.append(f"{what}: {solution.status.name}, {solution.message or solution.residuals}")
    for array, values in zip(ARRAYS, before, strict=True):
        if not np.array_equal(getattr(qp, array), values):
            faults.append(f"{what}: it wrote into {array}")
    faults += [
        f"{what}: it wrote into {array}, which is to be read only; copy before scaling in place"
        for array in solver._wrote
    ]
    return solution.d, faults


def _as_fresh(
    name: str, qps: list[QP], what: str, *, shift: bool = False, back: bool = False
) -> Iterator[str]:
    """Where one solver's answers to QPs in turn are not those of solvers made anew."""
    kept = create(name, tight())
    fresh = [create(name, tight()).solve(qp).d for qp in qps]
    order = [*range(len(qps)), *reversed(range(len(qps) if back else 0))]
    for k in order:
        if shift:
            kept.shift()
        found, faults = _judged(kept, qps[k], f"{what} {k}")
        yield from faults
        anew = fresh[k]
        if anew is None or found is None or np.abs(anew - found).max() > _SAME:
            yield f"{what} {k}: not the solution of a solver made anew"


def _kinds(can: Capabilities) -> tuple[Bounds, Sides]:
    return ("all", "two") if can.inequalities else ("none", "none")


def _caps(name: str, can: Capabilities) -> Iterator[str]:
    qp = all_kinds()
    for cap in CAPS:
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


def _no_inequality(name: str, _: Capabilities) -> Iterator[str]:
    for stages, n, rows in ((6, 2, 0), (1, 1, 0), (4, 3, 2)):
        qp = sample(stages, n, rows)
        yield from _wrong(create(name, tight()), qp, f"{stages} stages of {n}, {rows} rows")
        d = create(name, tight()).solve(qp).d
        exact = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
        if d is None or np.abs(d.ravel() - exact).max() > _SAME * (1.0 + np.abs(exact).max()):
            yield f"{stages} stages of {n}, {rows} rows: not the minimiser"


def _unbounded(name: str, _: Capabilities) -> Iterator[str]:
    qp = sample(6, 3, bounds="all")
    qp.lower[:, 1], qp.upper[:, 1], qp.upper[:, 2] = -np.inf, np.inf, np.inf
    yield from _wrong(create(name, tight()), qp, "one unknown without bounds")
    qp.lower[...], qp.upper[...] = -np.inf, np.inf
    yield from _wrong(create(name, tight()), qp, "all without bounds")
    yield from _wrong(create(name, tight()), sample(6, 3, bounds="part", push=100.0), "far away")


def _equalities(name: str, can: Capabilities) -> Iterator[str]:
    yield from _wrong(create(name, tight()), sample(5, 3, 1, sides="equal"), "rows")
    if can.inequalities:
        yield from _wrong(create(name, tight()), all_kinds(), "among others")
        fixed = sample(4, 2, bounds="all")
        fixed.lower[:, 0] = fixed.upper[:, 0]
        yield from _wrong(create(name, tight()), fixed, "fixed unknowns")


def _degenerate(name: str, _: Capabilities) -> Iterator[str]:
    twice = sample(6, 2, 2, sides="two")
    twice.row_own[:, 1], twice.row_next[:, 1] = twice.row_own[:, 0], twice.row_next[:, 0]
    twice.row_lower[:, 1], twice.row_upper[:, 1] = twice.row_lower[:, 0], twice.row_upper[:, 0]
    yield from _wrong(create(name, tight()), twice, "each row twice")
    touching = sample(5, 2, bounds="all", push=0.0)
    touching.lower[...], touching.upper[...] = 0.0, 1.0
    yield from _wrong(create(name, tight()), touching, "the solution on limits that do not push")


def _scaled(name: str, can: Capabilities) -> Iterator[str]:
    bounds, sides = _kinds(can)
    for decades in (2.0, 4.0):
        qp = sample(6, 2, 1, bounds=bounds, sides=sides, decades=decades)
        yield from _wrong(create(name, tight()), qp, f"{decades:.0f} decades")


def _updates(name: str, can: Capabilities) -> Iterator[str]:
    bounds, sides = _kinds(can)
    qps = [
        sample(6, 2, 2, bounds=bounds, sides=sides, seed=seed, decades=seed / 10)
        for seed in range(20)
    ]
    yield from _as_fresh(name, qps, "QP")


def _patterns(name: str, _: Capabilities) -> Iterator[str]:
    qps = [sample(7, 3, 2, bounds="part", sides="two", seed=seed) for seed in range(6)]
    for k, qp in enumerate(qps):  # a measurement that is missing, and moves on
        qp.row_lower[5 - k, 1], qp.row_upper[5 - k, 1] = -np.inf, np.inf
        qp.row_lower[-1], qp.row_upper[-1] = -np.inf, np.inf
    kinds: list[tuple[Bounds, Sides]] = [
        ("all", "equal"), ("all", "mixed"), ("all", "none"), ("none", "equal"), ("none", "mixed"),
        ("none", "none"),
    ]
    qps += [sample(7, 3, 2, bounds=bounds, sides=sides) for bounds, sides in kinds]
    yield from _as_fresh(name, qps, "pattern", back=True)


def _grows(name: str, can: Capabilities) -> Iterator[str]:
    bounds, sides = _kinds(can)
    lengths = (*range(1, 9), 8, 8, 1)
    qps = [sample(stages, 2, 1, bounds=bounds, sides=sides) for stages in lengths]
    yield from _as_fresh(name, qps, "window")


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
    for _moved in range(9):
        solver.shift()
    yield from _wrong(solver, qps[0], "shifted before the first solve")
    for _moved in range(9):
        solver.shift()
    yield from _wrong(solver, qps[1], "shifted beyond its end")


_CASES: dict[str, Callable[[str, Capabilities], Iterator[str]]] = {
    "no inequality": _no_inequality,
    "equalities": _equalities,
    "unbounded unknowns": _unbounded,
    "degenerate limits": _degenerate,
    "badly scaled weights": _scaled,
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
