"""Searches for trajectories that violate a certified bound: drawn at random, then made worse."""

from dataclasses import dataclass, replace
from itertools import cycle, product

import numpy as np

import qpmhe
from qpmhe.certificates import Monitor, Sizes
from qpmhe.certificates.theorem import decaying_sums

# Of two numbers computed in floating point, one exceeds the other by more than this, or not.
RELATIVE, ABSOLUTE = 1e-9, 1e-12

#: Kinds of noise of size about 1: (generator, steps, width) to (steps, width).
NOISES = {
    "none": lambda rng, steps, width: np.zeros((steps, width)),
    "normal": lambda rng, *shape: rng.standard_normal(shape),
    "signs": lambda rng, *shape: rng.choice([-1.0, 1.0], shape),
    "constant": lambda rng, steps, width: np.tile(rng.choice([-1.0, 1.0], width), (steps, 1)),
    "sine": lambda rng, steps, width: np.sin(
        np.outer(np.arange(steps), rng.uniform(0.1, 3.0, width)) + rng.uniform(0.0, 6.0, width)
    ),
    "ramp": lambda rng, steps, width: np.linspace(0.0, 1.0, steps)[:, None]
    * rng.choice([-1.0, 1.0], width),
    "impulses": lambda rng, *shape: rng.standard_normal(shape) * (rng.random((shape[0], 1)) < 0.1),
    "heavy tails": lambda rng, *shape: np.clip(rng.standard_t(2.0, shape), -30.0, 30.0),
}


@dataclass
class Attack:
    """The largest error as a share of its bound, and the run that reaches it."""

    ratio: float
    refuted: bool
    compared: int
    example: dict


def attack_detectability(system, region, claim, *, trials, steps=20, polish=40):
    """Look for two trajectories in the region that violate (eq:eIOSS).

    Disturbances may be anything, so any two sequences of states in the region are two
    trajectories.
    """
    rng = np.random.default_rng(0)
    u = any_inputs(region, trials, steps, rng)

    def shares(pairs):
        f1, f2 = (system.f.batch(x[:, :-1], u) for x in pairs)
        h1, h2 = (system.h.batch(x[:, :-1], u) for x in pairs)
        apart = np.linalg.norm(pairs[0] - pairs[1], axis=-1)
        w = np.linalg.norm((pairs[0][:, 1:] - f1) - (pairs[1][:, 1:] - f2), axis=-1)
        return apart, bounds(claim, apart[:, 0], w, np.linalg.norm(h1 - h2, axis=-1))

    def change(pairs, size):
        width = (region.upper - region.lower)[: region.n]
        move = size * width * rng.standard_normal(pairs.shape)
        return inside(region, pairs + move * (rng.random((*pairs.shape[:-1], 1)) < 0.3))

    return verdict(*polished(drawn_pairs(system, region, u, rng), shares, change, polish))


def attack_observer(system, region, gain, claim, *, trials, steps=30, polish=40):
    """Look for a run of an observer with constant gain that violates (eq:RGES).

    A run counts as long as the observer's state stays in the region; the true one does
    throughout.
    """
    rng, n, p = np.random.default_rng(0), system.n, system.p
    u = any_inputs(region, trials, steps, rng)
    truth = drawn_pairs(system, region, u, rng)[0]
    scale = np.abs(system.h.batch(truth[:, 0], u[:, 0])).max() + 1e-3
    noises = sizes(trials, rng) * scale * rng.standard_normal((trials, steps, p))
    noises *= rng.random((trials, steps, 1)) < rng.choice([0.0, 0.1, 1.0], (trials, 1, 1))
    points = region.sample(trials, rng)[:, :n]
    starts = points[rng.integers(len(points), size=trials)]
    near = rng.random((trials, 1)) < 0.5
    starts = np.where(near, inside(region, truth[:, 0] + 0.05 * (starts - truth[:, 0])), starts)
    # One array of all that may be changed: true states, noises, and the observer's start.
    runs = np.zeros((trials, steps + 1, n + p + n))
    runs[..., :n], runs[:, :-1, n : n + p], runs[:, 0, n + p :] = truth, noises, starts
    width = (region.upper - region.lower)[:n]
    widths = np.concatenate((width, np.full(p, scale), width))

    def shares(several):
        runs = several[0]
        x, v, z = runs[..., :n], runs[:, :-1, n : n + p], runs[:, 0, n + p :]
        y = system.h.batch(x[:, :-1], u) + v
        w = x[:, 1:] - system.f.batch(x[:, :-1], u)
        alive = np.ones((trials, steps + 1), bool)
        error = np.empty((trials, steps + 1))
        error[:, 0] = np.linalg.norm(x[:, 0] - z, axis=-1)
        for t in range(steps):
            alive[:, t + 1] = alive[:, t] & region.contains(z)
            held = np.where(alive[:, t + 1, None], z, x[:, t])
            z = system.f.batch(held, u[:, t]) + (y[:, t] - system.h.batch(held, u[:, t])) @ gain.T
            error[:, t + 1] = np.linalg.norm(x[:, t + 1] - z, axis=-1)
        bound = bounds(claim, error[:, 0], np.linalg.norm(w, axis=-1), np.linalg.norm(v, axis=-1))
        return np.where(alive, error, np.nan), bound

    def change(several, size):
        move = size * widths * rng.standard_normal(several.shape)
        moved = several + move * (rng.random((*several.shape[:-1], 1)) < 0.3)
        for part in (slice(0, n), slice(n + p, None)):
            moved[..., part] = inside(region, moved[..., part])
        return moved

    return verdict(*polished(runs[None], shares, change, polish))


