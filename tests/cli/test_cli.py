"""Commands from end to end; those with a room of their own are tested beside it."""

import csv
import sys
import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app, main
from qpmhe.errors import QpmheError


def invoke(*arguments, code=0):
    answer = CliRunner().invoke(app, [str(one) for one in arguments])
    assert answer.exit_code == code, answer.output
    return answer.output


def test_version_and_solvers():
    assert qpmhe.__version__ in invoke("--version")
    output = invoke("solvers")
    assert all(entry.name in output for entry in qpmhe.solvers.backends())


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_reproduce_writes_what_it_says(tmp_path, method):
    pytest.importorskip("casadi")
    options = "--steps", 12, "--seed", 3, "--ipopt", "--method", method
    invoke("reproduce", *options, "--out", tmp_path)
    for name in ("reproduce.png", "reproduce.svg", "reproduce.csv"):
        assert (tmp_path / name).stat().st_size > 1000
    system, observer, cost, scenario = qpmhe.models.batch_reactor(method)
    states, measurements = scenario.simulate(3, 12)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=[3, 0], max_qps=2
    )
    run, rows = mhe.run(measurements), table(tmp_path / "reproduce.csv")
    assert [float(row["real_x1"]) for row in rows] == states[:, 0].tolist()
    assert [float(row["i_is_2_x2"]) for row in rows] == run.states[:, 1].tolist()
    assert {row["backend"] for row in table(tmp_path / "reproduce_backends.csv")} == {
        name for name in qpmhe.solvers.available() if name != "auto" and ":" not in name
    }
    # Ipopt and the QPs come to the same minimum of the same problem.
    rows = table(tmp_path / "reproduce_summary.csv")
    summary = {row["run"]: float(row["mean_J"]) for row in rows}
    assert summary["Ipopt converged"] == pytest.approx(summary["converged"], rel=1e-6)


def test_reproduction_over_seeds_is_the_mean_of_single_ones(monkeypatch):
    # The backends are compared on one record: their rows are none of these.
    monkeypatch.setattr("qpmhe.studies.paper.available", lambda: ["banded"])
    options = {"steps": 6, "backend_name": "banded"}
    one, two = (qpmhe.studies.reproduce(seed=k, **options) for k in (4, 5))
    found = qpmhe.studies.reproduce(seed=4, seeds=2, **options)
    for row, *singles in zip(found.rows, one.rows, two.rows, strict=True):
        values = np.array([single.rmse for single in singles])
        assert row.rmse == pytest.approx(values.mean())
        half = 12.706204736432095 * values.std(ddof=1) / np.sqrt(2.0)  # Student's, 1 degree
        assert row.rmse_half == pytest.approx(half)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--seeds", "-3", "-3"), ("--measure", "tim", "'tim' is not one of"),
        ("--deadline", "soon", "soon"), ("--backend", "nonsense", "nonsense"),
        ("--noise-levels", "-1", "--noise-levels is -1.0; expected"),
        ("--start", "foo", "--start is 'foo'; expected"),
    ],
)
def test_a_bad_option_is_reported_in_a_line(option, value, words, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["qpmhe", "compare", option, value])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert option in error or value == "nonsense"
    for stray in ("Traceback", "Input should", "Value error"):
        assert stray not in error


_PUMPED = """
import warnings
import numpy as np
import qpmhe

def make():
    warnings.warn("of the model's own")
    def rate(x, u):
        return np.stack([u[..., 0] * (x[..., 1] - x[..., 0]), -0.1 * x[..., 1]], axis=-1)

    system = qpmhe.System.from_ode(rate, lambda x: x[..., 1:], dt=0.1, n=2, p=1, m=1)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(2), disturbance=1e-4 * np.eye(2), noise=[[0.01]])
    return system, qpmhe.Luenberger([0.0, 0.1]), cost, {"horizon": 5, "initial_state": [0.5, 1.0]}
"""


def test_our_warnings_are_one_line_and_those_of_others_have_their_place(
    tmp_path, monkeypatch, capsys
):
    """A step that the record's inputs make too long; and a record whose unit of time is another."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pumped.py").write_text(_PUMPED)
    rows = [f"{t},{0.9**t},40.0" for t in range(30)]  # steps of 10 usual ones
    (tmp_path / "record.csv").write_text("\n".join(["time,y,u", *rows]) + "\n")
    monkeypatch.setattr(
        sys, "argv", ["qpmhe", "estimate", "pumped.py:make", "record.csv", "--out", "out.csv"])
    before = warnings.showwarning
    with pytest.warns(UserWarning, match="own") as others, pytest.raises(SystemExit):
        main()
    assert warnings.showwarning is before
    printed = capsys.readouterr().err
    own = [line for line in printed.splitlines() if "is too long" in line]
    assert len(own) == 1
    assert own[0].startswith("warning: one step of rk4 in dt = 0.1 is too long")
    assert "with u = [40.]" in own[0]
    assert [str(one.message) for one in others] == ["of the model's own"]
    early = next(line for line in printed.splitlines() if "is about 10 of the usual" in line)
    assert early.startswith("warning: record.csv, line 22 (time 20): 180 samples were inserted")
    assert "--time-scale" in early
    assert printed.index(early) < printed.index("30 samples")


def test_compare_report_export_and_a_study_with_an_unknown_key(tmp_path):
    pytest.importorskip("jinja2")
    pytest.importorskip("joblib")
    store, out = tmp_path / "new" / "store.sqlite", tmp_path / "report"
    options = "--backend", "banded", "--qps", "0,1", "--seeds", 2, "--steps", 5, "--jobs", 1
    invoke("compare", *options, "--store", store, "--out", out)
    invoke("report", store, "--out", out)
    invoke("export", store, tmp_path / "rows.csv")
    assert (out / "index.html").is_file()
    assert len(table(tmp_path / "rows.csv")) == 2 * 2
    study = tmp_path / "study.toml"
    study.write_text('backends = ["banded"]\nseed = 3\n')
    answer = CliRunner().invoke(app, ["study", str(study)])
    assert isinstance(answer.exception, QpmheError)
    assert "line 2" in str(answer.exception)
    assert "seeds" in str(answer.exception)


def test_the_exit_code_of_solve_qp_says_whether_it_was_solved(tmp_path):
    for curvature, code in ((1.0, 0), (-1.0, 1)):
        qp = qpmhe.solvers.QP(2, 1)
        qp.band[:, :, 0], qp.gradient[...] = curvature, 1.0
        qpmhe.solvers.dump(qp, tmp_path / "one.npz")
        output = invoke("solve-qp", tmp_path / "one.npz", "--backend", "banded", code=code)
        assert "banded" in output
