"""Losses whose QPs have several minima: the check judges the step, not the branch that it takes."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
]
# Ranges to one tag, in metres. With the first ones, rounding decides between two branches.
ANCHORS = {
    "in sight": [[2.58, -0.87, 1.97], [-0.37, -0.13, 1.39], [2.31, 0.87, 0.5], [0.34, -0.87, 0.5]],
    "hidden": [[2.21, 0.19, 1.79], [-0.36, -0.46, 1.97], [0.71, -0.87, 0.61], [-0.05, 0.87, 0.5]],
}


def tag(anchors):
    """A walking tag: its place and velocity, and ranges to the anchors at 1 m."""
    pytest.importorskip("casadi")
    tag = pytest.importorskip("examples.gallery.outdoor_uwb.tag")
    return tag.model(np.array(anchors))


@pytest.mark.parametrize("where", ANCHORS)
@pytest.mark.parametrize("loss", [qpmhe.Cauchy, qpmhe.GemanMcClure])
def test_two_branches_of_a_loss_do_not_convict_the_compiler(loss, where):
    P, Q, R = np.diag([25.0, 25.0, 1.0, 1.0]), 0.05**2 * np.eye(2), 0.2**2 * np.eye(4)
    cost = qpmhe.RobustCost(
        prior=np.linalg.inv(P), disturbance=np.linalg.inv(Q),
        noise=loss(np.linalg.inv(R), per_component=True),
    )
    system = tag(ANCHORS[where])
    observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R, innovation=qpmhe.Gate())
    options = {
        "horizon": 80, "initial_state": [5.0, 0.0, 0.0, 0.0], "max_qps": 5, "warm_start": True,
    }
    engines = [
        qpmhe.MovingHorizonEstimator(system, observer, cost, engine=engine, **options)
        for engine in ("python", "compiled")
    ]
    assert engines[1].engine == "compiled"  # a warning, and an error here, if the check convicts
    rng, x = np.random.default_rng(3), np.array([5.0, 1.0, 0.3, -0.2])
    for _ in range(30):
        x = np.append(x[:2] + 0.1 * x[2:], x[2:])
        y = np.asarray(system.h(x, [0.1])) + 0.2 * rng.standard_normal(4)
        y[rng.random(4) < 0.1] += 3.0
        for one in engines:
            estimate = one.update(y, [0.1])
            assert 0.0 <= estimate.cost <= estimate.candidate_cost
