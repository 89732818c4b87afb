"""Dumped QPs as a test set of qpbenchmark."""

import csv
import subprocess
import sys

import numpy as np
import pytest
import qpsolvers

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies.qpbenchmark_set import export_qpbenchmark
from qpmhe_solvers import QP, create
from qpmhe_solvers.files import dump
from tests.solvers.problems import CASES, make


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


def test_an_exported_problem_has_the_same_optimum_and_objective(folder, tmp_path):
    exported = export_qpbenchmark(folder, tmp_path / "set")
    for path, case in zip(exported.problems, CASES, strict=True):
        qp, dense = make(**CASES[case])
        problem = qpsolvers.Problem.load(str(path))
        for name in ("P", "q", "G", "h", "A", "b", "lb", "ub"):
            value = getattr(problem, name)
            assert value is None or (value.size > 0 and np.isfinite(value).all()), name
        solution, expected = qpsolvers.solve_problem(problem, "quadprog"), dense.minimiser()
        np.testing.assert_allclose(solution.x, expected, atol=1e-7 * (1 + np.abs(expected).max()))
        for x in np.random.default_rng(0).standard_normal((5, qp.size)):
            value = 0.5 * x @ problem.P @ x + problem.q @ x
            assert value == pytest.approx(dense.objective(x), rel=1e-12)


def test_names_are_those_of_the_files_and_what_cannot_be_exported_is_reported(folder, tmp_path):
    new, text = tmp_path / "new", tmp_path / "text.npz"
    other = dump(QP(1, 1), tmp_path / "01 boxes.npz")
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
    text.write_text("no QP")
    for files, out, words in (
        ([], new, "no QP to export: no file was given"),
        ([folder, text], new, r"text.npz is not a QP file"),
        (folder, text, "cannot write the test set to .*text"),
        (folder, tmp_path / "set", "holds problems already"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            export_qpbenchmark(files, out)
        assert not new.exists()
    with pytest.raises(OptionError, match="matrices is 'banded'"):
        export_qpbenchmark(folder, new, matrices="banded")


@pytest.mark.slow
def test_qpbenchmark_takes_the_problems_in_order(folder, tmp_path):
    pytest.importorskip("qpbenchmark", reason="qpbenchmark is not installed")
    exported = export_qpbenchmark(folder, tmp_path / "set", title='The "set"')
    answer = subprocess.run(
        [sys.executable, "-m", "qpbenchmark.benchmark", str(exported.script),
         "--results-path", str(tmp_path / "results.csv"),
         "run", "--solver", "osqp", "--author", "nobody"],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
    )
    assert answer.returncode == 0, answer.stderr
    with (tmp_path / "results.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["settings"] == "high_accuracy"]
    assert [row["problem"] for row in rows] == [path.stem for path in exported.problems]
    assert {row["found"] for row in rows} == {"True"}
    report = (tmp_path / "mhe_qpbenchmark.md").read_text()
    assert '# The "set"' in report
    assert f"{len(CASES)} QPs from the steps of qpmhe" in report
