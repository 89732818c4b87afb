"""Models that break, measurements missing or absurd: survived, told and recovered from."""

import numpy as np
import pytest
from estimator.untraced import untraced
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status

from .plain import observer_path, true_cost

A = np.array([[1.0, 0.1], [-0.1, 0.95]])
GAIN = np.array([[0.3], [0.2]])
WEIGHTS = (1e3 * np.eye(2), 1e4 * np.eye(2), 2500.0 * np.eye(1))
GOOD = 0.1  # what the error of a healthy estimator stays below on these records
HORIZON, Z0 = 5, np.array([0.5, 0.0])

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def f(x):
    return x @ A.T


def h(x):
    return x[..., :1]


def record(steps=40, seed=0):
    rng = np.random.default_rng(seed)
    X, Y = [np.array([1.0, 0.5])], []
    for _ in range(steps):
        Y.append(h(X[-1]) + 0.02 * rng.standard_normal(1))
        X.append(f(X[-1]) + 0.01 * rng.standard_normal(2))
    return np.array(X), np.array(Y)


def estimator(f=f, h=h, *, observer=None, prior=WEIGHTS[0], f_jacobian=None, h_jacobian=None,
              noises=None, **options):
    # As they are written: of a trace, nothing breaks.
    system = qpmhe.System(
        untraced(f), untraced(h), n=2, p=1, f_jacobian=f_jacobian, h_jacobian=h_jacobian,
        noises=noises,
    )
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=WEIGHTS[1], noise=WEIGHTS[2])
    options = {"horizon": HORIZON, "initial_state": Z0, **options}
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger(GAIN), cost, **options
    )


def step(mhe, y, Y):
    """One update held to the promise; Y are the measurements up to this one."""
    estimate = mhe.update(y)
    assert estimate.time == len(Y) - 1
    assert mhe.time == len(Y)
    assert estimate.cost <= estimate.candidate_cost
    assert np.isfinite(estimate.trajectory).all()
    assert np.isfinite(estimate.candidate).all()
    assert estimate.trajectory.shape == (min(len(Y), HORIZON) + 1, 2)
    if np.isfinite(estimate.cost):
        prior = estimate.candidate[0]
        true, slack = true_cost(f, h, estimate.trajectory, prior, Y[-HORIZON:], WEIGHTS)
        assert abs(estimate.cost - true) <= 1e-9 * true + slack
    return estimate


def minimum(prior, Y):
    """The least J of a window of the linear system."""

    def residuals(flat):
        x = flat.reshape(-1, 2)
        w, v = x[1:] - f(x[:-1]), Y - h(x[:-1])
        return np.concatenate([np.sqrt(1e3) * (x[0] - prior), 100.0 * w.ravel(), 50.0 * v.ravel()])

    return 2.0 * least_squares(residuals, np.zeros(2 * len(Y) + 2), method="lm").cost


class Fragile:
    """A model function that can be broken and repaired."""

    def __init__(self, function, how):
        self.function, self.how, self.broken = function, how, False

    def __call__(self, x):
        return BREAKAGES[self.how](self.function(x)) if self.broken else self.function(x)


def _raise(error):
    def broken(value):
        raise error

    return broken


BREAKAGES = {
    "ValueError": _raise(ValueError("outside of the domain")),
    "ZeroDivisionError": _raise(ZeroDivisionError("division by zero")),
    "OverflowError": _raise(OverflowError("math range error")),
    "a solver's KeyError": _raise(KeyError("x")),
    "nan": lambda value: value * np.nan,
    "inf": lambda value: value + np.inf,
    "overflow": lambda value: (value + 1.0) * 1e306 * 1e6,
    "squares overflow": lambda value: value + 1e200,
    "nothing": lambda value: None,
    "wrong shape": lambda value: np.zeros(7),
    "text": lambda value: "nan",
    "complex": lambda value: value + 1j,
}


