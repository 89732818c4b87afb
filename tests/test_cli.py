import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app
from qpmhe.errors import QpmheError


def test_solvers_lists_every_backend():
    answer = CliRunner().invoke(app, ["solvers"])
    assert answer.exit_code == 0
    for entry in qpmhe.solvers.backends():
        assert entry.name in answer.output


def test_version():
    assert qpmhe.__version__ in CliRunner().invoke(app, ["--version"]).output


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_reproduce_writes_what_it_says(tmp_path: Path, method):
    pytest.importorskip("casadi")
    arguments = ["reproduce", "--steps", "25", "--seed", "3", "--method", method, "--ipopt"]
    answer = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path)])
    assert answer.exit_code == 0, answer.output
    for name in ("reproduce.png", "reproduce.svg", "reproduce.csv"):
        assert (tmp_path / name).stat().st_size > 1000
    with (tmp_path / "reproduce.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 26
    system, observer, cost, scenario = qpmhe.models.batch_reactor(method)
    states, measurements = scenario.simulate(3, 25)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=[3, 0], max_qps=2
    )
    run = mhe.run(measurements)
    for t, row in enumerate(rows):
        assert float(row["real_x1"]) == states[t, 0]
        assert float(row["i_is_2_x2"]) == run.states[t, 1]
    with (tmp_path / "reproduce_backends.csv").open() as file:
        compared = list(csv.DictReader(file))
    assert {row["backend"] for row in compared} == {
        name for name in qpmhe.solvers.available() if name != "auto" and ":" not in name
    }
    with (tmp_path / "reproduce_summary.csv").open() as file:
        summary = {row["run"]: row for row in csv.DictReader(file)}
    # Ipopt and the QPs come to the same minimum of the same problem.
    assert float(summary["Ipopt converged"]["mean_J"]) == pytest.approx(
        float(summary["converged"]["mean_J"]), rel=1e-6
    )


def test_reproduction_over_seeds_is_the_mean_of_single_ones():
    options = {"steps": 20, "backend_name": "banded"}
    one, two, three = (qpmhe.studies.reproduce(seed=k, **options) for k in (4, 5, 6))
    found = qpmhe.studies.reproduce(seed=4, seeds=3, **options)
    for row, *singles in zip(found.rows, one.rows, two.rows, three.rows, strict=True):
        for name in ("rmse", "rmse_settled"):
            values = np.array([getattr(single, name) for single in singles])
            assert getattr(row, name) == pytest.approx(values.mean())
            half = 4.302652729749464 * values.std(ddof=1) / np.sqrt(3.0)  # Student's, 2 degrees
            assert getattr(row, f"{name}_half") == pytest.approx(half)
        assert row.states.tolist() == singles[0].states.tolist()
    assert [found.excess(row) for row in found.backends] == pytest.approx(
        [one.excess(row) for row in one.backends], abs=1e-12
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "--seeds"),
        (["--backend", "nonsense"], "nonsense"),
        (["--steps", "0"], "--steps"),
        (["--method", "heun"], "heun"),
    ],
)
def test_bad_options_are_told_in_a_line(arguments, words):
    answer = subprocess.run(
        [sys.executable, "-c", "from qpmhe.cli import main; main()", "reproduce", *arguments],
        capture_output=True, text=True, check=False,
    )
    assert answer.returncode == 2
    assert words in answer.stderr
    assert "Traceback" not in answer.stderr


def test_compare_report_and_export_one_after_the_other(tmp_path: Path):
    pytest.importorskip("plotly")
    store, out = tmp_path / "new" / "store.sqlite", tmp_path / "report"
    table = tmp_path / "rows.csv"
    for arguments in (
        ["compare", "--backend", "banded", "--qps", "0,1", "--seeds", "2", "--steps", "12",
         "--jobs", "1", "--store", str(store), "--out", str(out)],
        ["report", str(store), "--out", str(out)],
        ["export", str(store), str(table)],
    ):
        answer = CliRunner().invoke(app, arguments)
        assert answer.exit_code == 0, answer.output
    assert (out / "index.html").is_file()
    assert len(table.read_text().splitlines()) == 1 + 2 * 2


def test_a_study_file_with_an_unknown_key_is_refused(tmp_path: Path):
    pytest.importorskip("joblib")
    study = tmp_path / "study.toml"
    study.write_text('backends = ["banded"]\nseed = 3\n')
    answer = CliRunner().invoke(app, ["study", str(study)])
    assert answer.exit_code != 0
    assert isinstance(answer.exception, QpmheError)
    assert "line 2" in str(answer.exception)
    assert "seeds" in str(answer.exception)
    assert list(tmp_path.iterdir()) == [study]


@pytest.mark.parametrize(("curvature", "code"), [(1.0, 0), (-1.0, 1)])
def test_solve_qp_tells_whether_it_was_solved(tmp_path: Path, curvature, code):
    qp = qpmhe.solvers.QP(2, 1)
    qp.band[:, :, 0], qp.gradient[...] = curvature, 1.0
    qpmhe.solvers.dump(qp, tmp_path / "one.npz")
    answer = CliRunner().invoke(
        app, ["solve-qp", str(tmp_path / "one.npz"), "--backend", "banded"]
    )
    assert answer.exit_code == code, answer.output
    assert "banded" in answer.output
