import csv
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app


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
    assert {row["backend"] for row in compared} == set(qpmhe.solvers.available()) - {"auto"}
    with (tmp_path / "reproduce_summary.csv").open() as file:
        summary = {row["run"]: row for row in csv.DictReader(file)}
    # Ipopt and the QPs come to the same minimum of the same problem.
    assert float(summary["Ipopt converged"]["mean_J"]) == pytest.approx(
        float(summary["converged"]["mean_J"]), rel=1e-6
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
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
