"""The C step where Python is no oracle: Kalman, time budgets, LAPACK, damaged snapshots."""

import ctypes

import casadi as ca
import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.codegen import write
from qpmhe.codegen.compiler import find_compiler, optimisation
from qpmhe.errors import InvalidInputError
from qpmhe.memory.snapshot import read, written
from tests.oracles.test_kalman import Plant, distance, kalman

from .cases import case

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]


class Clock:
    """A clock in place of the C step's, which goes on by one at each look."""

    def __init__(self, mhe):
        self.looks = 0
        self._function = ctypes.CFUNCTYPE(ctypes.c_double)(self._look)
        record = mhe._engine._tools.record
        record["clock"] = ctypes.cast(self._function, ctypes.c_void_p).value

    def _look(self):
        self.looks += 1
        return float(self.looks)


@pytest.mark.parametrize("name", ["inputs converged", "huber everywhere"])
def test_no_qp_is_begun_when_the_time_is_up(name):
    """Without inequalities, the clock is looked at once before each QP."""
    one = case(name).with_options(max_qps=None, tolerance=1e-15)
    free = one.estimator("compiled")
    for sample in one.samples[:6]:
        free.update(**sample)
    for budget in (0.5, 1.5, 2.5):
        mhe = one.estimator("compiled", time_budget=budget)
        mhe.load_state_dict(free.state_dict())
        clock, reference = Clock(mhe), one.estimator("compiled", max_qps=int(budget))
        reference.load_state_dict(free.state_dict())
        estimate, expected = (each.update(**one.samples[6]) for each in (mhe, reference))
        assert estimate.qps == int(budget)
        assert Status.TIME_UP in estimate.status
        assert clock.looks == 2 + estimate.qps  # at the start, before each QP and one more
        if budget > 1.0:  # without any QP there is no warm start either
            np.testing.assert_array_equal(estimate.trajectory, expected.trajectory)


def test_the_ladder_keeps_its_promise_whenever_the_time_is_up():
    one = case("tank conditions")
    for budget in (0.5, 1.5, 2.5, 4.5, 8.5, 30.5):
        up, mhe = 0, one.estimator("compiled", time_budget=budget)
        for sample in one.samples:
            clock = Clock(mhe)
            estimate = mhe.update(**sample)
            assert estimate.cost <= estimate.candidate_cost
            assert (Status.IMPROVED in estimate.status) != (Status.CANDIDATE in estimate.status)
            up += Status.TIME_UP in estimate.status
            assert clock.looks < 1000
        assert up > 0 or budget > 30.0


def test_a_budget_that_is_spent_at_once_leaves_the_candidate():
    one = case("inputs")
    mhe = one.estimator("compiled", time_budget=1e-12)
    for sample in one.samples:
        estimate = mhe.update(**sample)
        assert (estimate.status, estimate.qps) == (Status.CANDIDATE | Status.TIME_UP, 0)
        np.testing.assert_array_equal(estimate.trajectory, estimate.candidate)
    Y, U = (np.array([sample[key] for sample in one.samples]) for key in ("y", "u"))
    assert (mhe.run(Y, U).flags == estimate.status.value).all()


def test_a_hessian_that_is_not_finite_keeps_the_candidate(tmp_path):
    """LAPACK, which only the engine uses, gets infinities: it fails, and the step goes on."""
    n = 102
    system = qpmhe.from_casadi(
        lambda x: 0.5 * x + 1e-3 * ca.sin(1e150 * x), lambda x: x[:3], n=n, compiled=False
    )
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=1e20 * np.eye(n), noise=np.eye(3))
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.1 * np.eye(n, 3)), cost, horizon=4, initial_state=np.ones(n),
        engine="compiled",
    )
    assert mhe._engine._library.layout.lapack
    header, _ = write(mhe, tmp_path)
    assert "#define MHE_LAPACK 0" in header.read_text()
    for y in np.random.default_rng(1).normal(size=(7, 3)):
        found = mhe.update(y)
        assert found.status == Status.CANDIDATE | Status.SOLVER_FAILED
        assert found.cost == found.candidate_cost
        assert np.isfinite(found.trajectory).all()


def test_where_the_discount_underflows_a_failed_stage_costs_infinity():
    """Zero times infinity: the cost of such a window is infinite, not NaN."""
    system = qpmhe.from_casadi(lambda x: 0.9 * x, ca.sqrt, n=1, compiled=False)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=5.0, noise=5.0, discount=0.01)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost, horizon=190, initial_state=[0.5], max_qps=1,
        engine="compiled",
    )
    found = [mhe.update([-40.0 if t == 5 else 0.3 + 0.01 * np.sin(t)]) for t in range(220)]
    assert 0.01**185 == 0
    assert sum(Status.FAILED_STAGE in one.status for one in found) == 189
    for one in found:
        assert one.cost <= one.candidate_cost
        if Status.MODEL_FAILED not in one.status:
            assert np.isinf(one.candidate_cost) == (Status.FAILED_STAGE in one.status)


