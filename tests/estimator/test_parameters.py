"""Parameters beside the state: constant in every window, and found where they show."""

import pickle

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import (
    Box,
    Luenberger,
    MovingHorizonEstimator,
    Polytope,
    QuadraticCost,
    Status,
    augment_parameters,
)
from qpmhe_solvers import backend

from .plain import euler, rk4

DT = 0.1
TRUE = np.array([3.0, 0.8])  # stiffness and damping
NOMINAL = [2.0, 0.8]
START = np.array([1.0, 0.0])
POSITION_EXACT = Box([0.0, -np.inf], [0.0, np.inf])
NOTHING = Box([0.0, 0.0], [0.0, 0.0])


def spring(x, theta):
    """Position is the exact sum of speeds; batched."""
    position, speed = x[..., 0], x[..., 1]
    force = -theta[..., 0] * position - theta[..., 1] * speed
    return np.stack([position + DT * speed, speed + DT * force], axis=-1)


def position(x, theta):
    return x[..., 0]


def record(steps=40, seed=0, noise=1e-3, disturbance=0.0):
    generator = np.random.default_rng(seed)
    states, outputs = [START], []
    for _ in range(steps):
        outputs.append(states[-1][0] + noise * generator.normal())
        kick = np.array([0.0, disturbance * generator.normal()])
        states.append(spring(states[-1], TRUE) + kick)
    return np.array(states), np.array(outputs)


def spring_mhe(gain=(0.0, -0.05, 0.0), disturbances=POSITION_EXACT, horizon=15, **options):
    system = augment_parameters(
        spring, position, n=2, p=1, nominal=NOMINAL, estimated=[0], disturbances=disturbances,
        parameter_bounds=options.pop("bounds", None),
    )
    cost = QuadraticCost(prior=np.diag([10.0, 10.0, 1e-3]), disturbance=1e4 * np.eye(3), noise=1e6)
    return MovingHorizonEstimator(
        system, Luenberger(gain), cost, horizon=horizon, initial_state=[*START, NOMINAL[0]],
        **options,
    )


def checked(mhe, outputs, inputs=None):
    """All estimates, each held to the promises that are made of every one."""
    system, cost = mhe.system, mhe.cost
    estimates = []
    for t, y in enumerate(outputs):
        estimate = mhe.update(y) if inputs is None else mhe.update(y, inputs[t])
        assert estimate.cost <= estimate.candidate_cost
        assert not estimate.dropped
        x, w, v = estimate.trajectory, estimate.disturbances, estimate.noises
        assert system.disturbances.violation(w) <= 1e-8
        if system.states is not None:
            assert system.states.violation(x) <= 1e-8
        last = slice(t + 1 - len(v), t + 1)
        u = np.zeros((len(v), 0)) if inputs is None else inputs[last]
        np.testing.assert_allclose(w, x[1:] - system.f.batch(x[:-1], u), atol=1e-14)
        np.testing.assert_allclose(
            v, np.reshape(outputs[last], v.shape) - system.h.batch(x[:-1], u), atol=1e-14
        )
        stages = np.sum((w @ cost.disturbance) * w) + np.sum((v @ cost.noise) * v)
        assert estimate.cost >= stages * (1 - 1e-9)
        estimates.append(estimate)
    return estimates


def spread(estimate, first=2):
    return float(np.ptp(estimate.trajectory[:, first:], axis=0).max())


@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
@pytest.mark.parametrize("infeasible", ["drop_rows", "keep_candidate"])
def test_unknown_constant_is_recovered_and_constant(candidate, infeasible):
    states, outputs = record()
    mhe = spring_mhe(max_qps=None, candidate=candidate, infeasible=infeasible)
    estimates = checked(mhe, outputs)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    assert all((estimate.disturbances[:, 2] == 0.0).all() for estimate in estimates)
    late = np.array([estimate.state for estimate in estimates[20:]])
    assert abs(late[0, 2] - NOMINAL[0]) > 0.5
    np.testing.assert_allclose(late[:, 2], TRUE[0], rtol=0.05)
    np.testing.assert_allclose(late[:, :2], states[21:], atol=0.02)