def inside(region, points):
    """Points of the region: those inside as they are, others drawn in."""
    drawn = np.clip(points, region.lower[: region.n], region.upper[: region.n])
    out = ~region.contains(drawn)
    if not out.any():
        return drawn
    centre = region.sample(1, np.random.default_rng(0))[0, : region.n]
    share = np.ones((*out.shape, 1))
    while out.any():
        share[out] *= 0.8
        out = ~region.contains(centre + share * (drawn - centre))
    return np.where(share < 1.0, centre + share * (drawn - centre), drawn)


def any_inputs(region, trials, steps, rng):
    low, high = region.lower[region.n :], region.upper[region.n :]
    return low + (high - low) * rng.random((trials, steps, low.size))


def sizes(trials, rng):
    """Sizes of noise from none to large, one a trajectory."""
    return 10.0 ** rng.uniform(-5.0, 0.0, (trials, 1, 1)) * (rng.random((trials, 1, 1)) > 0.1)


def drawn_pairs(system, region, u, rng):
    """Pairs of trajectories in the region, (2, trials, steps + 1, n).

    Some have any states, others the same, small, rare or no disturbances, or differences
    hidden from the output.
    """
    (trials, steps), n = u.shape[:2], region.n
    points = region.sample(4 * trials, rng)[:, :n]
    width = (region.upper - region.lower)[:n]

    def any_point():
        return points[rng.integers(len(points), size=trials)]

    pairs = np.empty((2, trials, steps + 1, n))
    pairs[:, :, 0] = any_point(), any_point()
    near = pairs[0, :, 0] + sizes(trials, rng)[:, 0] * (pairs[1, :, 0] - pairs[0, :, 0])
    pairs[1, :, 0] = np.where(rng.random((trials, 1)) < 0.5, near, pairs[1, :, 0])
    kind = rng.integers(5, size=trials)[:, None]
    size = sizes(trials, rng)[:, 0] * width
    for t in range(steps):
        shared, own = size * rng.standard_normal((2, trials, n))
        quiet = (kind == 1) | ((kind == 2) & (rng.random((trials, 1)) > 0.1))
        ahead = [system.f.batch(pairs[i, :, t], u[:, t]) for i in (0, 1)]
        first = np.where(kind == 0, any_point(), ahead[0] + np.where(quiet, 0.0, shared))
        pairs[0, :, t + 1] = inside(region, first)
        second = ahead[1] + np.where(kind == 3, shared, np.where(quiet, 0.0, own))
        if t + 1 < steps:
            moved = hidden(system, ahead[1], pairs[0, :, t + 1], u[:, t + 1])
            second = np.where(kind == 4, moved, second)
        pairs[1, :, t + 1] = inside(region, np.where(kind == 0, any_point(), second))
    return pairs


def hidden(system, points, like, u):
    """Points moved so that, to first order, they have the outputs of others."""
    C = np.broadcast_to(system.h_jacobian.batch(points, u), (len(points), system.p, system.n))
    apart = system.h.batch(like, u) - system.h.batch(points, u)
    moved = points + np.einsum("bnp,bp->bn", np.linalg.pinv(C), apart)
    return np.where(np.isfinite(moved), moved, points)


def bounds(claim, start, w, v):
    """The claimed bound of many runs at once, (B, T + 1)."""
    decay = claim.rate ** np.arange(w.shape[1] + 1.0)
    entering = claim.disturbance * w + claim.noise * v
    sums = np.array([decaying_sums(claim.rate, row) for row in entering])
    return claim.initial * start[:, None] * decay + claim.rate * sums


def share_of(error, bound):
    """Errors as shares of their bounds; those within rounding of nothing do not count."""
    return np.where(error > ABSOLUTE, error / np.maximum(bound, ABSOLUTE), 0.0)


def polished(states, shares, change, rounds):
    """Change what is drawn at random, and keep what raises the largest share of each."""
    error, bound = shares(states)
    for i in range(rounds):
        other = change(states, 10.0 ** (-0.5 - 3.0 * i / max(1, rounds)))
        other_error, other_bound = shares(other)
        better = share_of(other_error, other_bound).max(axis=1) > share_of(error, bound).max(axis=1)
        states = np.where(better.reshape((1, -1) + (1,) * (states.ndim - 2)), other, states)
        error = np.where(better[:, None], other_error, error)
        bound = np.where(better[:, None], other_bound, bound)
    return error, bound


