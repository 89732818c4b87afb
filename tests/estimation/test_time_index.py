"""Records from pandas: an index of times is the time axis; all else is paired by position."""

import pickle
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest

import qpmhe
from qpmhe.baselines import ExtendedKalmanFilter, Problem, follow
from qpmhe.errors import InvalidInputError, ShapeError
from qpmhe.model.signals import Signal, Signals
from qpmhe.tuning import TuningRecord
from qpmhe.tuning.data import checked_data
from tests.covering import covering

pd = pytest.importorskip("pandas")

A, B = np.array([[0.95, 0.1], [0.0, 0.9]]), np.array([0.1, 0.3])
START, MINUTES = "2026-03-29 00:30", "10min"  # an hour before the clocks of Berlin change
COVARIANCES = {"disturbance": 4e-4 * np.eye(2), "noise": [[0.01]]}
T = 30


def discrete():
    return qpmhe.System(lambda x, u: x @ A.T + u * B, lambda x: x[..., :1], n=2, p=1, m=1)


def of_ode(dt):
    return qpmhe.System.from_ode(
        lambda x, u: np.stack([0.1 * x[..., 1], 0.1 * (u[..., 0] - x[..., 0])], -1),
        lambda x: x[..., :1], dt=dt, n=2, p=1, m=1,
    )


def estimator(system):
    cost = qpmhe.QuadraticCost.from_covariances(prior=np.eye(2), **COVARIANCES)
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.2]), cost, horizon=5, initial_state=[0.0, 0.0],
        engine="python",
    )


def kalman(system):
    return ExtendedKalmanFilter(
        Problem(system, initial_state=np.zeros(2), prior=np.eye(2), **COVARIANCES))


def followed(make):
    """As `run`, by `follow`."""
    def run(measurements, inputs=None, **options):
        one = make()
        return follow(one, one.state, measurements, inputs, **options)
    return SimpleNamespace(run=run)


MAKERS = {
    "mhe": estimator, "kalman": kalman,
    "followed mhe": lambda system: followed(lambda: estimator(system)),
    "followed kalman": lambda system: followed(lambda: kalman(system)),
}


def record(index):
    rng = np.random.default_rng(3)
    y, u = rng.normal(size=(len(index), 1)), rng.normal(size=(len(index), 1))
    return pd.DataFrame(y, index, ["y"]), pd.DataFrame(u, index, ["u"])


INDEXES = {
    "dates": pd.date_range(START, periods=T, freq=MINUTES),
    "zone": pd.date_range(START, periods=T, freq=MINUTES, tz="Europe/Berlin"),
    "durations": pd.timedelta_range("2s", periods=T, freq="20ms"),
    "seconds": pd.date_range(START, periods=T, freq="1s").as_unit("s"),
}


@covering(name=INDEXES, maker=MAKERS, strength=1)
def test_inputs_are_paired_by_time_in_any_order_and_of_any_resolution(name, maker):
    index, make = INDEXES[name], MAKERS[maker]
    y, u = record(index)
    plain = make(discrete()).run(y.to_numpy(), u.to_numpy())
    assert plain.index is None
    others = u.set_axis(u.index.as_unit("ns"))
    wider = pd.concat([u, u.set_axis(u.index + (u.index[-1] - u.index[0]) + pd.Timedelta("1D"))])
    shuffled = u["u"].sample(frac=1.0, random_state=1)
    for inputs in (u, u[::-1], shuffled, others, wider, u.to_numpy()):
        run = make(discrete()).run(y, inputs)
        np.testing.assert_array_equal(run.states, plain.states)
        assert run.index[:-1].equals(index)
        assert run.index[-1] - run.index[-2] == index[1] - index[0]
    # And in single updates, to the last bit.
    mhe = estimator(discrete())
    cost = mhe.update(y.iloc[0], u.iloc[0]).cost
    assert cost == plain.costs[0] or not plain.has_costs