def test_estimate_is_the_minimum_over_state_parameter_and_noisy_disturbance():
    _, outputs = record(8, disturbance=0.02)
    estimate = checked(spring_mhe(max_qps=None, tolerance=1e-14), outputs)[-1]

    def residuals(unknown):
        x, theta, kicks = unknown[:2], np.array([unknown[2], NOMINAL[1]]), unknown[3:]
        offset = np.append(x - START, unknown[2] - NOMINAL[0])
        parts = [np.sqrt([10.0, 10.0, 1e-3]) * offset, 1e2 * kicks]
        for y, kick in zip(outputs, kicks, strict=True):
            parts.append([1e3 * (y - x[0])])
            x = spring(x, theta) + np.array([0.0, kick])
        return np.concatenate(parts)

    begin = np.concatenate((START, NOMINAL[:1], np.zeros(8)))
    best = least_squares(residuals, begin, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert estimate.cost == pytest.approx(2.0 * best.cost, rel=1e-7)
    np.testing.assert_allclose(estimate.trajectory[0], best.x[:3], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", qpmhe.solvers.available())
@pytest.mark.parametrize("disturbances", [POSITION_EXACT, NOTHING, None])
def test_every_backend_keeps_parameters_constant(name, disturbances):
    states, outputs = record(18)
    # A gain that fits the set: none at all where nothing may be corrected.
    gain = (0.0, 0.0, 0.0) if disturbances is NOTHING else (0.0, -0.05, 0.0)
    mhe = spring_mhe(gain, disturbances, horizon=12, backend=name, max_qps=3)
    estimates = checked(mhe, outputs)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    # Of a problem scaled like this one, ecos brings nothing useful now and then.
    last = [estimate for estimate in estimates if estimate.improved][-1]
    assert last.time >= len(estimates) - (4 if name == "ecos" else 1)
    np.testing.assert_allclose(last.state[:2], states[last.time + 1], atol=0.05)


@pytest.mark.parametrize("name", [n for n in qpmhe.solvers.available() if backend(n).inequalities])
def test_every_backend_with_inequalities_respects_parameter_bounds(name):
    _, outputs = record(18)
    bounds = Box([1.5], [2.4])
    estimates = checked(
        spring_mhe(bounds=bounds, horizon=12, backend=name, max_qps=5), outputs
    )
    parameter = np.array([estimate.state[2] for estimate in estimates])
    assert (parameter <= 2.4 + 1e-8).all()
    # The true value, 3, is outside: the bound binds.
    assert parameter[-1] == pytest.approx(2.4, abs=1e-3)


def test_no_process_noise_at_all_rolls_the_model_out():
    states, outputs = record()
    estimates = checked(spring_mhe((0.0, 0.0, 0.0), NOTHING, max_qps=None), outputs)
    for estimate in estimates:
        assert not estimate.disturbances.any()
    assert estimates[-1].state[2] == pytest.approx(TRUE[0], rel=0.02)
    np.testing.assert_allclose(estimates[-1].state[:2], states[-1], atol=5e-3)


@pytest.mark.parametrize("name", qpmhe.solvers.available())
def test_gain_on_an_exact_integrator_is_met(name):
    states, outputs = record(18, disturbance=0.02)
    mhe = spring_mhe((0.3, 0.3, 0.0), horizon=12, backend=name, max_qps=3)
    estimates = checked(mhe, outputs)
    assert any(Status.CANDIDATE_OUTSIDE in estimate.status for estimate in estimates)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    for estimate in estimates:
        assert not estimate.disturbances[:, 0].any()
        x = estimate.trajectory
        np.testing.assert_allclose(x[1:, 0], x[:-1, 0] + DT * x[:-1, 1], atol=1e-14)
    np.testing.assert_allclose(estimates[-1].state[:2], states[-1], atol=0.1)


def test_gain_on_a_parameter_is_met():
    _, outputs = record()
    mhe = spring_mhe((0.0, -0.05, 0.5), max_qps=None)
    estimates = checked(mhe, outputs)
    assert any(Status.CANDIDATE_OUTSIDE in estimate.status for estimate in estimates)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    assert estimates[-1].state[2] == pytest.approx(TRUE[0], rel=0.05)


def test_parameter_that_does_not_show_keeps_its_prior():
    system = augment_parameters(
        lambda x, theta: 0.8 * x, lambda x, theta: x, n=1, p=1, nominal=[7.0]
    )
    cost = QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=1.0)
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.3, 0.0]), cost, horizon=5, initial_state=[1.0, 7.0], max_qps=None
    )
    for estimate in checked(mhe, np.random.default_rng(3).normal(size=12)):
        np.testing.assert_allclose(estimate.trajectory[:, 1], 7.0, atol=1e-12)


