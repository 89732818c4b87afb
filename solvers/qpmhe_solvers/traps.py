"""Traps of a user's backend: faults whose symptom, a rejected answer, does not name them."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import os
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .options import SolverOptions
from .qp import QP, Array, hessian_pattern
from .registry import create
from .sample_qps import contradiction, sample
from .solution import RawSolution, Residuals, Solution, SolveStatus

#: Error in d that counts as the same solution.
SAME = 1e-4
#: Iterations for QPs without solution: some backends take all the time there is to give up.
PATIENCE = 200
#: Claims of success, confirmed or not.
CLAIMED = (SolveStatus.SOLVED, SolveStatus.INACCURATE)

# Residuals, of numbers of order one, that no multiplier of another sign has.
_FITS = 1e-4
# Numbers of this size, all the same, are no iterate of a QP whose numbers are of order one.
_HUGE = 1e6
# Solvers made to see whether each leaves threads, and seconds that threads get to end.
_SOLVERS, _GRACE = 4, 0.5
_TASKS = Path("/proc/self/task")
_SIGNS = {
    (-1.0, 1.0): "of bounds", (1.0, -1.0): "of rows", (-1.0, -1.0): "of bounds and rows",
}


def tight(cap: int | None = None) -> SolverOptions:
    """Options of an accurate solve."""
    return SolverOptions(cap, absolute_tolerance=1e-9)


class _AlmostSymmetric(QP):
    """A QP whose Hessian, in the shapes that are made of it, is symmetric up to rounding."""

    __slots__ = ()

    @staticmethod
    def of(qp: QP) -> _AlmostSymmetric:
        """The same problem."""
        other = _AlmostSymmetric(*qp.sizes)
        other.numbers[...] = qp.numbers
        other.bounded, other.key = qp.bounded, qp.key
        return other

    def copy(self) -> QP:
        """A copy that shares no array."""
        return _AlmostSymmetric.of(self)

    def csc(self) -> Any:
        """H, whose entries above the diagonal are one unit in the last place larger."""
        matrix = super().csc()
        pattern = hessian_pattern(self.stages, self.n)
        column = np.repeat(np.arange(self.size), np.diff(pattern.indptr))
        above = pattern.indices < column
        matrix.data[above] = np.nextafter(matrix.data[above], np.inf)
        return matrix


def _kinds(inequalities: bool, seed: int = 0) -> QP:
    """A QP with every kind of limit, or with none."""
    if inequalities:
        return sample(7, 3, 2, bounds="part", sides="mixed", seed=seed)
    return sample(6, 2, seed=seed)


def _raw(name: str, qp: QP, options: SolverOptions) -> tuple[object, Solution]:
    """The answer of a new solver as its `_solve` gives it, and as it is judged."""
    solver = create(name, options)
    inner: Callable[[QP, Array | None], Any] = solver._solve
    kept: list[object] = []

    def spy(qp: QP, start: Array | None) -> Any:
        kept.append(inner(qp, start))
        return kept[-1]

    solver._solve = spy  # type: ignore[method-assign]  # of this object alone
    solution = solver.solve(qp)
    return (kept[-1] if kept else None), solution


def claims(name: str, _: bool) -> Iterator[str]:
    """Where the iterate is right, but claim or multipliers keep it from being SOLVED."""
    for qp in (_kinds(True), _kinds(False)):
        raw, solution = _raw(name, qp, tight())
        if solution.status is SolveStatus.SOLVED or solution.d is None:
            continue
        claimed = raw.claimed if isinstance(raw, RawSolution) else solution.status in CLAIMED
        fault = _misjudged(qp, solution, solution.d, claimed)
        if fault:
            yield fault
            return


def _misjudged(qp: QP, solution: Solution, d: Array, claimed: object) -> str:
    """Why an iterate is not SOLVED, if claim and multipliers alone are to blame."""
    if not isinstance(claimed, (bool, np.bool_)):
        return f"claimed is {claimed!r}, a {type(claimed).__name__}; return True or False"
    bounds, rows = solution.bound_duals, solution.row_duals
    if bounds is None or rows is None:
        missing = " and ".join(
            f"{which} is not {many} finite numbers" for which, many, given in (
                ("bound_duals", qp.size, bounds), ("row_duals", qp.stages * qp.rows, rows),
            ) if given is None
        )
        if not claimed or qp.violation(d) > _FITS:
            return ""
        return f"{missing}: a claim without multipliers cannot be confirmed"
    if _fits(qp, d, bounds, rows):
        return "" if claimed else "it never claims success: claimed is False at the solution"
    for (of_bounds, of_rows), which in _SIGNS.items():
        if _fits(qp, d, of_bounds * bounds, of_rows * rows):
            return (
                f"multipliers {which} have the opposite sign: positive belongs to an active "
                "upper limit, negative to a lower one"
            )
    return ""


def _fits(qp: QP, d: Array, bounds: Array, rows: Array) -> bool:
    found = Residuals.of(qp, d, bounds, rows)
    size = 1.0 + float(np.abs(qp.gradient).max())
    return found.primal <= _FITS and found.dual <= _FITS * size


def tolerance(name: str, inequalities: bool) -> Iterator[str]:
    """Where residuals stay at what the solver has by default, whatever is asked for."""
    qp = _kinds(inequalities)
    loose = create(name, SolverOptions(absolute_tolerance=1e-2)).solve(qp)
    close = create(name, tight()).solve(qp)
    if close.status is not SolveStatus.INACCURATE or loose.d is None or close.d is None:
        return
    left = close.residuals
    if left is None or not (left.primal < 1.0 and left.dual < 1.0):  # wrong, or without multipliers
        return
    if np.array_equal(loose.d, close.d):
        yield (
            f"residuals {left.primal:.0e} and {left.dual:.0e} at absolute_tolerance 1e-2 and 1e-9 "
            "alike: the tolerance does not arrive, check the name of the solver's option"
        )


def same_matrix(name: str, _: bool) -> Iterator[str]:
    """Where a solver is wrong from the second QP with one and the same Hessian on."""
    for inequalities in (True, False):
        solver = create(name, tight())
        for k in range(4):
            qp = _kinds(inequalities)
            qp.gradient *= 1.0 + 0.25 * k
            anew, found = create(name, tight()).solve(qp), solver.solve(qp)
            if anew.d is None or anew.status is not SolveStatus.SOLVED:
                break  # which other checks report
            if found.d is None or _apart(found.d, anew.d):
                yield (
                    f"solve {k + 1} with an equal Hessian differs from a new solver's: a matrix "
                    "that is kept between solves was overwritten (libraries factorise "
                    "Fortran-ordered arrays in place), copy it for each solve"
                )
                return


def _apart(one: Array, other: Array) -> bool:
    return float(np.abs(one - other).max()) > SAME * (1.0 + float(np.abs(other).max()))


def starts(name: str, inequalities: bool) -> Iterator[str]:
    """Where a start changes the solution, or makes a solve fail."""
    qp = _kinds(inequalities)
    plain = create(name, tight()).solve(qp)
    if plain.d is None or plain.status not in CLAIMED:
        return
    for what, start in {
        "the solution": plain.d, "its negative": -plain.d, "far away": 100.0 + plain.d,
    }.items():
        found = create(name, tight()).solve(qp, start)
        if found.d is None or found.status not in CLAIMED:
            yield (
                f"started at {what}: {found.status.name}, {found.message or found.residuals}, "
                "though solved without a start"
            )
        elif _apart(found.d, plain.d):
            yield f"started at {what}: another solution than without a start"


def symmetry(name: str, inequalities: bool) -> Iterator[str]:
    """Where a Hessian that is symmetric up to its last bit is refused, or read differently."""
    qp = _kinds(inequalities)
    solver, plain = create(name, tight()), create(name, tight()).solve(qp)
    if plain.d is None:
        if "symmetr" in plain.message.lower():
            yield (
                "the matrix that it makes of the QP is symmetric to the last bit only, which its "
                f"solver refuses ({plain.message}): make one triangle and mirror it"
            )
        return
    _, scaled = solver._scale(qp)
    try:
        with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
            raw = solver._solve(_AlmostSymmetric.of(scaled), None)
        d, words = raw.d, raw.message
    except Exception as error:
        d, words = None, f"{type(error).__name__}: {error}"
    if d is None:
        yield f"a matrix that is symmetric to the last bit only makes it fail ({words})"


def failures(name: str, inequalities: bool) -> Iterator[str]:
    """Where a QP without solution leaves a huge number that stands for none."""
    if not inequalities:
        return
    options = SolverOptions(PATIENCE, absolute_tolerance=1e-9)
    raw, solution = _raw(name, contradiction(), options)
    d = raw.d if isinstance(raw, RawSolution) and solution.d is not None else solution.d
    if d is None:
        return
    values = np.array(d, dtype=np.float64).ravel()  # as the solver gave them
    first = float(values[0])
    if abs(first) >= _HUGE and bool((values == first).all()):
        yield (
            f"an infeasible QP leaves {first:.10g} in every unknown: a finite number that stands "
            "for none, return None instead"
        )


def printed_lines(name: str) -> Iterator[str]:
    """What it prints in a solve, at a cap, and on a QP without solution."""
    with _output() as lines:
        for cap in (None, 1):
            create(name, tight(cap)).solve(_kinds(True))
        create(name, SolverOptions(PATIENCE)).solve(contradiction())
    if lines:
        more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
        yield f"it prints {lines[0][:80]!r}{more}: switch the solver's output off"


@contextlib.contextmanager
def _output() -> Iterator[list[str]]:
    """The lines that Python code and compiled code print meanwhile."""
    lines: list[str] = []
    words = io.StringIO()
    with tempfile.TemporaryFile() as file, contextlib.ExitStack() as undo:
        _flush()
        for descriptor in (1, 2):
            with contextlib.suppress(OSError):  # closed
                kept = os.dup(descriptor)
                undo.callback(os.close, kept)
                undo.callback(os.dup2, kept, descriptor)
                os.dup2(file.fileno(), descriptor)
        with contextlib.redirect_stdout(words), contextlib.redirect_stderr(words):
            yield lines
        _flush()
        file.seek(0)
        text = words.getvalue() + file.read().decode("utf-8", "replace")
        lines += [line.strip() for line in text.splitlines() if line.strip()]


def _flush() -> None:
    """Write what Python and the C library hold back."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a notebook's, or none at all
            stream.flush()
    with contextlib.suppress(Exception):  # another system's
        ctypes.CDLL(None).fflush(None)


