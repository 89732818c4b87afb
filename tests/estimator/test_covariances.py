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

    still = {"gain": 0.0, "start": 0.0}
    for given, text, *ys in (
        ({"f_jacobian": lambda x: 0.5 / np.sqrt(x)[..., None], **still}, "not finite", 1.0),
        ({"f_jacobian": lambda x: [[0.5 / float(x[0]) ** 0.5]], **still}, "no Jacobians", 1.0),
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
    """Of redescending losses, to zero and to a number that is lost in rounding."""
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
        check(InvalidInputError, ["weights", "undetermined", "Huber"], mhe.covariances)
        known = np.isfinite(run.covariances).all(axis=(1, 2))
        assert known[[0, 1, 3]].tolist() == [True, True, False]
        # After the outlier the observer is far from the last measurement, too.
        outlier, missing = of_loss("noise", loss), of_loss("noise", loss)
        outlier.run([0.0, 1e11, 0.0])
        missing.run([0.0, None, None])
        np.testing.assert_allclose(
            outlier.covariances(), missing.covariances(), rtol=1e-9, atol=1e-15
        )
