"""Random estimation problems, each step judged by code that shares nothing with the estimator.

J, the model, the observer and the sets are written a second time in `independent`. From `qpmhe`
comes only what a user writes down, and the estimator that is tried.

    python -m tests.properties.fuzz_independent --steps 100000 --seed 0
"""

import argparse
import itertools
import math
import pickle
import sys
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager

import numpy as np

import qpmhe
from qpmhe import Status
from qpmhe.codegen import compiler

from .independent import SMOOTH, Held, Model, Price, Region, Watcher, one_of, spd

SETS = ("states", "disturbances", "noises")
# What is missed by so much counts as satisfied, as the documentation has it.
FEASIBLE = 5e-9
WRITINGS = {
    "numpy": (
        "batched", "matmul", "columns", "looped", "view", "branching", "item", "flat", "loop",
        "buffer", "buffer in a branch", "clipping in place",
    ),
    "casadi": ("compiled", "interpreted"),
    "jax": ("jax",),
}
# Those that are quick, and all others but qpalm, which corrupts the memory on some QPs.
QUICK = ("auto", "auto", "banded", "daqp", "quadprog", "piqp", "proxqp", "osqp", "clarabel")
BACKENDS = (
    *QUICK, *QUICK, "piqp_dense", "proxqp_sparse", "qpsolvers:osqp", "qpsolvers:piqp",
    "scs", "ecos", "cvxopt",
)
COMPILED_BACKENDS = ("auto",)
LEVELS = compiler._LEVELS


class WrongStepError(Exception):
    """A step that is not what it says."""


