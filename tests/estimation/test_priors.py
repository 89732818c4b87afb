"""What weighs the prior: the observer's covariance, within its bounds, or a constant weight."""

import copy
import pickle
import warnings
from functools import partial

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ObserverWarning, PriorWarning
from qpmhe.terms.prior import PriorWeights

A, C = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[1.0, 0.3]])
P, Q, R = np.array([[1.0, 0.4], [0.4, 2.0]]), np.diag([0.01, 0.02]), np.array([[0.1]])
SPEAKS = "a constant weight beside ExtendedKalman"
ENGINES = pytest.mark.parametrize("engine", ["python", "compiled"])

COSTS = (
    qpmhe.QuadraticCost.from_covariances,
    lambda disturbance, noise, **given: qpmhe.RobustCost(
        disturbance=np.linalg.inv(disturbance), noise=np.linalg.inv(noise), **given
    ),
)


def f(x):
    return x @ A.T


def h(x):
    return x @ C.T


def system(units=(1.0, 1.0)):
    if units == (1.0, 1.0):
        return qpmhe.System(f, h, n=2, p=1)
    to, back = np.diag(units), np.diag(1.0 / np.asarray(units))
    a, c = to @ A @ back, C @ back
    return qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1)


def estimator(cost=None, prior=P, units=(1.0, 1.0), kind=qpmhe.ExtendedKalman, **options):
    to = np.diag(units)
    covariances = {"disturbance": to @ Q @ to, "noise": R}
    if cost is None:
        cost = COSTS[0](**covariances)
    observer = kind(prior=to @ prior @ to, **covariances)
    options = {"horizon": 6, "initial_state": [0.0, 0.0], "max_qps": 3} | options
    return qpmhe.MovingHorizonEstimator(system(units), observer, cost, **options)


def record(steps=60, seed=0):
    rng, x, ys = np.random.default_rng(seed), np.array([1.0, -1.0]), []
    for _ in range(steps):
        ys.append(C @ x + np.sqrt(R[0]) * rng.standard_normal(1))
        x = A @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(2)
    return np.array(ys)


def kalman_filter(ys, prior=P):
    """Filtered states of a textbook filter, in 40 digits."""
    mpmath = pytest.importorskip("mpmath")
    found = []
    with mpmath.workdps(40):
        a, c, q, r = (mpmath.matrix(one.tolist()) for one in (A, C, Q, R))
        z, s = mpmath.matrix([0, 0]), mpmath.matrix(prior.tolist())
        for y in ys:
            k = s * c.T / ((c * s * c.T)[0] + r[0])
            z, s = z + k * (mpmath.mpf(float(y[0])) - (c * z)[0]), s - k * c * s
            found.append([float(one) for one in z])
            z, s = a * z, a * s * a.T + q
    return np.array(found)


