"""Cases through libraries with sanitizers: ``LD_PRELOAD=libasan.so ... clean LEVEL CASE ...``."""

import sys
import warnings

import numpy as np

import qpmhe
from qpmhe.codegen import compiler, rehearsal

from .cases import case

WILD = 40


def wild(one):
    """Samples with anything in them: missing, infinite, huge, far off, irregular."""
    generator, found = np.random.default_rng(len(one.samples)), []
    for t in range(WILD):
        sample = dict(one.samples[generator.integers(len(one.samples))])
        y = np.array(sample["y"], float)
        scale = generator.choice([1.0, 10.0, 1e6, 1e30, 1e200, 1e308], p=[0.6, *[0.08] * 5])
        with np.errstate(over="ignore"):
            y *= scale * generator.uniform(-1.0, 1.0, y.size)
        y[generator.random(y.size) < 0.1] = generator.choice([np.nan, np.inf, -np.inf, 0.0])
        if "u" in sample:
            sample["u"] = sample["u"] * generator.choice([1.0, -3.0, 1e9], p=[0.8, 0.15, 0.05])
        if one.system.dt and t % 4 == 1:
            sample["dt"] = generator.choice([0.1, 1.0, 3.0]) * one.system.dt
        found.append(sample | {"y": y})
    return found


def run(name):
    """All that the library does: samples, late ones, changes, snapshots, runs and members."""
    one = case(name)
    mhe = one.estimator("compiled")
    assert mhe.engine == "compiled", name
    for t, sample in enumerate([*one.samples, *wild(one)]):
        found = [mhe.update(**sample)]
        if t in one.changes:
            found.append(mhe.set(**one.changes[t]))
        if t % 9 == 8:
            mhe.load_state_dict(mhe.state_dict())
            late = np.resize(sample["y"], one.system.p) + 0.1
            found.append(mhe.amend(t - min(3, one.options["horizon"] - 1), late))
        if t == len(one.samples) - 1 and "failing" not in name:
            mhe.covariances()
        for estimate in found:
            is_restored = qpmhe.Status.RESTORED in estimate.status
            limit = estimate.restored_cost if is_restored else estimate.candidate_cost
            assert estimate.cost <= limit, (name, t)
            assert np.isfinite(estimate.state).all(), (name, t)
    if "parameters" not in one.options:
        batch = qpmhe.BatchEstimator(
            one.system, one.observer, one.cost, members=2, initial_states=one.start,
            engine="compiled", **one.options,
        )
        Y = np.array([[np.resize(sample["y"], one.system.p) for sample in one.samples]] * 2)
        U = np.array([[sample["u"] for sample in one.samples]] * 2) if one.system.m else None
        batch.update(Y[:, 0], U[:, 0] if one.system.m else None)
        batch.run(Y, U)


if __name__ == "__main__":
    compiler._LEVELS = (compiler._LEVELS[int(sys.argv[1])],)
    rehearsal.estimator_fault = lambda *_: ""
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
    for each in sys.argv[2:]:
        run(each)
