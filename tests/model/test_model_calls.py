"""How models and estimators are called, and what models return that is odd."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError
from tests.estimation import spoil
from tests.estimation.spoil import cost_of
from tests.estimation.untraced import untraced

YS = np.random.default_rng(2).normal(size=30)


def estimator(system, **options):
    return spoil.estimator(
        system, qpmhe.Luenberger([0.4, 0.1]), cost_of(disturbance=10.0 * np.eye(2), noise=4.0),
        horizon=5, initial_state=[1.0, -1.0], max_qps=2, engine="python", **options,
    )


def masked(x, mask):
    return np.ma.masked_array(np.sin(x), mask=mask)


def test_a_model_may_return_masked_arrays_without_masked_entries():
    plain = qpmhe.System(lambda x: 0.9 * x, lambda x: np.sin(x[:1]), n=2, p=1)
    odd = qpmhe.System(lambda x: 0.9 * x, lambda x: masked(x[:1], False), n=2, p=1)
    one, two = estimator(plain), estimator(odd)
    for y in YS:
        np.testing.assert_allclose(two.update(y).state, one.update(y).state, 0.0, 1e-6)
    assert "masked array" in odd.explain()


def test_a_masked_entry_is_no_value():
    """What lies under a mask is never used."""
    far = qpmhe.System(
        lambda x: 0.9 * x, lambda x: masked(x[:1], np.abs(x[:1]) > 1e3), n=2, p=1
    )
    assert np.isnan(far.h(np.array([2e3, 0.0]))).all()
    assert far.h(np.array([1.0, 0.0])) == np.sin(1.0)
    assert np.isnan(far.h.batch(np.array([[2e3, 0.0], [1.0, 0.0]]), np.zeros((2, 0)))[0]).all()
    with pytest.raises(ModelError, match=r"nan.*at the initial state"):
        estimator(qpmhe.System(lambda x: 0.9 * x, lambda x: masked(x[:1], True), n=2, p=1))


def test_functions_of_a_system_without_inputs_are_called_with_a_state_alone():
    x = np.array([0.3, -0.4])
    for system in (
        qpmhe.System(lambda x: 0.9 * x, lambda x: np.sin(x[..., :1]), n=2, p=1),
        qpmhe.System(lambda x: 0.9 * x, lambda x: np.sin(x[0]), n=2, p=1),
        qpmhe.System.from_ode(lambda x: -x, lambda x: np.sin(x[:1]), dt=0.1, n=2, p=1),
        qpmhe.models.catalogue()["batch_reactor"]().system,
    ):
        nothing = np.zeros(0)
        for name in ("f", "h", "f_jacobian", "h_jacobian"):
            function = getattr(system, name)
            np.testing.assert_array_equal(function(x), function(x, nothing))


def test_an_input_that_is_missing_is_an_error_of_its_own():
    system = qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x[..., :1], n=2, p=1, m=2)
    for name in ("f", "h", "f_jacobian", "h_jacobian"):
        with pytest.raises(InvalidInputError, match=rf"u is missing.* 2 inputs; call {name}\(x, u"):
            getattr(system, name)(np.ones(2))


@pytest.mark.parametrize("batched", [True, False])
def test_an_output_may_be_a_function_of_state_and_parameters_beside_inputs(batched):
    def f(x, u, theta):
        return theta * x + u if batched else np.array([float(theta[0]) * x[0] + u[0]])

    def system(h):
        return qpmhe.augment_parameters(f, h, n=1, p=1, m=1, nominal=[0.5])

    short, full = (
        system(h) for h in (lambda x, theta: x * theta, lambda x, u, theta: x * theta)
    )
    x, u = np.array([2.0, 0.7]), np.array([0.3])
    assert short.h(x, u) == full.h(x, u) == [1.4]
    np.testing.assert_array_equal(short.f(x, u), full.f(x, u))
    np.testing.assert_allclose(short.h_jacobian(x, u), [[0.7, 2.0]], 1e-9)


def test_a_function_of_x_and_u_alone_is_still_refused_there():
    with pytest.raises(ModelError, match="cannot be called as h"):
        qpmhe.augment_parameters(
            lambda x, u, theta: theta * x + u, lambda x, u: x, n=1, p=1, m=1, nominal=[0.5]
        )


def test_update_within_an_update_is_an_error_and_changes_nothing():
    errors, inside = [], []

    def h(x):
        if inside:
            mhe = inside.pop()
            try:
                mhe.update(100.0)
            except InvalidInputError as error:
                errors.append(str(error))
            inside.append(mhe)
        return np.sin(x[:1]) if x[0] < 1e9 else x[:1]

    system = qpmhe.System(lambda x: 0.9 * x, h, n=2, p=1)
    twin, mhe = estimator(system), estimator(system)
    expected = [twin.update(y).state for y in YS]
    inside.append(mhe)
    found = [mhe.update(y).state for y in YS]
    np.testing.assert_array_equal(found, expected)
    assert mhe.time == len(YS)
    assert "update was called within an update of the same estimator" in errors[0]
    inside.clear()
    mhe.update(0.0)


def test_an_update_that_raises_leaves_the_estimator_ready():
    mhe = estimator(qpmhe.System(lambda x: 0.9 * x, lambda x: x[..., :1], n=2, p=1))
    for wrong in ([1.0, 2.0], "text"):
        with pytest.raises(InvalidInputError):
            mhe.update(wrong)
    mhe.update(1.0)
    assert mhe.time == 1


@pytest.mark.parametrize(
    "text", ["1.5", "abc", b"1.5", ["1.5"], np.array(["1.5"]), np.array(["1.5"], object)], ids=repr
)
def test_text_is_no_measurement(text):
    mhe = estimator(qpmhe.System(lambda x: 0.9 * x, lambda x: x[..., :1], n=2, p=1))
    with pytest.raises(InvalidInputError, match=r"(?s)y is .*(1\.5|abc).*text; expected numbers"):
        mhe.update(text)
    with pytest.raises(InvalidInputError, match=r"(?s)measurements is .*text; expected numbers"):
        mhe.run(np.array([text]).reshape(-1))
    assert mhe.time == 0


@pytest.mark.parametrize(("change", "most"), [(lambda one: one, 28), (untraced, 20)])
def test_constructors_call_a_model_a_few_times(change, most):
    """An estimator finds the expression and compares it; or it finds the steps of differences."""
    counts = {"f": 0, "h": 0}

    def counted(name, function):
        def call(x):
            counts[name] += 1
            return function(x)

        return change(call)

    system = qpmhe.System(
        counted("f", lambda x: np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * np.sin(x[0])])),
        counted("h", lambda x: x[:1]), n=2, p=1,
    )
    assert max(counts.values()) <= 2
    for most_now in (most, most - 4):  # another estimator of the same system takes less
        counts.update(f=0, h=0)
        estimator(system)
        assert 0 < max(counts.values()) <= most_now
