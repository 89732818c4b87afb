"""Models that break, measurements missing or absurd: survived, reported and recovered from."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import qpmhe
from qpmhe import Status
from tests.covering import covering
from tests.estimation.untraced import untraced

from .plain import observer_path
from .plain import steps as steps_of

A, C = np.array([[1.0, 0.1], [-0.1, 0.95]]), np.array([[1.0, 0.0]])
GAIN = np.array([[0.3], [0.2]])
WEIGHTS = (1e3 * np.eye(2), 1e4 * np.eye(2), 2500.0 * np.eye(1))
GOOD = 0.1  # what the error of a healthy estimator stays below on these records
HORIZON, Z0 = 5, np.array([0.5, 0.0])

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


def f(x):
    return x @ A.T


def h(x):
    return x[..., :1]


def record(steps=40):
    rng = np.random.default_rng(0)
    X, Y = [np.array([1.0, 0.5])], []
    for _ in range(steps):
        Y.append(h(X[-1]) + 0.02 * rng.standard_normal(1))
        X.append(f(X[-1]) + 0.01 * rng.standard_normal(2))
    return np.array(X), np.array(Y)


def estimator(f=f, h=h, observer=None, f_jacobian=None, h_jacobian=None, m=0, **options):
    # As they are written: of a trace, nothing breaks.
    system = qpmhe.System(
        untraced(f), untraced(h), n=2, p=1, m=m, f_jacobian=f_jacobian, h_jacobian=h_jacobian
    )
    prior, disturbance, noise = WEIGHTS
    return qpmhe.MovingHorizonEstimator(
        system, observer or qpmhe.Luenberger(GAIN),
        qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise),
        horizon=HORIZON, initial_state=Z0, **options,
    )


def steps(mhe, Y, before=lambda t: None, given=None):
    return steps_of(mhe, (f, h), Y, WEIGHTS, given=given, before=before)


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
        value = self.function(x)
        if self.broken and isinstance(self.how, Exception):
            raise self.how
        return self.how(value) if self.broken else value


BREAKAGES = {
    "ValueError": ValueError("outside of the domain"),
    "a solver's KeyError": KeyError("x"),
    "nan": lambda value: value * np.nan,
    "overflow": lambda value: (value + 1.0) * 1e306 * 1e6,
    "squares overflow": lambda value: value + 1e200,
    "nothing": lambda value: None,
    "wrong shape": lambda value: np.zeros(7),
    "complex": lambda value: value + 1j,
}


@covering(
    broken=[(10, 11, 20), range(10, 30)], how=BREAKAGES, part=["f", "h"], max_qps=[0, 1, None]
)
def test_a_model_that_breaks_for_a_while(how, part, max_qps, broken):
    X, Y = record(60)
    functions = {"f": f, "h": h}
    functions[part] = fragile = Fragile(functions[part], BREAKAGES[how])
    mhe = estimator(**functions, max_qps=max_qps)

    def spoil(t):
        fragile.broken = t in broken

    for t, estimate in enumerate(steps(mhe, Y, spoil)):
        assert (Status.MODEL_FAILED in estimate.status) == (t in broken)
        window = range(max(0, t + 1 - HORIZON), t + 1)
        assert set(window) & set(broken) or np.isfinite(estimate.candidate_cost)
        if t in broken:
            assert Status.CANDIDATE in estimate.status
            assert np.isfinite(estimate.cost) or Status.CONVERGED not in estimate.status
        elif max_qps != 0 and len(broken) == 3:
            # The measurement of a failed step has stayed: the estimate fits it like the others.
            assert np.isfinite(estimate.cost)
            fit = Y[window] - h(estimate.trajectory[:-1])
            np.testing.assert_allclose(estimate.noises, fit, atol=1e-12)
        if max_qps is None and t in {12, 22, 40} - set(broken):
            best = minimum(estimate.candidate[0], Y[window])
            assert estimate.cost == pytest.approx(best, rel=1e-6)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


def narrow(how, limit):
    def model(x):
        inside = np.abs(x).max() < limit
        if how == "raises" and not inside:
            raise ValueError("outside of the domain")
        return f(x) if inside else f(x) * np.nan

    return model


@pytest.mark.parametrize("how", ["raises", "nan"])
def test_a_trial_outside_of_the_model_domain_is_dropped_or_shortened(how):
    # The candidate stays inside |x| < 1.5; measurements draw every QP far out of it.
    mhe = estimator(narrow(how, 1.5), observer=qpmhe.Luenberger([0.0, 0.0]), max_qps=3)
    for estimate in steps(mhe, np.full((12, 1), 30.0)):
        assert np.isfinite(estimate.cost)
        assert np.abs(estimate.trajectory[:-1]).max() < 1.5
        assert Status.MODEL_FAILED not in estimate.status
        assert estimate.improved  # a shorter step stays inside and helps


GAPS = {
    "first": np.arange(60) == 0,
    "half": np.random.default_rng(1).random(60) < 0.5,
    "stretch": (np.arange(60) >= 20) & (np.arange(60) < 20 + 2 * HORIZON),
}
# The model, where the measurements are spoilt, and by what.
SPOILT = {
    **{f"an outlier, outside it {how}": (narrow(how, 10.0), np.arange(60) == 10, 100.0)
       for how in ("raises", "nan")},
    **{f"missing, {name}, as {gap}": (f, mask, gap)
       for (name, mask), gap in zip(GAPS.items(), (np.nan, np.inf, None), strict=True)},
    **{f"an outlier of {value}": (f, np.isin(np.arange(60), (10, 30)), value)
       for value in (1e155, -1e200, 1.7e308)},
}


@pytest.mark.parametrize("max_qps", [0, 1, None])
@pytest.mark.parametrize("name", SPOILT)
def test_measurements_that_are_missing_or_absurd_are_left_behind(name, max_qps):
    (model, mask, value), (X, Y) = SPOILT[name], record(60)
    Y[mask] = np.nan if value is None else value
    given = [[value] if spoilt else y for y, spoilt in zip(Y, mask, strict=True)]
    for t, estimate in enumerate(steps(estimator(model, max_qps=max_qps), Y, given=given)):
        if value != 100.0:
            reported = estimate.status & (Status.MODEL_FAILED | Status.MISSING)
            assert bool(reported) == mask[t]
            window = mask[max(0, t + 1 - HORIZON) : t + 1]
            assert np.isnan(estimate.noises[:, 0]).tolist() == window.tolist()
    assert np.isfinite(estimate.candidate_cost)
    assert Status.MODEL_FAILED not in estimate.status
    assert np.abs(estimate.state - X[-1]).max() < GOOD


@pytest.mark.parametrize("kalman", [False, True], ids=["luenberger", "kalman"])
@pytest.mark.parametrize("how", ["raises", "nan"])
@pytest.mark.parametrize("part", ["f_jacobian", "h_jacobian"])
def test_jacobians_that_break(part, how, kalman):
    # For x_1 < 0 there is no Jacobian. A Luenberger observer does not read it: the candidate
    # is the observer all the same, and its cost is known.
    def jacobian(x):
        matrix = {"f_jacobian": A, "h_jacobian": C}[part]
        value = np.broadcast_to(matrix, (*x.shape[:-1], *matrix.shape)).copy()
        if how == "raises" and (x[..., 0] < 0.0).any():
            raise ValueError("no derivative here")
        value[x[..., 0] < 0.0] = np.nan
        return value

    X, Y = record(80)
    path, failures = observer_path(f, h, GAIN, Z0, Y), 0
    assert (path[:, 0] < 0.0).any()
    observer = qpmhe.ExtendedKalman(prior=np.eye(2), disturbance=1e-4 * np.eye(2), noise=4e-4)
    mhe = estimator(**{part: jacobian}, max_qps=2, observer=observer if kalman else None)
    for t, estimate in enumerate(steps(mhe, Y)):
        failures += Status.MODEL_FAILED in estimate.status
        if not kalman:
            assert estimate.candidate.tolist() == path[max(0, t + 1 - HORIZON) : t + 2].tolist()
            assert np.isfinite(estimate.candidate_cost)
    assert failures > 0
    assert np.abs(estimate.state - X[-1]).max() < (1.0 if kalman else GOOD)


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
@pytest.mark.parametrize("value", [1e8, 1e30, 1e150, -1e308])
def test_no_outlier_raises_with_any_backend(backend, value):
    _, Y = record(9)
    Y[3] = value
    mhe = estimator(backend=backend, max_qps=2, max_solver_iterations=10)
    with np.errstate(all="ignore"):
        assert len(list(steps(mhe, Y))) == 9


def test_an_input_that_is_not_finite_spoils_its_step_only():
    X, Y = record(40)
    mhe = estimator(lambda x, u: f(x) + (u - 1.0), lambda x, u: h(x), m=1)
    for t in range(40):
        estimate = mhe.update(Y[t], [np.nan if t == 10 else 1.0])
        assert (Status.MODEL_FAILED in estimate.status) == (t == 10)
        assert np.isfinite(estimate.trajectory).all()
    assert np.isfinite(estimate.cost)
    assert np.abs(estimate.state - X[-1]).max() < GOOD


def test_floating_point_errors_that_the_caller_made_exceptions_stay_inside():
    _, Y = record(20)
    Y[[3, 4, 5]] = [[1e200], [np.nan], [1e150]]
    fragile = Fragile(f, BREAKAGES["overflow"])
    mhe = estimator(fragile, max_qps=None)
    with np.errstate(all="raise"):
        for t, y in enumerate(Y):
            fragile.broken = t == 8
            mhe.update(y)
    assert mhe.time == 20
    mhe.reset()  # forgets the failure
    assert mhe.run(Y).states.tolist() == estimator(max_qps=None).run(Y).states.tolist()


def test_refused_input_leaves_the_estimator_as_it_was():
    _, Y = record(20)
    mhe, spared = estimator(max_qps=2), estimator(max_qps=2)
    for y in Y:
        refusals = [(one,) for one in ([1.0, 2.0], [[1.0]], "y", 1j, {"y": 1.0}, 10**400)]
        for refused in [*refusals, (y, [1.0])]:
            with pytest.raises(qpmhe.errors.InvalidInputError):
                mhe.update(*refused)
        assert mhe.update(y).trajectory.tolist() == spared.update(y).trajectory.tolist()
