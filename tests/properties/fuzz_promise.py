"""The promise on many cheap random steps: ``python -m tests.properties.fuzz_promise --steps N``.

Small models, unstable observers, sets that exclude zero or one another, outliers and gaps, each
step judged by the few inequalities that no option may break. `fuzz_independent` judges fewer
steps by a second implementation of everything.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter

import numpy as np

import qpmhe
from qpmhe import Status

# Of a row, in units of its width or of a standard deviation.
FEASIBLE = 1e-8
STEPS = 100


def box(draw, size, width):
    """A box, or None; one in ten components excludes zero."""
    if draw.random() < 0.6:
        return None
    middle = np.where(draw.random(size) < 0.1, draw.choice([-1.5, 1.5], size), 0.0) * width
    return qpmhe.Box(
        middle - width * draw.uniform(0.2, 1.0, size), middle + width * draw.uniform(0.2, 1.0, size)
    )


def some_angles(draw, size):
    """Some of the components as angles of random periods, or None."""
    which = np.flatnonzero(draw.random(size) < 0.2)
    return qpmhe.angles(which, draw.uniform(0.5, 8.0, which.size)) if which.size else None


def some_rule(draw, size):
    """What a Kalman-type observer makes of innovations: a gate, Huber's weights, or None."""
    which = draw.random()
    if which < 0.4:
        return None
    if which < 0.6:
        return qpmhe.HuberInnovation(draw.uniform(0.5, 3.0), reopen=int(draw.integers(1, 6)))
    groups = [list(range(size))] if draw.random() < 0.3 else None
    return qpmhe.Gate(draw.choice([0.5, 0.95, 0.997]), int(draw.integers(1, 6)), groups)


def case(draw):
    """An estimator on a random small problem, and its options."""
    n, p = int(draw.integers(1, 4)), int(draw.integers(1, 3))
    a, b, c = (draw.normal(size=shape) for shape in ((n, n), (n, n), (p, n)))
    a *= draw.uniform(0.3, 1.1) / np.abs(np.linalg.eigvals(a)).max()
    edge = draw.choice([2.0, 1e3])  # beyond it the model is not defined

    def f(x):
        return np.where(np.abs(x) < 50 * edge, x @ a.T + 0.3 * np.sin(x @ b.T), np.nan)

    def h(x):
        return x @ c.T + 0.02 * (x @ c.T) ** 2

    r = int(draw.integers(1, n)) if n > 1 and draw.random() < 0.25 else n
    system = qpmhe.System(
        f, h, n=n, p=p, states=box(draw, n, edge), disturbances=box(draw, r, 0.3),
        noises=box(draw, p, 0.5), state_residual=some_angles(draw, n),
        output_residual=some_angles(draw, p),
        disturbance_matrix=draw.normal(size=(n, r)) if r < n else None,
    )
    covariances = {
        "prior": np.diag(draw.uniform(0.1, 2, n)), "disturbance": np.diag(draw.uniform(0.01, 1, r)),
        "noise": np.diag(draw.uniform(0.01, 1, p)),
    }
    if draw.random() < 0.15 and system.disturbances is None:
        covariances["disturbance"][-1, -1] = 0.0
    gain = draw.normal(size=(n, p)) if draw.random() < 0.3 else a @ np.linalg.pinv(c)
    observer = qpmhe.Luenberger(draw.uniform(0, 1.2) * gain)
    if draw.random() < 0.4:
        make = qpmhe.ExtendedKalman if draw.random() < 0.7 else qpmhe.UnscentedKalman
        observer = make(**covariances, innovation=some_rule(draw, p))
        if draw.random() < 0.5:
            covariances["prior"] = qpmhe.ObserverPrior()
    options = {
        "max_qps": [0, 1, 1, 2, 3, None][draw.integers(6)],
        "warm_start": bool(draw.random() < 0.3),
        "infeasible": ("drop_rows", "keep_candidate")[draw.integers(2)],
        "candidate": ("observer", "reinitialized")[int(draw.random() < 0.2)],
    }
    cost = qpmhe.QuadraticCost.from_covariances(**covariances)
    if system.state_residual is None and draw.random() < 0.2:  # as `augment_parameters` does
        held = draw.permutation(n)[: draw.integers(1, n + 1)]
        system.held = {int(j): float(draw.uniform(0.05, 1.0)) for j in held}
    if draw.random() < 0.3 and cost.disturbance_factor is None:
        loss = qpmhe.Barron(
            cost.noise, draw.choice([0.5, 0.0, -2.0, -np.inf]), draw.uniform(0.5, 3.0),
            per_component=bool(draw.random() < 0.5), graduation=draw.choice([1.0, 10.0]),
        )
        prior = cost.prior if cost.observer_prior is None else cost.observer_prior
        cost = qpmhe.RobustCost(prior=prior, disturbance=cost.disturbance, noise=loss)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=int(draw.integers(1, 7)),
        initial_state=draw.normal(size=n), **options,
    )
    return mhe, system, cost