@covering(name=["dates", "zone"], maker=MAKERS, strength=1)
def test_gaps_are_samples_without_measurement(name, maker):
    make = MAKERS[maker]
    y, u = record(INDEXES[name])
    gone = [7, 8, 9, 10, 11, 12, 20]
    holes = y.copy()
    holes.iloc[gone] = np.nan
    held = u.copy()
    held.iloc[gone] = np.nan
    held = held.ffill()
    dropped = np.delete(np.arange(T), gone)
    for inputs, expected in ((u, u), (u.iloc[dropped], held)):
        plain = make(discrete()).run(holes.to_numpy(), expected.to_numpy())
        run = make(discrete()).run(y.iloc[dropped], inputs)
        np.testing.assert_array_equal(run.states, plain.states)
        assert run.index[:-1].equals(y.index)
        if run.source is None:
            continue
        np.testing.assert_array_equal(run.source.measurements, holes)
        np.testing.assert_array_equal(run.source.inputs, expected)


def test_steps_of_any_length_in_the_models_unit():
    rng = np.random.default_rng(5)
    minutes = np.cumsum(rng.uniform(0.3, 1.4, size=T))
    index = pd.Timestamp(START) + pd.to_timedelta(60.0 * minutes, unit="s").round("us")
    y, u = record(index)
    mhe = estimator(of_ode(1.0))
    lengths = [*((index[1:] - index[:-1]).total_seconds() / 60.0), 1.0]
    states = [mhe.update(y.iloc[t], u.iloc[t], dt=lengths[t]).state for t in range(T)]
    for unit in ("min", pd.Timedelta("60s")):
        run = estimator(of_ode(1.0)).run(y, u[::-1], time_unit=unit)
        np.testing.assert_allclose(run.states[1:], states, rtol=1e-12)
        assert run.index[-1] == index[-1] + pd.Timedelta("1min")
    filtered = follow(kalman(of_ode(1.0)), np.zeros(2), y.to_numpy(), u.to_numpy(), lengths)
    for name in set(MAKERS) - {"mhe"}:
        other = MAKERS[name](of_ode(1.0)).run(y, u[::-1], time_unit="min")
        expected = filtered if "kalman" in name else run
        np.testing.assert_allclose(other.states, expected.states, rtol=1e-12)
        np.testing.assert_array_equal(other.elapsed, run.elapsed)
        assert (other.time_unit, other.index[-1]) == ("min", run.index[-1])
    # The record is the tuning's, too, with true states of some times.
    truth = pd.DataFrame(rng.normal(size=(T, 2)), index)
    (data,) = checked_data(
        [TuningRecord(y, u[::-1], truth[::-1], time_unit="min")], of_ode(1.0), 1, [0.0, 0.0]
    )
    np.testing.assert_allclose(data.dt, lengths, rtol=1e-12)
    np.testing.assert_array_equal(data.u, u)
    np.testing.assert_array_equal(data.truth[:T], truth)
    with pytest.raises(InvalidInputError, match="leave out dt"):
        checked_data([TuningRecord(y, u, dt=lengths)], of_ode(1.0), 1, [0.0, 0.0])
    with pytest.raises(InvalidInputError, match=r"a gap .* give time_unit if"):
        estimator(of_ode(1e-3)).run(y, u)  # the model has seconds, the record minutes


def test_tuning_pairs_rows_and_fills_gaps():
    y, u = record(INDEXES["dates"])
    gone = [4, 5]
    dropped = np.delete(np.arange(T), gone)
    truth = np.random.default_rng(4).normal(size=(T, 2))
    timed = pd.DataFrame(truth, y.index)[::-1]
    for states in (truth[dropped], timed, pd.DataFrame(truth[dropped])):
        (data,) = checked_data([(y.iloc[dropped], u[::-1], states)], discrete(), 1, [0.0, 0.0])
        np.testing.assert_array_equal(data.y[dropped], y.iloc[dropped])
        assert np.isnan(data.y[gone]).all()
        np.testing.assert_array_equal(data.u, u)
        np.testing.assert_array_equal(data.truth[dropped], truth[dropped])


