"""Columns of the set around the observer and of the estimate's bound."""

import csv
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import qpmhe
from qpmhe.certificates import NotCertifiedError
from qpmhe.cli.estimate import estimate
from qpmhe.errors import OptionError
from qpmhe.records import CheckpointError, RecordError, estimate_record
from qpmhe.records.bounds import BoundOptions
from qpmhe.records.checkpoints import load, save

MODEL = """
import numpy as np
import qpmhe

A = np.array([[0.9, 0.2], [-0.1, 0.7]])

def make(gain=0.4, scenario=True, states=True, inputs=False):
    X = qpmhe.Box([-10.0, -10.0], [10.0, 10.0]) if states else None
    if inputs:
        system = qpmhe.System(lambda x, u: x @ A.T + u, lambda x, u: x[..., :1], n=2, p=1, m=1)
    else:
        system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1, states=X)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=25.0)
    parts = system, qpmhe.Luenberger([[gain], [0.1]]), cost
    if not scenario:
        return *parts, {"horizon": 4, "initial_state": [0.0, 0.0]}
    return *parts, qpmhe.models.Scenario(
        system=system, initial_state=np.array([1.0, -1.0]), initial_estimate=np.zeros(2),
        disturbance_covariance=1e-3 * np.eye(2), noise_covariance=4e-3 * np.eye(1), dt=1.0,
        horizon=4, steps=60, labels=("a", "b"))
"""
OPTIONS = {"step_time": False, "checkpoint_every": 10, "checkpoint_seconds": 0.0}


@pytest.fixture
def made(tmp_path, monkeypatch):
    """The model, and a record of it whose noises are as small as stated; its states."""
    monkeypatch.chdir(tmp_path)
    Path("two.py").write_text(MODEL)
    rng, x, ys = np.random.default_rng(0), [np.array([1.0, -1.0])], []
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    for _ in range(60):
        ys.append(x[-1][0] + rng.uniform(-0.18, 0.18))
        x.append(A @ x[-1] + rng.uniform(-0.09, 0.09, 2))
    write(ys)
    return np.array(x), ys


def write(ys, path="record.csv", times=None):
    times = range(len(ys)) if times is None else times
    lines = [f"{t},{y}" for t, y in zip(times, ys, strict=True)]
    Path(path).write_text("\n".join(["time,y", *lines, ""]))


def columns(path):
    with Path(path).open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]
            if name != "status"}


def inside(found, states):
    lower, upper, guess = (
        np.column_stack([found[f"{kind}_{name}"] for name in "ab"])
        for kind in ("lower_predicted", "upper_predicted", "predicted")
    )
    assert ((lower <= states[1:]) & (states[1:] <= upper)).all()
    assert (np.linalg.norm(states[1:] - guess, axis=1) <= found["bound_predicted"]).all()
    return upper - lower


def test_the_truth_is_in_the_columns(made):
    states, _ = made
    warned = []
    summary = estimate_record("two.py:make", "record.csv", "out.csv", bound=True,
                              report=warned.append, **OPTIONS)
    wide = inside(columns("out.csv"), states)
    note = next(each for each in summary.notes if "z1" in each)
    assert "(proved while x stays in the region)" in note
    assert "three standard deviations of the model's scenario" in note
    assert warned == []
    given = BoundOptions(
        qpmhe.Box([-9.0, -9.0], [9.0, 9.0]), None, [1.0, 1.0], [0.09, 0.09], 0.18
    )
    estimate_record("two.py:make", "record.csv", "own.csv", bound=given, **OPTIONS)
    narrow = inside(columns("own.csv"), states)
    assert narrow[0].max() < wide[0].max() + 2.0  # of the same size
    assert not np.array_equal(narrow, wide)


def test_without_the_option_there_are_no_such_columns(made):
    estimate_record("two.py:make", "record.csv", "out.csv", **OPTIONS)
    assert "bound" not in Path("out.csv").read_text().splitlines()[0]


@pytest.mark.parametrize("what", ["missing", "gap"])
def test_what_ends_it_is_reported_once_and_leaves_blanks(made, what):
    _, ys = made
    times = list(range(60))
    if what == "missing":
        ys[20] = ""
    else:
        times[20:] = range(21, 61)
    write(ys, times=times)
    warned = []
    summary = estimate_record("two.py:make", "record.csv", "out.csv", bound=True,
                              report=warned.append, **OPTIONS)
    found = columns("out.csv")
    for name in ("bound_predicted", "lower_predicted_a", "upper_predicted_b"):
        assert np.isfinite(found[name][:20]).all()
        assert np.isnan(found[name][20:]).all()
    assert np.isfinite(found["predicted_a"]).all()
    (only,) = warned
    assert "a measurement was missing" in only
    assert "ends at the sample of time" in only
    assert "it ended: a measurement was missing" in summary.notes[-1]


