"""``qpmhe certify``: tables, JSON, the picture, and what it says where nothing is certified."""

import io
import json
import math
import re

import pytest
from rich.console import Console

import qpmhe
from qpmhe.certificates import certificate as certification
from qpmhe.certificates import certify_model
from qpmhe.certificates.evidence import NotCertifiedError
from qpmhe.cli.certify import certify
from qpmhe.errors import InvalidInputError, ModelError, OptionError, QpmheError, SetError
from qpmhe.models.loading import find, load

MODEL = '''
import numpy as np
import qpmhe

def raising(x):
    if x[0] > 1.5:
        raise ValueError("no way")
    return 0.5 * x

def model(gain=0.4, growth=0.7, discount=1.0, room=None, broken=False, meant=None):
    A = np.array([0.9, growth])
    B = np.array([[0.9, 0.2], [-0.1, 0.7]])
    system = qpmhe.System(
        raising if broken else lambda x: x @ B.T if growth < 1 else x * A,
        lambda x: x[..., :1], n=2, p=1,
        disturbances=None if room is None else qpmhe.Box([-room] * 2, [room] * 2))
    scenario = qpmhe.models.Scenario(
        system=system, initial_state=np.array([1.0, 0.5]), initial_estimate=np.zeros(2),
        disturbance_covariance=1e-4 * np.eye(2), noise_covariance=1e-2 * np.eye(1), dt=1.0,
        horizon=3, steps=20, labels=("a", "b"), title="Two [bold] states",
        region=None if meant is None else qpmhe.Box([-meant] * 2, [meant] * 2))
    cost = qpmhe.QuadraticCost(
        prior=np.eye(2), disturbance=1e4 * np.eye(2), noise=100.0, discount=discount)
    return system, qpmhe.Luenberger([[gain], [0.1]]), cost, scenario
'''


@pytest.fixture
def shown(tmp_path):
    """Calls the command on the model above, and gives what it returned and printed."""
    (tmp_path / "two.py").write_text(MODEL)

    def call(arguments="", width=200, details=True, **options):
        text = io.StringIO()
        console = Console(file=text, width=width, color_system=None)
        model = f"{tmp_path}/two.py:model{arguments}"
        done = certify(console, model, details=details, **options)
        return done, text.getvalue()

    return call


def test_the_first_line_is_the_observers_bound_in_the_states_units(shown):
    done, text = shown(box="-2:2,-2:2", details=False)
    assert done
    first, *rest = text.splitlines()
    assert re.fullmatch(
        r"\|x1 - z1\| <= [\d.]+, \|x2 - z2\| <= [\d.]+ after \d+ samples "
        r"\(proved( while x stays in the region)?\), "
        r"on a region 4 x 4 wide", first,
    )
    assert "Assumptions" not in text
    assert len(rest) < 10
    for words in (
        "|w1| <= 0.03, |w2| <= 0.03, |v| <= 0.3 (three standard deviations of the model's",
        "stays in the region", "the bound holds at all 20 samples", "--details",
    ):
        assert words in text, words


def test_a_cost_without_constants_leaves_the_observers_bound(shown):
    done, text = shown("(discount=0.9)", details=False)
    assert done
    assert text.startswith("|x1 - z1| <= ")
    assert "Not certified: the theorem: the cost has no constants: the discount" in text


def test_a_model_of_the_users_is_certified(shown, tmp_path):
    report = tmp_path / "out" / "two.json"
    done, text = shown(horizon="2,3", report=report, box="-2:2,-2:2")
    assert done
    for words in (
        "x1 in [-2, 2]", "proved", "(eq:kappa)", "e-IOSS", "by the paper's constants",
        "The certificate applied at 20 of 20 samples", "Assumed:",
    ):
        assert words in text, words
    content = json.loads(report.read_text())
    assert content["certified"] is True
    assert [each["horizon"] for each in content["paper"]] == [2, 3]
    assert content["region"]["lower"] == [-2.0, -2.0]
    assert content["monitor"] == (
        "The observer's bound held at all 20 samples. The certificate applied at 20 of 20 samples."
    )
    for suffix in (".png", ".svg"):
        assert report.with_suffix(suffix).stat().st_size > 1000
    # What the terminal shows is what the file has.
    row = next(line for line in text.splitlines() if "N = 3 (eq:RGES_result)" in line)
    numbers = [float(each) for each in re.findall(r" ([\d.]+(?:e\+\d+)?)(?:,|$)", row.rstrip())]
    paper = content["paper"][1]
    assert numbers == pytest.approx([*paper["C"], paper["lambda"]], rel=1e-3)


def test_without_a_box_the_record_gives_one(shown):
    done, text = shown()
    assert done
    low, high = map(float, re.search(r"x1 in \[([-\d.]+), ([-\d.]+)\]", text).groups())
    assert low < 0.0 < 1.0 < high


def test_an_unstable_observer_is_named_and_another_one_is_made(shown, tmp_path):
    report = tmp_path / "other.json"
    done, text = shown("(gain=-2.0)", box="-2:2,-2:2", report=report)
    assert done
    assert "e-IOSS" in text
    done, stated = shown("(gain=-2.0,meant=2.0)")  # the model states its region
    assert done
    assert stated.splitlines()[0] == text.splitlines()[0]
    assert text.startswith("With a gain made for the region: |x1 - z1| <= ")
    words = " ".join(text.split())
    assert "in place of the model's own: the observer's error does not contract" in words
    content = json.loads(report.read_text())
    assert content["certified"] is True
    assert content["replaced"].startswith("Luenberger([[")
    assert content["observer"]["gain"] != [[-2.0], [0.1]]