class Case:
    """A model, an estimator for it, and what is expected of each of its steps."""

    def __init__(self, seed, source=None, writing=None, engine=None):
        rng = self.rng = np.random.default_rng(seed)
        self.seed = seed
        self.source = source or one_of(rng, ("numpy",) * 6 + ("casadi",) * 3 + ("jax",))
        self.writing = writing or one_of(rng, WRITINGS[self.source])
        self.model = model = Model(rng, self.source, self.writing)
        self.start = np.clip(0.5 * rng.standard_normal(model.n), -0.15, 2.0)
        self.engine = engine
        self._set_up_sets()
        self.levels = ()
        if self.writing == "compiled":
            # The code is checked when it is loaded: what is wrong is optimised less.
            self.levels = LEVELS[int(rng.integers(len(LEVELS))) :]
        with self.optimised():
            self.system = model.system({name: one.made() for name, one in self.regions.items()})

    @contextmanager
    def optimised(self):
        """Compile with one of the levels of optimisation that are in use, or below."""
        compiler._LEVELS = self.levels or LEVELS
        try:
            yield
        finally:
            compiler._LEVELS = LEVELS

    def _set_up_sets(self):
        rng, model = self.rng, self.model
        self.regions, self.fixed = {}, ()
        if self.writing == "clipping in place":
            region = Region(rng, model.n, 1.0)
            region.low, region.high = np.full(model.n, -0.2), np.full(model.n, np.inf)
            region.rows = None
            self.regions["states"] = region
        elif rng.random() < 0.25 and self.engine != "compiled":
            self.regions["states"] = Region(rng, model.n, one_of(rng, (0.5, 1.0, 3.0)))
        if rng.random() < 0.25:
            if rng.random() < 0.4:
                self.fixed = (int(rng.integers(model.n)),)
            self.regions["disturbances"] = Region(rng, model.n, 0.3, self.fixed)
        if rng.random() < 0.2:
            self.regions["noises"] = Region(rng, model.p, 1.5)
        for name, width in (("disturbances", 0.3), ("noises", 1.5)):
            if name in self.regions and rng.random() < 0.2:
                self.regions[name].leave_out_zero(rng, width)
        if "states" in self.regions and self.regions["states"].missed(self.start) > 0.0:
            self.start = np.zeros(model.n)

    def configure(self):
        """Another estimator for the same system."""
        rng, model = self.rng, self.model
        engine = self.engine
        if engine is None:
            engine = "python"
            # Not for components of w without noise, nor for X: documented, and refused.
            free = not self.fixed and "states" not in self.regions
            if self.writing == "compiled" and free and rng.random() < 0.6:
                engine = "compiled"
        kinds = ["luenberger", "luenberger", "injection"]
        if model.kind in SMOOTH:
            kinds += ["extended", "extended", "steady"]
        if "states" not in self.regions:  # into whose bounds its sigma points are drawn
            kinds += ["unscented"]
        observer = "luenberger" if engine == "compiled" else one_of(rng, kinds)
        self.watcher = Watcher(rng, model, observer, self.start)
        if self.fixed:
            self.watcher.gain[list(self.fixed)] = 0.0
        candidate = "reinitialized" if rng.random() < 0.15 else "observer"
        covariant = observer in ("extended", "steady", "unscented")
        prior = covariant and candidate == "observer" and rng.random() < 0.6
        quadratic = engine == "compiled" or rng.random() < 0.65
        self.price = Price(rng, model, self.watcher, prior, quadratic)
        project = "states" in self.regions and rng.random() < 0.8
        if project:
            initial = self.price.prior_weight(self.watcher.P0)
            region = self.regions["states"]
            self.watcher.keep_inside(region, initial, self.price.weights[2])
        self.options = {
            "horizon": int(rng.integers(1, 13)),
            "backend": one_of(rng, COMPILED_BACKENDS if engine == "compiled" else BACKENDS),
            "max_qps": one_of(rng, (0, 0, 1, 1, 1, 2, 2, 2, 5, None)),
            "max_solver_iterations": one_of(rng, (None, None, 1, 3)),
            "infeasible": one_of(rng, ("drop_rows", "drop_rows", "keep_candidate")),
            "project_observer": project or "states" not in self.regions,
            "warm_start": one_of(rng, (False, False, True)),
            "candidate": candidate,
            "engine": engine,
        }
        sets = {"states", "disturbances", "noises"} & set(self.regions)
        if sets and self.options["backend"] == "banded":
            self.options["backend"] = "auto"
        if self.options["max_qps"] is None and self.options["backend"] not in QUICK:
            self.options["max_qps"] = 3
        self.options["delay"] = int(rng.integers(0, self.options["horizon"] + 1))
        self.data = {
            "missing": one_of(rng, (0.0, 0.0, 0.1, 0.4)),
            "own noise": one_of(rng, (0.0, 0.0, 0.2)),
            "irregular": 0.2 if model.timed and rng.random() < 0.4 else 0.0,
            "outliers": one_of(rng, (0.0, 0.05)),
        }
        self.scribble = rng.random() < 0.3
        self.snapshots = rng.random() < 0.15
        observer, cost = self.watcher.made(self.system), self.price.made()
        self.hold = None
        if quadratic and model.kind in SMOOTH and rng.random() < 0.5:
            self.hold = Held(rng, model, self.price, self.watcher, self.fixed)
        # As `augment_parameters` does; without QPs nothing is held.
        self.system.held = {} if self.hold is None else dict(
            zip(self.hold.places, self.hold.within.tolist(), strict=True)
        )
        if self.options["max_qps"] == 0:
            self.hold = None
        self.arguments = (self.system, observer, cost)
        return self._estimator()

    def _estimator(self):
        with self.optimised():
            return qpmhe.MovingHorizonEstimator(
                *self.arguments, initial_state=self.start, **self.options
            )

    def describe(self):
        model = self.model
        return (
            f"seed {self.seed}: {self.source}/{self.writing}/{model.kind} n={model.n} p={model.p} "
            f"m={model.m} {model.method or 'discrete'} sets={sorted(self.regions)} "
            f"fixed={self.fixed} observer={self.watcher.kind} cost={self.price.names} "
            f"single={self.price.single} discount={self.price.discount} "
            f"observer prior={self.price.prior_of_observer} {self.options} {self.data} "
            f"scribble={self.scribble} snapshots={self.snapshots} held={self.system.held}"
        )

    def sample(self, x):
        """y, u, dt and own weight of a step, and where the plant goes."""
        rng, model = self.rng, self.model
        u = rng.uniform(-1.0, 1.0, model.m)
        dt = None
        if rng.random() < self.data["irregular"]:
            dt = model.dt * float(rng.uniform(0.3, 1.7))
        y = np.array(model.h(x, u)) + 0.2 * rng.standard_normal(model.p)
        if rng.random() < self.data["outliers"]:
            y[rng.integers(model.p)] += 20.0 * rng.standard_normal()
        y[rng.random(model.p) < self.data["missing"]] = np.nan
        own = None
        if rng.random() < self.data["own noise"]:
            single = self.price.single[2]
            own = np.diag(10.0 ** rng.uniform(-1, 2, model.p)) if single else spd(rng, model.p)
        following = np.array(model.f(x, u, dt)) + 0.1 * rng.standard_normal(model.n)
        return (y, u, dt, own), following

    # The promise

    def run(self, steps, counts):
        """Take so many steps; raises `WrongStepError`."""
        mhe = self.configure()
        N, model = self.options["horizon"], self.model
        x = self.start + 0.3 * self.rng.standard_normal(model.n)
        samples, z, P = [], [self.start.copy()], [self.watcher.P0.copy()]
        self.unseen = -1
        history, handed_out, steps_taken = [self.start.copy()], [], []
        buffer_y, buffer_u = np.empty(model.p), np.empty(model.m)
        for t in range(steps):
            sample, x = self.sample(x)
            y, u, dt, own = sample
            samples.append(sample)
            # The same arrays every time, as a driver would.
            buffer_y[:], buffer_u[:] = y, u
            given = {} if own is None else {"noise_weight": own.copy()}
            if dt is not None:
                given["dt"] = dt
            estimate = mhe.update(buffer_y, *((buffer_u,) if model.m else ()), **given)
            buffer_y[:], buffer_u[:] = 1e3, -1e3
            K = min(t + 1, N)
            self._check(estimate, t, K, samples, z, P, history)
            if self.hold is not None:
                self._check_hold(mhe, estimate, K, t)
            if not np.array_equal(mhe.state, history[-1]):
                raise WrongStepError("the estimator's state is not the estimate's")
            arrays = [
                estimate.trajectory, estimate.candidate, estimate.disturbances, estimate.noises,
                estimate.state, estimate.filtered, mhe.state,
            ]
            if estimate.delayed is not None:
                arrays.append(estimate.delayed)
            if self.scribble:
                for one in arrays:
                    if one.flags.writeable:
                        one[...] = 777.0
            else:
                handed_out.append([(one, one.copy()) for one in arrays])
                # After the next step, and long after it left the window.
                old = handed_out[-2:-1] + handed_out[: -3 * N]
                del handed_out[: -3 * N]
                for one, kept in itertools.chain(*old):
                    if not np.array_equal(one, kept, equal_nan=True):
                        raise WrongStepError("an array that was handed out has changed")
            if self.snapshots and self.rng.random() < 0.1:
                state = pickle.loads(pickle.dumps(mhe.state_dict()))
                mhe = self._estimator()
                mhe.load_state_dict(state)
                counts["snapshots"] += 1
            self._count(mhe.engine, estimate, sample, counts)
            steps_taken.append((estimate.cost, estimate.candidate_cost, history[-1]))
        plain = not (self.snapshots or self.data["own noise"] or self.data["irregular"])
        if plain and (mhe.engine == "compiled" or self.rng.random() < 0.25):
            self._check_run(samples, steps_taken)
            counts["runs"] += 1

    def _check_run(self, samples, steps_taken):
        """A whole record at once is what it is step by step."""
        inputs = (np.array([sample[1] for sample in samples]),) if self.model.m else ()
        run = self._estimator().run(np.array([sample[0] for sample in samples]), *inputs)
        costs, candidate_costs, states = (np.array(one) for one in zip(*steps_taken, strict=True))
        for name, found, expected in (
            ("costs", run.costs, costs), ("candidate costs", run.candidate_costs, candidate_costs),
            ("states", run.states, np.vstack((self.start[None], states))),
        ):
            if not np.allclose(found, expected, rtol=1e-8, atol=1e-10):
                raise WrongStepError(f"the {name} of a run are not those of its steps")

    def _count(self, engine, estimate, sample, counts):
        y, _, dt, own = sample
        observed = np.isfinite(y)
        status = estimate.status
        counts["steps"] += 1
        for key, value in (
            ("model", f"{self.source}, {self.writing}"), ("engine", engine),
            ("engine and model", f"{engine}, {self.source}"),
            ("optimisation", " ".join(self.levels[0]) if self.levels else "none"),
            ("kind", self.model.kind),
            ("n", self.model.n), ("p", self.model.p), ("m", self.model.m),
            ("time", self.model.method or "discrete"),
            ("observer", self.watcher.kind),
            ("prior of the observer", self.price.prior_of_observer),
            ("cost", "quadratic" if self.price.quadratic else "robust"),
            ("discounted", self.price.discount < 1.0), ("horizon", self.options["horizon"]),
            ("backend", self.options["backend"]), ("max_qps", self.options["max_qps"]),
            ("cap", self.options["max_solver_iterations"]),
            ("candidate", self.options["candidate"]), ("warm_start", self.options["warm_start"]),
            ("sets", " ".join(sorted(self.regions)) or "none"),
            ("noise-free", bool(self.fixed)), ("infeasible", self.options["infeasible"]),
            ("projecting", self.watcher.region is not None),
            ("sample", "complete" if observed.all() else "partial" if observed.any() else "none"),
            ("own noise weight", own is not None), ("irregular step", dt is not None),
            ("scribbled over", self.scribble), ("held", self.hold is not None),
        ):
            counts[key, value] += 1
        for flag in Status:
            if flag in status:
                counts["status", flag.name] += 1
        if Status.CANDIDATE_OUTSIDE in status:
            rung = "b" if estimate.dropped else "a" if estimate.improved else "c"
            counts["candidate outside, rung", rung] += 1
            counts["nearest points"] += estimate.nearest_points

    def _check_hold(self, mhe, estimate, K, t):
        """What the estimator says of its hold; then the trusted values follow."""
        hold = self.hold
        if t % 4 == 0:
            for name in ("target", "weight"):
                told, own = getattr(mhe.hold, name), getattr(hold, name)
                if not np.allclose(told, own, rtol=1e-5, atol=1e-5 * np.abs(own).max()):
                    raise WrongStepError(f"the hold's {name} is {told}, truly {own}")
            hold.target = mhe.hold.target.copy()
        if estimate.improved:
            hold.learn(estimate.trajectory[int(self.options["horizon"] == K)])

    def _check(self, estimate, t, K, samples, z, P, history):
        status, price = estimate.status, self.price
        window = samples[-K:]
        n = self.model.n
        if estimate.trajectory.shape != (K + 1, n) or estimate.candidate.shape != (K + 1, n):
            raise WrongStepError(f"shapes {estimate.trajectory.shape}, {estimate.candidate.shape}")
        if not np.isfinite(estimate.trajectory).all() or not math.isfinite(estimate.cost):
            raise WrongStepError(f"not finite: {estimate!r}")
        if Status.MODEL_FAILED in status or Status.FAILED_STAGE in status:
            raise WrongStepError(f"the model does not fail, says {status}")
        raw = self._observed(estimate, t, K, window, z, P, history)
        prior, covariance = raw[0], P[t + 1 - K]
        if self.hold is not None:
            self.hold.see(estimate.candidate, window)
        J, first, w, v = price.of(estimate.trajectory, prior, covariance, window, self.hold)
        candidate_J, candidate_first, cw, cv = price.of(
            estimate.candidate, prior, covariance, window, self.hold
        )
        differences = price.prior_of_observer and not self.watcher.exact
        loose = 1e-5 if differences or self.hold is not None else 1e-8
        for name, told, own, term in (
            ("cost", estimate.cost, J, first),
            ("candidate_cost", estimate.candidate_cost, candidate_J, candidate_first),
        ):
            if not abs(told - own) <= 1e-8 * abs(own) + loose * term + 1e-10:
                raise WrongStepError(f"{name} is {told!r}, truly {own!r}; {status}")
        if not estimate.cost <= estimate.candidate_cost:
            raise WrongStepError(f"cost {estimate.cost!r} above {estimate.candidate_cost!r}")
        slack = 2.0 * loose * (first + candidate_first) + 1e-8 * candidate_J + 1e-10
        if not candidate_J + slack >= J:
            raise WrongStepError(f"truly, J {J!r} is above {candidate_J!r}")
        equal = estimate.cost == estimate.candidate_cost
        # Within the sets at the same cost is better, too.
        if (Status.IMPROVED in status and equal and Status.CANDIDATE_OUTSIDE not in status) or (
            Status.CANDIDATE in status and not equal
        ):
            raise WrongStepError(f"{status} with {estimate.cost!r} and {estimate.candidate_cost!r}")
        if (Status.IMPROVED in status) == (Status.CANDIDATE in status):
            raise WrongStepError(f"{status}")
        if Status.CANDIDATE in status and not np.array_equal(
            estimate.trajectory, estimate.candidate
        ):
            raise WrongStepError("the estimate is not the candidate")
        scale = 1.0 + float(np.abs(estimate.trajectory).max())
        if not np.allclose(estimate.disturbances, w, rtol=0, atol=1e-12 * scale):
            raise WrongStepError("the disturbances are not those of the trajectory")
        y_scale = scale + float(np.nanmax(np.abs([s[0] for s in window]), initial=0.0))
        if not np.allclose(estimate.noises, v, rtol=0, atol=1e-12 * y_scale, equal_nan=True):
            raise WrongStepError("the noises are not those of the trajectory")
        self._check_sets(estimate, t + 1 - K, w, v, cw, cv, max(scale, y_scale))
        if not np.array_equal(estimate.state, estimate.trajectory[-1]):
            raise WrongStepError("state is not the last of the trajectory")
        expected, tolerance = estimate.trajectory[-2], 0.0
        if Status.CANDIDATE in status:
            expected = self.watcher.filtered(z[t], P[t], samples[-1])
            tolerance = 0.0 if expected is z[t] else 1e-5
        if not np.allclose(estimate.filtered, expected, rtol=0, atol=tolerance * scale):
            raise WrongStepError(f"filtered is {estimate.filtered}, not {expected}; {status}")
        delay = self.options["delay"]
        if delay <= K and not np.array_equal(estimate.delayed, estimate.trajectory[K - delay]):
            raise WrongStepError("delayed is another state")
        missing = not all(math.isfinite(value) for value in samples[-1][0])
        if missing != (Status.MISSING in status):
            raise WrongStepError(f"{status} of y = {samples[-1][0]}")
        history.append(estimate.state.copy())

    def _observed(self, estimate, t, K, window, z, P, history):
        """Check the candidate against the observer; the observer's own states."""
        first, found, status = t + 1 - K, estimate.candidate, estimate.status
        if self.options["candidate"] == "reinitialized":
            z[first] = history[first]
            again = range(K)
        else:
            again = range(K - 1, K)
        if not np.array_equal(found[0], z[first]):
            raise WrongStepError(f"the candidate starts at {found[0]}, not at {z[first]}")
        tolerance = 1e-9 if self.watcher.exact else 1e-5
        for i in again:
            following, covariance = self.watcher.step(z[first + i], P[first + i], window[i])
            del z[first + i + 1 :], P[first + i + 1 :]
            P.append(covariance)
            scale = 1.0 + float(np.abs(following).max())
            if not np.allclose(found[i + 1], following, rtol=0, atol=tolerance * scale):
                raise WrongStepError(f"the candidate goes to {found[i + 1]}, not to {following}")
            z.append(found[i + 1].copy())
        if not np.array_equal(found, np.array(z[first:])):
            raise WrongStepError("the candidate has changed within the window")
        for flag, missed in (
            (Status.OBSERVER_PROJECTED, self.watcher.missed),
            (Status.PREDICTION_OUTSIDE, self.watcher.predicted_missed),
        ):
            moved = self.watcher.missed > tolerance * scale
            if moved and missed > tolerance * scale and flag not in status:
                raise WrongStepError(f"{flag} is not in {status}")
            if flag in status and not missed > 0.0 and self.watcher.exact:
                raise WrongStepError(f"{flag} is in {status}")
        return z[first : first + K + 1]

    def _check_sets(self, estimate, first, w, v, cw, cv, scale):
        weights = (
            self.price.prior_weight(self.watcher.P0), self.price.weights[1], self.price.weights[2]
        )

        def missed(points, factor, rounding):
            """Rows that are missed by more than so much in their scale."""
            return {
                (name, *row, first + k)
                for name, several, weight in zip(SETS, points, weights, strict=True)
                if name in self.regions
                for k, point in enumerate(several)
                for row, miss in self.regions[name].missed_rows(point, weight).items()
                if miss > FEASIBLE * factor + rounding * scale * math.sqrt(np.abs(weight).max())
            }

        status, dropped = estimate.status, set(estimate.dropped)
        of_candidate, of_estimate = (estimate.candidate, cw, cv), (estimate.trajectory, w, v)
        surely = missed(of_candidate, 1 + 1e-6, 1e-13)
        perhaps = missed(of_candidate, 1 - 1e-6, -1e-13)
        left = missed(of_estimate, 1 + 1e-6, 1e-13)
        if surely and Status.CANDIDATE_OUTSIDE not in status:
            raise WrongStepError(f"the candidate misses {surely}, says {status}")
        if Status.CANDIDATE_OUTSIDE in status and not perhaps:
            raise WrongStepError(f"the candidate misses nothing, says {status}")
        if (Status.ROWS_DROPPED in status) != bool(dropped):
            raise WrongStepError(f"dropped {dropped}, says {status}")
        if not dropped <= missed(of_estimate, 1 - 1e-6, -1e-13):
            raise WrongStepError(f"dropped {dropped}, and misses {left}")
        if not dropped <= perhaps:
            raise WrongStepError(f"dropped {dropped}, and the candidate misses {surely}")
        if any(row[0] == "disturbances" and row[1] in self.fixed for row in dropped):
            raise WrongStepError(f"dropped {dropped}, with rows that are free of noise")
        if Status.IMPROVED in status and not left <= dropped:
            raise WrongStepError(f"misses {left}; dropped {dropped}")
        if not perhaps and left:
            raise WrongStepError(f"misses {left}, and the candidate nothing")
        if self.options["infeasible"] == "keep_candidate" and dropped:
            raise WrongStepError(f"dropped {dropped} against the option")
        if self.watcher.region is not None:
            weight = weights[0]
            for point in (*estimate.trajectory, estimate.filtered, *estimate.candidate):
                outside = self.watcher.region.missed_rows(point, weight)
                if max(outside.values(), default=0.0) > 1.1 * FEASIBLE + 1e-13 * scale:
                    raise WrongStepError(f"{point} is not in X: {outside}; {status}")


