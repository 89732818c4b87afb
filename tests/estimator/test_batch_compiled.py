"""Batches in compiled code against single estimators."""

import copy
import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.models.batch_reactor import casadi_output, casadi_rate

from .untraced import untraced

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

MEMBERS, STEPS = 40, 30
BOX = qpmhe.Box([-0.1, -0.1], [0.1, 0.1])


def reactor(**sets):
    model = qpmhe.models.batch_reactor()
    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, dt=0.1, method="euler", n=2, **sets
    )
    return system, model.observer, model.cost


def records(seed=0):
    scenario = qpmhe.models.batch_reactor().scenario
    y = np.array([scenario.simulate(seed + k, STEPS).measurements for k in range(MEMBERS)])
    y[3, 5:9] = np.nan  # samples of one member
    y[7, 12] = np.inf
    return y


def starts():
    return np.array([3.0, 0.1]) + 0.1 * np.arange(MEMBERS)[:, None] / MEMBERS


@pytest.mark.parametrize("threads", [1, 2, None])
@pytest.mark.parametrize(
    ("sets", "options"),
    [
        ({}, {}), ({}, {"max_qps": 0}), ({}, {"max_qps": None, "warm_start": True, "delay": 3}),
        ({"disturbances": BOX}, {"max_qps": 2}),
    ],
    ids=["one", "none", "converged", "sets"],
)
def test_each_member_is_a_single_estimator(sets, options, threads):
    parts, y, x0 = reactor(**sets), records(), starts()
    shared = {"horizon": 8, "engine": "compiled", **options}
    batch = qpmhe.BatchEstimator(
        *parts, members=MEMBERS, initial_states=x0, threads=threads, **shared
    )
    assert batch.mode == "compiled"
    estimates = [batch.update(y[:, t]) for t in range(10)]
    run = batch.run(y[:, 10:])
    assert batch.time == STEPS
    for k in range(MEMBERS):
        mhe = qpmhe.MovingHorizonEstimator(*parts, initial_state=x0[k], **shared)
        for t in range(STEPS):
            one = mhe.update(y[k, t])
            if t < 10:
                found = estimates[t]
                np.testing.assert_array_equal(found.trajectories[k], one.trajectory)
                np.testing.assert_array_equal(found.candidates[k], one.candidate)
                np.testing.assert_array_equal(found.states[k], one.state)
                assert found.costs[k] == one.cost
                assert found.candidate_costs[k] == one.candidate_cost
                assert found.statuses[k] == one.status
                assert found.qps[k] == one.qps
            else:
                np.testing.assert_array_equal(run.states[k, t - 9], one.state)
                np.testing.assert_array_equal(run.filtered[k, t - 10], one.filtered)
                assert run.costs[k, t - 10] == one.cost
                assert run.statuses[k, t - 10] == one.status.value
                if one.delayed is not None:
                    np.testing.assert_array_equal(run.delayed[k, t - 10], one.delayed)
        np.testing.assert_array_equal(batch.states[k], mhe.state)


def test_inputs_of_each_member_and_shared_ones():
    def f(x, u):
        return [0.9 * x[0] + u[0], 0.8 * x[1] + 0.1 * x[0] * u[1]]

    system = qpmhe.from_casadi(f, lambda x: x[0] + x[1], n=2, m=2)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[4.0]])
    generator = np.random.default_rng(2)
    y, u = generator.normal(size=(20, 12, 1)), generator.normal(size=(20, 12, 2))
    shared = {"horizon": 5, "engine": "compiled"}

    def batch():
        return qpmhe.BatchEstimator(
            system, qpmhe.Luenberger([0.3, 0.2]), cost, members=20, initial_states=[0.0, 0.0],
            **shared,
        )

    own, common = batch().run(y, u), batch().run(y, u[0])
    for k in range(20):
        for run, inputs in ((own, u[k]), (common, u[0])):
            mhe = qpmhe.MovingHorizonEstimator(
                system, qpmhe.Luenberger([0.3, 0.2]), cost, initial_state=[0.0, 0.0], **shared
            )
            np.testing.assert_array_equal(run.states[k], mhe.run(y[k], inputs).states)


