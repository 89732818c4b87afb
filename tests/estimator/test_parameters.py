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

DT = 0.1
TRUE = np.array([3.0, 0.8])  # stiffness and damping
NOMINAL = [2.0, 0.8]
START = np.array([1.0, 0.0])
POSITION_EXACT = Box([0.0, -np.inf], [0.0, np.inf])
NOTHING = Box([0.0, 0.0], [0.0, 0.0])


def spring_rate(x, theta):
    return np.stack(
        [x[..., 1], -theta[..., 0] * x[..., 0] - theta[..., 1] * x[..., 1]], axis=-1
    )


def spring(x, theta):
    """Position is the exact sum of speeds; batched."""
    return x + DT * spring_rate(x, theta)


def position(x, theta):
    return x[..., 0]


def record(steps=40, disturbance=0.0):
    generator = np.random.default_rng(0)
    states, outputs = [START], []
    for _ in range(steps):
        outputs.append(states[-1][0] + 1e-3 * generator.normal())
        kick = np.array([0.0, disturbance * generator.normal()])
        states.append(spring(states[-1], TRUE) + kick)
    return np.array(states), np.array(outputs)


def spring_mhe(gain=(0.0, -0.05, 0.0), disturbances=POSITION_EXACT, bounds=None, **options):
    system = augment_parameters(
        spring, position, n=2, p=1, nominal=NOMINAL, estimated=[0], disturbances=disturbances,
        parameter_bounds=bounds,
    )
    cost = QuadraticCost(prior=np.diag([10.0, 10.0, 1e-3]), disturbance=1e4 * np.eye(3), noise=1e6)
    return MovingHorizonEstimator(
        system, Luenberger(gain), cost, initial_state=[*START, NOMINAL[0]],
        **{"horizon": 15, "max_qps": None} | options,
    )


def checked(mhe, outputs, inputs=None, n=2):
    """All estimates, each held to the promises that are made of every one."""
    estimates = []
    for t, y in enumerate(outputs):
        estimate = mhe.update(y) if inputs is None else mhe.update(y, inputs[t])
        x, w = estimate.trajectory, estimate.disturbances
        assert estimate.cost <= estimate.candidate_cost
        assert not estimate.dropped
        assert mhe.system.disturbances.violation(w) <= 1e-8
        assert mhe.system.states is None or mhe.system.states.violation(x) <= 1e-8
        assert np.ptp(x[:, n:], axis=0).max(initial=0.0) <= 1e-12
        u = np.zeros((len(w), 0)) if inputs is None else inputs[t + 1 - len(w) : t + 1]
        np.testing.assert_allclose(w, x[1:] - mhe.system.f.batch(x[:-1], u), atol=1e-14)
        estimates.append(estimate)
    return estimates


@pytest.mark.parametrize(
    "options", [{}, {"candidate": "reinitialized", "infeasible": "keep_candidate"}], ids=str
)
@pytest.mark.parametrize("gain", [0.0, 0.5])  # of the parameter, which no gain may move
def test_an_unknown_constant_is_recovered(gain, options):
    states, outputs = record()
    estimates = checked(spring_mhe((0.0, -0.05, gain), **options), outputs)
    if not options:
        outside = [Status.CANDIDATE_OUTSIDE in estimate.status for estimate in estimates]
        assert any(outside) is bool(gain)
    late = np.array([estimate.state for estimate in estimates[20:]])
    np.testing.assert_allclose(late[:, 2], TRUE[0], rtol=0.05)
    np.testing.assert_allclose(late[:, :2], states[21:], atol=0.02)


def test_the_estimate_is_the_minimum_over_state_parameter_and_noisy_disturbance():
    _, outputs = record(8, disturbance=0.02)
    estimate = checked(spring_mhe(tolerance=1e-14), outputs)[-1]

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
def test_every_backend_keeps_parameters_constant(name):
    states, outputs = record(18)
    for gain, disturbances in (
        ((0.0, 0.0, 0.0), NOTHING), ((0.3, 0.3, 0.0), POSITION_EXACT),  # moves what has no noise
    ):
        mhe = spring_mhe(gain, disturbances, horizon=12, backend=name, max_qps=3)
        estimates = checked(mhe, outputs)
        # Of a problem scaled like this one, ecos brings nothing useful now and then.
        last = [estimate for estimate in estimates if estimate.improved][-1]
        assert last.time >= len(estimates) - (4 if name == "ecos" else 1)
        np.testing.assert_allclose(last.state[:2], states[last.time + 1], atol=0.1)
    if backend(name).inequalities:
        mhe = spring_mhe(bounds=Box([1.5], [2.4]), horizon=12, backend=name, max_qps=5)
        # The true value, 3, is outside: the bound binds.
        assert checked(mhe, outputs)[-1].state[2] == pytest.approx(2.4, abs=1e-3)


def driven(x, u, theta):
    return np.stack(
        [theta[..., 0] * x[..., 0] + u[..., 0], x[..., 1] * theta[..., 2] + x[..., 0]], axis=-1
    )


def scaled(x, u, theta):
    return theta[..., 1:2] * x[..., 1:] + 0.0 * u


# The joint functions


