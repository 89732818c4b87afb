import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError, ShapeError, WeightError

from . import plain
from .plain import Record, is_minimum, spd
from .spoil import check

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
GAIN = np.array([[0.3, 0.05], [0.1, 0.2]])


def swing(x):
    return np.stack(
        [x[..., 0] + 0.2 * x[..., 1], 0.9 * x[..., 1] - 0.2 * np.sin(x[..., 0])], axis=-1
    )


def seen(x):
    return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1]], axis=-1)


def record(samples, missing=0.0, seed=2):
    """A noisy record with an outlier every now and then."""
    generator = np.random.default_rng(seed)
    x, ys = np.array([1.0, 0.5]), []
    for _ in range(samples):
        y = seen(x) + 0.05 * generator.standard_normal(2)
        y[generator.random(2) < 0.1] += 3.0
        y[generator.random(2) < missing] = np.nan
        ys.append(y)
        x = swing(x) + 0.02 * generator.standard_normal(2)
    return np.array(ys)


# As they are given, and their definitions.
COSTS = {
    "quadratic": ((P, Q, R), (plain.quadratic,) * 3),
    "huber of v": ((P, Q, qpmhe.Huber(R, 0.5)), (plain.quadratic, plain.quadratic,
                                                 plain.huber(0.5))),
    "huber": (
        (qpmhe.Huber(P, 0.1), qpmhe.Huber(Q, 0.2), qpmhe.Huber(R, 0.3)),
        (plain.huber(0.1), plain.huber(0.2), plain.huber(0.3)),
    ),
    "power 1.5": (
        tuple(qpmhe.Power(weight, 1.5) for weight in (P, Q, R)), (plain.power(1.5),) * 3
    ),
    "power 3": (
        tuple(qpmhe.Power(weight, 3.0) for weight in (P, Q, R)), (plain.power(3.0),) * 3
    ),
    "redescending": (
        (P, qpmhe.Cauchy(Q, 0.7, graduation=1.0), qpmhe.GemanMcClure(R, 0.9, graduation=1.0)),
        (plain.quadratic, plain.barron(0.0, 0.7), plain.geman_mcclure(0.9)),
    ),
    "graduated": (
        (P, qpmhe.Cauchy(Q, 0.7), qpmhe.GemanMcClure(R, 0.9, graduation=5.0)),
        (plain.quadratic, plain.barron(0.0, 0.7), plain.geman_mcclure(0.9)),
    ),
    "mixed": (
        (qpmhe.Quadratic(P), qpmhe.Power(Q, 1.2), qpmhe.Huber(np.diag([4.0, 9.0]), 0.4, True)),
        (plain.quadratic, plain.power(1.2), plain.each(plain.huber(0.4))),
    ),
}


def cost_of(name, **options):
    given = dict(zip(("prior", "disturbance", "noise"), COSTS[name][0], strict=True))
    return qpmhe.RobustCost(**given, **options)


def weights_of(name):
    return tuple(getattr(one, "weight", one) for one in COSTS[name][0])


def estimator(cost, **options):
    system = qpmhe.System(swing, seen, n=2, p=2)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost,
        **{"horizon": 5, "initial_state": [0.5, 0.0]} | options,
    )


@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("name", COSTS)
def test_the_cost_is_the_sum_of_the_losses(name, missing, discount):
    mhe = estimator(cost_of(name, discount=discount), max_qps=2)
    kept = Record(
        seen, GAIN, [0.5, 0.0], weights_of(name), 5, discount=discount, losses=COSTS[name][1]
    )
    better = 0
    for y in record(15, missing):
        estimate = mhe.update(y)
        kept.push(swing, y)
        np.testing.assert_allclose(estimate.candidate, kept.candidate, rtol=1e-12, atol=1e-13)
        assert estimate.candidate_cost == pytest.approx(kept.cost(kept.candidate), rel=1e-10)
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        assert estimate.cost <= estimate.candidate_cost
        better += estimate.improved
    assert better >= 12


@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize(
    "name", ["quadratic", "huber of v", "huber", "power 1.5", "mixed", "redescending"]
)
def test_the_converged_estimate_is_stationary(name, discount):
    mhe = estimator(cost_of(name, discount=discount), max_qps=None, tolerance=1e-13)
    kept = Record(
        seen, GAIN, [0.5, 0.0], weights_of(name), 5, discount=discount, losses=COSTS[name][1]
    )
    stationary = []
    for y in record(12):
        estimate = mhe.update(y)
        kept.push(swing, y)
        stationary.append(is_minimum(kept, estimate.trajectory, 1e-3))
    # Where losses have a kink at zero, a minimum may sit on it.
    assert np.mean(stationary) >= (0.5 if name in ("power 1.5", "mixed") else 1.0)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
