"""Disturbances of lower dimension than the state, and singular covariances."""

import numpy as np
import pytest
from scipy.optimize import minimize

import qpmhe
from qpmhe import Status
from qpmhe.certificates import CertificateError
from qpmhe.certificates.audit import checked_ingredients
from qpmhe.errors import (
    InvalidInputError,
    ModelError,
    SetError,
    ShapeError,
    WeightError,
)

from .spoil import check

A = np.array([[1.0, 0.1, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.8]])
C = np.array([[1.0, 0.0, 0.5]])
G = np.array([[0.1, 0.0], [1.0, 0.3], [0.0, 1.0]])
P, Q, R = np.diag([1.0, 2.0, 0.5]), np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[0.1]])
GAIN = np.array([[0.3], [0.2], [0.1]])


def f(x):
    return x @ A.T + 0.05 * np.sin(x)


def h(x):
    return x @ C.T


def system(matrix=G, **options):
    return qpmhe.System(f, h, n=3, p=1, disturbance_matrix=matrix, **options)


def cost(disturbance=Q, **options):
    return qpmhe.QuadraticCost.from_covariances(
        prior=P, disturbance=disturbance, noise=R, **options
    )


def estimator(model=None, observer=None, price=None, **options):
    options = {"horizon": 4, "initial_state": np.zeros(3), "max_qps": 2, **options}
    return qpmhe.MovingHorizonEstimator(
        model or system(), observer or qpmhe.Luenberger(GAIN), price or cost(), **options
    )


def record(steps=12, seed=0):
    return np.random.default_rng(seed).standard_normal((steps, 1))


# The identity


@pytest.mark.parametrize("kalman", [False, True])
def test_the_identity_changes_no_bit(kalman):
    full = np.diag([0.2, 0.1, 0.3])
    sets = {"disturbances": qpmhe.Box([-0.3, -np.inf, 0.0], [0.3, 0.5, 0.0])}
    observer = qpmhe.Luenberger(GAIN)
    if kalman:
        observer = qpmhe.ExtendedKalman(prior=P, disturbance=full, noise=R)
    found = []
    for matrix in (None, np.eye(3)):
        mhe = estimator(system(matrix, **sets), observer, cost(full))
        estimates = [mhe.update(y) for y in record()]
        found.append([
            [e.trajectory, e.disturbances, e.noises, e.candidate, e.cost, e.candidate_cost,
             e.status.value] for e in estimates
        ] + [mhe.covariances()])
    assert system(np.eye(3)).disturbance_matrix is None
    for one, other in zip(*found, strict=True):
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


# The candidate


def rolled_out(trajectory, directions):
    """The trajectory with x+ - f(x) projected in the metric of typical squares of the states."""
    variances = np.maximum(P.diagonal(), np.diag(G @ Q @ G.T))
    scaled = directions / np.sqrt(variances)[:, None]
    within = scaled @ np.linalg.pinv(scaled)
    project = np.sqrt(variances)[:, None] * within / np.sqrt(variances)
    found = [trajectory[0]]
    for following in trajectory[1:]:
        predicted = f(found[-1])
        found.append(predicted + project @ (following - predicted))
    return np.array(found)


def value(trajectory, ys):
    J = 0.0
    for x, following, y in zip(trajectory[:-1], trajectory[1:], ys, strict=True):
        w = np.linalg.lstsq(G, following - f(x), rcond=None)[0]
        v = y - h(x)
        J += w @ np.linalg.solve(Q, w) + v @ np.linalg.solve(R, v)
    return J


def test_a_candidate_outside_of_the_range_costs_what_its_roll_out_costs():
    mhe, Y = estimator(max_qps=0), record()
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        ys = Y[max(0, t - 3) : t + 1]
        expected = value(rolled_out(estimate.candidate, G), ys)
        assert estimate.candidate_cost == pytest.approx(expected, rel=1e-10)
        assert estimate.cost == estimate.candidate_cost
        np.testing.assert_array_equal(estimate.trajectory, estimate.candidate)
        z = estimate.candidate
        np.testing.assert_allclose(z[1:] - f(z[:-1]), (ys - h(z[:-1])) @ GAIN.T, atol=1e-14)
        assert Status.CANDIDATE_OUTSIDE not in estimate.status


