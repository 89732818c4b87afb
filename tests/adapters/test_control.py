"""Systems of python-control, and estimators as blocks in its own simulations."""

import pickle

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import qpmhe
from qpmhe import System, from_control
from qpmhe.errors import InvalidInputError, ModelError, OptionError
from tests.adapters.twins import same

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


def nonlinear(f, h=angle, **options):
    return control.NonlinearIOSystem(f, h, **{"inputs": 1, "outputs": 1, "states": 2} | options)


def test_a_linear_system_is_sampled_exactly_discretised_or_taken_as_it_is():
    plant = control.ss(A, B, C, D)
    ad, bd, *_ = cont2discrete((A, B, C, D), 0.1, "zoh")
    exact = from_control(plant, dt=0.1, states=qpmhe.Box([-5, -5], [5, 5]))
    same(pickle.loads(pickle.dumps(exact)), linear(ad, bd), POINTS, INPUTS)
    for method in ("euler", "rk4"):
        plain = System.from_ode(
            linear(A, B).f, linear(A, B).h, dt=0.1, n=2, p=1, m=1, method=method)
        same(from_control(plant, dt=0.1, method=method), plain, POINTS, INPUTS)
    for dt in (True, 0.1):
        same(from_control(control.ss(0.5 * A, B, C, D, dt)), linear(0.5 * A, B), POINTS, INPUTS)

    def update(t, x, u, params):
        assert t == pytest.approx(round(t))  # asked at its own times only
        return 0.5 * np.sqrt(x - 0.7)  # not a number at some probes, at all times

    system = from_control(nonlinear(update, inputs=0, dt=True))
    assert system.m == 0
    found = system.f.batch(1.0 + POINTS**2, np.empty((7, 0)))
    np.testing.assert_allclose(found, 0.5 * np.sqrt(0.3 + POINTS**2))


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
        (lambda: control.ss(A, B, C, D, 0.1), {"dt": 0.2}, OptionError, "leave it out"),
    ],
)
def test_what_does_not_fit_is_refused(made, options, error, words):
    with pytest.raises(error, match=words):
        from_control(made(), **options)


@pytest.mark.parametrize(("change", "dt", "at"), [
    (lambda t: 1e-9 * t, 0, "at time 0 and"), (lambda t: float(t % 0.125 > 0.03), 0, "at time 0"),
    (lambda t: float(t > 12.0), 0, "at time 0"), (lambda t: [0.0] * int(t < 0.3), 0, "at time 0"),
    (lambda t: float(t > 0.0), 0.1, r"at time 0\.1"),
], ids=["slowly", "periodic", "once", "table", "map"])  # fmt: skip
def test_a_system_that_depends_on_time_is_refused(change, dt, at):
    changed = [lambda *given, g=one: g(*given) + change(given[0]) for one in (swing, angle)]
    for where, functions in (("dynamics", (changed[0], angle)), ("output", (swing, changed[1]))):
        with pytest.raises(ModelError, match=rf"the {where} of .*{at}.*time-invariant"):
            from_control(nonlinear(*functions, dt=dt), dt=None if dt else 0.125)


F, G = np.array([[1.0, 0.1], [0.2, 0.95]]), np.array([[0.0], [0.1]])
FEEDBACK, OUTPUT = np.array([[8.0, 6.0]]), np.array([[1.0, 0.0]])
START, GUESS = np.array([1.0, -0.5]), np.array([0.4, 0.2])
NOISES = 0.02 * np.random.default_rng(5).standard_normal((60, 1))


def estimator(system=None, **options):
    system = from_control(control.ss(F, G, OUTPUT, 0, 0.1)) if system is None else system
    covariances = {"prior": np.eye(2), "disturbance": 1e-3 * np.eye(2), "noise": 4e-4 * np.eye(1)}
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**covariances),
        qpmhe.QuadraticCost.from_covariances(**covariances), horizon=8, initial_state=GUESS,
        **options,
    )


