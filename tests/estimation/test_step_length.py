"""The estimator's check of the step by which an ODE is discretised."""

import copy
import re
import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import qpmhe
from qpmhe.cli import doctor
from qpmhe.estimation.step_length import StepCheck, StepComparison, step_error, step_errors
from qpmhe.models import catalogue


def decay(rate):
    """x1' = -rate (x1 - x2^2), x2' = -0.1 x2."""

    def f(x):
        return np.stack([-rate * (x[..., 0] - x[..., 1] ** 2), -0.1 * x[..., 1]], axis=-1)

    return f


def h(x):
    return x[..., 1:]


STIFF, MILD = decay(40.0), decay(1.0)


def made(rate=STIFF, w=(1e-2, 1e-2), dt=0.1, method="rk4", **options):
    system = qpmhe.System.from_ode(rate, h, dt=dt, n=2, p=1, method=method)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=0.1**2 * np.eye(2), disturbance=np.diag(w) ** 2, noise=[[0.01]])
    return system, qpmhe.Luenberger([0.0, 0.1]), cost, {
        "horizon": 5, "initial_state": [0.5, 1.0], **options}


def build(system, observer, cost, options):
    return qpmhe.MovingHorizonEstimator(system, observer, cost, **options)


_TOO_LONG = (
    r"one step of rk4 in dt = 0.1 is too long.* state 0 .* cost: "
    r"steps=8 is fine enough\."
)


def test_a_stiff_model_warns_once_with_number_and_remedy():
    parts = made()
    with pytest.warns(qpmhe.ModelWarning, match=_TOO_LONG) as seen:
        mhe = build(*parts)
    assert len(seen) == 1
    assert seen[0].filename == __file__
    # Whoever copies an estimator, or loads it, knows.
    copy.deepcopy(mhe).update([1.0])
    mhe.reset([0.4, 1.0])
    mhe.update([1.0])


def test_a_step_that_explodes_warns():
    """One step leads to 1e40, and two half steps to no number."""
    def rate(x):
        return np.stack([-3e7 * x[..., 0] ** 2 - x[..., 0], -x[..., 1]], -1)

    with pytest.warns(qpmhe.ModelWarning, match=r"not both finite in state 0.* method='radau'"):
        build(*made(rate, dt=1.0))


def test_a_mild_model_does_not():
    build(*made(MILD))
    build(*made(w=(100.0, 1e-2)))  # nor one whose disturbance covers the error
    build(*made(STIFF, dt=0.005))
    discrete = qpmhe.System(lambda x: 0.9 * x, h, n=2, p=1)
    assert step_error(discrete, made()[2], None, np.ones(2), np.zeros(0)) is None


@pytest.mark.parametrize("rate", [STIFF, MILD])
def test_the_number_is_the_error_of_the_step(rate):
    """Against SciPy's Radau: two half steps are far nearer than one."""
    system, _, cost, options = made(rate, dt=0.05)
    found = step_error(system, cost, None, np.array(options["initial_state"]), np.zeros(0))
    exact = solve_ivp(
        lambda t, x: rate(x), (0.0, 0.05), found.point, "Radau", rtol=1e-12, atol=1e-14).y[:, -1]
    missed = np.abs(system.f(found.point, np.zeros(0)) - exact) / 1e-2
    assert found.component == np.argmax(missed)
    assert found.deviations == pytest.approx(missed.max(), rel=0.15)


def test_where_there_is_no_disturbance_the_prior_is_the_unit():
    system, _, cost, options = made(dt=0.05)
    start, none = np.array(options["initial_state"]), np.zeros(0)
    usual = step_error(system, cost, None, start, none)
    bound = qpmhe.Box([0.0, -np.inf], [0.0, np.inf])
    fixed = qpmhe.System.from_ode(STIFF, h, dt=0.05, n=2, p=1, disturbances=bound)
    # sd 1e-2 of w, sd 0.1 of the prior
    assert step_error(fixed, cost, None, start, none).deviations == pytest.approx(
        0.1 * usual.deviations)
    of_second = qpmhe.System.from_ode(
        STIFF, h, dt=0.05, n=2, p=1, disturbance_matrix=[[0.0], [1.0]])
    lifted = qpmhe.QuadraticCost.from_covariances(
        prior=0.1**2 * np.eye(2), disturbance=[[1e-4]], noise=[[0.01]])
    assert step_error(of_second, lifted, None, start, none).deviations == pytest.approx(
        0.1 * usual.deviations)