@pytest.mark.parametrize("horizon", [1, 2, 5, 12])
def test_the_bound_of_the_candidates_cost(horizon):
    """c(N) of docs/explanation/guarantees.md, in the norm of typical squares of the states."""
    roots = np.sqrt(np.maximum(P.diagonal(), np.diag(G @ Q @ G.T)))
    inverse = np.linalg.pinv(G / roots[:, None]) / roots
    L_f = np.linalg.norm(A * roots / roots[:, None], 2) + 0.05
    L_h = np.linalg.norm(C * roots, 2)
    c_w = np.linalg.norm(np.linalg.cholesky(np.linalg.inv(Q)).T @ inverse * roots, 2) ** 2
    c_v, S = 1.0 / R[0, 0], sum(L_f**k for k in range(horizon - 1))
    c = 2.0 * max(c_w + (c_w * L_f**2 + c_v * L_h**2) * S**2, c_v)
    mhe, Y = estimator(max_qps=0, horizon=horizon), record(30)
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        v = Y[max(0, t + 1 - horizon) : t + 1] - h(estimate.candidate[:-1])
        corrections = v @ GAIN.T / roots
        assert estimate.candidate_cost <= c * (np.sum(corrections**2) + np.sum(v**2))


def test_a_candidate_in_the_range_costs_what_it_always_did():
    inside = G @ np.array([[0.2], [0.1]])
    mhe, Y = estimator(observer=qpmhe.Luenberger(inside), max_qps=0), record()
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        ys = Y[max(0, t - 3) : t + 1]
        v = ys - h(estimate.candidate[:-1])
        w = v @ np.array([[0.2, 0.1]])
        expected = np.sum(w @ np.linalg.inv(Q) * w) + np.sum(v * v) / R[0, 0]
        assert estimate.candidate_cost == pytest.approx(expected, rel=1e-12)
        np.testing.assert_allclose(estimate.disturbances, w, atol=1e-14)


def test_w_bounds_the_disturbances_themselves():
    W = qpmhe.Box([-0.05, -np.inf], [0.05, 0.1])
    mhe = estimator(system(disturbances=W), max_qps=None)
    outside = 0
    for y in record(20):
        estimate = mhe.update(y)
        w = estimate.disturbances
        assert w.shape[1] == 2
        outside += Status.CANDIDATE_OUTSIDE in estimate.status
        if estimate.improved and not estimate.dropped:
            assert W.violation(w) <= 1e-7
        assert estimate.cost <= estimate.candidate_cost
        for row in estimate.dropped:
            assert row.set == "disturbances"
            assert (row.row, row.side) in {(0, "lower"), (0, "upper"), (1, "upper")}
    assert outside


def test_a_component_of_w_may_be_fixed():
    for fixed in (0.0, 0.02):
        W = qpmhe.Box([-np.inf, fixed], [np.inf, fixed])
        mhe = estimator(
            system(disturbances=W), qpmhe.Luenberger(G @ np.array([[0.2], [0.0]])), max_qps=None
        )
        for y in record():
            estimate = mhe.update(y)
            if estimate.improved:
                assert np.abs(estimate.disturbances[:, 1] - fixed).max() <= 1e-13
        assert estimate.improved


# Singular covariances


def test_a_variance_of_zero_is_a_component_without_disturbance():
    """As W of no width says it; the covariance alone implies it."""
    singular, free = np.diag([0.2, 0.0, 0.1]), qpmhe.Box([-np.inf] * 3, [np.inf] * 3)
    still = qpmhe.Box([-np.inf, 0.0, -np.inf], [np.inf, 0.0, np.inf])
    gain = GAIN * [[1.0], [0.0], [1.0]]
    found = []
    for W, disturbance in (
        (None, singular), (free, singular), (still, singular),
        (still, np.diag([0.2, 7.0, 0.1])),
    ):
        mhe = estimator(
            system(None, disturbances=W), qpmhe.Luenberger(gain), cost(disturbance), max_qps=None
        )
        estimates = [mhe.update(y) for y in record()]
        assert all(np.abs(e.disturbances[:, 1]).max() <= 1e-15 for e in estimates)
        found.append((estimates, mhe.covariances()))
    for estimates, covariances in found[:-1]:
        np.testing.assert_allclose(covariances, found[-1][1], rtol=1e-9)
        for one, other in zip(estimates, found[-1][0], strict=True):
            np.testing.assert_allclose(one.trajectory, other.trajectory, atol=1e-7)
            assert one.cost == pytest.approx(other.cost, rel=1e-8)
            assert one.candidate_cost == pytest.approx(other.candidate_cost, rel=1e-12)


