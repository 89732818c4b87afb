"""Make docs/backends-behaviour.md: QP solvers measured through qpsolvers, and through qpmhe.

    python examples/studies/backend_behaviour.py

Each solver gets a process of its own. All problems have a known solution: it is chosen first, with
its multipliers, and the gradient follows. What is not installed is named as such.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import qpsolvers

import qpmhe
from qpmhe.solvers import QP, SolverOptions
from qpmhe_solvers.qp import band_of
from qpmhe_solvers.translations import TRANSLATIONS

PAGE = Path(__file__).parents[2] / "docs" / "backends-behaviour.md"
SECONDS = 300.0
#: Solvers that qpsolvers knows and qpmhe has no backend for, with their packages.
OTHERS = {
    "jaxopt_osqp": "jaxopt", "kvxopt": "kvxopt", "pyqpmad": "pyqpmad", "qpax": "qpax",
    "qtqp": "qtqp", "sip": "sip-qp-python",
}
#: Problems of one kind that are counted.
COUNT = 40
#: Errors below this are shown as 0: they are rounding, in units of the solution.
SMALL = 1e-12


@dataclass
class Known:
    """A QP of n unknowns with its solution: H, g, rows A between limits, bounds."""

    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    row_lower: np.ndarray
    row_upper: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    x: np.ndarray

    def problem(self, kind: str, bounds_as_rows: bool = False) -> qpsolvers.Problem:
        """The QP as qpsolvers takes it, dense or sparse as the solver wants it."""
        equal = self.row_lower == self.row_upper
        free = ~equal
        sides = [(self.A[free], self.row_upper[free]), (-self.A[free], -self.row_lower[free])]
        if bounds_as_rows:
            unit = np.eye(len(self.g))
            sides += [(unit, self.upper), (-unit, -self.lower)]
        G, h = (np.concatenate(one) for one in zip(*sides, strict=True))
        finite = np.isfinite(h)
        H, G, A = self.H.copy(), G[finite], self.A[equal]
        if kind == "csc":
            from scipy.sparse import csc_matrix

            H, G, A = csc_matrix(H), csc_matrix(G), csc_matrix(A)
        bounded = np.isfinite(self.lower).any() or np.isfinite(self.upper).any()
        bounded = bool(bounded) and not bounds_as_rows
        return qpsolvers.Problem(
            H, self.g.copy(), *((G, h[finite]) if finite.any() else (None, None)),
            *((A, self.row_lower[equal]) if equal.any() else (None, None)),
            *((self.lower.copy(), self.upper.copy()) if bounded else (None, None)),
        )

    def stages(self) -> QP:
        """The QP as qpmhe's backends take it: one stage."""
        n, rows = len(self.g), len(self.A)
        qp = QP(1, n, rows)
        qp.band[0], qp.gradient[0] = band_of(self.H), self.g
        qp.row_own[0], qp.row_lower[0], qp.row_upper[0] = self.A, self.row_lower, self.row_upper
        qp.bounded = bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())
        qp.lower[0], qp.upper[0] = self.lower, self.upper
        return qp

    def error(self, x: Any) -> float:
        """Largest error, in units of each unknown of the solution."""
        gap = np.abs(np.asarray(x, float) - self.x) / np.maximum(np.abs(self.x), 0.1 * self.sizes)
        return float(gap.max())

    @property
    def sizes(self) -> np.ndarray:
        """The size of each unknown: the deviation of its own entry of H."""
        return 1.0 / np.sqrt(np.maximum(np.diag(self.H), 1e-300))


def known(
    n: int = 6, rows: int = 2, bounds: int = 2, *, twice: bool = False, equal: bool = False,
    units: np.ndarray | None = None, far: float = np.inf, linear: bool = False,
    weakly: bool = False, seed: int = 3,
) -> Known:
    """A strictly convex QP with active rows and active lower bounds."""
    numbers = np.random.default_rng(seed)
    factor = numbers.standard_normal((n + 3, n))
    H, x = factor.T @ factor / n, numbers.uniform(0.5, 2.0, n)
    A = numbers.standard_normal((rows, n))
    if twice:
        A[1:] = A[0]
    if linear:
        H = np.zeros((n, n))
    row_upper, row_lower = A @ x, np.full(rows, -np.inf)
    if equal:
        row_lower = row_upper.copy()
    lower, upper = np.full(n, -far), np.full(n, far)
    lower[:bounds] = x[:bounds]
    push = np.zeros(n)
    push[:bounds] = 0.0 if weakly else numbers.uniform(0.5, 2.0, bounds)
    g = -H @ x - A.T @ numbers.uniform(0.5, 2.0, rows) + push
    if linear:  # as many active limits as unknowns
        lower, g = x.copy(), numbers.uniform(0.5, 2.0, n)
        A, row_lower, row_upper = A, np.full(rows, -np.inf), A @ x + 1.0
        upper = x + 5.0
    scale = np.ones(n) if units is None else units
    return Known(
        H / np.outer(scale, scale), g / scale, A / scale, row_lower, row_upper, lower * scale,
        upper * scale, x * scale,
    )