def fuzz(
    steps, seed=0, *, source=None, writing=None, engine=None, estimators=3, report=None, until=None
):
    """So many steps, or until a failure has some words; counts by category, and the failures."""
    counts, failures, began = Counter(), [], time.perf_counter()
    number = 0
    told = time.perf_counter()
    while counts["steps"] < steps:
        case_seed = seed * 1_000_003 + number
        number += 1
        case = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                case = Case(case_seed, source, writing, engine)
                slow = case.source == "jax" or case.writing == "compiled"
                for _ in range(estimators):
                    length = 90 if slow else 40
                    case.run(min(length, steps - counts["steps"]), counts)
                    counts["estimators"] += 1
                    if counts["steps"] >= steps:
                        break
        except WrongStepError as failure:
            failures.append(f"{failure}\n    {case.describe()}")
        except Exception:
            where = case.describe() if hasattr(case, "watcher") else (
                f"seed {case_seed}, source {source}, writing {writing}"
            )
            failures.append(f"{traceback.format_exc(limit=-4)}    {where}")
        if report is not None and len(failures) > counts["failures"]:
            report(failures[-1])
        counts["systems"] += 1
        counts["failures"] = len(failures)
        if len(failures) > 200 or (until and any(until in failure for failure in failures)):
            break
        if report is not None and time.perf_counter() - told > 30.0:
            told = time.perf_counter()
            report(f"{counts['steps']} steps, {len(failures)} failures, {told - began:.0f} s")
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
    parser.add_argument("--show", type=int, default=20)
    given = parser.parse_args()
    counts, failures = fuzz(
        given.steps, given.seed, source=given.source, writing=given.writing, engine=given.engine,
        report=lambda line: print(line, flush=True),
    )
    print(table(counts))
    for failure in failures[: given.show]:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
