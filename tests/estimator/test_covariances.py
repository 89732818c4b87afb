"""Covariances of the window's states against the dense inverse of the Hessian."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

from . import plain
from .plain import Record, spd

SIZES = [(1, 1), (2, 1), (3, 2), (2, 3)]


class Case:
    """An estimator beside the plain record of what it was given."""

    def __init__(
        self, sizes=(2, 1), horizon=4, discount=1.0, missing=0.0, sets=None, losses=None,
        observer=None, **options,
    ):
        n, p = sizes
        self.n, self.p, self.missing = n, p, missing
        self.generator = generator = np.random.default_rng(10 * n + p)
        a, c = 0.6 * generator.standard_normal((n, n)), generator.standard_normal((p, n))

        def f(x):
            return np.sin(x @ a.T) + 0.3 * x

        def h(x):
            return x @ c.T + 0.2 * x[..., :1] ** 2

        self.f, gain = f, 0.1 * generator.standard_normal((n, p))
        weights = [spd(generator, n), spd(generator, n), spd(generator, p)]
        given = dict(zip(("prior", "disturbance", "noise"), weights, strict=True))
        if losses:
            cost = qpmhe.RobustCost(
                **{name: losses(weight) for name, weight in given.items()}, discount=discount
            )
        else:
            if observer:
                given["prior"] = qpmhe.ObserverPrior()
            cost = qpmhe.QuadraticCost(**given, discount=discount)
        start = generator.standard_normal(n)
        self.mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(f, h, n=n, p=p, **(sets or {})), observer or qpmhe.Luenberger(gain), cost,
            horizon=horizon, initial_state=start, **options,
        )
        self.cost = cost
        self.kept = Record(h, gain, start, weights, horizon, discount=discount)

    def update(self, **own):
        y = self.generator.standard_normal(self.p)
        y[self.generator.random(self.p) < self.missing] = np.nan
        self.kept.push(self.f, y, own.get("noise_weight"))
        return self.mhe.update(y, **own)


def blocks(matrix, n):
    return np.array([matrix[k : k + n, k : k + n] for k in range(0, len(matrix), n)])


def close(found, expected):
    assert found.shape == expected.shape
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * scale)


@pytest.mark.parametrize("max_qps", [0, 1, 3])
@pytest.mark.parametrize("missing", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("sizes", SIZES)
def test_they_are_the_blocks_of_the_inverse_hessian(sizes, missing, max_qps):
    case = Case(sizes, missing=missing, max_qps=max_qps)
    for t in range(8):
        estimate = case.update()
        found = case.mhe.covariances()
        assert found.shape == (min(t + 1, 4) + 1, sizes[0], sizes[0])
        np.testing.assert_allclose(found, np.swapaxes(found, 1, 2), rtol=1e-9, atol=1e-12)
        hessian = case.kept.hessian(estimate.trajectory)
        close(found, blocks(np.linalg.inv(hessian), sizes[0]))


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("discount", [0.4, 0.95])
@pytest.mark.parametrize("horizon", [1, 4])
def test_discounted_costs(horizon, discount, missing):
    case = Case((3, 2), horizon, discount, missing)
    for _ in range(7):
        estimate = case.update()
        hessian = case.kept.hessian(estimate.trajectory)
        close(case.mhe.covariances(), blocks(np.linalg.inv(hessian), 3))


def test_noise_weights_of_single_samples():
    case = Case((2, 2), missing=0.2)
    for t in range(9):
        own = {"noise_weight": spd(case.generator, 2)} if t % 2 else {}
        estimate = case.update(**own)
        hessian = case.kept.hessian(estimate.trajectory)
        close(case.mhe.covariances(), blocks(np.linalg.inv(hessian), 2))


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_robust_costs_have_the_hessian_of_their_majorising_forms(discount):
    case = Case((2, 2), missing=0.3, discount=discount, losses=lambda w: qpmhe.Huber(w, 0.3))
    kept = case.kept
    for _ in range(7):
        estimate = case.update()
        trajectory, count = estimate.trajectory, kept.count
        total = np.zeros((trajectory.size, trajectory.size))
        total[:2, :2] = discount**count * case.cost.majorise_prior(
            trajectory[0] - kept.z[kept.first], kept.P
        )
        residuals = kept.residuals(trajectory)
        for i, slope in enumerate(plain.differences(kept.residuals, trajectory)):
            joint = case.cost.joint_weight(kept.weight(kept.first + i))
            weight = case.cost.majorise(residuals[i : i + 1], joint[None])[0]
            total += discount ** (count - 1 - i) * slope.T @ weight @ slope
        close(case.mhe.covariances(), blocks(np.linalg.inv(total), 2))


# Components without noise


def reduced_inverse(kept, trajectory, free, n):
    """The inverse Hessian on trajectories whose free components follow the model."""
    hessian = kept.hessian(trajectory)
    slopes = plain.differences(kept.residuals, trajectory)[:, free].reshape(-1, trajectory.size)
    basis = np.linalg.svd(slopes)[2][len(slopes) :].T
    return blocks(basis @ np.linalg.inv(basis.T @ hessian @ basis) @ basis.T, n)


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("free", [[0], [1], [0, 2], [0, 1, 2]], ids=str)
def test_noise_free_components(free, missing):
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    lower[free] = upper[free] = 0.0
    # The candidate's corrections must stay off the components without noise.
    case = Case((3, 2), missing=missing, sets={"disturbances": qpmhe.Box(lower, upper)})
    gain = case.kept.gain
    gain[free] = 0.0
    case.mhe.observer.gain[:] = gain
    for _ in range(7):
        estimate = case.update()
        assert estimate.dropped == ()
        assert np.abs(estimate.disturbances[:, free]).max() < 1e-12
        expected = reduced_inverse(case.kept, estimate.trajectory, free, 3)
        close(case.mhe.covariances(), expected)


def test_inequalities_do_not_enter():
    case = Case((2, 1), sets={"states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0])})
    for _ in range(5):
        estimate = case.update()
        hessian = case.kept.hessian(estimate.trajectory)
        close(case.mhe.covariances(), blocks(np.linalg.inv(hessian), 2))


# Against the Kalman filter


def kalman(a, c, covariance, q, r, missing):
    """Covariances of the predictions, one by one."""
    predicted = [covariance]
    for there in missing:
        if there:
            gain = covariance @ c.T @ np.linalg.inv(c @ covariance @ c.T + r)
            covariance = covariance - gain @ c @ covariance
        covariance = a @ covariance @ a.T + q
        predicted.append(covariance)
    return predicted


@pytest.mark.parametrize("horizon", [1, 4])
def test_with_the_prior_of_a_kalman_observer_the_last_is_the_filters(horizon):
    generator = np.random.default_rng(5)
    a, c = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[1.0, 0.5]])
    prior, q, r = spd(generator, 2), 0.1 * spd(generator, 2), np.array([[0.5]])
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1),
        qpmhe.ExtendedKalman(prior=prior, disturbance=q, noise=r),
        qpmhe.QuadraticCost.from_covariances(
            prior=qpmhe.ObserverPrior(), disturbance=q, noise=r
        ),
        horizon=horizon, initial_state=[0.0, 0.0],
    )
    there = generator.random(15) < 0.8
    expected = kalman(a, c, prior, q, r, there)
    for t, seen in enumerate(there):
        mhe.update(generator.standard_normal(1) if seen else None)
        np.testing.assert_allclose(mhe.covariances()[-1], expected[t + 1], rtol=1e-8, atol=1e-10)


def test_errors_are_as_large_as_their_covariances_say():
    # Prior, disturbance and noise drawn as the weights say: the squared errors, weighed by
    # the inverse covariances, are chi squared with n degrees of freedom.
    generator = np.random.default_rng(6)
    a, c = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[1.0, 0.5]])
    squares = []
    for _ in range(150):
        x = generator.standard_normal(2)
        mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1),
            qpmhe.Luenberger([0.0, 0.0]),
            qpmhe.QuadraticCost.from_covariances(
                prior=np.eye(2), disturbance=0.04 * np.eye(2), noise=0.25
            ),
            horizon=5, initial_state=[0.0, 0.0],
        )
        states = [x]
        for _ in range(5):
            estimate = mhe.update(c @ x + 0.5 * generator.standard_normal(1))
            x = a @ x + 0.2 * generator.standard_normal(2)
            states.append(x)
        errors = estimate.trajectory - np.array(states)
        squares.append(
            [e @ np.linalg.solve(s, e) for e, s in zip(errors, mhe.covariances(), strict=True)]
        )
    # The mean of 150 such has a standard deviation of 0.16.
    np.testing.assert_allclose(np.mean(squares, axis=0), 2.0, atol=0.6)


# Errors and side effects


def test_there_are_none_without_an_estimate():
    mhe = Case().mhe
    with pytest.raises(InvalidInputError, match="no estimate yet; update first"):
        mhe.covariances()
    mhe.update([1.0])
    assert mhe.covariances().shape == (2, 2, 2)
    mhe.reset()
    with pytest.raises(InvalidInputError, match="no estimate yet; update first"):
        mhe.covariances()


def test_an_empty_record_has_them_in_their_shape():
    assert Case().mhe.run(np.empty((0, 1)), covariances=True).covariances.shape == (0, 2, 2)


@pytest.mark.parametrize(
    ("jacobian", "text"),
    [
        pytest.param(lambda x: 0.5 / np.sqrt(x)[..., None], "not finite", id="infinite"),
        pytest.param(lambda x: [[0.5 / float(x[0]) ** 0.5]], "no Jacobians", id="raises"),
    ],
)
def test_there_are_none_without_jacobians(jacobian, text):
    system = qpmhe.System(np.sqrt, lambda x: x, n=1, p=1, f_jacobian=jacobian)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[0.0], max_qps=0,
    )
    mhe.update([1.0])
    with pytest.raises(InvalidInputError, match=text):
        mhe.covariances()


@pytest.mark.parametrize("root", [np.sqrt, lambda x: [math.sqrt(x[0])]], ids=["NaN", "raises"])
def test_there_are_none_along_a_stage_that_failed(root):
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(root, lambda x: x, n=1, p=1), qpmhe.Luenberger([0.9]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[1.0], max_qps=0,
    )
    for y in (1.0, -5.0, 1.0, 1.0):
        estimate = mhe.update([y])
    assert estimate.cost == math.inf
    assert (estimate.trajectory[:-1] < 0.0).any()
    with pytest.raises(InvalidInputError, match="along the estimate"):
        mhe.covariances()


def test_asking_changes_nothing():
    asked, twin = Case(missing=0.2), Case(missing=0.2)
    for _ in range(10):
        one, other = asked.update(), twin.update()
        first = asked.mhe.covariances()
        np.testing.assert_array_equal(asked.mhe.covariances(), first)
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        first[:] = 0.0
        assert asked.mhe.covariances().any()


def test_they_follow_an_amended_measurement():
    case = Case(missing=0.0)
    for _ in range(6):
        case.update()
    for age, y in ((1, [0.3]), (3, [-0.8])):
        estimate = case.mhe.amend(5 - age, y)
        case.kept.amend(5 - age, y)
        hessian = case.kept.hessian(estimate.trajectory)
        close(case.mhe.covariances(), blocks(np.linalg.inv(hessian), 2))


def test_a_run_goes_on_where_there_are_no_covariances():
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(np.sqrt, lambda x: x, n=1, p=1), qpmhe.Luenberger([0.9]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=2, initial_state=[1.0], max_qps=0,
    )
    run = mhe.run([1.0, -5.0, 1.0, 1.0, 1.0, 1.0, 1.0], covariances=True)
    assert len(run) == 7
    known = np.isfinite(run.covariances[:, 0, 0])
    assert known[0]
    assert known[-1]
    assert not known.all()