def test_a_run_that_resumes_writes_the_same_bytes(made):
    estimate_record("two.py:make", "record.csv", "whole.csv", bound=True, **OPTIONS)
    text = Path("record.csv").read_text().splitlines(keepends=True)
    Path("record.csv").write_text("".join([*text[:38], "x\n"]))
    with pytest.raises(RecordError):
        estimate_record("two.py:make", "record.csv", "out.csv", bound=True, **OPTIONS)
    Path("record.csv").write_text("".join(text))
    with pytest.raises(CheckpointError, match="bound"):
        estimate_record("two.py:make", "record.csv", "out.csv", resume=True, bound=BoundOptions(
            initial_error=3.0), **OPTIONS)
    estimate_record("two.py:make", "record.csv", "out.csv", bound=True, resume=True, **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_another_norm_than_before_widens_the_bound_and_no_more(made):
    states, _ = made
    text = Path("record.csv").read_text().splitlines(keepends=True)
    Path("record.csv").write_text("".join([*text[:38], "x\n"]))
    with pytest.raises(RecordError):
        estimate_record("two.py:make", "record.csv", "out.csv", bound=True, **OPTIONS)
    Path("record.csv").write_text("".join(text))
    path = Path("out.csv.checkpoint")
    checkpoint = load(path)
    P, P_other = checkpoint.bound["metric"], np.diag([2.0, 0.5]) @ checkpoint.bound["metric"]
    other = 0.5 * (P_other + P_other.T)
    # The same set, or a larger one, in another norm.
    factor = np.sqrt(np.linalg.eigvals(np.linalg.solve(P, other)).real.max())
    checkpoint.bound.update(metric=other, radius=factor * checkpoint.bound["radius"])
    save(path, checkpoint)
    estimate_record("two.py:make", "record.csv", "out.csv", bound=True, resume=True, **OPTIONS)
    estimate_record("two.py:make", "record.csv", "whole.csv", bound=True, **OPTIONS)
    found, expected = columns("out.csv"), columns("whole.csv")
    inside(found, states)
    assert (found["bound_predicted"] >= expected["bound_predicted"] * (1.0 - 1e-9)).all()
    assert found["bound_predicted"][-1] == pytest.approx(expected["bound_predicted"][-1], rel=0.05)


@pytest.mark.parametrize(
    ("model", "options", "error", "words"),
    [
        ("(gain=-2.0)", {}, NotCertifiedError, "does not contract"),
        ("(scenario=False)", {}, OptionError, "--initial-error is missing"),
        ("(scenario=False,states=False)", {}, OptionError, "--bound-box is missing"),
        ("", {"initial_error": [1.0, 2.0, 3.0]}, OptionError, "--initial-error is"),
        ("", {"max_noise": -1.0}, OptionError, "--max-noise is -1.0"),
        ("", {"max_disturbance": [0.1, np.nan]}, OptionError, "--max-disturbance is"),
    ],
)
def test_what_cannot_be_bounded_is_said_before_any_row(made, model, options, error, words):
    with pytest.raises(error, match=words):
        estimate_record(f"two.py:make{model}", "record.csv", "out.csv",
                        bound=BoundOptions(**options), **OPTIONS)
    assert not Path("out.csv").exists()


def test_a_model_without_a_scenario_takes_options_and_weights(made):
    estimate_record("two.py:make(scenario=False)", "record.csv", "out.csv",
                    bound=BoundOptions(initial_error=2.0), **OPTIONS)
    assert np.isfinite(columns("out.csv")["bound_predicted"]).all()


def test_the_command_takes_the_options(made):
    app = typer.Typer()
    app.command()(estimate)

    def call(*arguments):
        return CliRunner().invoke(app, ["two.py:make", "record.csv", *arguments])

    done = call("--out", "out.csv", "--bound", "--initial-error", "1,1", "--max-noise", "0.18",
                "--max-disturbance", "0.09,0.09", "--bound-box", "-9:9,-9:9")
    assert done.exit_code == 0, done.output
    inside(columns("out.csv"), made[0])
    assert "|x1 - z1| <= " in " ".join(done.stderr.split())
    assert call("--out", "implied.csv", "--max-noise", "0.18").exit_code == 0
    assert "bound_predicted" in Path("implied.csv").read_text().splitlines()[0]
    for arguments, words in (
        (("--bound-box", "1,2"), "--bound-box is '1,2'"),
        (("--initial-error", "a"), "--initial-error is 'a'"),
    ):
        done = call("--out", "bad.csv", "--bound", *arguments)
        assert isinstance(done.exception, OptionError)
        assert words in str(done.exception)