@pytest.mark.parametrize(
    ("estimated", "order"),
    [(None, [0, 1, 2]), ([2, 0], [2, 0]), (1, [1]), ([True, False, True], [0, 2]), ([], [])],
)
def test_joint_functions_put_parameters_where_they_belong(estimated, order):
    generator, nominal = np.random.default_rng(1), np.array([0.5, 1.5, 2.5])
    own = nominal.copy()
    system = augment_parameters(
        driven, scaled, n=2, p=1, m=1, nominal=own, estimated=estimated, noises=Box(-1.0, 1.0),
        states=Box([-9.0, -9.0], [9.0, 8.0]),
    )
    own[:] = np.nan  # the system has taken a copy, and pickles
    system = pickle.loads(pickle.dumps(system))
    assert (system.n, system.m) == (2 + len(order), 1)
    assert system.states.upper.tolist() == [9.0, 8.0] + [np.inf] * len(order)
    z, u = generator.uniform(0.5, 1.5, (7, system.n)), generator.normal(size=(7, 1))
    theta = np.tile(nominal, (7, 1))
    theta[:, order] = z[:, 2:]
    ahead = np.hstack((driven(z[:, :2], u, theta), theta[:, order]))
    np.testing.assert_allclose(system.f.batch(z, u), ahead, rtol=1e-15)
    np.testing.assert_allclose(system.h.batch(z, u), scaled(z[:, :2], u, theta), rtol=1e-15)
    jacobian = system.f_jacobian.batch(z, u)
    np.testing.assert_array_equal(jacobian[:, 2:], np.tile(np.eye(system.n)[2:], (7, 1, 1)))
    if 0 in order:
        np.testing.assert_allclose(jacobian[:, 0, 2 + order.index(0)], z[:, 0], rtol=1e-12)


@pytest.mark.parametrize(
    ("states", "bounds"),
    [
        (None, None), (Box([-1.0, -np.inf], [1.0, 2.0]), None),
        (Polytope([[1.0, 1.0]], [1.0]), Box([0.0], [4.0])),
        (Box([-1.0, -1.0], [1.0, 2.0]), Polytope([[2.0], [-1.0]], [8.0, 0.0])),
    ],
)
def test_sets_are_products(states, bounds):
    system = augment_parameters(
        spring, position, n=2, p=1, nominal=NOMINAL, estimated=[0], states=states,
        disturbances=states, noises=Box([-1.0], [1.0]), parameter_bounds=bounds,
    )

    def miss(one, point):
        return 0.0 if one is None else one.violation(point)

    assert (system.states is None) is (states is None and bounds is None)
    for z in np.random.default_rng(2).normal(scale=3.0, size=(200, 3)):
        known = miss(states, z[:2])
        assert miss(system.states, z) == pytest.approx(max(known, miss(bounds, z[2:])))
        assert system.disturbances.violation(z) == pytest.approx(max(known, abs(z[2])))
    assert 2 in system.disturbances.fixed_components
    assert system.noises.upper == 1.0


# Bad input


def build(f=spring, h=position, **changes):
    return augment_parameters(f, h, **{"n": 2, "p": 1, "nominal": NOMINAL, **changes})


def careless(x, theta):
    theta[0] = 1.0
    return x


WRONG = [
    ({"nominal": []}, "ShapeError", r"shape \(0,\); expected \(k,\)"),
    ({"nominal": [None, 1.0]}, "InvalidInputError",
     r"nominal\[0\] is nan: the parameter has no prior value"),
    ({"nominal": [2.0]}, "ModelError", r"IndexError.*theta = \[2.0\].*Check nominal"),
    ({"estimated": [-1]}, "InvalidInputError", "names parameter -1; expected .* 0 to 1"),
    ({"estimated": [1, 1]}, "InvalidInputError", r"\[1, 1\], which names one parameter twice"),
    ({"estimated": [0.0]}, "InvalidInputError", r"\[0.0\]; expected indices"),
    ({"estimated": [True]}, "ShapeError", r"mask of shape \(1,\); expected \(2,\)"),
    ({"disturbances": Box([0.0], [1.0])}, "SetError",
     "disturbances has dimension 1; expected 2, the dimension of x alone"),
    ({"parameter_bounds": Box([0.0], [9.0])}, "SetError",
     "parameter_bounds has dimension 1; expected 2"),
    ({"parameter_bounds": Box([0.0, 1.0], [9.0, 9.0])}, "SetError",
     r"nominal is \[2.0, 0.8\].*outside parameter_bounds"),
    ({"parameter_bounds": Box([0.0] * 2, [9.0] * 2).soften(linear=1.0)}, "SetError",
     "is soft; an augmented model takes only hard sets"),
    ({"parameter_bounds": Box([0.0], [9.0]), "estimated": []}, "SetError",
     "parameter_bounds was given, but no parameter is estimated"),
    ({"f": lambda x: x}, "ModelError", r"cannot be called as f\(x, theta\).*no inputs"),
    ({"f": 3.0}, "ModelError", "f is 3.0; expected a function"),
    ({"m": 1}, "ModelError", r"f\(x, theta\) cannot be called as f\(x, u, theta\).*1 inputs"),
    ({"h": lambda x, theta: x}, "ModelError", r"h returned shape \(2,\).*expected \(1,\)"),
    ({"f": careless}, "ModelError", "changes its argument in place"),
    ({"method": "rk4"}, "OptionError", "method is 'rk4', but dt is missing"),
    ({"drifting": "yes"}, "OptionError", "drifting is 'yes'; expected True or False"),
]


def test_wrong_arguments_are_named():
    for changes, error, words in WRONG:
        with pytest.raises(getattr(qpmhe.errors, error), match=words):
            build(**changes)

def test_functions_are_tried_within_the_bounds():
    def narrow(x, theta):
        if np.any(np.abs(np.real(theta) - 10.25) > 0.01 + 1e-4):
            raise ValueError("no such substance")
        return theta[0] * x

    system = augment_parameters(
        narrow, lambda x, theta: x, n=1, p=1, nominal=[10.25],
        parameter_bounds=Box([10.24], [10.26]),
    )
    assert system.f_jacobian.method == "complex step"
