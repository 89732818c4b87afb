"""Covariances of the window's states against the dense inverse of the Hessian."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Barron, Cauchy
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError

from .plain import Record, differences, spd
from .spoil import check, estimator, observer_alone
from .systems import swing

RNG = np.random.default_rng(0)
WEIGHTS, GAIN, START = [spd(RNG, 2), spd(RNG, 2), spd(RNG, 3)], 0.1 * np.ones((2, 3)), np.ones(2)


def h(x):
    return np.stack([x[..., 0], x[..., 1] + 0.2 * x[..., 0] ** 2, x[..., 1]], axis=-1)


@pytest.mark.parametrize(("horizon", "discount", "missing", "loss", "free"), [
    (4, 1.0, 0.4, None, []), (1, 0.4, 0.0, None, []), (4, 0.95, 1.0, None, []),
    (3, 0.8, 0.3, lambda W: qpmhe.Huber(W, 0.3), []), (4, 1.0, 0.3, None, [0]),
    (4, 1.0, 0.0, None, [0, 1]),
], ids=["gaps", "one sample", "nothing", "huber", "noise-free", "no noise"])
def test_they_are_the_blocks_of_the_inverse_hessian(horizon, discount, missing, loss, free):
    """With noise weights of samples and late measurements; asking for them changes nothing."""
    generator, gain, upper = np.random.default_rng(1), GAIN.copy(), np.full(2, np.inf)
    gain[free] = upper[free] = 0.0
    terms = dict(zip(("prior", "disturbance", "noise"), WEIGHTS, strict=True))
    cost = qpmhe.QuadraticCost(**terms, discount=discount)
    if loss:
        terms = {name: loss(weight) for name, weight in terms.items()}
        cost = qpmhe.RobustCost(**terms, discount=discount)
    # Inequalities do not enter.
    sets = {"states": qpmhe.Box([-9.0] * 2, [9.0] * 2), "disturbances": qpmhe.Box(-upper, upper)}
    mhe, twin = (
        qpmhe.MovingHorizonEstimator(
            qpmhe.System(swing, h, n=2, p=3, **sets), qpmhe.Luenberger(gain), cost,
            horizon=horizon, initial_state=START,
        )
        for _ in range(2)
    )
    kept = Record(h, gain, START, WEIGHTS, horizon, discount)

    def check(trajectory):
        hessian = kept.hessian(trajectory, cost)
        slopes = differences(kept.residuals, trajectory)
        exact = slopes[:, free].reshape(-1, trajectory.size)
        basis = np.linalg.svd(exact)[2][len(exact) :].T if free else np.eye(len(hessian))
        inverse = basis @ np.linalg.inv(basis.T @ hessian @ basis) @ basis.T
        found = mhe.covariances()
        expected = [inverse[k : k + 2, k : k + 2] for k in range(0, len(inverse), 2)]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        found[:] = 0.0  # the user's

    with pytest.raises(InvalidInputError, match="no estimate yet; call update"):
        mhe.covariances()
    for t in range(8):
        y, own = generator.standard_normal(3), {"noise_weight": spd(generator, 3)} if t % 2 else {}
        y[generator.random(3) < missing] = np.nan
        kept.push(swing, y, **own)
        estimate = mhe.update(y, **own)
        np.testing.assert_array_equal(estimate.trajectory, twin.update(y, **own).trajectory)
        check(estimate.trajectory)
    late, when = np.full(3, 0.3), 8 - kept.count
    kept.amend(when, late)
    check(mhe.amend(when, late).trajectory)


def test_there_are_none_without_jacobians_or_along_a_stage_that_failed():
    def root(f=np.sqrt, gain=0.9, start=1.0, **options):
        system = qpmhe.System(f, lambda x: x, n=1, p=1, **options)
        return observer_alone(system, qpmhe.Luenberger([gain]), [start])

    # Without derivative at -1 and beside it.
    still = {"gain": 0.0, "start": -1.0, "f": lambda x: np.sqrt(np.maximum(x, 0.0))}
    infinite = {"f_jacobian": lambda x: 0.5 / np.sqrt(np.maximum(x, 0.0))[..., None]}
    raising = {"f_jacobian": lambda x: [[0.5 / max(float(x[0]), 0.0) ** 0.5]]}
    for given, text, *ys in (
        (infinite | still, "not finite", 1.0), (raising | still, "no Jacobians", 1.0),
        ({"f": lambda x: [math.sqrt(x[0])]}, "along the estimate", 1.0, -5.0, 1.0, 1.0),
    ):
        mhe = root(**given)
        mhe.run(ys)
        with pytest.raises(InvalidInputError, match=text):
            mhe.covariances()
    # A run goes on.
    known = np.isfinite(root().run([1.0, -5.0] + [1.0] * 6, covariances=True).covariances[:, 0, 0])
    assert (len(known), known[0], known[-1], known.all()) == (8, True, True, False)


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_weights_that_vanish_are_named_and_those_of_noises_are_missing_measurements(engine):
    """Of redescending losses: zero is named, a weight of 1e-22 is a variance of 1e22."""
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    weights = {"prior": np.eye(2), "disturbance": np.eye(2), "noise": np.eye(1)}

    def of_loss(term, loss):
        cost = qpmhe.RobustCost(**weights | {term: loss(weights[term])})
        return estimator(cost=cost, initial_state=[0.0, 0.0], max_qps=0, engine=engine)

    for loss in (
        lambda weight: Barron(weight, -math.inf, 0.3), lambda weight: Cauchy(weight, 0.3),
        lambda weight: Barron(weight, -math.inf, 0.3, per_component=True),
    ):
        mhe = of_loss("disturbance", loss)
        run = mhe.run([0.0, 0.0, 1e11, 1e11], covariances=True)
        known, vanishes = np.isfinite(run.covariances).all(axis=(1, 2)), "Cauchy" not in repr(mhe)
        assert known[[0, 1, 3]].tolist() == [True, True, not vanishes]
        if vanishes:
            check(InvalidInputError, ["weights", "undetermined", "Huber"], mhe.covariances)
        else:
            for newest in (run.covariances[3], mhe.covariances()[-1]):
                assert newest.diagonal().min() > 1e20
                assert np.linalg.eigvalsh(newest)[0] > 0.0
        # After the outlier the observer is far from the last measurement, too.
        outlier, missing = of_loss("noise", loss), of_loss("noise", loss)
        outlier.run([0.0, 1e11, 0.0])
        missing.run([0.0, None, None])
        np.testing.assert_allclose(
            outlier.covariances(), missing.covariances(), rtol=1e-9, atol=1e-15
        )


def filtered_and_smoothed(a, c, noise, prior, disturbance, missing):
    """Covariances of a linear window by a Kalman filter with Rauch-Tung-Striebel, in 60 digits."""
    mp = pytest.importorskip("mpmath")
    with mp.workdps(60):
        def exact(array):
            return mp.matrix(np.asarray(array).tolist())

        ahead, steps = exact(prior), []
        for i in range(len(a)):
            here, before, output, move = ahead, ahead, exact(c[i]), exact(a[i])
            if not missing[i]:
                spread = output * before * output.T + exact(noise)
                here = before - before * output.T * spread**-1 * output * before
            ahead = move * here * move.T + exact(disturbance)
            steps.append((here, move, ahead))
        found = [ahead]
        for here, move, following in reversed(steps):
            gain = here * move.T * following**-1
            found.insert(0, here + gain * (found[0] - following) * gain.T)
        n = len(prior)
        return np.array([[float(one[i, j]) for i in range(n) for j in range(n)] for one in found])


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize(("n", "p", "directions"), [(2, 1, 2), (2, 1, 1), (4, 2, 4), (8, 2, 3)])
def test_vague_priors_against_60_digits(n, p, directions, engine):
    """Priors of 1 to 1e10 deviations of the noise; outputs along no axis, gaps, odd units."""
    if engine == "compiled" and (find_compiler() is None or n == 4):
        pytest.skip("one large and two small libraries are enough, where there is a compiler")
    rng = np.random.default_rng(n + directions)
    units = 10.0 ** rng.integers(-6, 7, n)
    a = (np.eye(n) + np.triu(rng.normal(size=(n, n)), 1) / n) * np.multiply.outer(units, 1 / units)
    c = rng.normal(size=(p, n)) / units
    b = units[:, None] * rng.normal(size=(n, directions))
    noise = np.diag(10.0 ** rng.uniform(-1, 0, p))
    q = np.diag(10.0 ** rng.uniform(-3, 0, directions))
    shape = rng.normal(size=(n, n))
    shape = units[:, None] * (shape @ shape.T / n + np.eye(n)) * units
    singular = {"disturbance_matrix": b} if directions < n else {}
    whole = b @ q @ b.T
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=n, p=p, **singular)
    horizon = 12
    missing, ys = rng.random(horizon) < 0.2, rng.normal(size=(horizon, p))
    ys[missing] = np.nan
    given = {"disturbance": q if singular else whole, "noise": noise}
    for deviations in (1.0, 1e3, 1e6, 1e8, 1e10):
        prior = deviations**2 * shape
        for observer, weight in (
            (qpmhe.Luenberger(np.zeros((n, p))), prior),
            (qpmhe.ExtendedKalman(prior=prior, **given), qpmhe.ObserverPrior()),
        ):
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, qpmhe.QuadraticCost.from_covariances(prior=weight, **given),
                horizon=horizon, initial_state=np.zeros(n), engine=engine, max_qps=1,
            )
            mhe.run(ys)
            assert mhe.engine == engine
            found, right = mhe.covariances(), filtered_and_smoothed(
                [a] * horizon, [c] * horizon, noise, prior, whole, missing
            ).reshape(-1, n, n)
            deviation = np.sqrt(np.diagonal(right, axis1=1, axis2=2))
            scale = deviation[:, :, None] * deviation[:, None, :]
            assert np.abs((found - right) / scale).max() < 1e-11
            assert np.linalg.eigvalsh(found / scale).min() > -1e-15
            np.testing.assert_array_equal(found, found.transpose(0, 2, 1))


def test_a_direction_of_the_prior_alone_is_right_to_1e10_deviations_and_refused_beyond():
    n, horizon = 3, 8
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    spin = np.eye(n)
    spin[:2, :2] = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    a, c = turn @ spin @ turn.T, np.array([[*rng.normal(size=2), 0.0]]) @ turn.T
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=n, p=1)

    def of(deviations):
        given = {"disturbance": 1e-4 * np.eye(n), "noise": [[1.0]]}
        given["prior"] = deviations**2 * np.eye(n)
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(np.zeros((n, 1))),
            qpmhe.QuadraticCost.from_covariances(**given), horizon=horizon,
            initial_state=np.zeros(n), max_qps=0,
        )
        mhe.run(np.zeros(horizon))
        return mhe.covariances(), given

    for deviations, allowed in ((1e3, 1e-12), (1e6, 1e-12), (1e8, 1e-12), (1e10, 1e-9)):
        found, given = of(deviations)
        right = filtered_and_smoothed(
            [a] * horizon, [c] * horizon, given["noise"], given["prior"], given["disturbance"],
            [False] * horizon,
        ).reshape(-1, n, n)
        deviation = np.sqrt(np.diagonal(right, axis1=1, axis2=2))
        gap = (found - right) / (deviation[:, :, None] * deviation[:, None, :])
        assert np.abs(gap).max() < allowed
    for deviations in (1e13, 1e15, 1e20):
        check(InvalidInputError, ["weights", "undetermined"], of, deviations)


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_a_run_keeps_those_of_its_steps_beside_a_vague_prior(engine):
    """From the first sample on, after which nothing is known of a direction along no axis."""
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    a, c = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.7]])
    given = {"disturbance": np.diag([1e-2, 1e-4]), "noise": np.eye(1), "prior": 1e12 * np.eye(2)}
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T, n=2, p=1),
        qpmhe.Luenberger(np.zeros((2, 1))), qpmhe.QuadraticCost.from_covariances(**given),
        horizon=8, initial_state=np.zeros(2), engine=engine, max_qps=1,
    )
    run = mhe.run(np.random.default_rng(0).normal(size=(8, 1)), covariances=True)
    for count, found in enumerate(run.covariances, 1):
        right = filtered_and_smoothed(
            [a] * count, [c] * count, given["noise"], given["prior"], given["disturbance"],
            [False] * count,
        )[-1].reshape(2, 2)
        scale = np.sqrt(np.multiply.outer(right.diagonal(), right.diagonal()))
        assert np.abs((found - right) / scale).max() < 1e-9
