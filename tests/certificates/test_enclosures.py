"""Enclosures against values and derivatives in 40 digits; no model is proved to be another one."""

from __future__ import annotations

import math
from enum import Enum
from math import tanh as kept_tanh

import mpmath
import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Evidence,
    Sizes,
    certify_detectability,
    certify_observer,
    enclosures,
)
from qpmhe.certificates.deadline import Deadline
from qpmhe.certificates.enclosures import SmoothModel
from qpmhe.certificates.invariance import certify_invariance
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.regions import Region, bounded_region
from qpmhe.certificates.rowwise import RowwiseStep
from qpmhe.errors import ModelError

from .helpers import GAIN, box, scalar, smooth, unit_box, unit_cost
from .random_expressions import made, value

mpmath.mp.dps = 40
# CasADi computes with the constants of these functions before any interval does.
FOLDED = ("deg2rad", "log2", "log10")


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
    ("hypot", ("exp", 1), ("maximum", 0, 1)), ("leaky", ("where", 0, 1)),
])
def test_kinks_behind_other_functions(expression):
    generator = np.random.default_rng(1)
    for shift in (0.0, 0.01, -0.1):
        low, high = np.array([0.4, 0.45 + shift]), np.array([1.4, 1.35 + shift])
        assert violations(expression, low, high, generator) == (4, [])


@pytest.mark.slow
def test_models_of_numpy_and_casadi_have_the_same_enclosure():
    ca = pytest.importorskip("casadi")
    x = ca.MX.sym("x", 2)
    f = ca.Function("f", [x], [ca.vertcat(x[1], 1.5 * (1 - x[0] ** 2) * x[1] - ca.tanh(x[0]))])
    h = ca.Function("h", [x], [ca.fmax(x[0], 0.5 * x[0])])
    ours = qpmhe.System.from_ode(
        lambda x: np.array([x[1], 1.5 * (1.0 - x[0] ** 2) * x[1] - np.tanh(x[0])]),
        lambda x: np.maximum(x[:1], 0.5 * x[:1]), dt=0.1, n=2, p=1,
    )
    low, high = np.array([[0.1, -1.0], [0.5, 0.5]]), np.array([[0.4, 1.0], [2.0, 0.6]])
    one, other = (
        smooth(system, box([0.1, -2.0], [2.0, 2.0]))[0].enclose(low, high)
        for system in (ours, qpmhe.from_casadi(f, h, dt=0.1, compiled=False))
    )
    np.testing.assert_allclose(one.centre, other.centre, rtol=1e-12)
    np.testing.assert_allclose(one.slopes, other.slopes, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.error, other.error, rtol=0.02, atol=1e-12)
    # An output with a kink is proved.
    found = certify_detectability(ours, box([-0.2] * 2, [0.2] * 2), eta=0.98, seconds=300.0)
    assert found.evidence is Evidence.PROVED


# Models that look for symbols: each function is 0.5 x, but for a step of width 2e-4 at 0.3, which
# no sample meets.
PLACE, WIDTH = 0.3, 2e-4


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


def counted(x, calls=[]):  # noqa: B006 - the fault that is refused
    calls.append(0)
    return 0.5 * x + (1.0 if len(calls) % 5 == 0 else 0.0)


REFUSED = {
    "tanh of math, and any exception": (swallowing(lambda x: step(x[0])), "float()"),
    "a hash": (lambda x: 0.5 * x if x[0] not in {PLACE} else 0.0 * x, "hash"),
    "a text": (swallowing(lambda x: float(str(x[0])) * 0.0), "text"),
    "bool": (swallowing(lambda x: step(x[0]) if abs(x[0] - PLACE) < WIDTH else 0.0), "branch"),
    "a whole number": (swallowing(lambda x: [0.0, 0.0 * x[0]][int(x[0])]), "int()"),
    "a type": (lambda x: 0.5 * x + (step(x[0]) if type(x[0]) is np.float64 else 0.0),
               "depends on more than its arguments"),
    "identity": (lambda x: 0.5 * x + (0.0 if x[0] is x[0] else step(x[0])),
                 "depends on more than its arguments"),
    "an attribute": (
        lambda x: 0.5 * x + (step(x[0]) if hasattr(x[0], "is_integer") else 0.0), "is_integer"),
    "memory": (lambda x: 0.5 * x + (step(x[0]) if len(bytes(x)) > 99 else 0.0), "bytes"),
    "a change of the argument": (in_place, "change of its argument"),
    "a counter": (counted, "depends on more than its arguments"),
}


