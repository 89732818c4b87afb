"""The promise on some thousand cheap random steps; the script takes as many as there is time."""

import numpy as np
import pytest

from tests.properties import fuzz_promise


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("seed", [3, 11])
def test_no_step_breaks_the_promise(pytestconfig, seed):
    steps = 1000 if pytestconfig.option.all else 200
    counts, faults = fuzz_promise.run(steps, seed)
    assert faults == []
    assert counts["steps"] >= steps
    assert counts["IMPROVED"] > 0.1 * steps
    assert counts["CANDIDATE_OUTSIDE"] > 0.1 * steps


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
def test_the_judge_sees_a_broken_promise():
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
