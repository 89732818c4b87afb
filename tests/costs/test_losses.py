"""Losses by their definitions: values, majorising forms, constants, and graduation."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.costs import Barron, Cauchy, GemanMcClure, Huber, Power, Quadratic
from qpmhe.errors import OptionError, WeightError
from tests.estimation.plain import differences, huber, quadratic, spd
from tests.estimation.same import assert_same
from tests.estimation.spoil import check

DIAGONAL = np.diag([4.0, 0.25, 1.5])
FULL = spd(np.random.default_rng(1), 3)


def power(exponent):
    return lambda s, weight: (s @ weight @ s) ** (exponent / 2.0)


def barron(shape, threshold):
    def loss(s, weight):
        q, square = s @ weight @ s, threshold**2
        if shape == 0.0:
            return 2.0 * square * np.log1p(q / (2.0 * square))
        if shape == -np.inf:
            return -2.0 * square * np.expm1(-q / (2.0 * square))
        width = 2.0 - shape
        rise = np.expm1(np.log1p(q / (square * width)) * shape / 2.0)
        return 2.0 * square * width / shape * rise

    return loss


def each(loss):
    """The loss of every component by itself, added."""
    return lambda s, weight: sum(
        loss(s[j : j + 1], weight[j : j + 1, j : j + 1]) for j in range(len(s))
    )


# Each loss with its definition.
LOSSES = [
    (Quadratic(FULL), quadratic),
    (Huber(DIAGONAL, 0.8, per_component=True), each(huber(0.8))),
    (Power(FULL, 3.0), power(3.0)),
    (Power(2.0 * np.eye(3), 4.0, per_component=True), each(power(4.0))),
    (Power(DIAGONAL, 1.3, per_component=True), each(power(1.3))),
    (Barron(FULL, 1.5, 0.8), barron(1.5, 0.8)),
    (Cauchy(FULL, 0.5).widened(3.0), barron(0.0, 1.5)),
    (GemanMcClure(FULL), barron(-2.0, 1.894)),
    (GemanMcClure(DIAGONAL, 0.5, per_component=True).widened(2.0), each(barron(-2.0, 1.0))),
    (Barron(FULL, -5.0, 1.0), barron(-5.0, 1.0)),
    (Barron(FULL, -math.inf, 0.5).widened(3.0), barron(-math.inf, 1.5)),
]


def points(count, seed=2):
    """Residuals of all sizes, on both sides of any threshold."""
    generator = np.random.default_rng(seed)
    sizes = 10.0 ** generator.uniform(-2.0, 2.0, (count, 1))
    return sizes * generator.standard_normal((count, 3))


@pytest.mark.parametrize("mask", [[True] * 3, [True, False, True], [False] * 3], ids=str)
def test_values_and_their_derivatives(mask):
    s, seen = points(12) * mask, np.ix_(mask, mask)
    for loss, definition in LOSSES:
        weight = np.zeros((3, 3))
        weight[seen] = np.linalg.inv(np.linalg.inv(loss.weight)[seen])
        one_each = weight * np.linspace(0.5, 2.0, 12)[:, None, None]
        for given, several in ((weight, [weight] * 12), (one_each, one_each)):
            expected = [definition(row, w) for row, w in zip(s, several, strict=True)]
            np.testing.assert_allclose(
                loss.cost(s, given), expected, rtol=1e-12, err_msg=repr(loss)
            )
        assert not loss.cost(0.0 * s, weight).any()
        assert np.isfinite(loss.majorise(0.0 * s, weight)).all()
        # The majorising weights carry half the derivative.
        weights = loss.majorise(s, weight)
        np.testing.assert_allclose(weights, np.swapaxes(weights, 1, 2), rtol=1e-13)
        for row, majorising in zip(s, weights, strict=True):
            assert np.linalg.eigvalsh(majorising)[0] >= -1e-12 * np.abs(majorising).max()
            slope = np.zeros(3)
            if any(mask):
                slope = differences(lambda x, d=definition, w=weight: d(x, w), row)
            atol = 1e-9 * np.abs(slope).max() + 1e-250  # as the differences underflow
            np.testing.assert_allclose(
                2.0 * majorising @ row, slope, rtol=1e-9, atol=atol, err_msg=repr(loss)
            )


def test_majorising_forms_lie_above_the_loss():
    near, far = points(200, 3), points(200, 4)
    # Also along one ray, and on both sides of zero, where the forms touch or nearly do.
    along = near * np.random.default_rng(5).uniform(-2.0, 2.0, (200, 1))
    for loss, _ in LOSSES:
        if (loss.exponent or 0.0) > 2.0:  # grows faster than any form
            continue
        weights, value = loss.majorise(near, loss.weight), loss.cost(near, loss.weight)
        form = np.einsum("ki,kij,kj->k", near, weights, near)
        for other in (far, along, -near, np.zeros_like(near)):
            higher = value + np.einsum("ki,kij,kj->k", other, weights, other) - form
            slack = 1e-12 * (np.abs(form) + np.abs(value) + np.abs(higher))
            assert (loss.cost(other, loss.weight) <= higher + slack).all(), loss


def test_constants_bound_the_loss():
    for loss, definition in LOSSES:
        if not isinstance(loss, (Quadratic, Power)):
            assert (loss.constants(), loss.exponent) == (None, None)
            continue
        low, high = loss.constants()
        extreme = np.vstack([np.linalg.eigh(loss.weight)[1].T, np.ones((1, 3)), points(500)])
        ratios = [definition(s, loss.weight) / np.linalg.norm(s) ** loss.exponent for s in extreme]
        assert 0.0 < low * (1 - 1e-9) <= min(ratios), loss
        assert max(ratios) <= high * (1 + 1e-9), loss
        if not loss.per_component or np.ptp(loss.weight.diagonal()) == 0.0:
            assert (min(ratios), max(ratios)) == pytest.approx((low, high)), loss


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


def test_what_is_no_loss_is_refused():
    small, dense = np.diag([1.0, 2.0]), [[2.0, 0.5], [0.5, 1.0]]
    for loss in (Huber, Cauchy, GemanMcClure):
        check(WeightError, ["weight has the eigenvalue -1", "definite"], loss, -np.eye(2))
        text = ["weight is [[2.0, 0.5], [0.5, 1.0]]", "diagonal weight", "independent"]
        check(WeightError, text, loss, dense, per_component=True)
    for name, build in (
        ("threshold", lambda value: Huber(small, value)),
        ("exponent", lambda value: Power(small, value)),
        ("graduation", lambda value: Cauchy(small, graduation=value)),
    ):
        for value in (0, math.inf, True, "1"):
            check(OptionError, [f"{name} is {value!r}", "finite number > 0"], build, value)
    for value in (2.1, math.inf, True, "1"):
        text = [f"shape is {value!r}", "a number <= 2", "-math.inf"]
        check(OptionError, text, Barron, small, value, 1.0)
    for shape, value in ((0.0, 0.5), (1.0, 2.0)):
        text = [f"graduation is {value!r}", f"the shape {shape!r}", "expected 1, or a larger"]
        check(OptionError, text, Barron, small, shape, 1.0, graduation=value)


# Graduation: five sensors of one state, of which two see a reflection that is 4 away.
STATES = 3.0 * 0.98 ** np.arange(31)
Y = STATES[:-1, None] + 0.1 * np.random.default_rng(0).standard_normal((30, 5))
Y[:, :2] += 4.0


def estimator(start, graduation=50.0, max_qps=3):
    noise = GemanMcClure(100.0 * np.eye(5), per_component=True, graduation=graduation)
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: 0.98 * x, lambda x: np.full(5, 1.0) * x[0], n=1, p=5),
        qpmhe.Luenberger(np.zeros((1, 5))),
        qpmhe.RobustCost(prior=1e-4, disturbance=1e4, noise=noise),
        horizon=8, initial_state=[start], warm_start=True, max_qps=max_qps, engine="python",
    )


@pytest.mark.parametrize("max_qps", [1, None])
def test_widened_losses_lead_to_the_sensors_that_agree_from_any_start(max_qps):
    mhe = estimator(7.0, max_qps=max_qps)
    for start in (-10.0, 7.0, 40.0):
        mhe.reset([start])
        run = mhe.run(Y)
        assert np.abs(run.states[10:, 0] - STATES[10:]).max() < 0.3
        assert [Status.GRADUATED in one for one in run.statuses] == [True] * 7 + [False] * 23
        assert ["widened" in one.explain() for one in run.statuses[6:8]] == [True, False]
    run = estimator(7.0, 1.0, max_qps).run(Y)  # without them, the start decides
    assert np.abs(run.states[10:, 0] - STATES[10:]).min() > 1.5


def test_the_surrogate_goes_on_where_the_candidate_is_the_estimate():
    """In a basin that costs less at first, a candidate hides the trajectory that is followed."""
    mhe, other = (estimator(float(Y[0, :2].mean()), max_qps=2) for _ in range(2))
    kept = []
    for y in Y[:4]:
        kept.append(mhe.update(y))
        np.testing.assert_array_equal(mhe.state, kept[-1].state)
    other.load_state_dict(mhe.state_dict())
    for y in Y[4:20]:
        kept.append(mhe.update(y))
        assert_same(other.update(y), kept[-1])
    assert any(Status.CANDIDATE in estimate.status for estimate in kept[:7])
    assert np.abs(kept[-1].state - STATES[20]).max() < 0.3


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_a_search_that_ends_at_once_does_not_take_the_candidate_for_a_find(engine):
    """Corrections leave the directions of G, so that J of the candidate is that of a roll-out."""
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    g = np.array([[1.0], [0.02]])

    def model(x):
        return np.stack([0.9 * x[..., 0] + 0.1 * x[..., 1],
                         0.8 * x[..., 1] + 0.1 * np.sin(x[..., 0])], -1)

    system = qpmhe.System(model, lambda x: x[..., :1], n=2, p=1, disturbance_matrix=g)
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=[[500.0]], noise=qpmhe.GemanMcClure([[10.0]])
    )
    observer = qpmhe.Luenberger([[0.2], [0.3]])
    rng = np.random.default_rng(0)
    for budget in (1e-12, 1.0):
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=12, initial_state=[1.0, 0.0], engine=engine,
            max_qps=2, time_budget=budget,
        )
        assert mhe.engine == engine
        improved = 0
        for t in range(14):
            estimate = mhe.update(np.sin(0.3 * t) + rng.normal(size=1))
            if estimate.improved:
                improved += 1
                ahead = estimate.trajectory[1:] - model(estimate.trajectory[:-1])
                np.testing.assert_allclose(ahead, estimate.disturbances @ g.T, atol=1e-12)
        assert bool(improved) == (budget == 1.0)
