"""Enclosures against values and derivatives in 40 digits; no model is proved to be another one."""

from __future__ import annotations

import math
import operator
import threading
from math import tanh as kept_tanh

import mpmath
import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import Evidence, certify_detectability, enclosures
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.intervals import Interval
from qpmhe.certificates.regions import Region
from qpmhe.errors import ModelError

from .helpers import box, scalar, smooth, unit_box
from .random_expressions import made, value

mpmath.mp.dps = 40
# CasADi computes with the constants of these functions before any interval does.
FOLDED = ("deg2rad", "rad2deg", "interp", "log2", "log10")


def violations(expression, low, high, generator):
    """How many derivatives were compared with enclosures, and what is not in them."""
    room = mpmath.mpf(1e-15) if any(each in repr(expression) for each in FOLDED) else 0
    with np.errstate(all="ignore"):
        system = qpmhe.System(
            lambda x: np.stack([value(expression, x, 0) + 0.0 * x[0], x[1]]), lambda x: x, n=2, p=2
        )
    model = SmoothModel(system, Region(qpmhe.Box(low, high), low, high))
    if model.reason:
        return 0, []
    try:
        found = model.enclose(low[None], high[None])
    except ModelError:  # not defined on all of it
        return 0, []
    values = model.values(low[None], high[None])
    centre = 0.5 * low + 0.5 * high
    half = np.nextafter(np.maximum(high - centre, centre - low), np.inf)
    compared, wrong = 0, []
    for x in generator.uniform(low, high, (2, 2)):
        point = [mpmath.mpf(float(one)) for one in x]
        if values.known[0, 0]:
            exact = value(expression, point, 1)
            slack = room * abs(exact)
            if not values.low[0, 0] - slack <= exact <= values.high[0, 0] + slack:
                wrong.append((expression, x, exact))
        if np.isnan(found.error).any():
            continue
        shares = [(s - float(c)) / float(w) for s, c, w in zip(point, centre, half, strict=True)]
        for k in range(2):
            exact = mpmath.diff(
                lambda s, k=k, point=point: value(
                    expression, [*point[:k], s, *point[k + 1 :]], 1
                ), point[k],
            )
            slack = mpmath.mpf(10) ** -30 + room * abs(exact)
            inside = [
                abs(exact - part.centre[0, 0, k] - sum(
                    float(part.slopes[0, j, 0, k]) * shares[j] for j in range(2)
                )) <= part.error[0, 0, k] + slack for part in (found, *found.sides)
            ]
            compared += 1
            # In what holds all, and in what holds one side of the kinks.
            if not inside[0] or not any(inside[-len(found.sides):]):
                wrong.append((expression, x, k, exact))
    return compared, wrong


@pytest.mark.parametrize("block", range(5))
def test_random_expressions_lie_in_their_enclosures(block, monkeypatch):
    monkeypatch.setattr(enclosures, "_SAMPLES", 20)
    generator, compared = np.random.default_rng(block), 0
    for _ in range(60):
        expression = made(generator, int(generator.integers(1, 5)))
        middle, size = generator.uniform(-2.0, 2.0, 2), 10.0 ** generator.uniform(-3.0, 0.0, 2)
        count, wrong = violations(expression, middle - size, middle + size, generator)
        compared += count
        assert wrong == []
    assert compared > 60


# Functions that bend behind a kink, whose sides are enclosed beyond the kink.
@pytest.mark.parametrize("expression", [
    ("sqrt", ("minimum", 1, 0)), ("exp", ("clip", 0)), ("arctan", ("maximum", 0, 1)),
    ("hypot", ("exp", 1), ("maximum", 0, 1)), ("multiply", ("minimum", 1, 0), ("norm", 1, 0.12)),
    ("sin", ("interp", 0)), ("square", ("abs", ("subtract", 0, 1))), ("leaky", ("where", 0, 1)),
])
def test_kinks_behind_other_functions(expression):
    generator = np.random.default_rng(1)
    for shift in (0.0, 0.01, -0.1):
        low, high = np.array([0.4, 0.45 + shift]), np.array([1.4, 1.35 + shift])
        assert violations(expression, low, high, generator) == (4, [])


def test_extrema_inside_an_interval_are_found():
    wave = Interval([0.0, 3.0, -1.0], [4.0, 6.0, 1.0]).sin()
    assert (wave.high[0], wave.low[1]) == (1.0, -1.0)
    np.testing.assert_allclose([wave.low[2], wave.high[2]], [-math.sin(1.0), math.sin(1.0)])
    assert Interval(-2.0, 1.0).power(2).low == 0.0


# One model in all languages


def of_numpy():
    return qpmhe.System.from_ode(
        lambda x: np.array([x[1], 1.5 * (1.0 - x[0] ** 2) * x[1] - np.tanh(x[0])]),
        lambda x: np.maximum(x[:1], 0.5 * x[:1]), dt=0.1, n=2, p=1,
    )


def of_casadi(kind):
    ca = pytest.importorskip("casadi")
    x = getattr(ca, kind).sym("x", 2)
    rate = ca.vertcat(x[1], 1.5 * (1 - x[0] ** 2) * x[1] - ca.tanh(x[0]))
    f, h = (
        ca.Function(name, [x], [column])
        for name, column in (("f", rate), ("h", ca.fmax(x[0], 0.5 * x[0])))
    )
    return qpmhe.from_casadi(f, h, dt=0.1, compiled=False)