def test_euler_is_a_coarse_map_by_choice():
    build(*made(MILD, method="euler"))  # 0.2 deviations
    with pytest.warns(qpmhe.ModelWarning, match=r"expected at most 10\)"):
        build(*made(STIFF, method="euler", dt=0.03))


def aliased(x):
    """Four turns of x1 in a sample: all stages of rk4's one step, and of its two halves, see 1."""
    return np.stack([np.ones_like(x[..., 0]), np.cos(8.0 * np.pi * x[..., 0])], -1)


def untraced(rate):
    return lambda x: rate(x) if float(x[0]) < 1e300 else x


@pytest.mark.parametrize("rate", [aliased, untraced(aliased)], ids=["traced", "called"])
def test_what_halving_cannot_see_an_implicit_step_does(rate):
    parts = made(rate, dt=1.0)
    with pytest.warns(qpmhe.ModelWarning, match=(
        r"differs from that of radau with 2 substeps by .* in state 1 .* cost: steps=8 is fine"
    )):
        build(*parts)
    system = qpmhe.System.from_ode(rate, h, dt=1.0, n=2, p=1, steps=8)
    build(system, *parts[1:])


def test_a_step_that_explodes_either_way_is_found_by_an_implicit_one():
    """Neither one step nor two are finite away from the initial state."""
    def rate(x):
        return np.stack([-1e80 * x[..., 0], -1e-3 * x[..., 1]], -1)

    system, _, cost, _ = made(rate, dt=1.0)
    found = step_error(system, cost, None, np.array([0.0, 1.0]), np.zeros(0))
    assert found.deviations == np.inf
    assert found.finer == "that of radau with 2 substeps"


def test_a_reference_that_is_not_sure_of_itself_says_nothing():
    """A bend within the step: fifth order is worth nothing, and halves of rk4 agree better."""
    def rate(x):
        return np.stack([-np.abs(x[..., 0] - 0.3), -0.1 * x[..., 1]], -1)

    for steps in 16, 32:
        parts = made(rate, dt=0.5, w=(1e-3, 1e-3))
        build(qpmhe.System.from_ode(rate, h, dt=0.5, n=2, p=1, steps=steps), *parts[1:])


def test_large_models_are_compared_with_halves_alone():
    n = 60
    system = qpmhe.System.from_ode(lambda x: -x, lambda x: x[..., :1], dt=0.5, n=n, p=1)
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(n), disturbance=np.eye(n), noise=[[1.0]])
    found = step_error(system, cost, None, np.ones(n), np.zeros(0))
    assert found.finer == "that of half the length"


def test_implicit_steps_of_many_states_are_tried_at_few_points(monkeypatch):
    """Each costs the cube of the states: 2 n + 1 points and more took most of the constructor."""
    counts, n = [], 60

    def counted(self, one, finer, how):
        counts.append(len(one))
        return error(self, one, finer, how)

    error = StepComparison._error
    monkeypatch.setattr(StepComparison, "_error", counted)
    system = qpmhe.System.from_ode(
        lambda x: -x - 0.1 * x**3, lambda x: x[:1], dt=0.1, n=n, p=1, method="midpoint"
    )
    weights = qpmhe.QuadraticCost(
        prior=np.eye(n), disturbance=np.eye(n), noise=np.eye(1)
    )
    step_error(system, weights, None, np.ones(n), np.zeros(0))
    assert counts
    assert 6 <= max(counts) <= 1e7 / n**3


def test_a_model_outside_of_its_domain_is_no_error():
    def rate(x):
        if np.any(x > 0.55):
            raise ValueError("outside")
        return -40.0 * x

    system = qpmhe.System.from_ode(
        rate, lambda x: x, dt=0.1, n=1, p=1, states=qpmhe.Box([0.0], [0.55]))
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        step_error(system, cost, None, np.array([0.5]), np.zeros(0))


