"""Runs that look for an error above the bounds of a Lyapunov design."""

import itertools

import numpy as np

import qpmhe
from qpmhe.certificates import Sizes

from .attacks import NOISES, inside

KINDS = "minimiser", "measured"


def scalar():
    system = qpmhe.System(lambda x: 1.2 * x, lambda x: x, n=1, p=1)
    return system, qpmhe.Box([-10.0], [10.0]), Sizes(0.1, 0.2), [[0.8]]


def swap():
    A = np.array([[0.0, 1.0], [1.1, 0.0]])
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    return system, qpmhe.Box([-10.0, -10.0], [10.0, 10.0]), Sizes(0.1, 0.2), [[0.0], [1.1]]


def reactor():
    system, observer, *_ = qpmhe.models.batch_reactor()
    return system, qpmhe.Box([0.1, -1.0], [9.0, 9.0]), Sizes(0.03, 0.06), observer.gain


def bent_output():
    def f(x):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + 0.1 * b, 0.9 * b - 0.1 * np.sin(a)], -1)

    system = qpmhe.System(f, lambda x: x[..., :1] + 0.1 * np.sin(x[..., :1]), n=2, p=1)
    return system, qpmhe.Box([-2.0, -2.0], [2.0, 2.0]), Sizes(0.01, 0.02), [[0.4], [0.1]]


def attack(plan, gain, *, trials, steps=25, seed=0):
    """The largest error as a share of each bound, and how many errors were compared.

    Runs count within the region; those of a minimiser while J is at most the truth's.
    """
    rng, system, region = np.random.default_rng(seed), plan.system, plan.region
    horizons = sorted({1, 3, plan.least_horizon(), min(plan.horizon, 20)})
    turns = itertools.cycle(itertools.product(horizons, (0, 1, 2, None)))
    shares, compared, kinds = dict.fromkeys(KINDS, 0.0), 0, list(NOISES)
    nothing = np.zeros(system.m)
    for (N, cap), _ in zip(turns, range(trials), strict=False):
        points = region.sample(8, rng)[:, : system.n]
        start, other = points[rng.integers(len(points), size=2)]
        start, guess = (
            inside(region, 0.7 * start),
            inside(region, 0.7 * start + 10.0 ** rng.uniform(-3.0, 0.0) * (other - 0.7 * start)),
        )
        w, v = (
            bounded(rng, NOISES[rng.choice(kinds)](rng, steps, width), size)
            for width, size in ((system.n, plan.sizes.disturbance), (system.p, plan.sizes.noise))
        )
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(gain), plan.cost(), horizon=N, initial_state=guess,
            max_qps=cap, candidate="reinitialized", engine="python", project_observer=False,
        )
        pushing, x, lasts, lowest = rng.random() < 0.5, [start], steps, np.zeros(steps, bool)
        estimates = []
        for t in range(steps):
            if pushing:
                gap = mhe.state - x[-1]
                w[t] = -plan.sizes.disturbance * gap / max(float(np.linalg.norm(gap)), 1e-300)
            ahead = np.asarray(system.f(x[-1], nothing))
            estimates.append(mhe.update(system.h(x[-1], nothing) + v[t]))
            x.append(ahead + w[t])
            latest = estimates[-1]
            lowest[t] = latest.cost <= true_cost(plan, latest, x, w, v)
            seen = np.vstack((x[-1:], latest.candidate, latest.trajectory))
            if not region.contains(seen).all():
                lasts = t
                break
        if not lasts:
            continue
        run, x, count = qpmhe.estimation.run.Run.of(guess, estimates), np.array(x), len(estimates)
        away = run.states - x
        error = np.sqrt(np.einsum("ti,ij,tj->t", away, plan.prior, away))
        for kind in KINDS:
            until = lasts
            if kind == "minimiser":
                until = int(np.argmin(np.append(lowest[:lasts], False)))
            bound = plan.along(
                run, mhe, initial_error=start - guess, disturbances=w[:count], noises=v[:count],
                kind=kind,
            )[1 : until + 1]
            there = bound > 1e-9
            ratio = error[1 : until + 1][there] / bound[there]
            shares[kind] = max(shares[kind], float(ratio.max(initial=0.0)))
            compared += int(there.sum())
    return shares, compared


def bounded(rng, noise, size):
    """Vectors whose lengths are at most a size, and often this size."""
    lengths = np.linalg.norm(noise, axis=1, keepdims=True)
    full = noise / np.maximum(lengths, 1e-300) * (lengths > 0.0)
    return float(size) * (full if rng.random() < 0.5 else noise / max(1e-300, float(lengths.max())))


def true_cost(plan, estimate, x, w, v):
    """J of the truth, with the prior of an estimate's window."""
    K, t = len(estimate.trajectory) - 1, estimate.time + 1
    ages = plan.discount ** np.arange(K - 1.0, -1.0, -1.0)
    own = x[t - K] - estimate.candidate[0]
    stages = np.einsum("ti,ij,tj->t", w[t - K : t], plan.disturbance, w[t - K : t])
    stages = stages + np.einsum("ti,ij,tj->t", v[t - K : t], plan.noise, v[t - K : t])
    return float(plan.discount**K * own @ plan.prior @ own + ages @ stages)
