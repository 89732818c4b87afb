"""Adversaries: trajectories, noises and first guesses that look for an error above a bound."""

from itertools import cycle, islice, product
from types import SimpleNamespace

import numpy as np

import qpmhe
from qpmhe.certificates import Monitor, Sizes
from qpmhe.estimation.run import Run

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
    "impulses": lambda rng, *shape: rng.standard_normal(shape) * (rng.random((shape[0], 1)) < 0.1),
}


def share_of(error, bound):
    """Errors as shares of their bounds, but for the rounding of what they are differences of."""
    return np.maximum(error - ABSOLUTE, 0.0) / np.maximum(bound, ABSOLUTE)


def drawn_inputs(region, *shape, rng):
    low, high = region.lower[region.n :], region.upper[region.n :]
    return low + (high - low) * rng.random((*shape, low.size))


def attack_detectability(system, region, claim, *, trials, steps=15):
    """Largest distance of two trajectories in the region as a share of its bound (eq:eIOSS)."""
    rng, n = np.random.default_rng(0), region.n
    low, high, u = region.lower[:n], region.upper[:n], drawn_inputs(region, trials, steps, rng=rng)
    x, w = np.empty((2, trials, steps + 1, n)), np.empty((2, trials, steps, n))
    # Most pairs begin close to each other, many differ in some components alone.
    x[:, :, 0] = rng.uniform(low, high, (2, trials, n))
    share = 10.0 ** rng.uniform(-5.0, 0.0, (trials, 1)) * (rng.random((trials, n)) < 0.6)
    x[1, :, 0] = x[0, :, 0] + share * (x[1, :, 0] - x[0, :, 0])
    size = 10.0 ** rng.uniform(-5.0, 0.0, (trials, 1)) * rng.integers(2, size=(trials, 1))
    for i, t in product((0, 1), range(steps)):
        ahead = system.f.batch(x[i, :, t], u[:, t])
        moved = ahead + size * (high - low) * rng.standard_normal(ahead.shape)
        x[i, :, t + 1] = np.clip(moved, low, high)
        w[i, :, t] = x[i, :, t + 1] - ahead
    h = [system.h.batch(each[:, :-1], u) for each in x]
    apart, *signals = (np.linalg.norm(one - other, axis=-1) for one, other in (x, w, h))
    return max(
        share_of(each[1:], claim.bound(each[0], *acting)[1:]).max()
        for each, *acting in zip(apart, *signals, strict=True)
    )


def drawn(system, region, steps, rng, largest=None):
    """A run's start, first guess, inputs, and disturbances and noises of any kind.

    They are of any sizes, or often as long as the ``largest``. Half of the disturbances are turned
    against the estimate.
    """
    n, found, sizes = region.n, [], largest or (region.diameter, 1.0)
    low, high = region.lower[:n], region.upper[:n]
    start, other = 0.5 * (low + high) + 0.35 * (high - low) * rng.uniform(-1.0, 1.0, (2, n))
    guess = start + 10.0 ** rng.uniform(-3.0, 0.0) * (other - start)
    for width, size in zip((n, system.p), sizes, strict=True):
        noise = NOISES[rng.choice(list(NOISES))](rng, steps, width)
        lengths = np.linalg.norm(noise, axis=1, keepdims=True)
        longest = lengths if largest and rng.random() < 0.5 else lengths.max()
        shrunk = 1.0 if largest else 10.0 ** rng.uniform(-4.0, -0.5)
        found.append(shrunk * size * noise / np.maximum(longest, 1e-300))
    return SimpleNamespace(
        start=start, guess=guess, w=found[0], v=found[1], pushes=rng.random() < 0.5,
        u=drawn_inputs(region, steps, rng=rng),
    )


def played(mhe, region, trial):
    """States, which are kept in the region, the disturbances that do so, and the estimates."""
    system, n, x, w, estimates = mhe.system, region.n, [trial.start], [], []
    for u, disturbance, noise in zip(trial.u, trial.w, trial.v, strict=True):
        gap = x[-1] - mhe.state
        if trial.pushes and (length := np.linalg.norm(gap)) > 0.0:
            disturbance = np.linalg.norm(disturbance) / length * gap
        y = system.h(x[-1], u) + noise
        estimates.append(mhe.update(y, u if system.m else None))
        ahead = np.asarray(system.f(x[-1], u))
        x.append(np.clip(ahead + disturbance, region.lower[:n], region.upper[:n]))
        w.append(x[-1] - ahead)
    return np.array(x), np.array(w), estimates


