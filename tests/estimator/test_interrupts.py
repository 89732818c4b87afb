"""A step that is interrupted was not taken, wherever the interrupt comes."""

import contextlib

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

from .same import Interruption, assert_same, interrupted
from .test_own_memory import (
    BATCHES,
    BOX,
    NARROW,
    assert_all_same,
    batch_of,
    estimator,
    feed,
    samples,
)
from .untraced import untraced

CASES = {
    "plain": ("numpy", {}),
    "reinitialized in a set": ("numpy", {"candidate": "reinitialized", "sets": BOX}),
    "kalman": ("numpy", {"kalman": True, "candidate": "reinitialized"}),
    "robust": ("numpy", {"robust": True, "max_qps": 2}),
    "dropped": ("numpy", {"sets": NARROW, "max_qps": 2}),
    "smoothed": ("numpy", {"arrival": "smoothed", "discount": 0.8, "warm_start": True}),
    "held": ("numpy", {"held": {1: 0.5}, "max_qps": 2}),
    "compiled": ("compiled", {"candidate": "reinitialized"}),
}


@pytest.fixture
def stride(pytestconfig):
    """Lines from one interrupt to the next, at most."""
    return 60 if pytestconfig.option.all else 200


@pytest.mark.parametrize("name", CASES)
def test_an_interrupted_step_was_not_taken(name, stride):
    engine, options = CASES[name]
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    mhe, twin = estimator(engine, **options), estimator(engine, **options)
    generator = np.random.default_rng(1)

    for one in (mhe, twin):  # a step of another length decides how the model is called
        feed(one, samples(4)[3], False)
        one.reset()

    def both(do):
        twin.state_dict()  # in which solvers forget, as they do after an interrupt
        expected, found = do(twin), interrupted(mhe, do, generator, stride)
        if expected is None:
            assert found is None
        else:
            assert_same(found, expected)
        np.testing.assert_array_equal(mhe.state, twin.state)
        np.testing.assert_array_equal(mhe.initial_state, twin.initial_state)

    for t, arguments in enumerate(samples(44)):
        if t in (0, 1, 3, 6, 10, 17, 36, 37):  # the first move of stages to the front is at 36
            both(lambda one, a=arguments: feed(one, a, False))
        else:
            for one in (mhe, twin):
                one.state_dict()
            assert_same(feed(mhe, arguments, False), feed(twin, arguments, False))
        if t in (2, 9, 20):
            both(lambda one, t=t: one.amend(t - 1, [0.3]))
            np.testing.assert_array_equal(mhe.covariances(), twin.covariances())
        if t == 22:
            both(lambda one: one.set(noise_weight=[[2.0]]))
        if t == 24:
            state = estimator(engine, **options).state_dict()
            both(lambda one, state=state: one.load_state_dict(state))
        if t == 26:
            both(lambda one: one.reset())
        if t == 28:
            both(lambda one: one.reset([0.2, 0.1]))


@pytest.mark.parametrize("where", ["f", "h", "observer", "solver"])
def test_an_interrupt_out_of_what_the_user_wrote(where, monkeypatch):
    fuse = [0]  # calls to the next interrupt

    def ticking(name, function):
        def call(*arguments):
            fuse[0] -= name == where
            if name == where and fuse[0] == 0:
                raise KeyboardInterrupt
            return function(*arguments)

        return call

    def made():
        system = qpmhe.System(
            untraced(ticking("f", lambda x: 0.9 * x)),
            untraced(ticking("h", lambda x: x[..., :1] ** 2)), n=2, p=1,
        )
        correction = ticking("observer", lambda z, v: np.array([0.1, 0.2]) * v[0])
        cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1))
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.OutputInjection(correction), cost, horizon=3, initial_state=[0.5, 0.4],
            candidate="reinitialized", warm_start=True, max_qps=2,
        )
        solver = mhe._engine._solver
        monkeypatch.setattr(solver, "solve", ticking("solver", solver.solve))
        return mhe

    mhe, twin, hit = made(), made(), 0
    for y in np.random.default_rng(2).uniform(0.0, 1.0, (12, 1)):
        for k in range(1, 30):
            fuse[0] = k
            try:
                mhe.update(y)
            except KeyboardInterrupt:
                hit += 1
            else:
                break
        fuse[0] = 0
        twin.update(y)
        np.testing.assert_array_equal(mhe.state, twin.state)
        np.testing.assert_array_equal(mhe.covariances(), twin.covariances())
        assert mhe.time == twin.time
    assert hit > 11


@pytest.mark.parametrize("name", BATCHES)
def test_an_interrupted_step_of_a_batch_was_not_taken(name, stride):
    mhe, twin, generator = batch_of(name), batch_of(name), np.random.default_rng(0)

    def both(do):
        after, before = 1, mhe.time
        while True:
            with Interruption(after) as interruption, contextlib.suppress(KeyboardInterrupt):
                do(mhe)
            if interruption.count < after:
                break
            if mhe.time != before:  # C is not interrupted: it has taken the sample, whole
                assert name == "compiled"
                break
            np.testing.assert_array_equal(mhe.states, twin.states)
            np.testing.assert_array_equal(mhe.initial_states, twin.initial_states)
            after += int(generator.integers(1, stride))
        do(twin)
        np.testing.assert_array_equal(mhe.states, twin.states)

    for t in range(13):
        Y, U = generator.normal(0.0, 0.5, (3, 1)), generator.normal(0.0, 1.0, (3, 1))
        Y[generator.random((3, 1)) < 0.2] = np.nan
        if t % 3 == 0:
            both(lambda one, Y=Y, U=U: one.update(Y, U))
        if t == 11:
            both(lambda one: one.reset([0.1, 0.2]))
        found, expected = mhe.update(Y, U), twin.update(Y, U)
        assert_all_same(found, expected)
