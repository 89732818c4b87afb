import itertools
import math

import numpy as np
import pytest

import qpmhe
from qpmhe.costs import Barron, Cauchy, GemanMcClure, Huber, Power, Quadratic
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from . import plain
from .plain import spd
from .spoil import check

DIAGONAL = np.diag([4.0, 0.25, 1.5])
FULL = spd(np.random.default_rng(1), 3)

# Each loss with its definition; the third entry says whether quadratic forms lie above it.
LOSSES = {
    "quadratic": (Quadratic(FULL), plain.quadratic, True),
    "huber": (Huber(FULL), plain.huber(1.345), True),
    "huber of 0.3": (Huber(FULL, 0.3), plain.huber(0.3), True),
    "huber each": (
        Huber(DIAGONAL, 0.8, per_component=True), plain.each(plain.huber(0.8)), True
    ),
    "power 1": (Power(FULL, 1), plain.power(1.0), True),
    "power 1.5": (Power(FULL, 1.5), plain.power(1.5), True),
    "power 2": (Power(FULL, 2.0), plain.power(2.0), True),
    "power 3": (Power(FULL, 3.0), plain.power(3.0), False),
    "power 1 each": (
        Power(DIAGONAL, 1.0, per_component=True), plain.each(plain.power(1.0)), True
    ),
    "power 1.3 each": (
        Power(DIAGONAL, 1.3, per_component=True), plain.each(plain.power(1.3)), True
    ),
    "power 4 each": (
        Power(DIAGONAL, 4.0, per_component=True), plain.each(plain.power(4.0)), False
    ),
    "barron 1.5": (Barron(FULL, 1.5, 0.8), plain.barron(1.5, 0.8), True),
    "barron 2": (Barron(FULL, 2.0, 0.8), plain.quadratic, True),
    "cauchy": (Cauchy(FULL), plain.barron(0.0, 1.686), True),
    "cauchy each": (
        Cauchy(DIAGONAL, 0.7, per_component=True), plain.each(plain.barron(0.0, 0.7)), True
    ),
    "geman-mcclure": (GemanMcClure(FULL), plain.geman_mcclure(1.894), True),
    "geman-mcclure each": (
        GemanMcClure(DIAGONAL, 0.5, per_component=True), plain.each(plain.geman_mcclure(0.5)), True
    ),
    "barron -5": (Barron(FULL, -5.0, 1.0), plain.barron(-5.0, 1.0), True),
    "welsch": (Barron(FULL, -math.inf, 1.5), plain.barron(-math.inf, 1.5), True),
    "widened": (Cauchy(FULL, 0.5).widened(3.0), plain.barron(0.0, 1.5), True),
}
REDESCENDING = [
    name for name, (loss, *_) in LOSSES.items() if isinstance(loss, Barron) and loss.shape < 1.0
]
MAJORISED = [name for name, (_, _, above) in LOSSES.items() if above]
WITH_CONSTANTS = [name for name in LOSSES if "quadratic" in name or "power" in name]


def points(count, seed=2):
    """Residuals of all sizes, on both sides of any threshold."""
    generator = np.random.default_rng(seed)
    sizes = 10.0 ** generator.uniform(-2.0, 2.0, (count, 1))
    return sizes * generator.standard_normal((count, 3))


def partial(weight, seen):
    seen = np.array(seen)
    reduced = np.zeros_like(weight)
    block = np.linalg.inv(weight)[np.ix_(seen, seen)]
    reduced[np.ix_(seen, seen)] = np.linalg.inv(block)
    return reduced


MASKS = [mask for mask in itertools.product([True, False], repeat=3) if any(mask)]


@pytest.mark.parametrize("mask", MASKS, ids=lambda mask: "".join("xo"[b] for b in mask))
@pytest.mark.parametrize("name", LOSSES)
def test_values(name, mask):
    loss, definition, _ = LOSSES[name]
    weight = partial(loss.weight, mask)
    s = points(50) * mask
    expected = [definition(row, weight) for row in s]
    np.testing.assert_allclose(loss.cost(s, weight), expected, rtol=1e-12)
    one_each = np.broadcast_to(weight, (50, 3, 3)) * np.linspace(0.5, 2.0, 50)[:, None, None]
    expected = [definition(row, w) for row, w in zip(s, one_each, strict=True)]
    np.testing.assert_allclose(loss.cost(s, one_each), expected, rtol=1e-12)


