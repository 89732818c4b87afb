"""What the figures show, read from their lines."""

from copy import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import qpmhe
from qpmhe import Status, plots
from qpmhe.baselines import ExtendedKalmanFilter, Problem
from qpmhe.errors import InvalidInputError, OptionError, ShapeError
from qpmhe.model.signals import Signal, Signals

SYSTEM, OBSERVER, COST, SCENARIO = qpmhe.models.batch_reactor()


def estimator():
    return qpmhe.MovingHorizonEstimator(
        SYSTEM, OBSERVER, COST, horizon=10, initial_state=SCENARIO.initial_estimate
    )


@pytest.fixture(scope="module")
def case():
    states, measurements = SCENARIO.simulate(0, 30)
    measurements[12:15] = np.nan
    run, mhe = estimator().run(measurements, covariances=True), estimator()
    estimate = [mhe.update(y) for y in measurements[:17]][-1]
    return states, run, estimate


def lines(panel):
    return {line.get_label(): line.get_xydata() for line in panel.lines}


def extents(band):
    return band.get_paths()[0].get_extents().get_points()


def test_states_with_bands(case):
    states, run, _ = case
    lower, upper = run.states - [1.0, 2.0], run.states + 3.0
    lower[20:], upper[20:] = np.nan, np.nan
    guarded = np.clip(run.states, lower + 0.5, upper - 2.9)
    axes = plots.states(run, dt=0.1, truth=states, sigmas=3.0, guarded=guarded)
    proved = plots.states(run, dt=0.1, truth=states, band=(lower, upper))
    for j, panel in enumerate(axes):
        drawn = lines(panel)
        np.testing.assert_array_equal(drawn["estimate"][:, 1], run.states[:, j])
        np.testing.assert_array_equal(drawn["guarded"][:, 1], guarded[:, j])
        np.testing.assert_array_equal(drawn["truth"][:, 1], states[:, j])
        np.testing.assert_allclose(drawn["truth"][:, 0], 0.1 * np.arange(31))
        half = 3.0 * np.sqrt(run.covariances[:, j, j])
        ends = (run.states[1:, j] - half).min(), (run.states[1:, j] + half).max()
        assert extents(panel.collections[0])[:, 1] == pytest.approx(ends)
        band = proved[j].collections[-1]
        ends = [0.0, np.nanmin(lower[:, j])], [1.9, np.nanmax(upper[:, j])]
        assert extents(band) == pytest.approx(np.array(ends))
        assert band.get_zorder() < min(line.get_zorder() for line in proved[j].lines)
    (legend,) = proved[0].figure.legends
    assert "holds the true state (proved)" in [each.get_text() for each in legend.get_texts()]


def test_estimates_of_angles_are_drawn_on_the_turn_of_the_truth():
    system, observer, cost, scenario = qpmhe.models.vehicle()
    record = scenario.simulate(0, 60)
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=5, initial_state=scenario.initial_estimate)
    run = mhe.run(record.measurements, record.inputs, covariances=True)
    assert np.abs(run.states - record.states)[:, 2].max() > 6.0
    panel = plots.states(run, truth=record.states, residual=system.state_residual)[2]
    drawn = lines(panel)
    assert np.abs(drawn["estimate"][:, 1] - drawn["truth"][:, 1]).max() < 1.0
    low, high = extents(panel.collections[0])[:, 1]
    assert low < drawn["estimate"][1:, 1].min() < drawn["estimate"][1:, 1].max() < high


def test_measurements_are_dots_on_the_states_that_they_measure():
    def h(x):
        return np.array([x[2], 2.0 * x[0], x[1] + x[0], x[2]])

    system = qpmhe.System(lambda x: 0.9 * x, h, n=3, p=4)
    given = {"prior": np.eye(3), "disturbance": np.eye(3), "noise": np.eye(4)}
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(**given), qpmhe.QuadraticCost.from_covariances(**given),
        horizon=3, initial_state=[1.0, 2.0, 3.0])
    y = np.random.default_rng(0).normal(size=(12, 4))
    y[3, 0], y[:, 3] = np.nan, np.nan
    run = mhe.run(y, covariances=True)
    axes = plots.states(run, dt=0.5)
    dots = [[line for line in panel.lines if line.get_label() == "measurement"] for panel in axes]
    assert [len(each) for each in dots] == [0, 0, 1]
    np.testing.assert_array_equal(dots[2][0].get_xdata(), 0.5 * np.arange(12))
    np.testing.assert_array_equal(dots[2][0].get_ydata(), y[:, 0])
    assert dots[2][0].get_zorder() < axes[2].collections[0].get_zorder()
    (legend,) = axes[0].figure.legends
    assert "measurement" in [each.get_text() for each in legend.get_texts()]
    states = run.states
    figure = plots.states(run, truth=states, band=(states - 1.0, states + 1.0))[0].figure
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 5
    assert legend.get_window_extent().x0 >= 0.0
    assert legend.get_window_extent().x1 <= figure.bbox.width
    run.source = None
    assert not any("measurement" in lines(panel) for panel in plots.states(run))


