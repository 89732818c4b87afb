"""The likelihood in C: the one of CasADi's filter, and its slope the one of differences."""

import mpmath
import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import filters as library
from qpmhe.tuning import likelihood as tuned
from qpmhe.tuning import search
from tests.tuning.test_likelihood import check_slope, problem, untraced, zoo


def both(system, record, parts, **options):
    """The likelihood by CasADi, the one in C, and where to compare them."""
    made = [problem(system, record, parts, **options)[0] for _ in range(2)]
    made[1].compile(always=True)
    assert not made[1].not_compiled
    plan = made[0].structure
    return *made, plan.start + 0.1 * np.sin(np.arange(1, 1 + len(plan.start)))


def check_same(first, second, theta, tolerance=1e-9):
    chosen = [np.random.default_rng(2).random(len(one)) < 0.7 for one in first.data]
    expected, slope = first.gradient(theta, chosen)
    value, found = second.gradient(theta, chosen)
    assert np.isfinite(expected)
    assert value == pytest.approx(expected, rel=tolerance)
    assert second.value(theta, chosen) == pytest.approx(expected, rel=tolerance)
    np.testing.assert_allclose(found, slope, rtol=0, atol=tolerance * np.linalg.norm(slope))


@pytest.mark.parametrize(("name", "structure", "threshold"), [
    ("vehicle", "full", 1.5), ("batch_reactor", "diagonal", 2.0), ("cstr", "full", None),
    ("battery_cell", "diagonal", None), ("van_der_pol", "full", 1.0),
])  # fmt: skip
def test_it_is_the_one_of_casadi_and_its_slope_the_one_of_differences(name, structure, threshold):
    # Outputs are missing; the vehicle has angles, the reactor bounds.
    system, record, parts = zoo(name)
    options = {"structure": structure, "threshold": threshold}
    first, second, theta = both(system, record, parts, **options)
    check_same(first, second, theta)
    check_slope(second, theta, 60)


@pytest.mark.slow
def test_it_is_the_one_of_casadi_of_twelve_states():
    system, record, parts = zoo("quadrotor")
    first, second, theta = both(system, record, parts)
    check_same(first, second, theta)
    check_slope(second, theta, 60)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_samples_have_the_likelihood_of_casadi(count):
    first, second, theta = both(*zoo("vehicle"))
    first.data, second.data = ([one.first(count) for one in each.data] for each in (first, second))
    chosen = [np.ones(len(one), np.bool_) for one in first.data]
    assert sum(map(len, chosen)) == count
    value, slope = second.gradient(theta, chosen)
    assert second.value(theta, chosen) == value
    if count == 0:
        assert value == 0.0
        np.testing.assert_array_equal(slope, 0.0)
        return
    expected, of_casadi = first.gradient(theta, chosen)
    assert value == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(slope, of_casadi, rtol=0, atol=1e-9 * np.linalg.norm(of_casadi))


def cart(unit=1.0, matrix=None, linear=False):
    """A cart whose position is in another unit than its speed."""
    step, bent = np.array([[1.0, 0.1 / unit], [0.0, 0.95]]), np.array([0.01 / unit, 0.01])
    return qpmhe.System(
        (lambda x: x @ step.T) if linear else lambda x: x @ step.T + np.sin(x[..., 1:]) * bent,
        lambda x: x[..., :1], n=2, p=1, disturbance_matrix=matrix,
    )


def in_many_digits(y, parts, theta):
    """The likelihood of the linear cart (unit 1) with these factors of deviations, in 60 digits."""
    with mpmath.workdps(60):
        P, Q, R = (mpmath.matrix(one.tolist()) for one in parts)
        for matrix, part in ((P, theta[:2]), (Q, theta[2:4]), (R, theta[4:])):
            for k, one in enumerate(part):
                matrix[k, k] *= mpmath.exp(2 * one)
        A, C = mpmath.matrix([[1.0, 0.1], [0.0, 0.95]]), mpmath.matrix([[1, 0]])
        z = mpmath.zeros(2, 1)
        total = mpmath.mpf(0)
        for one in y[:, 0].tolist():
            S = (C * P * C.T + R)[0]
            e, gain = one - z[0], P * C.T / S
            total += e * e / S / 2 + mpmath.log(S) / 2
            z, P = A * (z + gain * e), A * (P - gain * S * gain.T) * A.T + Q
        return total


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-6])
@pytest.mark.parametrize("vague", [1.0, 1e10])
def test_vague_priors_and_units(unit, vague):
    y = np.random.default_rng(3).standard_normal((50, 1))
    scale = np.array([1.0 / unit, 1.0])
    plain = vague * np.eye(2), 0.01 * np.eye(2), np.eye(1)
    parts = *(np.outer(scale, scale) * one for one in plain[:2]), plain[2] / unit**2
    record = qpmhe.tuning.TuningRecord(y / unit, initial_state=[0.0, 0.0])
    first, second, theta = both(cart(unit, linear=True), record, parts)
    tolerance = 1e-9 * max(1.0, vague / 1e7)  # S has lost digits
    check_same(first, second, theta, tolerance)
    value, slope = second.gradient(theta, [np.ones(50, bool)])
    with mpmath.workdps(60):
        small = mpmath.mpf(10) ** -20
        expected = in_many_digits(y, plain, theta)
        slopes = []
        for k in range(5):
            moved = [mpmath.mpf(one) + small * (j == k) for j, one in enumerate(theta.tolist())]
            slopes.append(float((in_many_digits(y, plain, moved) - expected) / small))
    assert value + 50 * np.log(unit) == pytest.approx(float(expected), rel=tolerance)
    error = tolerance * np.linalg.norm(slopes)
    np.testing.assert_allclose(slope, slopes, rtol=0, atol=error)