@pytest.mark.parametrize("name", LOSSES)
def test_nothing_costs_nothing(name):
    loss = LOSSES[name][0]
    np.testing.assert_array_equal(loss.cost(np.zeros((2, 3)), loss.weight), [0.0, 0.0])
    np.testing.assert_array_equal(loss.cost(points(2), np.zeros((3, 3))), [0.0, 0.0])
    assert not loss.majorise(points(2), np.zeros((3, 3))).any()
    assert np.isfinite(loss.majorise(np.zeros((1, 3)), loss.weight)).all()


@pytest.mark.parametrize("mask", [(True, True, True), (True, False, True)], ids=["all", "some"])
@pytest.mark.parametrize("name", LOSSES)
def test_majorising_weights_carry_half_the_derivative(name, mask):
    loss, definition, _ = LOSSES[name]
    weight = partial(loss.weight, mask)
    s = points(40) * mask
    weights = loss.majorise(s, weight)
    assert weights.shape == (40, 3, 3)
    np.testing.assert_allclose(weights, np.swapaxes(weights, 1, 2), rtol=1e-13)
    for row, majorising in zip(s, weights, strict=True):
        assert np.linalg.eigvalsh(majorising)[0] >= -1e-12 * np.abs(majorising).max()
        slope = plain.differences(lambda x, w=weight: definition(x, w), row)
        scale = np.abs(slope).max()
        np.testing.assert_allclose(2.0 * majorising @ row, slope, rtol=1e-9, atol=1e-9 * scale)


@pytest.mark.parametrize("name", MAJORISED)
def test_majorising_forms_lie_above_the_loss(name):
    loss = LOSSES[name][0]
    near, far = points(200, 3), points(200, 4)
    # Also along one ray, and on both sides of zero, where the forms touch or nearly do.
    along = near * np.random.default_rng(5).uniform(-2.0, 2.0, (200, 1))
    weights = loss.majorise(near, loss.weight)
    value, form = loss.cost(near, loss.weight), plain_forms(near, weights)
    for other in (far, along, -near, np.zeros_like(near)):
        above = value + plain_forms(other, weights) - form
        cost = loss.cost(other, loss.weight)
        slack = 1e-12 * (np.abs(form) + np.abs(value) + np.abs(above))
        assert (cost <= above + slack).all()


def plain_forms(s, weights):
    return np.array([row @ weight @ row for row, weight in zip(s, weights, strict=True)])


@pytest.mark.parametrize("name", ["power 3", "power 4 each"])
def test_above_the_exponent_two_a_form_cannot_lie_above(name):
    loss = LOSSES[name][0]
    near = points(1)
    weights = loss.majorise(near, loss.weight)
    change = plain_forms(10.0 * near, weights) - plain_forms(near, weights)
    assert loss.cost(10.0 * near, loss.weight) > loss.cost(near, loss.weight) + change


@pytest.mark.parametrize("name", [name for name in LOSSES if name not in REDESCENDING])
def test_losses_are_convex_and_even(name):
    loss = LOSSES[name][0]
    one, other = points(200, 6), points(200, 7)
    share = np.random.default_rng(8).random((200, 1))
    between = loss.cost(share * one + (1.0 - share) * other, loss.weight)
    chord = share[:, 0] * loss.cost(one, loss.weight)
    chord += (1.0 - share[:, 0]) * loss.cost(other, loss.weight)
    assert (between <= chord * (1.0 + 1e-12)).all()
    np.testing.assert_array_equal(loss.cost(-one, loss.weight), loss.cost(one, loss.weight))


@pytest.mark.parametrize("name", WITH_CONSTANTS)
def test_constants_bound_the_loss(name):
    loss, definition, _ = LOSSES[name]
    low, high = loss.constants()
    assert 0.0 < low <= high
    extreme = np.vstack([np.linalg.eigh(loss.weight)[1].T, np.ones((1, 3)), np.eye(3)])
    ratios = [
        definition(s, loss.weight) / np.linalg.norm(s) ** loss.exponent
        for s in np.vstack([points(3000), extreme])
    ]
    assert low * (1 - 1e-9) <= min(ratios)
    assert max(ratios) <= high * (1 + 1e-9)
    if not loss.per_component:
        assert min(ratios) == pytest.approx(low)
        assert max(ratios) == pytest.approx(high)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