def of_sympy():
    sympy = pytest.importorskip("sympy")
    a, b = sympy.symbols("a b")
    rate = [b, sympy.Rational(3, 2) * (1 - a**2) * b - sympy.tanh(a)]
    return qpmhe.from_sympy(rate, [sympy.Max(a, a / 2)], [a, b], dt=0.1)


KINDS = {
    "casadi": lambda: of_casadi("SX"), "casadi of matrices": lambda: of_casadi("MX"),
    "sympy": of_sympy, "numpy through a copy": lambda: of_numpy().copy(traced=True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_of_models_have_the_same_enclosure(kind):
    ours, theirs = (
        smooth(system, box([0.1, -2.0], [2.0, 2.0]))[0] for system in (of_numpy(), KINDS[kind]())
    )
    assert ours.reason == theirs.reason == ""
    low, high = np.array([[0.1, -1.0], [0.5, 0.5]]), np.array([[0.4, 1.0], [2.0, 0.6]])
    ours, theirs = ours.enclose(low, high), theirs.enclose(low, high)
    np.testing.assert_allclose(ours.centre, theirs.centre, rtol=1e-12)
    np.testing.assert_allclose(ours.slopes, theirs.slopes, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.error, theirs.error, rtol=0.02, atol=1e-12)


def test_a_kinked_output_is_proved():
    found = certify_detectability(of_numpy(), box([-0.2] * 2, [0.2] * 2), eta=0.98, seconds=300.0)
    assert found.evidence is Evidence.PROVED


# Models that look for symbols: each function is 0.5 x, but for a step of width 2e-4 at 0.3, which
# no sample meets.
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


def sliver(x):
    if x[0] > 0.1234 and x[0] < 0.1235:
        raise ValueError("in between")
    return np.array([0.5 * x[0]])


REFUSED = {
    "tanh of math, and any exception": (swallowing(lambda x: step(x[0])), "float()"),
    "a hash": (lambda x: 0.5 * x if x[0] not in {PLACE} else 0.0 * x, "hash"),
    "a look-up in a dictionary": (swallowing(lambda x: TABLE.get(x[0], 0.0)), "hash"),
    "a text": (swallowing(lambda x: float(str(x[0])) * 0.0), "text"),
    "bool": (swallowing(lambda x: step(x[0]) if abs(x[0] - PLACE) < WIDTH else 0.0), "branch"),
    "a branch that no sample takes": (sliver, "the truth of a comparison"),
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
        model, _ = smooth(scalar(**{letter: function}), unit_box(1))
        assert word in model.reason, way
    found = certify_detectability(scalar(**{letter: REFUSED["a hash"][0]}), unit_box(1), eta=0.8)
    assert found.evidence is Evidence.SAMPLED


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
    model, _ = smooth(scalar(f), unit_box(1))
    assert model.reason == ""
    for low, high in ((-1.0, 1.0), (PLACE - 1e-6, PLACE + 1e-6)):
        corners, error = model.enclose(np.array([[low]]), np.array([[high]])).corners()
        assert corners[0, :, 0, 0].max() + error[0, 0, 0] >= 2.9


# Jumps, and values that are not finite


def test_what_jumps_between_samples_is_known_to():
    model, region = smooth(
        scalar(lambda x: 0.5 * x + np.where(np.isclose(x, PLACE), 1.0, 0.0)), unit_box(1)
    )
    assert model.reason == ""
    assert "jump" in model.obstacle(region.lower, region.upper)
    assert np.isnan(model.enclose(region.lower[None], region.upper[None]).error).any()


def test_a_tangent_continues_a_function_and_another_state_does_not():
    value, slope = math.sin(0.5), math.cos(0.5)
    for more, word in ((0.0, ""), (1.0, "jump")):
        system = qpmhe.System(
            lambda x, more=more: np.stack([
                np.where(x[0] < 0.5, np.sin(x[0]), value + slope * (x[0] - 0.5) + more * x[1]), x[1]
            ]), lambda x: x, n=2, p=2,
        )
        model, region = smooth(system, box([0.0, 0.0], [1.0, 1.0]))
        found = model.obstacle(region.lower, region.upper)
        assert word in found
        assert bool(found) == bool(word)


def lost(x):
    return np.where(np.real(x) > 5.0, np.nan, 0.5 * x)


def test_nothing_is_enclosed_where_values_or_derivatives_are_not_finite():
    for f in (lost, lambda x: np.maximum(0.5 * x, lost(x)), lambda x: 0.5 * x + lost(x) ** 2):
        model, _ = smooth(scalar(f), box(-10.0, 10.0))
        assert model.reason == ""
        for low, high in ((6.0, 10.0), (4.0, 7.0)):
            with pytest.raises(ModelError, match="not finite"):
                model.enclose(np.array([[low]]), np.array([[high]]))
        assert np.isfinite(model.enclose(np.array([[-9.0]]), np.array([[4.0]])).error).all()
    # The derivative overflows in one of two cells.
    model, _ = smooth(scalar(lambda x: (1e154 * x) ** 2), box(0.0, 1.0))
    found = model.enclose(np.array([[0.0], [0.5]]), np.array([[0.1], [1.0]]))
    corners, error = found.corners()
    assert np.isnan(error[1]).all()
    assert corners[0].max() + error[0].max() >= 2e307
