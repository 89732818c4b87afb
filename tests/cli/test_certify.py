"""``qpmhe certify``: tables, JSON, what it says where nothing is certified, and the zoo."""

import io
import json
import re

import numpy as np
import pytest
from rich.console import Console

import qpmhe
from qpmhe import certificates
from qpmhe.certificates.evidence import at_most
from qpmhe.cli.certify import certify
from qpmhe.errors import OptionError, QpmheError
from tests.certificates.helpers import box

MODEL = '''
import numpy as np
import qpmhe

def model(gain=0.4, growth=0.7, coupling=0.2, discount=1.0):
    A = np.array([[0.9, coupling], [-0.5 * coupling, growth]])
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    scenario = qpmhe.models.Scenario(
        system=system, initial_state=np.array([1.0, 0.5]), initial_estimate=np.zeros(2), dt=1.0,
        disturbance_covariance=1e-4 * np.eye(2), noise_covariance=1e-2 * np.eye(1), horizon=3,
        steps=20, labels=("a", "b"), title="Two [bold] states")
    cost = qpmhe.QuadraticCost(
        prior=np.eye(2), disturbance=1e4 * np.eye(2), noise=100.0, discount=discount)
    return system, qpmhe.Luenberger([[gain], [0.1]]), cost, scenario

def estimator(bounded=True):
    states = qpmhe.Box([-1] * 2, [1] * 2) if bounded else None
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: x[..., :1], n=2, p=1, states=states)
    return qpmhe.MovingHorizonEstimator(
        system, *model()[1:3], horizon=7, initial_state=[0.0, 0.0])

def parts():
    return model()[:3]

def restarts():
    return qpmhe.MovingHorizonEstimator(
        *model()[:3], horizon=7, initial_state=[0.0, 0.0], restart=True)
'''
SQUARE = "-2:2,-2:2"


@pytest.fixture
def shown(tmp_path):
    """Calls the command on the model above; what it returned, printed and reported."""
    (tmp_path / "two.py").write_text(MODEL)
    report = tmp_path / "out" / "two.json"

    def call(arguments="", width=300, of="model", **options):
        console = Console(file=io.StringIO(), width=width, color_system=None)
        options = {"report": report} | options
        done = certify(console, f"{tmp_path}/two.py:{of}{arguments}", **options)
        return done, console.file.getvalue(), json.loads(report.read_text())

    return call


def test_the_first_line_is_the_observers_bound_in_the_states_units(shown):
    _, text, _ = shown(box=SQUARE)
    first, *rest = text.splitlines()
    assert re.fullmatch(
        r"\|x1 - z1\| <= [\d.]+, \|x2 - z2\| <= [\d.]+ in the limit "
        r"and at most 10 % more from sample \d+ on "
        r"\(proved for the traced model, which agreed with f at \d+ points"
        r"(, while x stays in the region)?\), on a region 4 x 4 wide; "
        r"x_hat is within \|x_hat - z\| \+ b along a run", first,
    )
    assert len(rest) < 11
    for words in (
        "Two [bold] states", "x1 in [-2, 2]", "z is checked at each sample", "--details",
        "|w1| <= 0.03, |w2| <= 0.03, |v| <= 0.3 (three standard deviations of the model's",
        "by the paper's constants",
    ):
        assert words in text, words
    _, text, _ = shown("(discount=0.9)")  # the box is made around the record
    low, high = map(float, re.search(r"x1 in \[([-\d.]+), ([-\d.]+)\]", text).groups())
    assert low < 0.0 < 1.0 < high
    assert "Not certified: the theorem: the cost has no constants: the discount" in text


def test_the_report_holds_what_the_terminal_shows(shown):
    done, text, content = shown(width=80, horizon="1,10,100", box=SQUARE, details=True)
    assert done
    assert "…" not in text
    assert max(map(len, text.splitlines()[:-1])) <= 80
    assert (content["certified"], content["failures"]) == (True, [])
    assert content["region"]["lower"] == [-2.0, -2.0]
    assert content["simulated"].endswith("the bound holds at all 20 samples")
    for each in content["paper"]:
        for value in (*each["C"], each["lam"], each["limit"]):
            shown = re.escape(at_most(value, 4))
            assert re.search(rf" {shown}[ ,\n]", text), (each["horizon"], value)


def test_an_unstable_observer_is_replaced_and_an_undetectable_mode_is_named(shown):
    done, text, content = shown("(gain=-2.0)", box=SQUARE)
    assert done
    assert text.startswith("With a gain made for the region: |x1 - z1| <= ")
    words = "in place of the model's own: the observer's error does not contract"
    assert words in " ".join(text.split())
    assert content["replaced"].startswith("Luenberger([[")
    assert content["observer"]["gain"] != [[-2.0], [0.1]]
    done, text, content = shown("(growth=1.1,coupling=0.0)", box=SQUARE, details=True)
    assert not done
    assert text.startswith("No bound on the observer's error is proved.")
    for words in ("Not certified", "eigenvalue 1.1", "What may help", "another gain"):
        assert words in text, words
    assert (content["certified"], len(content["failures"])) == (False, 2)
    assert (content["detectability"], content["observer"]) == (None, None)


