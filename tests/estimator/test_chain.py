"""The chain of masses: its forces, its derivatives, its observer, and what an estimate gains."""

import pickle

import numpy as np
import pytest

import qpmhe
from qpmhe.models.chain import casadi_output, casadi_rate, chain_of_masses

NONE = np.zeros(0)
MASS, STIFFNESS, LENGTH, DAMPING, GRAVITY, SPACING = 0.033, 1.0, 0.033, 0.04, 9.81, 0.25
SIZES = [(1, 1), (4, 1), (1, 2), (3, 2), (1, 3), (2, 3), (3, 3), (16, 3)]


def continuous(system):
    """The rate, its Jacobian, the output and its Jacobian, which the system is made of."""
    given = system.__reduce__()[1][1]
    return given["rate"], given["rate_jacobian"], given["h"], given["h_jacobian"]


def states(scenario, count, seed=5):
    """Random states, far from rest and from each other."""
    generator = np.random.default_rng(seed)
    rest = scenario.initial_estimate
    return rest + generator.uniform(0.1, 2.0, (count, 1)) * generator.standard_normal(
        (count, rest.size)
    )


def link_vectors(x, masses, dimension):
    """Vectors of all links with their rates, from the definition."""
    p, v = x.reshape(2, masses, dimension)
    end = np.zeros(dimension)
    end[0] = SPACING * (masses + 1)
    still = np.zeros((1, dimension))
    points, moves = np.vstack((still, p, end)), np.vstack((still, v, still))
    return np.diff(points, axis=0), np.diff(moves, axis=0)


def energy(x, masses, dimension):
    p, v = x.reshape(2, masses, dimension)
    links, _ = link_vectors(x, masses, dimension)
    rails = LENGTH if dimension == 1 else 0.0
    stretch = np.sqrt((links**2).sum(axis=1) + rails**2) - LENGTH
    height = p[:, -1].sum() if dimension > 1 else 0.0
    return (
        0.5 * MASS * (v**2).sum() + 0.5 * STIFFNESS * (stretch**2).sum() + MASS * GRAVITY * height
    )


@pytest.mark.parametrize(("masses", "dimension"), SIZES)
def test_energy_is_lost_to_the_dampers_only(masses, dimension):
    system, _, _, scenario = chain_of_masses(masses, dimension)
    rate = continuous(system)[0]
    for x in states(scenario, 5):
        direction = rate(x)
        step = 1e-6 / np.linalg.norm(direction)
        found = (
            energy(x + step * direction, masses, dimension)
            - energy(x - step * direction, masses, dimension)
        ) / (2.0 * step)
        lost = DAMPING * (link_vectors(x, masses, dimension)[1] ** 2).sum()
        power = np.linalg.norm(direction) * np.linalg.norm(x)
        assert lost > 0.0
        assert found == pytest.approx(-lost, abs=1e-7 * power)


