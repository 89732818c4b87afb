"""Steps of numerical derivatives, and comparisons with them, in any unit."""

import math

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import ModelError, OptionError, ShapeError

NONE = np.zeros(0)


def cost_of(deviations, noise=1.0):
    return qpmhe.QuadraticCost.from_covariances(
        prior=np.diag(np.square(deviations)), disturbance=np.diag(np.square(deviations)) / 100.0,
        noise=noise,
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
@pytest.mark.parametrize("start", [0.0, 0.3, 2.0])
def test_a_right_jacobian_is_used_in_any_unit(km, start):
    f, jacobian = uptake(km)
    system = qpmhe.System(f, lambda x: x[:1], n=2, p=1, f_jacobian=jacobian)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.1]), cost_of([km, km], 0.01 * km**2), horizon=3,
        initial_state=[start * km, km],
    )
    estimate = mhe.update([0.5 * km])
    assert np.isfinite(estimate.state).all()


@pytest.mark.parametrize("km", [5e-9, 1.0, 5e9])
def test_a_wrong_jacobian_is_refused_in_any_unit(km):
    f, jacobian = uptake(km, slope=0.05)
    system = qpmhe.System(f, lambda x: x[:1], n=2, p=1, f_jacobian=jacobian)
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\] is 0\.95 at .* leave it out"):
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.3, 0.1]), cost_of([km, km]), horizon=3,
            initial_state=[km, km],
        )
    with pytest.raises(ModelError, match=r"f_jacobian\[0, 0\]"):
        qpmhe.System(f, lambda x: x[:1], n=2, p=1, f_jacobian=jacobian, scales=[km, km])


@pytest.mark.parametrize("wide", [1.0, 1e3, 1e6])
def test_a_prior_that_knows_nothing_does_no_harm(wide):
    f, jacobian = uptake(5e-9)
    arguments = {
        "observer": qpmhe.Luenberger([0.3, 0.1]), "cost": cost_of([5e-9 * wide] * 2, 1e-18),
        "horizon": 3, "initial_state": [0.0, 5e-9], "max_qps": None,
    }
    by_steps = qpmhe.System(lambda x: [float(s) for s in f(x)], lambda x: x[:1], n=2, p=1)
    found = [
        qpmhe.MovingHorizonEstimator(system, **arguments).run(np.full(5, 2e-9)).states
        for system in (
            qpmhe.System(f, lambda x: x[:1], n=2, p=1, f_jacobian=jacobian), by_steps
        )
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5)


def test_a_wrong_jacobian_of_the_rate_is_named_by_the_estimator():
    system = qpmhe.System.from_ode(
        lambda x: -x**2, lambda x: x, dt=1e-3, n=1, p=1, rate_jacobian=lambda x: -np.diag(x)
    )
    with pytest.raises(ModelError, match=r"rate_jacobian\[0, 0\] is "):
        qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([0.3]), cost_of([1.0]), horizon=3, initial_state=[0.5]
        )


def test_scales_that_the_user_gave_stay():
    system = qpmhe.System(lambda x: x, lambda x: x, n=1, p=1, scales=[3.0])
    system.use_scales([5.0])
    np.testing.assert_array_equal(system.scales, [3.0])
    assert qpmhe.System(lambda x: x, lambda x: x, n=1, p=1).scales is None


@pytest.mark.parametrize(
    ("scales", "error"),
    [
        ([0.0, 1.0], OptionError), ([1.0, -1.0], OptionError), ([1.0], ShapeError),
        ([1.0, np.nan], qpmhe.errors.InvalidInputError),
        ([1.0, np.inf], qpmhe.errors.InvalidInputError), ("ab", qpmhe.errors.InvalidInputError),
    ],
)
def test_scales_that_are_none(scales, error):
    with pytest.raises(error, match="scales"):
        qpmhe.System(lambda x: x, lambda x: x, n=2, p=2, scales=scales)
    with pytest.raises(error, match="scales"):
        qpmhe.System.from_ode(lambda x: x, lambda x: x, dt=0.1, n=2, p=2, scales=scales)


def smooth(a, b):
    return [a * math.exp(-0.3 * b) + 0.1 * b, b / (1.0 + a * a)]


@pytest.mark.parametrize("real", [False, True], ids=["complex step", "differences"])
def test_powers_of_two_change_not_a_bit_of_a_derivative(real):
    generator = np.random.default_rng(3)
    points = generator.uniform(-2.0, 2.0, (20, 2))
    points[3] = 0.0

    def system_in(units):
        def f(x):
            a, b = (float(s) if real else s for s in x / units)
            if real:
                return np.array(smooth(a, b)) * units
            return np.array([a * np.exp(-0.3 * b) + 0.1 * b, b / (1.0 + a * a)]) * units

        system = qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)
        system.use_scales(np.array([0.7, 3.0]) * units)
        system.check(np.array([0.5, 0.2]) * units, NONE)
        return system

    best = system_in(np.ones(2))
    assert best.f_jacobian.method == ("finite differences" if real else "complex step")
    expected = best.f_jacobian.batch(points, np.zeros((20, 0)))
    for _ in range(10):
        units = 2.0 ** generator.integers(-30, 31, 2)
        system = system_in(units)
        assert system.f_jacobian.method == best.f_jacobian.method
        found = system.f_jacobian.batch(points * units, np.zeros((20, 0)))
        np.testing.assert_array_equal(found, expected * units[:, None] / units)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6])
