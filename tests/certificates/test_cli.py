"""``qpmhe certify``: tables, JSON, the picture, and what it says where nothing is certified."""

import io
import json
import re

import pytest
from rich.console import Console

from qpmhe.cli.certify import certify
from qpmhe.errors import OptionError, QpmheError, SetError

MODEL = '''
import numpy as np
import qpmhe

def model(gain=0.4, growth=0.7, discount=1.0):
    A = np.array([0.9, growth])
    B = np.array([[0.9, 0.2], [-0.1, 0.7]])
    system = qpmhe.System(
        lambda x: x @ B.T if growth < 1 else x * A, lambda x: x[..., :1], n=2, p=1)
    scenario = qpmhe.models.Scenario(
        system=system, initial_state=np.array([1.0, 0.5]), initial_estimate=np.zeros(2),
        disturbance_covariance=1e-4 * np.eye(2), noise_covariance=1e-2 * np.eye(1), dt=1.0,
        horizon=3, steps=20, labels=("a", "b"), title="Two [bold] states")
    cost = qpmhe.QuadraticCost(
        prior=np.eye(2), disturbance=1e4 * np.eye(2), noise=100.0, discount=discount)
    return system, qpmhe.Luenberger([[gain], [0.1]]), cost, scenario
'''


@pytest.fixture
def shown(tmp_path):
    """Calls the command on the model above, and gives what it returned and printed."""
    (tmp_path / "two.py").write_text(MODEL)

    def call(arguments="", **options):
        text = io.StringIO()
        console = Console(file=text, width=200, color_system=None)
        done = certify(console, f"{tmp_path}/two.py:model{arguments}", **options)
        return done, text.getvalue()

    return call


def test_a_model_of_the_users_is_certified(shown, tmp_path):
    report = tmp_path / "out" / "two.json"
    done, text = shown(horizon="2,3", report=report, box="-2:2,-2:2")
    assert done
    for words in (
        "x1 in [-2, 2]", "proved", "(eq:kappa)", "e-IOSS", "theorem, paper's constants",
        "beyond: norms kept", "The certificate applied at 20 of 20 steps", "Assumed:",
    ):
        assert words in text, words
    told = json.loads(report.read_text())
    assert told["certified"] is True
    assert [each["horizon"] for each in told["horizons"]] == [2, 3]
    assert told["region"]["lower"] == [-2.0, -2.0]
    assert told["monitor"] == "The certificate applied at 20 of 20 steps."
    for suffix in (".png", ".svg"):
        assert report.with_suffix(suffix).stat().st_size > 1000
    # What the table tells is what the file tells.
    row = next(line for line in text.splitlines() if re.match(r"\W+3\W+theorem", line))
    shown_numbers = [float(each) for each in re.findall(r"[\d.]+(?:e\+\d+)?", row)[1:5]]
    paper = told["horizons"][1]["paper"]
    assert shown_numbers == pytest.approx([*paper["C"], paper["lambda"]], rel=1e-3)


def test_without_a_box_the_record_tells_one(shown):
    done, text = shown()
    assert done
    low, high = map(float, re.search(r"x1 in \[([-\d.]+), ([-\d.]+)\]", text).groups())
    assert low < 0.0 < 1.0 < high


def test_an_unstable_observer_is_named_and_the_rest_is_told(shown, tmp_path):
    report = tmp_path / "failed.json"
    done, text = shown("(gain=-2.0)", report=report)
    assert not done
    assert "Not certified" in text
    assert "the observer" in text
    assert "another gain" in text
    assert "e-IOSS" in text  # detectability does not depend on the observer
    assert "candidate, at each step and with any solver" in " ".join(text.split())
    told = json.loads(report.read_text())
    assert told["certified"] is False
    assert len(told["failures"]) == 1
    assert not report.with_suffix(".png").exists()


def test_an_undetectable_model_is_named_with_its_mode(shown):
    done, text = shown("(growth=1.1)")
    assert not done
    assert "eigenvalue 1.1" in text
    assert "What may help" in text
    assert "e-IOSS" not in text


def test_a_cost_without_constants_is_told(shown):
    done, text = shown("(discount=0.9)")
    assert not done
    assert "discount" in text


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"box": "-1:1"}, OptionError, "--box"),
        ({"box": "-1:1,a:b"}, OptionError, "--box"),
        ({"box": "-1:1,2:1"}, SetError, "empty"),
        ({"box": "-1:1,-inf:1"}, SetError, "unbounded"),
        ({"horizon": "0"}, OptionError, "--horizon"),
        ({"horizon": "two"}, OptionError, "--horizon"),
        ({"input_box": "0:1"}, OptionError, "--input-box"),
    ],
)
def test_bad_options_are_named(shown, options, error, words):
    with pytest.raises(error, match=words):
        shown(**options)


def test_a_model_that_is_not_known_is_named():
    with pytest.raises(QpmheError, match="nonsense"):
        certify(Console(file=io.StringIO()), "nonsense")


def test_a_report_that_cannot_be_written_is_told(shown, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(QpmheError, match="cannot write"):
        shown("(gain=-2.0)", report=tmp_path / "file" / "x.json")
