"""A user's model: what its function may return, where it does not fit, and failures on the way."""

import sys
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.models.loading import code_place as place
from qpmhe.records.record_model import load_record_model as load_model

from .tools import estimate, put, shell

BEGIN = """
import numpy as np, qpmhe
system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
observer = qpmhe.Luenberger([0.3])
cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
"""
PARTS = "return system, observer, cost"


@pytest.fixture
def make(here):
    numbers = iter(range(100))

    def write(function, begin=BEGIN):
        path = here / f"model{next(numbers)}.py"  # files are imported once
        path.write_text(f"{begin}\ndef make():\n    {function}\n")
        return f"{path.name}:make"

    return write


GIVEN = [
    f"{PARTS}, dict(horizon=4, initial_state=[2.0])",
    "return [system, observer, cost, dict(horizon=4, initial_state=2.0, dt=0.5, states='a')]",
    "return qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=4, initial_state=[2])",
    f"{PARTS}, qpmhe.models.Scenario(system=system, initial_state=[0.0],"
    " initial_estimate=[2.0], disturbance_covariance=1.0, noise_covariance=1.0, dt=0.5,"
    " horizon=4, steps=9, labels=('a',))",
]


def test_what_the_function_may_return(make):
    for given in GIVEN:
        name = make(given)
        found = load_model(name)
        assert (found.estimator.horizon, found.estimator.initial_state.tolist()) == (4, [2.0])
        has_names = "'a'" in given
        assert found.states == (("a",) if has_names else ("x1",))
        assert found.dt == (0.5 if has_names else None)
        changed = load_model(name, horizon=7, max_qps=None, initial_state=[1.0]).estimator
        assert changed.settings.max_qps is None
        assert (changed.horizon, changed.initial_state.tolist()) == (7, [1.0])


def test_bare_parts_need_options_and_a_zoo_model_has_its_own(make):
    model = make(PARTS)
    for words, options in (("--horizon", {}), ("--initial-state", {"horizon": 3})):
        with pytest.raises(OptionError, match=words):
            load_model(model, **options)
    assert load_model(model, horizon=3, initial_state=np.zeros(1)).estimator.horizon == 3
    found = load_model("battery_cell")
    assert found.estimator.horizon == 60
    assert found.states == ("state of charge", "v1 (V)", "v2 (V)")


ZERO = "line 8: ", "ZeroDivisionError: division by zero"


MISFITS = [
    ("return 3", BEGIN, ["gave a int", "(system, observer, cost)"]),
    ("return system, observer", BEGIN, ["gave a tuple of 2"]),
    ("return observer, system, cost", BEGIN, ["gave a Luenberger for its system"]),
    (f"{PARTS}, 3", BEGIN, ["gave a int after its cost"]),
    (f"{PARTS}, dict(horzon=3)", BEGIN, ["'horzon'", "horizon"]),
    (f"{PARTS}, dict(horizon=3, initial_state=[0, 1])", BEGIN, ["(2,)", "(1,)"]),
    (f"{PARTS}, dict(horizon=3, initial_state=0, states=['a', 'b'])", BEGIN,
     ["names its states", "1 different names"]),
    ("raise SystemExit(0)", BEGIN, ["line 8: ", "ends the program"]),
    ("return 1 / 0", BEGIN, ZERO),
    ("return qpmhe.System(lambda x: x[:0], lambda x: x, n=1, p=1)", BEGIN,
     ["line 8: ", "f returned shape (0,)", "expected (1,)"]),
    ("return 1", "x = 1\ny = (", ["line 2", "SyntaxError"]),
    ("return 1", "x = 1\nimport nowhere_to_be_found", ["line 2", "nowhere_to_be_found"]),
    ("return 1", "def f():\n    return 1 / 0\nf()", ["line 2", "ZeroDivisionError"]),
    (f"f = lambda x: x * gain\n    return qpmhe.System(f, f, n=1, p=1), {PARTS[15:]}, "
     "dict(horizon=3, initial_state=1.0)", BEGIN,
     ["line 8: ", "f raised NameError: name 'gain' is not defined"]),
]


def test_models_that_do_not_fit(make, here, monkeypatch):
    monkeypatch.syspath_prepend(here)
    for function, begin, words in MISFITS:
        models = [make(function, begin)]
        if begin is BEGIN:
            models.append(make(function).replace(".py", ""))
        for model in models:
            with pytest.raises(InvalidInputError) as caught:
                load_model(model)
            for word in (*words, model.partition(":")[0]):
                assert word in str(caught.value)


def test_no_such_function(make):
    for model, words in ((make("return 1").replace(":make", ":other"), "has no function other"),
                         ("nowhere.py:make", "cannot read"), ("nowhere", "battery_cell")):
        with pytest.raises(InvalidInputError, match=words):
            load_model(model)


