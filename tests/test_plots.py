"""What the figures show, read from their lines."""

import numpy as np
import pytest
from matplotlib.figure import Figure

import qpmhe
from qpmhe import Status, plots
from qpmhe.errors import ShapeError


@pytest.fixture(scope="module")
def case():
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    states, measurements = scenario.simulate(0, 30)
    measurements[12:15] = np.nan
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate
    )
    run = mhe.run(measurements, covariances=True)
    mhe.reset()
    estimate = [mhe.update(y) for y in measurements[:17]][-1]
    return states, run, estimate


def lines(panel):
    return {line.get_label(): line.get_xydata() for line in panel.lines}


def test_states_with_bands(case):
    states, run, _ = case
    axes = plots.states(run, dt=0.1, truth=states, sigmas=3.0)
    for j, panel in enumerate(axes):
        drawn = lines(panel)
        np.testing.assert_array_equal(drawn["estimate"][:, 1], run.states[:, j])
        np.testing.assert_array_equal(drawn["real"][:, 1], states[:, j])
        np.testing.assert_allclose(drawn["real"][:, 0], 0.1 * np.arange(31))
        low, high = panel.collections[0].get_paths()[0].get_extents().get_points()[:, 1]
        half = 3.0 * np.sqrt(run.covariances[:, j, j])
        assert low == pytest.approx((run.states[1:, j] - half).min())
        assert high == pytest.approx((run.states[1:, j] + half).max())
    assert len(axes[0].figure.legends) == 1


def test_the_window_stands_at_its_times(case):
    _, _, estimate = case
    axes = plots.window(estimate)
    for j, panel in enumerate(axes):
        best, candidate = panel.lines
        np.testing.assert_array_equal(best.get_ydata(), estimate.trajectory[:, j])
        np.testing.assert_array_equal(candidate.get_ydata(), estimate.candidate[:, j])
        # Seventeen samples, the last at t = 16: the window ends at the estimate of x(17).
        np.testing.assert_array_equal(best.get_xdata(), np.arange(7, 18))


def test_costs_mark_the_steps_that_kept_the_candidate(case):
    _, run, _ = case
    drawn = lines(plots.costs(run))
    np.testing.assert_array_equal(drawn["estimate"][:, 1], run.costs)
    np.testing.assert_array_equal(drawn["candidate"][:, 1], run.candidate_costs)
    assert "candidate kept" not in drawn
    run.flags[4] ^= Status.IMPROVED.value | Status.CANDIDATE.value
    try:
        assert lines(plots.costs(run))["candidate kept"][:, 0].tolist() == [5.0]
    finally:
        run.flags[4] ^= Status.IMPROVED.value | Status.CANDIDATE.value


def test_outcomes_have_a_row_for_what_occurred(case):
    _, run, _ = case
    panel = plots.outcomes(run)
    assert [text.get_text() for text in panel.get_yticklabels()] == [
        "improved (100%)", "missing data (10%)"
    ]
    assert panel.lines[1].get_xdata().tolist() == [13.0, 14.0, 15.0]


def test_step_times_tell_how_many_are_late(case):
    _, run, _ = case
    deadline = float(np.median(run.times))
    panel = plots.step_times(run, deadline=deadline)
    late = (run.times > deadline).mean()
    assert f"{late:.1%}" in panel.texts[0].get_text()
    steps = lines(panel)["whole step"]
    np.testing.assert_allclose(steps[:, 0], 1e6 * np.sort(run.times))
    assert steps[0, 1] == 1.0


@pytest.mark.parametrize("draw", [plots.costs, plots.outcomes, plots.step_times])
def test_given_axes_are_drawn_into_and_returned(case, draw):
    panel = Figure().subplots()
    assert draw(case[1], axes=panel) is panel
    assert panel.lines


def test_given_axes_must_be_as_many_as_states(case):
    panels = Figure().subplots(2)
    assert plots.states(case[1], axes=panels) == list(panels)
    with pytest.raises(ShapeError, match="expected 2"):
        plots.states(case[1], axes=panels[:1])


def test_figures_are_written(case, tmp_path):
    for path in plots.save(plots.costs(case[1]).figure, tmp_path / "new" / "costs"):
        assert path.stat().st_size > 1000
