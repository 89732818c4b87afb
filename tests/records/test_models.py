"""A user's model: what its function may return, where it does not fit, and failures on the way."""

from itertools import count
from pathlib import Path

import numpy as np
import pytest

from qpmhe.errors import InvalidInputError, ModelWarning, OptionError
from qpmhe.records.record_model import load_record_model as load_model

from .tools import estimate, put, shell

BEGIN = """
import numpy as np, qpmhe
system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
observer = qpmhe.Luenberger([0.3])
cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
"""
PARTS = "return system, observer, cost"
NUMBERS = count()


def make(function, begin=BEGIN):
    path = Path(f"model{next(NUMBERS)}.py")  # files are imported once
    path.write_text(f"{begin}\ndef make():\n    {function}\n")
    return f"{path}:make"


def test_what_the_function_may_return(here):
    for given in (
        f"{PARTS}, dict(horizon=4, initial_state=[2.0])",
        "return [system, observer, cost, dict(horizon=4, initial_state=2.0, dt=0.5, states='a')]",
        "return qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=4, initial_state=[2])",
        f"{PARTS}, qpmhe.models.Scenario(system=system, initial_state=[0.0],"
        " initial_estimate=[2.0], disturbance_covariance=1.0, noise_covariance=1.0, dt=0.5,"
        " horizon=4, steps=9, labels=('a',))",
    ):
        name = make(given)
        found = load_model(name)
        assert (found.estimator.horizon, found.estimator.initial_state.tolist()) == (4, [2.0])
        assert (found.states, found.dt) == ((("a",), 0.5) if "'a'" in given else (("x1",), None))
        changed = load_model(name, horizon=7, max_qps=None, initial_state=[1.0]).estimator
        assert changed.settings.max_qps is None
        assert (changed.horizon, changed.initial_state.tolist()) == (7, [1.0])
    model = make(PARTS)
    for words, options in (("--horizon", {}), ("--initial-state", {"horizon": 3})):
        with pytest.raises(OptionError, match=words):
            load_model(model, **options)
    assert load_model(model, horizon=3, initial_state=[0.0]).estimator.horizon == 3
    assert load_model("battery_cell").states == ("state of charge", "v1 (V)", "v2 (V)")


def test_models_that_do_not_fit(here, monkeypatch):
    monkeypatch.syspath_prepend(here)
    for function, begin, *words in (
        ("return observer, system, cost", BEGIN, "returned a Luenberger for its system"),
        (f"{PARTS}, dict(horzon=3)", BEGIN, "'horzon'", "horizon"),
        (f"{PARTS}, dict(horizon=3, initial_state=0, states=['a', 'b'])", BEGIN,
         "names its states", "1 different names"),
        ("raise SystemExit(0)", BEGIN, "line 8: ", "ends the program"),
        ("return 1", "x = 1\ny = (", "line 2: ", "SyntaxError: '(' was never closed in 'y = ('."),
        (f"f = lambda x: x * gain\n    system = qpmhe.System(f, f, n=1, p=1)\n    {PARTS}, "
         "dict(horizon=3, initial_state=1.0)", BEGIN,
         "line 8: ", "f raised NameError: name 'gain' is not defined"),
    ):
        for model in (make(function, begin), make(function, begin).replace(".py", "")):
            with pytest.raises(InvalidInputError) as caught:
                load_model(model)
            for word in (*words, model.partition(":")[0]):
                assert word in str(caught.value)
    for model, words in ((make("return 1").replace(":make", ":other"), "has no function other"),
                         ("nowhere.py:make", "cannot read"), ("nowhere", "battery_cell")):
        with pytest.raises(InvalidInputError, match=words):
            load_model(model)


FAILING = """
import numpy as np
import qpmhe

calls = 0

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
DISCRETE = "system = qpmhe.System(lambda x: 0.9 * x, output, n=1, p=1)"
CONTINUOUS = "system = qpmhe.System.from_ode(lambda x: -0.1 * x, output, dt=1.0, n=1, p=1)"
LARGE = "if np.any(np.real(x) > 2.5):\n        "
BEYOND = f"{LARGE}raise ValueError('beyond the table')"
MISTAKE = f"{LARGE}x = x + ofset"
# What is not traced is called at every sample.
SHAPE = "np.isnan(x)\n    if calls > 150:\n        return np.zeros(2)"


@pytest.mark.parametrize(
    ("body", "system", "words", "is_mistake"),
    [
        (BEYOND, CONTINUOUS, "h raised ValueError: beyond the table at x = [", False),
        (MISTAKE, DISCRETE, "h raised NameError: name 'ofset' is not defined at x = [", True),
        (SHAPE, CONTINUOUS, "h returned shape (2,); expected (1,) at x", True),
    ],
    ids=["beyond", "mistake", "shape"],
)
def test_a_model_that_fails_on_the_way_is_reported(here, body, system, words, is_mistake):
    # It rises above 2.5 in the middle, and comes back.
    y, reports = 4 * np.sin(np.linspace(0, np.pi, 50)) ** 2, []
    put("record.csv", ["time,y", *(f"{t},{y[t]:.6f}" for t in range(50))])
    Path("model.py").write_text(FAILING.format(body=body, system=system))
    summary = estimate("model.py:make", report=reports.append)
    text = Path("out.csv").read_text().splitlines()[1:]
    failed = [k for k, row in enumerate(text) if "MODEL_FAILED" in row]
    stale = [k for k, row in enumerate(text) if "FAILED_STAGE" in row]
    assert 0 < summary.failed == len(failed) < summary.samples == 50
    assert summary.stale == len(set(stale) - set(failed))
    assert summary.model_is_wrong == is_mistake
    for part in (words, f"failed at {len(failed)} of 50 samples",
                 f"first at record.csv, line {failed[0] + 2} (time {failed[0]}): "):
        assert part in summary.failure
    (once,) = reports
    assert words in once
    code, out, error = shell("qpmhe estimate model.py:make record.csv --quiet")
    assert (code, out.count("\n")) == (3 if is_mistake else 0, 51)  # bad luck stops nothing
    assert error.startswith("warning: the model failed at" if is_mistake else "")
    assert bool(error) == is_mistake


PUMPED = """
import numpy as np
import qpmhe

def rate(x, u):
    return 1.0 - u * x**2

def make():
    system = qpmhe.System.from_ode(rate, lambda x: x, dt=0.5, n=1, p=1, m=1{how})
    covariances = {{"disturbance": 0.1, "noise": 0.01}}
    return (system, qpmhe.ExtendedKalman(prior=0.1, **covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances),
            {{"horizon": 5, "initial_state": [1.0]}})
"""


def test_a_step_that_explodes_at_a_later_input_is_blamed_not_the_weights(here):
    """In a stream no input is known before its line; and what failed was the integration."""
    put("record.csv", ["time,y,u", *(f"{0.5 * t},1.0,{1.0 if t < 9 else 60.0}" for t in range(30))])
    put("model.py", [PUMPED.format(how="")])
    reports = []
    with pytest.warns(ModelWarning, match=r"one step of rk4 in dt = 0.5 .* u = \[60\.\]") as seen:
        summary = estimate("model.py:make", report=reports.append)
    assert len([one for one in seen if "u = [60.]" in str(one.message)]) == 1
    assert summary.failed > 1
    assert "One step of rk4 in dt = 0.5 is far too long near such states: " in summary.failure
    assert "method='radau'" in reports[0]
    assert "covariances" not in summary.failure
    put("stiff.py", [PUMPED.format(how=", method='radau', steps=8")])
    assert estimate("stiff.py:make", out="stiff.csv").failed == 0