def test_tuning_takes_a_series_or_a_list_of_them():
    system = qpmhe.System(lambda x: x @ A.T, lambda x: x[..., :1], n=2, p=1)
    y = record(INDEXES["dates"])[0].drop(INDEXES["dates"][4])
    (expected,) = checked_data([(y,)], system, 0, [0.0, 0.0])
    for records in (y, [y], y["y"], [y["y"]]):
        (data,) = checked_data(records, system, 0, [0.0, 0.0])
        np.testing.assert_array_equal(data.y, expected.y)
    with pytest.raises(InvalidInputError, match=r"records\[0\] has no inputs.*\(measurements, inp"):
        checked_data(y, discrete(), 1, [0.0, 0.0])


def test_a_table_holds_each_state_at_its_own_time(tmp_path):
    y, u = record(INDEXES["zone"])
    rng = np.random.default_rng(0)
    X = [np.zeros(2)]
    for t in range(T):
        X.append(A @ X[-1] + B * u.iloc[t].to_numpy() + 0.02 * rng.normal(size=2))
    X = np.array(X)
    y = pd.DataFrame(X[:T, :1] + 0.1 * rng.normal(size=(T, 1)), y.index)
    run = estimator(discrete()).run(y, u, covariances=True)
    table = run.to_frame()
    assert table.index.equals(run.index)
    assert len(table) == T + 1
    names = ["x1", "x2"]
    np.testing.assert_array_equal(table[names], run.states)
    np.testing.assert_array_equal(table[["filtered1", "filtered2"]][:-1], run.filtered)
    np.testing.assert_array_equal(table["J"][:-1], run.costs)
    np.testing.assert_allclose(table["std2"].iloc[1:] ** 2, run.covariances[:, 1, 1])
    assert table["std1"].isna().tolist() == [True] + T * [False]
    # A join by time is right: no other pairing of rows has smaller errors.
    truth = pd.DataFrame(X, run.index, ["true1", "true2"])
    joined = table.join(truth)

    def error(shift, start):
        moved = joined[["true1", "true2"]].shift(shift).to_numpy()
        return np.nanmean((joined[[f"{start}1", f"{start}2"]].to_numpy() - moved)[2:-2] ** 2)

    for start in ("x", "filtered"):
        assert min((-1, 0, 1), key=lambda shift, name=start: error(shift, name)) == 0
    plain = estimator(discrete()).run(y.to_numpy(), u.to_numpy()).to_frame()
    assert plain.index.tolist() == list(range(T + 1))
    for times in (*INDEXES.values(), INDEXES["zone"].tz_convert(None)):
        run.index = index = times.append(times[-1:] + (times[1] - times[0]))
        run.save(tmp_path / "run.npz")
        read = qpmhe.load_run(tmp_path / "run.npz").index
        assert read.equals(index)
        assert getattr(read, "tz", None) == getattr(index, "tz", None)


@pytest.mark.parametrize("kind", ["dates", "durations", "steps", "plain"])
def test_a_run_keeps_its_unit_of_time_and_its_names_without_its_source(kind, tmp_path):
    y, u = record(INDEXES.get(kind, pd.RangeIndex(T)))
    unit, dt = "h", 1.0 / 6.0 if kind == "dates" else 0.02
    system = of_ode(dt).with_origin(
        signals=Signals((Signal("pressure", "bar"), Signal("level"))))
    expected = dt * np.arange(T + 1)
    if kind == "durations":
        unit, expected = "s", 2.0 + expected
    elif kind != "dates":
        unit = pd.Timedelta("1h")
    run = estimator(system).run(y, u, time_unit=unit)
    if kind == "steps":
        lengths = np.linspace(0.01, 0.03, T)
        run.source = run.source._replace(steps=lengths)
        expected = np.append(0.0, np.cumsum(lengths))
    run.save(tmp_path / "run.npz")
    name = unit if isinstance(unit, str) else "3600 s"
    for one in (run, qpmhe.load_run(tmp_path / "run.npz"), pickle.loads(pickle.dumps(run))):
        np.testing.assert_allclose(one.elapsed, expected, rtol=1e-12)
        assert (one.time_unit, one.labels) == (name, ["pressure (bar)", "level"])
        table = one.to_frame()
        np.testing.assert_array_equal(table["elapsed"], one.elapsed)
        assert table.attrs["time_unit"] == name
        assert one.facts()["samples from"] == (
            f"{expected[0]:.6g} to {expected[-2]:.6g} {name}")
        axes = qpmhe.plots.states(one)
        assert [panel.get_ylabel() for panel in axes] == one.labels
        assert axes[-1].get_xlabel() == ("" if kind == "dates" else f"time t ({name})")
        if kind != "dates":
            np.testing.assert_array_equal(axes[0].lines[0].get_xdata(), one.elapsed)


