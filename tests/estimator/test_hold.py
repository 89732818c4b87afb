"""Parameters that a window does not see: held, without drift and without getting stiff."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.monitor import _barred
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError, ShapeError

from .spoil import check

DT = 0.1
PRIOR = np.array([1.0, 0.5])  # standard deviations of speed and of gain
NOISE, WANDER = 0.05, 0.01
HORIZON = 10
# Seen; unseen for ten horizons, in which the gain changes after five; seen again.
UNSEEN, CHANGE, AGAIN, END = (k * HORIZON for k in (5, 11, 16, 19))


def estimator(hold, drift=0.1, gain=None, scales=(1.0, 1.0, 1.0), drifting=True, **options):
    """Of a motor's speed and gain: with a Kalman filter, or with a constant gain and weight."""
    sx, sg, sy = scales
    states = np.array([sx, sg])
    system = qpmhe.augment_parameters(
        lambda x, u, g: -0.5 * x + (g / sg) * u * sx, lambda x, u, g: x / sx * sy,
        n=1, p=1, m=1, dt=DT, nominal=[sg], hold=hold, drifting=drifting,
    )
    covariances = {
        "prior": np.diag((PRIOR * states) ** 2),
        "disturbance": np.diag(([WANDER, drift] * states) ** 2), "noise": [[(NOISE * sy) ** 2]],
    }
    observer, prior = qpmhe.ExtendedKalman(**covariances), qpmhe.ObserverPrior()
    if gain is not None:
        observer, prior = qpmhe.Luenberger([[0.3], [gain]]), covariances["prior"]
    cost = qpmhe.QuadraticCost.from_covariances(**covariances | {"prior": prior})
    options = {"horizon": HORIZON, "initial_state": [0.0, sg], "max_qps": 2} | options
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **options)


def record(seed):
    """Measurements, inputs and gains; while unseen, a little current that does nothing."""
    generator, x = np.random.default_rng(seed), 0.0
    t = np.arange(END)
    gains = np.where(t < CHANGE, 1.3, 0.7)
    steady = (t >= UNSEEN) & (t < AGAIN)
    u = np.where(steady, 0.0, np.sign(np.sin(t / 4.0)))
    y = np.empty(END)
    for k in t:
        y[k] = x + NOISE * generator.standard_normal()
        x += DT * (-0.5 * x + gains[k] * u[k]) + 0.3 * WANDER * generator.standard_normal()
    return y, (u + 0.02 * steady)[:, None], gains


def drift_and_error(seed, *arguments, **options):
    """In deviations of the prior: how far the gain moves while unseen, and its later error."""
    y, u, gains = record(seed)
    run = estimator(*arguments, **options).run(y, u)
    assert (run.costs <= run.candidate_costs).all()
    found = run.states[1:, 1]
    moved = np.abs(found[UNSEEN:AGAIN] - found[UNSEEN - 1]).max()
    later = AGAIN + 2 * HORIZON - 1
    return moved / PRIOR[1], np.abs(found[later] - gains[later]) / PRIOR[1]


@pytest.mark.parametrize("seed", range(3))
def test_an_unseen_parameter_neither_drifts_nor_gets_stiff(seed):
    moved, _ = drift_and_error(seed, None, 0.1)
    assert moved > 1.0
    _, error = drift_and_error(seed, None, 1e-3)
    assert error > 0.5
    moved, error = drift_and_error(seed, 0.1, 0.1)
    assert moved < 0.6
    assert error < 0.3


def test_an_unseen_parameter_does_not_fall_back_to_the_observers():
    for gain, drifting in ((0.0, True), (0.1, False)):
        free, _ = drift_and_error(0, None, 0.02, gain, drifting=drifting)
        moved, error = drift_and_error(0, 0.1, 0.02, gain, drifting=drifting)
        assert free > 0.5
        assert moved < 0.5 * free
        assert error < 0.3