def test_a_measured_angle_is_drawn_in_the_turn_of_its_estimate(case):
    run = copy(case[1])
    turns = 2.0 * np.pi * np.arange(len(run))
    run.states = np.column_stack((np.append(turns, 0.0), np.ones(len(run) + 1)))

    def wrap(errors, _):
        errors[...] = (errors + np.pi) % (2.0 * np.pi) - np.pi

    run.source = case[1].source._replace(
        measurements=np.full((len(run), 1), 0.1),
        system=SimpleNamespace(
            h=SimpleNamespace(batch=lambda x, u: x[:, :1]), dt=None, signals=None,
            output_residual=SimpleNamespace(wrap=wrap)))
    found = lines(plots.states(run)[0])["measurement"]
    np.testing.assert_allclose(found[:, 1], turns + 0.1)


def test_time_is_in_seconds_where_the_step_is_known(case, monkeypatch):
    _, run, estimate = case
    for panel in (plots.states(run)[-1], plots.costs(run), plots.outcomes(run)):
        assert panel.get_xlabel() == "time t (s)"
        assert panel.lines[0].get_xdata()[-1] == pytest.approx(3.0)
    assert plots.window(estimate, dt=0.1)[-1].get_xlabel() == "time t (s)"
    steps = np.linspace(0.1, 0.2, 30)
    monkeypatch.setattr(run, "source", run.source._replace(steps=steps))
    drawn = lines(plots.states(run)[0])["estimate"]
    np.testing.assert_allclose(drawn[:, 0], [0.0, *np.cumsum(steps)])
    monkeypatch.setattr(run, "source", None)
    assert plots.states(run)[-1].get_xlabel() == "time t (samples)"


def test_time_is_in_the_unit_of_the_record():
    pandas = pytest.importorskip("pandas")
    y = SCENARIO.simulate(0, 12).measurements
    assert plots.costs(estimator().run(y, time_unit="min")).get_xlabel() == "time t (min)"
    hours = estimator().run(y, time_unit=pandas.Timedelta("1h"))
    assert plots.costs(hours).get_xlabel() == "time t (3600 s)"
    with pytest.raises(InvalidInputError, match="time_unit is 5; expected a unit"):
        estimator().run(y, time_unit=5)
    minutes = 100.0 + SCENARIO.dt * np.arange(12)
    table = pandas.DataFrame(y, index=pandas.to_timedelta(minutes, unit="min"))
    panel = plots.states(estimator().run(table, time_unit="min"))[-1]
    assert panel.get_xlabel() == "time t (min)"
    drawn = lines(panel)["estimate"][:, 0]
    np.testing.assert_allclose(drawn, 100.0 + SCENARIO.dt * np.arange(13), rtol=1e-9)


def test_the_window_stands_at_its_times(case):
    _, _, estimate = case
    axes = plots.window(estimate)
    assert axes[-1].get_xlabel() == "time t (samples)"
    for j, panel in enumerate(axes):
        best, candidate = panel.lines
        np.testing.assert_array_equal(best.get_ydata(), estimate.trajectory[:, j])
        np.testing.assert_array_equal(candidate.get_ydata(), estimate.candidate[:, j])
        # Seventeen samples, the last at t = 16: the window ends at the estimate of x(17).
        np.testing.assert_array_equal(best.get_xdata(), np.arange(7, 18))


def test_a_window_and_a_trajectory_have_the_band_of_their_covariances():
    mhe = estimator()
    for y in SCENARIO.simulate(0, 17).measurements:
        estimate = mhe.update(y)
    errors = mhe.covariances()
    assert not any(panel.collections for panel in plots.window(estimate))
    drawn = plots.window(estimate, covariances=errors, sigmas=3.0)
    others = plots.trajectories(
        np.arange(11), None, {"EKF": estimate.trajectory, "other": estimate.candidate},
        ["a", "b"], "time", covariances=errors[1:])
    for axes, sigmas, rest in ((drawn, 3.0, estimate.trajectory),
                               (others, 2.0, estimate.trajectory[1:])):
        for j, panel in enumerate(axes):
            (band,) = panel.collections
            half = sigmas * np.sqrt(errors[-len(rest):, j, j])
            ends = (rest[:, j] - half).min(), (rest[:, j] + half).max()
            assert extents(band)[:, 1] == pytest.approx(ends)
            assert band.get_facecolor()[0, :3] == pytest.approx(to_rgb(panel.lines[0].get_color()))
        (legend,) = axes[0].figure.legends
        assert f"± {sigmas:g} standard deviations" in [one.get_text() for one in legend.get_texts()]
    for wrong in (errors[0], errors[2:], errors[:, :1, :1]):
        with pytest.raises(ShapeError, match="covariances have shape"):
            plots.window(estimate, covariances=wrong)
    with pytest.raises(OptionError, match="sigmas is 0"):
        plots.window(estimate, covariances=errors, sigmas=0)