def test_a_file_imports_those_beside_it_and_may_be_a_module(make, here, monkeypatch):
    (here / "sub").mkdir()
    (here / "sub/helper_of_sib.py").write_text("HORIZON = 6\n")
    name = make(f"{PARTS}, dict(horizon=HORIZON, initial_state=3.0)",
                begin=f"from helper_of_sib import HORIZON\n{BEGIN}").partition(":")[0]
    before = list(sys.path)
    (here / "sub/sib.py").write_text(Path(name).read_text())
    found = load_model("sub/sib.py:make")
    assert (found.estimator.horizon, found.estimator.initial_state.tolist()) == (6, [3.0])
    assert sys.path == before
    monkeypatch.syspath_prepend(here / "sub")
    assert load_model("sib:make").identity["model"] == "sib:make"


def test_places_are_in_the_users_own_files(here):
    """Of a model beside the package's own folder, no line of the package is named."""
    package = Path(qpmhe.__file__).parent
    with pytest.raises(InvalidInputError) as caught:
        qpmhe.Luenberger("what")
    for file in (package.parent / "model.py", Path(__file__)):
        assert place(caught.value, file).startswith(f"{__file__}, line ")
    assert place(caught.value, None) == ""


FAILING = """
import numpy as np
import qpmhe

calls = 0

def rate(x, u):
    return -0.1 * x + u[..., :1]

def output(x):
    global calls
    calls += 1
{body}
    return x[..., :1] * 1.0

def make():
    {system}
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    return system, qpmhe.Luenberger([0.3]), cost, dict(horizon=5, initial_state=[0.0])
"""
SYSTEMS = [
    "system = qpmhe.System(lambda x, u: 0.9 * x + u[..., :1], output, n=1, p=1, m=1)",
    "system = qpmhe.System.from_ode(rate, output, dt=1.0, n=1, p=1, m=1)",
]
BEYOND = "    if np.any(np.real(x) > 2.5):\n        raise ValueError('beyond the table')"
MISTAKE = "    if np.any(np.real(x) > 2.5):\n        x = x + ofset"
INFINITE = "    x = np.where(np.real(x) > 2.5, np.inf, 1.0) * x"
WRONG_SHAPE = "    if np.any(np.real(x) > 2.5):\n        return np.zeros(2)"
# What is not traced is called at every sample.
LATE_SHAPE = "    np.isnan(x)\n    if calls > 150:\n        return np.zeros(2)"
LATE = "    np.isnan(x)\n    if calls > 100:\n        raise ArithmeticError('no convergence')"


def failing(body, system):
    # It rises above 2.5 in the middle, and comes back.
    y = 4 * np.sin(np.linspace(0, np.pi, 50)) ** 2
    put("record.csv", ["time,y,u", *(f"{t},{y[t]:.6f},0" for t in range(50))])
    Path("model.py").write_text(FAILING.format(body=body, system=system))
    return "model.py:make"


@pytest.mark.parametrize("system", SYSTEMS, ids=["discrete", "continuous"])
@pytest.mark.parametrize(("body", "words", "is_mistake"), [
    (BEYOND, "h raised ValueError: beyond the table at x = [", False),
    (MISTAKE, "h raised NameError: name 'ofset' is not defined at x = [", True),
    (WRONG_SHAPE, "h returned shape (2,); expected (1,) at x = [", True),
    (INFINITE, "is not finite at x = [", False),
    (LATE_SHAPE, "returned other than real numbers of the right shape at x = [", True),
])
def test_a_model_that_fails_on_the_way_is_reported(here, body, words, is_mistake, system):
    reports = []
    summary = estimate(failing(body, system), report=reports.append)
    text = Path("out.csv").read_text().splitlines()[1:]
    failed = [k for k, row in enumerate(text) if "MODEL_FAILED" in row]
    stale = [k for k, row in enumerate(text) if "FAILED_STAGE" in row]
    assert summary.samples == 50
    assert 0 < summary.failed == len(failed) < 50
    assert summary.stale == len(set(stale) - set(failed))
    assert summary.model_is_wrong == is_mistake
    for part in (words, f"failed at {len(failed)} of 50 samples",
                 f"first at record.csv, line {failed[0] + 2} (time {failed[0]}): "):
        assert part in summary.failure
    (once,) = reports
    assert words in once


@pytest.mark.parametrize(("body", "expected"), [
    ("    pass", 0), (BEYOND, 0), (WRONG_SHAPE, 3), (LATE, 3),
])
def test_exit_codes_of_models_that_fail(here, body, expected):
    name = failing(body, SYSTEMS[0])
    code, out, error = shell(f"qpmhe estimate {name} record.csv")
    assert (code, out.count("\n")) == (expected, 51)  # bad luck stops nothing
    assert error.count("warning: the model failed at") == (0 if "pass" in body else 2)
    code, out, error = shell(f"qpmhe estimate {name} record.csv --quiet")
    assert (code, out.count("\n")) == (expected, 51)
    assert error.startswith("warning: the model failed at" if expected else "")
    assert bool(error) == bool(expected)
