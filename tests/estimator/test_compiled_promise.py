"""What the compiled engine promises of every estimate, whatever the data, and in every thread."""

import threading

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from tests.codegen.test_agreement import ARRAYS

from .test_compiled import both, estimator, input_at, made, system_of
from .test_compiled_sets import missed_rows

casadi = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]

Status, INF = qpmhe.Status, np.inf


def test_two_estimators_in_two_threads():
    model, count = made("chain"), 2000
    Y = np.resize(model.Y, (count, model.system.p))
    expected = [estimator(model).run(Y).states, estimator(model, max_qps=0).run(Y).states]
    found = [None, None]

    def follow(k):
        mhe = estimator(model, max_qps=2 * (1 - k))
        run = mhe.run(Y[:1000]).states
        rest = [mhe.update(y).state for y in Y[1000:]]
        found[k] = np.vstack((run, rest))

    threads = [threading.Thread(target=follow, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["reactor rk4", "wide", "inputs"])
def test_kept_estimates_do_not_change(name):
    model = made(name)
    mhe = estimator(model, delay=1)
    kept = []
    for t in range(12):
        estimate = mhe.update(model.Y[t], *input_at(model, t))
        copies = {a: np.copy(getattr(estimate, a)) for a in ARRAYS}
        kept.append((estimate, copies, estimate.cost, estimate.status))
    mhe.amend(mhe.time - 1, model.Y[0])
    mhe.reset()
    for estimate, copies, cost, status in kept:
        for a, values in copies.items():
            np.testing.assert_array_equal(getattr(estimate, a), values, err_msg=a)
        assert (estimate.cost, estimate.status) == (cost, status)


def test_what_an_estimate_tells_of_itself():
    model = made("reactor euler")
    one, other = (mhe.update(model.Y[0]) for mhe in both(model))
    assert repr(other).startswith("Estimate(time=0, state=[")
    assert (other.improved, other.message) == (one.improved, one.message) == (True, "")
    assert (other.solver_iterations, other.status.explain()) == (0, one.status.explain())
    assert other.step_time > 0.0


def any_system():
    """A system whose coefficients are inputs, with sets that may be open on all sides."""
    def f(x, u):
        return [u[0] * x[0] + u[1] * casadi.sin(x[1]) + u[2] * x[0] ** 2,
                u[3] * x[1] + u[1] * x[0] + 0.1 * casadi.sqrt(x[0] + u[4])]

    def h(x, u):
        return [x[0] + u[2] * x[1] ** 2, casadi.log(x[1] + u[4])]

    return {"f": f, "h": h, "n": 2, "m": 5}


sides = st.one_of(st.just(INF), st.floats(0.05, 3.0))
numbers = st.one_of(
    st.floats(-3.0, 3.0), st.sampled_from([np.nan, INF, 0.0, 1e12, -1e149, 1e200])
)


def box(draw, rows):
    low, high = (np.array([draw(sides), draw(sides)]) for _ in range(2))
    return qpmhe.Box(-low, high) & qpmhe.model.sets.ConvexSet(
        np.full(2, -INF), np.full(2, INF), np.array([rows]),
        np.array([-draw(sides)]), np.array([draw(sides)]),
    )


@settings(
    max_examples=40, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(st.data())
def test_whatever_the_system_and_the_options(data):
    draw = data.draw
    sets = {
        name: box(draw, rows) for name, rows in (
            ("disturbances", [1.0, 2.0]), ("noises", [0.5, 1.0])
        )
    }
    system = system_of(**any_system(), **sets)
    scale = st.floats(-4.0, 4.0)
    weights = {
        name: 10.0 ** draw(scale) * np.array([[1.0, 0.3], [0.3, 0.5]])
        for name in ("prior", "disturbance", "noise")
    }
    mhe = qpmhe.MovingHorizonEstimator(
        system,
        qpmhe.Luenberger(np.reshape([draw(st.floats(-0.5, 0.5)) for _ in range(4)], (2, 2))),
        qpmhe.QuadraticCost(**weights, discount=draw(st.sampled_from([1.0, 0.9, 0.1]))),
        horizon=3, initial_state=[0.01, 0.02], engine="compiled",
        max_qps=draw(st.sampled_from([0, 1, 2, None])),
        max_solver_iterations=draw(st.sampled_from([None, 1, 3])),
        backend=draw(st.sampled_from(["auto", "auto", "banded"])),
        infeasible=draw(st.sampled_from(["drop_rows", "keep_candidate"])),
        warm_start=draw(st.booleans()),
        candidate=draw(st.sampled_from(["observer", "reinitialized"])), delay=1,
    )
    usual = [draw(st.floats(-1.1, 1.1)) for _ in range(4)] + [2.0]
    for t in range(8):
        u = usual if draw(st.integers(0, 9)) else [draw(numbers) for _ in range(5)]
        y = [draw(numbers), draw(numbers)]
        estimate = mhe.update(y, u)
        if t % 3 == 2:
            consistent(estimate, sets, weights, mhe.settings)
            estimate = mhe.amend(t - draw(st.integers(0, 2)), [draw(numbers), draw(numbers)])
        consistent(estimate, sets, weights, mhe.settings)


def consistent(estimate, sets, weights, options):
    """What holds for every estimate."""
    status = estimate.status
    assert estimate.cost <= estimate.candidate_cost
    assert (Status.IMPROVED in status) != (Status.CANDIDATE in status)
    assert np.isfinite(estimate.trajectory).all()
    assert np.isfinite(estimate.candidate).all()
    if Status.CANDIDATE in status:
        np.testing.assert_array_equal(estimate.trajectory, estimate.candidate)
        assert estimate.cost == estimate.candidate_cost
    else:
        # The model itself is in the engine: x, and w and v as it tells them. Of a row with an
        # output that is missing nothing is known: NaN misses nothing.
        first, size = estimate.time + 1 - len(estimate.noises), np.abs(estimate.trajectory).max()
        assert missed_rows(
            [sets["disturbances"], sets["noises"]], [weights["disturbance"], weights["noise"]],
            (estimate.disturbances, estimate.noises), first, 1e-8, 1e-14 * size,
        ) <= set(estimate.dropped)
    assert (Status.ROWS_DROPPED in status) == bool(estimate.dropped)
    assert (Status.NO_QPS in status) == (options.max_qps == 0)
    assert not (Status.FAILED_STAGE in status and np.isfinite(estimate.candidate_cost))
    # One more where rows had to be dropped.
    assert 0 <= estimate.qps <= options.qp_limit + (Status.CANDIDATE_OUTSIDE in status)
    assert len(status.explain()) > 0