def test_nothing_is_measured_for_ten_horizons():
    mhe, (y, u, _) = estimator(0.1), record(0)
    mhe.run(y[:UNSEEN], u[:UNSEEN])
    mhe.run([None] * HORIZON, np.ones((HORIZON, 1)))
    target = mhe.hold.target
    assert abs(target[0] - 1.3) < 0.5 * PRIOR[1]
    np.testing.assert_allclose(mhe.hold.weight, [[1.0 / (0.1 * PRIOR[1]) ** 2]], rtol=1e-12)
    for _ in range(9 * HORIZON):
        estimate = mhe.update(None, [1.0])
        np.testing.assert_array_equal(mhe.hold.target, target)
        np.testing.assert_array_equal(mhe.hold.values, [0.0])
        np.testing.assert_array_equal(mhe.hold.shares, [1.0])
        assert abs(estimate.trajectory[0, 1] - target[0]) < 0.02 * PRIOR[1]


def random_problem(draw):
    """A random small model with inputs and parameters, some of them held; its estimator."""
    n, k, p, m = (int(draw.integers(1, most)) for most in (3, 4, 3, 3))
    a, b = draw.normal(size=(n, n)), draw.normal(size=(n, k))
    c, d = draw.normal(size=(p, n)), draw.normal(size=(m, k))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()

    def f(x, u, theta):
        return x @ a.T + 0.2 * np.sin(x) + ((u @ d) * theta) @ b.T

    def h(x, u, theta):
        return x @ c.T + 0.05 * (x @ c.T) ** 2

    held = draw.permutation(k)[: draw.integers(1, k + 1)]
    system = qpmhe.augment_parameters(
        f, h, n=n, p=p, m=m, nominal=draw.normal(size=k), drifting=bool(draw.random() < 0.7),
        hold={int(j): float(draw.uniform(0.05, 1.0)) for j in held},
        parameter_bounds=qpmhe.Box([-4.0] * k, [4.0] * k) if draw.random() < 0.3 else None,
    )
    root = draw.normal(size=(n + k, n + k))
    prior = root @ root.T + 0.2 * np.eye(n + k)
    covariances = {
        "disturbance": np.diag(draw.uniform(1e-3, 0.1, n + k)),
        "noise": np.diag(draw.uniform(0.01, 0.5, p)),
    }
    kind = int(draw.integers(3))
    observer = qpmhe.ExtendedKalman(prior=prior, **covariances)
    if kind == 0:
        gain = 0.3 * np.vstack((a @ np.linalg.pinv(c), 0.2 * draw.normal(size=(k, p))))
        observer = qpmhe.Luenberger(gain)
    discount = float(draw.choice([1.0, 0.9]))
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=qpmhe.ObserverPrior() if kind == 2 else prior, discount=discount, **covariances
    )
    start = np.append(draw.normal(size=n), system.recipe[1]["nominal"])
    options = {
        "horizon": int(draw.integers(1, 7)), "max_qps": [1, 2, None][draw.integers(3)],
        "candidate": ("observer", "reinitialized")[int(draw.random() < 0.2)],
    }
    mhe = qpmhe.MovingHorizonEstimator(system, observer, cost, initial_state=start, **options)
    return mhe, prior


def plain_j(mhe, x, u, y, weight, prior):
    """J of a trajectory, stage by stage, with the hold that the estimator states."""
    system, cost, hold = mhe.system, mhe.cost, mhe.hold
    count = len(x) - 1
    factors = cost.discount ** np.arange(count - 1, -1, -1.0)
    offset, parameter = x[0] - prior, x[0][hold.components] - hold.target
    total = offset @ weight @ offset + parameter @ hold.weight @ parameter
    total *= cost.discount**count
    for i in range(count):
        w, v = x[i + 1] - system.f(x[i], u[i]), y[i] - system.h(x[i], u[i])
        v = np.where(np.isfinite(v), v, 0.0)
        noise = np.where(np.isnan(y[i])[:, None] | np.isnan(y[i]), 0.0, cost.noise)
        total += factors[i] * (w @ cost.disturbance @ w + v @ noise @ v)
    return total


