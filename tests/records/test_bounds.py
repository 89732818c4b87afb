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
from qpmhe.records import CheckpointError
from qpmhe.records.bounds import BoundOptions
from qpmhe.records.checkpoints import load, save

from .tools import cut_off, get, put
from .tools import estimate as by_hand

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
OPTIONS = {"checkpoint_every": 10, "checkpoint_seconds": 0.0}


def estimated(model="two.py:make", **options):
    return by_hand(model, **{"bound": True} | OPTIONS | options)


@pytest.fixture
def made(here):
    """The model, and a record of it whose noises are as small as stated: states and lines."""
    Path("two.py").write_text(MODEL)
    rng, x, text = np.random.default_rng(0), [np.array([1.0, -1.0])], ["time,y"]
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    for t in range(60):
        text.append(f"{t},{x[-1][0] + rng.uniform(-0.18, 0.18)}")
        x.append(A @ x[-1] + rng.uniform(-0.09, 0.09, 2))
    put("record.csv", text)
    return np.array(x), text


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
    summary = estimated(report=warned.append)
    wide = inside(columns("out.csv"), states)
    note = next(each for each in summary.notes if "z1" in each)
    assert "(proved while x stays in the region)" in note
    assert "three standard deviations of the model's scenario" in note
    assert warned == []
    given = BoundOptions(
        qpmhe.Box([-9.0, -9.0], [9.0, 9.0]), None, [1.0, 1.0], [0.09, 0.09], 0.18
    )
    estimated(out="own.csv", bound=given)
    narrow = inside(columns("own.csv"), states)
    assert narrow[0].max() < wide[0].max() + 2.0  # of the same size
    assert not np.array_equal(narrow, wide)
    by_hand("two.py:make", out="without.csv")
    assert b"bound" not in get("without.csv").splitlines()[0]


@pytest.mark.parametrize("what", ["missing", "gap"])
def test_what_ends_it_is_reported_once_and_leaves_blanks(made, what):
    _, text = made
    if what == "missing":
        text[21] = "20,"
    else:
        text[21:] = [f"{t + 1},{line.partition(',')[2]}" for t, line in enumerate(text[21:], 20)]
    put("record.csv", text)
    warned = []
    summary = estimated(report=warned.append)
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
    estimated(out="whole.csv")
    cut_off(made[1], 38, "two.py:make", bound=True, **OPTIONS)
    with pytest.raises(CheckpointError, match="bound"):
        estimated(resume=True, bound=BoundOptions(initial_error=3.0))
    estimated(resume=True)
    assert get("out.csv") == get("whole.csv")


def test_another_norm_than_before_widens_the_bound_and_no_more(made):
    cut_off(made[1], 38, "two.py:make", bound=True, **OPTIONS)
    path = Path("out.csv.checkpoint")
    checkpoint = load(path)
    P = checkpoint.bound["metric"]
    other = np.diag([2.0, 0.5]) @ P
    other = 0.5 * (other + other.T)
    # The same set, or a larger one, in another norm.
    factor = np.sqrt(np.linalg.eigvals(np.linalg.solve(P, other)).real.max())
    checkpoint.bound.update(metric=other, radius=factor * checkpoint.bound["radius"])
    save(path, checkpoint)
    estimated(resume=True)
    estimated(out="whole.csv")
    found, expected = columns("out.csv"), columns("whole.csv")
    inside(found, made[0])
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
        estimated(f"two.py:make{model}", bound=BoundOptions(**options))
    assert not Path("out.csv").exists()


def test_a_model_without_a_scenario_takes_options_and_weights(made):
    estimated("two.py:make(scenario=False)", bound=BoundOptions(initial_error=2.0))
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