def test_one_state_one_output_one_parameter():
    def decay(x, theta):
        return theta[0] * x[0] + 1.0  # a scalar, where n is 1

    system = augment_parameters(decay, lambda x, theta: x[0], n=1, p=1, nominal=0.5)
    outputs, x = [], 0.0
    for _ in range(25):
        outputs.append(x)
        x = 0.9 * x + 1.0
    cost = QuadraticCost(prior=np.diag([1.0, 1e-6]), disturbance=1e4 * np.eye(2), noise=1e4)
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.3, 0.0]), cost, horizon=10, initial_state=[0.0, 0.5], max_qps=None
    )
    estimates = checked(mhe, outputs)
    assert estimates[-1].state == pytest.approx([x, 0.9], rel=1e-5)
    assert max(spread(estimate, 1) for estimate in estimates) <= 1e-12


def driven(x, u, theta):
    return np.stack(
        [theta[..., 0] * x[..., 0] + u[..., 0], x[..., 1] * theta[..., 2] + x[..., 0]], axis=-1
    )


def scaled(x, u, theta):
    return theta[..., 1:2] * x[..., 1:] + 0.0 * u


def test_inputs_and_two_parameters_of_three():
    generator = np.random.default_rng(5)
    theta, nominal = np.array([0.7, 2.0, 0.3]), [0.7, 1.0, 0.5]
    inputs = generator.normal(size=(40, 1))
    x, states, outputs = np.array([1.0, 1.0]), [], []
    for u in inputs:
        outputs.append(scaled(x, u, theta))
        x = driven(x, u, theta)
        states.append(x)
    system = augment_parameters(
        driven, scaled, n=2, p=1, m=1, nominal=nominal, estimated=[2, 1]
    )
    assert (system.n, system.p, system.m) == (4, 1, 1)
    cost = QuadraticCost(
        prior=np.diag([1.0, 1.0, 1e-4, 1e-4]), disturbance=1e3 * np.eye(4), noise=1e3
    )
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.0, 0.1, 0.0, 0.0]), cost, horizon=15,
        initial_state=[1.0, 0.5, 0.5, 1.0], max_qps=None, candidate="reinitialized",
    )
    estimates = checked(mhe, np.array(outputs), inputs)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    np.testing.assert_allclose(estimates[-1].state, [*states[-1], 0.3, 2.0], rtol=1e-3)


def test_nothing_estimated_is_the_plain_system():
    _, outputs = record(12)
    plain = qpmhe.System(
        lambda x: spring(x, TRUE), lambda x: position(x, TRUE), n=2, p=1,
        disturbances=POSITION_EXACT,
    )
    cost = QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=100.0)
    runs = []
    for estimated in ([], np.zeros(2, dtype=bool), None):
        system = plain if estimated is None else augment_parameters(
            spring, position, n=2, p=1, nominal=TRUE, estimated=estimated,
            disturbances=POSITION_EXACT,
        )
        assert (system.n, system.states, system.disturbances) == (2, None, POSITION_EXACT)
        mhe = MovingHorizonEstimator(
            system, Luenberger([0.0, -0.05]), cost, horizon=5, initial_state=[0.5, 0.0]
        )
        runs.append(np.array([estimate.state for estimate in checked(mhe, outputs)]))
    np.testing.assert_array_equal(runs[0], runs[2])
    np.testing.assert_array_equal(runs[1], runs[2])


@pytest.mark.parametrize(
    ("estimated", "order"),
    [
        (None, [0, 1, 2]),
        ([0, 1, 2], [0, 1, 2]),
        ([2, 0], [2, 0]),
        (1, [1]),
        ([True, False, True], [0, 2]),
        (np.array([False, True, False]), [1]),
        ([], []),
    ],
)
def test_joint_functions_put_parameters_where_they_belong(estimated, order):
    generator = np.random.default_rng(1)
    nominal = np.array([0.5, 1.5, 2.5])
    system = augment_parameters(
        driven, scaled, n=2, p=1, m=1, nominal=nominal, estimated=estimated
    )
    assert system.n == 2 + len(order)
    z, u = generator.uniform(0.5, 1.5, (7, system.n)), generator.normal(size=(7, 1))
    theta = np.tile(nominal, (7, 1))
    theta[:, order] = z[:, 2:]
    ahead = np.hstack((driven(z[:, :2], u, theta), theta[:, order]))
    np.testing.assert_allclose(system.f.batch(z, u), ahead, rtol=1e-15)
    np.testing.assert_allclose(system.h.batch(z, u), scaled(z[:, :2], u, theta), rtol=1e-15)
    np.testing.assert_allclose(system.f(z[0], u[0]), ahead[0], rtol=1e-15)
    jacobian = system.f_jacobian.batch(z, u)
    np.testing.assert_array_equal(
        jacobian[:, 2:], np.tile(np.eye(system.n)[2:], (7, 1, 1))
    )
    if 0 in order:
        np.testing.assert_allclose(jacobian[:, 0, 2 + order.index(0)], z[:, 0], rtol=1e-12)