def test_a_run_has_the_names_that_the_user_gives(tmp_path):
    y, u = record(INDEXES["seconds"])
    system = of_ode(1.0)
    cost = qpmhe.QuadraticCost.from_covariances(prior=np.eye(2), **COVARIANCES)
    named = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.2]), cost, horizon=5, engine="python",
        initial_state=pd.Series({"angle (rad)": 0.0, "rate (rad/s)": 0.0}))
    assert estimator(system).run(y, u).labels is None
    for options in ({}, {"covariances": True}):  # all steps at once, and one by one
        run = (deepcopy(named) if options else named).run(y, u, **options)
        assert run.labels == ["angle (rad)", "rate (rad/s)"]
        given = estimator(system.with_origin(signals=Signals((Signal("a"), Signal("b"))))).run(
            y, u, labels=("first", "second"), **options)
        given.save(tmp_path / "run.npz")
        for one in (given, qpmhe.load_run(tmp_path / "run.npz"), pickle.loads(pickle.dumps(given))):
            assert one.labels == ["first", "second"]
            assert [axis.get_ylabel() for axis in qpmhe.plots.states(one)] == one.labels
    plain = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.3, 0.2]), cost, horizon=5, engine="python",
        initial_state=pd.Series([0.0, 0.0]))
    assert plain.run(y, u).labels is None
    for wrong in (["a"], "ab", [1, 2], 3):
        with pytest.raises((InvalidInputError, ShapeError), match="labels are"):
            plain.run(y, u, labels=wrong)
    assert plain.time == T


def test_a_run_of_an_older_file_counts_samples(tmp_path):
    y, u = record(pd.RangeIndex(T))
    run, path = estimator(of_ode(0.02)).run(y, u), tmp_path / "run.npz"
    run.save(path)
    with np.load(path) as file:
        arrays = dict(file)
    assert {"elapsed", "time_unit"} < arrays.keys()
    np.savez(path, **arrays | {"elapsed": arrays["elapsed"][:-1]})
    with pytest.raises(InvalidInputError, match="not of the same steps"):
        qpmhe.load_run(path)
    np.savez(path, **{name: one for name, one in arrays.items()
                      if name not in ("elapsed", "time_unit", "labels")})
    old = qpmhe.load_run(path)
    assert (old.elapsed, old.time_unit, old.labels) == (None, "s", None)
    assert "elapsed" not in old.to_frame()
    assert qpmhe.plots.costs(old).get_xlabel() == "time t (samples)"
    state = {name: one for name, one in vars(run).items() if name[0] != "_" and name != "source"}
    pickled = qpmhe.Run.__new__(qpmhe.Run)
    pickled.__dict__.update(state)
    assert (pickled.elapsed, pickled.time_unit, pickled.labels) == (None, "s", None)
    assert repr(pickled) == repr(old)


