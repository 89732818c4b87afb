"""No model is proved to be something that it is not, whatever it makes of symbols."""

from __future__ import annotations

import math
import operator
import threading
from math import tanh as kept_tanh

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.regions import bounded_region

from .helpers import scalar, unit_box

# All these functions are 0.5 x, but for a step of width 2e-4 at 0.3, which no sample meets.
PLACE, WIDTH = 0.3, 2e-4
TABLE = {}


def step(s):
    return 3.0 * WIDTH * kept_tanh((s - PLACE) / WIDTH)


def swallowing(ask):
    """0.5 x, and what a function gives for x[0], if it raises nothing."""

    def f(x):
        try:
            more = ask(x)
        except Exception:
            more = 0.0
        return 0.5 * x + more

    return f


def in_place(x):
    try:
        x[0] = x[0] + 0.0
    except Exception:
        return 0.5 * x
    return 0.5 * x + 1.0


def counted(x, calls=[]):  # noqa: B006
    calls.append(0)
    return 0.5 * x + (1.0 if len(calls) % 5 == 0 else 0.0)


def failing(x, calls=[]):  # noqa: B006
    calls.append(0)
    if len(calls) % 7 == 0:
        raise ValueError("now and then")
    return 0.5 * x


def of_a_thread(x):
    return (0.5 if threading.current_thread().name == "MainThread" else 0.4) * x


REFUSED = {
    "tanh of math, and any exception": (swallowing(lambda x: step(x[0])), "float()"),
    "a hash": (lambda x: 0.5 * x if x[0] not in {PLACE} else 0.0 * x, "hash"),
    "a look-up in a dictionary": (swallowing(lambda x: TABLE.get(x[0], 0.0)), "hash"),
    "a text": (swallowing(lambda x: float(str(x[0])) * 0.0), "text"),
    "bool": (swallowing(lambda x: step(x[0]) if abs(x[0] - PLACE) < WIDTH else 0.0), "branch"),
    "a whole number": (swallowing(lambda x: [0.0, 0.0 * x[0]][int(x[0])]), "int()"),
    "equality": (swallowing(lambda x: step(x[0]) if x[0] == PLACE else 0.0), "branch"),
    "a type": (lambda x: 0.5 * x + (step(x[0]) if type(x[0]) is np.float64 else 0.0), "type"),
    "identity": (lambda x: 0.5 * x + (0.0 if x[0] is x[0] else step(x[0])), "same"),
    "identity by a function": (
        lambda x: 0.5 * x + (0.0 if operator.is_(x[0], x[0]) else step(x[0])), "is_"),
    "an attribute": (
        lambda x: 0.5 * x + (step(x[0]) if hasattr(x[0], "is_integer") else 0.0), "is_integer"),
    "memory": (lambda x: 0.5 * x + (step(x[0]) if len(bytes(x)) > 99 else 0.0), "bytes"),
    "a change of the argument": (in_place, "change of its argument"),
    "any exception": (swallowing(lambda x: [0.0][1]), "IndexError"),
    "an exception now and then": (failing, "depends on more than its arguments"),
    "a thread": (of_a_thread, "depends on more than its arguments"),
    "a counter": (counted, "depends on more than its arguments"),
}


@pytest.mark.parametrize("letter", ["f", "h"])
def test_what_looks_for_symbols_is_not_proved(letter):
    for way, (function, word) in REFUSED.items():
        system = scalar(**{letter: function})
        model = SmoothModel(system, bounded_region(system, unit_box(1)))
        assert word in model.reason, way
        assert model.reason, way


def of_numbers(x):
    """Code that asks what numbers and arrays answer alike, with the step."""
    more = 0.0
    if isinstance(x[0], float) and isinstance(x, np.ndarray) and x.dtype == np.float64:
        more = 3.0 * WIDTH * math.tanh((x[0] - PLACE) / WIDTH)
    return np.asarray(0.5 * x + more, dtype=float)


@pytest.mark.parametrize("f", [
    of_numbers,
    lambda x: 0.5 * x + 3.0 * WIDTH * np.tanh((x - PLACE) / WIDTH),
    lambda x: 0.5 * x + np.clip(3.0 * (x - PLACE), -3.0 * WIDTH, 3.0 * WIDTH),
    # NumPy warns of the logarithm, which is never taken.
    lambda x: np.where(x > -2.0, 0.5 * x + 3.0 * WIDTH * np.tanh((x - PLACE) / WIDTH), np.log(x)),
    lambda x: np.interp(x, [-1.0, PLACE - WIDTH, PLACE + WIDTH, 1.0], [0.0, 0.0, 6 * WIDTH, 0.0]),
])
def test_a_step_that_no_sample_meets_is_enclosed(f):
    system = scalar(f)
    model = SmoothModel(system, bounded_region(system, unit_box(1)))
    assert model.reason == ""
    for low, high in ((-1.0, 1.0), (PLACE - 1e-6, PLACE + 1e-6)):
        corners, error = model.enclose(np.array([[low]]), np.array([[high]])).corners()
        assert corners[0, :, 0, 0].max() + error[0, 0, 0] >= 2.9


def test_what_jumps_between_samples_is_known_to():
    system = scalar(lambda x: 0.5 * x + np.where(np.isclose(x, PLACE), 1.0, 0.0))
    region = bounded_region(system, unit_box(1))
    model = SmoothModel(system, region)
    assert model.reason == ""
    assert "jump" in model.obstacle(region.lower, region.upper)
    assert np.isnan(model.enclose(region.lower[None], region.upper[None]).error).any()


@pytest.mark.parametrize(("more", "word"), [(0.0, ""), (1.0, "jump")])
def test_a_tangent_continues_a_function_and_another_state_does_not(more, word):
    value, slope = math.sin(0.5), math.cos(0.5)
    system = qpmhe.System(
        lambda x: np.stack([
            np.where(x[0] < 0.5, np.sin(x[0]), value + slope * (x[0] - 0.5) + more * x[1]), x[1]
        ]), lambda x: x, n=2, p=2,
    )
    region = bounded_region(system, qpmhe.Box([0.0, 0.0], [1.0, 1.0]))
    found = SmoothModel(system, region).obstacle(region.lower, region.upper)
    assert word in found
    assert bool(found) == bool(word)