def test_an_estimator_and_parts_are_certified_as_well(shown):
    _, text, content = shown(of="estimator")
    assert "three standard deviations of the cost's inverse weights" in text
    assert [each["horizon"] for each in content["paper"]] == [7]
    assert shown(of="parts", box=SQUARE, horizon="3")[0]


def test_bad_options_files_and_models_are_named(shown, tmp_path):
    (tmp_path / "file").write_text("")
    for arguments, options, error, words in (
        ("", {"box": "-1:1"}, OptionError, "--box"),
        ("", {"horizon": "two"}, OptionError, "--horizon"),
        ("", {"input_box": "0:1"}, OptionError, "--input-box"),
        ("", {"report": tmp_path / "x.txt"}, OptionError, r"--report is .*x.*\.json"),
        ("", {"report": tmp_path / "file" / "x.json"}, QpmheError, "cannot make the folder"),
        ("(bounded=False)", {"of": "estimator"}, OptionError, "the set in which the states stay"),
        ("", {"of": "parts", "box": SQUARE}, OptionError, "does not give its horizon; give --hor"),
        ("", {"of": "nonsense"}, QpmheError, "nonsense"),
    ):
        with pytest.raises(error, match=words):
            shown(arguments, **options)
    assert list(tmp_path.glob("x*")) == []


# Models of the zoo with a stated region: the own observer of these has a bound within it.
OWN = {"batch_reactor", "battery_cell", "pendulum"}
STATED = OWN | {"van_der_pol", "cstr", "vehicle"}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(STATED))
def test_a_model_with_a_stated_region_has_a_bound_that_is_smaller(name, tmp_path):
    report, n = tmp_path / "it.json", qpmhe.models.catalogue()[name]().system.n
    assert certify(Console(file=io.StringIO()), name, report=report, seconds=300.0)
    content = json.loads(report.read_text())
    assert (content["replaced"] == "") is (name in OWN)
    assert content["observer_bound"]["evidence"] == "proved"
    width = np.subtract(content["region"]["upper"], content["region"]["lower"])[:n]
    assert (content["observer_bound"]["components"] < width).all()


def test_angles_are_certified_where_they_do_not_wrap():
    angle = {"n": 1, "p": 1, "output_residual": qpmhe.angles([0])}
    system = qpmhe.System(lambda x: 0.5 * x, lambda x: x, **angle)
    observer, place = qpmhe.Luenberger([[0.1]]), box(-1.0, 1.0)
    found = certificates.certify_observer(system, observer, place, sizes=(0.1, 1.0))
    assert found.evidence is certificates.Evidence.PROVED
    assert any("y[0] is less than 1.141" in note for note in found.notes)  # pi - 2
    with pytest.raises(certificates.NotCertifiedError, match=r"angle y\[0\] may wrap"):
        certificates.certify_observer(system, observer, place, sizes=(0.1, 1.2))
    with pytest.raises(certificates.CertificateError, match="the system has angles"):
        certificates.certify_detectability(system, place)


@pytest.mark.slow
def test_a_guard_is_tried_on_the_record_or_refused_by_name(shown):
    """With the stated sizes, which the noises of the record need not keep to."""
    stated = {"box": SQUARE, "guard": True, "max_noise": "0.4"}
    done, text, content = shown(max_disturbance="0.05,0.04", **stated)
    assert done
    assert "|w1| <= 0.05, |w2| <= 0.04, |v| <= 0.4 (as stated)" in text
    assert "guarded, x_hat is within min(2 b, |x_hat - z| + b)" in text.splitlines()[0]
    assert re.search(r"guard +seed 0: \d+ of 20 estimates were moved; the largest", text)
    assert content["guard"].startswith("seed 0: ")
    done, text, _ = shown(of="parts", max_disturbance="0.05,0.04", horizon="3", **stated)
    assert done  # and no warning of a start outside of a set
    assert re.search(r"guard +there is one; it was not tried, as there is no record", text)
    for of, options, words in (
        ("model", {}, "the sizes are as stated and three standard deviations of the model's "
         "scenario, and Gaussian noises are not bounded"),
        ("restarts", {"max_disturbance": "0.05"}, "restart=True restarts the observer"),
    ):
        done, text, content = shown(of=of, **stated | options)
        assert not done
        assert content["certified"]
        assert f"There is no guard: {words}" in text
        assert content["guard"].startswith("there is no guard: ")


def test_out_writes_the_bound_for_load(shown, tmp_path):
    file = tmp_path / "kept" / "two.json"
    done, text, _ = shown(box=SQUARE, out=file)
    assert done
    assert f"wrote {file}" in text
    system, observer = find_parts(tmp_path)
    found = certificates.load(file, system, observer)
    assert text.splitlines()[0] == found.headline
    with pytest.raises(OptionError, match=r"--out is .*json"):
        shown(box=SQUARE, out=tmp_path / "two.toml")


def find_parts(folder):
    namespace = {}
    exec(compile((folder / "two.py").read_text(), "two.py", "exec"), namespace)
    return namespace["model"]()[:2]