def threads(name: str, inequalities: bool) -> Iterator[str]:
    """Whether each solver that was used and dropped leaves threads."""
    qp = _kinds(inequalities)
    create(name, tight()).solve(qp)  # whatever is made once
    before = _settled(0)
    for _ in range(_SOLVERS):
        create(name, tight()).solve(qp)
    left = _settled(before) - before
    if left >= _SOLVERS:
        yield (
            f"{_SOLVERS} solvers that were used and dropped left {left} threads: end them with "
            "the solve, or keep one pool for all"
        )


def _settled(goal: int) -> int:
    """The number of threads, once those that end have ended."""
    gc.collect()
    until = time.monotonic() + _GRACE
    count = _threads()
    while count > goal and time.monotonic() < until:
        time.sleep(0.01)
        now = _threads()
        if goal == 0 and now == count:
            break
        count = now
    return count


def _threads() -> int:
    """Threads of this process, of compiled code too where the system tells."""
    return len(list(_TASKS.iterdir())) if _TASKS.exists() else threading.active_count()


#: Title and check of each trap; the checks take the backend's name, and whether it handles limits.
TRAPS: dict[str, Callable[[str, bool], Iterator[str]]] = {
    "claim and multipliers": claims,
    "the tolerance": tolerance,
    "QPs with equal Hessians": same_matrix,
    "starts": starts,
    "a Hessian symmetric to the last bit only": symmetry,
    "numbers that stand for none": failures,
    "threads": threads,
}
