"""Observers: their gains and covariances, and what they refuse."""

import numpy as np
import pytest
from scipy.linalg import expm

import qpmhe
from qpmhe import Status
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError
from qpmhe.observers import (
    ExtendedKalman,
    HighGain,
    Luenberger,
    OutputInjection,
    Sample,
    SteadyStateKalman,
    UnscentedKalman,
    design_luenberger,
)
from tests.estimation.plain import spd
from tests.estimation.spoil import check, observer_alone
from tests.estimation.systems import linear

DT = 0.05
NONE = np.zeros(0)


class Plant:
    """A random observable linear system with dense covariances."""

    def __init__(self, seed, n=3, p=2, radius=1.05):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((n, n))
        self.A = a * (radius / np.abs(np.linalg.eigvals(a)).max())
        self.C, self.start = rng.standard_normal((p, n)), rng.standard_normal(n)
        self.P = spd(rng, n)
        self.covariances = {"disturbance": spd(rng, n), "noise": spd(rng, p)}
        self.system = linear(self.A, self.C)

    def sample(self, P):
        return Sample(self.system, NONE, self.A, self.C, covariance=P)


def poles_of(matrix):
    return np.sort_complex(np.linalg.eigvals(matrix))


def test_output_injection():
    system, start = linear(0.5 * np.eye(2), np.eye(2)), [1.0, -2.0]
    injection = OutputInjection(lambda z, v: [0.1 * v[0] - v[1], 0.3 * v[1]])
    listed = observer_alone(system, injection, start)
    matrix = observer_alone(system, Luenberger([[0.1, -1.0], [0.0, 0.3]]), start)
    Y = np.random.default_rng(2).standard_normal((9, 2))
    np.testing.assert_allclose(listed.run(Y).states, matrix.run(Y).states, rtol=1e-13, atol=1e-15)
    nothing = "L(z, 0) = 0"
    for correction, text in (
        (lambda z, v: v + 0.01 * z, ["0.01", nothing]),
        (lambda z, v: v / np.linalg.norm(v), ["nan", nothing]),
        (lambda z, v: 0.1 * v[:, None], ["correction returned shape (2, 1)", "(2,)"]),
        (lambda z, v: [][0], ["IndexError: ", "at z = [1.0, -2.0]"]),
        (lambda z, v: np.multiply(0.5, v, out=v), ["in place"]),
    ):
        check(ModelError, text, observer_alone, system, OutputInjection(correction), start)
    check(ModelError, ["correction is 0.3; expected a function"], OutputInjection, 0.3)


# Kalman-type observers


