"""Derivatives of estimates, against differences of estimates that were converged again."""

import copy
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe.sensitivity.sensitivity import NAMES
from tests.estimation.untraced import untraced

from .derivatives import (
    ALL,
    CENTRAL,
    DIAGONAL,
    LOSSES,
    MATRICES,
    SETS,
    STEP,
    Case,
    Continuous,
    PseudoHuber,
    Untraced,
    close,
    filtered,
    missing,
    robust,
    symmetric,
)
from .test_kalman import Plant, kalman


def by_component(W):
    return PseudoHuber(W, per_component=True)


def in_directions():
    return Case(
        lambda P, Q, R, discount: qpmhe.RobustCost(
            prior=P, disturbance=PseudoHuber(Q), noise=PseudoHuber(R), discount=discount
        ), discount=0.95, weights={"disturbance": np.array([[25.0]])},
        disturbances=symmetric(0.07), disturbance_matrix=np.array([[0.2], [1.0]]),
    )


# Case, and the least number of active rows.
CASES = {
    **{name: (lambda sets=sets: Case(discount=0.95, **sets), least)
       for name, (sets, least) in SETS.items()},
    **{name: (lambda make=make: robust(make), 0) for name, make in LOSSES.items()},
    "huber by component": (lambda: robust(
        lambda W: LOSSES["huber"](W, per_component=True), True, weights=DIAGONAL
    ), 0),
    "own by component": (lambda: robust(by_component, True, weights=DIAGONAL), 0),
    "huber with sets": (lambda: robust(LOSSES["huber"], **ALL), 1),
    "discount": (lambda: Case(discount=0.5), 0),
    "kalman": (filtered, 0),
    "missing with a loss and noise bounds": (
        lambda: missing(robust(PseudoHuber, noises=symmetric(0.3, 0.25))), 1
    ),
    "directions with a loss and bounds": (in_directions, 1),
    "step lengths": (
        lambda: Continuous(discount=0.95, update={2: {"dt": 0.05}, 5: {"dt": 0.17}}), 0
    ),
    "untraced with sets": (lambda: Untraced(discount=0.95, **ALL), 1),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_differences_of_estimates(name):
    make, least = CASES[name]
    found = make().check()
    assert len(found.active) >= least
    assert not found.weakly_active
    assert found.exact == ("untraced" not in name)


def test_every_name_alone():
    assert Case().check(one_by_one=True).exact
    # Penalties are discounted, too: those of the newest state are not.
    soft = qpmhe.Box([-1.0, -1.2], [0.8, 2.0]).soften(quadratic=30.0)
    Case(discount=0.7, states=soft).check(names=("discount",))


def test_singular_covariance():
    # The weight is of the factor F, which its covariance F W^-1 F' does not name alone.
    factor = np.array([[0.02], [0.1]])
    case = Case(
        cost=lambda P, Q, R, discount: qpmhe.QuadraticCost.from_covariances(
            prior=np.linalg.inv(P), disturbance=factor @ factor.T / Q[0, 0],
            noise=np.linalg.inv(R), discount=discount,
        ),
        weights={"disturbance": np.eye(1)},
    )
    case.check(names=("prior", "measurements", "inputs", "parameters", "noise_weight"))
    size = np.asarray(case.estimator().cost.disturbance).item()
    close(
        size * case.converged().disturbance_weight.sum(axis=(-2, -1)),
        case.difference({"disturbance_weight": np.ones((1, 1))}),
    )


@pytest.mark.parametrize("arrival", ["observer", "smoothed"])
def test_later_windows(arrival):
    # What enters the window's prior is data: measurements behind it, and all that moves it.
    case = Case(samples=10, horizon=6, options={"arrival": arrival})
    if arrival == "observer":
        case.check(names=MATRICES)
    found = case.converged()
    for name, size in (("measurements", 2), ("inputs", 1)):
        change = np.random.default_rng(3).normal(size=(10, size))
        change[:4] = 0.0
        if arrival == "smoothed":
            change[4:] = 0.0
            change[-1] = 1.0  # the mean is the last estimate's
        close(found.along(**{name: case.in_window(name, change)}), case.difference({name: change}))


def test_weights_of_samples():
    own, change = np.array([[5.0, 1.0], [1.0, 3.0]]), np.array([[1.0, 0.3], [0.3, -0.5]])

    def at(R, W):
        weights = {"noise_weight": R, "disturbance_weight": W}
        return missing(Case(discount=0.95, update={1: weights, 4: weights}))

    found = at(own, 2.0 * own).check()
    for name, share in (("noise_weights", (1, 0)), ("disturbance_weights", (0, 1))):
        inner = np.zeros((7, 2, 2))
        inner[[1, 4]] = change
        expected = sum(weight * at(
            own + share[0] * step * STEP * change, 2.0 * own + share[1] * step * STEP * change
        ).converged().trajectory for step, weight in CENTRAL.items()) / (12.0 * STEP)
        close(found.along(**{name: inner}), expected)
        close((getattr(found, name) * inner).sum(axis=(2, 3, 4)), expected)


def test_angles():
    class Turning(Case):
        @staticmethod
        def output(x):
            return np.stack([x[..., 0], x[..., 1]], axis=-1)

    residuals = dict.fromkeys(("state_residual", "output_residual"), qpmhe.angles([0]))
    case, plain = (Turning(prior=(3.1, 2.0), discount=0.95, **one) for one in (residuals, {}))
    x = np.array([3.1, 2.0])
    for y, other, u in zip(*(one.data.measurements for one in (case, plain)), case.data.inputs,
                           strict=True):
        y[...] = other[...] = x + 0.1 * (other - 0.5)
        x = case.step(x, np.append(u, 0.3))
    case.data.measurements[::2, 0] -= 2.0 * np.pi
    found, same = case.check(), plain.check()
    for name in ("measurements", "noise_weight", "prior", "discount"):
        np.testing.assert_allclose(getattr(found, name), getattr(same, name), 1e-9, 1e-12)


def test_differences_of_differences():
    class Real(Case):
        step = staticmethod(untraced(lambda x, u: np.real(Case.step(np.real(x), np.real(u)))))
        output = staticmethod(untraced(lambda x: np.real(Case.output(np.real(x)))))

    found, other = Real().estimator().sensitivity(), Case().estimator()
    exact = other._sensitivity_of(other._engine.solved()._replace(trajectory=found.trajectory))
    assert exact.exact
    assert not found.exact
    for name in ("noise_weight", "measurements", "inputs", "parameters"):
        close(getattr(found, name), getattr(exact, name), name, 1e-5)


@pytest.mark.parametrize("horizon", [9, 4], ids=["growing", "moving"])
def test_of_a_linear_system_they_are_the_kalman_filters(horizon):
    """By the complex step of the filter, which is exact."""
    plant = Plant(5, 2, 1, 0.9, steps=9)
    mhe = plant.estimator(horizon)
    for y in plant.Y:
        mhe.update(y)
    found = mhe.sensitivity()
    assert found.converged

    def slope(**changes):
        moved = copy.copy(plant)
        for name, change in changes.items():
            setattr(moved, name, getattr(plant, name) + 1e-30j * change)
        moved.Qs, moved.Rs = [moved.Q] * 9, [moved.R] * 9
        return kalman(moved)[0][-1][0].imag / 1e-30

    for k in range(horizon):
        expected = slope(Y=np.eye(9)[:, [9 - horizon + k]])
        np.testing.assert_allclose(found.measurements[-1, :, k, 0], expected, atol=1e-10)
    if horizon == 9:  # the prior's covariance is the data's, not yet the filter's
        for name, letter in zip(MATRICES, "PQR", strict=True):
            covariance = getattr(plant, letter)
            change = np.random.default_rng(6).normal(size=covariance.shape)
            change = change + change.T
            weight = np.linalg.inv(covariance)
            by_covariance = -weight @ getattr(found, name)[-1] @ weight
            np.testing.assert_allclose(
                (by_covariance * change).sum(axis=(1, 2)), slope(**{letter: change}), atol=1e-9
            )


@pytest.mark.shortened
@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@settings(deadline=None)
@given(
    seed=st.integers(0, 10**6), samples=st.integers(1, 9), horizon=st.integers(1, 9),
    kind=st.sampled_from([*SETS, ""]), loss=st.sampled_from([*LOSSES, ""]),
    discount=st.sampled_from([1.0, 0.8]),
)
def test_forward_and_adjoint_agree(seed, samples, horizon, kind, loss, discount):
    case = robust(LOSSES[loss]) if loss else Case()
    other = Case(samples=samples, horizon=horizon, discount=discount, seed=seed)
    case.data, case.horizon = other.data, horizon
    case.system = SETS[kind][0] if kind else {}
    found, rng = case.estimator().sensitivity(), np.random.default_rng(seed)
    if not found.converged:  # a matrix that is nearly singular, at times
        return
    cotangents = rng.normal(size=(3, *found.trajectory.shape))
    gradient = found.adjoint(cotangents)
    for name in NAMES:
        backward = getattr(gradient, name)
        change = rng.normal(size=backward.shape[1:])
        if "weight" in name:
            change = change + np.swapaxes(change, -1, -2)
        forward = (cotangents * found.along(**{name: change})).sum(axis=(1, 2))
        expected = (backward * change).reshape(3, -1).sum(axis=1)
        # Rows may leave no freedom: the derivatives are then rounding.
        size = np.abs(backward * change).sum() + np.abs(forward).max() + 1e-4
        np.testing.assert_allclose(forward, expected, rtol=0.0, atol=1e-7 * size, err_msg=name)


@pytest.mark.parametrize("kind", ["", "all", "filter", "smoothed"])
def test_both_engines(kind):
    make = filtered if kind == "filter" else Case
    sets = ALL if kind == "all" else {}
    options = {"arrival": "smoothed"} if kind == "smoothed" else {}
    found = []
    for engine in ("python", "compiled"):
        case = make(samples=9, horizon=6, discount=0.95, options=options, **sets)
        if not sets:
            case.data.measurements[7, 0] = np.nan
        mhe = case.estimator(engine=engine)
        assert mhe.engine == engine
        found.append(mhe.sensitivity())
    mine, other = found
    np.testing.assert_allclose(other.trajectory, mine.trajectory, atol=1e-7)
    assert [row[:4] for row in other.active] == [row[:4] for row in mine.active]
    for name in NAMES:
        close(getattr(other, name), getattr(mine, name), name, 1e-5)


@pytest.mark.parametrize("power", [-20, 14])
def test_no_unit_matters(power):
    # Powers of two: of the first state, and of the cost.
    unit = 2.0**power

    class Scaled(Case):
        @staticmethod
        def step(x, u):
            return Case.step(x / [unit, 1.0], u) * [unit, 1.0]

        @staticmethod
        def output(x):
            return Case.output(x / [unit, 1.0])

    def sets(unit):
        return {"states": qpmhe.Box([-unit, -1.25], [0.93 * unit, 2.0]),
                "disturbances": symmetric(0.15 * unit, 0.2)}

    case, scaled = Case(discount=0.95, **sets(1.0)), Scaled(discount=0.95, **sets(unit))
    each = np.array([unit, 1.0])
    weights = {
        name: getattr(case.data, name) * 4.0 / (1.0 if name == "noise_weight" else
                                                np.outer(each, each))
        for name in MATRICES
    }
    scaled.data = case.data._replace(prior=case.data.prior * each, **weights)
    found, other = (one.converged() for one in (case, scaled))
    assert found.converged
    assert other.converged
    assert [row[:4] for row in other.active] == [row[:4] for row in found.active]
    assert found.active
    cotangent = np.random.default_rng(1).normal(size=found.trajectory.shape)
    mine, its = found.adjoint(cotangent), other.adjoint(cotangent / each)
    for name in ("measurements", "inputs", "discount"):
        np.testing.assert_allclose(getattr(its, name), getattr(mine, name), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(4.0 * its.noise_weight, mine.noise_weight, rtol=1e-7)
    np.testing.assert_allclose(
        4.0 * its.prior_weight / np.outer(each, each), mine.prior_weight, rtol=1e-7
    )


def test_not_converged():
    case = Case()
    case.data.measurements[...] += 0.3
    found = case.estimator(max_qps=1).sensitivity()
    assert not found.converged
    assert "has not converged" in found.warning
    assert "max_qps=None" in found.warning
    # The step says how far off it is.
    minimiser = case.converged().trajectory
    before = np.abs(found.trajectory - minimiser).max()
    assert np.abs(found.trajectory + found.step - minimiser).max() < 0.3 * before


def test_weakly_active():
    free = Case(states=qpmhe.Box([-1.0, -3.0], [3.0, 3.0])).converged().trajectory
    lower = np.array([-1.0, free[:, 1].min()])  # the state with the lowest rate touches the bound
    found = Case(states=qpmhe.Box(lower, [3.0, 3.0])).converged()
    assert [row.set for row in found.weakly_active] == ["states"]
    time = int(free[:, 1].argmin())
    assert f"lower bound of states, row 1, at time {time}" in found.warning


def test_no_minimiser():
    # Outputs that fold: halfway between two solutions J has a saddle.
    system = qpmhe.System(lambda x: x, lambda x: x * x, n=1, p=1)
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=1.0, noise=1.0)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.0]), cost, horizon=3, initial_state=[0.0], max_qps=None
    )
    for _ in range(3):
        mhe.update([4.0])
    found = mhe.sensitivity()
    assert not found.converged
    assert "not positive definite" in found.warning


