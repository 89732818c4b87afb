"""Fixed-lag smoothed estimates of a run against the joint distribution of all states."""

import numpy as np
import pytest

import qpmhe
from qpmhe import plots
from qpmhe.errors import InvalidInputError, OptionError

A, C = np.array([[0.9, 0.4], [-0.2, 0.8]]), np.array([[1.0, 0.5]])
P, Q, R, START = np.diag([4.0, 9.0]), np.diag([0.1, 0.3]), np.array([[0.2]]), np.array([1.0, -1.0])
HORIZON, STEPS = 5, 14


def estimator():
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(lambda x: x @ A.T, lambda x: x @ C.T, n=2, p=1),
        qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R),
        qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=R),
        horizon=HORIZON, initial_state=START)


def record():
    y = np.random.default_rng(3).normal(size=(STEPS, 1))
    y[6] = np.nan
    return y


def joint(y):
    """Means and covariances of x(0), ..., x(len(y)), given y."""
    count = len(y) + 1
    information, rows = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
    information[:2, :2], rows[:2] = np.linalg.inv(P), np.linalg.solve(P, START)
    for t, value in enumerate(y):
        at, both = slice(2 * t, 2 * t + 2), slice(2 * t, 2 * t + 4)
        step = np.hstack((-A, np.eye(2)))
        information[both, both] += step.T @ np.linalg.solve(Q, step)
        if np.isfinite(value).all():
            information[at, at] += C.T @ np.linalg.solve(R, C)
            rows[at] += C.T @ np.linalg.solve(R, value)
    covariance = np.linalg.inv(information)
    blocks = [covariance[k : k + 2, k : k + 2] for k in range(0, 2 * count, 2)]
    return (covariance @ rows).reshape(count, 2), np.array(blocks)


@pytest.mark.parametrize("lag", [3, 0, HORIZON - 1])
def test_they_are_the_smoothers_with_their_covariances(lag):
    y = record()
    run = estimator().run(y, covariances=True, smoothed=lag)
    for t in range(STEPS + 1):
        mean, covariance = (one[t] for one in joint(y[: t + lag + 1]))
        np.testing.assert_allclose(run.smoothed[t], mean, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(run.smoothed_covariances[t], covariance, rtol=1e-9)
    np.testing.assert_array_equal(run.smoothed[-1], run.states[-1])
    np.testing.assert_array_equal(run.smoothed[-2], run.filtered[-1])
    np.testing.assert_array_equal(run.smoothed_covariances[-1], run.covariances[-1])


def test_a_run_that_goes_on_smooths_its_own_times():
    y, mhe = record(), estimator()
    whole = estimator().run(y, smoothed=2)
    mhe.run(y[:8])
    later = mhe.run(y[8:], smoothed=2)
    np.testing.assert_array_equal(later.smoothed, whole.smoothed[8:])
    assert later.smoothed_covariances is None


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_records_shorter_than_the_lag(steps):
    run = estimator().run(record()[:steps], covariances=True, smoothed=4)
    assert run.smoothed.shape == (steps + 1, 2)
    assert run.smoothed_covariances.shape == (steps + 1, 2, 2)
    if steps:
        mean, covariance = joint(record()[:steps])
        np.testing.assert_allclose(run.smoothed, mean, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(run.smoothed_covariances, covariance, rtol=1e-9)
    else:
        np.testing.assert_array_equal(run.smoothed, START[None])


def test_the_table_the_file_and_the_figure_have_them(tmp_path):
    pytest.importorskip("pandas")
    run = estimator().run(record(), covariances=True, smoothed=3)
    table = run.to_frame()
    np.testing.assert_array_equal(table[["smoothed1", "smoothed2"]], run.smoothed)
    np.testing.assert_allclose(table["smoothed_std2"] ** 2, run.smoothed_covariances[:, 1, 1])
    run.save(tmp_path / "run.npz")
    again = qpmhe.load_run(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.smoothed, run.smoothed)
    for j, panel in enumerate(plots.states(again, smoothed=True, sigmas=3.0)):
        line = next(one for one in panel.lines if one.get_label() == "estimate, smoothed")
        np.testing.assert_array_equal(line.get_ydata(), run.smoothed[:, j])
        half = 3.0 * np.sqrt(run.smoothed_covariances[:, j, j])
        (band,) = panel.collections
        ends = band.get_paths()[0].get_extents().get_points()[:, 1]
        both = (run.smoothed[:, j] - half).min(), (run.smoothed[:, j] + half).max()
        assert ends == pytest.approx(both)


def test_lags_outside_the_window_and_runs_without_them_are_refused():
    for lag in (HORIZON, -1, 1.5, True):
        with pytest.raises(OptionError, match="smoothed is"):
            estimator().run(record(), smoothed=lag)
    with pytest.raises(InvalidInputError, match="no smoothed estimates"):
        plots.states(estimator().run(record()), smoothed=True)
