"""The promise with everything mixed: ``python -m tests.properties.fuzz_general --steps N``.

Disturbances of lower dimension, angles, nonlinear and soft constraints, and weights, bounds,
parameters and sensors that change while running. The judge below computes J, the roll-out of the
candidate and all constraints a second time, from the record that it keeps itself.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

import qpmhe
from qpmhe import Status

from .fuzz_promise import main, some_rule

# Of a row, in units of its width or of a standard deviation.
FEASIBLE = 1e-8
STEPS = 60
CLOSE = 1e-8  # of two costs, as a share


def wrapped(difference, angles):
    """A difference (..., d), its angles brought to [-pi, pi]."""
    difference = np.array(difference, float)
    difference[..., angles] = np.remainder(difference[..., angles] + math.pi, 2 * math.pi) - math.pi
    return difference


@dataclass
class Sample:
    """A sample as it was taken."""

    y: np.ndarray
    known: np.ndarray
    disturbance: np.ndarray
    noise: np.ndarray
    bounds: dict


@dataclass
class Case:
    """A random estimator, and what its judge knows."""

    mhe: qpmhe.MovingHorizonEstimator
    f: object
    h: object
    g: object  # of x and w; None without
    g_penalty: tuple | None  # linear and quadratic; None where g is hard
    along: np.ndarray | None  # the slope of g with respect to x
    matrix: np.ndarray  # G
    metric: np.ndarray  # typical squares of the states: the larger ones of prior and disturbance
    prior: np.ndarray
    usual: Sample
    soft: dict  # linear and quadratic penalty of each soft set
    state_angles: list
    output_angles: list
    discount: float
    taken: list = field(default_factory=list)

    @property
    def inverse(self):
        """G^+ and the noise-free directions E and N."""
        g, d = self.matrix, self.metric
        r = g.shape[1]
        inverse = np.linalg.solve((g.T / d) @ g, g.T / d)
        null = np.linalg.svd(g.T / np.sqrt(d))[2][r:].T * np.sqrt(1 / d)[:, None]
        back = d[:, None] * null @ np.linalg.inv((null.T * d) @ null)
        return inverse, back, null


def sides(draw, size, width):
    middle = np.where(draw.random(size) < 0.05, draw.choice([-1.2, 1.2], size), 0.0) * width
    return (
        middle - width * draw.uniform(0.3, 1.0, size), middle + width * draw.uniform(0.3, 1.0, size)
    )


def case(draw, engine="python"):
    """A random small problem with a random mixture of features.

    The compiled step has no soft sets and no nonlinear constraints.
    """
    n, p = int(draw.integers(1, 4)), int(draw.integers(1, 3))
    r = int(draw.integers(1, n + 1)) if draw.random() < 0.5 else n
    k = int(draw.integers(0, 3)) if draw.random() < 0.5 else 0  # parameters
    angle_state, angle_output = draw.random() < 0.4, draw.random() < 0.4
    a, b = draw.normal(size=(2, n, n))
    c, scale = draw.normal(size=(p, n)), draw.uniform(0.3, 1.0)
    a *= scale / max(np.abs(np.linalg.eigvals(a)).max(), 1e-3)
    by_input, by_parameter = draw.normal(size=n), 0.3 * draw.normal(size=(k, n))

    def parts(x):
        s = x.copy()
        if angle_state:
            s[..., 0] = np.sin(x[..., 0])
        return s

    def f(x, u):
        s = parts(x)
        value = s @ a.T + 0.3 * np.sin(s @ b.T) + u[..., :1] * by_input + u[..., 1:] @ by_parameter
        value = np.where(np.abs(value) < 1e4, value, np.nan)
        return value + x * np.eye(n)[0] if angle_state else value

    def h(x, u):
        s = parts(x)
        value = s @ c.T + 0.02 * (s @ c.T) ** 2
        return value + x[..., :1] * np.eye(p)[0] if angle_state and angle_output else value

    outputs = [0] if angle_output else []
    states = [0] if angle_state else []
    options, sets, soft = {}, {}, {}
    if states:
        options["state_residual"] = qpmhe.angles(states)
    if outputs:
        options["output_residual"] = qpmhe.angles(outputs)
    matrix = np.eye(n)
    if r < n or draw.random() < 0.3:
        matrix = draw.normal(size=(n, r))
        options["disturbance_matrix"] = matrix
    for name, size, width in (("states", n, 3.0), ("disturbances", r, 0.4), ("noises", p, 0.6)):
        if draw.random() < 0.35:
            low, high = sides(draw, size, width)
            if name == "states" and states:
                low[0], high[0] = -np.inf, np.inf
                if n == 1:
                    continue
            sets[name] = qpmhe.Box(low, high)
            if draw.random() < 0.4 and engine == "python":
                soft[name] = (
                    (draw.uniform(0.1, 5), 0.0), (0.0, draw.uniform(0.1, 50)), (0.5, 5.0)
                )[draw.integers(3)]
    for name, one in sets.items():
        options[name] = one
        if name in soft:
            options[name] = one.soften(linear=soft[name][0], quadratic=soft[name][1])
    g = g_penalty = along = None
    if draw.random() < 0.3 and engine == "python":
        along, limit = draw.normal(size=n), draw.uniform(0.5, 4.0)
        if states:
            along[0] = 0.0

        def g(x, w):
            return x @ along + 0.1 * np.sum(w * w, axis=-1) - limit

        penalties = {}
        if draw.random() < 0.5:
            g_penalty = (draw.uniform(0.1, 3), draw.uniform(0.0, 5))
            penalties = {"linear": g_penalty[0], "quadratic": g_penalty[1]}
        options["constraints"] = [qpmhe.Constraint(g, 1, **penalties)]
    covariances = {
        "prior": np.diag(draw.uniform(0.1, 2, n)), "disturbance": np.diag(draw.uniform(0.01, 1, r)),
        "noise": np.diag(draw.uniform(0.01, 1, p)),
    }
    system = qpmhe.System(f, h, n=n, p=p, m=1 + k, **options)
    if not states and draw.random() < 0.25:  # as `augment_parameters` does
        held = draw.permutation(n)[: draw.integers(1, n + 1)]
        system.held = {int(j): float(draw.uniform(0.05, 1.0)) for j in held}
    observer = qpmhe.Luenberger(draw.uniform(0, 0.9) * a @ np.linalg.pinv(c))
    if draw.random() < 0.5:
        observer = qpmhe.ExtendedKalman(**covariances, innovation=some_rule(draw, p))
    discount = 1.0 if draw.random() < 0.7 else 0.9
    cost = qpmhe.QuadraticCost.from_covariances(discount=discount, **covariances)
    nominal = draw.normal(size=k)
    extra = {"parameters": nominal} if k else {}
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=int(draw.integers(1, 7)),
        initial_state=0.3 * draw.normal(size=n),
        max_qps=[0, 1, 1, 2, 3, None][draw.integers(6)], warm_start=bool(draw.random() < 0.3),
        infeasible=("drop_rows", "keep_candidate")[draw.integers(2)],
        candidate=("observer", "reinitialized")[int(draw.random() < 0.2)], engine=engine, **extra,
    )
    inverses = {name: np.linalg.inv(matrix) for name, matrix in covariances.items()}
    usual = Sample(
        np.zeros(p), np.append(0.0, nominal), inverses["disturbance"], inverses["noise"],
        {name: (one.lower, one.upper) for name, one in sets.items()},
    )
    spread = matrix @ covariances["disturbance"] @ matrix.T
    metric = np.maximum(covariances["prior"].diagonal(), spread.diagonal())
    return Case(
        mhe, f, h, g, g_penalty, along, matrix, metric, inverses["prior"], usual, soft, states,
        outputs, discount,
    )


def spd(draw, size):
    root = 0.5 * draw.normal(size=(size, size)) + np.eye(size)
    return root @ root.T


def moved(draw, one):
    """Other sides for some of the sets."""
    other = {}
    for name, (low, high) in one.usual.bounds.items():
        if draw.random() < 0.5:
            width = np.where(np.isfinite(high), high - low, 1.0)
            shift = 0.2 * width * draw.normal(size=low.size)
            other[name] = (low + shift, high + shift + 0.2 * width * draw.random())
    return other


def as_sets(bounds):
    return {name: qpmhe.Box(*one) for name, one in bounds.items()}


def update(one, draw):
    """Take a random sample with some of its options; return the estimate."""
    usual, k = one.usual, one.usual.known.size - 1
    p, r = usual.y.size, one.matrix.shape[1]
    y = draw.normal(size=p) * draw.choice([0.5] * 20 + [3.0])
    if one.output_angles:
        y = wrapped(3.0 * y, one.output_angles)
    u = np.array([0.3 * draw.normal()])
    sample = Sample(
        y.copy(), np.append(u, usual.known[1:]), usual.disturbance, usual.noise, dict(usual.bounds)
    )
    options = {}
    if draw.random() < 0.1:
        options["noise_weight"] = sample.noise = spd(draw, p)
    if draw.random() < 0.1:
        options["disturbance_weight"] = sample.disturbance = spd(draw, r)
    if k and draw.random() < 0.2:
        options["parameters"] = draw.normal(size=k)
        sample.known[1:] = options["parameters"]
    if draw.random() < 0.1 and (other := moved(draw, one)):
        sample.bounds |= other
        options["bounds"] = as_sets(other)
    if draw.random() < 0.2:
        sensors = sorted(draw.choice(p, draw.integers(1, p + 1), replace=False).tolist())
        sample.y[[j for j in range(p) if j not in sensors]] = np.nan
        options["sensors"], y = sensors, y[sensors]
    elif draw.random() < 0.1:
        y[draw.integers(p)] = np.nan
        sample.y = y.copy()
    one.taken.append(sample)
    return one.mhe.update(y, u, **options)


def reset(one, draw):
    """Change something for all samples of the window."""
    usual, k, r = one.usual, one.usual.known.size - 1, one.matrix.shape[1]
    options = {}
    if draw.random() < 0.5:
        options["noise_weight"] = usual.noise = spd(draw, usual.y.size)
    if draw.random() < 0.5:
        options["disturbance_weight"] = usual.disturbance = spd(draw, r)
    if k and draw.random() < 0.5:
        options["parameters"] = draw.normal(size=k)
        usual.known = np.append(0.0, options["parameters"])
    if draw.random() < 0.5 and (other := moved(draw, one)):
        usual.bounds = usual.bounds | other
        options["bounds"] = as_sets(other)
    if not options:
        return None
    for sample in one.taken[-one.mhe.horizon :]:
        if "noise_weight" in options:
            sample.noise = usual.noise
        if "disturbance_weight" in options:
            sample.disturbance = usual.disturbance
        if "parameters" in options:
            sample.known[1:] = usual.known[1:]
        if "bounds" in options:
            sample.bounds |= other
    return one.mhe.set(**options)


def reduced(weight, there):
    """The weight of the outputs that are there."""
    if there.all():
        return weight
    small = np.zeros_like(weight)
    if there.any():
        block = np.ix_(there, there)
        small[block] = np.linalg.inv(np.linalg.inv(weight)[block])
    return small


def penalty(values, low, high, linear_quadratic):
    linear, quadratic = linear_quadratic
    missed = np.maximum(np.maximum(low - values, values - high), 0.0)
    return float(np.sum(linear * missed + quadratic * missed**2))


def judged(one, trajectory, start):
    """J of a trajectory, its largest misses of a hard row and of a noise-free direction."""
    samples = one.taken[-(len(trajectory) - 1) :]
    inverse, _, null = one.inverse
    offset = wrapped(trajectory[0] - start, one.state_angles)
    count, worst, off = len(samples), 0.0, 0.0
    cost = offset @ one.prior @ offset
    if one.mhe.hold is not None:  # `fuzz_independent` finds its weight a second time
        away = trajectory[0][one.mhe.hold.components] - one.mhe.hold.target
        cost += away @ one.mhe.hold.weight @ away
    cost *= one.discount**count
    deviations = {
        "states": np.sqrt(one.metric),
        "disturbances": np.sqrt(np.linalg.inv(one.usual.disturbance).diagonal()),
        "noises": np.sqrt(np.linalg.inv(one.usual.noise).diagonal()),
    }
    for i, sample in enumerate(samples):
        x, ahead = trajectory[i], trajectory[i + 1]
        d = wrapped(ahead - one.f(x, sample.known), one.state_angles)
        w = inverse @ d
        off = max(off, float(np.abs(null.T @ d).max(initial=0.0) / (1e-12 + np.abs(ahead).max())))
        there = np.isfinite(sample.y)
        v = np.zeros(there.size)
        difference = np.nan_to_num(sample.y) - one.h(x, sample.known)
        v[there] = wrapped(difference, one.output_angles)[there]
        stage = w @ sample.disturbance @ w + v @ reduced(sample.noise, there) @ v
        seen = {"states": x, "disturbances": w, "noises": np.where(there, v, np.nan)}
        for name, (low, high) in sample.bounds.items():
            points = seen[name]
            if name in one.soft:
                keep = np.isfinite(points)
                stage += penalty(points[keep], low[keep], high[keep], one.soft[name])
            else:
                missed = np.maximum(low - points, points - high) - 1e-13 * (1 + np.abs(points))
                scale = np.minimum(high - low, deviations[name])
                worst = max(worst, float(np.nanmax(missed / scale, initial=0.0)))
        if one.g is not None:
            value = one.g(x, w)
            if one.g_penalty is not None:
                stage += penalty(value, -np.inf, 0.0, one.g_penalty)
            else:
                # Its largest change within a standard deviation of x and w.
                scale = np.abs(one.along) @ deviations["states"]
                scale = scale + 0.1 * np.sum(deviations["disturbances"] ** 2)
                worst = max(worst, float(value / scale))
        cost += one.discount ** (count - 1 - i) * stage
    if "states" in one.usual.bounds:
        low, high = samples[-1].bounds["states"]
        if "states" in one.soft:
            cost += penalty(trajectory[-1], low, high, one.soft["states"])
        else:
            missed = np.maximum(low - trajectory[-1], trajectory[-1] - high)
            worst = max(worst, float(np.max(missed / np.minimum(high - low, deviations["states"]))))
    return float(cost), worst, off


def rolled_out(one, trajectory):
    """The trajectory with its noise-free directions as the model has them."""
    _, back, null = one.inverse
    result = trajectory.copy()
    for i, sample in enumerate(one.taken[-(len(trajectory) - 1) :]):
        d = wrapped(result[i + 1] - one.f(result[i], sample.known), one.state_angles)
        result[i + 1] -= back @ (null.T @ d)
    return result


def broken(one, estimate):
    """Which parts of the promise a step breaks."""
    faults, status, start = [], estimate.status, estimate.candidate[0]
    with np.errstate(all="ignore"):
        if not (estimate.cost <= estimate.candidate_cost or estimate.candidate_cost == np.inf):
            faults.append("cost above the candidate's")
        if (Status.ROWS_DROPPED in status) != bool(estimate.dropped):
            faults.append("rows dropped in secret")
        if Status.MODEL_FAILED in status or Status.FAILED_STAGE in status:
            return faults
        if one.mhe.settings.candidate == "observer":
            candidate, _, off = judged(one, rolled_out(one, estimate.candidate), start)
            apart = abs(candidate - estimate.candidate_cost)
            # A roll-out that turns an angle by more than half a turn leaves the range of G.
            if apart > CLOSE * (1e-9 + abs(candidate)) and off < 1e-11:
                faults.append(f"candidate's cost {estimate.candidate_cost}, not {candidate}")
        if not estimate.improved:
            return faults
        cost, worst, off = judged(one, estimate.trajectory, start)
        if abs(cost - estimate.cost) > CLOSE * (1e-9 + abs(cost)):
            faults.append(f"cost {estimate.cost}, not {cost}")
        if off > 1e-11:
            faults.append(f"disturbance outside of the range of G by {off}")
        if worst > FEASIBLE and not estimate.dropped:
            faults.append(f"a hard row violated by {worst} and not dropped")
    return faults


def run(steps, seed, engine="python"):
    """Counts of statuses, and the faults, of so many steps of an engine."""
    draw, counts, faults, taken = np.random.default_rng(seed), Counter(), [], 0
    while taken < steps:
        start = int(draw.integers(2**31))
        inner = np.random.default_rng(start)
        one = case(inner, engine)
        for t in range(STEPS if engine == "python" else 5 * STEPS):  # that compiling pays
            estimate = update(one, inner)
            found = broken(one, estimate)
            if inner.random() < 0.03 and (again := reset(one, inner)) is not None:
                found += broken(one, again)
                counts["set"] += 1
            taken += 1
            counts.update(flag.name for flag in estimate.status)
            counts["steps"] += 1
            faults += [(start, t, fault) for fault in found]
    return counts, faults


if __name__ == "__main__":
    raise SystemExit(main(__doc__.splitlines()[0], run))
