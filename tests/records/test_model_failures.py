"""A model that fails on the way: the run goes on, and the user is told."""

from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import estimate_record

from . import process
from .test_resume import put

MODEL = """
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
DISCRETE = "system = qpmhe.System(lambda x, u: 0.9 * x + u[..., :1], output, n=1, p=1, m=1)"
TIMED = "system = qpmhe.System.from_ode(rate, output, dt=1.0, n=1, p=1, m=1)"

BEYOND = "    if np.any(np.real(x) > 2.5):\n        raise ValueError('beyond the table')"
MISTAKE = "    if np.any(np.real(x) > 2.5):\n        x = x + ofset"
INFINITE = "    x = np.where(np.real(x) > 2.5, np.inf, 1.0) * x"
WRONG_SHAPE = "    if np.any(np.real(x) > 2.5):\n        return np.zeros(2)"
# What is not traced is called at every sample.
LATE_SHAPE = "    np.isnan(x)\n    if calls > 150:\n        return np.zeros(2)"
LATE = "    np.isnan(x)\n    if calls > 100:\n        raise ArithmeticError('no convergence')"


@pytest.fixture
def record(here):
    # It rises above 2.5 in the middle, and comes back.
    y = 4 * np.sin(np.linspace(0, np.pi, 50)) ** 2
    put("record.csv", ["time,y,u", *(f"{t},{y[t]:.6f},0" for t in range(50))])
    return here


def model(body, system=DISCRETE):
    path = Path("model.py")
    path.write_text(MODEL.format(body=body, system=system))
    return "model.py:make"


@pytest.mark.parametrize("system", [DISCRETE, TIMED])
@pytest.mark.parametrize(
    ("body", "words", "is_mistake"),
    [
        (BEYOND, "h raised ValueError: beyond the table at x = [", False),
        (MISTAKE, "h raised NameError: name 'ofset' is not defined at x = [", True),
        (WRONG_SHAPE, "h returned shape (2,); expected (1,) at x = [", True),
        (INFINITE, "is not finite at x = [", False),
        (LATE_SHAPE, "returned other than real numbers of the right shape at x = [", True),
    ],
)
def test_it_is_told(record, body, words, is_mistake, system):
    name = model(body, system)
    told = []
    summary = estimate_record(name, "record.csv", "out.csv", report=told.append)
    text = Path("out.csv").read_text().splitlines()[1:]
    failed = [k for k, row in enumerate(text) if "MODEL_FAILED" in row]
    stale = [k for k, row in enumerate(text) if "FAILED_STAGE" in row]
    assert summary.samples == 50
    assert 0 < summary.failed == len(failed) < 50
    assert summary.stale == len(set(stale) - set(failed))
    assert summary.model_is_wrong == is_mistake
    assert f"failed at {len(failed)} of 50 samples" in summary.failure
    place, _, why = summary.failure.partition(f"first at record.csv, line {failed[0] + 2}")
    assert place
    assert f"(time {failed[0]}): " in why
    assert words in why
    # Once, when it happens.
    assert len(told) == 1
    assert words in told[0]


def test_nothing_is_told_of_a_model_that_works(record):
    name = model("    pass")
    summary = estimate_record(name, "record.csv", "out.csv")
    assert (summary.failed, summary.stale, summary.failure) == (0, 0, "")


@pytest.mark.parametrize(
    ("body", "expected", "quiet"),
    [
        ("    pass", 0, ""),
        (BEYOND, 0, ""),
        (WRONG_SHAPE, 3, "warning: the model failed at"),
        (LATE, 3, "warning: the model failed at"),
    ],
)
def test_exit_codes(record, body, expected, quiet):
    name = model(body)
    code, out, error = process.shell(f"qpmhe estimate {name} record.csv")
    assert code == expected
    assert out.count("\n") == 51  # bad luck stops nothing
    assert error.count("warning: the model failed at") == (0 if "pass" in body else 2)
    code, out, error = process.shell(f"qpmhe estimate {name} record.csv --quiet")
    assert (code, out.count("\n")) == (expected, 51)
    assert error.startswith(quiet)
    assert bool(error) == bool(quiet)
