"""The promise with everything mixed: ``python -m tests.properties.fuzz_general --steps N``.

Disturbances of lower dimension, angles, nonlinear and soft constraints, losses, and weights,
bounds, parameters and sensors that change while running. J, the roll-out of the candidate and all
constraints are computed a second time by CasADi, from the record.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

import qpmhe
from qpmhe import Status
from qpmhe_solvers import RawSolution, Solver
from qpmhe_solvers.options import SolverOptions
from tests.oracles.nlp import spd

from .fuzz_promise import FEASIBLE, main
from .fuzz_promise import broken as broken_promise
from .problems import Problem

STEPS = 60
BACKENDS = qpmhe.solvers.available()[2:6]
CLOSE = 1e-8  # of two costs, as a share
MIXED = {
    "ode": 0.3, "irregular": 0.5, "inputs": 0.6, "parameters": 0.4, "matrix": 0.4, "angles": 0.3,
    "states": 0.35, "disturbances": 0.35, "noises": 0.35, "rows": 0.5, "soft": 0.5,
    "constraint": 0.3, "discount": 0.3, "loss": 0.3, "kalman": 0.5, "rules": 0.6, "held": 0.3,
    "covariance": 0.2, "weights": 0.4, "bounds": 0.4, "sensors": 0.4, "missing": 0.5,
    "outliers": 0.4,
}


class Liar(Solver):
    """Claims success for the right step, for noise, for NaN, or raises."""

    def __init__(self, seed):
        super().__init__(SolverOptions())
        self.draw = np.random.default_rng(seed)
        self.honest = qpmhe.solvers.create("auto")

    def _solve(self, qp, start):
        kind, size = self.draw.integers(5), (qp.stages, qp.n)
        if kind == 0:
            raise RuntimeError("no")
        if kind < 3:
            lie = np.full(size, np.nan) if kind == 1 else self.draw.normal(size=size)
            return RawSolution(lie, True, 1)
        found = self.honest.solve(qp)
        duals = (None, None) if kind == 3 or found.d is None else (
            self.draw.normal(size=qp.size), self.draw.normal(size=qp.stages * qp.rows)
        )
        return RawSolution(found.d, True, 1, *duals)


def solver(one, seed):
    """Options of an estimator's solver: a liar or a named one with a cap, at times."""
    if one.rng.random() < 0.6:
        return {}
    if one.rng.random() < 0.5:
        return {"backend": Liar(seed)}
    backend = str(one.rng.choice(BACKENDS))
    return {"backend": backend, "max_solver_iterations": int(one.rng.integers(1, 6))}


def changed(one, mhe, time):
    """Change something for all samples of the window; the estimate, None if nothing changes."""
    rng, usual, given = one.rng, one.usual, {}
    if "weights" in one.has and rng.random() < 0.7:
        given["noise_weight"] = usual.noise * rng.uniform(0.3, 3.0)
    if "weights" in one.has and one.how != "covariance" and rng.random() < 0.7:
        weight = 30.0 * spd(rng, one.G.shape[1])
        if one.each and "disturbance" in one.robust:  # a loss per component takes no other
            weight = np.diag(np.diag(weight))
        given["disturbance_weight"] = weight
    if one.k and rng.random() < 0.5:
        given["parameters"] = rng.standard_normal(one.k)
    if "bounds" in one.has and (other := one.moved()):
        given["bounds"] = other
    if not given:
        return None
    first = max(0, time + 1 - one.options["horizon"])
    for k, sample in enumerate([usual, *one.samples[first:]], first - 1):
        left = {name: value for name, value in given.items() if k <= time or name not in sample.own}
        sample.noise = left.get("noise_weight", sample.noise)
        sample.disturbance = left.get("disturbance_weight", sample.disturbance)
        sample.known[one.m :] = left.get("parameters", sample.known[one.m :])
        sample.bounds |= given.get("bounds", {})
        if k > time:
            sample.bounds |= sample.own.get("bounds", {})
    return mhe.set(**one.in_units(given, one.own_units))


def rolled_out(one, trajectory, time):
    """The trajectory with its noise-free directions as the model has them."""
    spread = one.G @ one.Q @ one.G.T
    metric, r = np.maximum(one.P.diagonal(), spread.diagonal()), one.G.shape[1]
    null = np.linalg.svd(one.G.T / np.sqrt(metric))[2][r:].T * np.sqrt(1.0 / metric)[:, None]
    back = metric[:, None] * null @ np.linalg.inv((null.T * metric) @ null)
    result, period = trajectory.copy(), one.periods[0]
    for i, sample in enumerate(one.samples[time + 2 - len(trajectory) : time + 1]):
        d = result[i + 1] - one.f(result[i], sample.known, sample.dt)
        d = np.where(np.isfinite(period), d - period * np.round(d / period), d)
        result[i + 1] -= back @ (null.T @ d)
    return result


def broken(one, mhe, estimate):
    """Which parts of the promise a step breaks."""
    # Scales are shares of deviations, which `set` may have changed in the estimator.
    faults, status = broken_promise(one, estimate, 10.0 * FEASIBLE), estimate.status
    if Status.MODEL_FAILED in status or Status.FAILED_STAGE in status:
        return faults
    window = one.window(estimate, mhe.hold)  # `fuzz_independent` finds its weight a second time
    if one.options["candidate"] == "observer":
        path = rolled_out(one, estimate.candidate, estimate.time)
        J, missed = window.judged(path)
        # A roll-out that turns an angle by more than half a turn leaves the range of G.
        turns = one.how and np.isfinite(one.periods[0]).any()
        if abs(J - estimate.candidate_cost) > CLOSE * (1e-9 + abs(J)) and not turns:
            faults.append(f"candidate's cost {estimate.candidate_cost}, not {J}")
    if Status.CANDIDATE in status:
        return faults
    J, missed = window.judged(estimate.trajectory)
    if abs(J - estimate.cost) > CLOSE * (1e-9 + abs(J)):
        faults.append(f"cost {estimate.cost}, not {J}")
    if missed > 10.0 * FEASIBLE and not estimate.dropped:
        faults.append(f"a hard row violated by {missed} and not dropped")
    return faults


def run(steps, seed, engine="python"):
    """Counts of statuses, and the faults, of so many steps of an engine."""
    draw, counts, faults = np.random.default_rng(seed), Counter(), []
    while counts["steps"] < steps:
        start = int(draw.integers(2**31))
        # Five times as many for an estimator that is compiled.
        one = Problem(start, MIXED, STEPS if engine == "python" else 5 * STEPS)
        options = solver(one, start) if engine == "python" else {}
        mhe, one.largest = one.estimator(engine=engine, **options), 1.0
        for t, sample in enumerate(one.samples):
            estimate = one.update(mhe, sample)
            found = broken(one, mhe, estimate)
            if one.rng.random() < 0.03 and (again := changed(one, mhe, t)) is not None:
                found += broken(one, mhe, again)
                counts["set"] += 1
            if one.rng.random() < 0.03:
                late = int(one.rng.integers(max(0, t + 1 - mhe.horizon), t + 1))
                one.samples[late].y = one.rng.standard_normal(one.p)
                found += broken(one, mhe, mhe.amend(late, one.samples[late].y))
                counts["amended"] += 1
            counts.update(flag.name for flag in estimate.status)
            counts["steps"] += 1
            faults += [(start, t, fault) for fault in found]
    return counts, faults


if __name__ == "__main__":
    raise SystemExit(main(__doc__.splitlines()[0], run))