@pytest.mark.parametrize(("masses", "dimension"), SIZES)
def test_casadi_gives_the_same(masses, dimension):
    casadi = pytest.importorskip("casadi")
    system, _, _, scenario = chain_of_masses(masses, dimension)
    x = casadi.SX.sym("x", system.n)
    expressions = [casadi_rate(masses, dimension)(x), casadi_output(masses, dimension)(x)]
    expected = casadi.Function(
        "expected", [x], [g for e in expressions for g in (e, casadi.jacobian(e, x))]
    )
    for point in states(scenario, 20):
        for k, (function, value) in enumerate(
            zip(continuous(system), expected(point), strict=True)
        ):
            value = np.array(value).reshape((-1, system.n) if k % 2 else -1)
            tolerance = (1e-10 if k % 2 else 1e-12) * (1.0 + np.abs(value).max())
            np.testing.assert_allclose(function(point), value, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize(("masses", "dimension"), [(1, 1), (3, 2), (2, 3)])
def test_the_steps_derivative_is_that_of_the_complex_step(masses, dimension, method):
    system, _, _, scenario = chain_of_masses(masses, dimension, method)
    rate, _, h, _ = continuous(system)
    plain = qpmhe.System.from_ode(
        rate, h, dt=scenario.dt, n=system.n, p=system.p, method=method
    )
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("given", "given")
    assert (plain.f_jacobian.method, plain.h_jacobian.method) == ("complex step", "complex step")
    x, u = states(scenario, 6), np.zeros((6, 0))
    for given, computed in (
        (system.f_jacobian, plain.f_jacobian), (system.h_jacobian, plain.h_jacobian)
    ):
        expected = computed.batch(x, u)
        np.testing.assert_allclose(given.batch(x, u), expected, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(given(x[0], NONE), expected[0], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("masses", "dimension"), SIZES)
def test_functions_take_any_leading_dimensions(masses, dimension):
    system, _, _, scenario = chain_of_masses(masses, dimension)
    for function in continuous(system):
        for lead in [(1,), (7,), (2, 3)]:
            x = states(scenario, int(np.prod(lead))).reshape(*lead, -1)
            found = function(x)
            expected = np.array([function(row) for row in x.reshape(-1, system.n)])
            assert found.shape == (*lead, *expected.shape[1:])
            np.testing.assert_allclose(
                found.reshape(expected.shape), expected, rtol=0.0,
                atol=1e-13 * np.abs(expected).max(),
            )
    assert system.f.mode == system.h.mode == "batched"


@pytest.mark.parametrize(("masses", "dimension"), SIZES)
def test_the_chain_rests_where_the_estimation_starts(masses, dimension):
    system, _, _, scenario = chain_of_masses(masses, dimension)
    rest = scenario.initial_estimate
    assert not rest[system.p :].any()
    assert np.abs(continuous(system)[0](rest)).max() < 1e-10
    np.testing.assert_allclose(system.f(rest, NONE), rest, rtol=0.0, atol=1e-12)
    positions = rest[: system.p].reshape(masses, dimension)
    along = SPACING * np.arange(1, masses + 1)
    np.testing.assert_allclose(positions[:, 0] + positions[::-1, 0], SPACING * (masses + 1))
    assert np.all(np.diff(positions[:, 0]) > 0.0)
    if dimension == 1:
        np.testing.assert_allclose(positions[:, 0], along, rtol=1e-12)
    else:
        assert positions[:, -1].max() < -0.1
    if dimension == 3:
        assert not positions[:, 1].any()


def test_sizes_weights_and_labels():
    for masses, dimension in SIZES:
        system, observer, cost, scenario = chain_of_masses(masses, dimension)
        n, p = system.n, system.p
        assert (n, p, system.m) == (2 * masses * dimension, masses * dimension, 0)
        assert observer.gain.shape == (n, p)
        for weight, covariance in (
            (cost.disturbance, scenario.disturbance_covariance),
            (cost.noise, scenario.noise_covariance),
        ):
            np.testing.assert_allclose(weight @ covariance, np.eye(len(weight)), atol=1e-12)
        assert len(set(scenario.labels)) == len(scenario.labels) == n
        assert scenario.labels[p - 1] == f"{'xyz'[dimension - 1]}{masses} (m)"
        assert scenario.labels[p] == "vx1 (m/s)"
    system, _, _, scenario = chain_of_masses()
    assert (system.n, scenario.horizon) == (12, 30)


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("masses", [1, 2, 3, 5, 9, 16])
def test_the_observer_converges(masses, dimension, method):
    system, observer, _, scenario = chain_of_masses(masses, dimension, method)
    # Independent of the design: the chain itself, and the error's linearisation, are stable.
    A, C = (g(scenario.initial_estimate, NONE) for g in (system.f_jacobian, system.h_jacobian))
    assert np.abs(np.linalg.eigvals(A)).max() < 1.0
    assert np.abs(np.linalg.eigvals(A - observer.gain @ C)).max() < 0.96
    x, z = scenario.initial_state, scenario.initial_estimate
    first = np.linalg.norm(x - z)
    disturbed, measurements = scenario.simulate(3, 300)
    errors, follower = [], z
    for t in range(300):
        x, z = system.f(x, NONE), system.f(z, NONE) + observer.gain @ (x - z)[: system.p]
        correction = observer.gain @ (measurements[t] - follower[: system.p])
        follower = system.f(follower, NONE) + correction
        errors.append(np.linalg.norm(follower - disturbed[t + 1]))
    assert np.linalg.norm(x - z) < 1e-6 * first
    assert np.abs(disturbed).max() < 10.0 * (masses + 1)
    assert np.sqrt(np.mean(np.square(errors[100:])) / system.n) < 0.1


def test_the_gain_is_that_of_the_stationary_kalman_predictor():
    system, observer, _, scenario = chain_of_masses(3, 2)
    kalman = qpmhe.SteadyStateKalman(
        system, scenario.initial_estimate,
        disturbance=scenario.disturbance_covariance, noise=scenario.noise_covariance,
    )
    np.testing.assert_allclose(observer.gain, kalman.gain, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("masses", "dimension"), [(1, 1), (3, 2), (2, 3)])
def test_one_qp_improves_on_the_observer_and_is_almost_converged(masses, dimension):
    system, observer, cost, scenario = chain_of_masses(masses, dimension)
    rmse = {}
    for max_qps in (0, 1, None):
        squares = []
        for seed in range(3):
            true, measurements = scenario.simulate(seed)
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=scenario.horizon, backend="banded",
                initial_state=scenario.initial_estimate, max_qps=max_qps,
            )
            run = mhe.run(measurements)
            assert np.all(run.costs <= run.candidate_costs)
            squares.append(((run.states - true) ** 2).sum(axis=1).mean())
        rmse[max_qps] = np.sqrt(np.mean(squares))
    assert rmse[1] < 0.7 * rmse[0]
    assert rmse[1] == pytest.approx(rmse[None], rel=0.02)


def test_a_pickled_chain_estimates_the_same():
    def estimates(chain):
        system, observer, cost, scenario = chain
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=5, initial_state=scenario.initial_estimate
        )
        return mhe.run(scenario.simulate(0, 8).measurements).states

    chain = chain_of_masses(2, 2)
    assert np.array_equal(estimates(pickle.loads(pickle.dumps(chain))), estimates(chain))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"masses": 0}, "masses is 0; expected an integer >= 1"),
        ({"masses": -2}, "masses is -2"),
        ({"masses": 2.0}, r"masses is 2\.0"),
        ({"masses": True}, "masses is True"),
        ({"dimension": 0}, "dimension is 0; expected 1, 2 or 3"),
        ({"dimension": 4}, "dimension is 4"),
        ({"dimension": 3.0}, r"dimension is 3\.0"),
        ({"dimension": True}, "dimension is True"),
        ({"dimension": "3"}, "dimension is '3'"),
    ],
)
@pytest.mark.parametrize("maker", [chain_of_masses, casadi_rate, casadi_output])
def test_sizes_that_are_none(maker, options, named):
    with pytest.raises(qpmhe.errors.OptionError, match=named):
        maker(**options)


def test_an_unknown_method():
    with pytest.raises(qpmhe.errors.OptionError, match="method is 'heun'; expected one of 'euler'"):
        chain_of_masses(method="heun")
