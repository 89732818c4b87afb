"""Searches for trajectories that violate a certified bound: drawn at random, then made worse."""

from dataclasses import replace
from itertools import cycle, product
from types import SimpleNamespace

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


def attack_detectability(system, region, claim, *, trials, steps=20, polish=40):
    """Look for two trajectories in the region, with any disturbances, that violate (eq:eIOSS)."""
    rng = np.random.default_rng(0)
    u = any_inputs(region, trials, steps, rng)

    def shares(pairs):
        f1, f2 = (system.f.batch(x[:, :-1], u) for x in pairs)
        h1, h2 = (system.h.batch(x[:, :-1], u) for x in pairs)
        apart = np.linalg.norm(pairs[0] - pairs[1], axis=-1)
        w = np.linalg.norm((pairs[0][:, 1:] - f1) - (pairs[1][:, 1:] - f2), axis=-1)
        return share_of(apart, bounds(claim, apart[:, 0], w, np.linalg.norm(h1 - h2, axis=-1)))

    pairs = drawn_pairs(system, region, u, rng)
    share, width = shares(pairs).max(axis=1), (region.upper - region.lower)[: region.n]
    for i in range(polish):  # keep what raises the largest share of each
        move = 10.0 ** (-0.5 - 3.0 * i / polish) * width * rng.standard_normal(pairs.shape)
        other = inside(region, pairs + move * (rng.random((*pairs.shape[:-1], 1)) < 0.3))
        better = (new := shares(other).max(axis=1)) > share
        pairs = np.where(better[:, None, None], other, pairs)
        share = np.maximum(share, new)
    return float(share.max())


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


def drawn_pairs(system, region, u, rng):
    """Pairs of trajectories in the region, (2, trials, steps + 1, n), of five kinds."""
    (trials, steps), n = u.shape[:2], region.n
    points = region.sample(4 * trials, rng)[:, :n]
    sizes = 10.0 ** rng.uniform(-5.0, 0.0, (2, trials, 1))

    def any_point():
        return points[rng.integers(len(points), size=trials)]

    pairs = np.empty((2, trials, steps + 1, n))
    pairs[:, :, 0] = any_point(), any_point()
    near = pairs[0, :, 0] + sizes[0] * (pairs[1, :, 0] - pairs[0, :, 0])
    pairs[1, :, 0] = np.where(rng.random((trials, 1)) < 0.5, near, pairs[1, :, 0])
    kind = rng.integers(5, size=trials)[:, None]
    size = sizes[1] * (region.upper - region.lower)[:n]
    for t in range(steps):
        shared, own = size * rng.standard_normal((2, trials, n))
        quiet = (kind == 1) | ((kind == 2) & (rng.random((trials, 1)) > 0.1))
        ahead = [system.f.batch(pairs[i, :, t], u[:, t]) for i in (0, 1)]
        first = np.where(kind == 0, any_point(), ahead[0] + np.where(quiet, 0.0, shared))
        pairs[0, :, t + 1] = inside(region, first)
        second = ahead[1] + np.where(kind == 3, shared, np.where(quiet, 0.0, own))
        if t + 1 < steps:  # to first order, with the other one's output
            C = np.broadcast_to(
                system.h_jacobian.batch(ahead[1], u[:, t + 1]), (trials, system.p, n)
            )
            apart = system.h.batch(pairs[0, :, t + 1], u[:, t + 1])
            apart = apart - system.h.batch(ahead[1], u[:, t + 1])
            moved = ahead[1] + np.einsum("bnp,bp->bn", np.linalg.pinv(C), apart)
            second = np.where((kind == 4) & np.isfinite(moved), moved, second)
        pairs[1, :, t + 1] = inside(region, np.where(kind == 0, any_point(), second))
    return pairs


def bounds(claim, start, w, v):
    """The claimed bound of many runs at once, (B, T + 1)."""
    decay = claim.rate ** np.arange(w.shape[1] + 1.0)
    entering = claim.disturbance * w + claim.noise * v
    sums = np.array([decaying_sums(claim.rate, row) for row in entering])
    return claim.initial * start[:, None] * decay + claim.rate * sums