@pytest.mark.parametrize("letter", ["f", "h"])
def test_what_looks_for_symbols_is_not_proved(letter):
    for way, (function, word) in REFUSED.items():
        model, _ = smooth(scalar(**{letter: function}), unit_box(1))
        assert word in model.reason, way


class Method(Enum):
    """How a model is discretised."""

    EULER = 1


def remembering(x, known={}, method=Method.EULER):  # noqa: B006 - the memory of a function
    """0.5 x; an exception, an identity and a type are none of its arguments' business."""
    try:
        factor = known["factor"]
    except KeyError:
        factor = known["factor"] = 0.5 if method is Method.EULER else 0.4
    return type(factor)(factor) * x


@pytest.mark.parametrize("letter", ["f", "h"])
def test_exceptions_and_identities_of_other_objects_do_no_harm(letter):
    model, _ = smooth(scalar(**{letter: remembering}), unit_box(1))
    assert not model.reason


class Counting:
    """0.5 |x - 0.2|, and from its k-th call on something else within a width of the kink."""

    def __init__(self, after, width):
        self.after, self.width, self.calls = after, width, 0

    def __call__(self, x):
        self.calls += 1
        away = np.abs(x - 0.2)
        return 0.5 * away + (0.01 * (away < self.width) if self.calls > self.after else 0.0)


def test_the_trace_of_a_proof_is_compared_with_f_inside_each_cell():
    """Also close to kinks, which no sample of the region meets."""
    region, found = box(-1.0, 1.3), {}
    for after in (100, 10**9):
        found[after] = certify_observer(scalar(Counting(after, 1e-9)), GAIN, region)
    assert found[10**9].evidence is Evidence.PROVED
    assert found[10**9].compared > 400 + 2 * 256 + 2
    assert found[100].evidence is Evidence.SAMPLED
    assert found[100].compared == 0
    assert "the proof is of something else: f is [0.01" in found[100].notes[0]
    assert "its expression is" in found[100].notes[0]
    for prove in (
        lambda system: certify_invariance(system, region).holds,
        lambda system: RowwiseStep(
            system, bounded_region(system, region), np.array([[0.1]]), np.eye(1)).rows,
    ):
        assert prove(scalar(Counting(100, 1e-9))) is None
        assert prove(scalar(Counting(10**9, 1e-9))) is not None


def test_a_region_thinner_than_its_cells_is_compared_at_points_of_its_own():
    changed = []

    def f(x):
        return 0.5 * x + (1e-3 if changed else 0.0)

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    # |x1 - 0.37 x2 - 0.1234| <= 1e-9, which the box around it does not have at its corners.
    thin = qpmhe.Polytope([[1.0, -0.37], [-1.0, 0.37], [0.0, 1.0], [0.0, -1.0]],
                          [0.1234 + 1e-9, -0.1234 + 1e-9, 1.0, 1.0])
    model, region = smooth(system, thin)
    cells = [(region.lower[None], region.upper[None])]
    assert model.agrees(cells, Deadline(math.inf))
    assert model.compared > 400 + 256
    changed.append(True)
    assert not model.agrees(cells, Deadline(math.inf))
    assert "its expression is" in model.reason


class Looks(Deadline):
    """A time that is over after so many looks at the clock."""

    def __init__(self, count):
        super().__init__(math.inf)
        self.count = count

    @property
    def passed(self):
        self.count -= 1
        return self.count < 0

    def part(self, share):
        return self


