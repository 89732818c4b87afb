"""Steps of one estimator of the campaign, with all that happens while it runs."""

from __future__ import annotations

import copy
import io
import json
import time
import traceback
from collections import Counter

import numpy as np

import qpmhe
from qpmhe import QpmheError, Status

from .cases import SETS, Case
from .engines import Beside
from .judge import Judge, Sample, functions

# An estimator goes on until it has used so many seconds of the processor: fast ones take more
# samples. Where it ends changes none of its steps.
_SECONDS, _LONGEST = 2.5, 1000
_TWIN = 60  # for so many of its samples, a twin whose arrays nobody touches stands beside it
# A fault of each kind is told once for each estimator, and no more than so many end it.
_MOST = 20


class LostError(Exception):
    """An estimator that cannot go on."""


def plain(state):
    """A snapshot to compare: NaN is NaN, whichever its bits are."""
    return {
        name: (np.where(np.isnan(value), np.nan, value) if value.dtype.kind == "f" else
               value).tobytes()
        for name, value in state.items() if isinstance(value, np.ndarray)
    }


def scribble(arrays):
    """Overwrite arrays that were handed out or in."""
    for array in arrays:
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and array.flags.writeable:
            array[...] = 1e300


class Run:
    """An estimator, at times a twin whose arrays nobody touches, and at times another engine."""

    def __init__(self, seed, engine="python", samples=None):
        self.counts, self.faults = Counter(), []
        self.case = case = Case(seed, engine)
        self.r = r = np.random.default_rng([seed, 1])
        self.mhe = case.estimator()
        self.beside = None
        if engine == "compiled":
            if self.mhe.engine != "compiled":
                self.fault("the step was not compiled", "")
            else:
                self.beside = Beside(case, self.mhe)
                self.counts["libraries"] += 1
        self.twin = case.estimator() if engine == "python" and r.random() < 0.15 else None
        self.judge = Judge(case)
        length = int(r.integers(60, 200))
        self.shortest = self.longest = samples or length
        if not samples and engine == "python":
            self.shortest, self.longest = case.options["horizon"] + 5, _LONGEST
        self.hostile = r.random() < 0.15
        self.smoothed = case.options.get("arrival") == "smoothed"
        self.exact = "time_budget" not in case.options
        self.usual = Sample(
            case.model.parameters.copy(), np.zeros(0), case.iQ, case.iR, dict(case.sets)
        )
        self._forget()
        self.truth = case.origin.copy()
        case.tags += ["hostile data"] * self.hostile

    def fault(self, kind, detail):
        self.counts[f"fault: {kind}"] += 1
        if self.counts[f"fault: {kind}"] == 1:
            self.faults.append((kind, f"at {getattr(self, 'time', 0)}: {detail}"))

    def _forget(self):
        """Nothing has been measured."""
        self.window, self.time, self.last = [], 0, None
        self.states, self.restarted = {}, 0  # the last estimates, by the time of their state

    def go(self):
        """Take all samples; the steps' number."""
        began = time.process_time()
        try:
            for taken in range(self.longest):
                if taken >= self.shortest and time.process_time() - began > _SECONDS:
                    break
                if taken == _TWIN:
                    self.twin = None
                self._sample()
                if len(self.faults) > _MOST:
                    break
        except LostError:
            pass
        self.counts += Counter(self.judge.counts)
        for tag in set(self.case.tags):
            self.counts[f"with {tag}"] += self.counts["steps"]
        return self

    def _called(self, name, function):
        """What a call returns; nothing that comes from data may raise."""
        try:
            return function()
        except Exception as error:
            self.fault(f"{name} raised {type(error).__name__}", traceback.format_exc(limit=-4))
            raise LostError from error

    # What is measured.

    def _drawn(self):
        """The input, and a sample with what comes with it."""
        case, r = self.case, self.r
        u = 0.3 * r.normal(size=case.m - case.k)
        if case.model.defined_within:
            u = np.abs(u + 0.3)
        given, theta = {}, self.usual.u
        if case.k and r.random() < 0.1:
            theta = theta * r.uniform(0.5, 1.5, case.k)
            given["parameters"] = theta.copy()
        known = np.append(u, theta)
        ahead, outputs = functions(case, self.truth[None], known[None])
        R, Q = (np.sqrt(np.diag(one)) for one in (case.R, case.Q))
        y, w = outputs[0] + r.normal(size=case.p) * R, r.normal(size=case.d) * Q
        self.truth = ahead[0] + (w if case.G is None else case.G @ w)
        if case.model.positive:
            self.truth = np.maximum(self.truth, 0.0)
        with np.errstate(invalid="ignore"):
            if not np.abs(self.truth / case.x_units).max() <= 1e6:
                self.truth = case.origin.copy()
        return u, Sample(known, self._spoilt(y, R), self.usual.disturbance, self.usual.noise,
                         dict(self.usual.sets)), given

    def _spoilt(self, y, R):
        """Outliers, and numbers that no sensor should return."""
        r, p = self.r, len(y)
        chance = r.random()
        if chance < 0.05:
            y = y + r.normal(size=p) * R * 10.0 ** r.uniform(1.0, 12.0 if self.hostile else 2.0)
        if self.hostile and chance > 0.97:
            extremes = [0.0, 1e12, -1e12, 1e100, 1e-300, 5e-324]
            y = r.choice(extremes, p) * self.case.y_units
        if self.hostile and 0.9 < chance < 0.92:
            y = np.full(p, np.inf if r.random() < 0.5 else -1e160)
        return y if self.hostile else np.where(np.isfinite(y), y, np.nan)

    def _given(self, sample, given):
        """Gaps, sensors, weights and bounds of one sample; the argument y."""
        case, r = self.case, self.r
        chance, y = r.random(), sample.y.copy()
        if chance < 0.04:
            y, sample.y = None, np.full(case.p, np.nan)
        elif chance < 0.1:
            y[r.random(case.p) < 0.5] = np.nan
            sample.y = y.copy()
        elif chance < 0.14:
            chosen = np.flatnonzero(r.random(case.p) < 0.6)
            chosen = chosen if len(chosen) else np.array([0])
            given["sensors"], sample.y = chosen.tolist(), np.full(case.p, np.nan)
            sample.y[chosen] = y[chosen]
            y = y[chosen]
        with np.errstate(invalid="ignore"):  # beyond 1e150 no square is finite
            sample.y = np.where(np.abs(sample.y) < 1e150, sample.y, np.nan)
        if r.random() < 0.05:
            sample.noise = sample.noise * 10.0 ** r.uniform(-2.0, 2.0)
            given["noise_weight"] = sample.noise.copy()
        if r.random() < 0.04:
            sample.disturbance = sample.disturbance * 10.0 ** r.uniform(-2.0, 2.0)
            given["disturbance_weight"] = sample.disturbance.copy()
        if r.random() < 0.06 and (moved := self._moved()):
            given["bounds"] = {SETS[name]: one for name, one in moved.items()}
            sample.sets |= moved
        return y

    def _moved(self):
        """Other sides of some sets."""
        case, r, found = self.case, self.r, {}
        units = {"x": case.x_units, "w": np.ones(case.d), "v": case.y_units}
        for name, one in self.usual.sets.items():
            if one is None or r.random() < 0.5 or (name == "x" and case.x_angles):
                continue
            if len(one.matrix):
                upper = one.row_upper + r.uniform(-0.2, 1.0) * np.abs(one.row_upper)
                found[name] = qpmhe.Polytope(one.matrix, upper)
                continue
            low, high = one.lower, one.upper
            side = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high, 0.0))
            with np.errstate(invalid="ignore"):
                width = np.where(
                    np.isfinite(high - low), high - low, np.abs(side) + 1e-3 * units[name]
                )
            lower = low + r.uniform(-0.3, 0.3) * width
            upper = high + r.uniform(-0.25, 0.5) * width
            if case.model.defined_within and name == "x":
                lower = np.maximum(lower, 0.0)
            fixed = one.fixed_components
            lower[fixed], upper[fixed] = low[fixed], high[fixed]
            upper = np.maximum(upper, lower)
            new = upper == lower
            new[fixed] = False
            upper[new] += width[new]
            found[name] = qpmhe.Box(lower, upper)
        return found

    # One sample.

    def _sample(self):
        u, sample, given = self._drawn()
        y, inputs = self._given(sample, given), (u,) if len(u) else ()
        self._at_times(y, inputs, given)
        mean = self.last if self.smoothed and self.time >= self.case.options["horizon"] else None
        if self.beside:
            self.beside.begin(self.mhe)
        arguments = copy.deepcopy((y, inputs, given))
        estimate = self._called("update", lambda: self.mhe.update(
            arguments[0], *arguments[1], **arguments[2]
        ))
        scribble([arguments[0], *arguments[1], *arguments[2].values()])
        self._compare(estimate, y, inputs, given)
        self.window.append(sample)
        self.time += 1
        if self.mhe.time != self.time:
            self.fault("time", (self.mhe.time, self.time))
        self._judged(estimate, mean)
        self._afterwards()
        del self.window[: -self.case.options["horizon"] - 1]

    def _judged(self, estimate, mean=None):
        self.counts["steps"] += 1
        window = self.window[1 - len(estimate.trajectory) :]
        for fault in self.judge.faults(estimate, window, mean):
            self.fault(*fault)
        if Status.RESTARTED in estimate.status:
            self._of_restart(estimate)
        self.last = estimate.trajectory[1].copy()
        self.states[self.time] = estimate.state.copy()
        self.states.pop(self.time - 31, None)
        handed = [getattr(estimate, name) for name in (
            "trajectory", "candidate", "observer_state", "filtered", "disturbances", "noises",
            "state",
        )]
        scribble([*handed, self.mhe.state, self.mhe.observer_state, self.mhe.initial_state])

    def _of_restart(self, estimate):
        """The observer starts at the estimate of a horizon before, once in a horizon at most."""
        case, horizon = self.case, self.case.options["horizon"]
        self.counts["restarted"] += 1
        if "restart" not in case.options:
            self.fault("restarted against the option", estimate.status)
        if self.time - 1 - self.restarted < horizon:
            self.fault("restarted too early", (self.time, self.restarted))
        self.restarted, projected = self.time, case.given["x"] is not None
        start = self.states.get(self.time - horizon)
        if not projected and (start is None or not np.array_equal(start, estimate.candidate[0])):
            self.fault("restarted elsewhere", (start, estimate.candidate[0]))

    def _compare(self, estimate, y, inputs, given):
        if self.twin:
            other = self._called("update", lambda: self.twin.update(y, *inputs, **given))
            same = np.array_equal(other.trajectory, estimate.trajectory) and (
                other.cost == estimate.cost and other.candidate_cost == estimate.candidate_cost
            )
            backend = self.case.options.get("backend")
            # Two fresh solvers of these kinds may differ in the last digits on equal QPs.
            if self.exact and not same and backend != "proxqp":
                self.fault("a twin whose arrays nobody touched differs",
                           (estimate.cost, other.cost, estimate.status, other.status))
            if not same:
                self.mhe.forget_warm_start()
                self.twin.load_state_dict(self.mhe.state_dict())
        self._stand_beside("update", estimate, lambda one, change: one.update(
            y if y is None else change(y), *inputs, **given
        ))

    def _stand_beside(self, name, estimate, act):
        """Compare with the Python step, which does the same from the same memory."""
        if not self.beside or estimate is None:
            return
        other, difference = self._called(
            f"{name} of the Python step", lambda: self.beside.compare(estimate, act)
        )
        self.counts["compared"] += 1
        restored = Status.RESTORED in other.status
        if not 0.0 <= other.cost <= (other.restored_cost if restored else other.candidate_cost):
            self.fault("cost of the Python step", (other.cost, other.candidate_cost))
        if difference:
            name = "" if name == "update" else f" after {name}"
            self.counts[f"engines{name}: {difference}"] += 1
            if difference.reason == "open":
                self.fault(f"engines{name}: {difference}", difference.detail)

    def _all(self, name, act):
        """Do something with the estimator, its twin and the Python step."""
        if self.beside:
            self.beside.begin(self.mhe)
        if self.twin:
            self._called(name, lambda: act(self.twin, lambda numbers: numbers))
        estimate = self._called(name, lambda: act(self.mhe, lambda numbers: numbers))
        if name != "reset":
            self._stand_beside(name, estimate, act)
        return estimate

    # What happens at times.

    def _at_times(self, y, inputs, given):
        """Interrupts, and arguments that must be refused as a whole."""
        case, r = self.case, self.r
        if self.twin and case.writing == "opaque" and r.random() < 0.15:
            before, case.alarm.left = plain(self.mhe.state_dict()), int(r.integers(12))
            try:
                self.mhe.update(*copy.deepcopy((y, *inputs)), **copy.deepcopy(given))
            except KeyboardInterrupt:
                self.counts["interrupts"] += 1
                if plain(self.mhe.state_dict()) != before:
                    self.fault("an interrupted update changed the memory", given)
            case.alarm.left = -1
            self.mhe.load_state_dict(self.twin.state_dict())
            for one in (self.mhe, self.twin):
                one.forget_warm_start()
        if r.random() < 0.02:
            self._refused()

    def _refused(self):
        case, kind, before = self.case, int(self.r.integers(6)), plain(self.mhe.state_dict())
        inputs = (np.zeros(case.m - case.k),) if case.m > case.k else ()
        bad = [
            lambda: self.mhe.update(np.zeros(case.p + 1), *inputs),
            lambda: self.mhe.update(np.zeros(case.p), *inputs, noise_weight=-np.eye(case.p)),
            lambda: self.mhe.update("abc", *inputs),
            lambda: self.mhe.amend(self.time + 5, np.zeros(case.p)),
            lambda: self.mhe.set(noise_weight=np.full((case.p, case.p), np.nan)),
            lambda: self.mhe.update(np.zeros(case.p), *inputs, bounds={
                "states": qpmhe.Box(np.zeros(case.n + 1), np.ones(case.n + 1))
            }),
        ][kind]
        try:
            bad()
            self.fault(f"bad argument {kind} is taken", "")
        except QpmheError:
            self.counts["bad arguments refused"] += 1
        except Exception:
            self.fault(f"bad argument {kind} raises another error", traceback.format_exc(limit=-3))
        if plain(self.mhe.state_dict()) != before:
            self.fault(f"bad argument {kind} changed the memory", "")

    def _afterwards(self):
        r = self.r
        if r.random() < 0.05:
            self._asked("covariances", lambda: scribble([self.mhe.covariances()]))
        if r.random() < 0.02:
            self._asked("sensitivity", lambda: self.mhe.sensitivity())
        chance = r.random()
        if chance < 0.03 and not self.smoothed:
            self._late()
        elif chance < 0.05 and not self.smoothed:
            self._set()
        elif chance < 0.07:
            self._snapshot(int(r.integers(4)))
        elif chance < 0.073:
            self._all("reset", lambda one, change: one.reset())
            self._forget()

    def _asked(self, name, function):
        try:
            function()
            self.counts[name] += 1
        except QpmheError:
            self.counts[f"{name} refused"] += 1
        except Exception:
            self.fault(f"{name} raises another error", traceback.format_exc(limit=-4))

    def _late(self):
        case, r = self.case, self.r
        count = min(len(self.window), case.options["horizon"])
        back = int(r.integers(1, count + 1))
        sample = copy.copy(self.window[-back])
        y = functions(case, self.truth[None], sample.u[None])[1][0]
        y = np.where((r.random(case.p) < 0.5) | ~(np.abs(y) < 1e150), np.nan, y)
        sample.y = np.where(np.isfinite(y), y, sample.y)
        self.window[-back] = sample
        estimate = self._all("amend", lambda one, change: one.amend(self.time - back, change(y)))
        self.counts["amended"] += 1
        self._judged(estimate)

    def _set(self):
        case, r, given = self.case, self.r, {}
        if r.random() < 0.5:
            given["noise_weight"] = self.usual.noise * 10.0 ** r.uniform(-1.0, 1.0)
        if r.random() < 0.5:
            given["disturbance_weight"] = self.usual.disturbance * 10.0 ** r.uniform(-1.0, 1.0)
        moved = self._moved() if r.random() < 0.5 else {}
        if moved:
            given["bounds"] = {SETS[name]: one for name, one in moved.items()}
        if case.k and r.random() < 0.5:
            given["parameters"] = self.usual.u * r.uniform(0.8, 1.2, case.k)
        if not given:
            return
        self.window = [copy.copy(one) for one in self.window]
        for one in (self.usual, *self.window):
            one.noise = given.get("noise_weight", one.noise)
            one.disturbance = given.get("disturbance_weight", one.disturbance)
            one.sets = one.sets | moved
            if "parameters" in given:
                one.u = np.append(one.u[: len(one.u) - case.k], given["parameters"])
        self.judge.iQ, self.judge.iR = self.usual.disturbance, self.usual.noise
        estimate = self._all("set", lambda one, change: one.set(**copy.deepcopy(given)))
        self.counts["set"] += 1
        if estimate is not None:
            self._judged(estimate)

    def _snapshot(self, way):
        """Go on in another estimator, from a snapshot in one of four ways."""
        if self.twin:
            self.twin.forget_warm_start()
        self.mhe.forget_warm_start()
        state, fresh = self.mhe.state_dict(), self.case.estimator()
        if way == 0:
            self._called("load_state_dict", lambda: fresh.load_state_dict(state))
        elif way == 1:
            file = io.BytesIO()
            np.savez(file, **state)
            file.seek(0)
            with np.load(file) as loaded:
                self._called("load_state_dict", lambda: fresh.load_state_dict(loaded))
        elif way == 2:
            text = json.dumps(state, default=np.ndarray.tolist)
            self._called("load_state_dict", lambda: fresh.load_state_dict(json.loads(text)))
        else:
            fresh = self._called("deepcopy", lambda: copy.deepcopy(self.mhe))
        self.mhe = fresh
        self.counts["snapshots"] += 1
        if plain(fresh.state_dict()) != plain(state):
            self.fault(f"a snapshot of way {way} is another one", "")


def run(seed, engine="python", samples=None):
    """Counts of one estimator, its faults, and how to describe it."""
    try:
        one = Run(seed, engine, samples)
    except QpmheError as error:
        return Counter({f"refused: {type(error).__name__}": 1}), [], str(error)
    one.go()
    one.counts["estimators"] += 1
    return one.counts, one.faults, f"{one.case.tags} {one.case.options}"
