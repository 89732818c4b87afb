"""What the figures show, read from their lines."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import qpmhe
from qpmhe import Status, plots
from qpmhe.errors import InvalidInputError, OptionError, ShapeError


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
        np.testing.assert_array_equal(drawn["truth"][:, 1], states[:, j])
        np.testing.assert_allclose(drawn["truth"][:, 0], 0.1 * np.arange(31))
        low, high = panel.collections[0].get_paths()[0].get_extents().get_points()[:, 1]
        half = 3.0 * np.sqrt(run.covariances[:, j, j])
        assert low == pytest.approx((run.states[1:, j] - half).min())
        assert high == pytest.approx((run.states[1:, j] + half).max())
    assert len(axes[0].figure.legends) == 1


def test_a_band_that_holds_the_truth_is_drawn_behind(case):
    states, run, _ = case
    lower, upper = run.states - [1.0, 2.0], run.states + 3.0
    lower[20:], upper[20:] = np.nan, np.nan
    axes = plots.states(run, dt=0.1, truth=states, band=(lower, upper))
    for j, panel in enumerate(axes):
        band = panel.collections[-1]
        low, high = band.get_paths()[0].get_extents().get_points()
        assert low == pytest.approx((0.0, np.nanmin(lower[:, j])))
        assert high == pytest.approx((1.9, np.nanmax(upper[:, j])))
        assert band.get_zorder() < min(line.get_zorder() for line in panel.lines)
    (legend,) = axes[0].figure.legends
    assert "holds the true state (proved)" in [each.get_text() for each in legend.get_texts()]


def test_estimates_of_angles_are_drawn_on_the_turn_of_the_truth():
    system, observer, cost, scenario = qpmhe.models.vehicle()
    record = scenario.simulate(0, 60)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=scenario.initial_estimate)
    run = mhe.run(record.measurements, record.inputs, covariances=True)
    far = np.abs(run.states - record.states)[:, 2].max()
    assert far > 6.0
    for residual, most in ((None, np.inf), (system.state_residual, 1.0)):
        panel = plots.states(run, truth=record.states, residual=residual)[2]
        drawn = lines(panel)
        error = np.abs(drawn["estimate"][:, 1] - drawn["truth"][:, 1]).max()
        assert error < most
        assert error == far or residual is not None
        low, high = panel.collections[0].get_paths()[0].get_extents().get_points()[:, 1]
        assert low < drawn["estimate"][1:, 1].min()
        assert high > drawn["estimate"][1:, 1].max()


def test_time_is_in_seconds_where_the_step_is_known(case):
    _, run, estimate = case
    for panel in (plots.states(run)[-1], plots.costs(run), plots.outcomes(run)):
        assert panel.get_xlabel() == "time t (s)"
        assert panel.lines[0].get_xdata()[-1] == pytest.approx(3.0)
    assert plots.costs(run, time_label="time t (min)").get_xlabel() == "time t (min)"
    assert plots.window(estimate)[-1].get_xlabel() == "time t (samples)"
    assert plots.window(estimate, dt=0.1)[-1].get_xlabel() == "time t (s)"
    steps = np.linspace(0.1, 0.2, 30)
    source, run.source = run.source, run.source._replace(steps=steps)
    try:
        drawn = lines(plots.states(run)[0])["estimate"]
        np.testing.assert_allclose(drawn[:, 0], [0.0, *np.cumsum(steps)])
        run.source = None
        assert plots.states(run)[-1].get_xlabel() == "time t (samples)"
    finally:
        run.source = source


def test_one_thing_has_one_colour(case):
    _, run, estimate = case
    states, colors = run.states, plots.COLORS
    (panel, _) = plots.trajectories(
        np.arange(31.0), states, {"EKF": states, "observer alone": states, "MHE, 2 QPs": states,
                                  "i = 0": states}, ["x", "y"], "time")
    found = {line.get_label(): line.get_color() for line in panel.lines}
    assert found["truth"] == colors["truth"]
    assert found["observer alone"] == found["i = 0"] == colors["observer"]
    assert found["MHE, 2 QPs"] == colors["estimate"]
    assert found["EKF"] not in colors.values()
    for drawn in (plots.costs(run), plots.window(estimate)[0]):
        found = {line.get_label().partition(",")[0]: line.get_color() for line in drawn.lines}
        assert found["estimate"] == colors["estimate"]
        assert found["candidate"] == colors["observer"]


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
        assert lines(plots.costs(run, dt=2.0))["candidate kept"][:, 0].tolist() == [10.0]
    finally:
        run.flags[4] ^= Status.IMPROVED.value | Status.CANDIDATE.value


def test_outcomes_have_a_row_for_what_occurred(case):
    _, run, _ = case
    panel = plots.outcomes(run)
    assert [text.get_text() for text in panel.get_yticklabels()] == [
        "improved (100%)", "missing data (10%)"
    ]
    assert panel.lines[1].get_xdata() == pytest.approx([1.3, 1.4, 1.5])


def test_step_times_tell_how_many_are_late(case):
    _, run, _ = case
    deadline = float(np.median(run.times))
    panel = plots.step_times(run, deadline=deadline)
    late = (run.times > deadline).mean()
    texts = [text.get_text() for text in panel.get_legend().get_texts()]
    assert f"deadline ({late:.1%} late)" in texts
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


@pytest.fixture(scope="module")
def empty():
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate
    )
    return mhe.run(np.empty((0, 1)), covariances=True)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"labels": ["a"]}, ShapeError, r"labels are \['a'\]; expected 2"),
        ({"labels": ["a", "b", "c"]}, ShapeError, "expected 2, one per state"),
        ({"labels": []}, ShapeError, r"labels are \[\]; expected 2"),
        ({"labels": "ab"}, InvalidInputError, r"labels are 'ab'; expected a sequence"),
        ({"labels": [1, 2]}, InvalidInputError, "sequence of strings"),
        ({"truth": np.zeros((30, 2))}, ShapeError, r"truth has shape \(30, 2\).*\(31, 2\), a row"),
        ({"truth": np.zeros((31, 3))}, ShapeError, r"truth has shape \(31, 3\).*\(31, 2\)"),
        ({"truth": "none"}, InvalidInputError, "truth is 'none'"),
        ({"dt": 0}, OptionError, "dt is 0; expected a finite number > 0"),
        ({"dt": -1.0}, OptionError, "dt is -1.0"),
        ({"sigmas": -2.0}, OptionError, "sigmas is -2.0"),
        ({"axes": 3}, InvalidInputError, "axes contain 3; expected matplotlib Axes, 2"),
        ({"axes": Figure()}, InvalidInputError, "axes contain .*Figure"),
        ({"band": np.zeros((31, 2))}, InvalidInputError, r"band is of type ndarray.*\(lower,"),
        ({"band": (np.zeros((31, 2)), 0.0)}, ShapeError, r"band\[1\] has shape \(\)"),
        ({"band": (np.zeros((30, 2)), np.zeros((31, 2)))}, ShapeError, r"band\[0\] has shape"),
    ],
)
def test_states_refuse_what_does_not_fit(case, options, error, words):
    with pytest.raises(error, match=words):
        plots.states(case[1], **options)


@pytest.mark.parametrize("options", [{"labels": ["a"]}, {"dt": 0.0}, {"axes": [3, 4]}])
def test_the_window_refuses_what_does_not_fit(case, options):
    with pytest.raises(InvalidInputError, match="expected"):
        plots.window(case[2], **options)


@pytest.mark.parametrize("draw", [plots.costs, plots.outcomes])
@pytest.mark.parametrize("dt", [0.0, -0.1, float("nan"), "1"])
def test_steps_refuse_times_that_do_not_rise(case, draw, dt):
    with pytest.raises(OptionError, match=r"dt is .*> 0"):
        draw(case[1], dt=dt)


@pytest.mark.parametrize("deadline", [-0.001, 0.0, float("inf")])
def test_a_deadline_is_above_zero(case, deadline):
    with pytest.raises(OptionError, match=r"deadline is .*> 0"):
        plots.step_times(case[1], deadline=deadline)


@pytest.mark.parametrize("draw", [plots.states, plots.costs, plots.outcomes, plots.step_times])
def test_one_estimate_is_no_run(case, draw):
    with pytest.raises(InvalidInputError, match=r"run is of type Estimate; .*plots\.window"):
        draw(case[2])
    with pytest.raises(InvalidInputError, match="axes contain 3"):
        draw(case[1], axes=3)


def test_a_run_is_no_estimate(case):
    with pytest.raises(InvalidInputError, match=r"estimate is of type Run; .*plots\.states"):
        plots.window(case[1])


@pytest.mark.parametrize("draw", [plots.costs, plots.outcomes, plots.step_times])
def test_a_run_without_steps_is_an_empty_picture(empty, draw, tmp_path):
    options = {"deadline": 0.001} if draw is plots.step_times else {}
    panel = Figure(layout="constrained").subplots()
    assert draw(empty, axes=panel, **options) is panel
    # Warnings are errors here, those of writing included.
    plots.save(panel.figure, tmp_path / "empty")


def test_states_of_a_run_without_steps_are_its_start(empty, tmp_path):
    axes = plots.states(empty)
    assert lines(axes[0])["estimate"].tolist() == [[0.0, empty.states[0, 0]]]
    plots.save(axes[0].figure, tmp_path / "empty")


def test_trajectories_take_what_is_an_array():
    (panel,) = plots.trajectories(
        [0, 1, 2], [3, 4, 5], {"estimate": [3.0, 4.0, np.nan]}, ["x"], "time"
    )
    assert lines(panel)["truth"].tolist() == [[0, 3], [1, 4], [2, 5]]


@pytest.mark.parametrize(
    ("times", "estimates", "error", "words"),
    [
        (np.zeros((3, 1)), {}, ShapeError, r"times have shape \(3, 1\)"),
        (np.arange(3), {"mine": np.zeros((2, 1))}, ShapeError, r"estimates\['mine'\] has shape"),
        (np.arange(3), np.zeros((3, 1)), InvalidInputError, "expected a mapping"),
        (
            np.arange(3), {f"number {k}": np.zeros(3) for k in range(7)}, InvalidInputError,
            "estimates are 7: .*at most 6",
        ),
    ],
)
def test_trajectories_refuse_what_does_not_fit(times, estimates, error, words):
    with pytest.raises(error, match=words):
        plots.trajectories(times, None, estimates, ["x"], "time")


@pytest.mark.parametrize(
    ("stem", "written"),
    [
        ("run_0.5", "run_0.5"),
        ("v1.2", "v1.2"),
        ("states.png", "states"),
        ("states.SVG", "states"),
        ("new/states", "new/states"),
    ],
)
@pytest.mark.parametrize("kind", [str, Path])
def test_a_dot_belongs_to_the_name(tmp_path, monkeypatch, stem, written, kind):
    monkeypatch.chdir(tmp_path)
    paths = plots.save(Figure(), kind(stem))
    assert paths == [Path(f"{written}.png"), Path(f"{written}.svg")]
    assert all(path.is_file() for path in paths)


def test_save_refuses_what_does_not_fit(case):
    with pytest.raises(InvalidInputError, match=r"figure is of type Axes; .*axes\.figure"):
        plots.save(plots.costs(case[1]), "costs")
    with pytest.raises(InvalidInputError, match="stem is 3; expected a path"):
        plots.save(Figure(), 3)
    with pytest.raises(InvalidInputError, match="a folder"):
        plots.save(Figure(), "..")
