"""The promise on many cheap random steps: ``python -m tests.properties.fuzz_promise --steps N``.

Small models that are not defined everywhere, sets that exclude zero or one another, outliers and
gaps, each step judged by the few inequalities that no option may break. `fuzz_general` judges J
as well, `fuzz_independent` everything.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter

import numpy as np

import qpmhe
from qpmhe import Status

from .problems import SETS, Problem

# Of a row, in units of its width or of a standard deviation.
FEASIBLE = 1e-8
STEPS = 50
WILD = {
    "domain": 1.0, "outliers": 1.0, "missing": 1.0, "states": 0.4, "disturbances": 0.4,
    "noises": 0.4, "angles": 0.4, "matrix": 0.25, "covariance": 0.15, "kalman": 0.4, "rules": 0.6,
    "observer prior": 0.5, "held": 0.2, "loss": 0.3, "discount": 0.2, "inputs": 0.2,
}


def misses(one, estimate):
    """The largest miss of a hard bound in X, and in W and V."""
    x, count = estimate.trajectory, len(estimate.disturbances)
    window = one.samples[estimate.time + 1 - count : estimate.time + 1]
    states = [*enumerate(x)]
    if one.options["project_observer"]:
        states += [*enumerate(estimate.candidate), (count - 1, estimate.filtered)]
    points = states, enumerate(estimate.disturbances), enumerate(estimate.noises)
    found = dict.fromkeys(SETS, 0.0)
    for name, covariance, several in zip(SETS, (one.P, one.Q, one.R), points, strict=True):
        if name in one.sets and name not in one.prices:
            for k, point in several:
                low, high = window[min(k, count - 1)].bounds[name]
                scale = np.sqrt(covariance.diagonal())
                scale = np.where(high > low, np.minimum(high - low, scale), scale)
                missed = np.maximum(low - point, point - high)
                if name != "states":
                    missed -= 1e-13 * (1.0 + np.abs(x).max() + one.largest)
                found[name] = max(found[name], float(np.nanmax(missed / scale, initial=0.0)))
    return found.pop("states"), max(found.values())


def broken(one, estimate, feasible=FEASIBLE):
    """Which parts of the promise a step breaks."""
    faults, status, x = [], estimate.status, estimate.trajectory
    count = len(x) - 1
    window = one.samples[estimate.time + 1 - count : estimate.time + 1]
    restored, moved = Status.RESTORED in status, Status.CANDIDATE not in status
    if restored != np.isfinite(estimate.restored_cost):
        faults.append("restored in secret")
    if restored and (Status.CANDIDATE_OUTSIDE not in status or estimate.dropped):
        faults.append("restored into sets that are left")
    if restored and one.options["infeasible"] != "restore":
        faults.append("restored against the option")
    if restored and not estimate.cost <= estimate.restored_cost:
        faults.append("cost above that of the restored candidate")
    if not (restored or estimate.cost <= estimate.candidate_cost or (
        estimate.candidate_cost == np.inf
    )):
        faults.append("cost above the candidate's")
    if (Status.ROWS_DROPPED in status) != bool(estimate.dropped):
        faults.append("rows dropped in secret")
    if estimate.improved + restored + (Status.CANDIDATE in status) != 1:
        faults.append("improved, restored and the candidate")
    if not moved and not np.array_equal(x, estimate.candidate):
        faults.append("not the candidate")
    outside, missed = misses(one, estimate)
    projected = one.options["project_observer"] or (moved and not estimate.dropped)
    # Where trials are rolled out, none of them can be clipped.
    if projected and outside > (feasible if one.how else 0.0):
        faults.append(f"outside of X by {outside}")
    if moved and one.how == "matrix":
        ahead = np.array([
            one.f(state, sample.known, sample.dt)
            for state, sample in zip(x, window, strict=False)
        ])
        d = x[1:] - ahead - estimate.disturbances @ one.G.T
        period = one.periods[0]
        d = np.where(np.isfinite(period), d - period * np.round(d / period), d)
        if np.abs(d).max() > 1e-12 * (1.0 + np.abs(x).max()):
            faults.append(f"a disturbance in a direction that has none, {np.abs(d).max()}")
    if moved and not estimate.dropped and missed > feasible:
        faults.append(f"a set violated by {missed} and no row dropped")
    return faults


def run(steps, seed):
    """Counts of statuses, and the faults, of so many steps."""
    draw, counts, faults = np.random.default_rng(seed), Counter(), []
    while counts["steps"] < steps:
        start = int(draw.integers(2**31))
        one = Problem(start, WILD, STEPS)
        mhe, one.largest = one.estimator(), 1.0
        for t, sample in enumerate(one.samples):
            sample.y *= one.rng.choice([1.0] * 20 + [1e4])
            one.largest = max(one.largest, float(np.nanmax(np.abs(sample.y), initial=0.0)))
            estimate = one.update(mhe, sample)
            counts.update(flag.name for flag in estimate.status)
            counts["steps"] += 1
            faults += [(start, t, fault) for fault in broken(one, estimate)]
    return counts, faults


def main(description, run):
    """Print what `run` counts and finds; 1 if there are faults."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for known in (qpmhe.ObserverWarning, qpmhe.ModelWarning):
        warnings.simplefilter("ignore", known)
    counts, faults = run(arguments.steps, arguments.seed)
    for name, count in counts.most_common():
        print(f"{name:20}{count:>10,}")
    print(f"faults: {len(faults)}", *faults[:20], sep="\n")
    return bool(faults)


if __name__ == "__main__":
    raise SystemExit(main(__doc__.splitlines()[0], run))