def test_costs_outcomes_and_times_of_steps(case, monkeypatch):
    _, run, _ = case
    drawn = lines(plots.costs(run))
    np.testing.assert_array_equal(drawn["estimate"][:, 1], run.costs)
    np.testing.assert_array_equal(drawn["candidate"][:, 1], run.candidate_costs)
    assert "candidate kept" not in drawn
    panel = plots.outcomes(run)
    assert [text.get_text() for text in panel.get_yticklabels()] == [
        "improved (100%)", "missing data (10%)"
    ]
    improved, data = panel.lines
    drawn = data.get_xydata()
    assert drawn[np.isfinite(drawn[:, 1]), 0] == pytest.approx([1.3, 1.4, 1.5])
    assert data.get_markevery() == [12, 14]
    # Unbroken, it looks so: markers are at its ends only.
    assert np.isfinite(improved.get_ydata()).all()
    assert improved.get_markevery() == [0, 29]
    flags = run.flags.copy()
    flags[4] ^= Status.IMPROVED.value | Status.CANDIDATE.value
    monkeypatch.setattr(run, "flags", flags)
    assert lines(plots.costs(run, dt=2.0))["candidate kept"][:, 0].tolist() == [10.0]
    deadline = float(np.median(run.times))
    panel = plots.step_times(run, deadline=deadline)
    late = (run.times > deadline).mean()
    texts = [text.get_text() for text in panel.get_legend().get_texts()]
    assert f"deadline ({late:.1%} late)" in texts
    steps = lines(panel)["whole step"]
    np.testing.assert_allclose(steps[:, 0], 1e6 * np.sort(run.times))
    assert steps[0, 1] == 1.0


def test_dates_stand_on_the_axis_and_one_window_without_data_does_not_stretch_it(case):
    pandas = pytest.importorskip("pandas")
    run = copy(case[1])
    run.index = pandas.date_range("2026-03-01 22:00", periods=len(run) + 1, freq="10s",
                                  tz="Europe/Berlin")
    for panel in (plots.states(run)[-1], plots.costs(run), plots.outcomes(run)):
        panel.figure.canvas.draw()
        texts = [one.get_text() for one in panel.get_xticklabels()]
        assert any(text.startswith("22:0") for text in texts)
        assert panel.xaxis.get_major_formatter().get_offset().startswith("2026-Mar-01")
        assert panel.get_xlabel() == ""
    assert plots.states(run, dt=2.0)[-1].lines[0].get_xdata()[1] == 2.0
    run.costs = np.where(np.arange(len(run)) == 3, 0.0, run.costs)
    low, high = plots.costs(run).get_ylim()
    known = run.costs[run.costs > 0.0]
    assert low > 0.01 * known.min()
    assert high >= known.max()


def test_states_have_the_names_of_the_model(case):
    signals = Signals(states=(Signal("pressure", "bar"), Signal("level")))
    run = copy(case[1])
    run.source = case[1].source._replace(system=SimpleNamespace(signals=signals, dt=None))
    assert [one.get_ylabel() for one in plots.states(run)] == ["pressure (bar)", "level"]
    run.source = case[1].source._replace(system=SimpleNamespace(signals=signals._replace(
        states=signals.states[:1]), dt=None))
    assert [one.get_ylabel() for one in plots.states(run)] == ["x1", "x2"]
    assert [one.get_ylabel() for one in plots.states(run, labels=["a", "b"])] == ["a", "b"]


def test_a_logarithmic_axis_of_one_decade_has_more_than_one_label(case):
    run = copy(case[1])
    run.costs = run.candidate_costs = np.linspace(3.0, 7.0, len(run))
    panel = plots.costs(run)
    panel.figure.canvas.draw()
    low, high = panel.get_ylim()
    labels = {float(one): text.get_text() for one, text in zip(
        panel.get_yticks(), panel.get_yticklabels(), strict=True)}
    assert {text for tick, text in labels.items() if low <= tick <= high} == {"3", "5", "7"}