def test_differences_keep_their_accuracy_where_a_state_passes_zero(unit):
    system = qpmhe.System(
        lambda x: [unit * math.sin(x[0] / unit), x[1] + x[0] * x[1] / unit], lambda x: x[:1],
        n=2, p=1, scales=[unit, unit],
    )
    assert system.f_jacobian.method == "finite differences"
    for a, b in ((0.0, 0.0), (1e-9, 1.0), (0.5, -0.4)):
        np.testing.assert_allclose(
            system.f_jacobian(unit * np.array([a, b]), NONE),
            [[math.cos(a), 0.0], [b, 1.0 + a]], rtol=1e-8, atol=1e-9,
        )


def positive_root(x):
    """Defined for x >= 0 alone, and for real numbers alone."""
    return [0.5 * math.sqrt(x[0]) * x[0] + 0.1 * x[1], math.pow(x[1], 1.5) + math.sqrt(x[0]) * x[0]]


@pytest.mark.parametrize("share", [0.0, 1e-12, 1e-7, 0.1])
@pytest.mark.parametrize("unit", [1e-6, 1.0])
def test_differences_at_a_bound_go_inwards(unit, share):
    def f(x):
        return [unit * value for value in positive_root(x / unit)]

    system = qpmhe.System(
        f, lambda x: x[:1], n=2, p=1, states=qpmhe.Box([0.0, 0.0], [np.inf, np.inf]),
        scales=[unit, unit],
    )
    assert system.f_jacobian.method == "finite differences"
    for x in ([share, 1.0], [1.0, share], [share, share]):
        a, b = x
        np.testing.assert_allclose(
            system.f_jacobian(unit * np.array(x), NONE),
            [[0.75 * math.sqrt(a), 0.1], [1.5 * math.sqrt(a), 1.5 * math.sqrt(b)]],
            rtol=1e-6, atol=5e-3,  # of a root of a third order, a quotient of second order
        )


def test_differences_at_an_upper_bound_are_of_second_order():
    def f(x):
        if x[0] > 1.0:
            raise ValueError("beyond the bound")
        return [math.exp(float(x[0]))]

    system = qpmhe.System(
        f, lambda x: x, n=1, p=1, states=qpmhe.Box([-1.0], [1.0]), scales=[1.0]
    )
    for x in (1.0, 1.0 - 1e-9, 0.5, -1.0):
        np.testing.assert_allclose(
            system.f_jacobian(np.array([x]), NONE), [[math.exp(x)]], rtol=1e-9
        )
    batch = system.f_jacobian.batch(np.array([[1.0], [0.0], [-1.0]]), np.zeros((3, 0)))
    np.testing.assert_allclose(batch[:, 0, 0], np.exp([1.0, 0.0, -1.0]), rtol=1e-9)


def test_a_box_that_is_narrower_than_a_step_is_left():
    system = qpmhe.System(
        lambda x: [math.exp(float(x[0]))], lambda x: x, n=1, p=1,
        states=qpmhe.Box([1.0], [1.0]), scales=[1.0],
    )
    np.testing.assert_allclose(system.f_jacobian(np.ones(1), NONE), [[math.e]], rtol=1e-9)


