"""Weights, bounds, parameters and sensors that change from sample to sample, against Ipopt."""

from functools import cache

import numpy as np
import pytest

import qpmhe

from .nlp import Window, ca
from .test_kalman import spd

HORIZON, STEPS = 5, 14
START = np.array([0.9, -0.2])
GAIN = np.array([[0.3, 0.05], [0.05, 0.3]])
P, Q, R = np.diag([4.0, 2.0]), np.array([[60.0, 10.0], [10.0, 40.0]]), np.diag([25.0, 16.0])
WIDE = {name: qpmhe.Box([-9.0, -9.0], [9.0, 9.0]) for name in ("states", "disturbances", "noises")}


def step(x, u, sin):
    """A pendulum with a push u[0], and damping u[1] and stiffness u[2] as parameters."""
    return [x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - u[1] * x[1] - u[2] * sin(x[0]))]


def f(x, u):
    if isinstance(x, np.ndarray):
        return np.stack(step(np.moveaxis(x, -1, 0), np.moveaxis(u, -1, 0), np.sin), axis=-1)
    return ca.vertcat(*step([x[0], x[1]], [u[0], u[1], u[2]], ca.sin))


def h(x, u):
    if isinstance(x, np.ndarray):
        return np.stack([x[..., 0] + 0.1 * x[..., 1] ** 2, x[..., 1] * u[..., 2]], axis=-1)
    return ca.vertcat(x[0] + 0.1 * x[1] ** 2, x[1] * u[2])


class Record:
    """A simulated record, and what each sample is taken with, all sets around the truth."""

    def __init__(self, kind, seed):
        rng = np.random.default_rng(seed)
        x, self.samples = START + rng.normal(0.0, 0.3, 2), []
        changing = set(kind.split("+"))
        for _ in range(STEPS):
            own, parameters = {}, np.array([0.3, 2.0])
            if "weights" in changing and rng.random() < 0.7:
                own["noise_weight"] = 20.0 * spd(rng, 2)
            if "weights" in changing and rng.random() < 0.7:
                own["disturbance_weight"] = 50.0 * spd(rng, 2)
            if "parameters" in changing and rng.random() < 0.7:
                own["parameters"] = parameters = parameters * rng.uniform(0.5, 2.0, 2)
            u = np.append(rng.normal(0.0, 1.0, 1), parameters)
            w, v = rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.2, 0.2, 2)
            following = f(x, u) + w
            if "bounds" in changing and rng.random() < 0.8:
                own["bounds"] = {
                    "states": _around(np.array([x, following]), rng.uniform(0.02, 0.3, 2)),
                    "disturbances": _around(w[None], rng.uniform(0.02, 0.2, 2)),
                    "noises": _around(v[None], rng.uniform(0.02, 0.3, 2)),
                }
            y = h(x, u) + v
            if "sensors" in changing and rng.random() < 0.6:
                y[rng.integers(2)] = np.nan
                own["sensors"] = np.flatnonzero(np.isfinite(y))
            self.samples.append((y, u, own))
            x = following

    def feed(self, mhe):
        for y, u, own in self.samples:
            yield mhe.update(y[np.isfinite(y)], u[:1], **own)

    def window(self, estimate):
        count = len(estimate.disturbances)
        ys, us, owns = zip(*self.samples[estimate.time + 1 - count :][:count], strict=True)
        bounds = [WIDE | own.get("bounds", {}) for own in owns]
        return Window(
            f, h, np.array(ys), estimate.candidate[0], (
                P, [own.get("disturbance_weight", Q) for own in owns],
                [own.get("noise_weight", R) for own in owns],
            ), us=us, boxes={name: [one[name] for one in [*bounds, bounds[-1]]] for name in WIDE},
        )


def _around(points, half):
    return qpmhe.Box(points.min(axis=0) - half, points.max(axis=0) + half)


KINDS = [
    "weights", "parameters", "sensors", "bounds", "weights+parameters+sensors",
    "weights+parameters+sensors+bounds",
]


record = cache(Record)


def estimator(kind, symbolic=False, **options):
    sets = WIDE if "bounds" in kind else {}
    if symbolic:
        system = qpmhe.from_casadi(f, h, n=2, m=3, **sets)
    else:
        system = qpmhe.System(f, h, n=2, p=2, m=3, **sets)
    cost = qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=HORIZON, initial_state=START,
        parameters=[0.3, 2.0], solver_tolerance=1e-10, tolerance=1e-11, **options,
    )


@pytest.mark.parametrize("symbolic", [False, True], ids=["numpy", "casadi"])
@pytest.mark.parametrize("kind", KINDS)
def test_convergence_is_ipopts_minimum_with_the_same_data(kind, symbolic):
    compared = 0
    for seed in range(3):
        one = record(kind, seed)
        for t, estimate in enumerate(one.feed(estimator(kind, symbolic, max_qps=None))):
            if t % 3 != 1 and t < STEPS - 1:
                continue
            if not estimate.improved:  # there may be no way below an infeasible candidate's cost
                continue
            assert estimate.dropped == ()
            J, trajectory = one.window(estimate).minimum(estimate.candidate)
            assert estimate.cost == pytest.approx(J, rel=1e-6)
            np.testing.assert_allclose(estimate.trajectory, trajectory, rtol=0, atol=2e-4)
            compared += 1
    assert compared >= (8 if "bounds" in kind else 15)


def test_the_observer_is_in_the_set_of_each_sample():
    """Also where that came only with the next sample, and after a late measurement."""
    moved = 0
    for seed in range(6):
        one, boxes = record("bounds", seed), []
        mhe = estimator("bounds", max_qps=0)
        for t, estimate in enumerate(one.feed(mhe)):
            boxes.append((WIDE | one.samples[t][2].get("bounds", {}))["states"])
            if t in (5, 9):
                estimate = mhe.amend(t - 2, one.samples[t - 2][0] + 0.1)
            first = t + 1 - len(estimate.disturbances)
            for x, box in zip(estimate.candidate, [*boxes[first:], boxes[-1]], strict=True):
                assert box.violation(x) == 0.0
                moved += np.any((x == box.lower) | (x == box.upper))
    assert moved > 50
