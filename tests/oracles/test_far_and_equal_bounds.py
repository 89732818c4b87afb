"""Bounds that are far away, or equal, change no estimate, whichever backend solves the QPs."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import SetError
from qpmhe_solvers import available, backend

NAMES = [name for name in available() if ":" not in name and backend(name).inequalities]
A = np.array([[1.0, 0.1, 0.0], [-0.3, 0.9, 0.05], [0.0, 0.0, 1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
COVARIANCES = {
    "prior": np.eye(3), "disturbance": np.diag([9e-4, 9e-4, 1e-8]), "noise": 25e-4 * np.eye(2)
}
# What the backends' own tolerances leave of deviations of 0.05.
CLOSE = 1e-3


def record():
    rng = np.random.default_rng(0)
    x, ys = np.array([0.5, -1.0, 0.2]), []
    for _ in range(14):
        ys.append(C @ x + 0.05 * rng.standard_normal(2))
        x = A @ x + np.array([0.03, 0.03, 0.0]) * rng.standard_normal(3)
        x[0] = max(x[0], 0.0)
    return np.array(ys)


def states(lower, upper, name="auto", engine="python"):
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x @ C.T, n=3, p=2, states=qpmhe.Box(lower, upper)
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**COVARIANCES),
        qpmhe.QuadraticCost.from_covariances(**COVARIANCES), horizon=8,
        initial_state=[0.3, 0.0, 0.2], backend=name, engine=engine, max_qps=3,
    )
    run = mhe.run(record())
    assert mhe.engine == engine
    assert (run.costs <= run.candidate_costs).all()
    return run.states


@pytest.mark.parametrize("name", [*NAMES, "compiled"])
def test_bounds_that_are_far_away_are_none(name):
    if name == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    engine, used = ("compiled", "auto") if name == "compiled" else ("python", name)
    right = states([0.0, -np.inf, -np.inf], 3 * [np.inf], used, engine)
    # The near bound is active.
    assert np.abs(right - states(3 * [-np.inf], 3 * [np.inf])).max() > 0.01
    if not name.startswith("proxqp"):  # which is off by 0.01 at its tolerance, far bounds or not
        assert np.abs(right - states([0.0, -np.inf, -np.inf], 3 * [np.inf])).max() < CLOSE
    for far in (1e10, 1e12, 1e20, 1e200, 1.7e308):
        found = states([0.0, -far, -far], 3 * [far], used, engine)
        assert np.abs(found - right).max() < CLOSE


@pytest.mark.parametrize("name", NAMES)
def test_equal_bounds_fix_a_state(name):
    lower, upper = [0.0, -np.inf, 0.2], [np.inf, np.inf, 0.2]
    right, found = states(lower, upper, "daqp"), states(lower, upper, name)
    assert np.abs(found - right).max() < CLOSE
    assert np.abs(found[:, 2] - 0.2).max() == 0.0


def test_bounds_whose_squares_are_not_finite_are_none_or_refused():
    box = qpmhe.Box([-1.7e308, -1e151, -1e149], [1e151, 1e20, 1.7e308])
    np.testing.assert_array_equal(box.lower, [-np.inf, -np.inf, -1e149])
    np.testing.assert_array_equal(box.upper, [np.inf, 1e20, np.inf])
    for lower, upper in (([1e200], [np.inf]), ([-np.inf], [-1e200])):
        with pytest.raises(SetError, match="the box is empty"):
            qpmhe.Box(lower, upper)