def share_of(error, bound):
    """Errors as shares of their bounds, but for the rounding of what they are differences of."""
    return np.maximum(error - ABSOLUTE, 0.0) / np.maximum(bound, ABSOLUTE)


def attack_estimator(certificate, *, trials, steps=15, backends=None, rounds=10, seed=0):
    """Look for runs of the estimator whose error exceeds a bound while the theorem applies.

    The worst runs are made worse. Returned are the largest shares of the paper's bound and of the
    monitor's, and how many errors were compared.
    """
    rng, region, found = np.random.default_rng(seed), certificate.region, []
    noises = list(product(NOISES, NOISES))
    rng.shuffle(noises)
    names = qpmhe.solvers.available() if backends is None else backends

    def play(trial):
        error, *known = played(certificate, trial)
        shares = [share_of(error, each).max(initial=0.0) for each in known]
        found.append((shares[-1], len(found), trial, shares, len(error)))
        return shares[-1]

    turns = zip(cycle(product(names, (0, 1, 2, 5))), cycle(noises), range(trials), strict=False)
    for (backend, cap), kinds, _ in turns:
        play(drawn_trial(certificate, backend, cap, kinds, steps, rng))
    ranked = sorted(found, reverse=True)
    # A large disturbance reaches its own bound one step later; without any, more can be found.
    silent = [each for each in ranked if not each[2].w.any()]
    for most, _, best, *_ in ranked[:2] + silent[:2]:
        for i in range(rounds):
            size = 10.0 ** (-0.3 - 2.0 * i / rounds)
            moved = {
                name: values + size * (np.abs(values).max() or 1e-3 * (name != "w"))
                * rng.standard_normal(values.shape)
                for name, values in vars(best).items() if name in ("start", "guess", "w", "v")
            }
            moved |= {name: inside(region, moved[name]) for name in ("start", "guess")}
            other = SimpleNamespace(**vars(best) | moved)
            if (reached := play(other)) > most:
                best, most = other, reached
    return *np.max([each[3] for each in found], axis=0), sum(each[4] for each in found)


def drawn_trial(certificate, backend, cap, kinds, steps, rng):
    system, region = certificate.system, certificate.region
    n, width = system.n, (region.upper - region.lower)[: system.n]
    points = region.sample(8, rng)
    start, other = inside(region, points[rng.integers(len(points), size=2), :n])
    size = max(1e-3, float(np.abs(system.h.batch(points[:, :n], points[:, n:])).max()))
    return SimpleNamespace(
        start=start, guess=inside(region, start + 10.0 ** rng.uniform(-3.0, 0.0) * (other - start)),
        w=10.0 ** rng.uniform(-4.0, -0.5) * width * NOISES[kinds[0]](rng, steps, n),
        v=10.0 ** rng.uniform(-4.0, -0.5) * size * NOISES[kinds[1]](rng, steps, system.p),
        u=any_inputs(region, 1, steps, rng)[0], backend=backend, cap=cap,
    )


def played(certificate, trial):
    """Errors of a run while the certificate applies, the paper's bound and the monitor's."""
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
        initial_state=trial.guess, backend=trial.backend, max_qps=trial.cap,
    )
    start = x[0] - mhe.observer_state
    paper = certificate.of().result.bound(np.linalg.norm(start), *signals)[1:]
    watch = Monitor(
        certificate, mhe, initial_error=start, sizes=Sizes(*(float(e.max()) for e in signals))
    )
    error, known = [], []
    for t, u in enumerate(trial.u):
        given = u if system.m else None
        estimate = mhe.update(y[t], given)
        reading = watch.check(estimate, given)
        if not watch.applies:
            break
        error.append(np.linalg.norm(x[t + 1] - estimate.state))
        known.append(reading.error if reading.lost is None else np.inf)
    return np.array(error), paper[: len(error)], np.array(known)


def with_wrong_bound(certificate):
    """The same, with a bound of the observer that claims too much."""
    bound = certificate.observer_bound
    wrong = replace(bound.stability, P=100.0 * bound.metric, rho=0.3)
    object.__setattr__(certificate, "observer_bound", replace(bound, stability=wrong))
    return certificate