def by_column(x, u, theta):
    return np.array([x[0] * theta[0] + u[0], x[1] - theta[1] * x[0]])


def by_state(x, u, theta):
    first, second = float(np.real(theta[0])), float(np.real(theta[1]))
    return [x[0] * first + u[0], x[1] - second * x[0]]


def by_row(x, u, theta):
    return np.stack(
        [x[..., 0] * theta[..., 0] + u[..., 0], x[..., 1] - theta[..., 1] * x[..., 0]], axis=-1
    )


@pytest.mark.parametrize("written", [by_column, by_state, by_row])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_every_way_of_writing_gives_the_same_values(written, count):
    """Counts that equal n, m + k and n + k: shapes that do not tell rows from columns."""
    system = augment_parameters(
        written, lambda x, u, theta: x[0], n=2, p=1, m=1, nominal=[0.9, 0.1]
    )
    generator = np.random.default_rng(count)
    z, u = generator.normal(size=(count, 4)), generator.normal(size=(count, 1))
    expected = np.array([[*by_row(zi[:2], ui, zi[2:]), *zi[2:]]
                         for zi, ui in zip(z, u, strict=True)])
    np.testing.assert_allclose(system.f.batch(z, u), expected, rtol=1e-14)
    np.testing.assert_allclose(system.f(z[0], u[0]), expected[0], rtol=1e-14)
    np.testing.assert_array_equal(system.h.batch(z, u), z[:, :1])


def square(x, theta):
    return np.array([x[0] * theta[1], x[1] + theta[0]])


def test_columns_are_told_from_rows_where_all_sizes_agree():
    system = augment_parameters(square, lambda x, theta: x[1], n=2, p=1, nominal=[0.3, 0.4])
    z, nothing = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]), np.zeros((2, 0))
    np.testing.assert_array_equal(
        system.f.batch(z, nothing), [[4.0, 5.0, 3.0, 4.0], [40.0, 13.0, 7.0, 8.0]]
    )


def test_functions_of_columns_are_not_looped_over():
    calls = []

    def counted(x, theta):
        calls.append(np.shape(x))
        return np.array([x[0] * theta[0], x[1]])

    system = augment_parameters(counted, lambda x, theta: x[:1], n=2, p=1, nominal=[0.5])
    calls.clear()
    system.f.batch(np.ones((50, 3)), np.zeros((50, 0)))
    assert calls == [(2, 50)]


def test_one_parameter_vector_for_all_states_does_not_pass_for_batched():
    """``theta[0]`` is one state's parameter, or all parameters of the first of many states."""
    system = augment_parameters(
        lambda x, theta: theta[0] * x, lambda x, theta: x, n=1, p=1, nominal=[0.5]
    )
    z = np.array([[1.0, 2.0], [1.0, 3.0], [1.0, 4.0]])
    np.testing.assert_array_equal(
        system.f.batch(z, np.zeros((3, 0))), [[2.0, 2.0], [3.0, 3.0], [4.0, 4.0]]
    )
    assert system.f.mode == "batched"  # by columns inside, not state by state