def verdict(error, bound):
    share = share_of(error, bound)
    worst = int(share.max(axis=1).argmax())
    return Attack(
        float(share.max()), bool((error > bound * (1.0 + RELATIVE) + ABSOLUTE).any()),
        int(np.isfinite(error).sum()), {"error": error[worst], "bound": bound[worst]},
    )


@dataclass
class Trial:
    """What may be changed to make a run of the estimator worse."""

    start: np.ndarray
    estimate: np.ndarray
    w: np.ndarray
    v: np.ndarray
    u: np.ndarray
    backend: str
    cap: int


def attack_estimator(
    certificate, *, trials, steps=15, backends=None, caps=(0, 1, 2, 5), polished=4, rounds=10,
    seed=0,
):
    """Look for runs of the estimator whose error exceeds a bound of the certificate.

    Backends, caps and kinds of noise take turns; sizes are drawn over four decades. The worst
    runs are then made worse. Runs count as long as the monitor lets the certificate apply;
    returned are the attacks on the paper's bound and on the monitor's, and how many runs it let
    go.
    """
    rng = np.random.default_rng(seed)
    noises = list(product(NOISES, NOISES))
    rng.shuffle(noises)
    names = qpmhe.solvers.available() if backends is None else backends
    found = []

    def play(trial):
        error, *bounds = played(certificate, trial)
        found.append((share_of(error, bounds[-1]).max(), trial, error, bounds))
        return found[-1][0]

    turns = zip(cycle(product(names, caps)), cycle(noises), range(trials), strict=False)
    for (backend, cap), kinds, _ in turns:
        play(drawn_trial(certificate, backend, cap, kinds, steps, rng))
    ranked = sorted(found, key=lambda each: -each[0])
    # A large disturbance reaches its own bound one step later; without any, more can be found.
    silent = [each for each in ranked if not each[1].w.any()]
    for most, best, *_ in ranked[: polished - polished // 2] + silent[: polished // 2]:
        for i in range(rounds):
            other = worse(certificate.region, best, 10.0 ** (-0.3 - 2.0 * i / rounds), rng)
            if (reached := play(other)) > most:
                best, most = other, reached
    error = np.array([each[2] for each in found])
    attacks = [verdict(error, np.array([each[3][k] for each in found])) for k in (0, 1)]
    return *attacks, sum(int(np.isnan(row).any()) for row in error)


def drawn_trial(certificate, backend, cap, kinds, steps, rng):
    system, region = certificate.system, certificate.region
    n, width = system.n, (region.upper - region.lower)[: system.n]
    points = region.sample(8, rng)
    start, other = inside(region, points[rng.integers(len(points), size=2), :n])
    estimate = inside(region, start + 10.0 ** rng.uniform(-3.0, 0.0) * (other - start))
    w = 10.0 ** rng.uniform(-4.0, -0.5) * width * NOISES[kinds[0]](rng, steps, n)
    size = max(1e-3, float(np.abs(system.h.batch(points[:, :n], points[:, n:])).max()))
    v = 10.0 ** rng.uniform(-4.0, -0.5) * size * NOISES[kinds[1]](rng, steps, system.p)
    return Trial(start, estimate, w, v, any_inputs(region, 1, steps, rng)[0], backend, cap)


def worse(region, trial, size, rng):
    """The same run, with everything moved a little."""

    def moved(values):
        scale = float(np.abs(values).max(initial=0.0)) or 1e-3
        return values + size * scale * rng.standard_normal(values.shape)

    return replace(
        trial, start=inside(region, moved(trial.start)),
        estimate=inside(region, moved(trial.estimate)),
        w=moved(trial.w) if trial.w.any() else trial.w, v=moved(trial.v),
    )


def played(certificate, trial):
    """Error of a run, NaN once the certificate is lost, the paper's bound and the monitor's."""
    system, region = certificate.system, certificate.region
    x, y, w = [trial.start], [], []
    for noise, disturbance, u in zip(trial.v, trial.w, trial.u, strict=True):
        y.append(system.h(x[-1], u) + noise)
        ahead = np.asarray(system.f(x[-1], u))
        x.append(inside(region, ahead + disturbance))
        w.append(x[-1] - ahead)
    signals = [np.linalg.norm(each, axis=1) for each in (w, trial.v)]
    mhe = qpmhe.MovingHorizonEstimator(
        system, certificate.observer, certificate.cost, horizon=next(iter(certificate.constants)),
        initial_state=trial.estimate, backend=trial.backend, max_qps=trial.cap,
    )
    start = x[0] - mhe.observer_state
    watch = Monitor(
        certificate, mhe, initial_error=start, sizes=Sizes(*(float(e.max()) for e in signals))
    )
    error, known = np.full((2, len(y)), np.nan)
    for t, u in enumerate(trial.u):
        given = u if system.m else None
        estimate = mhe.update(y[t], given)
        reading = watch.check(estimate, given)
        if watch.applies:
            error[t] = np.linalg.norm(x[t + 1] - estimate.state)
            known[t] = np.inf if np.isnan(reading.error) else reading.error
    paper = certificate.of().result.bound(np.linalg.norm(start), *signals)[1:]
    return error, paper, known
