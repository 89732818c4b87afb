"""Columns of the set around the observer and of the estimate's bound."""

import csv
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import NotCertifiedError
from qpmhe.errors import OptionError
from qpmhe.records import CheckpointError
from qpmhe.records.bounds import BoundOptions

from .tools import command, cut_off, estimate, get, put

MODEL = """
import numpy as np
import qpmhe

A = np.array([[0.9, 0.2], [-0.1, 0.7]])

def make(gain=0.4, scenario=True):
    X = qpmhe.Box([-10.0, -10.0], [10.0, 10.0]) if scenario else None
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
OPTIONS = {"checkpoint_every": 10, "checkpoint_seconds": 0.0, "bound": True}


def bounded(model="two.py:make", **options):
    return estimate(model, **OPTIONS | options)


@pytest.fixture
def made(here):
    """The model, and a record of it whose noises are as small as stated: states and lines."""
    Path("two.py").write_text(MODEL)
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    rng, x, text = np.random.default_rng(0), [np.array([1.0, -1.0])], ["time,y"]
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


def width(path, states):
    """Of the set, which holds the truth."""
    found = columns(path)
    lower, upper, guess = (
        np.column_stack([found[f"{kind}_{name}"] for name in "ab"])
        for kind in ("lower_predicted", "upper_predicted", "predicted")
    )
    assert ((lower <= states[1:]) & (states[1:] <= upper)).all()
    assert (np.linalg.norm(states[1:] - guess, axis=1) <= found["bound_predicted"]).all()
    return upper - lower


def test_the_truth_is_in_the_columns_with_sizes_of_the_scenario_or_of_options(made):
    warned = []
    summary = bounded(report=warned.append)
    wide = width("out.csv", made[0])
    note = next(each for each in summary.notes if "z1" in each)
    assert "while x stays in the region)" in note
    assert "three standard deviations of the model's scenario" in note
    assert warned == []
    box = qpmhe.Box([-9.0, -9.0], [9.0, 9.0])
    bounded(out="own.csv", bound=BoundOptions(box, None, [1.0, 1.0], [0.09, 0.09], 0.18))
    narrow = width("own.csv", made[0])
    assert narrow[0].max() < wide[0].max() + 2.0  # of the same size
    assert not np.array_equal(narrow, wide)
    done = command("two.py:make", "record.csv", "--out", "told.csv", "--no-step-time",
                   "--initial-error", "1,1", "--max-noise", "0.18", "--max-disturbance",
                   "0.09,0.09", "--bound-box", "-9:9,-9:9")
    assert "|x1 - z1| <= " in " ".join(done.stderr.split())
    assert get("told.csv") == get("own.csv")


def test_what_ends_it_is_reported_once_leaves_blanks_and_resumes_with_the_same_bytes(made):
    _, text = made
    text[41] = "40,"
    put("record.csv", text)
    warned = []
    summary = bounded(report=warned.append)
    found, whole = columns("out.csv"), get("out.csv")
    for name in ("bound_predicted", "lower_predicted_a", "upper_predicted_b"):
        assert np.isfinite(found[name]).tolist() == [True] * 40 + [False] * 20
    assert np.isfinite(found["predicted_a"]).all()
    (only,) = warned
    assert "a measurement was missing" in only
    assert "ends at the sample of time" in only
    assert "it ended: a measurement was missing" in summary.notes[-1]
    cut_off(text, 38, "two.py:make", **OPTIONS)
    with pytest.raises(CheckpointError, match="bound"):
        bounded(resume=True, bound=BoundOptions(initial_error=3.0))
    bounded(resume=True)
    assert get("out.csv") == whole


def test_what_cannot_be_bounded_is_said_before_any_row(made):
    for model, options, error, words in (
        ("(gain=-2.0)", {}, NotCertifiedError, "does not contract"),
        ("(scenario=False)", {}, OptionError, "--bound-box is missing"),
        ("", {"initial_error": [1.0, 2.0, 3.0]}, OptionError, "--initial-error is"),
        ("", {"max_noise": -1.0}, OptionError, "--max-noise is -1.0"),
    ):
        with pytest.raises(error, match=words):
            bounded(f"two.py:make{model}", bound=BoundOptions(**options))
    for option, value in (("--bound-box", "1,2"), ("--initial-error", "a")):
        done = command("two.py:make", "record.csv", "--out", "out.csv", "--bound", option, value)
        assert isinstance(done.exception, OptionError)
        assert f"{option} is {value!r}" in str(done.exception)
    assert not Path("out.csv").exists()


def test_sizes_are_of_w_where_a_matrix_takes_it(made):
    text = made[1]
    Path("two.py").write_text(
        MODEL.replace("states=X)", "states=X, disturbance_matrix=[[3.0], [-2.0]])")
        .replace("100.0 * np.eye(2)", "[[100.0]]").replace("1e-3 * np.eye(2)", "1e-4 * np.eye(1)")
    )
    A, G = np.array([[0.9, 0.2], [-0.1, 0.7]]), np.array([3.0, -2.0])
    rng, x, rows = np.random.default_rng(1), [np.array([1.0, -1.0])], [text[0]]
    for t in range(60):
        rows.append(f"{t},{x[-1][0] + rng.uniform(-0.18, 0.18)}")
        x.append(A @ x[-1] + 0.02 * G * rng.choice([-1.0, 1.0]))
    put("record.csv", rows)
    # Three standard deviations of the scenario's w, 0.03, or what is stated.
    bounded()
    usual = width("out.csv", np.array(x))[-1]
    for given in (0.02, [0.02]):
        bounded(
            resume=False, overwrite=True,
            bound=BoundOptions(initial_error=[1.0, 1.0], max_disturbance=given),
        )
        assert (width("out.csv", np.array(x))[-1] < usual).all()
    with pytest.raises(OptionError, match=r"--max-disturbance is .*, or 1, one for each component"):
        bounded(
            overwrite=True, bound=BoundOptions(initial_error=1.0, max_disturbance=[0.06, 0.04])
        )