def test_a_system_without_any_disturbance():
    mhe = estimator(system(None), price=cost(np.zeros((3, 3))), max_qps=None)
    for y in record():
        estimate = mhe.update(y)
        x = estimate.trajectory
        if estimate.improved:
            np.testing.assert_allclose(x[1:], f(x[:-1]), atol=1e-15)
    assert estimate.improved
    covariances = mhe.covariances()
    slope = A + 0.05 * np.diag(np.cos(x[-2]))
    np.testing.assert_allclose(covariances[-1], slope @ covariances[-2] @ slope.T, rtol=1e-9)


@pytest.mark.parametrize("raises", [False, True])
def test_a_roll_out_that_fails_is_named(raises):
    def falling(x):
        if raises and (x[..., 0] < -2.5).any():
            raise ValueError("too low")
        return np.where(x[..., :1] < -2.5, np.nan, x - np.array([1.0, 0.0]))

    model = qpmhe.System(falling, lambda x: x[..., :1], n=2, p=1, disturbance_matrix=[[0.0], [1.0]])
    price = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=1.0, noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        model, qpmhe.Luenberger([[0.5], [0.0]]), price, horizon=6, initial_state=[0.0, 0.0],
    )
    for _ in range(6):
        estimate = mhe.update(3.0)
    assert estimate.candidate_cost == np.inf
    assert np.isfinite(estimate.candidate).all()
    assert Status.MODEL_FAILED in estimate.status
    assert "roll-out" in estimate.message
    assert not raises or "too low" in estimate.message


def test_a_set_that_contradicts_a_covariance_is_refused():
    W = qpmhe.Box([-np.inf, 0.5, -np.inf], [np.inf, 0.5, np.inf])
    check(
        SetError, ["component 1", "0.5", "variance"],
        lambda: estimator(system(None, disturbances=W), price=cost(np.diag([0.2, 0.0, 0.1]))),
    )


@pytest.mark.parametrize("kind", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
def test_kalman_type_observers_keep_a_singular_covariance_of_x_inside_the_set(kind):
    X = qpmhe.Box([-0.2] * 3, [0.2] * 3)
    observer = kind(prior=np.diag([1.0, 0.0, 0.5]), disturbance=np.diag([0.1, 0.0, 0.0]), noise=R)
    mhe = estimator(
        system(None, states=X), observer,
        qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=np.diag([0.1, 0.0, 0.0]), noise=R
        ),
        max_qps=None,
    )
    for y in record(20):
        estimate = mhe.update(y)
        assert X.violation(estimate.trajectory) <= 1e-8
        assert estimate.cost <= estimate.candidate_cost


def test_designed_gains_take_the_matrix():
    model = system()
    full = qpmhe.design_luenberger(
        system(None), np.zeros(3), disturbance=G @ Q @ G.T, noise=R
    ).gain
    np.testing.assert_allclose(
        qpmhe.design_luenberger(model, np.zeros(3), disturbance=Q, noise=R).gain, full, rtol=1e-9
    )
    steady = qpmhe.SteadyStateKalman(model, np.zeros(3), disturbance=Q, noise=R)
    np.testing.assert_allclose(steady.gain, full, rtol=1e-9)
    walk = qpmhe.System(lambda x: x, lambda x: x, n=2, p=2)
    check(
        ModelError, ["eigenvalue 1", "small variance"],
        lambda: qpmhe.design_luenberger(
            walk, [0.0, 0.0], disturbance=np.diag([1.0, 0.0]), noise=np.eye(2)
        ),
    )