def test_every_backend_lowers_a_robust_cost(backend):
    mhe = estimator(cost_of("huber"), backend=backend, max_qps=3)
    kept = Record(seen, GAIN, [0.5, 0.0], (P, Q, R), 5, losses=COSTS["huber"][1])
    for y in record(6):
        estimate = mhe.update(y)
        kept.push(swing, y)
        assert estimate.improved
        assert estimate.cost == pytest.approx(kept.cost(estimate.trajectory), rel=1e-10)
        assert estimate.cost < 0.9 * kept.cost(kept.candidate)


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_matrices_stand_for_quadratic_losses(discount):
    weights = {"prior": P, "disturbance": Q, "noise": R, "discount": discount}
    losses = {name: qpmhe.Quadratic(weights[name]) for name in ("prior", "disturbance", "noise")}
    costs = [
        qpmhe.QuadraticCost(**weights), qpmhe.RobustCost(**weights),
        qpmhe.RobustCost(**losses, discount=discount),
    ]
    ys = record(90, 0.1)
    runs = [estimator(cost, max_qps=2).run(ys) for cost in costs]
    for run in runs[1:]:
        np.testing.assert_allclose(run.states, runs[0].states, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(run.costs, runs[0].costs, rtol=1e-9)
        np.testing.assert_allclose(run.candidate_costs, runs[0].candidate_costs, rtol=1e-10)


def test_the_prior_weight_of_an_observer():
    system = qpmhe.System(swing, seen, n=2, p=2)
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=0.1 * np.eye(2), noise=np.eye(2))
    runs = [
        qpmhe.MovingHorizonEstimator(
            system, observer, kind(prior=qpmhe.ObserverPrior(), disturbance=Q, noise=R),
            horizon=4, initial_state=[0.5, 0.0],
        ).run(record(20))
        for kind in (qpmhe.QuadraticCost, qpmhe.RobustCost)
    ]
    np.testing.assert_allclose(runs[0].states, runs[1].states, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(runs[0].costs, runs[1].costs, rtol=1e-9)


def test_an_outlier_moves_a_robust_estimate_less():
    shifts = {}
    for cost in ("quadratic", "huber"):
        clean = record(8, seed=3)
        spoilt = clean.copy()
        spoilt[6] += 50.0
        runs = [
            estimator(cost_of(cost), max_qps=None, horizon=8).run(ys) for ys in (clean, spoilt)
        ]
        shifts[cost] = np.abs(runs[0].states[-1] - runs[1].states[-1]).max()
    assert shifts["huber"] < 0.5 * shifts["quadratic"]


# Parts


@pytest.mark.parametrize("name", COSTS)
def test_majorising_weights_join_those_of_the_terms(name):
    cost, (_, of_w, of_v) = cost_of(name), COSTS[name][1]
    generator = np.random.default_rng(4)
    residuals = generator.standard_normal((20, 4)) * 10.0 ** generator.uniform(-1, 1, (20, 1))
    weights = cost.majorise(residuals, cost.stage_weight)
    assert weights.shape == (20, 4, 4)
    assert not weights[:, :2, 2:].any()
    assert not weights[:, 2:, :2].any()
    _, w_weight, v_weight = weights_of(name)
    for residual, weight in zip(residuals, weights, strict=True):
        slope = plain.differences(
            lambda r, a=w_weight, b=v_weight: of_w(r[:2], a) + of_v(r[2:], b), residual
        )
        np.testing.assert_allclose(2.0 * weight @ residual, slope, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", COSTS)
def test_the_prior_term(name):
    cost, prior = cost_of(name), COSTS[name][1][0]
    for offset in np.random.default_rng(5).standard_normal((10, 2)):
        assert cost.prior_cost(offset, P) == pytest.approx(prior(offset, P), rel=1e-12)
        slope = plain.differences(lambda s: prior(s, P), offset)
        weight = cost.majorise_prior(offset, P)
        np.testing.assert_allclose(2.0 * weight @ offset, slope, rtol=1e-9)
    assert cost.prior_cost(np.zeros(2), P) == 0.0


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
def test_constants_of_equal_exponents(exponent):
    losses = [
        qpmhe.Power(P, exponent), qpmhe.Power(np.diag([1.0, 5.0]), exponent, True),
        qpmhe.Power(R, exponent),
    ]
    cost = qpmhe.RobustCost(prior=losses[0], disturbance=losses[1], noise=losses[2])
    constants = cost.constants
    assert constants.exponent == exponent
    assert [constants.prior, constants.disturbance, constants.noise] == [
        loss.constants() for loss in losses
    ]
    definitions = [
        plain.power(exponent), plain.each(plain.power(exponent)), plain.power(exponent)
    ]
    for s in np.random.default_rng(6).standard_normal((500, 2)):
        size = np.linalg.norm(s) ** exponent
        for loss, definition, (low, high) in zip(
            losses, definitions, (constants.prior, constants.disturbance, constants.noise),
            strict=True,
        ):
            value = definition(s, loss.weight)
            assert low * size * (1 - 1e-9) <= value <= high * size * (1 + 1e-9)


def test_constants_of_matrices_are_those_of_the_quadratic_cost():
    weights = {"prior": P, "disturbance": Q, "noise": R}
    robust, quadratic = qpmhe.RobustCost(**weights), qpmhe.QuadraticCost(**weights)
    assert robust.constants.exponent == 2.0
    for term in ("prior", "disturbance", "noise"):
        np.testing.assert_allclose(
            getattr(robust.constants, term), getattr(quadratic.constants, term), rtol=1e-12
        )


def test_constants_with_the_prior_of_an_observer():
    rule = qpmhe.ObserverPrior(minimum=0.1, maximum=10.0)
    cost = qpmhe.RobustCost(prior=rule, disturbance=Q, noise=R)
    assert cost.constants.prior == (0.1, 10.0)
    powers = {"disturbance": qpmhe.Power(Q, 1.5), "noise": qpmhe.Power(R, 1.5)}
    assert qpmhe.RobustCost(prior=rule, **powers).constants is None


@pytest.mark.parametrize("spoilt", ["prior", "disturbance", "noise"])
@pytest.mark.parametrize("by", ["huber", "exponent"])
def test_there_are_no_constants_without_one_exponent_for_all(spoilt, by):
    weights = {"prior": P, "disturbance": Q, "noise": R}
    assert qpmhe.RobustCost(**weights).constants is not None
    weights[spoilt] = (
        qpmhe.Huber(weights[spoilt]) if by == "huber" else qpmhe.Power(weights[spoilt], 1.5)
    )
    assert qpmhe.RobustCost(**weights).constants is None


def test_all_huber_has_no_constants():
    assert cost_of("huber").constants is None


# Errors


@pytest.mark.parametrize("kind", [qpmhe.QuadraticCost, qpmhe.RobustCost])
@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((value, "expected a ") for value in (0, 0.0, -0.5, math.nan, math.inf, True, "0.9")),
        *((value, "expected a ") for value in (None, [0.9])),
        *((value, "in (0, 1]") for value in (1.0001, 2)),
    ],
)
def test_discounts_out_of_range(kind, value, expected):
    check(
        OptionError, [f"discount is {value!r}", expected],
        lambda: kind(prior=P, disturbance=Q, noise=R, discount=value),
    )


