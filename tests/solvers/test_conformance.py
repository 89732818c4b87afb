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
    SolveStatus,
    backend,
    check,
    create,
    measure,
)
from qpmhe_solvers.sample_qps import contradiction, sample

from .example_backend import Quadprog, entry
from .problems import EVERY, registered

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
    pytest.importorskip("quadprog")
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

    before = None

    def _solve(self, qp, start):
        raw = super()._solve(qp, start)
        answer = self.spoilt(qp, raw)
        self.before = raw
        return answer

    def spoilt(self, qp, raw):
        return raw


class Stale(Faulty):
    def spoilt(self, qp, raw):
        fits = self.before is not None and np.size(self.before.d) == qp.size
        return self.before if fits else raw


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


class InPlace(Faulty):
    """It scales its QP in place, does nothing, and has nothing left to do."""

    def _solve(self, qp, start):
        qp.gradient *= 1e-12
        qp.band *= 1e-12
        zeros = np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
        return RawSolution(zeros[0], True, 1, *zeros)


class Leaving(Faulty):
    def spoilt(self, qp, raw):
        sys.exit(3)


class Dead(Faulty):
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


class NoRows(Faulty):
    """It forgets the general rows."""

    def _solve(self, qp, start):
        without = type(qp)(qp.stages, qp.n)
        for name in ("band", "gradient", "lower", "upper"):
            getattr(without, name)[...] = getattr(qp, name)
        raw = super()._solve(without, start)
        return RawSolution(raw.d, True, 1, raw.bound_duals, np.zeros(qp.stages * qp.rows))


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
    ],
)
def test_faults_are_found(fault, part, words):
    pytest.importorskip("quadprog")
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
    pytest.importorskip("quadprog")
    with registered(Backend("boasting", Quadprog, "-", **{flag: True})):
        report = check("boasting")
    assert not report.passed
    assert all(finding.passed for finding in report.findings)
    assert f"  {flag} is declared True, but measured False" in str(report)


def test_capabilities_are_those_of_the_table():
    assert Capabilities.declared(backend("banded")) == Capabilities(*[False] * 7)
    assert measure("banded") == Capabilities(*[False] * 7)


def test_a_backend_that_never_answers_is_measured():
    class Silent(Solver):
        def _solve(self, qp, start):
            raise RuntimeError("never")

    with registered(Backend("silent", Silent, "-", inequalities=False)):
        report = check("silent")
    assert not report.measured.inequalities
    assert not any(finding.passed for finding in report.findings)


@pytest.mark.parametrize("bounds", ["all", "part"])
@pytest.mark.parametrize("sides", ["two", "equal", "mixed"])
def test_samples_have_a_solution_with_active_limits(bounds, sides):
    pytest.importorskip("quadprog")
    for seed in range(3):
        qp = sample(7, 3, 2, bounds=bounds, sides=sides, seed=seed)
        assert np.linalg.eigvalsh(qp.dense())[0] > 0
        solution = create("quadprog").solve(qp)
        assert solution.status is SolveStatus.SOLVED
        assert np.count_nonzero(np.abs(solution.bound_duals) > 1e-6) > 2


def test_the_hessian_of_a_sample_is_a_sum_over_stages():
    # Each stage's term couples it to the next one only, and the last stage stands alone.
    qp = sample(3, 2, decades=0.0, seed=4)
    full = qp.dense()
    assert np.count_nonzero(full[:2, 4:]) == 0
    assert np.count_nonzero(full[:2, 2:4]) == 4
    np.testing.assert_array_equal(full, full.T)


def test_the_contradiction_is_one():
    qp = contradiction()
    middle = qp.row_lower[3], qp.row_upper[3]
    assert (qp.row_own[3, 0] == qp.row_own[3, 1]).all()
    assert middle[0][0] > middle[1][1]


PLUGIN = """
import numpy as np
from qpmhe_solvers import Backend, RawSolution, Solver

class Zero(Solver):
    def _solve(self, qp, start):
        return RawSolution(np.zeros(qp.size), False)

one = Backend("zero", Zero, "none")
def two():
    return [Backend("zero2", Zero, "none"), Backend("zero3", Zero, "none")]
def nothing():
    return 3
def taken():
    return Backend("osqp", Zero, "none")
def mixed():
    return [3]
def leaving():
    raise SystemExit(3)
"""
SCRIPT = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import qpmhe_solvers as s
    print("plugin" in __import__("sys").modules)
    names = {lookup}
    s.available(); s.backends()
print([name for name in s.available() if "zero" in name])
print(s.create("zero").solve(s.QP(2, 2)).status.name)
for one in caught:
    print(one.category.__name__, one.message)
"""


@pytest.mark.parametrize("lookup", ["s.available()", "s.backends()", "s.backend('zero2')"])
def test_entry_points(tmp_path, lookup):
    import subprocess

    (tmp_path / "plugin.py").write_text(PLUGIN)
    info = tmp_path / "plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    points = {
        "one": "plugin:one", "two": "plugin:two", "odd": "plugin:nothing", "gone": "nosuch:x",
        "clash": "plugin:taken", "mixed": "plugin:mixed", "leaves": "plugin:leaving",
    }
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text("[qpmhe.backends]\n" + "\n".join(lines) + "\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + SCRIPT.format(lookup=lookup)
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    early, names, status, *warned = result.stdout.splitlines()
    assert early == "False"  # importing the package loads nobody's entry points
    assert names == "['zero', 'zero2', 'zero3']"
    assert status == "STOPPED"
    assert len(warned) == 5
    for name, words in (
        ("odd", "TypeError"), ("gone", "ModuleNotFoundError"), ("clash", "registered already"),
        ("mixed", "cannot register 3"), ("leaves", "SystemExit: 3"),
    ):
        (line,) = (one for one in warned if f"the entry point {name!r}" in one)
        assert words in line
        assert line.startswith("UserWarning")