def test_a_comparison_with_f_that_outlasts_its_time_is_given_up(monkeypatch):
    """A slow f: a proof of many cells that are not all compared is none, and says so."""
    region, fine = box(-1.0, 1.3), np.linspace(-1.0, 1.3, 301)[:, None]
    system = scalar(lambda x: 0.5 * x + 0.1 * np.sin(x))
    place, cells = bounded_region(system, region), [(fine[:-1], fine[1:])]
    model = SmoothModel(system, place)
    before = model.compared
    assert not model.agrees(cells, Looks(2))
    assert not model.reason
    assert model.late == "f and h were compared with their expressions in 128 of 300 cells"
    assert model.compared == before + 2 * 128
    assert model.agrees(cells, Looks(5))
    assert not model.late
    found = certify_invariance(system, region, seconds=Looks(0))
    assert found.holds is None
    assert "compared with their expressions in 0 of 1 cells when the time was over" in str(found)
    for looks, known in ((0, False), (1, False), (100, True)):
        rows = RowwiseStep(system, place, np.array([[0.1]]), np.eye(1), Looks(looks)).rows
        assert (rows is not None) == known
    agrees = SmoothModel.agrees
    monkeypatch.setattr(SmoothModel, "agrees", lambda *given: agrees(*given[:2], Looks(0)))
    sampled = certify_observer(system, GAIN, region, rho=0.9)
    assert (sampled.evidence, sampled.compared) == (Evidence.SAMPLED, 0)
    assert "the proof was given up when its time was over: f and h were comp" in sampled.notes[0]


def of_numbers(x):
    """Code that asks what numbers and arrays answer alike, with the step."""
    more = 0.0
    if isinstance(x[0], float) and isinstance(x, np.ndarray) and x.dtype == np.float64:
        more = 3.0 * WIDTH * math.tanh((x[0] - PLACE) / WIDTH)
    return np.asarray(0.5 * x + more, dtype=float)


@pytest.mark.parametrize("f", [
    of_numbers,
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


def test_a_tangent_continues_a_function_and_another_state_does_not():
    for more in (0.0, 1.0):
        model, region = smooth(qpmhe.System(
            lambda x, more=more: np.stack([np.where(
                x[0] < 0.5, np.sin(x[0]), math.sin(0.5) + math.cos(0.5) * (x[0] - 0.5) + more * x[1]
            ), x[1]]), lambda x: x, n=2, p=2,
        ), box([0.0, 0.0], [1.0, 1.0]))
        assert ("jump" in model.obstacle(region.lower, region.upper)) is (more > 0.0)
        found = model.enclose(region.lower[None], region.upper[None])
        assert np.isnan(found.error).any() == (more > 0.0)


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
    corners, error = model.enclose(np.array([[0.0], [0.5]]), np.array([[0.1], [1.0]])).corners()
    assert np.isnan(error[1]).all()
    assert corners[0].max() + error[0].max() >= 2e307


def test_programs_are_made_once_for_all_parts_of_a_certificate(monkeypatch):
    """Of the same expressions, whichever region asks; of a changed model, anew."""
    made, begin = [], enclosures._Expressions.__init__
    monkeypatch.setattr(
        enclosures._Expressions, "__init__", lambda *given: (made.append(1), begin(*given))[1])
    slope = np.array([[0.8123]])
    system = qpmhe.System(lambda x: x @ slope.T + 0.01 * np.sin(x), lambda x: 1.0 * x, n=1, p=1)
    bound = bound_observer(
        system, qpmhe.Luenberger([[0.2]]), unit_cost(), box(-1.0, 1.0), sizes=Sizes(0.01, 0.01))
    assert bound.inner is not None or bound.invariance is not None
    assert len(made) == 1
    slope[0, 0] = 0.7
    region = Region(box(-1.0, 1.0), np.array([-1.0]), np.array([1.0]))
    model = SmoothModel(system, region)
    assert len(made) == 2
    assert model.jacobians(np.zeros((1, 1)))[0, 0, 0] == pytest.approx(0.71, rel=1e-12)
    assert not model.reason