@ENGINES
@pytest.mark.parametrize("make", COSTS)
@pytest.mark.parametrize("kind", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
def test_without_a_prior_it_is_the_kalman_filter(engine, make, kind):
    ys = record()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mhe = estimator(make(disturbance=Q, noise=R), engine=engine, kind=kind)
    run = mhe.run(ys)
    np.testing.assert_allclose(run.filtered, kalman_filter(ys), rtol=0, atol=1e-12)


@ENGINES
@pytest.mark.parametrize(("deviation", "digits"), [(1e3, 1e-11), (1e5, 1e-7), (1e6, 1e-5)])
def test_the_bounds_leave_vague_priors_alone(engine, deviation, digits):
    ys, prior = record(), deviation**2 * R * np.eye(2)
    estimator(engine=engine)  # a library is checked where it is first made: on a filter with digits
    found = estimator(prior=prior, engine=engine).run(ys).filtered
    np.testing.assert_allclose(found[2:], kalman_filter(ys, prior)[2:], rtol=0, atol=digits)
    # A bound that cannot hold a filter's certainty discards what came before the window.
    cost = COSTS[0](prior=qpmhe.ObserverPrior(1e4), disturbance=Q, noise=R)
    bounded = estimator(cost, prior=prior, engine=engine).run(ys).filtered
    assert np.abs(bounded - found)[8:].max() > 1e-2


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-9, 1e12)])
@pytest.mark.parametrize("kappa", [4.0, 50.0, 1e8, 1e32])
def test_weights_stay_within_kappa_of_the_first(units, kappa):
    """For covariances from nothing to everything, and for such that rounding has made wrong."""
    to = np.diag(units)
    cost = COSTS[0](prior=qpmhe.ObserverPrior(kappa), disturbance=to @ Q @ to, noise=R)
    mhe = estimator(cost, units=units)
    weights = PriorWeights(mhe.system, mhe.observer, cost)
    root = to @ np.linalg.cholesky(P)
    rng = np.random.default_rng(3)
    for power in (-300, -40, -16, -4, 0, 4, 16, 40, 250):
        for shape in (np.eye(2), np.ones((2, 2)), np.diag([1.0, 1e-40]), np.diag([1.0, 0.0])):
            factor = to @ rng.standard_normal((2, 2))
            covariance = 10.0**power * factor @ shape @ factor.T
            with np.errstate(under="ignore"):
                weight = weights(0.5 * (covariance + covariance.T)).weight
            # Relative to the first: the identity.
            low, high = np.linalg.eigvalsh(root.T @ weight @ root)
            assert low >= -1e-9 * high
            assert high <= kappa * (1.0 + 1e-9)
            if high < 1e6 / kappa:  # else rounding hides it
                assert low >= (1.0 - 1e-9) / kappa


@ENGINES
def test_the_bounds_depend_on_no_unit(engine):
    ys, units = record(), (2.0**-30, 2.0**40)
    own = COSTS[0](prior=qpmhe.ObserverPrior(20.0), disturbance=Q, noise=R)
    to = np.diag(units)
    other = COSTS[0](prior=qpmhe.ObserverPrior(20.0), disturbance=to @ Q @ to, noise=R)
    one = estimator(own, engine=engine).run(ys)
    two = estimator(other, units=units, engine=engine).run(ys)
    np.testing.assert_allclose(two.states / units, one.states, rtol=1e-9, atol=1e-12)


def test_both_engines_snapshots_batches_and_derivatives_have_the_bounds():
    ys = record()
    cost = COSTS[0](prior=qpmhe.ObserverPrior(20.0), disturbance=Q, noise=R)
    python, compiled = (estimator(cost, engine=one) for one in ("python", "compiled"))
    run = python.run(ys[:30])
    np.testing.assert_allclose(compiled.run(ys[:30]).states, run.states, rtol=0, atol=1e-12)
    assert np.abs(run.states - estimator().run(ys[:30]).states).max() > 1e-3
    for mhe in (python, compiled):
        for twin in (copy.deepcopy(mhe), pickle.loads(pickle.dumps(mhe))):
            np.testing.assert_array_equal(twin.run(ys[30:]).states, copy.deepcopy(mhe).run(
                ys[30:]).states)
        text = r"cost\.prior\.kappa"
        with pytest.raises(InvalidInputError, match=text):
            estimator(engine=mhe.engine).load_state_dict(mhe.state_dict())
    weight = python._engine.solved().problem.prior.weight
    for mhe in (python, compiled):
        # What the window knows of its first state is this weight and its measurements.
        known = np.linalg.inv(mhe.covariances()[0]) - weight
        assert np.linalg.eigvalsh(known)[0] > 0.0
    ours, theirs = (mhe.sensitivity() for mhe in (python, compiled))
    for name in ("prior", "measurements", "prior_weight"):
        np.testing.assert_allclose(
            getattr(theirs, name), getattr(ours, name), rtol=1e-8, atol=1e-10
        )
    # The last state by the mean of the prior: what the bounded weight says, by least squares.
    np.testing.assert_allclose(ours.prior[-1], _by_prior_mean(weight, 6), rtol=1e-8, atol=1e-10)
    batch = qpmhe.BatchEstimator(
        python.system, python.observer, cost, members=2, horizon=6, max_qps=3,
        initial_states=[0.0, 0.0],
    )
    found = np.array([batch.update(np.tile(y, (2, 1))).states for y in ys[:30]])
    np.testing.assert_allclose(found[:, 1], run.states[1:], rtol=0, atol=1e-12)