# Robust costs


@pytest.mark.parametrize("loss", ["huber", "power", "per component"])
def test_robust_costs_reach_the_minimum(loss):
    weights = {"disturbance": np.linalg.inv(np.diag(Q.diagonal())), "noise": np.linalg.inv(R)}
    losses = {
        "huber": lambda W: qpmhe.Huber(W, 0.5), "power": lambda W: qpmhe.Power(W, 1.5),
        "per component": lambda W: qpmhe.Huber(W, 0.5, per_component=True),
    }
    made = {name: losses[loss](weight) for name, weight in weights.items()}
    price = qpmhe.RobustCost(prior=np.linalg.inv(P), **made)
    mhe, Y = estimator(price=price, max_qps=None, tolerance=1e-12), 2.0 * record(8)
    for y in Y:
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost
    ys, prior = Y[-4:], estimate.candidate[0]

    def objective(unknowns):
        x, J = unknowns[:3], (unknowns[:3] - prior) @ np.linalg.solve(P, unknowns[:3] - prior)
        for w, y in zip(unknowns[3:].reshape(-1, 2), ys, strict=True):
            v = y - h(x)
            J += float(made["disturbance"].cost(w[None], weights["disturbance"])[0])
            J += float(made["noise"].cost(v[None], weights["noise"])[0])
            x = f(x) + G @ w
        return J

    start = np.concatenate((estimate.trajectory[0], estimate.disturbances.ravel()))
    assert objective(start) == pytest.approx(estimate.cost, rel=1e-10)
    best = minimize(objective, start, method="Nelder-Mead", options={"maxiter": 20000})
    assert estimate.cost <= best.fun * (1.0 + 1e-7)
    far = minimize(objective, np.concatenate((prior, np.zeros(8))), method="BFGS")
    assert estimate.cost == pytest.approx(far.fun, rel=1e-4)


# Everything around


def test_snapshots_continue_bit_for_bit_and_know_the_matrix():
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
    one, other = (estimator(observer=observer) for _ in range(2))
    for y in record():
        one.update(y)
    other.load_state_dict(one.state_dict())
    for y in record(seed=1):
        mine, theirs = one.update(y), other.update(y)
        np.testing.assert_array_equal(mine.trajectory, theirs.trajectory)
        np.testing.assert_array_equal(mine.disturbances, theirs.disturbances)
    check(
        InvalidInputError, ["disturbance_matrix"],
        lambda: estimator(system(2.0 * G), observer).load_state_dict(one.state_dict()),
    )


def test_a_batch_estimates_as_single_estimators_do():
    Y = np.array([record(seed=seed) for seed in range(3)])
    batch = qpmhe.BatchEstimator(
        system(), qpmhe.Luenberger(GAIN), cost(), members=3, horizon=4, max_qps=2,
        initial_states=np.zeros(3),
    ).run(Y)
    for states, ys in zip(batch.states, Y, strict=True):
        np.testing.assert_array_equal(states, estimator().run(ys).states)


def test_options_work_together():
    Y = record(25)
    Y[[4, 11]] = np.nan
    for options in (
        {"warm_start": True}, {"candidate": "reinitialized"}, {"delay": 2}, {"max_qps": None},
    ):
        for discount in (1.0, 0.9):
            mhe = estimator(price=cost(discount=discount), **options)
            for y in Y:
                estimate = mhe.update(y, noise_weight=[[3.0]] if y[0] > 1.0 else None)
                x = estimate.trajectory
                assert estimate.cost <= estimate.candidate_cost
                if estimate.improved:
                    missed = x[1:] - f(x[:-1]) - estimate.disturbances @ G.T
                    assert np.abs(missed).max() <= 1e-13


def test_augmented_parameters_and_noisy_inputs_keep_the_matrix():
    plant = qpmhe.System(
        lambda x, u: x @ A.T + u[..., :1], h, n=3, p=1, m=1, disturbance_matrix=G,
        disturbances=qpmhe.Box([-1.0, -2.0], [1.0, 2.0]),
    )
    wider = qpmhe.augment_parameters(plant, nominal=[0.5])
    np.testing.assert_array_equal(
        wider.disturbance_matrix, [[0.1, 0, 0], [1, 0.3, 0], [0, 1, 0], [0, 0, 1]]
    )
    assert wider.disturbances.lower.tolist() == [-1.0, -2.0, 0.0]
    assert qpmhe.noisy_inputs(plant).disturbance_matrix.shape == (4, 3)