@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("part", ["f", "h"])
@pytest.mark.parametrize("how", BREAKAGES)
def test_a_model_that_breaks_for_a_while(how, part, max_qps):
    X, Y = record()
    functions = {"f": f, "h": h}
    functions[part] = fragile = Fragile(functions[part], how)
    mhe = estimator(**functions, max_qps=max_qps)
    for t in range(40):
        fragile.broken = t in (10, 11, 20)
        estimate = step(mhe, Y[t], Y[: t + 1])
        assert (Status.MODEL_FAILED in estimate.status) == fragile.broken
        assert Status.MISSING not in estimate.status
        spoilt = 10 <= t < 11 + HORIZON or 20 <= t < 20 + HORIZON
        assert spoilt or np.isfinite(estimate.candidate_cost)
        if fragile.broken:
            assert Status.CANDIDATE in estimate.status
        elif max_qps != 0:
            # The measurement of a failed step has stayed: the estimate fits it like the others.
            assert np.isfinite(estimate.cost)
            fit = Y[max(0, t + 1 - HORIZON) : t + 1] - h(estimate.trajectory[:-1])
            np.testing.assert_allclose(estimate.noises, fit, atol=1e-12)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("how", ["ValueError", "nan"])
def test_convergence_does_not_suffer_from_a_failed_stage(how):
    _, Y = record()
    fragile = Fragile(f, how)
    mhe = estimator(fragile, max_qps=None)
    for t in range(25):
        fragile.broken = t == 10
        estimate = step(mhe, Y[t], Y[: t + 1])
        if not fragile.broken:
            best = minimum(estimate.candidate[0], Y[max(0, t + 1 - HORIZON) : t + 1])
            assert estimate.cost == pytest.approx(best, rel=1e-6)


def test_no_claim_of_convergence_without_a_finite_cost():
    _, Y = record()
    fragile = Fragile(f, "nan")
    mhe = estimator(fragile, max_qps=2)
    for t in range(20):
        fragile.broken = t >= 10
        estimate = step(mhe, Y[t], Y[: t + 1])
        assert np.isfinite(estimate.cost) == (t < 10)
        if fragile.broken:
            assert Status.CONVERGED not in estimate.status


def test_a_model_broken_for_longer_than_the_window_comes_back():
    X, Y = record(120)
    fragile = Fragile(f, "ValueError")
    mhe = estimator(fragile, max_qps=2)
    for t in range(120):
        fragile.broken = 5 <= t < 90
        estimate = step(mhe, Y[t], Y[: t + 1])
    assert np.isfinite(estimate.candidate_cost)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("how", ["raises", "nan"])
def test_a_trial_outside_of_the_model_domain_is_dropped_or_shortened(how):
    # The candidate stays inside |x| < 1.5; measurements draw every QP far out of it.
    def narrow(x):
        inside = np.abs(x).max() < 1.5
        if how == "raises" and not inside:
            raise ValueError("outside of the domain")
        return f(x) if inside else f(x) * np.nan

    mhe = estimator(narrow, observer=qpmhe.Luenberger([0.0, 0.0]), max_qps=3)
    Y = np.full((12, 1), 30.0)
    for t in range(12):
        estimate = step(mhe, Y[t], Y[: t + 1])
        assert np.isfinite(estimate.cost)
        assert np.abs(estimate.trajectory[:-1]).max() < 1.5
        assert Status.MODEL_FAILED not in estimate.status
        assert estimate.improved  # a shorter step stays inside and helps


@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("how", ["raises", "nan"])
def test_an_observer_thrown_out_of_the_model_domain_comes_back(how, max_qps):
    def narrow(x):
        inside = np.abs(x).max() < 10.0
        if how == "raises" and not inside:
            raise ValueError("outside of the domain")
        return f(x) if inside else f(x) * np.nan

    X, Y = record(80)
    Y[10] = 100.0  # one outlier, which the observer follows
    mhe = estimator(narrow, max_qps=max_qps)
    for t in range(80):
        estimate = step(mhe, Y[t], Y[: t + 1])
    assert np.isfinite(estimate.cost)
    assert Status.MODEL_FAILED not in estimate.status
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("max_qps", [1, 2, None])
@pytest.mark.parametrize("how", ["raises", "nan", "inf"])
@pytest.mark.parametrize("part", ["f_jacobian", "h_jacobian"])
def test_an_observer_without_jacobians_does_not_mind_theirs_breaking(part, how, max_qps):
    # For x_1 < 0 there is no Jacobian. A Luenberger observer does not read it: the candidate
    # is the observer all the same, and its cost is known.
    def jacobian(x, matrix):
        value = np.broadcast_to(matrix, (*x.shape[:-1], *matrix.shape)).copy()
        if how == "raises" and (x[..., 0] < 0.0).any():
            raise ValueError("no derivative here")
        value[x[..., 0] < 0.0] = np.nan if how == "nan" else np.inf
        return value

    X, Y = record(80)
    given = {"f_jacobian": A, "h_jacobian": np.array([[1.0, 0.0]])}
    mhe = estimator(**{part: lambda x: jacobian(x, given[part])}, max_qps=max_qps)
    path, failures = observer_path(f, h, GAIN, Z0, Y), 0
    assert (path[:, 0] < 0.0).any()
    for t in range(80):
        estimate = step(mhe, Y[t], Y[: t + 1])
        failures += Status.MODEL_FAILED in estimate.status
        assert estimate.candidate.tolist() == path[max(0, t + 1 - HORIZON) : t + 2].tolist()
        assert np.isfinite(estimate.candidate_cost)
    assert failures > 0
    assert np.abs(estimate.state - X[-1]).max() < GOOD


