"""The proved bound on each state of an observer, as a multiple of the largest error found.

    nice -n 15 python examples/studies/certified_ratios.py

For the models of the zoo that are certified, and for other systems, with gains made for the region.
An adversary chooses disturbances and noises at their bounds along their influence on one state's
last error, from many starts at once, anew along each run that follows; the observer is projected
onto X in P. A larger error than the bound stops the script. Beside it is the bound as a multiple of
the largest error where each sample may have the Jacobian of any state of the region, as the bound
allows: where this is near 1, no other P and no finer cells make the bound much smaller.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

import qpmhe
from qpmhe.certificates import ObserverBound, Sizes, synthesise_gain
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.certificates.report import region_of
from qpmhe.model.residuals import difference
from qpmhe.observers.projection import NearestPoint

Array = NDArray[np.float64]
Case = tuple[qpmhe.System, qpmhe.certificates.Region, Sizes]

ZOO = ("batch_reactor", "van_der_pol", "cstr", "pendulum", "vehicle", "battery_cell")
SECONDS, STEPS, STARTS, ROUNDS = 600.0, (5, 20, 60, 150), 24, 5
# Slow errors take as many samples as their bound does to settle, up to so many.
MOST_STEPS = 1500


def box(*half: float) -> qpmhe.Box:
    return qpmhe.Box(-np.array(half), np.array(half))


def zoo(name: str) -> Case:
    """A model with its scenario's region, and boxes of three standard deviations."""
    made = qpmhe.models.catalogue()[name]()
    scenario = made.scenario
    w, v = (box(*(3.0 * np.sqrt(np.diag(each)))) for each in (
        scenario.disturbance_covariance, scenario.noise_covariance))
    return made.system, region_of(made.system, scenario), Sizes(w, v)


