"""`qpmhe.solvers.check`: every backend conforms, and faults and false words are found."""

import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe_solvers import QP, Backend, Capabilities, RawSolution, check, measure

from .example_backend import Quadprog, entry
from .problems import EVERY, registered

pytest.importorskip("quadprog")
# ecos solves the QP as a second-order cone program; its multipliers satisfy the QP's own
# conditions roughly, so that its claims cannot be confirmed.
MARKED = {"ecos": "INACCURATE"}


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_every_backend_is_what_it_says_and_prints_nothing(name, capfd):
    report = check(name)
    assert capfd.readouterr() == ("", "")
    assert report.measured == report.declared, str(report)
    for finding in report.findings:
        complaints = finding.detail.split("; ") if finding.detail else []
        marked = MARKED.get(name)
        assert all(marked and f": {marked}," in one for one in complaints), str(report)
        assert finding.passed == (not complaints)
    assert report.passed == (name not in MARKED)
    if name == "banded":
        assert measure(name) == Capabilities(*[False] * 7)


def test_no_backend_has_a_banner():
    # Which a solver writes once a process, where the test above may come too late.
    code = (
        "import qpmhe_solvers as s\n"
        "for name in s.available(): s.create(name).solve(s.QP(2, 2))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "", "")


def test_a_backend_of_a_user_conforms():
    with registered(entry()):
        report = qpmhe.solvers.check("mine")
    assert (report.passed, str(report), len(report.findings)) == (True, "mine: conforms", 20)


def stale(self, qp, solve):
    before, self.before = self.before, solve(qp)
    return before if before is not None and np.size(before.d) == qp.size else self.before


def zero(qp):
    pushes = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
    return RawSolution(np.zeros(qp.size), True, 1, *pushes)


def in_place(self, qp, solve):
    """Scale the QP in place, do nothing, and have nothing left to do."""
    qp.gradient *= 1e-12
    qp.band *= 1e-12
    return zero(qp)


def dead(self, qp, solve):
    """After a failure it never recovers."""
    if self.before:
        raise RuntimeError("dead")
    try:
        return solve(qp)
    except ValueError:
        self.before = True
        raise


def no_rows(self, qp, solve):
    """Forget the general rows."""
    without = QP(qp.stages, qp.n)
    for name in ("band", "gradient", "lower", "upper"):
        getattr(without, name)[...] = getattr(qp, name)
    found = solve(without)
    return RawSolution(found.d, True, 1, found.bound_duals, zero(qp).row_duals)


@pytest.mark.parametrize(
    ("fault", "part", "words"),
    [
        (stale, "20 QPs in turn", "INACCURATE"),
        (in_place, "no inequality", "it wrote into band, gradient of the QP"),
        (dead, "an infeasible QP, then a good one", "after contradicting rows: FAILED"),
        (no_rows, "equalities", "INACCURATE"),
    ],
)
def test_faults_are_found(fault, part, words):
    class Faulty(Quadprog):
        before = None

        def _solve(self, qp, start):
            return fault(self, qp, lambda qp: super(Faulty, self)._solve(qp, start))

    with registered(Backend("faulty", Faulty, "theatre")):
        report = check("faulty")
    assert not report.passed
    (found,) = (one for one in report.findings if one.check == part)
    assert (found.passed, words in found.detail) == (False, True)
    assert f"\n  {part}: " in str(report)
    assert str(report).startswith("faulty: does not conform")


def test_who_ignores_limits_and_gives_no_multipliers_is_told_so_in_few_words():
    class Dense(qpmhe.solvers.Solver):
        def _solve(self, qp, start):
            found = np.linalg.solve(qp.dense(), -qp.gradient.ravel())
            return RawSolution(found.reshape(qp.stages, qp.n), claimed=True)

    with registered(Backend("dense", Dense, "-", inequalities=False)):
        report = check("dense")
    assert report.measured == report.declared
    faults = {one.check: one.detail for one in report.findings if not one.passed}
    assert "no multipliers to check the claim" in faults["no inequality"]
    assert faults["20 QPs in turn"].endswith("; and 17 more")
    assert "limits that come and go" not in faults


@pytest.mark.parametrize(
    "flag", ["iteration_cap", "iterate_at_cap", "warm_start", "time_limit", "keeps_duals"]
)
def test_false_words_are_found(flag):
    with registered(Backend("boasting", Quadprog, "-", **{flag: True})):
        report = check("boasting")
    assert not report.passed
    assert all(finding.passed for finding in report.findings)
    assert f"  {flag} is declared True, but measured False" in str(report)