def test_an_observer_with_jacobians_survives_theirs_breaking():
    X, Y = record(60)
    broken = Fragile(lambda x: np.broadcast_to(A, (*x.shape[:-1], 2, 2)), "ValueError")
    observer = qpmhe.ExtendedKalman(
        prior=np.eye(2), disturbance=1e-4 * np.eye(2), noise=4e-4
    )
    mhe = estimator(f_jacobian=broken, observer=observer, max_qps=2)
    for t in range(60):
        broken.broken = t in (10, 30, 31)
        estimate = step(mhe, Y[t], Y[: t + 1])
        assert (Status.MODEL_FAILED in estimate.status) == broken.broken
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("max_qps", [0, 1, None])
def test_all_samples_missing_is_open_loop(max_qps):
    mhe, z, Y = estimator(max_qps=max_qps), Z0, np.full((12, 1), np.nan)
    for t in range(12):
        estimate = step(mhe, Y[t], Y[: t + 1])
        z = f(z)
        assert Status.MISSING in estimate.status
        assert estimate.cost == 0.0
        assert estimate.state.tolist() == z.tolist()
        assert np.isnan(estimate.noises).all()
        assert not estimate.disturbances.any()


@pytest.mark.parametrize("gap", [np.nan, np.inf, -np.inf, None])
@pytest.mark.parametrize("lost", ["first", "half", "stretch"])
def test_missing_samples(lost, gap):
    X, Y = record(60)
    mask = {
        "first": np.arange(60) == 0,
        "half": np.random.default_rng(1).random(60) < 0.5,
        "stretch": (np.arange(60) >= 20) & (np.arange(60) < 20 + 2 * HORIZON),
    }[lost]
    Y[mask] = np.nan
    mhe = estimator(max_qps=None)
    for t in range(60):
        estimate = step(mhe, [gap] if mask[t] else Y[t], Y[: t + 1])
        assert (Status.MISSING in estimate.status) == mask[t]
        assert Status.MODEL_FAILED not in estimate.status
        window = mask[max(0, t + 1 - HORIZON) : t + 1]
        assert np.isnan(estimate.noises[:, 0]).tolist() == window.tolist()
    assert np.abs(estimate.state - X[-1]).max() < GOOD


def test_a_missing_sample_is_not_held_to_the_noise_set():
    # Nothing was measured, so there is no noise that could be outside of V, although the
    # output itself is.
    offset = np.array([9.0, 0.0])

    def shifted(x):
        return f(x - offset) + offset

    Y = record(40)[1] + 9.0
    Y[::2] = np.nan

    def run(noises):
        mhe = estimator(shifted, initial_state=Z0 + offset, noises=noises, max_qps=None)
        return mhe.run(Y)

    free, boxed = run(None), run(qpmhe.Box(-5.0, 5.0))
    assert free.costs[-1] < 0.9 * free.candidate_costs[-1]
    np.testing.assert_allclose(boxed.costs, free.costs, rtol=1e-6)
    np.testing.assert_allclose(boxed.states, free.states, rtol=1e-6)


