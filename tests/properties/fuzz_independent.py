"""Random estimation problems, each step judged by code that shares nothing with the estimator.

J and the model are those of `problems`, the observer, its projection and what is held are written
a second time in `independent`. From `qpmhe` comes only what a user writes down, and the estimator
that is tried.

    python -m tests.properties.fuzz_independent --steps 100000 --seed 0
"""

import argparse
import itertools
import math
import pickle
import sys
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager

import numpy as np

from qpmhe import Status
from qpmhe.codegen import compiler

from .independent import Held, Watcher, misses
from .problems import SETS, WRITINGS, Problem

# What is missed by so much counts as satisfied, as the documentation has it.
FEASIBLE = 5e-9
# All but qpalm, which corrupts the memory on some QPs; those that are quick more often.
QUICK = ("auto", "daqp", "quadprog", "piqp", "proxqp", "osqp", "clarabel")
BACKENDS = (*QUICK, *QUICK, "piqp_dense", "proxqp_sparse", "qpsolvers:osqp", "scs", "ecos")
LEVELS = compiler._LEVELS
SHARES = {
    "ode": 0.3, "irregular": 0.3, "inputs": 0.6, "parameters": 0.2, "states": 0.35,
    "disturbances": 0.3, "noises": 0.25, "rows": 0.4, "discount": 0.4, "loss": 0.35, "kalman": 0.5,
    "observer prior": 0.5, "held": 0.4, "weights": 0.3, "missing": 0.5, "outliers": 0.5,
}


class WrongStepError(Exception):
    """A step that is not what it says."""


def wrong(condition, *words):
    if condition:
        raise WrongStepError(" ".join(map(str, words)))


