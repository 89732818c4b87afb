"""How much work a step does, counted and not timed."""

import sys
import tracemalloc

import numpy as np
import pytest

import qpmhe
from qpmhe.models.batch_reactor import casadi_output, casadi_rate

from .untraced import untraced


class Counted:
    """The reactor's functions, with counts of calls on one state and on many."""

    def __init__(self):
        reactor = qpmhe.models.batch_reactor()
        self.single, self.many = {}, {}
        self.system = qpmhe.System(
            untraced(self.counting("f", reactor.system.f)),
            untraced(self.counting("h", reactor.system.h)),
            n=2, p=1,
            f_jacobian=self.counting("A", reactor.system.f_jacobian),
            h_jacobian=self.counting("C", reactor.system.h_jacobian),
        )
        self.observer, self.cost = reactor.observer, reactor.cost
        self.measurements = reactor.scenario.simulate(0, 60).measurements

    def counting(self, name, function):
        def counted(x):
            nothing = np.empty((*x.shape[:-1], 0))
            counts = self.single if x.ndim == 1 else self.many
            counts[name] = counts.get(name, 0) + 1
            return function.batch(x, nothing) if x.ndim > 1 else function(x, nothing)

        return counted

    def estimator(self, **options):
        return qpmhe.MovingHorizonEstimator(
            self.system, self.observer, self.cost, horizon=10, initial_state=[3.0, 0.0], **options
        )


@pytest.mark.parametrize(("max_qps", "trials"), [(0, 0), (1, 1), (2, 2)])
def test_the_model_is_evaluated_once_at_each_new_observer_state(max_qps, trials):
    counted = Counted()
    mhe = counted.estimator(max_qps=max_qps, backend="banded")
    for y in counted.measurements[:40]:
        mhe.update(y)
    counted.single.clear()
    counted.many.clear()
    steps = 20
    for y in counted.measurements[40:]:
        mhe.update(y)
    # One state a sample: the rest of the window is remembered.
    assert counted.single["f"] == counted.single["h"] == steps
    assert counted.single.get("A", 0) == counted.single.get("C", 0) == (steps if max_qps else 0)
    # One batch a trial, and now and then one to make sure that batches may be trusted.
    for name in ("f", "h"):
        assert trials * steps <= counted.many.get(name, 0) <= trials * steps + 2
    # The first QP needs no Jacobians but those of the newest stage.
    assert counted.many.get("A", 0) == max(0, max_qps - 1) * steps


@pytest.mark.parametrize("options", [{}, {"max_qps": 2, "warm_start": True}], ids=["one", "two"])
def test_memory_does_not_grow(options):
    reactor = qpmhe.models.batch_reactor()
    measurements = reactor.scenario.simulate(0, 500).measurements
    mhe = qpmhe.MovingHorizonEstimator(
        *reactor[:3], horizon=10, initial_state=[3.0, 0.0], **options
    )

    def steps(count):
        for _ in range(count):
            for y in measurements:
                mhe.update(y)

    steps(2)
    tracemalloc.start()
    steps(1)
    before = tracemalloc.get_traced_memory()[0]
    steps(4)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 8_000  # bytes, over 2,000 steps


def calls_in_a_step(mhe, measurements):
    """The median of Python and C function calls in one update."""
    counts = []
    for y in measurements:
        calls = [0]

        def count(frame, event, argument, calls=calls):
            calls[0] += event in ("call", "c_call")

        sys.setprofile(count)
        mhe.update(y)
        sys.setprofile(None)
        counts.append(calls[0])
    return int(np.median(counts[20:]))


# What the steps take now, and a tenth of slack: a guard against creeping growth that no
# clock has to see.
@pytest.mark.parametrize(
    ("options", "most"),
    [({"max_qps": 0}, 96), ({"max_qps": 1}, 132), ({"max_qps": 2}, 222)],
    ids=["no QP", "one QP", "two QPs"],
)
def test_a_step_takes_no_more_calls_than_it_did(options, most):
    reactor = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        *reactor[:3], horizon=10, initial_state=[3.0, 0.0], backend="banded", **options
    )
    assert calls_in_a_step(mhe, reactor.scenario.simulate(0, 60).measurements) <= most


def test_a_casadi_model_is_called_twice_in_a_step():
    reactor = qpmhe.models.batch_reactor()
    system = qpmhe.from_casadi(casadi_rate, casadi_output, dt=0.1, method="euler", n=2)
    kernel, counts = system.kernel, {"stage": 0, "residuals": 0}

    class Counting:
        prepare = kernel.prepare

        def stage(self, *arguments):
            counts["stage"] += 1
            return kernel.stage(*arguments)

        def residuals(self, *arguments):
            counts["residuals"] += 1
            return kernel.residuals(*arguments)

    system.kernel = Counting()
    mhe = qpmhe.MovingHorizonEstimator(
        system, reactor.observer, reactor.cost, horizon=10, initial_state=[3.0, 0.0],
        backend="banded",
    )
    for y in reactor.scenario.simulate(0, 30).measurements:
        mhe.update(y)
    assert counts == {"stage": 30, "residuals": 30}


def test_a_compiled_step_is_one_call_into_c():
    reactor = qpmhe.models.batch_reactor()
    system = qpmhe.from_casadi(casadi_rate, casadi_output, dt=0.1, method="euler", n=2)
    mhe = qpmhe.MovingHorizonEstimator(
        system, reactor.observer, reactor.cost, horizon=10, initial_state=[3.0, 0.0],
        engine="compiled",
    )
    if mhe.engine != "compiled":
        pytest.skip("no C compiler")
    assert calls_in_a_step(mhe, reactor.scenario.simulate(0, 60).measurements) <= 12


def test_memory_is_in_proportion_to_the_horizon():
    reactor = qpmhe.models.batch_reactor()
    measurements = reactor.scenario.simulate(0, 60).measurements
    taken = []
    for horizon in (50, 100, 400):  # the first only for what is imported late
        tracemalloc.start()
        mhe = qpmhe.MovingHorizonEstimator(
            *reactor[:3], horizon=horizon, initial_state=[3.0, 0.0], backend="banded"
        )
        for k in range(horizon + 20):
            mhe.update(measurements[k % 60])
        taken.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert taken[2] < 6 * taken[1]
