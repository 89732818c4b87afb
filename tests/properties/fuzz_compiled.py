"""The promise of compiled steps with soft and nonlinear rows: ``python -m ... --steps N``.

The cases in which both steps are compared, with random samples of all sorts instead of theirs: each
step is judged by the inequality of costs, and by what its status says of it.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np

from qpmhe import Status

from ..codegen.cases import FEATURES, case
from ..codegen.clean import wild
from . import fuzz_promise

NAMES = [*FEATURES["soft"], *FEATURES["constraints"]]
# Samples of an estimator before the next one of the same case.
RECORD = 200


def broken(estimate):
    """Which parts of the promise a step breaks."""
    faults, status = [], estimate.status
    restored = Status.RESTORED in status
    if not estimate.cost <= (estimate.restored_cost if restored else estimate.candidate_cost):
        faults.append("cost above the limit")
    if estimate.improved + restored + (Status.CANDIDATE in status) != 1:
        faults.append("improved, restored and the candidate")
    if Status.CANDIDATE in status and not np.array_equal(estimate.trajectory, estimate.candidate):
        faults.append("not the candidate")
    if (Status.ROWS_DROPPED in status) != bool(estimate.dropped):
        faults.append("rows dropped in secret")
    if not np.isfinite(estimate.trajectory).all():
        faults.append("not finite")
    return faults


def run(steps, seed, names=NAMES):
    """Counts of statuses, and the faults, of so many steps of each case in turn."""
    counts, faults, share = Counter(), [], -(-steps // len(names))
    for k, name in enumerate(names):
        one, generator = case(name), np.random.default_rng([seed, k])
        samples = [*one.samples, *wild(one)]
        for t in range(share):
            if t % RECORD == 0:
                mhe = one.estimator("compiled")
            sample = dict(samples[generator.integers(len(samples))])
            y = np.array(sample["y"], float)
            factor = generator.choice([1.0, 1.1, 10.0, 1e4], p=[0.8, 0.1, 0.07, 0.03])
            with np.errstate(over="ignore"):
                sample["y"] = y * factor
            estimate = mhe.update(**sample)
            counts.update(flag.name for flag in estimate.status)
            counts["steps"] += 1
            faults += [(name, seed, t, fault) for fault in broken(estimate)]
    return counts, faults


if __name__ == "__main__":
    sys.exit(fuzz_promise.main(__doc__.splitlines()[0], run))
