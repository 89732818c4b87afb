"""How often a guard acts, and what it is worth, with a backend that returns the worst it may.

    nice -n 15 python examples/studies/hostile_guard.py

For each certified model of the zoo, a record with disturbances and noises at their bounds is
estimated with a backend that returns, of all steps that lower the QP's objective, one that leads
farthest from the truth. Then the same with assumptions broken on purpose: disturbances and noises
ten times as large as stated, and a start five times as far away. First, truths with signals at
their bounds, many runs a system, and beside them estimates that are anything at all: an error of
the observer above its bound, or a guarded one above twice that, stops the script.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from adversary import Array
from certified_ratios import ZOO, others, zoo

import qpmhe
from qpmhe.certificates import (
    CertificateError,
    Evidence,
    Monitor,
    ObserverBound,
    synthesise_gain,
)
from qpmhe.certificates.guard import Guard
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.model.residuals import difference
from qpmhe.observers.projection import NearestPoint
from qpmhe_solvers import QP, Backend, RawSolution, Solver

# Systems on which many runs are cheap.
SMALL = ("waves", "a kink", "four coupled states")
MODELS = ("batch_reactor", "van_der_pol", "pendulum", "vehicle", "battery_cell")
SECONDS = 300.0
# Of the ellipsoid of steps that lower the objective: as far as rounding lets the verdict pass.
NEARLY = 0.999


class Hostile(Solver):
    """Lowers the objective, and leads the last state as far from the truth as that allows."""

    #: The last state of the candidate, less the true one.
    offset: Array = np.zeros(0)

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        H, g, n = qp.dense(), qp.gradient.ravel(), qp.n
        inverse = np.linalg.inv(H)
        best, radius = -inverse @ g, np.sqrt(max(g @ inverse @ g, 0.0))
        units = 1.0 / np.sqrt(np.diag(inverse)[-n:])
        directions = np.vstack((np.diag(units), -np.diag(units), self.offset * units**2))
        steps = []
        for direction in directions:
            moved = inverse[:, -n:] @ direction
            length = np.sqrt(max(direction @ moved[-n:], 1e-300))
            steps.append(best + NEARLY * radius / length * moved)
        worst = max(steps, key=lambda d: np.linalg.norm((self.offset + d[-n:]) * units))
        if qp.bounded or qp.rows:
            worst = worst * _share(qp, worst)
        return RawSolution(worst, True)


def _share(qp: QP, d: Array) -> float:
    """The share of a step that bounds and rows allow."""
    steps, share = d.reshape(qp.stages, qp.n), 1.0
    pairs = [(steps, qp.lower, qp.upper)]
    if qp.rows:
        values = np.einsum("kjc,kc->kj", qp.row_own, steps)
        values[:-1] += np.einsum("kjc,kc->kj", qp.row_next[:-1], steps[1:])
        pairs.append((values, qp.row_lower, qp.row_upper))
    for values, lower, upper in pairs:
        with np.errstate(all="ignore"):
            limits = np.where(values > 0.0, upper, lower)
            room = np.where(values == 0.0, 1.0, limits / values)
        share = min(share, float(np.clip(room, 0.0, 1.0).min()))
    return share


@dataclass
class Counts:
    """What was seen in some runs."""

    samples: int = 0
    moved: int = 0
    lost: int = 0
    noticed: int = 0
    worst: float = 0.0  # of |x_i - x_hat_i| over 2 b_i
    guarded: float = 0.0
    squares: float = 0.0
    guarded_squares: float = 0.0

    def row(self, name: str, runs: int) -> str:
        """One line of the table."""
        root, guarded = (
            np.sqrt(each / max(self.samples, 1)) for each in (self.squares, self.guarded_squares)
        )
        moved = 100.0 * self.moved / max(self.samples, 1)
        return (
            f"| {name} | {runs} | {self.samples} | {moved:.0f} % "
            f"| {self.worst:.2f} | {self.guarded:.2f} | {root:.2f} | {guarded:.2f} "
            f"| {self.lost} | {self.noticed} |"
        )


def certified(name: str) -> tuple[qpmhe.models.Example, qpmhe.Luenberger, ObserverBound]:
    """A model of the zoo, an observer with the certified metric, and its bound."""
    made = qpmhe.models.catalogue()[name]()
    system, region, sizes = zoo(name)
    found = synthesise_gain(system, region, sizes=sizes.typical, seconds=SECONDS)
    bound = bound_observer(
        system, found.observer, made.cost, region, sizes=sizes, seconds=SECONDS)
    return made._replace(system=system), found.observer, bound


def drawn(kind: str, shape: tuple[int, int], half: Array, rng: np.random.Generator) -> Array:
    """Signals at their bounds: signs that last, that alternate, or by chance; or inside."""
    signs = rng.choice([-1.0, 1.0], (1, shape[1])) * np.ones(shape)
    if kind == "alternating":
        signs[1::2] *= -1.0
    elif kind == "random signs":
        signs = rng.choice([-1.0, 1.0], shape)
    elif kind == "inside":
        signs = rng.uniform(-1.0, 1.0, shape)
    return signs * half


CERTIFIED: dict[str, tuple[qpmhe.models.Example, qpmhe.Luenberger, ObserverBound]] = {}


def run(name: str, runs: int, steps: int, larger: float = 1.0, farther: float = 1.0) -> Counts:
    """Runs of one model, with signals and a first error so many times as large as stated."""
    made, observer, bound = CERTIFIED[name]
    system, scenario, counts = made.system, made.scenario, Counts()
    region, n, rng = bound.region, system.n, np.random.default_rng(len(name))
    w, v = bound.sizes.extent
    start = qpmhe.Box(-bound.settled.box, bound.settled.box)
    for k in range(runs):
        kind = ("lasting", "alternating", "random signs", "inside")[k % 4]
        x = scenario.initial_state if k % 2 else 0.5 * (region.lower + region.upper)[:n]
        half = 0.5 * (region.upper - region.lower)[:n]
        x = np.clip(x, region.lower[:n] + 0.2 * half, region.upper[:n] - 0.2 * half)
        first = x + farther * rng.uniform(-0.9, 0.9, n) * start.upper
        first = np.clip(first, region.lower[:n], region.upper[:n])
        noises = drawn(kind, (steps, system.p), larger * v, rng)
        pushes = drawn(kind, (steps, system.r), larger * w, rng)
        G = np.eye(n) if system.disturbance_matrix is None else system.disturbance_matrix
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, made.cost, horizon=min(scenario.horizon, 10), initial_state=first,
            max_qps=1, backend="hostile", engine="python")
        watch, z = Monitor(bound, mhe, initial_error=start, guard=True), first
        for t in range(steps):
            u = np.zeros(0) if scenario.inputs is None else np.asarray(scenario.inputs(t, x))
            if u.size:
                u = np.clip(u, region.lower[n:], region.upper[n:])
            y = np.asarray(system.h(x, u)) + noises[t]
            x = np.asarray(system.f(x, u)) + G @ pushes[t]
            if not region.contains(x):
                break
            z = np.asarray(system.f(z, u)) + observer.gain @ difference(
                system.output_residual, y, np.asarray(system.h(z, u)))
            Hostile.offset = z - x
            estimate = mhe.update(y, u if system.m else None)
            reading, z = watch.check(estimate, u), estimate.observer_state
            if reading.lost is not None:
                counts.lost += 1
                counts.noticed += "contradict" in reading.reason or "no state" in reading.reason
                break
            if reading.unguarded:
                counts.noticed += 1
                break
            twice = 2.0 * bound.components(reading.radius)
            errors = [np.abs(x - each) / twice for each in (estimate.state, reading.state)]
            counts.samples += 1
            counts.moved += "state" in reading.guarded
            counts.worst = max(counts.worst, float(errors[0].max()))
            counts.guarded = max(counts.guarded, float(errors[1].max()))
            counts.squares += float(np.mean(errors[0] ** 2))
            counts.guarded_squares += float(np.mean(errors[1] ** 2))
    if larger == farther == 1.0 and counts.guarded > 1.0 + 1e-9:
        raise SystemExit(f"{name}: a guarded error is {counts.guarded} times its bound")
    return counts


def many(name: str, runs: int, hostile: int, steps: int = 25, checked: int = 2) -> str:
    """Truths beside the observer, all at once; hostile estimates at the last samples, guarded.

    In a system with an X, the observer is projected in P, and the truth stays in X.
    """
    system, region, sizes = zoo(name) if name in ZOO else others()[name]
    gain = synthesise_gain(system, region, sizes=sizes.typical, seconds=SECONDS).observer
    cost = qpmhe.QuadraticCost(
        prior=np.eye(system.n), disturbance=np.eye(system.n), noise=np.eye(system.p))
    bound = bound_observer(system, gain, cost, region, sizes=sizes, seconds=SECONDS)
    rng, n, L, X = np.random.default_rng(1), system.n, gain.gain, system.states
    half, nearest = 0.3 * bound.settled.box, None if X is None else NearestPoint(X)
    covariance = np.linalg.inv(bound.metric)
    w, v = (np.broadcast_to(each, (size,)) / (1.0 if np.ndim(each) else np.sqrt(size))
            for each, size in zip(bound.sizes.extent, (n, system.p), strict=True))
    low, high = bound.region.lower, bound.region.upper
    points = low + (high - low) * rng.uniform(0.3, 0.7, (runs + 1, low.size))
    if X is not None:  # half of them where the observer may be projected
        points[::2, :n] = np.clip(
            points[::2, :n] + (high - low)[:n], low[:n], np.minimum(high[:n], X.upper))
    points[:, :n] = np.where(  # of a slanted region, only from its middle on
        bound.region.contains(points[:, :n])[:, None], points[:, :n], points[-1, :n])
    x, u = points[:runs, :n].copy(), points[:runs, n:]
    z = np.clip(x + rng.choice([-1.0, 1.0], (runs, n)) * half, low[:n], high[:n])
    A, C = (np.asarray(each(points[-1, :n], points[-1, n:]))
            for each in (system.f_jacobian, system.h_jacobian))
    rows = rng.standard_normal((runs, n)) / bound.settled.box
    backwards = [rows]
    for _ in range(steps - 1):
        backwards.append(backwards[-1] @ (A - L @ C))
    alive, tube = np.ones(runs, np.bool_), bound.begun(qpmhe.Box(-half, half))
    guard, entering, added = Guard(bound, system), bound.entering(), bound.added()
    worst, moved, compared, projected = 0.0, 0, 0, 0
    for t in range(steps):
        push = backwards[steps - 1 - t]
        sign = np.where(push > 0.0, 1.0, -1.0)
        chance = rng.random(runs) < 0.3
        sign[chance] = rng.choice([-1.0, 1.0], (int(chance.sum()), n))
        noise = np.where(-push @ L > 0.0, 1.0, -1.0) * v
        fit = difference(
            system.output_residual, system.h.batch(x, u) + noise, system.h.batch(z, u))
        z, x = system.f.batch(z, u) + fit @ L.T, system.f.batch(x, u)
        x += np.where(bound.region.contains(x + sign * w)[:, None], sign, -sign) * w
        if nearest is not None:
            alive &= nearest.contains(x)
            for k in np.flatnonzero(~nearest.contains(z) & alive):
                z[k], projected = nearest(z[k], covariance).point, projected + 1
        alive &= bound.region.contains(x)
        tube = bound.followed(tube, entering, added, projected=X is not None)
        share = (np.abs(x - z)[alive] / tube.box).max(initial=0.0)
        if share > 1.0 + 1e-9:
            raise SystemExit(f"{name}: an error is {share} times its bound")
        alive &= bound.region.contains(z)
        x[~alive] = z[~alive] = points[-1, :n]  # these count no more, and may not overflow
        if t < steps - checked:
            continue
        left = np.flatnonzero(alive)
        for k in left[:: max(len(left) * checked // hostile, 1)]:
            # Beyond z as seen from the truth, or anywhere, near and far.
            away = z[k] - x[k] if k % 2 else rng.standard_normal(n) * bound.settled.box
            found = guard(z[k] + 10.0 ** rng.uniform(-1.0, 4.0) * away, z[k], tube)
            if found.reason:
                raise SystemExit(f"{name}: {found.reason}")
            e = x[k] - found.point
            share = max(float((np.abs(e) / (2.0 * tube.box)).max()),
                        float(bound.length(e)) / (2.0 * tube.radius))
            if share > 1.0 + 1e-9:
                raise SystemExit(f"{name}: a guarded error is {share} times twice its bound")
            worst, moved, compared = max(worst, share), moved + found.acted, compared + 1
    return (
        f"{name}: {runs} runs, {int(alive.sum())} of them in the region to the end, {projected} "
        f"projections, {compared} hostile estimates, {moved} moved, largest error {worst:.3f} of "
        "twice the bound"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Estimates that are as wrong as may be, guarded.")
    parser.add_argument("--runs", type=int, default=10_000, help="of each small system")
    parser.add_argument("--small", nargs="*", default=SMALL, help="systems, also of the zoo")
    parser.add_argument("--hostile", type=int, default=20_000, help="estimates of each of these")
    parser.add_argument("--zoo-runs", type=int, default=8, help="of each model of the zoo")
    parser.add_argument("--steps", type=int, default=50, help="samples of a run in the zoo")
    parser.add_argument("--models", nargs="*", default=MODELS)
    given, began = parser.parse_args(), time.process_time()
    for name in given.small if given.runs else ():
        print(many(name, given.runs, given.hostile), flush=True)
    qpmhe.solvers.register(Backend("hostile", Hostile, "adversary"))
    print("| model | runs | samples | moved | worst / 2 b | guarded | rms / 2 b | guarded | lost "
          "| of these noticed |\n|---|---|---|---|---|---|---|---|---|---|")
    for name in given.models if given.zoo_runs else ():
        CERTIFIED[name] = certified(name)
        if CERTIFIED[name][2].evidence is not Evidence.PROVED:
            print(f"| {name} | not proved in {SECONDS:g} s |", flush=True)
            continue
        for words, options in (
            ("", {}), (", w and v ten times", {"larger": 10.0}),
            (", start five times", {"farther": 5.0}),
        ):
            try:
                counts = run(name, given.zoo_runs, given.steps, **options)
            except CertificateError as error:  # as with angles among the states
                print(f"| {name} | {error} |", flush=True)
                break
            print(counts.row(f"{name}{words}", given.zoo_runs), flush=True)
    print(f"{time.process_time() - began:.0f} s of one core")


if __name__ == "__main__":
    main()