class Case:
    """A problem, an estimator for it, and what is expected of each of its steps."""

    def __init__(self, seed, source=None, writing=None, engine=None):
        rng = self.rng = np.random.default_rng([seed, 1])
        self.seed, sources = seed, ("numpy",) * 6 + ("casadi",) * 3 + ("jax",)
        self.source = source or sources[rng.integers(len(sources))]
        self.writing = writing or str(rng.choice(WRITINGS[self.source]))
        slow = self.writing in ("jax", "compiled")
        shares = SHARES | ({"states": 1.0, "ode": 0.0} if "clip" in self.writing else {})
        self.one = one = Problem(seed, shares, 90 if slow else 40, self.writing)
        if "clip" in self.writing:
            one.sets["states"] = np.full(one.n, -0.2), np.full(one.n, np.inf), np.zeros(
                (0, one.n)), np.zeros(0)
        for sample in one.samples:
            sample.bounds = {name: sides[:2] for name, sides in one.sets.items()}
        self.start = one.start = np.maximum(one.start, -0.15) if "clip" in self.writing else (
            one.start
        )
        if "states" in one.sets and misses(one.sets, "states", one.start):
            del one.sets["states"]
        if self.writing == "compiled" and "states" not in one.sets and rng.random() < 0.6:
            engine = engine or "compiled"
        one.options |= {"horizon": int(rng.integers(1, 13)), "engine": engine or "python"}
        if engine != "compiled":
            one.options["backend"] = str(rng.choice(BACKENDS))
            one.options["max_solver_iterations"] = [None, None, 1, 3][rng.integers(4)]
        if one.options["max_qps"] == 0 or one.loss or one.kink is not None or "clip" in one.writing:
            one.held = {}
        if one.kind == "ukf" and "states" in one.sets:  # X shortens the moves of its sigma points
            one.from_observer = False
        # The code is checked when it is loaded: what is wrong is optimised less.
        self.levels = LEVELS[int(rng.integers(len(LEVELS))) :]
        self.restarted = -1
        self.scribble, self.snapshots = rng.random() < 0.3, rng.random() < 0.15

    @contextmanager
    def optimised(self):
        """Compile with one of the levels of optimisation that are in use, or below."""
        compiler._LEVELS = self.levels
        try:
            yield
        finally:
            compiler._LEVELS = LEVELS

    def configure(self):
        one = self.one
        with self.optimised():
            mhe = one.estimator()
        self.fixed_prior = not one.from_observer
        weight = self.prior_weight(one.P)
        self.watcher = Watcher(one, weight)
        self.hold = Held(one, weight) if one.held else None
        return mhe

    def prior_weight(self, P):
        return np.linalg.inv(self.one.P if self.fixed_prior else P)

    def describe(self):
        one = self.one
        return f"seed {self.seed}: n={one.n} p={one.p} {sorted(one.has)} {self.features()}"

    def features(self):
        one = self.one
        return {
            "model": f"{self.source}, {self.writing}", "time": one.method or "discrete",
            "observer": one.kind, "optimisation": " ".join(self.levels[0]), "cost": one.loss,
            "discount": one.discount, "observer prior": not self.fixed_prior, **one.options,
            "sets": " ".join(one.sets) or "none", "scribbled over": self.scribble,
            "snapshots": self.snapshots, "held": self.hold is not None,
        }

    def run(self, steps, counts):
        """Take so many steps; raises `WrongStepError`."""
        mhe, one = self.configure(), self.one
        N = one.options["horizon"]
        z, P = [one.start.copy()], [self.watcher.P0.copy()]
        history, handed_out, taken = [one.start.copy()], [], []
        buffer_y, buffer_u = np.empty(one.p), np.empty(one.m)
        for t, sample in enumerate(one.samples[:steps]):
            # The same arrays every time, as a driver would.
            buffer_y[:], buffer_u[:] = sample.y, sample.known[: one.m]
            inputs = (buffer_u,) if one.m else ()
            estimate = mhe.update(buffer_y, *inputs, **one.in_units(sample.own, one.own_units))
            buffer_y[:], buffer_u[:] = 1e3, -1e3
            K = min(t + 1, N)
            self._check(estimate, t, K, z, P, history)
            if self.hold is not None:
                self._check_hold(mhe, estimate, K, t)
            wrong(not np.array_equal(mhe.state, history[-1]), "the state is not the estimate's")
            arrays = [
                estimate.trajectory, estimate.candidate, estimate.disturbances, estimate.noises,
                estimate.state, estimate.filtered, mhe.state,
            ]
            if self.scribble:
                for array in arrays:
                    if array.flags.writeable:
                        array[...] = 777.0
            else:
                handed_out.append([(array, array.copy()) for array in arrays])
                # After the next step, and long after it left the window.
                old = handed_out[-2:-1] + handed_out[: -3 * N]
                del handed_out[: -3 * N]
                for array, kept in itertools.chain(*old):
                    changed = not np.array_equal(array, kept, equal_nan=True)
                    wrong(changed, "an array that was handed out has changed")
            if self.snapshots and self.rng.random() < 0.1:
                state = pickle.loads(pickle.dumps(mhe.state_dict()))
                mhe = one.estimator()
                mhe.load_state_dict(state)
            counts["steps"] += 1
            counts.update(self.features().items())
            counts.update(("status", flag.name) for flag in estimate.status)
            taken.append((estimate.cost, estimate.candidate_cost, history[-1]))
        plain = not (self.snapshots or one.k or {"weights", "irregular"} & one.has)
        if plain and (mhe.engine == "compiled" or self.rng.random() < 0.25):
            self._check_run(taken)

    def _check_run(self, taken):
        """A whole record at once is what it is step by step."""
        one, samples = self.one, self.one.samples[: len(taken)]
        inputs = (np.array([sample.known[: one.m] for sample in samples]),) if one.m else ()
        run = one.estimator().run(np.array([sample.y for sample in samples]), *inputs)
        costs, candidate_costs, states = (np.array(each) for each in zip(*taken, strict=True))
        for found, expected in (
            (run.costs, costs), (run.candidate_costs, candidate_costs), (run.states[1:], states),
        ):
            same = np.allclose(found, expected, rtol=1e-8, atol=1e-10)
            wrong(not same, "a run is not its steps:", found, expected)

    def _check_hold(self, mhe, estimate, K, t):
        """What the estimator says of its hold; then the trusted values follow."""
        hold = self.hold
        if t % 4 == 0:
            for name in ("target", "weight"):
                told, own = getattr(mhe.hold, name), getattr(hold, name)
                close = np.allclose(told, own, rtol=1e-5, atol=1e-5 * np.abs(own).max())
                wrong(not close, f"the hold's {name} is", told, "truly", own)
            hold.target = mhe.hold.target.copy()
        if Status.CANDIDATE not in estimate.status:
            hold.learn(estimate.trajectory[int(self.one.options["horizon"] == K)])

    def _check(self, estimate, t, K, z, P, history):
        status, x, one, candidate = estimate.status, estimate.trajectory, self.one, None
        samples = one.samples[t + 1 - K : t + 1]
        candidate = estimate.candidate
        wrong(x.shape != (K + 1, one.n) or candidate.shape != x.shape, x.shape)
        finite = np.isfinite(x).all() and math.isfinite(estimate.cost)
        wrong(not finite or status & (Status.MODEL_FAILED | Status.FAILED_STAGE), status)
        self._observed(estimate, t, K, samples, z, P, history)
        if self.hold is not None:
            self.hold.see(candidate, samples)
        window = one.window(estimate, self.hold, self.prior_weight(P[t + 1 - K]))
        J, candidate_J = window.judged(x)[0], window.judged(candidate)[0]
        exact = self.hold is None and (self.fixed_prior or self.watcher.exact)
        loose = 1e-8 if exact else 1e-5
        for name, told, own in (
            ("cost", estimate.cost, J), ("candidate_cost", estimate.candidate_cost, candidate_J),
        ):
            wrong(not abs(told - own) <= loose * abs(own) + 1e-10, name, "is", told, "truly", own)
        costs = estimate.cost, estimate.candidate_cost
        restored = Status.RESTORED in status
        if restored:
            most = limit = estimate.restored_cost
            wrong(one.options["infeasible"] != "restore", "restored against the option")
            wrong(Status.CANDIDATE_OUTSIDE not in status, "restored from inside", status)
        else:
            most, limit = costs[1], candidate_J
            wrong(not math.isnan(estimate.restored_cost), "restored in secret", status)
        higher = not costs[0] <= most or limit * (1.0 + 2.0 * loose) + 1e-10 < J
        wrong(higher, "the cost is above the", restored, "limit:", *costs, most, J, limit)
        # Within the sets at the same cost is better, too.
        same, improved = costs[0] == costs[1], Status.IMPROVED in status
        wrong(improved and same and Status.CANDIDATE_OUTSIDE not in status, status, *costs)
        wrong(improved + restored + (Status.CANDIDATE in status) != 1, status)
        wrong(not (improved or restored or same), status, *costs)
        moved, kept = improved or restored, np.array_equal(x, candidate)
        wrong(not moved and not kept, "the estimate is not the candidate")
        size = 1.0 + max(float(np.abs(x).max()), *(
            float(np.nanmax(np.abs(one.y), initial=0.0)) for one in samples
        ))
        own = [self._residuals(trajectory, samples) for trajectory in (x, candidate)]
        for told, residuals in zip((estimate.disturbances, estimate.noises), own[0], strict=True):
            close = np.allclose(told, residuals, rtol=0, atol=1e-12 * size, equal_nan=True)
            wrong(not close, "the residuals are not those of the trajectory")
        self._check_sets(estimate, t + 1 - K, (x, *own[0]), (candidate, *own[1]), size)
        wrong(not np.array_equal(estimate.state, x[-1]), "state is not the last of the trajectory")
        expected, tolerance = x[-2], 0.0
        if not moved:
            expected = self.watcher.filtered(z[t], P[t], samples[-1])
            tolerance = 0.0 if expected is z[t] else 1e-5
        close = np.allclose(estimate.filtered, expected, rtol=0, atol=tolerance * size)
        wrong(not close, "filtered is", estimate.filtered, "not", expected, status)
        missing = not np.isfinite(samples[-1].y).all()
        wrong(missing != (Status.MISSING in status), status, "of y =", samples[-1].y)
        history.append(estimate.state.copy())

    def _residuals(self, x, samples):
        """The disturbances and noises of a trajectory."""
        pairs = list(zip(x, samples, strict=False))
        return (
            x[1:] - np.array([self.one.f(z, sample.known, sample.dt) for z, sample in pairs]),
            np.array([sample.y - self.one.h(z, sample.known) for z, sample in pairs]),
        )

    def _observed(self, estimate, t, K, samples, z, P, history):
        """Check the candidate against the observer."""
        first, found, status = t + 1 - K, estimate.candidate, estimate.status
        again, watcher = range(K - 1, K), self.watcher
        if self.one.options["candidate"] == "reinitialized":
            z[first], again = history[first], range(K)
        elif Status.RESTARTED in status:
            wrong(not self.one.options["restart"], "restarted against the option")
            wrong(t - self.restarted < K, "restarted twice within a horizon")
            z[first], P[first], again = history[first], watcher.P0.copy(), range(K)
            self.restarted = t
        wrong(not np.array_equal(found[0], z[first]), "the candidate starts at", found[0])
        tolerance = 1e-9 if watcher.exact else 1e-5
        for i in again:
            following, covariance = watcher.step(z[first + i], P[first + i], samples[i])
            del z[first + i + 1 :], P[first + i + 1 :]
            P.append(covariance)
            scale = 1.0 + float(np.abs(following).max())
            if self.one.kind != "ukf" or "states" not in self.one.sets:  # and its sigma points
                close = np.allclose(found[i + 1], following, rtol=0, atol=tolerance * scale)
                wrong(not close, "the candidate goes to", found[i + 1], "not to", following)
            z.append(found[i + 1].copy())
        same = np.array_equal(found, np.array(z[first:]))
        wrong(not same, "the candidate has changed within the window")
        for flag, missed in (
            (Status.OBSERVER_PROJECTED, watcher.missed),
            (Status.PREDICTION_OUTSIDE, watcher.predicted_missed),
        ):
            moved = min(watcher.missed, missed) > tolerance * scale
            wrong(moved and flag not in status, flag, "is not in", status)
            wrong(flag in status and watcher.exact and not missed, flag, "is in", status)

    def _check_sets(self, estimate, first, of_estimate, of_candidate, scale):
        covariances = np.linalg.inv(self.prior_weight(self.watcher.P0)), self.one.Q, self.one.R

        def missed(points, factor, rounding):
            """Rows that are missed by more than so much in their scale."""
            return {
                (*row, first + k)
                for name, several, covariance in zip(SETS, points, covariances, strict=True)
                for k, point in enumerate(several)
                for row, miss in misses(self.one.sets, name, point, covariance).items()
                if miss > FEASIBLE * factor + rounding * scale / math.sqrt(
                    np.linalg.eigvalsh(covariance)[0]
                )
            }

        status, dropped = estimate.status, set(estimate.dropped)
        surely = missed(of_candidate, 1 + 1e-6, 1e-13)
        perhaps = missed(of_candidate, 1 - 1e-6, -1e-13)
        left = missed(of_estimate, 1 + 1e-6, 1e-13)
        outside, words = Status.CANDIDATE_OUTSIDE in status, ("of", left, surely, "in", status)
        wrong(surely and not outside, "the candidate misses", surely, "says", status)
        wrong(outside and not perhaps, "the candidate misses nothing, says", status)
        wrong((Status.ROWS_DROPPED in status) != bool(dropped), "dropped", dropped, *words)
        missed_too = missed(of_estimate, 1 - 1e-6, -1e-13) & perhaps
        wrong(not dropped <= missed_too, "dropped", dropped, *words)
        low, high, *_ = self.one.sets.get("disturbances", (np.zeros(1), np.ones(1)))
        free = {row for row in dropped if row[0] == "disturbances" and row[1] < len(low)
                and low[row[1]] == high[row[1]]}
        wrong(free, "dropped", free, "which are free of noise")
        moved = Status.CANDIDATE not in status
        wrong(moved and not left <= dropped, "dropped", dropped, *words)
        wrong(not perhaps and left, "misses", left, "and the candidate nothing")
        if self.watcher.projects:
            for point in (*estimate.trajectory, estimate.filtered, *estimate.candidate):
                found = misses(self.one.sets, "states", point, covariances[0])
                beyond = max(found.values(), default=0.0) > 1.1 * FEASIBLE + 1e-13 * scale
                wrong(beyond, point, "is not in X:", found, status)


