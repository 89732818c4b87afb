"""Covariances of the window's states against the dense inverse of the Hessian."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

from . import plain
from .plain import Record, spd


class Case:
    """An estimator beside the plain record of what it was given."""

    def __init__(
        self, sizes=(2, 1), horizon=4, discount=1.0, missing=0.0, sets=None, losses=None, free=(),
        **options,
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
        gain[list(free)] = 0.0
        weights = [spd(generator, n), spd(generator, n), spd(generator, p)]
        make = qpmhe.RobustCost if losses else qpmhe.QuadraticCost
        self.cost = make(
            **{name: losses(weight) if losses else weight for name, weight in zip(
                ("prior", "disturbance", "noise"), weights, strict=True
            )}, discount=discount,
        )
        start = generator.standard_normal(n)
        self.mhe = qpmhe.MovingHorizonEstimator(
            qpmhe.System(f, h, n=n, p=p, **(sets or {})), qpmhe.Luenberger(gain), self.cost,
            horizon=horizon, initial_state=start, **options,
        )
        self.kept = Record(h, gain, start, weights, horizon, discount=discount)

    def update(self, **own):
        y = self.generator.standard_normal(self.p)
        y[self.generator.random(self.p) < self.missing] = np.nan
        self.kept.push(self.f, y, own.get("noise_weight"))
        return self.mhe.update(y, **own)

    def check(self, hessian, basis=None):
        """Compare with the blocks of the inverse of a Hessian, on a basis of the trajectories."""
        basis = np.eye(len(hessian)) if basis is None else basis
        inverse = basis @ np.linalg.inv(basis.T @ hessian @ basis) @ basis.T
        found, n = self.mhe.covariances(), self.n
        expected = [inverse[k : k + n, k : k + n] for k in range(0, len(inverse), n)]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("options", [
    {"sizes": (1, 1), "missing": 0.4, "max_qps": 3}, {"sizes": (3, 2), "max_qps": 0},
    {"sizes": (2, 3), "missing": 1.0}, {"discount": 0.4, "horizon": 1},
    {"sizes": (3, 2), "discount": 0.95, "missing": 0.4},
    {"sets": {"states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0])}},  # inequalities do not enter
])
def test_they_are_the_blocks_of_the_inverse_hessian(options):
    """With noise weights of samples and late measurements; asking for them changes nothing."""
    case, twin = Case(**options), Case(**options)
    with pytest.raises(InvalidInputError, match="no estimate yet; call update"):
        case.mhe.covariances()
    empty = case.mhe.run(np.empty((0, case.p)), covariances=True).covariances
    assert empty.shape == (0, case.n, case.n)
    for t in range(9):
        own = {"noise_weight": spd(np.random.default_rng(t), case.p)} if t % 2 else {}
        estimate, other = case.update(**own), twin.update(**own)
        np.testing.assert_array_equal(estimate.trajectory, other.trajectory)
        case.check(case.kept.hessian(estimate.trajectory))
        first = case.mhe.covariances()
        assert first.shape == (len(estimate.trajectory), case.n, case.n)
        first[:] = 0.0
        case.check(case.kept.hessian(estimate.trajectory))
    late, when = np.full(case.p, 0.3), 9 - case.kept.count
    estimate = case.mhe.amend(when, late)
    case.kept.amend(when, late)
    case.check(case.kept.hessian(estimate.trajectory))
    case.mhe.reset()
    with pytest.raises(InvalidInputError, match="no estimate yet; call update"):
        case.mhe.covariances()


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_robust_costs_have_the_hessian_of_their_majorising_forms(discount):
    case = Case((2, 2), missing=0.3, discount=discount, losses=lambda w: qpmhe.Huber(w, 0.3))
    kept = case.kept
    for _ in range(7):
        trajectory, count = case.update().trajectory, kept.count
        total = np.zeros((trajectory.size, trajectory.size))
        total[:2, :2] = discount**count * case.cost.majorise_prior(
            trajectory[0] - kept.z[kept.first], kept.P
        )
        residuals = kept.residuals(trajectory)
        for i, slope in enumerate(plain.differences(kept.residuals, trajectory)):
            joint = case.cost.joint_weight(kept.weight(kept.first + i))
            weight = case.cost.majorise(residuals[i : i + 1], joint[None])[0]
            total += discount ** (count - 1 - i) * slope.T @ weight @ slope
        case.check(total)


@pytest.mark.parametrize("free", [[0], [0, 2], [0, 1, 2]], ids=str)
def test_noise_free_components_follow_the_model(free):
    upper = np.full(3, np.inf)
    upper[free] = 0.0
    case = Case((3, 2), missing=0.3, free=free, sets={"disturbances": qpmhe.Box(-upper, upper)})
    for _ in range(7):
        estimate = case.update()
        assert np.abs(estimate.disturbances[:, free]).max() < 1e-12
        slopes = plain.differences(case.kept.residuals, estimate.trajectory)[:, free]
        slopes = slopes.reshape(-1, estimate.trajectory.size)
        basis = np.linalg.svd(slopes)[2][len(slopes) :].T
        case.check(case.kept.hessian(estimate.trajectory), basis)


def root(f=np.sqrt, gain=0.9, start=1.0, **options):
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, lambda x: x, n=1, p=1, **options), qpmhe.Luenberger([gain]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
        horizon=3, initial_state=[start], max_qps=0,
    )


def test_there_are_none_without_jacobians_or_along_a_stage_that_failed():
    steep, raises = (
        {"f_jacobian": slope, "gain": 0.0, "start": 0.0} for slope in (
            lambda x: 0.5 / np.sqrt(x)[..., None], lambda x: [[0.5 / float(x[0]) ** 0.5]]
        )
    )
    for given, text, *ys in (
        (steep, "not finite", 1.0), (raises, "no Jacobians", 1.0),
        ({}, "along the estimate", 1.0, -5.0, 1.0, 1.0),
        ({"f": lambda x: [math.sqrt(x[0])]}, "along the estimate", 1.0, -5.0, 1.0, 1.0),
    ):
        mhe = root(**given)
        for y in ys:
            mhe.update([y])
        with pytest.raises(InvalidInputError, match=text):
            mhe.covariances()


def test_a_run_goes_on_where_there_are_no_covariances():
    run = root().run([1.0, -5.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], covariances=True)
    known = np.isfinite(run.covariances[:, 0, 0])
    assert (len(run), known[0], known[-1], known.all()) == (8, True, True, False)