def test_an_undetectable_mode_is_named_and_nothing_is_drawn(shown, tmp_path):
    report = tmp_path / "failed.json"
    done, text = shown("(growth=1.1)", report=report, box="-2:2,-2:2")
    assert not done
    assert text.startswith("No bound of the observer's error is proved.")
    for words in ("Not certified", "eigenvalue 1.1", "What may help", "another gain"):
        assert words in text, words
    assert "candidate, at each step and with any solver" in " ".join(text.split())
    content = json.loads(report.read_text())
    assert content["certified"] is False
    assert len(content["failures"]) == 2
    assert not report.with_suffix(".png").exists()
    assert content["region"]["lower"] == [-2.0, -2.0]
    assert content["region"]["diameter"] == pytest.approx(32.0**0.5)
    assert content["detectability"] is None
    assert content["observer"] is None
    assert any("another gain" in each for each in content["suggestions"])
    assert content["smallest_rates"] == {"eta": None, "rho": None}
    report = certify_model(*load(find(f"{tmp_path}/two.py:model(growth=1.1)")))
    assert not report.certificate.holds
    assert report.certificate.stability is None
    assert list(report.certificate.errors) == ["the observer", "detectability"]
    with pytest.raises(InvalidInputError, match="no certificate"):
        report.draw()


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


def test_files_and_models_that_will_not_do_are_named(shown, tmp_path):
    with pytest.raises(QpmheError, match="nonsense"):
        certify(Console(file=io.StringIO()), "nonsense")
    (tmp_path / "file").write_text("")
    with pytest.raises(QpmheError, match="cannot make the folder"):
        shown("(gain=-2.0)", report=tmp_path / "file" / "x.json")
    for name in ("x.txt", "x"):
        with pytest.raises(OptionError, match=r"--report is .*x.*\.json"):
            shown(report=tmp_path / name)
    assert list(tmp_path.glob("x*")) == []
    with pytest.raises(ModelError, match=r"no way.*smaller region"):
        shown("(broken=True)", box="-2:2,-2:2")


def test_figures_are_never_cut_at_80_columns(shown, tmp_path):
    report = tmp_path / "wide.json"
    done, text = shown(width=80, horizon="1,10,100", report=report, box="-2:2,-2:2")
    assert done
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= max(80, 7 + len(str(report)))
    content = json.loads(report.read_text())
    for each in content["paper"]:
        for value in (*each["C"], each["lambda"], each["limit"]):
            assert re.search(rf" {re.escape(f'{value:.4g}')}[ ,\n]", text), (each["horizon"], value)


def test_an_estimator_is_certified_as_well(shown, tmp_path):
    (tmp_path / "made.py").write_text(MODEL + """
def estimator(states=True):
    system, observer, cost, scenario = model()
    if states:
        system = qpmhe.System(
            lambda x: 0.5 * x, lambda x: x[..., :1], n=2, p=1, states=qpmhe.Box([-1] * 2, [1] * 2))
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=7, initial_state=[0.0, 0.0])

def parts():
    return model()[:3]
""")
    console = Console(file=io.StringIO(), width=200, color_system=None)
    report = tmp_path / "made.json"
    assert certify(console, f"{tmp_path}/made.py:estimator", report=report)
    text = console.file.getvalue()
    assert text.startswith("|x1 - z1| <= ")
    assert "three standard deviations of the cost's inverse weights" in text
    content = json.loads(report.read_text())
    assert [each["horizon"] for each in content["paper"]] == [7]
    assert content["monitored"] is None
    assert not report.with_suffix(".png").exists()
    with pytest.raises(OptionError, match="the set in which the states stay"):
        certify(console, f"{tmp_path}/made.py:estimator(states=False)")
    assert certify(console, f"{tmp_path}/made.py:parts", "-1:1,-1:1", "3")
    with pytest.raises(OptionError, match="does not give its horizon; give --horizon"):
        certify(console, f"{tmp_path}/made.py:parts", "-1:1,-1:1")


def test_smallest_feasible_rate_is_told_to_machines(shown, monkeypatch, tmp_path):
    def refused(*_, **__):
        raise NotCertifiedError("no", ("a larger eta",), 0.73)

    monkeypatch.setattr(certification, "certify_detectability", refused)
    report = tmp_path / "failed.json"
    assert shown(report=report, box="-2:2,-2:2")[0]  # the observer's bound needs none
    content = json.loads(report.read_text())
    assert content["smallest_rates"] == {"eta": 0.73, "rho": None}
    assert content["suggestions"] == ["a larger eta"]
    assert content["observer"]["rho"] < 1.0


def test_one_call_does_what_the_command_does(shown, tmp_path):
    path = tmp_path / "command.json"
    done, _ = shown(horizon="2", box="-2:2,-2:2", report=path, seconds=math.inf, details=False)
    model = f"{tmp_path}/two.py:model"
    region = qpmhe.Box([-2.0, -2.0], [2.0, 2.0])
    report = certify_model(
        *load(find(model)), horizon=2, region=region, seconds=math.inf, name=model
    )
    assert done
    assert report.certificate.failures == []
    written = report.save(tmp_path / "call.json")
    assert [each.name for each in written] == ["call.png", "call.svg", "call.json"]
    assert json.loads(written[-1].read_text()) == json.loads(path.read_text())
