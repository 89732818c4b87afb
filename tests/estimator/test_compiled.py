"""The compiled step beside the Python one, on data and models that the table of cases lacks."""

import copy
import functools
import itertools
import math
import pickle

import numpy as np
import pytest
from oracles.systems import SYSTEMS, around, reactor

import qpmhe
from qpmhe import Box, Polytope, Status
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from tests.codegen.cases import Case, case, recorded, spd
from tests.codegen.test_agreement import ARRAYS, agree

casadi = pytest.importorskip("casadi")
pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
ENGINES, STEPS, INF, NAN = ("python", "compiled"), 24, np.inf, np.nan
both_engines = pytest.mark.parametrize("engine", ENGINES)
WAYS = [
    {"max_qps": 0}, {"max_qps": 3, "delay": 1}, {"max_qps": None, "warm_start": True},
    {"max_qps": 1, "candidate": "reinitialized", "warm_start": True},
    {"max_qps": None, "backend": "banded", "tolerance": 1e-3, "candidate": "reinitialized"},
]


def system_of(f, h, **options):
    # The Python side is evaluated by CasADi's virtual machine: nothing in common but the model.
    return qpmhe.from_casadi(f, h, compiled=False, **options)


def case_of(system, observer, start, horizon=4, **options):
    """A case with weights that are not diagonal, and a record of it."""
    cost = qpmhe.QuadraticCost(
        prior=spd(1, system.n), disturbance=10 * spd(2, system.n), noise=spd(3, system.p)
    )
    if not isinstance(observer, qpmhe.Observer):
        observer = qpmhe.Luenberger(observer)
    return Case(
        system, observer, cost, np.array(start, float), recorded(system, start),
        {"horizon": horizon, "max_qps": 2} | options,
    )


def wide():
    """More outputs than states."""
    return case_of(system_of(
        lambda x: [x[0] + 0.1 * x[1], 0.9 * x[1] - 0.3 * casadi.sin(x[0])],
        lambda x: [x[0], casadi.sin(x[0]) + x[1], x[0] * x[1]], n=2,
    ), [[0.1, 0.0, 0.05], [0.0, 0.1, 0.0]], [1.0, 0.5])


def large(n):
    generator = np.random.default_rng(n)
    A = 0.9 * np.eye(n) + 0.1 * generator.standard_normal((n, n)) / math.sqrt(n)
    C = generator.standard_normal((3, n))
    return case_of(system_of(
        lambda x: casadi.mtimes(casadi.DM(A), x) + 0.05 * casadi.sin(x),
        lambda x: casadi.mtimes(casadi.DM(C), x), n=n,
    ), 0.02 * C.T, np.ones(n), 2)


def high_gain(method, sampling):
    system = system_of(
        lambda x: [x[1], -casadi.sin(x[0]) - 0.1 * x[1]], lambda x: x[0], n=2, dt=0.1,
        method=method,
    )
    return case_of(system, qpmhe.HighGain(2, epsilon=0.2, dt=0.1, sampling=sampling), [0.5, 0.0])


MODELS = {
    "wide": wide, "reactor": lambda: case("reactor"),
    "n=1": lambda: case_of(system_of(
        lambda x: 0.9 * x + 0.2 * casadi.sin(x), lambda x: [x[0] + 0.1 * x[0] ** 2, -x[0]], n=1
    ), [[0.2, -0.1]], [0.7], 3),
    # Where the rows of the factorisation's panels change their padding.
    "n=23": lambda: large(23), "n=25": lambda: large(25),
    **{f"N={k}": lambda k=k: case("inputs").with_options(horizon=k) for k in (1, 2, 12)},
    "high gain, euler": lambda: high_gain("euler", "euler"),
    "high gain, rk4": lambda: high_gain("rk4", "exact"),
    # Components that do not depend on the state, and an output that depends on none.
    "no slopes": lambda: case_of(system_of(
        lambda x, u: [u[0], 0.5], lambda x, u: 2.0 * u[0], n=2, m=1
    ), [[0.1], [0.1]], [0.5, 0.5]),
}


@functools.cache
def made(name):
    return MODELS[name]()


def both(one, **options):
    pair = [one.estimator(engine, **options) for engine in ENGINES]
    assert tuple(mhe.engine for mhe in pair) == ENGINES
    return pair