@pytest.mark.parametrize("name", list(catalogue()))
def test_no_model_of_the_zoo_warns(name):
    system, observer, cost, scenario = catalogue()[name]()
    qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=scenario.initial_estimate)


def test_the_step_loop_does_not_pay():
    """The model is called as often in a step with and without a warning at construction."""
    calls = []

    def rate(x):
        calls.append(1)
        return MILD(x)

    system, observer, cost, options = made(rate, max_qps=0)
    mhe = build(system, observer, cost, options | {"engine": "python"})
    mhe.update([1.0])
    counts = []
    for _ in range(3):
        calls.clear()
        mhe.update([1.0])
        counts.append(len(calls))
    assert len(set(counts)) == 1
    assert counts[0] <= 8


@pytest.mark.parametrize("method", ["euler", "rk4", "midpoint"])
def test_the_remedies_are_remedies(method):
    """An estimator with each of them, as the warning writes it, does not warn."""
    parts = made(dt=0.2, method=method)
    with pytest.warns(qpmhe.ModelWarning, match="too long") as seen:
        build(*parts)
    text = str(seen[0].message)
    remedies = re.findall(r"(?:method='(\w+)')?(?: with )?(?:steps=(\d+))?", text.split(". ")[-2])
    found = [one for one in remedies if any(one)]
    assert len(found) == 1, text  # the cheaper one
    for name, steps in found:
        system = qpmhe.System.from_ode(
            STIFF, h, dt=0.2, n=2, p=1, method=name or method, steps=int(steps or 1)
        )
        build(system, *parts[1:])


@pytest.mark.parametrize("rate", [STIFF, MILD])
def test_a_table_has_the_own_step_and_where_it_is_too_long_finer_ones(rate):
    """Each error is that of `step_error` of a system with this discretisation."""
    system, _, cost, options = made(rate)
    point = None, np.array(options["initial_state"]), np.zeros(0)
    errors = step_errors(system, cost, *point)
    assert [how.method for how, _ in errors[:1]] == ["rk4"]
    if rate is MILD:
        assert len(errors) == 1
        return
    assert [tuple(how) for how, _ in errors] == [
        ("rk4", 1), ("rk4", 2), ("rk4", 4), ("rk4", 8), ("radau", 1), ("radau", 2)
    ]
    assert [error.is_harmless for _, error in errors] == 3 * [False] + [True, False, True]
    for how, error in errors:
        other = qpmhe.System.from_ode(rate, h, dt=0.1, n=2, p=1, method=how.method, steps=how.steps)
        expected = step_error(other, cost, *point)
        assert error.deviations == pytest.approx(expected.deviations, rel=1e-6)


def test_doctor_shows_the_table():
    system, observer, cost, options = made()
    with pytest.warns(qpmhe.ModelWarning, match="too long"):
        mhe = build(system, observer, cost, options)
    rows = doctor._steps(mhe)
    assert [row[:2] for row in rows][::3] == [("rk4", "1"), ("rk4", "8")]
    assert rows[0][2].startswith("[yellow]")
    assert rows[-1][2].startswith("[default]")
    assert {row[3] for row in rows} == {"at most 0.1"}


def pumped(**options):
    """x1' = -u (x1 - x2), which is stiff where u is large."""
    def rate(x, u):
        return np.stack([u[..., 0] * (x[..., 1] - x[..., 0]), -0.1 * x[..., 1]], axis=-1)

    system = qpmhe.System.from_ode(rate, h, dt=0.1, n=2, p=1, m=1, **options)
    return build(system, *made()[1:])