def dense_hold(mhe, candidate, u, y, prior):
    """H and the matrix by which the trusted values follow, by dense inverses of all states."""
    system, cost, count = mhe.system, mhe.cost, len(candidate) - 1
    n, held = system.n, mhe.hold.components
    spread = np.linalg.inv(cost.disturbance)
    fixed = [] if system.disturbances is None else system.disturbances.fixed_components
    spread[fixed] = spread[:, fixed] = 0.0
    # Parameters of the window: x_0 and each disturbance; the outputs are linear in them.
    size = n * (count + 1)
    covariance = np.zeros((size, size))
    covariance[:n, :n] = prior
    slopes, information = np.zeros((n, size)), np.zeros((size, size))
    slopes[:, :n] = np.eye(n)
    for i in range(count):
        covariance[n * (i + 1) : n * (i + 2), n * (i + 1) : n * (i + 2)] = spread
        rows = system.h_jacobian(candidate[i], u[i]) @ slopes
        there = ~np.isnan(y[i])
        information += rows[there].T @ cost.noise[np.ix_(there, there)] @ rows[there]
        slopes = system.f_jacobian(candidate[i], u[i]) @ slopes
        slopes[:, n * (i + 1) : n * (i + 2)] += np.eye(n)
    left = covariance @ np.linalg.inv(np.eye(size) + information @ covariance)
    part = prior[np.ix_(held, held)]
    units = np.sqrt(part.diagonal())
    values, vectors = np.linalg.eigh(part / np.outer(units, units))
    root = units[:, None] * ((vectors * np.sqrt(values)) @ vectors.T)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ left[np.ix_(held, held)] @ inverse.T)
    low = np.minimum(values, 0.5)
    shares = (vectors * (low / (1.0 - low))) @ vectors.T
    stiffness = np.diag([1.0 / system.held[int(j)] for j in held])
    weight, eye = stiffness @ shares @ shares @ stiffness, np.eye(held.size)
    follow = root @ np.linalg.inv(eye + stiffness @ shares @ stiffness) @ (eye - shares)
    return inverse.T @ weight @ inverse, follow @ inverse


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("first", [0, 5, 10, 15])
def test_promise_and_formulas_on_random_problems(first):
    for seed in range(first, first + 5):
        check_random_problem(np.random.default_rng(seed))