def _by_prior_mean(weight, horizon):
    """Derivative (2, 2) of x(t+1) by z(t-N) in a least squares problem."""
    n = 2 * (horizon + 1)
    rows, sides = [np.eye(2, n)], [np.eye(2)]
    scale = [weight]
    for k in range(horizon):
        step = np.zeros((2, n))
        step[:, 2 * k : 2 * k + 4] = np.hstack((-A, np.eye(2)))
        seen = np.zeros((1, n))
        seen[:, 2 * k : 2 * k + 2] = C
        rows += [step, seen]
        sides += [np.zeros((2, 2)), np.zeros((1, 2))]
        scale += [np.linalg.inv(Q), np.linalg.inv(R)]
    matrix = np.vstack(rows)
    weights = np.zeros((len(matrix), len(matrix)))
    at = 0
    for each in scale:
        weights[at : at + len(each), at : at + len(each)] = each
        at += len(each)
    normal = matrix.T @ weights @ matrix
    return np.linalg.solve(normal, matrix.T @ weights @ np.vstack(sides))[-2:]


@pytest.mark.filterwarnings("always::qpmhe.errors.PriorWarning")
def test_a_constant_weight_beside_a_filter_warns_once():
    cost = COSTS[0](prior=P, disturbance=Q, noise=R)
    with pytest.warns(PriorWarning, match=SPEAKS) as caught:
        mhe = estimator(cost)
    assert len(caught) == 1
    assert issubclass(PriorWarning, ObserverWarning)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Never overridden: J has the given weight.
        np.testing.assert_array_equal(mhe.cost.prior, np.linalg.inv(P))
        mhe.run(record())
        mhe.reset()
        copy.deepcopy(mhe)
        pickle.loads(pickle.dumps(mhe))
        # Nothing depends on the weight without QPs, and a constant gain has no other.
        estimator(cost, max_qps=0)
        qpmhe.MovingHorizonEstimator(
            system(), qpmhe.Luenberger([0.3, 0.2]), cost, horizon=6, initial_state=[0.0, 0.0]
        )
    with pytest.warns(PriorWarning, match="SteadyStateKalman") as caught:
        qpmhe.MovingHorizonEstimator(
            system(), qpmhe.SteadyStateKalman(system(), [0.0, 0.0], disturbance=Q, noise=R), cost,
            horizon=6, initial_state=[0.0, 0.0],
        )
    assert len(caught) == 1
    make = partial(
        qpmhe.BatchEstimator, mhe.system, mhe.observer, cost, members=3, horizon=6,
        initial_states=[0.0, 0.0],
    )
    with pytest.warns(PriorWarning, match=SPEAKS) as caught:
        make()
    assert len(caught) == 1


def test_a_wrong_constant_prior_is_worse_than_its_filter_and_no_prior_is_not():
    """An unknown constant, seen through noise: the filter learns it, a short window forgets it."""
    rng = np.random.default_rng(5)
    model = qpmhe.System(lambda x: x, lambda x: x[..., :1], n=1, p=1)
    given = {"disturbance": [[1e-10]], "noise": [[1.0]]}
    kalman = qpmhe.ExtendedKalman(prior=[[25.0]], **given)
    ys = 3.0 + rng.standard_normal((400, 1))
    errors = []
    for prior, count in ((None, 0), (None, 2), ([[25.0]], 2)):
        cost = COSTS[0](prior=prior, **given)
        run = qpmhe.MovingHorizonEstimator(
            model, kalman, cost, horizon=10, initial_state=[0.0], max_qps=count
        ).run(ys)
        errors.append(float(np.sqrt(np.mean((run.filtered[200:] - 3.0) ** 2))))
    assert errors[1] == pytest.approx(errors[0], rel=1e-9)
    assert errors[2] > 4.0 * errors[0]