@pytest.mark.parametrize(("engine", "sets"), [("python", ""), ("python", "W"), ("compiled", "WV")])
def test_where_the_discount_underflows_the_estimate_is_that_of_a_short_window(engine, sets):
    """A sample of age 10 has a weight of 1e-20, one of age 163 none that a double can have."""
    A = np.array([[0.9, 0.2], [-0.1, 0.8]])
    options = {
        "W": {"disturbances": qpmhe.Box([-np.inf, 0.0], [np.inf, 0.0])},
        "V": {"noises": qpmhe.Box([-0.3], [0.3])},
    }
    system = qpmhe.System(
        lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1,
        **{key: value for one in sets for key, value in options[one].items()},
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.04]], discount=0.01
    )

    def last(horizon):
        made = [
            qpmhe.MovingHorizonEstimator(
                system, qpmhe.Luenberger([[0.3], [0.0]]), cost, horizon=horizon, max_qps=count,
                initial_state=[1.0, 0.5], engine=engine,
            )
            for count in (0, 2)
        ]
        for y in Y[:-1]:
            made[0].update(y)
        made[1].load_state_dict(made[0].state_dict())
        return made[1].update(Y[-1])

    Y = np.random.default_rng(0).normal(0.0, 0.3, (181, 1))
    short, found = last(10), last(170)
    assert 0.01**163 == 0
    assert Status.CONVERGED in found.status
    assert Status.SOLVER_STOPPED not in found.status
    assert found.cost == pytest.approx(short.cost, rel=1e-9)
    np.testing.assert_allclose(found.filtered, short.filtered, rtol=1e-9)


@pytest.mark.parametrize(("name", "where", "part"), [
    ("tank conditions", "compiled", "noise_weight"), ("tank conditions", "usual", "parameters"),
    ("extended prior", "window", "covariance"),
    ("extended prior", "window", "last_good_covariance"),
])
def test_damaged_snapshots_of_conditions_and_covariances_are_refused(name, where, part):
    one = case(name)
    mhe = one.estimator("compiled")
    for t, sample in enumerate(one.samples[:12]):
        mhe.update(**sample)
        if t in one.changes:
            mhe.set(**one.changes[t])
    one.estimator("compiled").load_state_dict(mhe.state_dict())
    state = read(mhe.state_dict())
    state[where][part][...] = np.nan
    before = mhe._engine._memory.tobytes(), mhe._engine.usual
    with pytest.raises(InvalidInputError, match=r"the state is|observer|finite"):
        mhe.load_state_dict(written(state))
    assert before == (mhe._engine._memory.tobytes(), mhe._engine.usual)


@pytest.mark.parametrize("make", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
@pytest.mark.parametrize(("n", "p", "horizon", "radius", "missing"), [
    (1, 2, 1, 1.15, True), (2, 2, 2, 0.8, False), (3, 1, 5, 1.15, True), (2, 2, 20, 0.8, True),
])
def test_every_horizon_gives_the_kalman_predictor_and_filter(make, n, p, horizon, radius, missing):
    plant = Plant(100 * n + p, n, p, radius, m=n % 3, missing=missing)
    predicted, filtered, _ = kalman(plant)
    mhe = plant.estimator(horizon, observer=make, engine="compiled")
    assert mhe.engine == "compiled"
    run = mhe.run(plant.Y, plant.inputs())
    assert distance(run.states, np.array([x for x, _ in predicted])) < 1e-9
    assert distance(run.filtered, np.array([x for x, _ in filtered])) < 1e-9
    P = predicted[-1][1]
    np.testing.assert_allclose(mhe.covariances()[-1], P, rtol=0.0, atol=1e-8 * np.abs(P).max())


def chain(method):
    """Five states that decay into each other, from rates; a map, or a DAE, if asked for."""
    def rate(x):
        return -x + 0.3 * np.roll(x, 1, axis=-1)

    if method == "map":
        return qpmhe.System(lambda x: x + 0.1 * rate(x), lambda x: x[..., :1], n=5, p=1)
    if method == "dae":
        return qpmhe.System.from_dae(
            lambda x, z: rate(x) + z, lambda x, z: z + z**3 - 0.1 * x[..., :1],
            lambda x, z: x[..., :1], dt=0.1, n=5, k=1, p=1, algebraic_guess=[0.0])
    return qpmhe.System.from_ode(rate, lambda x: x[..., :1], dt=0.1, n=5, p=1, method=method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["map", "rk4", "radau", "midpoint", "dae"])
def test_the_step_is_compiled_with_all_optimisation(method):
    """A part that does not compile beside another is left without a word: the next level does."""
    made = qpmhe.compile(
        chain(method), qpmhe.Luenberger(0.1 * np.ones((5, 1))),
        qpmhe.QuadraticCost(prior=np.eye(5), disturbance=np.eye(5), noise=np.eye(1)), horizon=3,
        initial_state=np.zeros(5))
    assert optimisation(made.path).startswith("-O3")
