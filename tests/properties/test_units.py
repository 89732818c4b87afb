"""Units change nothing but the numbers' units.

Each problem is drawn once, and estimated in its own units and in others: of each state, output,
input, of the time and the cost, and of each inequality. Powers of two are exact, so that
estimates and statuses must agree in every bit; other units round, and must agree up to that.
"""

import numpy as np
import pytest

from qpmhe import Status
from tests.codegen.cases import constraints_of
from tests.codegen.test_agreement import agree

from .problems import Problem, Units

STEPS = 14
pytestmark = [
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
    # Some of the random models have long steps, in which units do not matter either.
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ModelWarning"),
]
PLAIN = {
    "ode": 0.6, "irregular": 0.5, "inputs": 0.6, "parameters": 0.2, "states": 0.4,
    "disturbances": 0.3, "noises": 0.3, "rows": 0.5, "discount": 0.5, "loss": 0.5, "angles": 0.5,
    "kalman": 0.6, "observer prior": 0.5, "rules": 0.3, "held": 0.2, "missing": 0.7,
    "outliers": 0.2, "weights": 0.4, "bounds": 0.3, "sensors": 0.3, "untraced": 0.8,
}
KINDS = {
    "plain": PLAIN, "low rank": PLAIN | {"matrix": 0.6, "covariance": 1.0},
    # Of constraints that are traced, CasADi drops factors of 1, and rounds in another order.
    "soft": PLAIN | {
        "constraint": 1.0, "soft": 1.0, "states": 0.9, "noises": 0.9, "untraced": 1.0,
    },
}


def other_units(one, base, most):
    """Random units, powers of the base."""
    rng = np.random.default_rng(one.n + 10 * one.p)

    def draw(size):
        return float(base) ** rng.integers(-most, most + 1, size)

    states, outputs, inputs = draw(one.n), draw(one.p), draw(one.m + one.k)
    by_w = draw(one.G.shape[1]) if one.how == "matrix" else states @ one.G
    units = Units(states, outputs, inputs, by_w, draw(2), *draw(2))
    # Covariances of an observer fix the cost's unit; and so do sets, whose tolerances are shares
    # of standard deviations, and difference steps, which are shares of the prior's.
    free = one.kind in ("luenberger", "injection") and not one.sets and not one.names
    if not free or one.derivative not in ("traced", "given") or one.loss or one.held:
        units = units._replace(cost=1.0)
    return units


def numbers(one, estimate, units):
    """The numbers of an estimate, taken back to the units in which it was drawn."""
    states = ("state", "filtered", "trajectory", "candidate")
    return {
        **{name: getattr(estimate, name) / units.states for name in states},
        "noises": estimate.noises / units.outputs,
        "disturbances": estimate.disturbances / (
            units.disturbances if one.how == "matrix" else units.states
        ),
        "cost": estimate.cost / units.cost, "candidate_cost": estimate.candidate_cost / units.cost,
    }


def posed_twice(seed, kind, base, most):
    """Pairs of estimates in the drawn units and in others: time, both, and their numbers."""
    one = Problem(seed, KINDS[kind], STEPS)
    found = []
    for units in (one.own_units, other_units(one, base, most)):
        mhe = one.estimator(units)
        estimates = [one.update(mhe, sample, units) for sample in one.samples]
        late = STEPS - min(2, mhe.horizon)
        estimates.append(mhe.amend(late, np.ones(one.p) * units.outputs))
        scale = np.outer(units.states, units.states) / units.cost
        found.append((estimates, mhe.covariances() / scale, units))
    (plain, spread, own), (others, other_spread, units) = found
    if base == 2.0:
        np.testing.assert_array_equal(other_spread, spread)
    for estimate, other in zip(plain, others, strict=True):
        first, second = numbers(one, estimate, own), numbers(one, other, units)
        yield one, estimate, other, [(name, second[name], first[name]) for name in first]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(20))
def test_powers_of_two_change_not_a_bit(seed, kind):
    for _, one, other, values in posed_twice(seed, kind, 2.0, 30):
        # How far an observer may be is a number of standard deviations.
        ignored = Status.OBSERVER_FAR
        assert other.status & ~ignored == one.status & ~ignored
        assert (other.qps, other.dropped) == (one.qps, one.dropped)
        for name, value, expected in values:
            np.testing.assert_array_equal(value, expected, err_msg=f"{name} at {one.time}")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(12))
def test_powers_of_ten_change_no_estimate(seed, kind):
    costs = []
    for problem, one, other, values in posed_twice(seed, kind, 10.0, 9):
        if (one.status | other.status) & (Status.SOLVER_STOPPED | Status.NO_DECREASE):
            break  # where it stopped is a matter of rounding, and later estimates may start there
        # A sequence has converged where J hardly changes, and corrections end within a
        # tolerance of a set: states are less accurate.
        exact = problem.options["max_qps"] is not None and not (
            one.corrections or one.nearest_points
        )
        accuracy = 1e-5 if exact and kind != "soft" else 1e-3
        # A QP with penalties is solved to a share of what its sequence began with, and what the
        # window's former estimates missed by is in the next candidate.
        costs.append(one.cost if np.isfinite(one.cost) else 0.0)
        size = max(1.0, *costs[-problem.options["horizon"] - 1 :]) if kind == "soft" else 1.0
        for name, value, expected in values:
            if kind != "soft" or "cost" in name:
                np.testing.assert_allclose(
                    value, expected, rtol=accuracy, atol=accuracy * size,
                    err_msg=f"{name} at {one.time}",
                )


@pytest.mark.parametrize("size", [1e-160, 1e200, 1e280])
def test_constraints_in_units_whose_squares_are_no_numbers(size):
    """Where slopes cannot be squared, the estimates are those of a usual unit."""
    usual, other = (constraints_of(one) for one in (1.0, size))
    expected, found = (one.estimator("python", max_qps=3) for one in (usual, other))
    for sample in usual.samples:
        estimate = found.update(**sample)
        assert Status.SOLVER_STOPPED not in estimate.status
        agree(expected.update(**sample), estimate, 1e-13)