@pytest.mark.parametrize(
    ("states", "bounds"),
    [
        (None, None),
        (Box([-1.0, -np.inf], [1.0, 2.0]), None),
        (None, Box([0.0], [4.0])),
        (Polytope([[1.0, 1.0]], [1.0]), Box([0.0], [4.0])),
        (Box([-1.0, -1.0], [1.0, 2.0]), Polytope([[2.0], [-1.0]], [8.0, 0.0])),
        (Polytope([[1.0, 1.0]], [1.0]) & Box([-1.0, -1.0], [1.0, 1.0]), None),
    ],
)
def test_sets_are_products(states, bounds):
    points = np.random.default_rng(2).normal(scale=3.0, size=(200, 3))
    system = augment_parameters(
        spring, position, n=2, p=1, nominal=NOMINAL, estimated=[0], states=states,
        disturbances=states, noises=Box([-1.0], [1.0]), parameter_bounds=bounds,
    )

    def miss(one, point):
        return 0.0 if one is None else one.violation(point)

    if states is None and bounds is None:
        assert system.states is None
    else:
        for z in points:
            assert system.states.violation(z) == pytest.approx(
                max(miss(states, z[:2]), miss(bounds, z[2:]))
            )
    for z in points:
        assert system.disturbances.violation(z) == pytest.approx(
            max(miss(states, z[:2]), abs(z[2]))
        )
    assert 2 in system.disturbances.fixed_components
    assert system.noises.upper == 1.0


def test_polytope_of_disturbances_is_respected_beside_constant_parameters():
    _, outputs = record(18, disturbance=0.05)
    narrow = Polytope([[0.0, 1.0], [0.0, -1.0], [1.0, 1.0]], [1e-3, 1e-3, 1e-3])
    mhe = spring_mhe((0.0, 0.0, 0.0), narrow, horizon=12, max_qps=5)
    estimates = checked(mhe, outputs)
    assert max(spread(estimate) for estimate in estimates) <= 1e-12
    # Some of the kicks are larger than allowed, so that the set binds.
    assert max(np.abs(estimate.disturbances[:, 1]).max() for estimate in estimates) > 0.99e-3


def build(**changes):
    arguments = {"n": 2, "p": 1, "nominal": NOMINAL, **changes}
    f, h = arguments.pop("f", spring), arguments.pop("h", position)
    return augment_parameters(f, h, **arguments)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"nominal": [[2.0, 0.8]]}, "ShapeError", r"shape \(1, 2\); expected \(k,\)"),
        ({"nominal": []}, "ShapeError", r"shape \(0,\); expected \(k,\)"),
        ({"nominal": [2.0, np.nan]}, "InvalidInputError",
         r"nominal\[1\] is nan: a parameter without a prior value"),
        ({"nominal": [None, 1.0]}, "InvalidInputError", r"nominal\[0\] is nan"),
        ({"nominal": [np.inf, 1.0]}, "InvalidInputError", r"nominal\[0\] is inf"),
        ({"nominal": "two"}, "InvalidInputError", "nominal is 'two'"),
        ({"nominal": [2.0]}, "ModelError", r"IndexError.*theta = \[2.0\].*Check nominal"),
        ({"estimated": [2]}, "InvalidInputError", "names parameter 2; expected .* 0 to 1"),
        ({"estimated": [-1]}, "InvalidInputError", "names parameter -1"),
        ({"estimated": [1, 1]}, "InvalidInputError", r"\[1, 1\], which names one parameter twice"),
        ({"estimated": [0.0]}, "InvalidInputError", r"\[0.0\]; expected indices"),
        ({"estimated": [[0, 1]]}, "InvalidInputError", r"\[\[0, 1\]\]; expected indices"),
        ({"estimated": "damping"}, "InvalidInputError", "'damping'; expected indices"),
        ({"estimated": [True]}, "ShapeError", r"mask of shape \(1,\); expected \(2,\)"),
        ({"states": Box([0.0], [1.0])}, "SetError", "states has dimension 1; expected 2"),
        ({"states": Box([0.0] * 4, [1.0] * 4)}, "SetError", "states has dimension 4; expected 2"),
        ({"states": [0.0, 1.0]}, "SetError", "states is .*; expected a qpmhe.Box"),
        ({"disturbances": Box([0.0], [1.0])}, "SetError",
         "disturbances has dimension 1; expected 2, the dimension of x alone"),
        ({"noises": Box([0.0] * 2, [1.0] * 2)}, "SetError", "noises has dimension 2; expected 1"),
        ({"parameter_bounds": Box([0.0], [9.0])}, "SetError",
         "parameter_bounds has dimension 1; expected 2"),
        ({"parameter_bounds": Box([0.0, 1.0], [9.0, 9.0])}, "SetError",
         r"nominal is \[2.0, 0.8\].*outside of parameter_bounds"),
        ({"parameter_bounds": Box([0.0] * 2, [9.0] * 2).soften(linear=1.0)}, "SetError",
         "is soft; an augmented model takes hard ones only"),
        ({"parameter_bounds": Box([0.0], [9.0]), "estimated": []}, "SetError",
         "parameter_bounds was given, but no parameter is estimated"),
        ({"f": lambda x: x}, "ModelError",
         r"f\(x\) cannot be called as f\(x, theta\).*no inputs"),
        ({"h": lambda x, u, theta: x[0]}, "ModelError",
         r"h\(x, u, theta\) cannot be called as h\(x, theta\)"),
        ({"m": 1}, "ModelError", r"f\(x, theta\) cannot be called as f\(x, u, theta\).*1 inputs"),
        ({"f": 3.0}, "ModelError", "f is 3.0; expected a function"),
        ({"f": lambda x, theta: x[:1]}, "ModelError",
         r"f returned shape \(1,\).*expected \(2,\)"),
        ({"h": lambda x, theta: x}, "ModelError", r"h returned shape \(2,\).*expected \(1,\)"),
        ({"n": 0}, "OptionError", "n is 0; expected an integer >= 1"),
        ({"p": 1.5}, "OptionError", "p is 1.5"),
        ({"m": -1}, "OptionError", "m is -1"),
        ({"n": None}, "OptionError", "n is None"),
        ({"h": None}, "ModelError", "h is None; expected a function"),
        ({"dt": 0.0}, "OptionError", "dt is 0.0; expected a finite number > 0"),
        ({"dt": -0.1}, "OptionError", "dt is -0.1"),
        ({"dt": "fast"}, "OptionError", "dt is 'fast'"),
        ({"dt": 0.1, "method": "trapezoid"}, "OptionError", "method is 'trapezoid'"),
        ({"method": "rk4"}, "OptionError", "method is 'rk4', but dt is missing"),
        ({"drifting": "yes"}, "OptionError", "drifting is 'yes'; expected True or False"),
    ],
)
def test_wrong_arguments_are_named(changes, error, words):
    with pytest.raises(getattr(qpmhe.errors, error), match=words):
        build(**changes)


