"""Steps of another length, and noises of another weight, sample by sample."""

import math

import numpy as np
import pytest

import qpmhe

from .plain import spd
from .systems import GAIN, seen

GENERATOR = np.random.default_rng(1)
P, Q, R = spd(GENERATOR, 2), spd(GENERATOR, 2), spd(GENERATOR, 2)
DT, START = 0.1, [0.5, 0.0]


def free(x):
    return np.stack([x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0]], axis=-1)


def driven(x, u):
    push = u[..., 0] - u[..., 1] * x[..., 0]
    return free(x) + np.stack([0.0 * push, push], axis=-1)


def looped(x, u):
    return [x[1], (1.0 - math.pow(x[0], 2)) * x[1] - x[0] + u[0] - u[1] * x[0]]


def slope(x, u=None):
    value = np.zeros((*x.shape, 2), dtype=x.dtype)
    value[..., 0, 1] = 1.0
    value[..., 1, 0] = -2.0 * x[..., 0] * x[..., 1] - 1.0 - (0.0 if u is None else u[..., 1])
    value[..., 1, 1] = 1.0 - x[..., 0] ** 2
    return value


RATES = {
    "free": (free, 0, {}), "free, given": (free, 0, {"rate_jacobian": slope}),
    "driven": (driven, 2, {}), "driven, looped": (looped, 2, {}),
    "driven, looped, given": (looped, 2, {"rate_jacobian": slope}),
}


def system_of(way="free", h=seen, **options):
    rate, m, given = RATES[way]
    return qpmhe.System.from_ode(rate, h, n=2, p=2, m=m, **{"dt": DT} | given | options)


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("way", RATES)
def test_the_timed_system_is_the_one_of_that_step(way, method):
    timed, m = system_of(way, method=method).timed, RATES[way][1]
    assert (timed.n, timed.p, timed.m) == (2, 2, m + 1)
    lengths, rng = [0.02, 0.1, 0.35, 1.0], np.random.default_rng(2)
    x, u = rng.uniform(-1.0, 1.0, (4, 2)), rng.standard_normal((4, m))
    extended = np.column_stack([u, lengths])
    for name in ("f", "h", "f_jacobian", "h_jacobian"):
        rtol = 1e-6 if "jacobian" in name and way == "driven, looped" else 1e-12
        together = np.asarray(getattr(timed, name).batch(x, extended))
        for i, dt in enumerate(lengths):
            expected = getattr(system_of(way, method=method, dt=dt), name)(x[i], u[i])
            found = getattr(timed, name)(x[i], extended[i])
            np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)
            np.testing.assert_allclose(together[i], expected, rtol=rtol, atol=rtol)


def test_what_the_timed_system_keeps():
    box = qpmhe.Box([-9.0, -9.0], [9.0, 9.0])
    system = system_of(states=box, disturbances=box, noises=box)
    assert system.dt == DT
    assert system.timed is system.timed
    assert system.timed.states is system.timed.disturbances is system.timed.noises is box
    # Outputs do not see the step.
    timed, x = system_of("driven", lambda x, u: seen(x) * u[..., :1]).timed, np.array([0.5, -0.3])
    found = timed.h.batch(np.tile(x, (3, 1)), np.tile([2.0, 7.0, 0.35], (3, 1)))
    np.testing.assert_allclose(found, [2.0 * seen(x)] * 3, rtol=1e-13)


def estimator(way="free", discount=1.0, **options):
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R, discount=discount)
    return qpmhe.MovingHorizonEstimator(
        system_of(way), qpmhe.Luenberger(GAIN), cost, initial_state=START, **options
    )


def test_a_step_of_the_usual_length_may_be_named():
    plainly, named = estimator(horizon=4), estimator(horizon=4)
    for t, y in enumerate(np.random.default_rng(4).standard_normal((12, 2))):
        one, other = plainly.update(y), named.update(y, dt=DT if t % 3 else None)
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-9, atol=1e-10)


def test_a_noise_weight_of_one_output_may_be_a_scalar():
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1), qpmhe.Luenberger([0.0]),
        qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0), horizon=3, initial_state=[0.0],
        max_qps=0,
    )
    for weight in (np.array([[3.0]]), 3.0, [[3.0]]):
        mhe.reset()
        assert mhe.update([2.0], noise_weight=weight).cost == pytest.approx(12.0)