def test_kept_estimates_do_not_change_and_a_reset_starts_again():
    y = records()
    batch = qpmhe.BatchEstimator(
        *reactor(), members=MEMBERS, horizon=8, initial_states=starts(), engine="compiled"
    )
    first = batch.update(y[:, 0])
    kept = first.trajectories.copy()
    batch.run(y[:, 1:])
    np.testing.assert_array_equal(first.trajectories, kept)
    batch.reset()
    assert batch.time == 0
    np.testing.assert_array_equal(batch.states, starts())
    np.testing.assert_array_equal(batch.update(y[:, 0]).trajectories, kept)


def test_without_a_compiler_it_is_a_loop_and_says_so(monkeypatch):
    parts = reactor()
    monkeypatch.setenv("CC", "/nowhere/cc")
    with pytest.warns(qpmhe.errors.EngineWarning, match="no C compiler"):
        batch = qpmhe.BatchEstimator(
            *parts, members=3, horizon=4, initial_states=[3.0, 0.1], engine="compiled"
        )
    assert batch.mode == "looped"


def test_without_a_compiler_a_looped_batch_says_so_once(monkeypatch):
    parts = reactor(disturbances=BOX)
    monkeypatch.setenv("CC", "/nowhere/cc")
    with pytest.warns(qpmhe.errors.EngineWarning) as caught:
        batch = qpmhe.BatchEstimator(
            *parts, members=5, horizon=4, initial_states=[3.0, 0.1], engine="compiled"
        )
    assert len(caught) == 1
    batch.update(np.full((5, 1), 3.0))
    assert batch.mode == "looped"


def test_bad_input():
    with pytest.raises(qpmhe.errors.OptionError, match="threads"):
        qpmhe.BatchEstimator(
            *reactor(), members=3, horizon=4, initial_states=[3.0, 0.1], engine="compiled",
            threads=0,
        )
    _, *parts = qpmhe.models.batch_reactor()[:3]
    plain = qpmhe.System(untraced(lambda x: x), lambda x: x[..., :1], n=2, p=1)
    with pytest.raises(qpmhe.errors.OptionError, match="from_casadi"):
        qpmhe.BatchEstimator(
            plain, *parts, members=3, horizon=4, initial_states=[3.0, 0.1], engine="compiled"
        )


@pytest.mark.parametrize("copied", [lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy],
                         ids=["pickle", "deepcopy"])
@pytest.mark.parametrize(
    ("mode", "engine", "sets", "compiled"),
    [("compiled", "compiled", {"disturbances": BOX}, None), ("looped", "python", {}, None),
     ("looped", "python", {}, False), ("looped", "python", {"disturbances": BOX}, None)],
)
def test_copies_go_on_where_they_were_made(mode, engine, sets, compiled, copied):
    model = qpmhe.models.batch_reactor()
    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, dt=0.1, method="euler", n=2, compiled=compiled, **sets
    )
    members, cut = 20, 14
    batch = qpmhe.BatchEstimator(
        system, model.observer, model.cost, members=members, horizon=8, engine=engine,
        initial_states=starts()[:members], max_qps=2, warm_start=True,
    )
    y = records()[:members]
    batch.run(y[:, :cut])
    other = copied(batch)
    assert (other.mode, other.time, other.members) == (mode, cut, members)
    np.testing.assert_array_equal(other.states, batch.states)
    one, two = batch.run(y[:, cut:]), other.run(y[:, cut:])
    np.testing.assert_allclose(two.states, one.states, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(two.costs, one.costs, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(two.statuses, one.statuses)
    other.reset()
    again = qpmhe.BatchEstimator(
        system, model.observer, model.cost, members=members, horizon=8, engine=engine,
        initial_states=starts()[:members], max_qps=2, warm_start=True,
    )
    np.testing.assert_array_equal(other.update(y[:, 0]).states, again.update(y[:, 0]).states)


def test_more_memory_than_there_is(monkeypatch):
    def refuse(*_):
        raise MemoryError("Unable to allocate 1.49 TiB")

    system, observer, cost = reactor()
    monkeypatch.setattr("qpmhe.batch._Looped", refuse)
    with pytest.raises(
        qpmhe.errors.OptionError, match=r"1000 members with a horizon of 9 .*1.49 TiB.*fewer"
    ):
        qpmhe.BatchEstimator(
            system, observer, cost, members=1000, horizon=9, initial_states=[3.0, 0.1]
        )