def attack_estimator(certificate, *, trials, seed, steps=15):
    """The largest errors as shares of the paper's bound and the monitor's while they apply."""
    rng, region, shares, compared = np.random.default_rng(seed), certificate.region, [0.0] * 2, 0
    turns = cycle(product(qpmhe.solvers.available(), (0, 1, 2, 5)))
    for backend, cap in islice(turns, trials):
        trial = drawn(certificate.system, region, steps, rng)
        mhe, fresh = (
            qpmhe.MovingHorizonEstimator(
                certificate.system, certificate.observer, certificate.cost, backend=backend,
                horizon=next(iter(certificate.constants)), initial_state=trial.guess, max_qps=cap,
            ) for _ in range(2)
        )
        x, w, estimates = played(mhe, region, trial)
        start, signals = x[0] - trial.guess, [np.linalg.norm(e, axis=1) for e in (w, trial.v)]
        paper = certificate.of().result.bound(np.linalg.norm(start), *signals)
        sizes = Sizes(*(float(each.max()) for each in signals))
        watch = Monitor(certificate, fresh, initial_error=start, sizes=sizes)
        for t, (estimate, u) in enumerate(zip(estimates, trial.u, strict=True), 1):
            reading = watch.check(estimate, u if certificate.system.m else None)
            if not watch.applies:
                break
            error, bounds = np.linalg.norm(x[t] - estimate.state), (paper[t], reading.error)
            shares = [max(each) for each in zip(shares, share_of(error, bounds), strict=True)]
            compared += 1
    return *shares, compared


def attack_design(plan, gain, *, trials, steps=15, seed=0):
    """The largest error as a share of each bound of a Lyapunov design, and how many were compared.

    Runs count while the estimates are in the region; as a minimiser's, while J is at most the
    truth's.
    """
    rng, system, region = np.random.default_rng(seed), plan.system, plan.region
    shares, compared = {"minimiser": 0.0, "measured": 0.0}, 0
    estimators = [
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger(gain), plan.cost(), horizon=N, max_qps=cap,
            initial_state=np.zeros(system.n), candidate="reinitialized", project_observer=False,
            engine="compiled",
        )
        for N in sorted({3, min(plan.horizon, 12)}) for cap in (0, 1, 2, None)
    ]
    for mhe in islice(cycle(estimators), trials):
        trial = drawn(system, region, steps, rng, (plan.sizes.disturbance, plan.sizes.noise))
        mhe.reset(trial.guess)
        x, w, estimates = played(mhe, region, trial)
        inside = [region.contains(np.vstack((e.candidate, e.trajectory))).all() for e in estimates]
        least = [e.cost <= true_cost(plan, e, x, w, trial.v) for e in estimates]
        run = Run.of(trial.guess, estimates)
        error = np.sqrt(np.einsum("ti,ij,tj->t", run.states - x, plan.prior, run.states - x))
        for kind in shares:
            bound = plan.along(
                run, mhe, initial_error=x[0] - trial.guess, disturbances=w, noises=trial.v,
                kind=kind,
            )
            counts = np.logical_and.accumulate(
                inside if kind == "measured" else np.logical_and(inside, least)
            )
            found = share_of(error[1:][counts], bound[1:][counts])
            shares[kind] = max(shares[kind], float(found.max(initial=0.0)))
            compared += found.size
    return shares, compared


def true_cost(plan, estimate, x, w, v):
    """J of the truth, with the prior of an estimate's window."""
    K, t = len(estimate.trajectory) - 1, estimate.time + 1
    ages = plan.discount ** np.arange(K - 1.0, -1.0, -1.0)
    own = x[t - K] - estimate.candidate[0]
    stages = np.einsum("ti,ij,tj->t", w[t - K : t], plan.disturbance, w[t - K : t])
    stages = stages + np.einsum("ti,ij,tj->t", v[t - K : t], plan.noise, v[t - K : t])
    return float(plan.discount**K * own @ plan.prior @ own + ages @ stages)