def scaled_misses(convex_set, weight, points, sizes):
    """The largest miss of a bound, in units of its width or of a standard deviation."""
    if convex_set is None:
        return 0.0
    scale = np.minimum(
        convex_set.upper - convex_set.lower, np.sqrt(np.linalg.inv(weight).diagonal())
    )
    missed = np.maximum(convex_set.lower - points, points - convex_set.upper)
    missed = missed - 1e-14 * np.abs(sizes)
    return float(np.nanmax(missed / scale, initial=0.0))


def broken(mhe, system, cost, estimate, y):
    """Which parts of the promise a step breaks."""
    faults, status = [], estimate.status
    if not (estimate.cost <= estimate.candidate_cost or estimate.candidate_cost == np.inf):
        faults.append("cost above the candidate's")
    if (Status.ROWS_DROPPED in status) != bool(estimate.dropped):
        faults.append("rows dropped in secret")
    if estimate.dropped and mhe.settings.infeasible == "keep_candidate":
        faults.append("rows dropped against the option")
    if system.states is not None:
        points = np.vstack((estimate.trajectory, estimate.filtered, estimate.candidate))
        low, high = system.states.lower, system.states.upper
        # Where trials are rolled out, none of them can be clipped.
        if system.r < system.n or cost.disturbance_factor is not None:
            slack = FEASIBLE * (high - low)
            low, high = low - slack, high + slack
        if not ((points >= low) & (points <= high)).all():
            faults.append("outside of X")
    if estimate.improved and system.disturbance_matrix is not None:
        x, subtract = estimate.trajectory, system.state_residual or np.subtract
        missed = subtract(x[1:], system.f.batch(x[:-1], np.empty((len(x) - 1, 0))))
        missed = missed - estimate.disturbances @ system.disturbance_matrix.T
        if np.abs(missed).max() > 1e-12 * (1.0 + np.abs(x).max()):
            faults.append("a disturbance in a direction that has none")
    if estimate.improved and not estimate.dropped:
        w, v, sizes = estimate.disturbances, estimate.noises, np.abs(estimate.trajectory[1:])
        if system.disturbance_matrix is not None:
            sizes = sizes @ np.abs(np.linalg.pinv(system.disturbance_matrix)).T
        if max(
            scaled_misses(system.disturbances, cost.disturbance, w, sizes),
            scaled_misses(system.noises, cost.noise, v, np.abs(y).max()),
        ) > FEASIBLE:
            faults.append("a set violated and no row dropped")
    return faults


def run(steps, seed):
    """Counts of statuses, and the faults, of so many steps."""
    draw, counts, faults, taken = np.random.default_rng(seed), Counter(), [], 0
    while taken < steps:
        start = int(draw.integers(2**31))
        inner = np.random.default_rng(start)
        mhe, system, cost = case(inner)
        largest = 1.0
        for t in range(STEPS):
            y = inner.normal(size=system.p) * inner.choice([0.3] * 20 + [3.0, 1e4])
            largest = max(largest, float(np.abs(y).max()))
            y[inner.random(system.p) < 0.05] = np.nan
            estimate = mhe.update(y)
            taken += 1
            counts.update(flag.name for flag in estimate.status)
            counts["steps"] += 1
            faults += [(start, t, fault) for fault in broken(mhe, system, cost, estimate, largest)]
    return counts, faults


def main(description, run):
    """Print what `run` counts and finds; 1 if there are faults."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", qpmhe.ObserverWarning)
    counts, faults = run(arguments.steps, arguments.seed)
    for name, count in counts.most_common():
        print(f"{name:20}{count:>10,}")
    print(f"faults: {len(faults)}", *faults[:20], sep="\n")
    return bool(faults)


if __name__ == "__main__":
    raise SystemExit(main(__doc__.splitlines()[0], run))