def attempt(solve: Callable[[], Any]) -> tuple[Any, list[str], str]:
    """What a call returned, its warnings, and its exception."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return solve(), [str(one.message) for one in caught], ""
        except Exception as error:
            return None, [str(one.message) for one in caught], type(error).__name__


class Raw:
    """One solver through qpsolvers, with its defaults; bounds are rows if it wants finite ones."""

    def __init__(self, name: str) -> None:
        self.name, self.translation = name, TRANSLATIONS.get(name)
        dense = name in OTHERS or (self.translation and self.translation.style.matrices == "dense")
        self.kind = "dense" if dense else "csc"
        self.bounds_as_rows = False
        self.refuses_infinite = bool(self.solve(known())[2])  # all but two bounds are infinite
        self.bounds_as_rows = self.refuses_infinite

    def solve(self, qp: Known, **options: Any) -> tuple[Any, list[str], str]:
        """The solution of a QP."""
        return self.solve_problem(self.problem(qp), **options)

    def problem(self, qp: Known) -> qpsolvers.Problem:
        """The QP as this solver takes it."""
        return qp.problem(self.kind, self.bounds_as_rows)

    def solve_problem(
        self, problem: qpsolvers.Problem, **options: Any
    ) -> tuple[Any, list[str], str]:
        """The solution of a problem."""
        return attempt(
            lambda: qpsolvers.solve_problem(problem, self.name, verbose=False, **options)
        )

    def outcome(self, qp: Known, **options: Any) -> str:
        """The error of x as a number, and a mark of how the solver judges it."""
        solution, _, error = self.solve(qp, **options)
        if error:
            return f"raises {error}"
        return judged(qp, solution.x, bool(solution.found))

    def count(self, problems: Iterator[Known]) -> str:
        """How many of these QPs are right; how many are wrong although the solver claims them."""
        right = wrong = total = 0
        for qp in problems:
            total += 1
            solution, _, error = self.solve(qp)
            if error or solution.x is None:
                continue
            fits = qp.error(solution.x) < 1e-2
            right += fits
            wrong += not fits and bool(solution.found)
        return f"{right} of {total} right" + (f", {wrong} wrong but found" if wrong else "")


def size(value: float) -> str:
    """A number's order of magnitude."""
    return f"{value:.0e}" if value else "0"


def judged(qp: Known, x: Any, found: bool) -> str:
    """An error as it is shown; in brackets where the solver does not claim it."""
    if x is None or not np.isfinite(np.asarray(x, float)).all():
        return "found, but not finite" if found else "none"
    error = qp.error(x)
    text = "0" if error < SMALL else f"{error:.0e}"
    return text if found else f"({text})"


def own(name: str, qp: Known) -> str:
    """The same through qpmhe's backend of that name."""
    if name not in qpmhe.solvers.available():
        return "no backend"
    solution, _, error = attempt(
        lambda: qpmhe.solvers.create(name, SolverOptions()).solve(qp.stages())
    )
    if error:
        return f"raises {error}"
    d = None if solution.d is None else np.ravel(solution.d)
    return judged(qp, d, solution.status.name in ("SOLVED", "INACCURATE"))


def at_the_cap(raw: Raw) -> dict[str, str]:
    """A cap of one iteration, a start, and an option that does not exist."""
    qp = known()
    cap = raw.translation.cap if raw.translation else None
    found = {"the cap's name": f"`{cap}`" if cap else "none, or not measured"}
    if cap:
        first, warned, error = raw.solve(qp, **{cap: 1})
        x = None if first is None else first.x
        found["x at a cap of 1"] = error or ("None" if x is None else f"{qp.error(x):.0e} off")
        found["found"] = "-" if first is None else str(bool(first.found))
        found["warns"] = "yes" if warned else "no"
    plain, warned, _ = raw.solve(qp)
    begun, words, error = raw.solve(qp, initvals=0.9 * qp.x)
    if error or plain is None:
        found["a start"] = f"raises {error}"
    else:
        same = np.array_equal(plain.x, begun.x)
        found["a start"] = "leaves x to the last bit" if same else "changes x"
        found["a start"] += ", warns" if len(words) > len(warned) else ""
    _, _, error = raw.solve(qp, max_itre=3)
    found["an option misspelt"] = f"raises {error}" if error else "ignored"
    return found


