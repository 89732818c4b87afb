"""`qpmhe.solvers.check`: every backend conforms, and faults and false words are found."""

import sys

import numpy as np
import pytest

import qpmhe
from qpmhe_solvers import (
    Backend,
    BackendError,
    Capabilities,
    RawSolution,
    Solver,
    check,
    measure,
)

from .example_backend import Quadprog, entry
from .problems import EVERY, registered

pytest.importorskip("quadprog")
# ecos solves the QP as a second-order cone program; its multipliers satisfy the QP's own
# conditions roughly, so that its claims cannot be confirmed.
MARKED = {"ecos": "INACCURATE"}


@pytest.mark.parametrize("name", EVERY)
def test_every_backend_is_what_it_says(name):
    report = check(name)
    assert report.measured == report.declared, str(report)
    for finding in report.findings:
        complaints = finding.detail.split("; ") if finding.detail else []
        marked = MARKED.get(name)
        assert all(marked and f": {marked}," in one for one in complaints), str(report)
        assert finding.passed == (not complaints)
    assert report.passed == (name not in MARKED)


def test_a_backend_of_a_user_conforms():
    with registered(entry()):
        report = qpmhe.solvers.check("mine")
    assert report.passed, str(report)
    assert str(report) == "mine: conforms"
    assert len(report.findings) == 12


@pytest.mark.parametrize("function", [check, measure])
def test_only_what_is_there_can_be_checked(function):
    with pytest.raises(BackendError, match="'nosuch' is not known"):
        function("nosuch")
    absent = Backend("ghost", Quadprog, "none at all", module="no_such_module")
    with registered(absent), pytest.raises(BackendError, match="pip install no_such_module"):
        function("ghost")


class Faulty(Quadprog):
    """Quadprog, but for what its subclasses do wrong."""

    def _solve(self, qp, start):
        return self.spoilt(qp, super()._solve(qp, start))


class Stale(Faulty):
    before = None

    def spoilt(self, qp, raw):
        fits = self.before is not None and np.size(self.before.d) == qp.size
        before, self.before = self.before, raw
        return before if fits else raw


class Writing(Faulty):
    def spoilt(self, qp, raw):
        qp.upper += 1.0
        return raw


class Lying(Faulty):
    def spoilt(self, qp, raw):
        return RawSolution(np.zeros(qp.size), True, 1, raw.bound_duals, raw.row_duals)


class Raising(Faulty):
    def spoilt(self, qp, raw):
        if not np.isfinite(qp.lower).any() and not np.isfinite(qp.upper).any():
            raise KeyError("no bounds")
        return raw


class Leaving(Faulty):
    def spoilt(self, qp, raw):
        sys.exit(3)


class InPlace(Quadprog):
    """It scales its QP in place, does nothing, and has nothing left to do."""

    def _solve(self, qp, start):
        qp.gradient *= 1e-12
        qp.band *= 1e-12
        zeros = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        return RawSolution(zeros[0], True, 1, *zeros)


class Dead(Quadprog):
    """After a failure it never recovers."""

    dead = False

    def _solve(self, qp, start):
        if self.dead:
            raise RuntimeError("dead")
        try:
            return super()._solve(qp, start)
        except ValueError:
            self.dead = True
            raise


class NoRows(Quadprog):
    """It forgets the general rows."""

    def _solve(self, qp, start):
        without = type(qp)(qp.stages, qp.n)
        for name in ("band", "gradient", "lower", "upper"):
            getattr(without, name)[...] = getattr(qp, name)
        raw = super()._solve(without, start)
        return RawSolution(raw.d, True, 1, raw.bound_duals, np.zeros(qp.stages * qp.rows))


class Silent(Solver):
    def _solve(self, qp, start):
        raise RuntimeError("never")


@pytest.mark.parametrize(
    ("fault", "part", "words"),
    [
        (Stale, "20 QPs in turn", "INACCURATE"),
        (Writing, "20 QPs in turn", "wrote into upper"),
        (InPlace, "no inequality", "it wrote into band, gradient of the QP"),
        (InPlace, "20 QPs in turn", "wrote into gradient"),
        (Leaving, "no inequality", "SystemExit: 3"),
        (Lying, "no inequality", "INACCURATE"),
        (Raising, "no inequality", "KeyError"),
        (Dead, "an infeasible QP, then a good one", "after contradicting rows: FAILED"),
        (NoRows, "equalities", "INACCURATE"),
        (Silent, "no inequality", "RuntimeError: never"),
    ],
)
def test_faults_are_found(fault, part, words):
    with registered(Backend("faulty", fault, "theatre")):
        report = check("faulty")
    assert not report.passed
    (found,) = (one for one in report.findings if one.check == part)
    assert not found.passed
    assert words in found.detail
    assert f"\n  {part}: " in str(report)
    assert str(report).startswith("faulty: does not conform")


@pytest.mark.parametrize(
    "flag",
    ["iteration_cap", "iterate_at_cap", "warm_start", "time_limit", "keeps_duals",
     "reports_infeasibility"],
)
def test_false_words_are_found(flag):
    with registered(Backend("boasting", Quadprog, "-", **{flag: True})):
        report = check("boasting")
    assert not report.passed
    assert all(finding.passed for finding in report.findings)
    assert f"  {flag} is declared True, but measured False" in str(report)


def test_a_backend_without_inequalities_is_capable_of_nothing():
    assert measure("banded") == Capabilities(*[False] * 7)