def test_scenarios_draw_disturbances_of_lower_dimension():
    scenario = qpmhe.models.Scenario(
        system=system(disturbances=qpmhe.Box([-0.2, -np.inf], [0.2, np.inf])),
        initial_state=np.zeros(3), initial_estimate=np.zeros(3),
        disturbance_covariance=np.diag([0.1, 0.0]), noise_covariance=R, dt=1.0, horizon=4,
        steps=50, labels=("a", "b", "c"),
    )
    states, _ = scenario.simulate(0)
    w = np.linalg.lstsq(G, (states[1:] - f(states[:-1])).T, rcond=None)[0].T
    np.testing.assert_allclose(states[1:] - f(states[:-1]), w @ G.T, atol=1e-13)
    assert 0.05 < np.abs(w[:, 0]).max() <= 0.2 + 1e-12
    assert np.abs(w[:, 1]).max() <= 1e-12


def test_what_cannot_take_it_refuses_it_by_name():
    model = qpmhe.from_casadi(lambda x: x, lambda x: x, n=2, p=2, disturbance_matrix=[[1], [2]])
    plain = qpmhe.from_casadi(lambda x: x, lambda x: x, n=2, p=2)
    singular = np.diag([1.0, 0.0])
    for one, disturbance in ((model, np.eye(1)), (plain, singular)):
        price = qpmhe.QuadraticCost.from_covariances(
            prior=np.eye(2), disturbance=disturbance, noise=np.eye(2)
        )
        observer = qpmhe.Luenberger(0.5 * np.eye(2))
        with pytest.raises(CertificateError, match="disturbance_matrix"):
            checked_ingredients(one, observer, price)


# Bad input


@pytest.mark.parametrize(
    ("matrix", "kind", "fragments"),
    [
        ([1.0, 2.0, 3.0], ShapeError, ["shape (3,)", "(3, r)", "column for each"]),
        (np.ones((2, 1)), ShapeError, ["shape (2, 1)", "(3, r)"]),
        (np.ones((3, 4)), ShapeError, ["shape (3, 4)", "from 1 to 3"]),
        (np.ones((3, 0)), ShapeError, ["shape (3, 0)", "from 1 to 3"]),
        (np.ones((3, 2)), ModelError, ["linearly dependent", "rank 2", "Merge"]),
        ([[1e9, 2e-9], [1.0, 2e-18], [0.0, 0.0]], ModelError, ["linearly dependent"]),
        (np.zeros((3, 1)), ModelError, ["linearly dependent", "rank 1"]),
        ([[1.0], [np.nan], [0.0]], InvalidInputError, ["disturbance_matrix", "finite"]),
        ("G", InvalidInputError, ["disturbance_matrix is 'G'", "real numbers"]),
    ],
)
def test_bad_matrices(matrix, kind, fragments):
    check(kind, fragments, lambda: system(matrix))


def test_columns_in_units_far_apart_are_no_dependent_ones():
    assert system([[1e9, 0.0], [0.0, 1e-9], [1e9, 1e-9]]).r == 2


def test_costs_observers_and_sets_of_another_dimension():
    for price in (cost(np.eye(3)), cost(np.eye(1))):
        check(
            ShapeError, [f"for {price.r} disturbances; expected 2", "column"],
            lambda price=price: estimator(price=price),
        )
    for observer, size in (
        (qpmhe.ExtendedKalman(prior=P, disturbance=np.eye(3), noise=R), "(3, 3)"),
        (qpmhe.UnscentedKalman(prior=P, disturbance=np.eye(1), noise=R), "(1, 1)"),
    ):
        check(
            ShapeError, [f"disturbance covariance has shape {size}", "expected (2, 2)"],
            lambda observer=observer: estimator(observer=observer),
        )
    check(
        SetError, ["disturbances has dimension 3; expected 2"],
        lambda: system(disturbances=qpmhe.Box([-1.0] * 3, [1.0] * 3)),
    )


