"""Observers that run side by side give the same re-initialised candidate as a full replay."""

import math

import numpy as np
import pytest

import qpmhe

from .same import assert_same
from .spoil import cost_of, estimator

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def failing_system(where, how):
    """Where x is negative, f or h returns NaN or raises."""

    def root(x):
        return 0.9 * np.sqrt(x) + 0.1 if how == "nan" else [0.9 * math.sqrt(x[0]) + 0.1]

    functions = {"f": lambda x: 0.9 * x, "h": lambda x: 0.9 * x} | {where: root}
    slopes = {f"{k}_jacobian": lambda x: np.full((*np.shape(x), 1), 0.9) for k in functions}
    slopes[f"{where}_jacobian"] = lambda x: 0.45 / np.sqrt(np.asarray(x))[..., None]
    return qpmhe.System(**functions, **slopes, n=1, p=1)


def watched(mhe):
    """Whether each step's candidate came from running observers: filled as it goes on."""
    window, found = mhe._engine._window, []
    follow, replay = window._follow, window.replay
    window._follow = lambda estimates: found.append(True) or follow(estimates)
    window.replay = lambda steps, state=None: (
        found.append(False) if state is not None else None
    ) or replay(steps, state)
    return found


@pytest.mark.parametrize(("where", "how", "seed"), [
    ("f", "nan", 1), ("f", "raises", 0), ("h", "nan", 1), ("h", "raises", 0),
])
def test_the_candidate_is_that_of_a_replay(where, how, seed):
    generator, start = np.random.default_rng(seed), np.ones(1)
    mhe, full, resumed = (
        estimator(
            failing_system(where, how), qpmhe.Luenberger([[0.5]]),
            cost_of(1, 1, disturbance=2.0, noise=0.3), horizon=4, initial_state=start,
            candidate="reinitialized", max_qps=seed, warm_start=bool(seed),
        ) for _ in range(3)
    )
    came = watched(mhe)
    for t in range(24):
        state = mhe.state_dict()
        full.load_state_dict(state)
        full._engine._window._observers = None  # it replays the window
        resumed.load_state_dict(state)
        y = generator.normal(1.0, 0.2, 1) - 3.0 * (generator.random() < 0.15)
        if generator.random() < 0.2:
            y[0] = generator.choice([np.nan, 1e154, -np.inf])
        estimate, again, expected = (one.update(y) for one in (mhe, resumed, full))
        assert_same(estimate, again)
        if came[-1]:
            size = 1.0 + np.abs(expected.candidate).max() ** 2
            np.testing.assert_allclose(
                estimate.candidate, expected.candidate, rtol=0, atol=1e-12 * size
            )
            assert estimate.candidate_cost == pytest.approx(expected.candidate_cost, rel=1e-11)
        else:
            assert_same(estimate, expected)
        if generator.random() < 0.2:
            time = t - int(generator.integers(0, mhe._engine.length))
            late = start + 0.2 * generator.standard_normal(1)
            assert_same(mhe.amend(time, late), resumed.amend(time, late))
    assert 0 < came.count(False) < 23
