"""Losses: their values, the forms that lie above them, their constants, and what they refuse."""

import itertools
import math

import numpy as np
import pytest

from qpmhe.costs import Barron, Cauchy, GemanMcClure, Huber, Power, Quadratic
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from . import plain
from .plain import spd
from .spoil import check

DIAGONAL = np.diag([4.0, 0.25, 1.5])
FULL = spd(np.random.default_rng(1), 3)
EQUAL = 2.0 * np.eye(3)
# Each loss with its definition; the third entry says whether quadratic forms lie above it.
LOSSES = [
    (Quadratic(FULL), plain.quadratic, True),
    (Huber(FULL), plain.huber(1.345), True),
    (Huber(DIAGONAL, 0.8, per_component=True), plain.each(plain.huber(0.8)), True),
    (Power(FULL, 1), plain.power(1.0), True),
    (Power(FULL, 1.5), plain.power(1.5), True),
    (Power(FULL, 3.0), plain.power(3.0), False),
    (Power(EQUAL, 1.0, per_component=True), plain.each(plain.power(1.0)), True),
    (Power(DIAGONAL, 1.3, per_component=True), plain.each(plain.power(1.3)), True),
    (Power(EQUAL, 4.0, per_component=True), plain.each(plain.power(4.0)), False),
    (Barron(FULL, 1.5, 0.8), plain.barron(1.5, 0.8), True),
    (Barron(FULL, 2.0, 0.8), plain.quadratic, True),
    (Cauchy(FULL), plain.barron(0.0, 1.686), True),
    (Cauchy(DIAGONAL, 0.7, per_component=True), plain.each(plain.barron(0.0, 0.7)), True),
    (GemanMcClure(FULL), plain.geman_mcclure(1.894), True),
    (GemanMcClure(DIAGONAL, 0.5, per_component=True), plain.each(plain.geman_mcclure(0.5)), True),
    (Barron(FULL, -5.0, 1.0), plain.barron(-5.0, 1.0), True),
    (Barron(FULL, -math.inf, 1.5), plain.barron(-math.inf, 1.5), True),
    (Cauchy(FULL, 0.5).widened(3.0), plain.barron(0.0, 1.5), True),
]
MASKS = list(itertools.product([True, False], repeat=3))


def points(count, seed=2):
    """Residuals of all sizes, on both sides of any threshold."""
    generator = np.random.default_rng(seed)
    sizes = 10.0 ** generator.uniform(-2.0, 2.0, (count, 1))
    return sizes * generator.standard_normal((count, 3))


def partial(weight, seen):
    reduced, seen = np.zeros_like(weight), np.array(seen)
    block = np.linalg.inv(weight)[np.ix_(seen, seen)]
    reduced[np.ix_(seen, seen)] = np.linalg.inv(block)
    return reduced


def test_values_and_their_derivatives():
    for (loss, definition, _), mask in itertools.product(LOSSES, MASKS):
        s, weight = points(12) * mask, np.zeros((3, 3))
        if any(mask):
            weight = partial(loss.weight, mask)
        one_each = weight * np.linspace(0.5, 2.0, 12)[:, None, None]
        for given, each in ((weight, [weight] * 12), (one_each, one_each)):
            expected = [definition(row, w) for row, w in zip(s, each, strict=True)]
            np.testing.assert_allclose(
                loss.cost(s, given), expected, rtol=1e-12, err_msg=repr(loss)
            )
        # The majorising weights carry half the derivative.
        weights = loss.majorise(s, weight)
        np.testing.assert_allclose(weights, np.swapaxes(weights, 1, 2), rtol=1e-13)
        for row, majorising in zip(s, weights, strict=True):
            assert np.linalg.eigvalsh(majorising)[0] >= -1e-12 * np.abs(majorising).max()
            slope = np.zeros(3)
            if any(mask):
                slope = plain.differences(lambda x, d=definition, w=weight: d(x, w), row)
            atol = 1e-9 * np.abs(slope).max() + 1e-250  # as the differences underflow
            np.testing.assert_allclose(
                2.0 * majorising @ row, slope, rtol=1e-9, atol=atol, err_msg=repr(loss)
            )
        zeros = np.zeros((1, 3))
        assert loss.cost(zeros, weight) == [0.0]
        assert np.isfinite(loss.majorise(zeros, weight)).all()


def forms(s, weights):
    return np.array([row @ weight @ row for row, weight in zip(s, weights, strict=True)])


def test_majorising_forms_lie_above_the_loss():
    near, far = points(200, 3), points(200, 4)
    # Also along one ray, and on both sides of zero, where the forms touch or nearly do.
    along = near * np.random.default_rng(5).uniform(-2.0, 2.0, (200, 1))
    for loss, _, above in LOSSES:
        weights = loss.majorise(near, loss.weight)
        value, form = loss.cost(near, loss.weight), forms(near, weights)
        if not above:  # as the loss grows faster than any form
            higher = value + forms(10.0 * near, weights) - form
            assert (loss.cost(10.0 * near, loss.weight) > higher).all(), loss
            continue
        for other in (far, along, -near, np.zeros_like(near)):
            higher = value + forms(other, weights) - form
            slack = 1e-12 * (np.abs(form) + np.abs(value) + np.abs(higher))
            assert (loss.cost(other, loss.weight) <= higher + slack).all(), loss