def test_a_step_that_inputs_make_too_long_warns_once_a_run():
    """The constructor knows no inputs; `run` has them, wherever in the record they are large."""
    Y = np.ones((6, 1))
    mild, late = np.ones((6, 1)), np.ones((6, 1))
    late[4] = 40.0
    mhe = pumped()
    mhe.run(Y, mild)
    with pytest.warns(qpmhe.ModelWarning, match=r"with u = \[40\.\].* in state 0 ") as seen:
        pumped().run(Y, late)
    assert len(seen) == 1
    assert seen[0].filename == __file__
    mhe, late[2] = pumped(), np.nan
    mhe.check_inputs(late[2:3])  # no finite ones, and none that count
    with pytest.warns(
        qpmhe.ModelWarning, match=r"cost: steps=4 is fine enough"
    ) as seen:
        mhe.check_inputs(late)
    assert seen[0].filename == __file__
    mhe.check_inputs(late)
    mhe.run(Y, late)
    mhe.check_inputs([[60.0]])  # an error that is not ten times as large is no news
    pumped(method="radau", steps=2).run(Y, late)
    with pytest.raises(qpmhe.errors.ShapeError, match=r"shape \(6,\); expected \(T, 1\)"):
        mhe.check_inputs(late[:, 0])


def test_later_inputs_are_tried_where_they_lie_beyond_those_before(monkeypatch):
    """Whoever streams has no record; and a second run may have other inputs."""
    Y, tried = np.ones((6, 1)), []
    checked = StepCheck.warn
    monkeypatch.setattr(
        StepCheck, "warn", lambda *args: tried.append(args[3]) or checked(*args))
    mhe = pumped()
    tried.clear()
    mhe.run(Y, np.ones((6, 1)))
    mhe.run(Y, np.ones((6, 1)))
    assert np.concatenate(tried).tolist() == [[1.0]]
    for k in range(1000):  # slowly up: a few times
        mhe.check_inputs([[1.0 + 1e-3 * k + 1e-6 * (-1) ** k]])
    assert 10 <= len(tried) <= 25
    with pytest.warns(qpmhe.ModelWarning, match=r"with u = \[20\.\].*by (.*) standard") as seen:
        mhe.check_inputs([[20.0]])
    with pytest.warns(qpmhe.ModelWarning, match=r"with u = \[2000\.\]"):
        mhe.run(Y, np.full((6, 1), 2000.0))
    assert len(seen) == 1
    copy.deepcopy(mhe).check_inputs([[1e5]])  # whose user knows


def test_a_failure_of_the_step_is_told_from_those_of_the_model():
    mhe, Y = pumped(), np.ones((60, 1))
    mhe.update(Y[0], [1.0])
    for y in Y:
        estimate = mhe.update(y, [400.0])
        if qpmhe.Status.MODEL_FAILED in estimate.status:
            break
    fault = mhe.step_fault(estimate)
    assert fault.startswith("One step of rk4 in dt = 0.1 is far too long near such states: ")
    assert "method='radau'" in fault
    fine = pumped(method="radau", steps=2)
    assert fine.step_fault(fine.update(Y[0], [1.0])) == ""


def test_the_error_at_inputs_is_that_of_a_system_whose_inputs_they_are():
    """Of several inputs the worst, at the same points."""
    mhe = pumped()
    tried = np.array([[1.0], [40.0], [20.0]])
    found = step_error(mhe.system, mhe.cost, None, mhe.initial_state, tried)
    expected = step_error(qpmhe.System.from_ode(
        lambda x: np.stack([40.0 * (x[..., 1] - x[..., 0]), -0.1 * x[..., 1]], axis=-1),
        h, dt=0.1, n=2, p=1), mhe.cost, None, mhe.initial_state, np.zeros(0))
    assert found.inputs.tolist() == [40.0]
    assert found.deviations == pytest.approx(expected.deviations, rel=1e-9)
    assert np.array_equal(found.point, expected.point)


def test_verify_looks_at_the_step_from_the_present_state():
    """x' = -x^3 is slow near 0, where the estimator is made, and fast at 1.9."""
    system = qpmhe.System.from_ode(lambda x: -x**3, lambda x: x, dt=0.5, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=[[100.0]], disturbance=[[100.0]], noise=[[1.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([[0.9]]), cost, horizon=5, initial_state=[0.1])
    assert mhe.verify()
    mhe.reset([1.9])
    with pytest.warns(qpmhe.ModelWarning, match="one step of rk4 in dt = 0.5 is too long") as seen:
        assert mhe.verify()
    assert seen[0].filename == __file__
    assert mhe.verify()  # no news