def spoilt(one, generator, share=0.3):
    """The samples with components that are missing in all sorts of ways, weights and steps."""
    samples = []
    for t, sample in enumerate(one.samples):
        y = np.array(sample["y"], float)
        for j in np.flatnonzero(generator.random(y.size) < share):
            y[j] = generator.choice([NAN, INF, -INF, 1e200, -1e160])
        own = {}
        if t % 3 == 1:
            own["noise_weight"] = 10.0 ** generator.uniform(-2, 2) * spd(t, y.size)
        if one.system.dt and t % 7 in (0, 1, 4):
            own["dt"] = one.system.dt * generator.uniform(0.2, 2.0)
        samples.append(sample | {"y": None if t % 11 == 7 else y} | own)
    return samples


def late(one, t, generator):
    """A sample of the window whose measurement comes now: whole, in part, or once more."""
    first = max(0, t + 1 - one.options["horizon"])
    when = first if t % 4 == 0 else int(generator.integers(first, t + 1))
    y = np.array(one.samples[when]["y"]) + 0.1 * generator.standard_normal(one.system.p)
    y[generator.random(y.size) < 0.3] = generator.choice([NAN, INF, 1e170])
    return when, y


def equal(one, other):
    """Equality of two estimates to the last bit."""
    for name in (*ARRAYS, "cost", "candidate_cost"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.status, one.qps, one.solver_iterations, one.dropped, one.time) == (
        other.status, other.qps, other.solver_iterations, other.dropped, other.time
    )


def loaded(mhe, fresh):
    fresh.load_state_dict(pickle.loads(pickle.dumps(mhe.state_dict())))
    return fresh


@pytest.mark.parametrize("name", MODELS)
def test_the_same_estimates_whatever_comes(name):
    """And copies of an estimator, however they are made, go on to the last bit."""
    one = made(name)
    for k, way in enumerate(WAYS):
        generator, (reference, compiled), copies = np.random.default_rng(k), both(one, **way), []
        for t, sample in enumerate(spoilt(one, generator)):
            found = compiled.update(**sample)
            agree(reference.update(**sample), found, 1e-9)
            assert (Status.MISSING in found.status) == np.isnan(found.noises[-1]).any()
            for other in copies:
                equal(other.update(**sample), found)
            for _ in range(int(generator.integers(0, 3))):
                when, y = late(one, t, generator)
                found = compiled.amend(when, y)
                agree(reference.amend(when, y), found, 1e-9)
                for other in copies:
                    equal(other.amend(when, y), found)
            if t == 3 * k + 1:
                fresh = one.estimator("compiled", **way)
                fresh.update(**one.samples[0])
                copies = [
                    loaded(compiled, fresh), pickle.loads(pickle.dumps(compiled)),
                    copy.deepcopy(compiled),
                ]
        expected = reference.covariances()
        for mhe in (compiled, *copies):
            np.testing.assert_allclose(
                mhe.covariances(), expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max()
            )
            assert (mhe.engine, mhe.time) == ("compiled", STEPS)


def test_a_discount_that_underflows_within_the_window():
    """The oldest stages then weigh nothing: no reason for the factorisation to fail."""
    system, estimates = system_of(lambda x: 0.9 * x, lambda x: x + 0.1 * x**3, n=1), []
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=5.0, noise=5.0, discount=0.01)
    for horizon in (20, 190):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.3]), cost, horizon=horizon, initial_state=[0.5],
            max_qps=3, engine="compiled",
        )
        estimates.append([mhe.update(y) for y in 0.3 + 0.1 * np.sin(np.arange(200.0))])
    assert 0.01**190 == 0
    for short, long in zip(*estimates, strict=True):
        assert Status.SOLVER_FAILED not in long.status
        # What is 20 samples old weighs 1e-40.
        np.testing.assert_allclose(long.state, short.state, rtol=1e-9)


def test_an_outage_longer_than_the_window():
    """The observer waits where the model last worked, however long that is ago."""
    system = system_of(lambda x, u: x * u[0], lambda x, u: x, n=1, m=1)
    for engine in ENGINES:
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.5]), qpmhe.QuadraticCost(prior=1, disturbance=1, noise=1),
            horizon=2, initial_state=[0.0], engine=engine,
        )
        for samples in (1, 2, 3, *range(60, 70), 130):
            mhe.reset()
            with pytest.raises(InvalidInputError, match="no estimate yet"):
                mhe.covariances()
            for _ in range(samples):
                mhe.update([5.0], [1.0])
            held = [mhe.update([5.0], [NAN]).state[0] for _ in range(5)]
            assert held == [held[0]] * 5, samples
            with pytest.raises(InvalidInputError, match="finite"):
                mhe.covariances()
            assert mhe.update([5.0], [1.0]).state[0] == pytest.approx(5.0, abs=3.0)