def test_the_steady_gain_is_the_limit_of_the_extended_kalman_observer():
    for n, p, radius in ((1, 1, 1.2), (2, 1, 0.7), (4, 3, 1.0)):
        plant = Plant(n, n, p, radius)
        steady = SteadyStateKalman(plant.system, plant.start, **plant.covariances)
        moving, P = ExtendedKalman(prior=plant.P, **plant.covariances), plant.P
        for _ in range(400):
            _, P = moving.correct(plant.start, np.zeros(p), plant.sample(P))
        gain = [moving.correct(plant.start, v, plant.sample(P))[0] for v in np.eye(p)]
        np.testing.assert_allclose(steady.gain, np.transpose(gain), rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(steady.covariance, P, rtol=1e-8)
        designed = design_luenberger(plant.system, plant.start, **plant.covariances)
        np.testing.assert_array_equal(steady.gain, designed.gain)


def test_sigma_points_stay_within_the_bounds():
    # A model that ends where the bounds do. Torricelli: the tank's outflow is a root.
    def f(x):
        return x - 0.05 * np.sqrt(x - 1.0) + 0.04

    observer = UnscentedKalman(prior=[[1.0]], disturbance=[[1e-3]], noise=[[0.1]])
    Y = 1.5 + 0.3 * np.random.default_rng(1).standard_normal(60)
    for states, fails in ((qpmhe.Box([1.0], [np.inf]), False), (None, True)):
        system = qpmhe.System(f, lambda x: x, n=1, p=1, states=states)
        run = observer_alone(system, observer, [1.1]).run(Y)
        assert (run.share(Status.OBSERVER_RESET) > 0) == fails

# Designed gains


def test_poles_are_placed_as_asked():
    for p, poles in (
        (2, [0.3]), (2, [0.4, 0.4]), (1, [0.0, 0.0, 0.0]), (1, [0.6, 0.6, -0.2]),
        (2, [0.3 - 0.6j, 0.9, 0.3 + 0.6j, -0.5]),
    ):
        plant = Plant(20 + len(poles) + p, len(poles), p)
        gain = design_luenberger(plant.system, plant.start, poles=poles).gain
        placed = np.poly(plant.A - gain @ plant.C)
        np.testing.assert_allclose(placed, np.poly(poles).real, rtol=0, atol=1e-8)
    # Two outputs that say the same are one.
    A, C = np.eye(3) + 0.1 * np.eye(3, k=1), np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    gain = design_luenberger(linear(A, C), np.zeros(3), poles=[0.3, 0.4, 0.5]).gain
    np.testing.assert_allclose(poles_of(A - gain @ C), [0.3, 0.4, 0.5], atol=1e-8)
    # An unobservable mode that decays is left alone.
    A, C = np.array([[1.1, 0.0], [0.3, 0.5]]), np.eye(1, 2)
    gain = design_luenberger(linear(A, C), [0.0, 0.0], disturbance=np.eye(2), noise=1.0).gain
    poles = poles_of(A - gain @ C)
    assert np.abs(poles).max() < 1
    assert np.abs(poles - 0.5).min() < 1e-12


def test_a_hidden_mode_is_named_in_any_coordinates():
    # The first state shows the second, and neither shows the others.
    hidden = np.array([
        [0.9, 0.3, 0.0, 0.0], [0.0, 0.8, 0.0, 0.0], [0.2, 0.4, 1.25, 0.0], [0.1, 0.0, 0.5, 0.7]
    ])
    T = np.random.default_rng(0).standard_normal((4, 4))
    system = linear(T @ hidden @ np.linalg.inv(T), np.eye(1, 4) @ np.linalg.inv(T))
    with pytest.raises(ModelError, match=r"not detectable: .* eigenvalue 1\.25, which does"):
        design_luenberger(system, np.zeros(4), disturbance=np.eye(4), noise=[[1.0]])
    with pytest.raises(ModelError, match=r"not observable: .* (1\.25, 0\.7|0\.7, 1\.25), and"):
        design_luenberger(system, np.zeros(4), poles=[0.1, 0.2, 0.3, 0.4])


def test_designs_that_cannot_be():
    for options, kind, text in (
        ({}, OptionError, ["given: none of them; expected either the poles, or"]),
        ({"poles": [0.1, 1.0]}, OptionError, ["poles 1 do not lie inside the unit", "exp(s dt)"]),
        ({"poles": [0.5j, 0.5j]}, OptionError, ["poles is ", "complex poles in conjugate"]),
        ({"poles": [0.5] * 3, "system": Plant(23).system, "at": np.zeros(3)}, OptionError,
         ["pole 0.5 is given 3 times", "rank C = 2 times"]),
        ({"poles": np.linspace(0.1, 0.6, 6), "at": np.zeros(6),
          "system": linear(np.eye(6) + 1e-4 * np.eye(6, k=1), np.eye(1, 6) + 0.3)},
         ModelError, ["come out as ", "instead of ", "too ill-conditioned"]),
    ):
        given = {"system": linear([[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]]), "at": [0.0, 0.0]}
        check(kind, text, design_luenberger, **given | options)


def chain(n, step, sampling="exact"):
    shift = step * np.eye(n, k=1)
    return expm(shift) if sampling == "exact" else np.eye(n) + shift


def test_high_gain_gives_the_chain_the_sampled_poles():
    for n, epsilon, sampling in ((1, 0.2, "exact"), (3, 0.2, "euler"), (4, 0.2, "exact")):
        coefficients = np.poly(-np.arange(1.0, n + 1))[1:]
        options = {"coefficients": coefficients, "sampling": sampling}
        gain = HighGain(n, epsilon=epsilon, dt=DT, **options).gain
        expected = np.exp(-np.arange(n, 0.0, -1) * DT / epsilon)
        found = poles_of(chain(n, DT, sampling) - gain @ np.eye(1, n))
        np.testing.assert_allclose(found, expected, atol=1e-6)
    fast = HighGain(3, epsilon=1e-9, dt=DT).gain
    error = np.linalg.matrix_power(chain(3, DT) - fast @ np.eye(1, 3), 3)
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_high_gain_observers_that_make_no_sense():
    options = {"epsilon": 0.1, "dt": 2 * DT}
    text = ["real part 1", "roots in the left"]
    check(OptionError, text, HighGain, 2, coefficients=[-2.0, 1.0], **options)
    observer = HighGain(2, **options)
    timed = qpmhe.System.from_ode(lambda x: -x, lambda x: x[..., :1], dt=DT, n=2, p=1)
    for system, kind, text in (
        (linear(np.eye(2), np.eye(2)), ShapeError, ["the system has 2 outputs; expected 1"]),
        (linear(np.eye(3), np.eye(1, 3)), ShapeError, ["is for n = 2; expected 3 states"]),
        (linear(chain(2, DT), [[-1.0, 0.0]]), ModelError, ["C is [[-1.0, 0.0]]"]),
        (timed, InvalidInputError, ["dt of the high-gain observer is 0.1; expected 0.05"]),
    ):
        check(kind, text, observer_alone, system, observer, np.zeros(system.n))


def test_an_observer_that_starts_again_has_the_state_that_it_starts_from():
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])

    def f(x):
        if x[0] > 50.0:
            raise ValueError("too hot")
        return A @ x

    system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
    mhe = observer_alone(system, Luenberger([[0.4], [0.1]]), [1.0, -1.0], horizon=2, max_qps=3)
    mhe.run([0.5, 200.0])
    failed = mhe.update(0.5)
    assert Status.MODEL_FAILED in failed.status
    expected = failed.state if failed.improved else failed.candidate[-1]
    np.testing.assert_array_equal(failed.observer_state, expected)
    np.testing.assert_array_equal(mhe.update(0.4).candidate[-2], expected)