def test_writing_to_the_parameters_is_found_out():
    def careless(x, theta):
        theta[0] = 1.0
        return x

    with pytest.raises(qpmhe.errors.ModelError, match="changes its argument in place"):
        build(f=careless)


def test_model_undefined_at_the_start_is_named_there():
    system = build(f=lambda x, theta: [1.0 / int(0 * x[0].real), 0.0])
    cost = QuadraticCost(prior=np.eye(4), disturbance=np.eye(4), noise=1.0)
    with pytest.raises(qpmhe.errors.ModelError, match="f raised ZeroDivisionError"):
        MovingHorizonEstimator(
            system, Luenberger(np.zeros(4)), cost, horizon=3, initial_state=[1.0, 0.0, *NOMINAL]
        )


def test_bounds_keep_trials_inside_the_domain_of_the_model():
    def narrow(x, theta):
        if np.any(np.abs(np.real(theta) - 10.25) > 0.01 + 1e-4):
            raise ValueError("no such substance")
        return theta[0] * x

    system = augment_parameters(
        narrow, lambda x, theta: x, n=1, p=1, nominal=[10.25],
        parameter_bounds=Box([10.24], [10.26]),
    )
    assert (system.f_jacobian.method, system.h_jacobian.method) == ("complex step", "complex step")


def spring_rate(x, theta):
    return np.stack(
        [x[..., 1], -theta[..., 0] * x[..., 0] - theta[..., 1] * x[..., 1]], axis=-1
    )


def driven_rate(x, u, theta):
    return np.array([x[1], u[0] - theta[0] * x[0] - theta[1] * x[1]])


@pytest.mark.parametrize(("method", "step"), [(None, rk4), ("rk4", rk4), ("euler", euler)])
@pytest.mark.parametrize("m", [0, 1])
def test_a_rate_is_discretised(m, method, step):
    f, h = (spring_rate, position) if m == 0 else (driven_rate, lambda x, u, theta: x[0])
    system = augment_parameters(
        f, h, n=2, p=1, m=m, nominal=NOMINAL, estimated=[0], dt=DT, method=method
    )
    assert (system.dt, system.n, system.f_jacobian.method) == (DT, 3, "complex step")
    generator = np.random.default_rng(4)
    z, u = generator.normal(size=(6, 3)), generator.normal(size=(6, m))

    def following(z, u, dt):
        theta = np.array([z[2], NOMINAL[1]])

        def rate(x, u):
            return f(x, theta) if m == 0 else f(x, u, theta)

        return np.append(step(rate)(z[:2], u, dt), z[2])

    for zi, ui in zip(z, u, strict=True):
        np.testing.assert_allclose(system.f(zi, ui), following(zi, ui, DT), rtol=1e-14)
        found = system.timed.f(zi, np.append(ui, 0.25))
        np.testing.assert_allclose(found, following(zi, ui, 0.25), rtol=1e-14)
        slope = [following(zi + 1e-30j * unit, ui, DT).imag / 1e-30 for unit in np.eye(3)]
        np.testing.assert_allclose(system.f_jacobian(zi, ui).T, slope, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        system.f.batch(z, u), [following(*pair, DT) for pair in zip(z, u, strict=True)], rtol=1e-14
    )


