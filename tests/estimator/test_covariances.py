"""Covariances of the window's states against the dense inverse of the Hessian."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError

from .plain import Record, differences, spd


class Case:
    """An estimator beside the plain record of what it was given."""

    def __init__(
        self, sizes=(2, 1), horizon=4, discount=1.0, missing=0.0, losses=None, free=(), sets=None,
        **options,
    ):
        n, p = sizes
        self.n, self.p, self.missing, self.free = n, p, missing, list(free)
        self.generator = generator = np.random.default_rng(10 * n + p)
        a, c = 0.6 * generator.standard_normal((n, n)), generator.standard_normal((p, n))

        def f(x):
            return np.sin(x @ a.T) + 0.3 * x

        def h(x):
            return x @ c.T + 0.2 * x[..., :1] ** 2

        self.f, gain = f, 0.1 * generator.standard_normal((n, p))
        gain[self.free] = 0.0
        weights = [spd(generator, n), spd(generator, n), spd(generator, p)]
        terms = zip(("prior", "disturbance", "noise"), weights, strict=True)
        self.cost = (qpmhe.RobustCost if losses else qpmhe.QuadraticCost)(
            **{name: losses(one) if losses else one for name, one in terms}, discount=discount
        )
        upper = np.full(n, np.inf)
        upper[self.free] = 0.0
        if free:
            sets = {"disturbances": qpmhe.Box(-upper, upper)}
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

    def check(self, trajectory):
        """The blocks of the inverse Hessian of the majorising forms, where noise-free rows hold."""
        hessian, n = self.kept.hessian(trajectory, self.cost), self.n
        slopes = differences(self.kept.residuals, trajectory)
        exact = slopes[:, self.free].reshape(-1, trajectory.size)
        basis = np.linalg.svd(exact)[2][len(exact) :].T if self.free else np.eye(len(hessian))
        inverse = basis @ np.linalg.inv(basis.T @ hessian @ basis) @ basis.T
        found = self.mhe.covariances()
        expected = [inverse[k : k + n, k : k + n] for k in range(0, len(inverse), n)]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        found[:] = 0.0  # the user's


@pytest.mark.parametrize("options", [
    {"sizes": (1, 1), "missing": 0.4, "max_qps": 3}, {"sizes": (2, 3), "missing": 1.0},
    {"discount": 0.4, "horizon": 1}, {"sizes": (3, 2), "discount": 0.95, "missing": 0.4},
    {"sets": {"states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0])}},  # inequalities do not enter
    {"sizes": (2, 2), "missing": 0.3, "discount": 0.8, "losses": lambda w: qpmhe.Huber(w, 0.3)},
    {"sizes": (3, 2), "free": [0, 2], "missing": 0.3}, {"sizes": (3, 2), "free": [0, 1, 2]},
], ids=lambda one: " ".join(one))
def test_they_are_the_blocks_of_the_inverse_hessian(options):
    """With noise weights of samples and late measurements; asking for them changes nothing."""
    case, twin = Case(**options), Case(**options)
    with pytest.raises(InvalidInputError, match="no estimate yet; call update"):
        case.mhe.covariances()
    for t in range(9):
        own = {"noise_weight": spd(np.random.default_rng(t), case.p)} if t % 2 else {}
        estimate, other = case.update(**own), twin.update(**own)
        np.testing.assert_array_equal(estimate.trajectory, other.trajectory)
        case.check(estimate.trajectory)
    late, when = np.full(case.p, 0.3), 9 - case.kept.count
    estimate = case.mhe.amend(when, late)
    case.kept.amend(when, late)
    case.check(estimate.trajectory)


def test_there_are_none_without_jacobians_or_along_a_stage_that_failed():
    def root(f=np.sqrt, gain=0.9, start=1.0, **options):
        return qpmhe.MovingHorizonEstimator(
            qpmhe.System(f, lambda x: x, n=1, p=1, **options), qpmhe.Luenberger([gain]),
            qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0),
            horizon=3, initial_state=[start], max_qps=0,
        )

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