def reading(raw: Raw) -> dict[str, str]:
    """Which triangle of P is read, and multipliers."""
    qp = known()
    found = {"infinite bounds": "refused" if raw.refuses_infinite else "taken"}
    for title, part in (("upper triangle only", np.triu), ("lower triangle only", np.tril)):
        problem = raw.problem(qp)
        problem.P = part(qp.H) if raw.kind == "dense" else type(problem.P)(part(qp.H))
        found[title] = right_or_not(raw, qp, problem)
    rounded = raw.problem(qp)
    if raw.kind == "dense":
        rounded.P[0, 1] *= 1.0 + 2.0**-52
    else:
        rounded.P.data[1] *= 1.0 + 2.0**-52
    found["one ulp from symmetric"] = right_or_not(raw, qp, rounded)
    solution, _, error = raw.solve(qp)
    z = None if error or solution.z_box is None or not len(solution.z_box) else solution.z_box
    if z is None:
        found["at active lower bounds"] = found["at infinite bounds"] = "none"
    else:
        found["at active lower bounds"] = "negative" if (z[:2] < 0.0).all() else "positive"
        worst = float(np.abs(z[2:]).max())
        found["at infinite bounds"] = size(worst)
    return found


def right_or_not(raw: Raw, qp: Known, problem: qpsolvers.Problem) -> str:
    """Whether a solver takes a problem for this QP."""
    solution, _, error = raw.solve_problem(problem)
    if error:
        return f"raises {error}"
    if solution.x is not None and qp.error(solution.x) < 1e-2:
        return "right"
    return "wrong, found" if solution.found else "not found"


def hard(raw: Raw) -> dict[str, str]:
    """Problems that come apart from rounding, rank or units; qpmhe's backend beside it."""
    free = np.array([1e-6, 1e-6, 1.0, 1.0, 1e6, 1e6])
    problems = {
        "usual": known(),
        "one equality twice": known(twice=True, equal=True, bounds=0),
        "weakly active bound": known(rows=0, weakly=True),
        "bounds of 1e10": known(far=1e10),
        "bounds of 1e20": known(far=1e20),
        "micro and mega": known(units=free),
    }
    return {title: f"{raw.outcome(qp)} / {own(raw.name, qp)}" for title, qp in problems.items()}


def without_solution(raw: Raw) -> dict[str, str]:
    """Linear programmes, QPs without rows, an unbounded one and an infeasible one."""
    linear = (known(rows=0, linear=True, seed=seed) for seed in range(COUNT))
    free = (known(rows=0, bounds=0, seed=seed) for seed in range(COUNT))
    found = {"linear programmes": raw.count(linear), "QPs without rows": raw.count(free)}
    flat = known(rows=1, bounds=0)
    flat.H[...] = 0.0
    flat.H[0, 0], flat.g[...] = 1.0, 0.0
    flat.g[1], flat.A[...], flat.row_upper[...] = -1.0, 0.0, 1.0
    flat.A[0, 0] = 1.0
    split = known(rows=2, bounds=0)
    split.A[1], split.row_upper[...] = -split.A[0], (-1.0, -1.0)
    for title, qp in (("unbounded", flat), ("infeasible", split)):
        solution, _, error = raw.solve(qp)
        if error:
            found[title] = f"raises {error}"
            continue
        x = None if solution.x is None else float(np.abs(np.asarray(solution.x, float)).max())
        claim = "found" if solution.found else "not found"
        found[title] = f"{claim}, x " + ("None" if x is None else f"up to {size(x)}")
    return found


def left(raw: Raw) -> dict[str, str]:
    """Residuals at default tolerances, and side effects."""
    qp = known()
    problem = raw.problem(qp)
    before = [np.copy(np.asarray(getattr(one, "data", one))) for one in (problem.P, problem.q)]
    solution, _, error = raw.solve_problem(problem)
    if error:
        return {"primal": f"raises {error}"}
    now = [np.asarray(getattr(one, "data", one)) for one in (problem.P, problem.q)]
    changed = any(not np.array_equal(a, b) for a, b in zip(before, now, strict=True))
    values = (solution.primal_residual(), solution.dual_residual(), solution.duality_gap())
    names = ("primal", "dual", "gap")
    shown = {name: size(value) for name, value in zip(names, values, strict=True)}
    return {**shown, "arrays changed": "yes" if changed else "no"}


PARTS = {
    "At a cap": at_the_cap, "Reading": reading, "Hard problems": hard,
    "Little to hold on to": without_solution, "Left behind": left,
}


def measured(name: str) -> dict[str, dict[str, str]]:
    """All answers of one solver, each part by itself."""
    threads = thread_count()
    raw = Raw(name)
    found = {}
    for title, part in PARTS.items():
        answers, _, error = attempt(lambda part=part: part(raw))
        found[title] = answers if not error else {"": error}
    found["Left behind"]["threads left"] = str(thread_count() - threads)
    return found


