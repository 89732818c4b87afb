"""Steps of numerical derivatives, and comparisons with them, in any unit."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError, OptionError, ShapeError

from .untraced import untraced

NONE = np.zeros(0)


def estimator(system, deviation, gain, start, noise=1.0, **options):
    """Costs in the unit of the deviation."""
    prior = deviation**2 * np.eye(system.n)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=prior, disturbance=prior / 100.0, noise=noise
    )
    observer = gain if isinstance(gain, qpmhe.Observer) else qpmhe.Luenberger(gain)
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=3, initial_state=start, **options
    )


def uptake(km, slope=None):
    """Two concentrations, one of which is taken up with the constant Km."""

    def f(x):
        rate = x[0] / (km + x[0])
        return np.array([x[0] - 0.1 * km * rate, 0.9 * x[1] + 0.1 * km * rate])

    def jacobian(x):
        steep = 0.1 * km * km / (km + x[0]) ** 2 if slope is None else slope
        return np.array([[1.0 - steep, 0.0], [steep, 0.9]])

    return f, jacobian


@pytest.mark.parametrize("km", [5e-9, 1.0, 5e9])
def test_given_jacobians_are_compared_in_any_unit(km):
    f, jacobian = uptake(km)
    system = qpmhe.System(f, lambda x: x[:1], n=2, p=1, f_jacobian=jacobian)
    for start in (0.0, 0.3, 2.0):
        mhe = estimator(system, km, [0.3, 0.1], [start * km, km], 0.01 * km**2)
        assert np.isfinite(mhe.update([0.5 * km]).state).all()
    f, jacobian = uptake(km, slope=0.05)
    options = {"n": 2, "p": 1, "f_jacobian": jacobian}
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\] is 0\.95 at .* leave it out"):
        estimator(qpmhe.System(f, lambda x: x[:1], **options), km, [0.3, 0.1], [km, km])
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\]"):
        qpmhe.System(f, lambda x: x[:1], **options, scales=[km, km])


def test_a_wrong_jacobian_of_the_rate_is_named_by_the_estimator():
    system = qpmhe.System.from_ode(
        lambda x: -x**2, lambda x: x, dt=1e-3, n=1, p=1, rate_jacobian=lambda x: -np.diag(x)
    )
    with pytest.raises(ModelError, match=r"rate_jacobian\[0, 0\] is "):
        estimator(system, 1.0, [0.3], [0.5])


def test_scales_that_the_user_gave():
    system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1, scales=[3.0])
    system.use_scales([5.0])
    np.testing.assert_array_equal(system.scales, [3.0])
    for scales, error in (
        ([0.0, 1.0], OptionError), ([1.0, -1.0], OptionError), ([1.0], ShapeError),
        ([1.0, np.nan], InvalidInputError), ("ab", InvalidInputError),
    ):
        with pytest.raises(error, match="scales"):
            qpmhe.System(lambda x: x, lambda x: x, n=2, p=2, scales=scales)
        with pytest.raises(error, match="scales"):
            qpmhe.System.from_ode(lambda x: x, lambda x: x, dt=0.1, n=2, p=2, scales=scales)


# Differences


@pytest.mark.parametrize("unit", [1e-6, 1.0])
def test_differences_at_a_bound_go_inwards(unit):
    def f(x):
        """Defined for x >= 0 alone, and for real numbers alone."""
        a, b = x / unit
        return [unit * (0.5 * math.sqrt(a) * a + 0.1 * b), unit * (b**1.5 + math.sqrt(a) * a)]

    system = qpmhe.System(
        f, lambda x: x[:1], n=2, p=1, states=qpmhe.Box([0.0, 0.0], [np.inf, np.inf]),
        scales=[unit, unit],
    )
    for share in (0.0, 1e-12, 1e-7, 0.1):
        for a, b in ((share, 1.0), (1.0, share), (share, share)):
            np.testing.assert_allclose(
                system.f_jacobian(unit * np.array([a, b]), NONE),
                [[0.75 * math.sqrt(a), 0.1], [1.5 * math.sqrt(a), 1.5 * math.sqrt(b)]],
                rtol=1e-6, atol=5e-3,  # of a root of a third order, a quotient of second order
            )


def test_differences_at_an_upper_bound_are_of_second_order():
    def f(x):
        if x[0] > 1.0:
            raise ValueError("beyond the bound")
        return [math.exp(float(x[0]))]

    def slopes(lower, points):
        box = qpmhe.Box([lower], [1.0])  # if narrower than a step, it is left
        function = f if lower < 1.0 else lambda x: [math.exp(float(x[0]))]
        system = qpmhe.System(function, lambda x: x, n=1, p=1, states=box, scales=[1.0])
        points = np.array(points)[:, None]
        single = [system.f_jacobian(x, NONE) for x in points]
        np.testing.assert_array_equal(
            system.f_jacobian.batch(points, np.zeros((len(points), 0))), single
        )
        np.testing.assert_allclose(np.ravel(single), np.exp(points[:, 0]), rtol=1e-9)

    slopes(-1.0, [1.0, 1.0 - 1e-9, 0.5, -1.0])
    slopes(1.0, [1.0])


def test_an_estimator_on_a_bound_needs_no_model_beyond_it():
    system = qpmhe.System(
        untraced(lambda x: [0.9 * x[0] + 0.1 * x[0] * math.sqrt(x[0])]), lambda x: x, n=1, p=1,
        states=qpmhe.Box([0.0], [np.inf]),
    )
    # Nor does the test of a correction.
    observer = qpmhe.OutputInjection(lambda z, v: 0.1 * v * math.sqrt(z[0]))
    for gain in ([0.5], observer):
        estimate = estimator(system, 0.1, gain, [0.0], 0.01).update([0.2])
        assert estimate.improved, estimate.message
        assert not estimate.message


# Observers


def oscillator_in(units, **options):
    """The same oscillator, its states and its output in these units."""
    one, two, out = units

    def f(x):
        a, b = x[0] / one, x[1] / two
        return np.array([(a + 0.1 * b) * one, (b - 0.1 * np.sin(a) - 0.02 * b) * two])

    return qpmhe.System(f, lambda x: x[:1] / one * out, n=2, p=1, **options)


def designs(units, **options):
    """Gains and the stationary covariance, in units of 1."""
    system, states, out = oscillator_in(units, **options), np.array(units[:2]), units[2]
    q, r = np.array([[0.01, 0.004], [0.004, 0.02]]), np.array([[0.1]])
    covariances = {"disturbance": q * np.outer(states, states), "noise": r * out**2}
    at = states * [0.1, 0.2]
    steady = qpmhe.SteadyStateKalman(system, at, **covariances)
    gains = [
        qpmhe.design_luenberger(system, at, **given).gain
        for given in ({"poles": [0.5, 0.6]}, covariances)
    ]
    in_ones = [gain * out / states[:, None] for gain in (steady.gain, *gains)]
    return [steady.covariance / np.outer(states, states), *in_ones]


def test_designed_gains_in_any_unit():
    best = designs((1.0, 1.0, 1.0))
    for units in ((1e-9, 1e9, 1e-6), (1e6, 1.0, 1e9), (1.0, 1e-9, 1e-9)):
        for found, expected in zip(designs(units, scales=units[:2]), best, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-7)
    generator = np.random.default_rng(7)
    for _ in range(5):  # the stationary filter to the bit
        found = designs(2.0 ** generator.integers(-30, 31, 3))
        np.testing.assert_array_equal(found[0], best[0])
        np.testing.assert_array_equal(found[1], best[1])
    high = qpmhe.HighGain(4, epsilon=0.3, dt=0.07).gain
    for unit in (2.0**-30, 2.0**20):
        found = qpmhe.HighGain(4, epsilon=0.3 * unit, dt=0.07 * unit).gain
        np.testing.assert_array_equal(found * unit ** np.arange(4)[:, None], high)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_correction_is_tried_near_the_start_in_any_unit(unit):
    def correction(z, v):
        # Defined near 3 units alone, and far from fits it would write into v.
        assert abs(z[0] / unit - 3.0) < 2.0
        if abs(v[0]) > 100.0 * unit:
            v[0] = 0.0
        return 0.2 * v

    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    start = [3.0 * unit]
    mhe = estimator(system, unit, qpmhe.OutputInjection(correction), start, unit**2)
    assert np.isfinite(mhe.update([3.1 * unit]).state).all()
    wrong = qpmhe.OutputInjection(lambda z, v: 0.2 * v + (z - 3.0 * unit))
    with pytest.raises(ModelError, match=r"must satisfy L\(z, 0\) = 0"):
        estimator(system, unit, wrong, start, unit**2)
