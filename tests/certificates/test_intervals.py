"""Interval enclosures against values and derivatives in 40 digits; regions."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import enclosures
from qpmhe.certificates.contraction import certify_detectability
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.evidence import Evidence
from qpmhe.certificates.intervals import Interval
from qpmhe.certificates.regions import Region, bounded_region
from qpmhe.errors import SetError

from .helpers import unit_box
from .random_expressions import made, value


def test_extrema_inside_an_interval_are_found():
    wave = Interval([0.0, 3.0, -1.0], [4.0, 6.0, 1.0]).sin()
    assert (wave.high[0], wave.low[1]) == (1.0, -1.0)
    np.testing.assert_allclose([wave.low[2], wave.high[2]], [-math.sin(1.0), math.sin(1.0)])
    assert Interval(-2.0, 1.0).power(2).low == 0.0


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
    plain, twin = of_numpy(), KINDS[kind]()
    ours, theirs = (
        SmoothModel(system, bounded_region(system, qpmhe.Box([0.1, -2.0], [2.0, 2.0])))
        for system in (plain, twin)
    )
    assert ours.reason == theirs.reason == ""
    low, high = np.array([[0.1, -1.0], [0.5, 0.5]]), np.array([[0.4, 1.0], [2.0, 0.6]])
    ours, theirs = ours.enclose(low, high), theirs.enclose(low, high)
    np.testing.assert_allclose(ours.centre, theirs.centre, rtol=1e-12)
    np.testing.assert_allclose(ours.slopes, theirs.slopes, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.error, theirs.error, rtol=0.02, atol=1e-12)


def test_a_kinked_output_is_proved():
    found = certify_detectability(
        of_numpy(), qpmhe.Box([-0.2, -0.2], [0.2, 0.2]), eta=0.98, seconds=300.0
    )
    assert found.evidence is Evidence.PROVED


mpmath.mp.dps = 40
# CasADi computes with the constants of these functions before any interval does.
FOLDED = ("deg2rad", "rad2deg", "interp", "log2", "log10")


def violations(expression, low, high, generator):
    """How many values were compared with enclosures, and where they are not in them."""
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
    except qpmhe.errors.ModelError:  # not defined on all of it
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
        compared, wrong = violations(expression, low, high, generator)
        assert wrong == []
        assert compared == 4


def test_unbounded_missing_and_misfit_regions():
    plane, driven = qpmhe.models.van_der_pol()[0], qpmhe.models.cstr()[0]
    for system, states, inputs, words in (
        (plane, qpmhe.Box([0.0, 0.0], [1.0, np.inf]), None, r"unbounded in x\[1\]"),
        (plane, None, None, "there is no region"), (plane, unit_box(3), None, "dimension 3"),
        (plane, qpmhe.Polytope([[1, 0], [-1, 0], [0, 1]], [1] * 3), None, "unbounded"),
        (plane, unit_box(2), unit_box(1), "system has none"),
        (driven, unit_box(2), None, "has inputs"),
    ):
        with pytest.raises(SetError, match=words):
            bounded_region(system, states, inputs)


def test_polytope_is_boxed_outward_and_sampled_inside():
    system = qpmhe.models.van_der_pol()[0]
    triangle = qpmhe.Polytope([[-1.0, 0.0], [0.0, -1.0], [3.0, 1.0]], [0.0, 0.0, 1.0])
    region = bounded_region(system, triangle)
    assert (region.lower <= 0.0).all()
    assert (region.upper >= [1.0 / 3.0, 1.0]).all()
    np.testing.assert_allclose(region.upper, [1.0 / 3.0, 1.0], rtol=1e-9)
    np.testing.assert_allclose(region.lower, 0.0, atol=1e-9)
    points = region.sample(200, np.random.default_rng(4))
    assert region.contains(points).all()
    assert (np.ptp(points, axis=0) > 0.9 * region.upper).all()
    away = region.outside(np.array([[0.3, 0.3], [0.1, 0.1]]), np.array([[0.4, 0.4], [0.2, 0.2]]))
    assert away.tolist() == [True, False]