def test_a_rate_with_irregular_steps_finds_the_constant():
    system = augment_parameters(
        spring_rate, position, n=2, p=1, nominal=NOMINAL, estimated=[0], dt=DT
    )
    cost = QuadraticCost(prior=np.diag([10.0, 10.0, 1e-3]), disturbance=1e6 * np.eye(3), noise=1e6)
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.0, -0.05, 0.0]), cost, horizon=15, initial_state=[*START, 2.0],
        max_qps=None,
    )
    x, generator = START, np.random.default_rng(3)
    for _ in range(30):
        dt = DT * generator.uniform(0.5, 2.0)
        estimate = mhe.update(x[0] + 1e-3 * generator.normal(), dt=dt)
        x = rk4(lambda x, _: spring_rate(x, TRUE))(x, None, dt)
        assert estimate.cost <= estimate.candidate_cost
        assert spread(estimate) == 0.0
    assert estimate.state[2] == pytest.approx(TRUE[0], rel=0.02)
    np.testing.assert_allclose(estimate.state[:2], x, atol=0.01)


def test_parameters_that_drift_are_followed():
    theta, x, found = 2.0, START, []
    system = augment_parameters(
        driven_rate, lambda x, u, theta: x[:1], n=2, p=1, m=1, nominal=NOMINAL, estimated=[0],
        dt=DT, drifting=True, disturbances=POSITION_EXACT,
    )
    assert system.disturbances.upper.tolist() == [0.0, np.inf, np.inf]
    cost = QuadraticCost.from_covariances(
        prior=np.diag([0.1, 0.1, 0.2]), disturbance=np.diag([1e-6, 1e-6, 1e-2]), noise=1e-6
    )
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.0, -0.05, 0.0]), cost, horizon=15, initial_state=[*START, theta],
        max_qps=None, candidate="reinitialized",
    )
    for t in range(80):
        u = np.array([2.0 * np.sin(0.3 * t)])
        estimate = mhe.update(x[0], u)
        x = rk4(lambda x, known: driven_rate(x, known[:1], known[1:]))(
            x, np.array([*u, theta, TRUE[1]]), DT
        )
        theta += 0.02
        found.append(estimate.state[2] - theta)
    assert np.abs(found[40:]).mean() < 0.2
    assert np.ptp(estimate.trajectory[:, 2]) > 0.05


@pytest.mark.parametrize("options", [{}, {"dt": DT, "method": "euler"}, {"drifting": True}])
def test_they_pickle_and_so_do_their_estimators(options):
    nominal = np.array(NOMINAL)
    system = augment_parameters(
        spring_rate, position, n=2, p=1, nominal=nominal, estimated=[True, False],
        parameter_bounds=Box([0.5], [9.0]), **options,
    )
    nominal[:] = 7.0  # the user's own: the system has taken a copy
    loaded = pickle.loads(pickle.dumps(system))
    z = np.array([[1.0, 0.5, 2.5], [0.1, -0.5, 1.5]])
    nothing = np.zeros((2, 0))
    assert (loaded.f.batch(z, nothing) == system.f.batch(z, nothing)).all()
    assert loaded.states.upper.tolist() == system.states.upper.tolist()
    cost = QuadraticCost(prior=1e-2 * np.eye(3), disturbance=np.eye(3), noise=1.0)
    mhe = MovingHorizonEstimator(
        system, Luenberger([0.0, -0.05, 0.0]), cost, horizon=4, initial_state=[*START, 2.0]
    )
    _, outputs = record(12)
    mhe.run(outputs[:6])
    other = pickle.loads(pickle.dumps(mhe))
    for y in outputs[6:]:
        assert (mhe.update(y).trajectory == other.update(y).trajectory).all()