def check_random_problem(draw):
    mhe, prior = random_problem(draw)
    system, horizon = mhe.system, mhe.horizon
    parameters = 3 * draw.normal(size=system.n)
    x = np.append(draw.normal(size=1), parameters)[: system.n]
    ys, us, target = [], [], None
    for t in range(4 * horizon + 6):
        ys.append(system.h(x, np.zeros(system.m)) + 0.2 * draw.normal(size=system.p))
        ys[-1][draw.random(system.p) < 0.1] = np.nan
        us.append(draw.normal(size=system.m) * (t // horizon % 2))
        x = system.f(x, us[-1])
        estimate = mhe.update(ys[-1], us[-1])
        assert estimate.cost <= estimate.candidate_cost
        if np.abs(estimate.candidate).max() > 100.0:  # an observer that runs away
            target = None
            continue
        y, u, hold = ys[-horizon:], us[-horizon:], mhe.hold
        if target is not None:
            np.testing.assert_allclose(hold.target, target, rtol=1e-9, atol=1e-9)
        weight, follow = dense_hold(mhe, estimate.candidate, u, y, prior)
        np.testing.assert_allclose(hold.weight, weight, rtol=1e-6, atol=1e-7 * np.abs(weight).max())
        problem = mhe._engine.solved().problem
        for trajectory, cost in (
            (estimate.trajectory, estimate.cost), (estimate.candidate, estimate.candidate_cost)
        ):
            found = plain_j(mhe, trajectory, u, y, problem.prior_weight, estimate.candidate[0])
            if np.isfinite(cost):
                assert cost == pytest.approx(found, rel=1e-8, abs=1e-10)
        target = hold.target
        if estimate.improved:
            first = estimate.trajectory[int(len(u) == horizon)][hold.components]
            target = target + follow @ (first - target)


def test_snapshots():
    y, u, _ = record(1)
    mhe = estimator({0: 0.1})
    for t in range(END):
        if t in (0, 1, UNSEEN, AGAIN + 3):
            if t > 1:
                mhe.amend(t - 2, [y[t - 2] + 0.01])
            restored = estimator(0.1)
            restored.load_state_dict(pickle.loads(pickle.dumps(mhe.state_dict())))
            copied = copy.deepcopy(mhe)
        expected = mhe.update(y[t], u[t])
        for other in (restored, copied):
            found = other.update(y[t], u[t])
            np.testing.assert_array_equal(found.state, expected.state)
            assert found.candidate_cost == expected.candidate_cost
            np.testing.assert_array_equal(other.hold.target, mhe.hold.target)
    mhe.reset([0.0, 0.8])
    assert mhe.hold is None
    mhe.update(y[0], u[0])
    np.testing.assert_array_equal(mhe.hold.target, [0.8])  # the new start is trusted


def test_snapshots_of_other_holds_and_damaged_ones_are_refused():
    y, u, _ = record(2)
    for engine in ("python", "compiled")[: 1 + (find_compiler() is not None)]:
        mhe = estimator(0.1, engine=engine)
        mhe.run(y[:14], u[:14])
        assert mhe.update(y[14], u[14]).message == ""
        state = mhe.state_dict()
        for hold in (None, 0.2):
            other = estimator(hold, engine=engine)
            check(InvalidInputError, ["another"], other.load_state_dict, state)
        if engine == "python":
            state["window/trusted"][...] = np.nan
        else:
            state["memory"].view(mhe._engine._memory.dtype)["trusted"] = np.nan
        check(InvalidInputError, ["damaged"], mhe.load_state_dict, state)


@pytest.mark.parametrize("exponents", [(9, -14, 4), (-20, 7, -3)])
def test_no_unit_matters(exponents):
    scales, (y, u, _) = np.ldexp(1.0, exponents), record(5)
    expected = estimator(0.1, engine="python").run(y, u)
    found = estimator(0.1, scales=scales, engine="python").run(scales[2] * y, u)
    np.testing.assert_allclose(found.states / scales[:2], expected.states, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.costs, expected.costs, rtol=1e-12, atol=1e-12)


def test_sensitivity_has_the_hold():
    """By the newest measurement, on which neither target nor weight rests here."""
    y, u, _ = record(6)
    mhe = estimator(0.1, max_qps=None, tolerance=1e-15)
    mhe.run(y[: UNSEEN + 8], u[: UNSEEN + 8])
    state, k = mhe.state_dict(), UNSEEN + 8
    mhe.update(y[k], u[k])
    assert mhe.hold.shares[0] > 0.05
    found = mhe.sensitivity().measurements[-1, :, -1, 0]
    ends = []
    for step in (1e-4, -1e-4):
        mhe.load_state_dict(state)
        ends.append(mhe.update(y[k] + step, u[k]).state)
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-9)


def same(x, theta):
    return x


def augmented(hold, nominal=(1.0, 2.0, 3.0), estimated=(0, 2)):
    return qpmhe.augment_parameters(
        same, same, n=1, p=1, nominal=nominal, estimated=estimated, hold=hold
    )


def test_what_is_held_survives_pickles_and_further_augmentations():
    system = augmented({2: 0.2})
    assert pickle.loads(pickle.dumps(system)).held == system.held == {2: 0.2}
    system = estimator({0: 0.2}).system
    assert qpmhe.noisy_inputs(system).held == {1: 0.2}
    again = qpmhe.augment_parameters(system, nominal=[0.0], hold=0.3)
    assert again.held == {1: 0.2, 2: 0.3}


def test_the_theorem_does_not_cover_it():
    assert _barred(estimator(None)) == ""
    assert "without hold" in _barred(estimator(0.1))


def test_bad_holds_are_refused():
    for hold, kind, text in (
        (0.0, InvalidInputError, ["hold is 0.0", "above 0"]),
        ([0.1, np.nan], InvalidInputError, ["hold is nan"]),
        ([0.1, np.inf], InvalidInputError, ["hold is inf", "omit it"]),
        (True, InvalidInputError, ["hold is True"]),
        ({0: "stiff"}, InvalidInputError, ["hold is 'stiff'"]),
        ([0.1], ShapeError, ["expected one number, or (2,)"]),
        ([[0.1, 0.1]], ShapeError, ["shape (1, 2)"]),
        ({1: 0.1}, InvalidInputError, ["key 1, which is not an estimated parameter", "[0, 2]"]),
        ({"inertia": 0.1}, InvalidInputError, ["key 'inertia'"]),
        ({True: 0.1}, InvalidInputError, ["key True"]),
        ({-1: 0.1}, InvalidInputError, ["key -1"]),
    ):
        check(kind, text, augmented, hold)
    check(InvalidInputError, ["no parameter is estimated"], augmented, 0.1, [1.0], [])
