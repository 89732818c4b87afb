"""`qpmhe solve-qp`: recorded QPs, solved again by any backend."""

import io

import numpy as np
import pytest
from rich.console import Console

from qpmhe.cli import solve_qp
from qpmhe.errors import BackendError, InvalidInputError, OptionError
from qpmhe_solvers import QP, Backend, SolverOptions, available, create
from qpmhe_solvers.files import dump, load
from tests.solvers.problems import CASES, make, registered


class Screen:
    """A console of a width, and what was printed on it."""

    def __init__(self, width=80):
        self.console = Console(width=width, record=True, file=io.StringIO())

    def rows(self):
        """Cells of each line, by its first one."""
        lines = [line.split() for line in self.console.export_text(clear=False).splitlines()]
        return {line[0]: line[1:] for line in lines if line}

    def text(self):
        return " ".join(self.console.export_text(clear=False).split())


@pytest.fixture
def stored(tmp_path):
    qp, _ = make(**CASES["boxes"])
    options = SolverOptions(max_iterations=3)
    return dump(
        qp, tmp_path / "capped.npz", solution=create("osqp", options).solve(qp),
        backend="osqp", options=options,
    )


def test_by_default_it_is_solved_as_it_was(stored, tmp_path):
    screen = Screen()
    assert solve_qp.run(screen.console, [stored]) is False
    rows = screen.rows()
    assert rows["osqp"][:2] == ["STOPPED", "3"]
    assert rows["osqp"][2:7] == [*rows["as"][3:7], "0"]  # "as dumped": the same, to the last digit
    assert "cap 3, tolerance 1e-07; dumped by osqp" in screen.text()
    assert "osqp: maximum iterations reached" in screen.text()
    screen = Screen()
    path = dump(make(3, 2)[0], tmp_path / "qp.npz", backend="no longer there")
    assert solve_qp.run(screen.console, [path])
    assert screen.rows()["auto"][:2] == ["SOLVED", "0"]
    assert "as dumped" not in screen.text()


def test_named_backends_and_limits(stored):
    screen, old = Screen(), "qpsolvers:quadprog-of-old"
    entry = Backend(old, lambda options: create("banded", options), "-", inequalities=False)
    names = ["osqp", "quadprog"]
    assert solve_qp.run(screen.console, [stored], names, max_iterations=4000, tolerance=1e-9)
    rows, found = screen.rows(), load(stored)
    assert rows["osqp"][0] == rows["quadprog"][0] == "SOLVED"
    assert "cap 4000, tolerance 1e-09" in screen.text()
    optimum = create("quadprog").solve(found.qp)
    assert float(rows["quadprog"][5]) == pytest.approx(found.qp.objective(optimum.d), rel=1e-6)
    apart = np.abs(optimum.d - found.solution.d).max()
    assert float(rows["quadprog"][6]) == pytest.approx(apart, rel=0.06)
    assert "STOPPED" in rows["as"]
    screen = Screen(100)
    assert solve_qp.run(screen.console, [stored], max_iterations=4000, every=True)
    rows = screen.rows()
    assert set(available()) <= set(rows)
    assert (rows["auto"][0], rows["banded"][0]) == ("SOLVED", "UNCONSTRAINED")
    screen = Screen()
    with registered(entry):
        solve_qp.run(screen.console, [stored], [old])
    text = screen.console.export_text()  # nothing is cut off
    assert "\u2026" not in text
    assert old in "".join(line.split(" ")[0] for line in text.splitlines())


def test_each_of_several_files_must_be_solved_and_exports(stored, tmp_path, monkeypatch, capsys):
    spoilt, screen, names = QP(2, 1), Screen(), ["osqp", "auto"]
    spoilt.gradient[0] = np.nan
    dump(spoilt, tmp_path / "spoilt.npz", backend="no longer there")
    assert not solve_qp.run(screen.console, [tmp_path], names, max_iterations=4000)
    assert "osqp: the QP's data are not finite" in screen.text()
    assert "2 QPs" in screen.text()
    assert screen.rows()["osqp"][:6] == ["2", "1", "-", "-", "-", "1"]
    assert solve_qp.run(screen.console, [stored, stored], names, max_iterations=4000)
    out = tmp_path / "set"
    monkeypatch.setenv("COLUMNS", "300")
    solve_qp.export_qps([tmp_path], out)
    text = " ".join(capsys.readouterr().out.split())
    assert f"qpbenchmark {out}/mhe_qpbenchmark.py --results-path {out}/results.csv run" in text
    assert "wrote 1 QPs" in text
    assert "its data are not finite" in text
    assert (out / "problems" / "capped.npz").is_file()


def test_bad_arguments_are_refused_before_anything_is_solved(stored, tmp_path):
    for arguments, error, words in [
        ({"backends": ["nonsense"]}, BackendError, "nonsense"),
        ({"max_iterations": 0}, OptionError, "max_iterations is 0"),
        ({"tolerance": -1.0}, OptionError, "absolute_tolerance is -1"),
        ({"paths": ["none.npz"]}, InvalidInputError, "no file none.npz"),
        ({"paths": [tmp_path / "empty"]}, InvalidInputError, "holds no .npz file"),
        ({"paths": [__file__]}, InvalidInputError, "is not a QP file"),
    ]:
        screen = Screen()
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(error, match=words):
            solve_qp.run(screen.console, **{"paths": [stored], **arguments})
        assert screen.text() == ""