def thread_count() -> int:
    """Threads of this process, where the system tells."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.exists() else 0


def asked(name: str) -> tuple[dict[str, dict[str, str]] | None, str]:
    """The same in a process of its own, with the lines that the solver prints."""
    if name not in qpsolvers.available_solvers:
        return None, ""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(
        [sys.executable, __file__, "--one", name], capture_output=True, text=True, check=True,
        timeout=SECONDS, env=environment,
    )
    *printed, answers = ended.stdout.strip().splitlines()
    first = next((line.strip() for line in printed if line.strip()), "")
    return json.loads(answers), first


NOTES = {
    "At a cap": """*x at a cap of 1* is the largest error of x at that cap, in units of the
solution; *found* is the solver's own claim. A start of 0.9 x changes x, or does not. qpmhe gives
each cap by one name, `max_solver_iterations`. It takes whatever finite iterate comes back as a
trial, and keeps the candidate where none comes; it gives a start to the solvers that use one, and
refuses an option that does not exist.""",
    "Reading": """Through qpsolvers P is to be symmetric; a solver that reads one triangle is
right with that triangle alone. Multipliers are qpsolvers' `z_box`. qpmhe hands each solver the
triangle that it reads, or both, equal to the last bit; one that refuses infinite bounds gets the
finite ones as rows.""",
    "Hard problems": """Each entry is the largest error of x, in units of the solution, through
qpsolvers at default options, then through qpmhe's backend of the same name. Brackets: the solver
does not claim to have found it; 0 means below 1e-12. qpmhe scales unknowns and rows, leaves out
limits that are too far away to count, solves to 1e-7, and recomputes the residuals: a solution
that does not fit counts as inaccurate, whatever the solver claims.""",
    "Little to hold on to": f"""{COUNT} linear programmes with all bounds active, {COUNT} strictly
convex QPs without rows and bounds: right to 1 %, or wrong although the solver claims to have
found the solution. The last two have no solution; x is what the solver leaves there. qpmhe's QPs
are strictly convex. A solver that needs a row gets one that never binds; any x is a trial, which
the true cost accepts or rejects, but osqp's 2143289344, which stands for none, counts as none.""",
    "Left behind": """Residuals of the first problem at default tolerances, as qpsolvers computes
them (absolute; the problem's numbers are about 1), and side effects. qpmhe gives a solver copies
of the arrays.""",
}


def page(
    answers: dict[str, dict[str, dict[str, str]] | None], printed: dict[str, str]
) -> Iterator[str]:
    """The lines of docs/backends-behaviour.md."""
    yield "# How QP solvers behave\n"
    yield (
        "You want to know what a QP solver does at a cap, with odd data, or where there is no\n"
        "solution, before you rely on it. `python examples/studies/backend_behaviour.py` writes\n"
        "this page from the versions that are installed. All problems are random QPs of six\n"
        "unknowns whose solution is chosen first.\n"
    )
    for title in PARTS:
        rows = {name: found[title] for name, found in answers.items() if found}
        columns = list(dict.fromkeys(column for row in rows.values() for column in row))
        yield f"## {title}\n"
        yield f"| solver | {' | '.join(columns)} |"
        yield f"|{' --- |' * (len(columns) + 1)}"
        for name, found in answers.items():
            if found is None:
                yield f"| {name} | not installed |{' |' * (len(columns) - 1)}"
            else:
                cells = (found[title].get(column, "-") for column in columns)
                yield f"| {name} | {' | '.join(cells)} |"
        yield f"\n{NOTES[title]}\n"
    speaking = [f"{name} prints `{line}`" for name, line in printed.items() if line]
    yield "## Printed lines\n"
    yield ("; ".join(speaking) if speaking else "No solver prints") + " with `verbose=False`.\n"
    yield f"Measured with {', '.join(versions(answers))}."


def versions(names: Any) -> Iterator[str]:
    """The version of each package that took part."""
    packages = [OTHERS[name] if name in OTHERS else TRANSLATIONS[name].package for name in names]
    for package in ("qpsolvers", *dict.fromkeys(packages)):
        try:
            yield f"{package} {version(package)}"
        except PackageNotFoundError:
            continue


def main() -> int:
    """Measure every solver and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--one", help="measure this solver and print its answers as JSON")
    parser.add_argument("--out", type=Path, default=PAGE, help="the page")
    given = parser.parse_args()
    if given.one:
        print("\n" + json.dumps(measured(given.one)))
        return 0
    answers, printed = {}, {}
    for name in sorted({*TRANSLATIONS, *OTHERS}):
        answers[name], printed[name] = asked(name)
        print(name, "measured" if answers[name] else "not installed", flush=True)
    given.out.write_text("\n".join(page(answers, printed)) + "\n")
    print(f"wrote {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