def test_an_estimator_on_a_bound_needs_no_model_beyond_it():
    system = qpmhe.System(
        lambda x: [0.9 * x[0] + 0.1 * x[0] * math.sqrt(x[0])], lambda x: x, n=1, p=1,
        states=qpmhe.Box([0.0], [np.inf]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost_of([0.1], 0.01), horizon=4, initial_state=[0.0],
    )
    estimate = mhe.update([0.2])
    assert estimate.improved, estimate.message


def test_steps_of_other_lengths_have_the_same_scales():
    system = qpmhe.System.from_ode(
        lambda x: [1e-9 * math.sin(x[0] / 1e-9)], lambda x: x, dt=0.1, n=1, p=1
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost_of([1e-9], 1e-18), horizon=4, initial_state=[0.0],
        max_qps=None,
    )
    mhe.update([1e-9], dt=0.2)
    other = mhe._own_system.timed.f_jacobian(np.zeros(1), np.array([0.2]))
    rk4 = 1.0 + 0.2 + 0.02 + 0.2**3 / 6.0 + 0.2**4 / 24.0
    np.testing.assert_allclose(other, [[rk4]], rtol=1e-8)


def test_a_model_is_called_for_derivatives_as_often_as_before():
    calls = []

    def f(x):
        calls.append(x)
        return [math.sin(x[0]), x[1] * x[0]]

    system = qpmhe.System(f, lambda x: x[:1], n=2, p=1, states=qpmhe.Box([-9.0] * 2, [9.0] * 2))
    system.use_scales([1.0, 1.0])
    calls.clear()
    system.f_jacobian.batch(np.ones((10, 2)), np.zeros((10, 0)))
    assert len(calls) == 40  # two states to each side, at each of ten


# Observers

UNITS = [(1e-9, 1e9, 1e-6), (1e6, 1.0, 1e9), (1.0, 1e-9, 1e-9)]


def oscillator(a, b):
    return [a + 0.1 * b, b - 0.1 * np.sin(a) - 0.02 * b]


def oscillator_in(units, **options):
    """The same oscillator, its states and its output in these units."""
    one, two, out = units

    def f(x):
        a, b = oscillator(x[0] / one, x[1] / two)
        return np.array([a * one, b * two])

    return qpmhe.System(f, lambda x: x[:1] / one * out, n=2, p=1, **options)


@pytest.mark.parametrize("units", UNITS)
def test_designed_gains_in_any_unit(units):
    states, out = np.array(units[:2]), units[2]
    q, r = np.diag([0.01, 0.02]), 0.1
    plain, other = oscillator_in((1.0, 1.0, 1.0)), oscillator_in(units, scales=states)
    for options, scaled in (
        ({"poles": [0.5, 0.6]}, {"poles": [0.5, 0.6]}),
        (
            {"disturbance": q, "noise": r},
            {"disturbance": q * np.outer(states, states), "noise": r * out**2},
        ),
    ):
        best = qpmhe.design_luenberger(plain, [0.1, 0.2], **options).gain
        found = qpmhe.design_luenberger(other, states * [0.1, 0.2], **scaled).gain
        np.testing.assert_allclose(found * out / states[:, None], best, rtol=1e-7)
    steady = qpmhe.SteadyStateKalman(other, states * [0.1, 0.2], **scaled)
    best = qpmhe.SteadyStateKalman(plain, [0.1, 0.2], **options)
    np.testing.assert_allclose(
        steady.covariance / np.outer(states, states), best.covariance, rtol=1e-9
    )


def test_the_stationary_filter_is_equivariant_to_the_bit():
    generator = np.random.default_rng(7)
    q, r = np.array([[0.01, 0.004], [0.004, 0.02]]), np.array([[0.1]])
    best = qpmhe.SteadyStateKalman(
        oscillator_in((1.0, 1.0, 1.0)), [0.1, 0.2], disturbance=q, noise=r
    )
    for _ in range(5):
        units = 2.0 ** generator.integers(-30, 31, 3)
        states, out = units[:2], units[2]
        found = qpmhe.SteadyStateKalman(
            oscillator_in(units), states * [0.1, 0.2],
            disturbance=q * np.outer(states, states), noise=r * out**2,
        )
        np.testing.assert_array_equal(found.gain * out / states[:, None], best.gain)
        np.testing.assert_array_equal(
            found.covariance / np.outer(states, states), best.covariance
        )


@pytest.mark.parametrize("unit", [2.0**-30, 2.0**-7, 2.0**20])
def test_a_high_gain_observer_is_equivariant_to_the_bit_in_time(unit):
    best = qpmhe.HighGain(4, epsilon=0.3, dt=0.07).gain
    found = qpmhe.HighGain(4, epsilon=0.3 * unit, dt=0.07 * unit).gain
    np.testing.assert_array_equal(found * unit ** np.arange(4)[:, None], best)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_correction_is_tried_near_the_start_in_any_unit(unit):
    def correction(z, v):
        # Defined near 3 units alone, and far from fits it would write into v.
        assert abs(z[0] / unit - 3.0) < 2.0
        if abs(v[0]) > 100.0 * unit:
            v[0] = 0.0
        return 0.2 * v

    system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.OutputInjection(correction), cost_of([unit], unit**2), horizon=3,
        initial_state=[3.0 * unit],
    )
    assert np.isfinite(mhe.update([3.1 * unit]).state).all()
    wrong = qpmhe.OutputInjection(lambda z, v: 0.2 * v + (z - 3.0 * unit))
    with pytest.raises(ModelError, match="must not correct where the output fits"):
        qpmhe.MovingHorizonEstimator(
            system, wrong, cost_of([unit], unit**2), horizon=3, initial_state=[3.0 * unit]
        )


def test_a_correction_is_tried_within_x_alone():
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([0.0], [np.inf])
    )
    qpmhe.MovingHorizonEstimator(
        system, qpmhe.OutputInjection(lambda z, v: v * 0.1 * math.sqrt(z[0])), cost_of([1.0]),
        horizon=3, initial_state=[0.0],
    )