def others() -> dict[str, tuple[qpmhe.System, qpmhe.Box, Sizes]]:
    """Systems that are not in the zoo."""
    stack = np.stack

    def first(x: Array) -> Array:
        return x[..., :1]

    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    units = np.array([1.0, 1e6])

    def lorenz(x: Array) -> Array:
        a, b, c = (x[..., k] for k in range(3))
        return stack([10.0 * (b - a), a * (28.0 - c) - b, a * b - 8.0 / 3.0 * c], -1)

    def stiff(x: Array) -> Array:
        a, b = x[..., 0], x[..., 1]
        return stack([0.02 * a + 0.3 * np.sin(b), 0.99 * b - 0.01 * b**3], -1)

    def fitzhugh(x: Array) -> Array:
        a, b = x[..., 0], x[..., 1]
        return stack([a + 0.1 * (a - a**3 / 3 - b + 0.5), b + 0.008 * (a + 0.7 - 0.8 * b)], -1)

    def tanks(x: Array) -> Array:
        flow = 0.3 * np.sqrt(x)
        return stack([0.35 - flow[..., 0], flow[..., 0] - flow[..., 1]], -1) / 0.5

    def enzyme(x: Array) -> Array:
        a, b, c = (x[..., k] for k in range(3))
        used = a / (0.5 + a)
        rates = stack([1.0 - used - 0.2 * a, used - b, b - c], -1)
        return x + 0.1 * rates

    def discrete(f, n: int, h=first, p: int = 1) -> qpmhe.System:
        return qpmhe.System(f, h, n=n, p=p)

    small = Sizes(box(0.01, 0.01), box(0.02))
    return {
        "waves": (discrete(
            lambda x: x @ A.T + 0.05 * np.sin(x[..., :1]) * np.array([0.0, 1.0]), 2),
            box(2.0, 2.0), small),
        "a kink": (discrete(lambda x: stack(
            [0.8 * np.abs(x[..., 0]) - 0.5 * x[..., 1], 0.6 * x[..., 0]], -1), 2),
            box(2.0, 2.0), small),
        "a saturation": (discrete(lambda x: stack(
            [0.9 * x[..., 0] + 0.2 * np.tanh(x[..., 1]), 0.95 * x[..., 1]], -1), 2),
            box(2.0, 2.0), small),
        "one state in millionths": (discrete(
            lambda x: (x / units) @ A.T * units, 2), box(2.0, 2e6),
            Sizes(box(0.01, 1e4), box(0.02))),
        "a stiff system": (discrete(stiff, 2, lambda x: x[..., 1:]), box(1.0, 2.0), small),
        "FitzHugh-Nagumo": (discrete(fitzhugh, 2), qpmhe.Box([-2.5, -1.0], [2.5, 2.0]), small),
        "four coupled states": (discrete(
            lambda x: 0.8 * x + 0.1 * np.sin(np.roll(x, 1, axis=-1))
            + 0.1 * np.roll(x, -1, axis=-1), 4, lambda x: x[..., ::2], 2),
            box(2.0, 2.0, 2.0, 2.0), Sizes(0.01, 0.01)),
        "two tanks": (qpmhe.System.from_ode(tanks, lambda x: x[..., 1:], dt=0.1, n=2, p=1),
            qpmhe.Box([0.2, 0.2], [2.0, 2.0]), Sizes(box(0.002, 0.002), box(0.005))),
        "enzyme": (discrete(enzyme, 3, lambda x: x[..., ::2], 2),
            qpmhe.Box([0.1, 0.0, 0.0], [3.0, 1.0, 1.0]), Sizes(0.003, 0.01)),
        "Lorenz": (qpmhe.System.from_ode(
            lorenz, lambda x: x[..., :2], dt=0.01, n=3, p=2, method="euler"),
            qpmhe.Box([-20.0, -28.0, 0.0], [20.0, 28.0, 50.0]), Sizes(0.01, 0.02)),
        # Around the mass at rest, which is never at the wall or at the end point there.
        "a chain of one mass": (qpmhe.models.chain_of_masses(masses=1).system, qpmhe.Box(
            [0.2, -0.05, -0.23, -0.5, -0.5, -0.5], [0.3, 0.05, -0.13, 0.5, 0.5, 0.5]),
            Sizes(box(*[3e-4] * 3, *[0.009] * 3), box(*[0.009] * 3))),
    }


def extreme(size: float | qpmhe.Box, along: Array) -> Array:
    """The members of a set, or vectors of a length, farthest along each row."""
    if isinstance(size, qpmhe.Box):
        return np.where(along > 0.0, size.upper, size.lower)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return size * along / np.where(length > 0.0, length, 1.0)


def largest(system: qpmhe.System, bound: ObserverBound) -> Array:
    """The largest |x_i - z_i| found, from no initial error."""
    region, n, L = bound.region, system.n, bound.gain
    G = np.eye(n) if system.disturbance_matrix is None else system.disturbance_matrix
    points = region.sample(STARTS, np.random.default_rng(0))[: 2 * STARTS]
    middle = points[0]
    starts = middle + 0.7 * (points - middle)
    rows = np.tile(np.vstack((np.eye(n), -np.eye(n))), (len(starts), 1))
    first, u = np.repeat(starts[:, :n], 2 * n, axis=0), np.repeat(starts[:, n:], 2 * n, axis=0)
    X = system.states
    nearest, covariance = None if X is None else NearestPoint(X), np.linalg.inv(bound.metric)
    f_slope, h_slope, found = system.f_jacobian, system.h_jacobian, np.zeros(n)
    settled = min(bound.settling_samples or 0, MOST_STEPS)
    for steps in (*STEPS, settled) if settled > STEPS[-1] else STEPS:
        w, v = np.zeros((steps, len(rows), system.r)), np.zeros((steps, len(rows), system.p))
        for _ in range(ROUNDS):
            x, z, alive = first.copy(), first.copy(), np.ones(len(rows), np.bool_)
            middles = []
            for t in range(steps):
                middles.append(np.where(alive[:, None], 0.5 * (x + z), first))
                y = system.h.batch(x, u) + v[t]
                fit = difference(system.output_residual, y, system.h.batch(z, u))
                z = system.f.batch(z, u) + fit @ L.T
                x = system.f.batch(x, u) + w[t] @ G.T
                if nearest is not None:  # onto X in P; a truth beyond is none that counts
                    for k in np.flatnonzero(~nearest.contains(z) & alive):
                        z[k] = nearest(z[k], covariance).point
                    alive &= nearest.contains(x)
                e = np.abs(x - z)[alive]
                found = np.maximum(found, e.max(axis=0, initial=0.0))
                alive &= region.contains(x) & region.contains(z)
                x, z = (np.where(alive[:, None], each, first) for each in (x, z))
            p = rows
            for t in range(steps - 1, -1, -1):
                w[t], v[t] = extreme(bound.sizes.disturbance, p @ G), extreme(
                    bound.sizes.noise, -p @ L)
                closed = np.asarray(f_slope.batch(middles[t], u)) - L @ np.asarray(
                    h_slope.batch(middles[t], u))
                p = np.einsum("kij,ki->kj", closed, p)
    return found