def test_where_a_vague_prior_takes_digits_the_library_is_compared_with_a_share_of_it():
    system, record, (prior, *others) = zoo("vehicle")
    first, second, theta = both(system, record, (1e10 * np.eye(len(prior)), *others))
    assert second.value(theta) == pytest.approx(first.value(theta), rel=1e-4)


def test_a_prior_without_variance_and_a_disturbance_of_one_direction():
    y = np.random.default_rng(3).standard_normal((50, 1))
    y[10:20] = np.nan
    record = qpmhe.tuning.TuningRecord(y, initial_state=[0.0, 0.0])
    parts = np.diag([0.0, 1.0]), np.eye(1), np.eye(1)
    first, second, theta = both(cart(matrix=[[0.005], [0.1]]), record, parts)
    check_same(first, second, theta)
    check_slope(second, theta, 50)


def test_parameters_among_the_inputs_and_steps_of_other_lengths():
    generator, one = np.random.default_rng(0), np.eye(1)
    u, y = generator.standard_normal((2, 50, 1))
    system = qpmhe.System.from_ode(
        lambda x, u: -u[..., 1:] * np.sin(x) + u[..., :1], lambda x: x, dt=0.1, n=1, p=1, m=2)
    dt = generator.uniform(0.05, 0.3, 50)
    record = qpmhe.tuning.TuningRecord(y, u, dt=dt, initial_state=[0.5])
    first, second, theta = both(
        system, record, (one, 0.1 * one, one), inputs=1, parameters={"rate": 0.7})
    check_same(first, second, theta)
    check_slope(second, theta, 50)


def test_of_a_long_record_stretches_are_filtered_again(monkeypatch):
    system, record, parts = zoo("van_der_pol")
    _, second, theta = both(system, record, parts)
    whole = second.gradient(theta)
    monkeypatch.setattr(library, "_MOST_BYTES", 0)
    value, slope = second.gradient(theta)
    assert value == whole[0]
    np.testing.assert_array_equal(slope, whole[1])


def test_a_filter_that_diverges_costs_infinitely_much():
    system = qpmhe.System(lambda x: x**3, lambda x: x, n=1, p=1)
    record = qpmhe.tuning.TuningRecord(
        np.concatenate((np.full(10, 0.1), np.full(40, np.nan)))[:, None], initial_state=[0.1])
    _, second, theta = both(system, record, (np.eye(1), np.eye(1), np.eye(1)))
    second.data[0].y[10:], second.data[0].observed[10:] = 1e200, True
    every = [np.ones(50, bool)]
    assert second.value(theta, every) == np.inf
    assert second.gradient(theta, every)[0] == np.inf


def test_without_a_compiler_or_with_wrong_code_it_stays_in_python(monkeypatch):
    system, record, parts = zoo("pendulum")
    usual, _ = problem(system, record, parts)
    expected = usual.gradient(usual.structure.start)
    monkeypatch.setenv("CC", "/nowhere/cc")
    likelihood, plan = problem(system, record, parts)
    likelihood.compile(always=True)
    assert "no C compiler" in likelihood.not_compiled
    assert likelihood.gradient(plan.start)[0] == expected[0]
    monkeypatch.delenv("CC")

    def wrong(self, given, weights):
        value, *by = right(self, given, weights)
        by[1][0, 0] *= 1.01
        return value, *by

    right = library.LikelihoodLibrary.adjoint
    monkeypatch.setattr(library.LikelihoodLibrary, "adjoint", wrong)
    monkeypatch.setattr("qpmhe.codegen.compiler._LEVELS", (("-O0",),))
    likelihood, plan = problem(system, record, parts)
    likelihood.compile(always=True)
    assert "check" in likelihood.not_compiled
    assert likelihood.gradient(plan.start)[0] == expected[0]


def test_only_what_can_be_compiled_and_saves_time_is(monkeypatch):
    monkeypatch.delenv("QPMHE_ENGINE")
    monkeypatch.setenv("CC", "/nowhere/cc")  # which it would need
    system, record, parts = zoo("pendulum")
    for one, many, tried in ((system, False, False), (system, True, True),
                             (untraced(system), True, False)):
        likelihood, _ = problem(one, record, parts)
        if many:
            monkeypatch.setattr(tuned, "_GRADIENTS", 1e6)
        likelihood.compile()
        assert bool(likelihood.not_compiled) == tried


def test_a_search_that_begins_with_a_part_of_the_record_finds_the_same(monkeypatch):
    system, record, parts = zoo("van_der_pol", steps=400)
    likelihood, plan = problem(system, record, (parts[0], 9 * parts[1], parts[2] / 4))
    assert likelihood.shortened(200) is None
    assert likelihood.shortened(50).samples == 50
    found = []
    for short in (10_000, 50):
        monkeypatch.setattr(search, "_SHORT", short)
        theta, _ = search.search_likelihood(likelihood, plan.start, lambda *_: None)
        theta, _ = search.polish(likelihood, theta)
        found.append((likelihood.value(theta), list(plan.values(theta).values())))
    assert found[1][0] == pytest.approx(found[0][0], abs=1e-4)
    # A deviation of which the records say nothing ends anywhere below what they would show.
    np.testing.assert_allclose(found[1][1][1:], found[0][1][1:], rtol=1e-3, atol=1e-4)