def test_given_axes_are_drawn_into_and_a_run_without_steps_is_an_empty_picture(case, tmp_path):
    empty = estimator().run(np.empty((0, 1)), covariances=True)
    for run in (case[1], empty):
        for draw in (plots.costs, plots.outcomes, plots.step_times):
            panel = Figure(layout="constrained").subplots()
            options = {"deadline": 0.001} if draw is plots.step_times else {}
            assert draw(run, axes=panel, **options) is panel
            assert panel.lines or run is empty
        for path in plots.save(panel.figure, tmp_path / "new" / "times"):
            assert path.stat().st_size > 1000
    axes = plots.states(empty)
    assert lines(axes[0])["estimate"].tolist() == [[0.0, empty.states[0, 0]]]
    panels = Figure().subplots(2)
    assert plots.states(case[1], axes=panels) == list(panels)


def test_trajectories_take_what_is_an_array():
    (panel,) = plots.trajectories(
        [0, 1, 2], [3, 4, 5],
        {"EKF": [3.0, 4.0, np.nan], "i = 0": [1, 2, 3], "MHE, 2 QPs": [3, 4, 5]}, ["x"], "time",
    )
    assert lines(panel)["truth"].tolist() == [[0, 3], [1, 4], [2, 5]]
    found = {line.get_label(): line.get_color() for line in panel.lines}
    assert found["truth"] == plots.COLORS["truth"]
    assert found["i = 0"] == plots.COLORS["observer"]
    assert found["MHE, 2 QPs"] == plots.COLORS["estimate"]
    assert found["EKF"] not in plots.COLORS.values()


def trajectories(times, estimates):
    plots.trajectories(times, None, estimates, ["x"], "time")


def test_what_does_not_fit_is_refused(case):
    _, run, estimate = case
    rows = np.zeros((31, 2))
    many = {f"number {k}": np.zeros(3) for k in range(7)}
    for draw, arguments, options, error, words in [
        (plots.states, [run], {"labels": ["a"]}, ShapeError, r"labels are \['a'\]; expected 2"),
        (plots.states, [run], {"truth": rows[1:]}, ShapeError, r"truth has shape \(30, 2\)"),
        (plots.states, [run], {"dt": 0}, OptionError, "dt is 0; expected a finite number > 0"),
        (plots.states, [run], {"sigmas": -2.0}, OptionError, "sigmas is -2.0"),
        (plots.states, [run], {"axes": 3}, InvalidInputError, "axes contain 3; expected matplotl"),
        (plots.states, [run], {"band": (rows, rows[1:])}, ShapeError, r"band\[1\] has shape"),
        (plots.states, [run], {"guarded": rows[1:]}, ShapeError, r"'guarded'\] has shape"),
        (plots.states, [run], {"band": (rows + 1, rows - 1)}, InvalidInputError, "is 1 and band"),
        (plots.states, [estimate], {}, InvalidInputError, r"type Estimate; .*plots\.window"),
        (plots.window, [run], {}, InvalidInputError, r"estimate is of type Run; .*plots\.states"),
        (plots.step_times, [run], {"deadline": -0.001}, OptionError, r"deadline is .*> 0"),
        (trajectories, [np.arange(3), {"a": np.zeros(2)}], {}, ShapeError, r"estimates\['a'\] has"),
        (trajectories, [np.arange(3), many], {}, InvalidInputError, "are 7: .*at most 6"),
        (plots.save, [Figure().subplots(), "a"], {}, InvalidInputError, r"type Axes; .*\.figure"),
        (plots.save, [Figure(), ".."], {}, InvalidInputError, "a folder"),
    ]:
        with pytest.raises(error, match=words):
            draw(*arguments, **options)


def test_a_dot_belongs_to_the_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for stem, written in (("run_0.5", "run_0.5"), ("states.SVG", "states")):
        assert plots.save(Figure(), stem) == [Path(f"{written}.png"), Path(f"{written}.svg")]


def test_a_run_without_costs_has_a_page_of_states_and_a_legend_that_fits(case):
    states, run, _ = case
    problem = Problem.of(SYSTEM, OBSERVER, COST, SCENARIO.initial_estimate)
    other = ExtendedKalmanFilter(problem).run(states[1:, :1].sum(axis=1) + states[1:, 1])
    assert {"mean J", "improved"} < run.facts().keys()
    assert other.facts().keys() == {"steps", "states", "engine", "median step"}
    assert "<img" in other._repr_html_()
    axes = plots.states(
        run, truth=states, guarded=run.states, band=(run.states - 1.0, run.states + 1.0)
    )
    figure = axes[0].figure
    figure.canvas.draw()
    (legend,) = figure.legends
    ends = legend.get_window_extent().extents
    assert len(legend.get_texts()) == 5
    assert 0.0 <= ends[0] < ends[2] <= figure.bbox.width