def test_jacobians_that_are_not_finite_at_the_start():
    for fails, f in (
        (True, lambda x: [0.5 * casadi.sqrt(casadi.fabs(x[0])), 0.9 * x[1] + 0.1]),
        (True, lambda x: [0.9 * casadi.sqrt(x[0] ** 2 + x[1] ** 2), 0.9 * x[1]]),
        (False, lambda x: [0.9 * casadi.fabs(x[0]), 0.9 * x[1]]),
    ):
        one = case_of(system_of(f, lambda x: x[0] + x[1], n=2), [[0.1], [0.1]], [0.0, 0.0], 3)
        for max_qps in (0, 1):
            pair, flags = both(one, max_qps=max_qps), []
            for sample in one.samples[:12]:
                expected, found = (mhe.update(**sample) for mhe in pair)
                agree(expected, found, 1e-7)  # what rounding leaves of 0 has a large root
                flags.append(found.status)
            assert (Status.MODEL_FAILED in flags[0]) == (fails and max_qps > 0)
            assert Status.MODEL_FAILED not in flags[-1]


# Sets


def estimator_in(name, kind, engine="compiled", sets=None, **options):
    """A problem of the oracles, and an estimator of it, with tight sets or sets of its own."""
    one = reactor() if name == "reactor" else SYSTEMS[name]()
    functions = one.symbolic()
    if sets is None:
        sets = one.sets["box"][1:]
        sets = [
            each and qpmhe.model.sets.ConvexSet(
                0.5 * each.lower, 0.5 * each.upper, each.matrix, each.row_lower, each.row_upper
            ) for each in sets
        ] if kind == "tight" else one.sets[kind][1:]
    labelled = dict(zip(("disturbances", "noises"), sets, strict=True))
    system = system_of(functions["f"], functions["h"], n=one.n, **labelled)
    return one, qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(options.pop("gain", one.gain)), one.cost, horizon=one.horizon,
        initial_state=one.start, engine=engine, **options,
    )


def test_bounds_that_are_all_but_infinite():
    costs = []
    for far in (INF, 1e20, 1e300):
        one, mhe = estimator_in("reactor", "open", max_qps=2, sets=(
            Box([-far, -0.05], [0.05, far]) & around([0, 0], 0.1, 0.1),
            Box(-1.2, far) & Polytope([[1.0]], [0.3]),
        ))
        run = mhe.run(one.record(0, 30))
        assert run.share(Status.IMPROVED) > 0.5
        costs.append(run.costs)
    for found in costs[1:]:
        np.testing.assert_allclose(found, costs[0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("flat", [
    *(Polytope([[1, 1], [-1, -1]], [width, width]) for width in (1e-3, 1e-6, 1e-8, 1e-12, 0.0)),
    Polytope([[1, -1], [-3, 3]], [0.01, -0.03]), Polytope([[1, 0], [0, 1], [-1, -1]], [0.0] * 3),
    Box([0, 0], [1, 1]) & Polytope([[1, 2]], [0.0]),
])
def test_sets_of_almost_no_width(flat):
    """However narrow, nothing worse than the candidate; rows may make equations together."""
    costs = []
    for engine in ENGINES:
        one, mhe = estimator_in(
            "reactor", "narrow", engine, max_qps=None, solver_tolerance=1e-9, sets=(flat, None),
            gain=[[0.05], [-0.05]],
        )
        estimates = [mhe.update(y) for y in one.record(0, 12)]
        for estimate in estimates:
            assert estimate.cost <= estimate.candidate_cost
            if estimate.improved and not estimate.dropped:
                assert flat.violation(estimate.disturbances) <= 1e-8
        costs.append([estimate.cost for estimate in estimates])
    assert sum(estimate.improved for estimate in estimates) > 6
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-6)


@pytest.mark.parametrize("backend", ["auto", "banded"])  # the latter knows no inequalities
def test_rows_dropped_for_long_are_worth_a_warning(backend):
    dropped = []
    for engine, whole in itertools.product(ENGINES, (False, True)):
        one, mhe = estimator_in("pendulum", "tight", engine, backend=backend, max_qps=3)
        take = mhe.run if whole else lambda ys, mhe=mhe: dropped.append(
            [mhe.update(y).dropped for y in ys]
        )
        with pytest.warns(qpmhe.ObserverWarning, match="inequalities were dropped in") as caught:
            take(one.record(1, 30))
        assert len(caught) == 1
        assert caught[0].filename == __file__ or (engine, whole) == ("python", True)
    assert dropped[0] == dropped[1]
    assert len(set(dropped[0])) > 5