def test_shapes():
    one, other, direction = points(200, 6), points(200, 7), np.array([[1.0, -0.5, 2.0]])
    share = np.random.default_rng(8).random(200)
    between = share[:, None] * one + (1.0 - share[:, None]) * other
    for loss, *_ in LOSSES:
        cost = loss.cost(one, loss.weight)
        np.testing.assert_array_equal(loss.cost(-one, loss.weight), cost)
        if not isinstance(loss, Barron) or loss.shape >= 1.0:
            chord = share * cost + (1.0 - share) * loss.cost(other, loss.weight)
            assert (loss.cost(between, loss.weight) <= chord * (1.0 + 1e-12)).all(), loss
            continue
        # The weight of an outlier goes to zero, and near zero it is the given one.
        far = loss.majorise(1e6 * direction, loss.weight)[0]
        assert np.abs(far).max() <= 1e-9 * np.abs(loss.weight).max(), loss
        near = loss.majorise(1e-6 * direction, loss.weight)[0]
        np.testing.assert_allclose(near, loss.weight, rtol=1e-9, atol=1e-12)
        far, farther = loss.cost(np.array([[1.0], [1e3]]) * direction, loss.weight)
        assert farther < 41.0 * far, loss  # a quadratic loss: a million times


def test_constants_bound_the_loss():
    for loss, definition, _ in LOSSES:
        if not isinstance(loss, (Quadratic, Power)):
            assert loss.constants() is None
            assert loss.exponent is None
            continue
        low, high = loss.constants()
        extreme = np.vstack([np.linalg.eigh(loss.weight)[1].T, np.ones((1, 3)), np.eye(3)])
        ratios = [
            definition(s, loss.weight) / np.linalg.norm(s) ** loss.exponent
            for s in np.vstack([points(500), extreme])
        ]
        assert 0.0 < low * (1 - 1e-9) <= min(ratios), loss
        assert max(ratios) <= high * (1 + 1e-9), loss
        if not loss.per_component or np.ptp(loss.weight.diagonal()) == 0.0:
            assert (min(ratios), max(ratios)) == pytest.approx((low, high)), loss


def test_the_weight_of_a_power_is_bounded_at_zero():
    for exponent in (1.0, 1.5, 2.0):
        at_zero, near = Power(FULL, exponent).majorise(np.array([[0.0] * 3, [1e-7] * 3]), FULL)
        np.testing.assert_allclose(at_zero, exponent / 2 * 1e-8 ** (exponent / 2 - 1) * FULL)
        np.testing.assert_array_equal(near, at_zero)


def test_a_widened_loss_has_a_larger_threshold():
    s = points(100)
    for kind in (Cauchy, GemanMcClure, lambda W, c: Barron(W, -math.inf, c)):
        for factor in (1.0, 2.0, 37.0):
            wide, large = kind(FULL, 1.2).widened(factor), kind(FULL, 1.2 * factor)
            np.testing.assert_allclose(wide.cost(s, FULL), large.cost(s, FULL), rtol=1e-12)
            np.testing.assert_allclose(wide.majorise(s, FULL), large.majorise(s, FULL), rtol=1e-12)


@pytest.mark.parametrize("default", [Cauchy, GemanMcClure])
def test_default_thresholds_keep_95_percent_of_the_efficiency(default):
    """The asymptotic variance of a location's estimate from normal noise of variance 1."""
    one = np.eye(1)
    x, dx = np.linspace(-12.0, 12.0, 200001, retstep=True)
    density = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    influence = default(one).majorise(x[:, None], one)[:, 0, 0] * x
    slope = np.gradient(influence, x)
    efficiency = (slope @ density * dx) ** 2 / (influence**2 @ density * dx)
    assert efficiency == pytest.approx(0.95, abs=2e-4)


# Errors

SMALL = np.diag([1.0, 2.0])
KINDS = [
    Huber, lambda weight, **more: Power(weight, 1.5, **more), Cauchy, GemanMcClure,
    lambda weight, **more: Barron(weight, 0.5, 1.0, **more),
]


def test_weights_of_losses():
    for weight, kind, text in (
        (-np.eye(2), WeightError, ["weight has the eigenvalue -1", "positive definite"]),
        ([[1.0, 0.5], [0.0, 1.0]], WeightError, ["weight is not symmetric", "0.5"]),
        (np.ones((2, 3)), ShapeError, ["weight has shape (2, 3)", "square"]),
        ([[math.nan]], InvalidInputError, ["weight is [[nan]]", "finite"]),
        ("heavy", InvalidInputError, ["weight is 'heavy'", "real numbers"]),
    ):
        for loss in (Quadratic, *KINDS):
            check(kind, text, loss, weight)
    text = ["weight is [[2.0, 0.5], [0.5, 1.0]]", "diagonal weight", "independent"]
    for loss in KINDS:
        loss(SMALL, per_component=True)
        check(WeightError, text, loss, [[2.0, 0.5], [0.5, 1.0]], per_component=True)
    given = np.eye(2)
    loss = Huber(given)
    given[0, 0] = 9.0  # a copy is kept
    np.testing.assert_array_equal(loss.weight, np.eye(2))


def test_options_of_losses():
    for name, build in (
        ("threshold", lambda value: Huber(SMALL, value)),
        ("exponent", lambda value: Power(SMALL, value)),
        ("graduation", lambda value: Cauchy(SMALL, graduation=value)),
    ):
        for value in (0, -1.0, math.nan, math.inf, True, "1", None):
            check(OptionError, [f"{name} is {value!r}", "finite number > 0"], build, value)
    for value in (2.1, math.inf, math.nan, True, "1", None, 1j):
        text = [f"shape is {value!r}", "a number <= 2", "-math.inf"]
        check(OptionError, text, Barron, SMALL, value, 1.0)
    for shape, value in ((0.0, 0.5), (1.0, 2.0), (2.0, 10.0)):
        text = [f"graduation is {value!r}", f"the shape {shape!r}", "expected 1, or a larger"]
        check(OptionError, text, Barron, SMALL, shape, 1.0, graduation=value)
    text = ["exponent is 0.999", "a number >= 1", "convexity"]
    check(OptionError, text, Power, SMALL, 0.999)