@pytest.mark.parametrize(
    "matrix", [[[1.0, 2.0], [2.0, 1.0]], [[0.0, 1e-3], [1e-3, 1.0]], [[1.0, 0.0], [0.0, -1e-9]]]
)
def test_covariances_with_a_negative_eigenvalue(matrix):
    for build in (
        lambda: cost(matrix), lambda: qpmhe.ExtendedKalman(prior=P, disturbance=matrix, noise=R),
        lambda: qpmhe.SteadyStateKalman(system(), np.zeros(3), disturbance=matrix, noise=R),
    ):
        check(WeightError, ["disturbance covariance", "eigenvalue -", "semidefinite"], build)


# What may change while running


def test_weights_and_bounds_of_single_samples_are_those_of_the_disturbances():
    W = qpmhe.Box([-0.5, -0.5], [0.5, 0.5])
    narrow = qpmhe.Box([-0.02, -0.5], [0.02, 0.5])
    heavy = 4.0 * np.linalg.inv(Q)
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
    mhe = estimator(system(disturbances=W), observer, max_qps=None)
    plain = estimator(system(disturbances=W), observer, max_qps=None)
    Y, weights, bound = 0.3 * record(16), [], []
    for t, y in enumerate(Y):
        own = {"disturbance_weight": heavy} if t % 3 == 0 else {}
        if t % 4 == 1:
            own["bounds"] = {"disturbances": narrow}
        weights.append(own.get("disturbance_weight", np.linalg.inv(Q)))
        bound.append("bounds" in own)
        estimate, other = mhe.update(y, **own), plain.update(y)
        assert estimate.cost <= estimate.candidate_cost
        w, v = estimate.disturbances, estimate.noises
        offset = estimate.trajectory[0] - estimate.candidate[0]
        J = offset @ np.linalg.solve(P, offset) + np.sum(v * v) / R[0, 0]
        J += sum(one @ W @ one for one, W in zip(w, weights[-len(w):], strict=True))
        if estimate.improved:
            assert estimate.cost == pytest.approx(J, rel=1e-9)
        if not estimate.dropped and estimate.improved:
            held = np.array(bound[-len(w):])
            assert np.abs(w[held, 0]).max(initial=0.0) <= 0.02 * (1.0 + 1e-7)
    assert not np.allclose(estimate.trajectory, other.trajectory, rtol=1e-6)


def test_a_weight_for_all_samples_is_that_of_an_estimator_made_with_it():
    heavy = 4.0 * np.linalg.inv(Q)
    mhe, other = estimator(), estimator(price=cost(np.linalg.inv(heavy)))
    for y in record():
        mhe.update(y)
        expected = other.update(y)
    estimate = mhe.set(disturbance_weight=heavy)
    np.testing.assert_allclose(estimate.trajectory, expected.trajectory, rtol=1e-9, atol=1e-12)
    assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-9)


def test_no_weight_stands_for_a_singular_covariance():
    mhe = estimator(system(None), price=cost(np.diag([0.2, 0.0, 0.1])))
    check(
        qpmhe.errors.OptionError, ["disturbance_weight", "singular", "disturbance_matrix"],
        lambda: mhe.update(0.1, disturbance_weight=np.eye(3)),
    )
    assert mhe.time == 0


def test_steps_of_other_lengths_have_the_same_matrix():
    model = qpmhe.System.from_ode(
        lambda x: x @ (A.T - np.eye(3)), h, dt=0.5, n=3, p=1, disturbance_matrix=G
    )
    mhe = estimator(model, qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R), max_qps=None)
    for t, y in enumerate(record()):
        dt = 0.8 if t % 3 == 1 else 0.5
        estimate = mhe.update(y, dt=dt)
    x, steps = estimate.trajectory, [0.5, 0.5, 0.8, 0.5]
    for k, step in enumerate(steps):
        predicted = model.timed.f(x[k], np.array([step]))
        np.testing.assert_allclose(x[k + 1] - predicted, G @ estimate.disturbances[k], atol=1e-14)