class Own(qpmhe.QuadraticCost):
    def stage_costs(self, residuals, weights):
        return 2.0 * super().stage_costs(residuals, weights)


INVALID, SHAPE = qpmhe.errors.InvalidInputError, qpmhe.errors.ShapeError


def test_refusals():
    mhe = Case(constraints=[qpmhe.Constraint(lambda x: x[..., 0] ** 2 - 40.0)]).estimator()
    found = mhe.sensitivity()  # of an inactive constraint no derivative is needed
    assert found.converged
    whole = np.pad([[1.0, 2.0]], ((7, 0), (0, 0)))
    newest, of_all = found.adjoint([1.0, 2.0]), found.adjoint(whole)
    np.testing.assert_array_equal(newest.noise_weight, of_all.noise_weight)
    for call, error, words in (
        (lambda: found.adjoint(np.zeros((3, 2))), SHAPE, "cotangent has shape"),
        (lambda: found.along(noise_covariance=np.eye(2)), qpmhe.errors.OptionError, "noise_cov"),
        (lambda: found.along(noise_weight=np.eye(3)), SHAPE, "noise_weight has shape"),
        (lambda: found.state, AttributeError, "state"),
    ):
        with pytest.raises(error, match=words):
            call()
    mhe.reset()
    bent = qpmhe.Constraint(lambda x, w: x[..., 0] ** 2 + w[..., 1] ** 2 - 0.9)
    for case, words in (
        (mhe, "no estimate yet"),
        (Case(lambda P, Q, R, _: Own(prior=P, disturbance=Q, noise=R)).estimator(),
         "Own has no second derivatives"),
        (Case(constraints=[bent]).estimator(), "row 0 of the nonlinear constraints"),
    ):
        with pytest.raises(INVALID, match=words):
            case.sensitivity()


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_the_estimator_goes_on_as_its_twin_and_what_was_handed_out_stays(engine):
    case = Case(samples=12, horizon=5, **ALL)
    Y, U = case.data.measurements, case.data.inputs
    Y[...] = Y.mean(axis=0)
    start = case.data._replace(measurements=Y[:6], inputs=U[:6])
    twin, mhe = (case.estimator(start, engine=engine) for _ in range(2))
    first, cotangent = mhe.sensitivity(), np.ones((6, 2))
    expected = {name: getattr(first.adjoint(cotangent), name) for name in NAMES}
    # Until the window's arrays are full, and move.
    for y, u in zip(np.tile(Y, (4, 1)), np.tile(U, (4, 1)), strict=True):
        found, estimate = twin.update(y, u), mhe.update(y, u)
        np.testing.assert_array_equal(estimate.trajectory, found.trajectory)
        found = mhe.sensitivity()
        for one in (found.trajectory, found.step, found.adjoint([1.0, 0.0]).noise_weights):
            one[...] = np.nan
    gradient = first.adjoint(cotangent)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(gradient, name), expected[name])


def test_rows_that_were_dropped_do_not_hold():
    mhe = Case(states=qpmhe.Box([-1.0, -1.2], [2.0, 2.0]), noises=symmetric(1.5, 1.5)).estimator()
    estimate = mhe.update([6.0, 6.0], [0.0])
    assert qpmhe.Status.ROWS_DROPPED in estimate.status
    found = mhe.sensitivity()
    np.testing.assert_allclose(found.trajectory, estimate.trajectory, atol=1e-12)
    dropped = {row[:4] for row in estimate.dropped}
    assert dropped.isdisjoint(row[:4] for row in found.active)


def test_memory_grows_with_the_window():
    # One factorisation of a banded matrix: no array has the square of the window's length.
    mhe = Case(samples=120, horizon=120, **SETS["noise-free"][0]).estimator(max_qps=1)
    tracemalloc.start()
    _ = mhe.sensitivity().adjoint(np.ones(2)).measurements
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 8 * (121 * 2) ** 2
