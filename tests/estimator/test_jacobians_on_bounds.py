"""A Jacobian that is not finite on a bound of X is taken a small step inside."""

import casadi
import numpy as np
import pytest

import qpmhe
from qpmhe.model.derivatives import Jacobian

DRAIN = 0.1


def level(x):
    return x - DRAIN * np.sqrt(x)


def slope(x):
    return np.array([[1.0 - 0.5 * DRAIN / np.sqrt(x[0])]])


def raising(x):
    if x[0] == 0.0:
        raise ZeroDivisionError
    return slope(x)


def identity(x):
    return x


def system(kind):
    options = {"n": 1, "p": 1, "states": qpmhe.Box([0.0], [np.inf])}
    if kind == "casadi":
        return qpmhe.from_casadi(lambda x: x - DRAIN * casadi.sqrt(x), identity, **options)
    given = {"given": slope, "raising": raising}.get(kind)
    return qpmhe.System(level, identity, f_jacobian=given, **options)


def run(kind, engine):
    mhe = qpmhe.MovingHorizonEstimator(
        system(kind), qpmhe.Luenberger([[0.3]]), engine=engine, horizon=4, initial_state=[0.0],
        cost=qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0),
    )
    return [mhe.update([y]) for y in (0.0, -0.1, 0.2, 0.1, 0.0, -0.2, -0.3, 0.4)]


@pytest.mark.parametrize(
    ("kind", "engine"),
    [("traced", "python"), ("traced", "compiled"), ("casadi", "python"), ("casadi", "compiled"),
     ("given", "python"), ("raising", "python")],
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_the_step_goes_on_where_the_exact_jacobian_is_infinite(kind, engine):
    estimates = run(kind, engine)
    assert not any(qpmhe.Status.MODEL_FAILED in one.status for one in estimates)
    assert sum(qpmhe.Status.IMPROVED in one.status for one in estimates) > 4
    reference = run("traced", "python")
    np.testing.assert_allclose(
        [one.cost for one in estimates], [one.cost for one in reference], rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e4])
def test_the_step_inside_is_of_the_magnitude_of_the_states(unit):
    def given(x):
        return np.array([[0.5 / np.sqrt(x[0])]])

    box = qpmhe.Box([0.0], [np.inf])
    one = qpmhe.System(np.sqrt, identity, n=1, p=1, f_jacobian=given, states=box, scales=[unit])
    assert isinstance(one.f_jacobian, Jacobian)
    with np.errstate(divide="ignore"):
        found = one.f_jacobian.batch(np.array([[0.0], [4.0 * unit]]), np.zeros((2, 0)))
    inside = 0.25 / found[0, 0, 0] ** 2
    assert 1e-4 * unit < inside < 1e-2 * unit
    assert found[1, 0, 0] == 0.25 / np.sqrt(unit)