@pytest.mark.parametrize("engine", ["python", "auto"])
def test_a_closed_loop_is_a_plain_loop_and_starts_anew(engine):
    plant = control.ss(F, G, OUTPUT, 0, 0.1, name="plant", inputs=["u[0]"], outputs=["clean"])
    noise = control.summing_junction(["clean", "v"], "y[0]", name="noise", dt=0.1)
    law = control.ss([], [], [], -FEEDBACK, 0.1, name="law", inputs=["xhat[0]", "xhat[1]"],
                     outputs=["u[0]"])
    block = qpmhe.to_iosystem(estimator(engine=engine), dt=0.1)
    loop = control.interconnect(
        [plant, noise, law, block], inputs=["v"],
        outputs=["clean", "u[0]", "xhat[0]", "xhat[1]"], dt=0.1,
    )
    x, rows, mhe = START, [], estimator(engine=engine)
    for v in NOISES:
        u = -FEEDBACK @ mhe.state
        rows.append([*(OUTPUT @ x), *u, *mhe.state])
        mhe.update(OUTPUT @ x + v, u)
        x = F @ x + G @ u
    time = 0.1 * np.arange(len(NOISES))
    for guess in (GUESS, GUESS + 0.3, GUESS):
        answer = control.input_output_response(
            loop, time, NOISES.T, np.concatenate([START, guess])).outputs
        np.testing.assert_array_equal(answer[2:, 0], guess)
    np.testing.assert_allclose(answer, np.transpose(rows), rtol=1e-9, atol=1e-12)


def test_a_block_takes_missing_measurements_and_repeated_calls():
    mhe, other = estimator(), estimator()
    block, x = qpmhe.to_iosystem(mhe), GUESS
    for t, y in enumerate([0.7, np.nan, 0.6]):
        before = x
        for _ in range(2):  # a second call is not another sample
            x = block.dynamics(t, before, [y, 0.1])
            assert mhe.time == t + 1
        np.testing.assert_array_equal(x, other.update([y], [0.1]).state)
    # Another state than its own resets it.
    other.reset(GUESS)
    again = block.dynamics(3, GUESS, [0.7, 0.1])
    np.testing.assert_array_equal(again, other.update([0.7], [0.1]).state)
    assert mhe.time == 1


def test_labels_and_options_of_a_block():
    mhe = estimator(System.from_ode(lambda x, u: u - x, lambda x: x[..., :1], dt=0.2, n=2, p=1,
                                    m=1))
    block = qpmhe.to_iosystem(
        mhe, name="level", measurement_labels=["h"], control_labels="pump", estimate_labels="x{i}"
    )
    assert (block.dt, block.name) == (0.2, "level")
    assert (block.input_labels, block.output_labels) == (["h", "pump"], ["x0", "x1"])
    for options, words in (
        ({"dt": 0.1}, r"dt is 0\.1, but the system has 0\.2"),
        ({"measurement_labels": ["a", "b"]}, "measurement_labels is"),
        ({"estimate_labels": "x"}, "estimate_labels is 'x'; expected 2 different names"),
    ):
        with pytest.raises(OptionError, match=words):
            qpmhe.to_iosystem(mhe, **options)
    with pytest.raises(InvalidInputError, match="mhe is a System"):
        qpmhe.to_iosystem(mhe.system)


@pytest.mark.slow
def test_a_block_outputs_the_prediction_as_python_controls_own_does():
    """Neither sees y(t); `filtered` does, one sample earlier."""
    optimal = pytest.importorskip("control.optimal")
    Q, R = np.diag([1e-3, 1e-2]), np.array([[0.1]])
    plant = control.ss(F, np.eye(2), OUTPUT, 0, True)
    problem = optimal.OptimalEstimationProblem(
        plant, np.arange(5), optimal.gaussian_likelihood_cost(plant, Q, R),
        terminal_cost=lambda x, prior: (x - prior) @ (x - prior), disturbance_indices=[0, 1],
    )
    mhe = qpmhe.MovingHorizonEstimator(
        from_control(control.ss(F, np.zeros((2, 1)), OUTPUT, 0, True)),
        qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=Q, noise=R),
        qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=R), horizon=5,
        initial_state=[0.0, 0.0],
    )
    times, at = np.arange(12), 8
    y = 1.0 + 0.1 * np.sin(times)
    records = y, y + 0.5 * (times == at)
    ours, zero = qpmhe.to_iosystem(mhe), np.zeros(12)
    for block, signals in (
        (problem.create_mhe_iosystem(), list), (ours, lambda y: np.array([y, zero]))
    ):
        one, other = (
            control.input_output_response(block, times, signals(each)).outputs for each in records
        )
        np.testing.assert_array_equal(one[:, : at + 1], other[:, : at + 1])
        assert np.abs(one - other)[0, at + 1] > 0.1
    runs = []
    for each in records:
        mhe.reset([0.0, 0.0])
        runs.append(mhe.run(each[:, None], zero[:, None]))
    np.testing.assert_array_equal(runs[1].states[:12].T, other)
    changed = np.abs(runs[1].filtered - runs[0].filtered)[:, 0]
    assert changed[at - 1] == 0.0 < 0.1 < changed[at]
