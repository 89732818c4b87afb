"""What only python-control's systems have: linear ones, sampling, dependence on time."""

import pickle

import numpy as np
import pytest
from scipy.signal import cont2discrete

import qpmhe
from adapters.twins import same
from qpmhe import System, from_control
from qpmhe.errors import InvalidInputError, ModelError, OptionError

control = pytest.importorskip("control")

A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B, C, D = np.array([[0.0], [1.5]]), np.array([[1.0, 0.2]]), np.array([[0.4]])
POINTS = np.random.default_rng(0).standard_normal((7, 2))
INPUTS = np.random.default_rng(1).standard_normal((7, 1))


def swing(t, x, u, params):
    return np.array([x[1], -np.sin(x[0]) - 0.1 * x[1] + u[0]])


def angle(t, x, u, params):
    return np.array([x[0]])


def linear(a, b):
    return System(
        lambda x, u: x @ a.T + u @ b.T, lambda x, u: x @ C.T + u @ D.T, n=2, p=1, m=1
    )


def test_a_linear_system_in_continuous_time_is_sampled_exactly():
    ad, bd, *_ = cont2discrete((A, B, C, D), 0.1, "zoh")
    same(from_control(control.ss(A, B, C, D), dt=0.1), linear(ad, bd), POINTS, INPUTS)


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_a_linear_system_is_discretised_like_any_rate(method):
    plain = System.from_ode(
        lambda x, u: x @ A.T + u @ B.T, lambda x, u: x @ C.T + u @ D.T, dt=0.1, n=2, p=1, m=1,
        method=method,
    )
    same(from_control(control.ss(A, B, C, D), dt=0.1, method=method), plain, POINTS, INPUTS)


@pytest.mark.parametrize("dt", [True, 0.1])
def test_a_linear_system_in_discrete_time_is_taken_as_it_is(dt):
    same(from_control(control.ss(0.5 * A, B, C, D, dt)), linear(0.5 * A, B), POINTS, INPUTS)


def test_a_nonlinear_system_in_discrete_time_without_inputs():
    theirs = control.NonlinearIOSystem(
        lambda t, x, u, params: 0.9 * np.sin(x), lambda t, x, u, params: x[:1],
        inputs=0, outputs=1, states=2, dt=True,
    )
    system = from_control(theirs)
    assert system.m == 0
    np.testing.assert_allclose(system.f.batch(POINTS, np.empty((7, 0))), 0.9 * np.sin(POINTS))


def test_an_estimator_runs_on_it_and_it_pickles():
    system = from_control(
        control.ss(A, B, C, 0), dt=0.1, states=qpmhe.Box([-5, -5], [5, 5])
    )
    copy = pickle.loads(pickle.dumps(system))
    same(copy, system, POINTS, INPUTS)
    assert repr(copy.states) == repr(system.states)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.2]),
        qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=[[1.0]]),
        horizon=5, initial_state=[0, 0],
    )
    assert mhe.update([1.0], [0.0]).improved


def rotating():
    """With a complex matrix, which python-control takes in an existing system only."""
    plant = control.ss(A, B, C, D)
    plant.A = A + 1j
    return plant


@pytest.mark.parametrize(
    ("made", "options", "error", "words"),
    [
        (lambda: control.tf([1], [1, 1]), {}, ModelError, "control.ss"),
        (lambda: control.ss([], [], [], [[1.0]]), {}, ModelError, "no states"),
        (rotating, {"dt": 0.1}, ModelError, "A of the .*imaginary"),
        (lambda: control.ss(A, B, C, np.inf), {"dt": 0.1}, InvalidInputError, "D of the system"),
        (lambda: control.ss(A, B, C, D), {}, OptionError, "dt is missing"),
        (lambda: control.ss(A, B, C, D), {"dt": -1.0}, InvalidInputError, "dt"),
        (lambda: control.ss(A, B, C, D, 0.1), {"dt": 0.2}, OptionError, "leave it out"),
        (lambda: control.ss(A, B, C, D, 0.1), {"method": "rk4"}, OptionError, "discrete"),
        (lambda: control.ss(A, B, C, D), {"dt": 0.1, "method": "foo"}, OptionError, "foo"),
    ],
)
def test_what_does_not_fit_is_refused(made, options, error, words):
    with pytest.raises(error, match=words):
        from_control(made(), **options)


def in_time(change, where):
    """The swing with an update or output that change(t) is added to."""

    def changed(function):
        return lambda t, x, u, params: function(t, x, u, params) + change(t)

    functions = {"dynamics": swing, "output": angle}
    functions[where] = changed(functions[where])
    return functions["dynamics"], functions["output"]


def table(t):
    return [0.0, 0.0, 0.0][int(t / 0.125)]


@pytest.mark.parametrize("where", ["dynamics", "output"])
@pytest.mark.parametrize(
    "change",
    [
        lambda t: 1e-9 * t,
        lambda t: float(t % 0.125 > 0.03),
        lambda t: float(t > 12.0),
        table,
    ],
    ids=["slowly", "periodic", "once", "table"],
)
def test_a_system_that_depends_on_time_is_refused(change, where):
    theirs = control.NonlinearIOSystem(
        *in_time(change, where), inputs=1, outputs=1, states=2
    )
    with pytest.raises(ModelError, match=rf"the {where} of .*at time 0 and .*time-invariant"):
        from_control(theirs, dt=0.125)


def test_a_map_that_depends_on_time_is_refused():
    theirs = control.NonlinearIOSystem(
        *in_time(lambda t: float(t > 0.0), "dynamics"), inputs=1, outputs=1, states=2, dt=0.1
    )
    with pytest.raises(ModelError, match=r"dynamics of .*at time 0\.1"):
        from_control(theirs)


def test_a_map_is_asked_at_its_own_times_only():
    def update(t, x, u, params):
        assert t == pytest.approx(round(t))
        return 0.5 * np.sqrt(x - 0.7)  # not a number at some probes, at all times

    theirs = control.NonlinearIOSystem(update, angle, inputs=1, outputs=1, states=2, dt=True)
    assert from_control(theirs).n == 2