@pytest.mark.parametrize("number", [1, np.float64(0.5), np.float32(0.5), np.int64(1)], ids=repr)
@pytest.mark.parametrize("kind", [qpmhe.QuadraticCost, qpmhe.RobustCost])
def test_discounts_may_be_any_number(kind, number):
    assert kind(prior=P, disturbance=Q, noise=R, discount=number).discount == float(number)


@pytest.mark.parametrize("discount", [0, 1.5])
def test_discounts_of_costs_from_covariances(discount):
    check(
        OptionError, [f"discount is {discount!r}", "expected a "],
        lambda: qpmhe.QuadraticCost.from_covariances(
            prior=P, disturbance=Q, noise=R, discount=discount
        ),
    )


@pytest.mark.parametrize("loss", [np.eye(1), qpmhe.Huber(np.eye(1)), qpmhe.Power(np.eye(1), 1.5)])
def test_a_prior_of_another_size(loss):
    check(
        ShapeError, ["prior has shape (1, 1)", "expected (2, 2)"],
        lambda: qpmhe.RobustCost(prior=loss, disturbance=Q, noise=R),
    )


@pytest.mark.parametrize("name", ["disturbance", "noise"])
def test_only_the_prior_can_come_from_an_observer(name):
    weights = {"prior": P, "disturbance": Q, "noise": R, name: qpmhe.ObserverPrior()}
    check(
        InvalidInputError, [f"{name} is <", "ObserverPrior", "expected a loss or a weight matrix"],
        lambda: qpmhe.RobustCost(**weights),
    )


@pytest.mark.parametrize("name", ["prior", "disturbance", "noise"])
def test_weights_that_are_not_positive_definite(name):
    weights = {"prior": P, "disturbance": Q, "noise": R, name: np.diag([1.0, -1.0])}
    check(
        WeightError, [f"{name} has the eigenvalue -1", "positive definite"],
        lambda: qpmhe.RobustCost(**weights),
    )


def test_a_loss_per_component_refuses_a_correlated_weight_of_one_sample():
    cost = qpmhe.RobustCost(
        prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber(np.eye(2), per_component=True)
    )
    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=2, p=2)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.3 * np.eye(2)), cost, horizon=3, initial_state=[0.0, 0.0]
    )
    with pytest.raises(qpmhe.errors.WeightError, match="diagonal"):
        mhe.update([1.0, 1.0], noise_weight=[[2.0, 1.0], [1.0, 2.0]])
    assert mhe.time == 0
    mhe.update([1.0, 1.0], noise_weight=[[2.0, 0.0], [0.0, 1.0]])