@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("value", [1e155, -1e200, 1.7e308])
def test_an_outlier_whose_square_overflows_is_left_behind(value, max_qps):
    X, Y = record(60)
    Y[[10, 30]] = value
    mhe = estimator(max_qps=max_qps)
    for t in range(60):
        estimate = step(mhe, Y[t], Y[: t + 1])
        told = Status.MODEL_FAILED in estimate.status or Status.MISSING in estimate.status
        assert told == (t in (10, 30))
    assert np.isfinite(estimate.candidate_cost)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
@pytest.mark.parametrize("value", [1e8, 1e30, 1e150, -1e308])
def test_no_outlier_raises_with_any_backend(backend, value):
    _, Y = record(9)
    Y[3] = value
    mhe = estimator(backend=backend, max_qps=2, max_solver_iterations=10)
    with np.errstate(all="ignore"):
        for t in range(9):
            step(mhe, Y[t], Y[: t + 1])


def test_an_input_that_is_not_finite_spoils_its_step_only():
    X, Y = record(40)
    system = qpmhe.System(lambda x, u: f(x) + (u - 1.0), lambda x, u: h(x), n=2, p=1, m=1)
    cost = qpmhe.QuadraticCost(prior=WEIGHTS[0], disturbance=WEIGHTS[1], noise=WEIGHTS[2])
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(GAIN), cost, horizon=HORIZON, initial_state=Z0
    )
    for t in range(40):
        estimate = mhe.update(Y[t], [np.nan if t == 10 else 1.0])
        assert (Status.MODEL_FAILED in estimate.status) == (t == 10)
        assert np.isfinite(estimate.trajectory).all()
    assert np.isfinite(estimate.cost)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


def test_floating_point_errors_that_the_caller_made_exceptions_stay_inside():
    _, Y = record(20)
    Y[[3, 4, 5]] = [[1e200], [np.nan], [1e150]]
    fragile = Fragile(f, "overflow")
    mhe = estimator(fragile, max_qps=None)
    with np.errstate(all="raise"):
        for t, y in enumerate(Y):
            fragile.broken = t == 8
            mhe.update(y)
    assert mhe.time == 20


def test_refused_input_leaves_the_estimator_as_it_was():
    _, Y = record(20)
    mhe, spared = estimator(max_qps=2), estimator(max_qps=2)
    for y in Y:
        for refused in ([1.0, 2.0], [[1.0]], "y", 1j, {"y": 1.0}, 10**400):
            with pytest.raises(qpmhe.errors.InvalidInputError):
                mhe.update(refused)
        with pytest.raises(qpmhe.errors.InvalidInputError):
            mhe.update(y, [1.0])
        assert mhe.update(y).trajectory.tolist() == spared.update(y).trajectory.tolist()


def test_a_reset_after_a_failure_forgets_it():
    _, Y = record(20)
    fragile = Fragile(f, "nan")
    mhe = estimator(fragile)
    fragile.broken = True
    for y in Y[:7]:
        mhe.update(y)
    fragile.broken = False
    mhe.reset()
    assert mhe.time == 0
    assert mhe.run(Y).states.tolist() == estimator().run(Y).states.tolist()


def test_a_model_may_return_the_same_array_every_time():
    # As wrappers of compiled code do: the array is overwritten by the next call.
    memory = np.empty(2)

    def reusing(x):
        if x.ndim > 1:
            raise TypeError("one state at a time")
        memory[...] = A @ x
        return memory

    _, Y = record(20)
    mhe, path = estimator(reusing, max_qps=2), observer_path(f, h, GAIN, Z0, Y)
    for t in range(20):
        estimate = step(mhe, Y[t], Y[: t + 1])
        expected = path[max(0, t + 1 - HORIZON) : t + 2]
        np.testing.assert_allclose(estimate.candidate, expected, rtol=1e-12)


def test_what_the_caller_does_to_an_estimate_does_not_come_back():
    _, Y = record(20)
    mhe, spared = estimator(max_qps=2), estimator(max_qps=2)
    for y in Y:
        measurement = y.copy()
        estimate, expected = mhe.update(measurement), spared.update(y)
        assert estimate.trajectory.tolist() == expected.trajectory.tolist()
        for array in (measurement, estimate.trajectory, estimate.candidate):
            array[...] = np.nan
        estimate.disturbances[...] = np.nan