def test_constants_of_equal_components_are_attained(exponent):
    low, high = Power(2.0 * np.eye(4), exponent, per_component=True).constants()
    ratios = [
        sum((2.0 * s**2) ** (exponent / 2.0)) / np.linalg.norm(s) ** exponent
        for s in (np.ones(4), np.eye(4)[0])
    ]
    assert low == pytest.approx(min(ratios))
    assert high == pytest.approx(max(ratios))


def test_huber_has_no_constants():
    assert Huber(FULL).constants() is None
    assert Huber(FULL).exponent is None
    assert Huber(DIAGONAL, per_component=True).constants() is None


@pytest.mark.parametrize("name", [*REDESCENDING, "barron 1.5"])
def test_barrons_losses_have_no_constants(name):
    loss = LOSSES[name][0]
    assert loss.constants() is None
    assert loss.exponent is None


@pytest.mark.parametrize("name", REDESCENDING)
def test_the_weight_of_an_outlier_goes_to_zero_and_near_zero_it_is_the_given_one(name):
    loss = LOSSES[name][0]
    direction = np.array([[1.0, -0.5, 2.0]])
    far = loss.majorise(1e6 * direction, loss.weight)[0]
    assert np.abs(far).max() <= 1e-9 * np.abs(loss.weight).max()
    near = loss.majorise(1e-6 * direction, loss.weight)[0]
    np.testing.assert_allclose(near, loss.weight, rtol=1e-9, atol=1e-12)
    farther = loss.cost(np.array([[1.0], [1e3]]) * direction, loss.weight)
    assert farther[1] - farther[0] < 40.0 * farther[0]  # a quadratic loss: a million times


@pytest.mark.parametrize("kind", [Cauchy, GemanMcClure, lambda W, c: Barron(W, -math.inf, c)])
def test_a_widened_loss_has_a_larger_threshold(kind):
    s = points(100)
    for factor in (1.0, 2.0, 37.0):
        wide, large = kind(FULL, 1.2).widened(factor), kind(FULL, 1.2 * factor)
        np.testing.assert_allclose(wide.cost(s, FULL), large.cost(s, FULL), rtol=1e-12)
        np.testing.assert_allclose(wide.majorise(s, FULL), large.majorise(s, FULL), rtol=1e-12)


@pytest.mark.parametrize(("kind", "default"), [("cauchy", Cauchy), ("geman", GemanMcClure)])
def test_default_thresholds_keep_95_percent_of_the_efficiency(kind, default):
    """The asymptotic variance of a location's estimate from normal noise of variance 1."""
    one = np.eye(1)
    x, dx = np.linspace(-12.0, 12.0, 200001, retstep=True)
    density = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    influence = default(one).majorise(x[:, None], one)[:, 0, 0] * x
    slope = np.gradient(influence, x)
    efficiency = (slope @ density * dx) ** 2 / (influence**2 @ density * dx)
    assert efficiency == pytest.approx(0.95, abs=2e-4)


def test_huber_is_smooth_at_its_threshold():
    loss = Huber([[4.0]], 0.6)
    at = np.array([[0.3], [-0.3]])
    np.testing.assert_allclose(loss.cost(at, loss.weight), [0.36, 0.36], rtol=1e-12)
    for side in (1.0 - 1e-9, 1.0 + 1e-9):
        np.testing.assert_allclose(loss.cost(side * at, loss.weight), [0.36, 0.36], rtol=1e-8)
        np.testing.assert_allclose(loss.majorise(side * at, loss.weight), [[[4.0]]] * 2, rtol=1e-8)
    # Beyond it the loss grows by a constant slope.
    far = loss.cost(np.array([[10.0], [20.0], [30.0]]), loss.weight)
    assert far[1] - far[0] == pytest.approx(far[2] - far[1]) == pytest.approx(2 * 0.6 * 2 * 10)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0])
