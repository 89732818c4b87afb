"""The promise with everything mixed, on some hundred steps; the script takes any number."""

import re

import numpy as np
import pytest

from qpmhe.codegen.compiler import find_compiler
from tests.properties import fuzz_general


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_no_step_breaks_the_promise(seed):
    counts, faults = fuzz_general.run(500, seed)
    assert faults == []
    assert counts["IMPROVED"] > 60
    assert counts["CANDIDATE_OUTSIDE"] > 20
    assert counts["set"] > 0


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("seed", [0, 1])
def test_no_compiled_step_breaks_the_promise(seed):
    counts, faults = fuzz_general.run(1200, seed, "compiled")
    assert faults == []
    assert counts["IMPROVED"] > 200
    assert counts["set"] > 0


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_the_judge_sees_a_broken_promise():
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
