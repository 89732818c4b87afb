"""The promise on some hundred random steps of each fuzzer; the scripts take any number."""

import re

import pytest

from qpmhe.codegen.compiler import find_compiler
from tests.properties import fuzz_general, fuzz_promise, problems

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")


@pytest.mark.parametrize("seed", [3, 11])
def test_cheap_steps_keep_the_promise(pytestconfig, seed):
    steps = 1000 if pytestconfig.option.all else 200
    counts, faults = fuzz_promise.run(steps, seed)
    assert faults == []
    assert counts["steps"] >= steps
    assert counts["IMPROVED"] > 0.1 * steps
    assert counts["CANDIDATE_OUTSIDE"] > 0.03 * steps


@pytest.mark.parametrize(("engine", "seed"), [
    ("python", 0), *(pytest.param("python", k, marks=pytest.mark.slow) for k in (1, 2)),
    *(pytest.param("compiled", k, marks=[pytest.mark.slow, pytest.mark.skipif(
        find_compiler() is None, reason="there is no C compiler"
    )]) for k in (0, 2)),
])
def test_steps_with_everything_mixed_keep_the_promise(engine, seed):
    counts, faults = fuzz_general.run(400 if engine == "python" else 1200, seed, engine)
    assert faults == []
    assert counts["IMPROVED"] > 60
    assert counts["CANDIDATE_OUTSIDE"] > (20 if engine == "python" else 0)
    assert counts["set"] > 0
    assert counts["amended"] > 0


def test_the_judge_of_mixed_steps_sees_a_broken_promise():
    seen = set()
    for seed in range(40):
        one = problems.Problem(seed, fuzz_general.MIXED, 1)
        mhe, one.largest = one.estimator(), 1.0
        estimate = one.update(mhe, one.samples[0])
        assert fuzz_general.broken(one, mhe, estimate) == []
        if not estimate.improved:
            continue
        estimate.trajectory[:] = estimate.trajectory + 3.0
        estimate.dropped = () if estimate.dropped else ("a row",)
        faults = fuzz_general.broken(one, mhe, estimate)
        estimate.dropped = ()
        estimate.cost, estimate.candidate_cost = 2.0, 1.0
        faults += fuzz_general.broken(one, mhe, estimate)
        seen |= {re.split(r",? (?:by )?[-0-9]", fault)[0] for fault in faults}
    assert seen >= {
        "rows dropped in secret", "a hard row violated", "outside of X", "candidate's cost", "cost",
        "a disturbance in a direction that has none", "cost above the candidate's",
    }
