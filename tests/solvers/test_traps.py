"""`qpmhe.solvers.check` names the traps of a user's backend: one broken backend for each."""

import ctypes
import subprocess
import sys
import threading

import numpy as np
import pytest
from scipy.linalg.lapack import dpotrf, dpotrs

from qpmhe_solvers import Backend, RawSolution, Solver, check, create
from qpmhe_solvers.sample_qps import contradiction
from qpmhe_solvers.traps import PATIENCE, TRAPS, SolverOptions

from .example_backend import Quadprog
from .problems import EVERY, registered

pytest.importorskip("quadprog")
EQUAL, SYMMETRIC = "QPs with equal Hessians", "a Hessian symmetric to the last bit only"
NUMBERS = "numbers that stand for none"


class Free(Solver):
    """The minimiser without inequalities, by a Hessian that `hessian` makes."""

    def hessian(self, qp):
        return qp.dense()

    def minimiser(self, qp):
        return np.linalg.solve(self.hessian(qp), -qp.gradient.ravel())

    def _solve(self, qp, start):
        if np.isfinite(qp.limits).any():
            raise NotImplementedError("limits")
        return RawSolution(
            self.minimiser(qp), True, 1, np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        )


class Strict(Free):
    """Scales rows, then columns, and has a library that wants symmetry to the last bit."""

    def hessian(self, qp):
        unit = 1.0 / np.sqrt(qp.band[:, :, 0].ravel())
        scaled = qp.dense() * unit[:, None] * unit
        if not np.array_equal(scaled, scaled.T):
            raise ValueError("P must be symmetric")
        return scaled / unit[:, None] / unit


class StrictAsGiven(Free):
    def hessian(self, qp):
        matrix = qp.dense()
        if not np.array_equal(matrix, matrix.T):
            raise ValueError("not equal to its transpose")
        return matrix


class Overwriting(Free):
    """Keeps a Fortran-ordered Hessian while it is the same, which LAPACK factorises in place."""

    kept = seen = None

    def minimiser(self, qp):
        if self.seen is None or not np.array_equal(self.seen, qp.band):
            self.seen, self.kept = qp.band.copy(), np.asfortranarray(qp.dense())
        factor, _ = dpotrf(self.kept, lower=1, overwrite_a=1, clean=0)
        return dpotrs(factor, -qp.gradient.ravel(), lower=1)[0]


class Changed(Quadprog):
    """quadprog's right answer, and something that is done to it."""

    def changed(self, raw):
        return raw

    def _solve(self, qp, start):
        return self.changed(super()._solve(qp, start))


def parts(raw, **changes):
    names = ("d", "claimed", "iterations", "bound_duals", "row_duals", "message")
    return RawSolution(**{name: getattr(raw, name) for name in names} | changes)


class NeverFound(Changed):
    def changed(self, raw):
        return parts(raw, claimed=False)


class CodeForFound(Changed):
    def changed(self, raw):
        return parts(raw, claimed=1)


class NoMultipliers(Changed):
    def changed(self, raw):
        return parts(raw, bound_duals=None, row_duals=raw.row_duals[:-1])


class OtherSigns(Changed):
    def changed(self, raw):
        return parts(raw, bound_duals=-raw.bound_duals, row_duals=-raw.row_duals)


class OtherSignsOfBounds(Changed):
    def changed(self, raw):
        return parts(raw, bound_duals=-raw.bound_duals)


class Untold(Changed):
    """Leaves the accuracy of a solver whose tolerance has another name."""

    def changed(self, raw):
        return parts(raw, d=raw.d + 1e-3)


class NaNAsNumber(Quadprog):
    def _solve(self, qp, start):
        try:
            return super()._solve(qp, start)
        except ValueError:
            return RawSolution(np.full(qp.size, 2143289344.0), False)


class NaNAsClaim(NaNAsNumber):
    """The same, with a status of success."""

    def _solve(self, qp, start):
        raw = super()._solve(qp, start)
        return parts(raw, claimed=True)


class StartAsAnswer(Quadprog):
    """Takes a start that is far away for the solution's active set, and stays there."""

    def _solve(self, qp, start):
        raw = super()._solve(qp, start)
        return raw if start is None or np.abs(start).max() < 50.0 else parts(raw, d=start)


