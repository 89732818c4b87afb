"""The promise on some hundred random steps of each fuzzer; the scripts take any number."""

import re

import numpy as np
import pytest

from qpmhe.codegen.compiler import find_compiler
from tests.properties import fuzz_general, fuzz_promise

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
SLOW = pytest.mark.slow
COMPILED = [SLOW, pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")]


@pytest.mark.parametrize("seed", [3, 11])
def test_cheap_steps_keep_the_promise(pytestconfig, seed):
    steps = 1000 if pytestconfig.option.all else 200
    counts, faults = fuzz_promise.run(steps, seed)
    assert faults == []
    assert counts["steps"] >= steps
    assert counts["IMPROVED"] > 0.1 * steps
    assert counts["CANDIDATE_OUTSIDE"] > 0.1 * steps


@pytest.mark.parametrize(("engine", "seed"), [
    ("python", 0), *(pytest.param("python", k, marks=SLOW) for k in (1, 2, 3)),
    *(pytest.param("compiled", k, marks=COMPILED) for k in (0, 2)),
])
def test_steps_with_everything_mixed_keep_the_promise(engine, seed):
    counts, faults = fuzz_general.run(500 if engine == "python" else 1200, seed, engine)
    assert faults == []
    assert counts["IMPROVED"] > (60 if engine == "python" else 200)
    assert counts["CANDIDATE_OUTSIDE"] > (20 if engine == "python" else 0)
    assert counts["set"] > 0


def test_the_judge_of_cheap_steps_sees_a_broken_promise():
    seen = set()
    for seed in range(40):
        draw = np.random.default_rng(seed)
        mhe, system, cost = fuzz_promise.case(draw)
        estimate = mhe.update(np.full(system.p, 0.3))
        assert fuzz_promise.broken(mhe, system, cost, estimate, 0.3) == []
        estimate.cost = estimate.candidate_cost + 1.0
        estimate.dropped = () if estimate.dropped else ("a row",)
        if system.states is not None:
            estimate.trajectory[:] = system.states.upper + 1.0
        seen |= set(fuzz_promise.broken(mhe, system, cost, estimate, 0.3))
    assert seen >= {"cost above the candidate's", "rows dropped in secret", "outside of X"}


def test_the_judge_of_mixed_steps_sees_a_broken_promise():
    seen = set()
    for seed in range(60):
        draw = np.random.default_rng(seed)
        one = fuzz_general.case(draw)
        estimate = fuzz_general.update(one, draw)
        assert fuzz_general.broken(one, estimate) == []
        if not estimate.improved:
            continue
        estimate.trajectory[:] = estimate.trajectory + 3.0
        estimate.dropped = () if estimate.dropped else ("a row",)
        seen |= {*map(kind, fuzz_general.broken(one, estimate))}
        estimate.dropped = ()
        estimate.cost, estimate.candidate_cost = 2.0, 1.0
        seen |= {*map(kind, fuzz_general.broken(one, estimate))}
    assert seen >= {
        "rows dropped in secret", "a hard row violated", "disturbance outside of the range of G",
        "candidate's cost", "cost", "cost above the candidate's",
    }


def kind(fault):
    """A fault without its numbers."""
    return re.split(r" (?:by )?[-0-9]", fault)[0]
