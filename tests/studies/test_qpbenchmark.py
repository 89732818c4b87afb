import csv
import os
import runpy
import subprocess
import sys
import types

import numpy as np
import pytest
import qpsolvers
from solvers.problems import CASES, make

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies.qpbenchmark_set import export_qpbenchmark
from qpmhe_solvers import QP, create
from qpmhe_solvers.files import dump


@pytest.fixture
def folder(tmp_path):
    """A folder of dumped QPs, one of each case that is not nearly degenerate."""
    inside = tmp_path / "dumped"
    inside.mkdir()
    for number, case in enumerate(CASES):
        qp, _ = make(**CASES[case])
        dump(qp, inside / f"{number:02d} {case}.npz", backend="auto",
             solution=create("auto").solve(qp))
    return inside


def missed(problem, x):
    found = [np.zeros(1)]
    for matrix, side, size in (
        (problem.G, problem.h, np.asarray), (problem.A, problem.b, np.abs),
        (-np.eye(x.size), None if problem.lb is None else -problem.lb, np.asarray),
        (np.eye(x.size), problem.ub, np.asarray),
    ):
        if side is not None:
            found.append(size(matrix @ x - side))
    return np.concatenate(found).max()


@pytest.mark.parametrize("case", CASES)
def test_an_exported_problem_has_the_same_optimum_objective_and_constraints(case, tmp_path):
    qp, dense = make(**CASES[case])
    exported = export_qpbenchmark(dump(qp, tmp_path / "one.npz"), tmp_path / "set")
    problem = qpsolvers.Problem.load(str(exported.problems[0]))
    for name in ("P", "q", "G", "h", "A", "b", "lb", "ub"):
        value = getattr(problem, name)
        assert value is None or (value.size > 0 and np.isfinite(value).all()), name
    solution, expected = qpsolvers.solve_problem(problem, "quadprog"), dense.minimiser()
    np.testing.assert_allclose(solution.x, expected, atol=1e-7 * (1 + np.abs(expected).max()))
    for x in np.random.default_rng(0).standard_normal((20, qp.size)):
        value = 0.5 * x @ problem.P @ x + problem.q @ x
        assert value == pytest.approx(dense.objective(x), rel=1e-12)
        assert missed(problem, x) == pytest.approx(dense.violation(x), rel=1e-12, abs=1e-12)


def test_a_side_of_the_bounds_that_is_finite_is_given_as_such(tmp_path):
    for name, component, given in (("all", slice(None), True), ("some", 0, False)):
        qp, _ = make(3, 2)
        qp.bounded = True
        qp.lower[:, component] = -1.0
        exported = export_qpbenchmark(dump(qp, tmp_path / f"{name}.npz"), tmp_path / name)
        problem = qpsolvers.Problem.load(str(exported.problems[0]))
        assert (problem.lb is not None, problem.G is None, problem.ub) == (given, given, None)


def test_names_are_those_of_the_files_and_what_no_solver_must_be_given_is_left_out(
    folder, tmp_path
):
    other = tmp_path / "other"
    other.mkdir()
    dump(QP(1, 1), other / "01 boxes.npz")
    spoilt, crossed = QP(2, 1), QP(2, 1)
    spoilt.gradient[0] = np.nan
    crossed.lower[0], crossed.upper[0] = 1.0, 0.0
    one, two = (dump(qp, tmp_path / f"{k}.npz") for k, qp in enumerate((spoilt, crossed)))
    exported = export_qpbenchmark([one, folder, two, other], tmp_path / "set")
    assert exported.skipped == {
        one: "its data are not finite", two: "a lower bound is above its upper bound",
    }
    names = [path.stem for path in exported.problems]
    assert names == [f"{number:02d} {case}" for number, case in enumerate(CASES)] + ["01 boxes_2"]
    assert exported.script.name == "mhe_qpbenchmark.py"
    assert sorted((tmp_path / "set" / "problems").iterdir()) == sorted(exported.problems)


def test_what_cannot_be_exported_is_reported(folder, tmp_path):
    (tmp_path / "text.npz").write_text("text")
    spoilt = QP(2, 1)
    spoilt.gradient[0] = np.nan
    one, new = dump(spoilt, tmp_path / "one.npz"), tmp_path / "set"
    export_qpbenchmark(folder, tmp_path / "full")
    for files, out, error, words in (
        ([], new, InvalidInputError, "no QP to export: no file was given"),
        ([one], new, InvalidInputError, "no QP to export: its data are not finite"),
        ([folder, tmp_path / "text.npz"], new, InvalidInputError, r"text.npz is not a QP file"),
        (folder, tmp_path / "text.npz", InvalidInputError, "cannot write the test set to .*text"),
        (folder, tmp_path / "full", InvalidInputError, "holds problems already"),
    ):
        with pytest.raises(error, match=words):
            export_qpbenchmark(files, out)
        assert not new.exists()
    with pytest.raises(OptionError, match="matrices is 'banded'"):
        export_qpbenchmark(folder, new, matrices="banded")


def test_the_script_yields_the_problems_in_order(folder, tmp_path, monkeypatch):
    class Problem:
        @staticmethod
        def load(path):
            kinds = {f"to_{kind}": lambda kind=kind: (kind, path) for kind in ("sparse", "dense")}
            return types.SimpleNamespace(**kinds)

    stand_in = types.SimpleNamespace(TestSet=object, Problem=Problem)
    monkeypatch.setitem(sys.modules, "qpbenchmark", stand_in)
    for kind in ("sparse", "dense"):
        exported = export_qpbenchmark(folder, tmp_path / kind, matrices=kind, title='the "set"')
        # qpbenchmark looks for the class by the name of the file.
        test_set = runpy.run_path(str(exported.script))["MheQpbenchmark"]()
        assert list(test_set) == [(kind, str(path)) for path in exported.problems]
        assert (test_set.title, test_set.sparse_only) == ('the "set"', kind == "sparse")
        assert test_set.description.startswith(f"{len(CASES)} QPs from")


@pytest.mark.slow
def test_the_runner_and_report_of_qpbenchmark_take_it(folder, tmp_path):
    pytest.importorskip("qpbenchmark", reason="qpbenchmark is not installed")
    exported = export_qpbenchmark(folder, tmp_path / "set", title="Fourteen")
    answer = subprocess.run(
        [sys.executable, "-m", "qpbenchmark.benchmark", str(exported.script),
         "--results-path", str(tmp_path / "results.csv"),
         "run", "--solver", "osqp", "--author", "nobody"],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert answer.returncode == 0, answer.stderr
    with (tmp_path / "results.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["settings"] == "high_accuracy"]
    assert {row["problem"] for row in rows} == {path.stem for path in exported.problems}
    for row in rows:
        assert row["found"] == "True", row
        assert float(row["primal_residual"]) < 1e-6
        assert float(row["dual_residual"]) < 1e-6
    report = (tmp_path / "mhe_qpbenchmark.md").read_text()
    assert "# Fourteen" in report
    assert f"{len(CASES)} QPs from the steps of qpmhe" in report
    assert "| osqp" in report
