"""Disturbances in few directions beside a vague prior, in both engines, against 60 digits."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

mp = pytest.importorskip("mpmath")

ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.skipif(
    find_compiler() is None, reason="there is no C compiler"
))]
SAMPLES = 16
TRACK = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[0.5], [1.0]])
JERK = (
    np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]]),
    np.array([[0.2], [0.5], [1.0]]),
)
# A level and a season of four, as statsmodels writes them: two of five states are disturbed.
SEASON = (
    np.array([[1.0, 0, 0, 0], [0, -1, -1, -1], [0, 1, 0, 0], [0, 0, 1, 0]]),
    np.array([[1.0, 1.0, 0.0, 0.0]]), np.eye(4)[:, :2],
)


def filtered(a, c, g, q, variance, ys):
    """Filtered means (T, n) of a Kalman filter from 0, with noise of variance 1, in 60 digits."""
    with mp.workdps(60):
        move, output = mp.matrix(a.tolist()), mp.matrix(c.tolist())
        spread = q * mp.matrix(g.tolist()) * mp.matrix(g.tolist()).T
        mean, covariance, found = mp.zeros(len(a), 1), mp.mpf(variance) * mp.eye(len(a)), []
        for y in ys[:, 0]:
            gain = covariance * output.T / ((output * covariance * output.T)[0] + 1)
            mean = mean + gain * (mp.mpf(float(y)) - (output * mean)[0])
            covariance = covariance - gain * output * covariance
            found.append([float(one) for one in mean])
            mean, covariance = move * mean, move * covariance * move.T + spread
        return np.array(found)


def estimator(model, q, deviation, form, engine, units=1.0, **options):
    a, c, g = model
    n, scale = len(a), np.asarray(units) * np.ones(len(a))
    a, c, g = scale[:, None] * a / scale, c / scale, scale[:, None] * g
    matrix = form == "matrix"
    system = qpmhe.System(
        lambda x: x @ a.T, lambda x: x @ c.T, n=n, p=1,
        disturbance_matrix=g if matrix else None, **options,
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=deviation**2 * np.diag(scale**2), noise=[[1.0]],
        disturbance=q * np.eye(g.shape[1]) if matrix else q * g @ g.T,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.zeros((n, 1))), cost, horizon=SAMPLES,
        initial_state=np.eye(n)[1] if options else np.zeros(n), engine=engine, max_qps=3,
    )
    assert mhe.engine == engine
    return mhe


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("form", ["matrix", "singular covariance"])
@pytest.mark.parametrize("model", [TRACK, JERK, SEASON], ids=["track", "jerk", "season"])
def test_the_estimate_is_the_kalman_filters(model, form, engine):
    """To 1e-4 deviations of the noise for priors of 1e5; the prior alone decides nothing there."""
    ys = 10.0 + np.random.default_rng(0).normal(size=(SAMPLES, 1))
    known = len(model[0])  # from this sample on, the data determine all states
    for deviation, allowed in ((10.0, 1e-6), (1e3, 1e-5), (1e4, 1e-4), (1e5, 1e-3), (1e6, 1e-2)):
        right = filtered(*model, 0.01, deviation**2, ys)
        run = estimator(model, 0.01, deviation, form, engine).run(ys)
        assert np.abs(run.filtered - right)[known:].max() < allowed
        assert not any("CANDIDATE" in one.name for one in map(_outcome, run.statuses[known:]))
        assert (run.costs <= run.candidate_costs).all()


def _outcome(status):
    return status & (qpmhe.Status.IMPROVED | qpmhe.Status.CANDIDATE)


@pytest.mark.parametrize("engine", ENGINES)
def test_no_unit_matters(engine):
    ys = 10.0 + np.random.default_rng(0).normal(size=(SAMPLES, 1))
    units = np.array([2.0**30, 2.0**-20, 2.0**3])
    for deviation in (1.0, 1e5):
        plain, other = (
            estimator(JERK, 0.01, deviation, "matrix", engine, scale).run(ys)
            for scale in (1.0, units)
        )
        np.testing.assert_allclose(other.filtered / units, plain.filtered, rtol=0.0, atol=1e-2)


@pytest.mark.parametrize("sets", [
    {"disturbances": qpmhe.Box([-0.12], [0.12])}, {"noises": qpmhe.Box([-1.5], [1.5])},
    {"states": qpmhe.Box([-np.inf, 0.8, -np.inf], [np.inf, 1.5, 0.05])},
], ids=lambda one: next(iter(one)))
def test_with_active_rows_both_engines_agree(sets):
    if find_compiler() is None:
        pytest.skip("there is no C compiler")
    rng, (a, c, g) = np.random.default_rng(0), JERK
    x, ys = np.array([5.0, 1.0, 0.02]), []
    for _ in range(SAMPLES):
        ys.append(c @ x + rng.normal(size=1))
        x = a @ x + g[:, 0] * np.clip(0.1 * rng.normal(), -0.12, 0.12)
    ys, active = np.array(ys), 0
    free = estimator(JERK, 0.01, 1.0, "matrix", "python").run(ys)
    for deviation, allowed in ((1.0, 1e-6), (1e3, 1e-5), (1e5, 1e-3)):
        one, two = (
            estimator(JERK, 0.01, deviation, "matrix", engine, **sets).run(ys)
            for engine in ("python", "compiled")
        )
        assert np.abs(one.filtered - two.filtered)[3:].max() < allowed
        np.testing.assert_allclose(two.costs[3:], one.costs[3:], rtol=allowed)
        active += np.abs(one.filtered - free.filtered).max() > 1e-3
    assert active == 3


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e7])
@pytest.mark.parametrize("start", [[0.0, 0.0], [1.9, 0.1]])
@pytest.mark.parametrize("ratio", [1e2, 1e6, 1e10])
def test_a_hard_constraint_holds_beside_a_vague_prior(ratio, start, unit):
    """The state with the least J is the point of a ball nearest to y."""
    system = qpmhe.System(
        lambda x: 1.0 * x, lambda x: 1.0 * x, n=2, p=2,
        constraints=[qpmhe.Constraint(lambda x: x @ x / unit**2 - 4.0)],
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=(0.1 * ratio * unit) ** 2 * np.eye(2), disturbance=(0.01 * unit) ** 2 * np.eye(2),
        noise=(0.1 * unit) ** 2 * np.eye(2),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.5 * np.eye(2)), cost, horizon=1,
        initial_state=unit * np.array(start), max_qps=None,
    )
    active = 0
    for y in 2.0 * np.random.default_rng(0).normal(size=(30, 2)):
        x, length = mhe.update(unit * y).trajectory[0] / unit, np.linalg.norm(y)
        active += length > 2.0
        assert x @ x <= 4.0 + 1e-7
        np.testing.assert_allclose(x, y * min(1.0, 2.0 / length), rtol=0, atol=1e-8 + 5 / ratio**2)
    assert active > 10