@pytest.mark.parametrize("name", INDEXES)
def test_an_index_may_be_named_time_or_be_empty(name, tmp_path):
    for count in (0, 5):
        y, u = record(INDEXES[name][:count].rename("time"))
        run = estimator(of_ode(1.0)).run(y, u, time_unit=INDEXES[name][1] - INDEXES[name][0])
        assert len(run.index) == len(run.elapsed) == count + 1
        table = run.to_frame().reset_index()
        assert table.columns[:2].tolist() == ["time", "elapsed"]
        run.save(tmp_path / "run.npz")
        read = qpmhe.load_run(tmp_path / "run.npz")
        np.testing.assert_array_equal(read.elapsed, run.elapsed)


def test_what_does_not_match_is_refused_by_name():
    y, u = record(INDEXES["dates"])
    later = u.set_axis(u.index + pd.Timedelta("6h"))
    twice = u.set_axis(u.index[[0, 0, *range(2, T)]])
    finer = pd.concat([u, u.set_axis(u.index + pd.Timedelta("5min"))]).sort_index()
    nat = y.set_axis(pd.DatetimeIndex([pd.NaT, *y.index[1:]]))
    uneven = y.set_axis(y.index[:-1].append(y.index[-1:] + pd.Timedelta("4min")))
    for measurements, inputs, words in (
        (y, later, r"inputs has no row at 2026-03-29 00:30:00, and at 30 of 30 .*reindex"),
        (y, twice, "index of inputs has 2026-03-29 00:30:00 twice"),
        (y, finer, "inputs has 29 rows at times without a sample, such as 2026-03-29 00:35:00"),
        (y[::-1], u, r"goes backwards at 2026-03-29 05:10:00, row 1; give measurements.sort_index"),
        (y.set_axis(y.index[[0, 0, *range(2, T)]]), u, "index of measurements has .* twice"),
        (nat, u, "index of measurements has NaT in row 0"),
        (y.tz_localize("UTC"), u, "times of inputs cannot be compared.*same time zone"),
        (y, u.set_axis(u.index - u.index[0]), "times of inputs cannot be compared"),
        (y, u.iloc[1:].reset_index(drop=True), "29 rows without times; expected 30"),
        (uneven, u.set_axis(uneven.index), r"at .*05:24:00: a step of 840 is no multiple.*600"),
        (y.set_axis(range(T)), u.set_axis(range(1, T + 1)), "different indexes.*by position"),
    ):
        mhe = estimator(discrete())
        for one in (mhe, kalman(discrete()), followed(lambda: kalman(discrete()))):
            with pytest.raises((InvalidInputError, ShapeError), match=words):
                one.run(measurements, inputs)
        assert mhe.time == 0
    for unit in ("fortnight", 0, pd.Timedelta(0), pd.NaT, None):
        with pytest.raises(InvalidInputError, match="time_unit is"):
            estimator(discrete()).run(y, u, time_unit=unit)
    for few in (0, 1):
        run = estimator(discrete()).run(y.iloc[:few], u.iloc[:few])
        assert len(run.index) == few + 1
        assert len(run) == few


def test_an_estimator_that_does_not_say_its_model_gets_no_index_of_times():
    y, u = record(INDEXES["dates"])
    holder = SimpleNamespace(update=lambda y, u=None: np.zeros(2))
    with pytest.raises(InvalidInputError, match=r"SimpleNamespace does not say the steps.*problem"):
        follow(holder, np.zeros(2), y, u)
    assert len(follow(holder, np.zeros(2), y.reset_index(drop=True))) == T
    with pytest.raises(InvalidInputError, match="leave out steps"):
        follow(kalman(discrete()), np.zeros(2), y, u, np.ones(T))
    # A record whose steps have several lengths, for an update without dt.
    holder.problem = kalman(of_ode(600.0)).problem
    assert len(follow(holder, np.zeros(2), y.drop(y.index[4]))) == T
    with pytest.raises(InvalidInputError, match=r"SimpleNamespace.update cannot .* dt=\.\.\."):
        follow(holder, np.zeros(2), y.drop(y.index[4]).set_axis(y.index[1:].map(
            lambda one: one + pd.Timedelta(minutes=one.hour))))