def test_the_weight_of_a_power_is_bounded_at_zero(exponent):
    loss = Power(FULL, exponent)
    at_zero, near = loss.majorise(np.array([np.zeros(3), np.full(3, 1e-7)]), FULL)
    np.testing.assert_allclose(at_zero, exponent / 2 * 1e-8 ** (exponent / 2 - 1) * FULL)
    np.testing.assert_array_equal(near, at_zero)


# Errors

SMALL = np.diag([1.0, 2.0])
KINDS = {
    "quadratic": Quadratic,
    "huber": Huber,
    "power": lambda weight, **more: Power(weight, 1.5, **more),
    "barron": lambda weight, **more: Barron(weight, 0.5, 1.0, **more),
    "cauchy": Cauchy,
    "geman-mcclure": GemanMcClure,
}


@pytest.mark.parametrize(
    ("weight", "kind", "fragments"),
    [
        (-np.eye(2), WeightError, ["weight has the eigenvalue -1", "positive definite"]),
        (np.ones((2, 2)), WeightError, ["weight has the eigenvalue", "positive definite"]),
        ([[1.0, 0.5], [0.0, 1.0]], WeightError, ["weight is not symmetric", "0.5"]),
        (np.ones((2, 3)), ShapeError, ["weight has shape (2, 3)", "square"]),
        ([[math.nan]], InvalidInputError, ["weight is [[nan]]", "finite"]),
        ("heavy", InvalidInputError, ["weight is 'heavy'", "real numbers"]),
    ],
)
@pytest.mark.parametrize("loss", KINDS)
def test_weights_of_losses(loss, weight, kind, fragments):
    check(kind, fragments, lambda: KINDS[loss](weight))


@pytest.mark.parametrize("loss", ["huber", "power", "barron", "cauchy", "geman-mcclure"])
def test_a_loss_per_component_needs_a_diagonal_weight(loss):
    KINDS[loss](SMALL, per_component=True)
    check(
        WeightError, ["weight is [[2.0, 0.5], [0.5, 1.0]]", "diagonal weight", "independent"],
        lambda: KINDS[loss]([[2.0, 0.5], [0.5, 1.0]], per_component=True),
    )


@pytest.mark.parametrize("value", [0, -1.0, math.nan, math.inf, True, "1", None])
def test_thresholds_out_of_range(value):
    check(
        OptionError, [f"threshold is {value!r}", "finite number > 0"], lambda: Huber(SMALL, value)
    )


@pytest.mark.parametrize("value", [2.1, math.inf, math.nan, True, "1", None, 1j])
def test_shapes_out_of_range(value):
    check(
        OptionError, [f"shape is {value!r}", "a number <= 2", "-math.inf"],
        lambda: Barron(SMALL, value, 1.0),
    )


@pytest.mark.parametrize("value", [0, -1.0, math.nan, math.inf, True, "1", None])
def test_graduations_that_are_no_positive_number(value):
    check(
        OptionError, [f"graduation is {value!r}", "finite number > 0"],
        lambda: Cauchy(SMALL, graduation=value),
    )


@pytest.mark.parametrize(("shape", "value"), [(0.0, 0.5), (1.0, 2.0), (2.0, 10.0)])
def test_graduations_out_of_range(shape, value):
    check(
        OptionError,
        [f"graduation is {value!r}", f"the shape {shape!r}", "expected 1, or a larger"],
        lambda: Barron(SMALL, shape, 1.0, graduation=value),
    )


@pytest.mark.parametrize("value", [0, -1.0, math.nan, math.inf, True, "1", None])
def test_exponents_that_are_no_positive_number(value):
    check(
        OptionError, [f"exponent is {value!r}", "finite number > 0"], lambda: Power(SMALL, value)
    )


@pytest.mark.parametrize("value", [0.5, 0.999])
def test_exponents_without_convexity(value):
    check(
        OptionError, [f"exponent is {value!r}", "a number >= 1", "convexity"],
        lambda: Power(SMALL, value),
    )


def test_weights_of_losses_are_copies():
    given = np.eye(2)
    loss = qpmhe.Huber(given)
    given[0, 0] = 9.0
    np.testing.assert_array_equal(loss.weight, np.eye(2))