class Speaking(Quadprog):
    def _solve(self, qp, start):
        print("a licence for academic use")
        return super()._solve(qp, start)


class SpeakingInC(Quadprog):
    """Through the C library, which holds back what does not go to a terminal."""

    def _solve(self, qp, start):
        ctypes.CDLL(None).puts(b"iteration 0\niteration 1")
        return super()._solve(qp, start)


class Threads(Quadprog):
    """A pool of one for each solver, which nobody ends."""

    over = threading.Event()
    pool = None

    def _solve(self, qp, start):
        if self.pool is None:
            self.pool = threading.Thread(target=self.over.wait, daemon=True)
            self.pool.start()
        return super()._solve(qp, start)


@pytest.mark.parametrize(
    ("made", "trap", "words"),
    [
        (Strict, SYMMETRIC, "refuses (ValueError: P must be symmetric): make one triangle"),
        (StrictAsGiven, SYMMETRIC, "makes it fail (ValueError: not equal to its transpose)"),
        (Overwriting, EQUAL, "solve 2 with an equal Hessian differs from a new solver's"),
        (NeverFound, "claim and multipliers", "it never claims success"),
        (CodeForFound, "claim and multipliers", "claimed is 1, a int; return True or False"),
        (NoMultipliers, "claim and multipliers", "bound_duals is not 21 finite numbers and row_"),
        (OtherSigns, "claim and multipliers", "multipliers of bounds and rows have the opposite"),
        (OtherSignsOfBounds, "claim and multipliers", "multipliers of bounds have the opposite"),
        (Untold, "the tolerance", "at absolute_tolerance 1e-2 and 1e-9 alike"),
        (NaNAsNumber, NUMBERS, "leaves 2143289344 in every unknown"),
        (NaNAsClaim, NUMBERS, "leaves 2143289344 in every unknown"),
        (StartAsAnswer, "starts", "started at far away: another solution"),
        (Speaking, "printed lines", "it prints 'a licence for academic use' and 2 more"),
        (SpeakingInC, "printed lines", "it prints 'iteration 0' and 5 more"),
        (Threads, "threads", "4 solvers that were used and dropped left 4 threads"),
    ],
)
def test_a_trap_is_named(made, trap, words, capfd):
    limits = issubclass(made, Quadprog)
    with registered(Backend("trap", made, "theatre", inequalities=limits, warm_start=False)):
        try:
            report = check("trap")
        finally:
            Threads.over.set()
            Threads.over = threading.Event()
    capfd.readouterr()  # later checks let it speak
    found = {one.check: one.detail for one in report.findings}
    assert words in found[trap], found
    assert f"\n  {trap}: " in str(report)
    # Each backend has one trap; where its answers are wrong, no other is blamed for it.
    others = {*TRAPS, "printed lines"} - {trap}
    assert {name: found[name] for name in others if found[name]} == {}


@pytest.mark.parametrize("flag", ["iteration_cap", "warm_start", "time_limit", "iterate_at_cap"])
def test_an_option_that_does_not_arrive_has_its_reason(flag):
    with registered(Backend("boasting", Quadprog, "-", **{flag: True})):
        line = next(one for one in str(check("boasting")).splitlines() if flag in one)
    words = {"iteration_cap": "misspelt", "time_limit": "the name of the solver's option"}
    assert words.get(flag, "ignored" if flag == "warm_start" else "return") in line


@pytest.mark.parametrize("name", [name for name in EVERY if "osqp" in name])
def test_osqp_leaves_no_number_that_stands_for_none(name):
    solution = create(name, SolverOptions(PATIENCE)).solve(contradiction())
    assert (solution.d, "infeasible" in solution.message) == (None, True)


def test_a_backend_whose_streams_are_closed_is_checked_too():
    code = (
        "import os, sys; sys.path[:0] = sys.argv[1:]; os.close(1); sys.stdout = None\n"
        "import qpmhe_solvers as s; sys.exit(str(s.check('banded')) != 'banded: conforms')"
    )
    done = subprocess.run([sys.executable, "-c", code, *sys.path], stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")