def fuzz(
    steps, seed=0, *, source=None, writing=None, engine=None, report=None, until=None
):
    """So many steps, or until a failure has some words; counts by category, and the failures."""
    counts, failures, number = Counter(), [], itertools.count(seed * 1_000_003)
    while counts["steps"] < steps:
        case_seed, case = next(number), None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                case = Case(case_seed, source, writing, engine)
                case.run(min(len(case.one.samples), steps - counts["steps"]), counts)
        except WrongStepError as failure:
            failures.append(f"{failure}\n    {case.describe()}")
        except Exception:
            failures.append(f"{traceback.format_exc(limit=-4)}    seed {case_seed}, {writing}")
        if report is not None and len(failures) > counts["failures"]:
            report(failures[-1])
        counts["failures"] = len(failures)
        if len(failures) > 200 or (until and any(until in failure for failure in failures)):
            break
    return counts, failures


def table(counts):
    """The counts in lines."""
    lines = [f"{key}: {value}" for key, value in counts.items() if isinstance(key, str)]
    groups = {}
    for key, value in counts.items():
        if not isinstance(key, str):
            groups.setdefault(key[0], []).append((str(key[1]), value))
    for name, entries in groups.items():
        lines.append(f"{name}: " + "; ".join(f"{key} {value}" for key, value in sorted(entries)))
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--source", choices=WRITINGS)
    parser.add_argument("--writing")
    parser.add_argument("--engine", choices=("python", "compiled"))
    given = parser.parse_args()
    counts, failures = fuzz(
        given.steps, given.seed, source=given.source, writing=given.writing, engine=given.engine,
        report=lambda line: print(line, flush=True),
    )
    print(table(counts))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