def with_any_jacobian(system: qpmhe.System, bound: ObserverBound) -> Array:
    """The largest errors where each sample has the Jacobian of some state of the region, at will.

    Going back from the last sample, always one that keeps the error's row largest.
    """
    n, L = system.n, bound.gain
    points = bound.region.sample(STARTS, np.random.default_rng(1))
    x, u = points[:, :n], points[:, n:]
    closed = np.asarray(system.f_jacobian.batch(x, u)) - L @ np.asarray(
        system.h_jacobian.batch(x, u))
    G = np.eye(n) if system.disturbance_matrix is None else system.disturbance_matrix
    rows, found, inverse = np.eye(n), np.zeros(n), np.linalg.inv(bound.metric)
    for _ in range(MOST_STEPS):
        for size, moved in ((bound.sizes.disturbance, rows @ G), (bound.sizes.noise, -rows @ L)):
            found += np.sum(moved * extreme(size, moved), axis=1)
        before = np.einsum("ij,kjl->kil", rows, closed)
        best = np.einsum("kil,lm,kim->ki", before, inverse, before).argmax(axis=0)
        rows = before[best, np.arange(n)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Bounds as multiples of the largest errors found.")
    parser.add_argument("names", nargs="*", default=(*ZOO, *others()))
    print("| system | evidence | bound / largest error, by state | with any Jacobian | CPU s |\n"
          "|---|---|---|---|---|")
    for name in parser.parse_args().names:
        began = time.process_time()
        system, region, sizes = zoo(name) if name in ZOO else others()[name]
        cost = qpmhe.QuadraticCost(
            prior=np.eye(system.n), disturbance=np.eye(system.r), noise=np.eye(system.p))
        try:
            gain = synthesise_gain(system, region, sizes=sizes.typical, seconds=SECONDS).observer
            bound = bound_observer(system, gain, cost, region, sizes=sizes, seconds=SECONDS)
        except qpmhe.errors.QpmheError as error:
            print(f"| {name} | none: {str(error)[:150]} | | | |", flush=True)
            continue
        limit = bound.settled.box
        errors = largest(system, bound)
        if bound.evidence is qpmhe.certificates.Evidence.PROVED and (errors > limit).any():
            raise SystemExit(f"{name}: {errors} is above its bound {limit}")
        widths = (bound.region.upper - bound.region.lower)[: system.n]
        each = ", ".join(
            f"{ratio:.2f}{' (vacuous)' if wide else ''}"
            for ratio, wide in zip(limit / errors, limit >= widths, strict=True)
        )
        free = ", ".join(f"{ratio:.2f}" for ratio in limit / with_any_jacobian(system, bound))
        print(f"| {name} | {bound.evidence} | {each} | {free} "
              f"| {time.process_time() - began:.0f} |", flush=True)


if __name__ == "__main__":
    main()
