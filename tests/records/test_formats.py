"""Files with channels: each against its library's own reading, and what is wrong with one."""

import os
import signal
import sys
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.records import RecordError, formats, read
from qpmhe.records.arrays import read_record
from qpmhe.records.channels import merged
from qpmhe.records.record_model import load_record_model
from tests.covering import covering

from .oscillator import DT, lines
from .tools import CONTINUOUS, DISCRETE, estimate, get, killed, put

pd = pytest.importorskip("pandas")

T1, T2 = np.arange(40) * 0.05, np.arange(20) * 0.1
FAST, SLOW = np.sin(T1), np.cos(3 * T2)
EPOCH = 1_780_000_000 * 10**9
UNSET = datetime(1970, 1, 1, tzinfo=UTC)


def mf4(name, groups, start=UNSET, version="4.10"):
    """An MDF file; groups of (times, {name: values}) with the unit V. Its clock is not set."""
    asammdf = pytest.importorskip("asammdf")
    mdf = asammdf.MDF(version=version)
    mdf.start_time = start
    for k, (times, channels) in enumerate(groups):
        signals = [
            asammdf.Signal(values, times, name=one, unit="V",
                           encoding="utf-8" if values.dtype.kind == "S" else None)
            for one, values in channels.items()
        ]
        mdf.append(signals, acq_name=f"raster {k}")
    mdf.save(name, overwrite=True)
    mdf.close()


def bag(folder, plugin, topics, version=9):
    """A ROS 2 bag: (topic, log times, stamps or None, values)."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = {name.rpartition("/")[2]: one for name, one in store.types.items()}
    with rosbag2.Writer(
        Path(folder), version=version, storage_plugin=rosbag2.StoragePlugin[plugin]
    ) as writer:
        for topic, logged, stamps, values in topics:
            kind = "std_msgs/msg/Float64" if stamps is None else "geometry_msgs/msg/PointStamped"
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, value in enumerate(values):
                if stamps is None:
                    message = make["Float64"](float(value))
                else:
                    stamp = make["Time"](*map(int, divmod(int(stamps[k]), 10**9)))
                    message = make["PointStamped"](
                        make["Header"](stamp, "map"), make["Point"](float(value), 0.0, -1.0)
                    )
                writer.write(connection, int(logged[k]), store.serialize_cdr(message, kind))
    (found,) = (each for each in Path(folder).iterdir() if each.suffix != ".yaml")
    return str(found)


def mat73(name, variables):
    """As MATLAB writes it: columns first, and what a variable is in its attributes."""
    h5py = pytest.importorskip("h5py")

    def fill(group, values):
        for key, value in values.items():
            if isinstance(value, dict):
                inner = group.create_group(key)
                inner.attrs["MATLAB_class"] = np.bytes_("struct")
                fill(inner, value)
            else:
                data = group.create_dataset(key, data=np.atleast_2d(value.T))
                data.attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(name, "w", userblock_size=512) as file:
        fill(file, variables)
    with open(name, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def seconds(frame):
    return frame.index.total_seconds().to_numpy()


def refused(name, *words, read=read, **options):
    with pytest.raises(RecordError) as caught:
        read(name, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    return message


@pytest.mark.parametrize("fragment", [formats._FRAGMENT, 96])
def test_mdf_has_what_asammdf_reads(here, monkeypatch, fragment):
    monkeypatch.setattr(formats, "_FRAGMENT", fragment)
    mf4("record.mf4", [
        (T1, {"speed": FAST, "gear": np.arange(40, dtype=np.uint8)}), (T2, {"temp": SLOW}),
        (T2 + 0.01, {"speed": SLOW}), (T2, {"text": np.array([b"a", b"bc"] * 10)}),
    ])
    frame = read("record.mf4")
    asammdf = sys.modules["asammdf"]
    with asammdf.MDF("record.mf4") as mdf:
        for name, (group, index) in {
            "raster 0/speed": (0, 1), "gear": (0, 2), "temp": (1, 1), "raster 2/speed": (2, 1),
        }.items():
            signal, found = mdf.get(group=group, index=index), frame[name].dropna()
            np.testing.assert_array_equal(found, signal.samples)
            np.testing.assert_allclose(seconds(found), signal.timestamps, atol=1e-9)
    assert frame["text"][frame["text"] != ""].tolist() == ["a", "bc"] * 10
    assert frame.attrs["units"] == dict.fromkeys(frame.columns, "V")
    assert len(frame) == 60  # two clocks have common times, the third is later
    # Only what is asked for makes rows; the last part of a name will do.
    assert len(read("record.mf4", ["temp"])) == 20
    refused("record.mf4", "2 columns could all be", "'raster 0/speed', 'raster 2/speed'",
            columns=["speed"])
    refused("record.mf4", "sample 1, column 'text': 'a' is not a number",
            read=lambda name: estimate(CONTINUOUS, name, outputs="y1=text", inputs="u1=temp"))


@pytest.mark.parametrize(("name", "version"), [("r.mdf", "3.30"), ("r.mf4", "4.10")])
def test_times_are_dates_where_an_mdf_file_says_when_it_started(here, name, version):
    berlin = timezone(timedelta(hours=2))
    start = datetime(2026, 7, 2, 8, 0, 0, 250_000, tzinfo=berlin)
    values = {"y1": SLOW, "y2": SLOW}
    mf4(name, [(T2, values)], start, version)
    frame = read(name)
    dates = [start + timedelta(seconds=0.1 * k) for k in range(20)]
    assert (frame.index == pd.DatetimeIndex(dates)).all()
    assert pd.Timestamp(frame.attrs["start"]) == pd.Timestamp(start)
    np.testing.assert_allclose((frame.index - pd.Timestamp(start)).total_seconds(), T2, atol=1e-9)
    frame.to_parquet("kept.parquet")
    assert pd.read_parquet("kept.parquet").attrs == frame.attrs
    # Estimates have the dates, and are those of the seconds.
    mf4("seconds.mf4", [(T2, values)])
    assert "start" not in read("seconds.mf4").attrs
    for one in (name, "seconds.mf4"):
        estimate(DISCRETE, one, f"{one}.csv")
        estimate(DISCRETE, one, f"{one}.parquet")
    table, numbers = read(f"{name}.csv"), read("seconds.mf4.csv")
    for each in (table, read(f"{name}.parquet"), pd.read_parquet(f"{name}.parquet")):
        found = each.index if each.index.name else pd.DatetimeIndex(each["time"])
        assert (found == pd.DatetimeIndex(dates)).all()
    pd.testing.assert_frame_equal(table.reset_index(drop=True), numbers.reset_index(drop=True))
    assert seconds(numbers)[-1] == pytest.approx(1.9)


def test_local_dates_of_mdf_have_no_zone(here):
    mf4("local.mf4", [(T2, {"y": SLOW})], datetime(2026, 7, 2, 8, 0))
    index = read("local.mf4").index
    assert index.tz is None
    assert index[10] == pd.Timestamp("2026-07-02T08:00:01")


def test_invalid_values_of_mdf_are_left_out(here):
    asammdf = pytest.importorskip("asammdf")
    mdf = asammdf.MDF(version="4.10")
    mdf.start_time = UNSET
    invalid = np.arange(20) % 5 == 3
    mdf.append([asammdf.Signal(SLOW, T2, name="y", invalidation_bits=invalid)])
    mdf.save("record.mf4", overwrite=True)
    mdf.close()
    frame = read("record.mf4")
    np.testing.assert_array_equal(frame["y"], SLOW[~invalid])
    np.testing.assert_allclose(seconds(frame), T2[~invalid])


@pytest.mark.parametrize("version", ["4", "5", "7.3"])
def test_mat_has_what_scipy_or_pymatreader_reads(here, version):
    from scipy.io import loadmat, savemat

    both = np.stack((FAST, FAST**2), 1)
    variables = {"t": T1, "pos": both, "across": both.T, "level": FAST[:, None], "g": 9.81}
    if version != "4":
        variables["slow"] = {"time": T2, "temp": SLOW, "deep": {"temp2": -SLOW}}
    if version == "7.3":
        pytest.importorskip("pymatreader")
        mat73("record.mat", {name: np.asarray(each) if not isinstance(each, dict) else each
                             for name, each in variables.items()})
        h5py = sys.modules["h5py"]
        with h5py.File("record.mat", "r+") as file:  # what only pymatreader reads, and a text
            parts = [file.create_dataset(f"#refs#/{k}", data=row[None])
                     for k, row in enumerate(both.T)]
            for part in parts:
                part.attrs["MATLAB_class"] = np.bytes_("double")
            cell = file.create_dataset("cell", data=np.array(
                [[part.ref] for part in parts], h5py.ref_dtype))
            cell.attrs["MATLAB_class"] = np.bytes_("cell")
            text = file.create_dataset("slow/name", data=np.array([[111], [107]], np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
        content = sys.modules["pymatreader"].read_mat("record.mat")
    else:
        savemat("record.mat", variables, format=version)
        content = loadmat("record.mat", simplify_cells=True)
    frame = read("record.mat")
    assert frame["pos[1]"].dropna().tolist() == np.asarray(content["pos"])[:, 1].tolist()
    assert frame["across[1]"].dropna().tolist() == (FAST**2).tolist()
    assert frame["level"].dropna().tolist() == FAST.tolist()
    assert seconds(frame["level"].dropna()) == pytest.approx(content["t"])
    assert "g" not in frame
    assert "slow.name" not in frame
    if version == "7.3":
        assert frame["cell[1]"].dropna().tolist() == (FAST**2).tolist()
        assert np.array_equal(content["cell"], both.T)
    if version == "4":
        assert list(frame) == ["pos[0]", "pos[1]", "across[0]", "across[1]", "level"]
        return
    for name, factor in (("slow.temp", 1.0), ("slow.deep.temp2", -1.0)):
        found = frame[name].dropna()
        np.testing.assert_array_equal(found, factor * content["slow"]["temp"])
        np.testing.assert_allclose(seconds(found), T2)
    assert len(frame) == 40  # the times of the slow ones are among those of the fast ones
    refused("record.mat", "no time of its length, 20", columns=["slow.temp"], time="t")


def test_hdf5_has_what_h5py_reads(here):
    h5py = pytest.importorskip("h5py")
    stamps = EPOCH + (T1 * 1e9).astype(np.int64)  # no float has their last digits
    with h5py.File("record.h5", "w") as file:
        file["timestamp"] = stamps
        file["imu/rows"] = np.stack((FAST, -FAST), 1)
        file["imu/columns"] = np.stack((FAST, -FAST))
        file["imu/rows"].attrs["units"] = "m/s"
        file["gps/Time"] = stamps[::2].astype(np.uint64)
        file["gps/square"] = np.arange(400.0).reshape(20, 20)
        table = np.zeros(40, dtype=[("time", "i8"), ("a", "f8"), ("ok", "?")])
        table["time"], table["a"], table["ok"] = stamps, FAST, FAST > 0
        file["log"] = table
        file["alone"] = np.arange(7.0)
    frame = read("record.h5", ["imu.rows[1]", "columns[1]", "square[2]", "log.a", "ok"],
                 time_scale=1e-9)
    assert frame["imu.columns[1]"].tolist() == (-FAST).tolist()
    assert frame["imu.rows[1]"].tolist() == (-FAST).tolist()
    assert frame["gps.square[2]"].dropna().tolist() == np.arange(2.0, 400.0, 20.0).tolist()
    assert frame["log.a"].tolist() == FAST.tolist()
    assert frame["log.ok"].tolist() == (FAST > 0).astype(float).tolist()
    assert frame.index[1] - frame.index[0] == pd.Timedelta("50ms")
    assert frame.attrs["units"] == {"imu.rows[1]": "m/s"}
    assert any("20 x 20: its rows are the samples" in note for note in frame.attrs["notes"])
    refused("record.h5", "no time of its length, 7", "--time", columns=["alone"])


@pytest.mark.parametrize("kind", ["SQLITE3", "MCAP"])
def test_bags_have_what_was_written(here, kind, monkeypatch):
    monkeypatch.setattr(formats, "_MESSAGES", {"SQLITE3": 7, "MCAP": 10}[kind])
    stamps = EPOCH + np.arange(20) * 10**8 + 123
    logged = stamps + 1000
    path = bag("run", kind, [("/pose", logged, stamps, SLOW), ("/speed", logged, None, -SLOW),
                             ("/zero", logged, np.zeros(20), SLOW)])
    for name in ("run", path):
        frame = read(name)
        found = frame["/pose.point.x"].dropna()
        np.testing.assert_array_equal(found, SLOW)
        assert found.index.asi8.tolist() == stamps.tolist()
        assert str(found.index.tz) == "UTC"
        for other in ("/speed.data", "/zero.point.x"):
            assert frame[other].dropna().index.asi8.tolist() == logged.tolist()
    (note,) = frame.attrs["notes"]
    for words in ("header.stamp of /pose", "the log's time of /speed", "the log's time of /zero"):
        assert words in note
    both = read("run", ["/pose.point.x", "data"], log_time=True)
    assert len(both) == 20
    assert both.index.asi8.tolist() == logged.tolist()
    assert len(read("run", ["/pose.point.x", "data"], same_time=1e-6)) == 20
    assert len(read("run", ["/pose.point.x", "data"], same_time=9e-7)) == 40


def test_ros1_bags(here):
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "std_msgs/msg/Float64"
    with rosbag1.Writer(Path("record.bag")) as writer:
        connection = writer.add_connection("/level", kind, typestore=store)
        for k in range(10):
            message = store.types[kind](float(SLOW[k]))
            writer.write(connection, EPOCH + k * 10**8, store.serialize_ros1(message, kind))
    frame = read("record.bag", ["/level.data"])
    assert frame["/level.data"].tolist() == SLOW[:10].tolist()


def test_text_and_parquet_as_frames(here):
    put("record.csv", ["time [s],Level [m],note,u", "0,1.5,,1", "0.5,,ok,2", "1.5,-2,bad,"])
    frame = read("record.csv")
    assert frame.index.tolist() == [pd.Timedelta(each, "s") for each in (0, 0.5, 1.5)]
    np.testing.assert_array_equal(frame["Level [m]"], [1.5, np.nan, -2.0])
    assert frame["note"].tolist() == ["", "ok", "bad"]
    assert frame.attrs["units"] == {"Level [m]": "m"}
    assert list(read("record.csv", ["level"], time_scale=60.0).index) == [
        pd.Timedelta(each, "min") for each in (0, 0.5, 1.5)]
    put("record.csv", ["time,y", "0,1", "1,high"])
    refused("record.csv", "line 3, column 'y': 'high' is not a number")
    put("record.csv", ["time,y", "2026-05-04T12:00:00,1", "2026-05-04T12:00:00.123456789,2"])
    index = read("record.csv").index
    assert index.tz is None
    assert index[1] == pd.Timestamp("2026-05-04T12:00:00.123456789")
    # Missing entries of dictionaries stay missing, in several chunks, too.
    pytest.importorskip("pyarrow")
    values = pd.Categorical([1.5, None, 2.5, None, 1.5, 1.5] * 1000)
    table = pd.DataFrame({"time": np.arange(6000.0), "y": values})
    table.to_parquet("record.parquet", row_group_size=1500)
    np.testing.assert_array_equal(
        read("record.parquet")["y"], [1.5, np.nan, 2.5, np.nan, 1.5, 1.5] * 1000
    )


@pytest.mark.parametrize("step", ["1ms", "250ms", "1.000000001s", "36h", "1D"])
def test_durations_that_pandas_writes_come_back(here, step):
    index = (pd.timedelta_range("-2D", periods=12, freq=step)).rename("time")
    frame = pd.DataFrame({"y1": SLOW[:12], "y2": FAST[:12]}, index)
    frame.to_csv("record.csv")
    frame.to_parquet("record.parquet")
    dt = {"dt": index.to_series().diff().median().total_seconds()}
    for name in ("record.csv", "record.parquet"):
        found = read(name)
        assert (found.index == index).all()
        np.testing.assert_array_equal(found, frame)
        for out in ("out.csv", "out.parquet"):
            estimate(DISCRETE, name, out, overwrite=True, **dt)
            assert (read(out).index == index).all()
    assert pd.read_parquet("out.parquet")["time"].dtype == index.dtype  # as the record has it
    put("seconds.csv", ["time,y1,y2", *(f"{t},{a},{b}" for t, a, b in zip(
        index.total_seconds(), SLOW, FAST, strict=False))])
    estimate(DISCRETE, "seconds.csv", **dt, overwrite=True)
    numbers = read("out.csv").reset_index(drop=True)
    estimate(DISCRETE, "record.csv", overwrite=True, **dt)
    pd.testing.assert_frame_equal(read("out.csv").reset_index(drop=True), numbers)


def test_durations_of_python_and_spreadsheets(here):
    forms = [
        "-1 day, 23:59:58.5", "0:00:00", "00:00:02,25", "1 day, 1:02:03", "2 days", "100:00:00"]
    put("record.csv", ["time;y", *(f"{one};1" for one in forms)])
    assert read("record.csv").index.total_seconds().tolist() == [
        -1.5, 0.0, 2.25, 86_400 + 3723, 172_800, 360_000]
    put("record.csv", ["time,y", "0:00:01,1", "0.5,1"])
    refused("record.csv", "its time is a number, and in line 2 a duration")
    put("record.csv", ["time,y", "0:00:01,1", "0:99:00,1"])
    refused("record.csv", "line 3")


@pytest.mark.parametrize("seed", range(4))
def test_merged_clocks_lose_nothing_and_invent_nothing(seed, monkeypatch):
    monkeypatch.setattr("qpmhe.records.channels._BATCH", 5)
    generator = np.random.default_rng(seed)
    tolerance = [0.0, 0.01, 0.3, 5.0][seed]
    times = [np.sort(generator.uniform(0, 3, generator.integers(0, 40)).round(2))
             for _ in range(4)]
    axis, samples = merged(times, tolerance)
    assert (np.diff(axis) >= 0).all()
    for own, rows in zip(times, samples, strict=True):
        assert len(np.unique(rows)) == len(own)  # one value of each clock in a sample
        assert (np.diff(rows) > 0).all()
        assert (own >= axis[rows]).all()
        assert (own - axis[rows] <= tolerance + 1e-12).all()
    assert set(axis) <= {*np.concatenate(times)}
    assert {*np.concatenate(samples).tolist()} == {*range(len(axis))}


def test_estimates_of_two_clocks_are_those_of_the_merged_rows(here):
    late = 0.02
    inputs = np.where(T2 < 1.0, 0.3, -0.3)
    mf4("record.mf4", [(T1, {"y": FAST}), (T2 + late, {"u": inputs})])
    summary = estimate(CONTINUOUS, "record.mf4")
    rows, held = ["time,y,u"], None
    for time, y, u in sorted([(t, y, None) for t, y in zip(T1, FAST, strict=True)]
                             + [(t + late, None, u) for t, u in zip(T2, inputs, strict=True)]):
        held = u if held is None or u is not None else held
        if held is not None:
            rows.append(f"{time!r},{'' if y is None else y},{held}".replace("np.float64", "")
                        .replace("(", "").replace(")", ""))
    put("rows.csv", rows)
    estimate(CONTINUOUS, "rows.csv", "rows-out.csv")
    assert get("out.csv") == get("rows-out.csv")
    assert summary.incomplete == 20
    assert any("1 samples of record.mf4 come before the first value of an input" in note
               for note in summary.notes)


def same_record(here):
    """One record of the continuous model in several kinds of files, and the columns if needed."""
    put("lines.csv", lines(50, irregular=False, gaps=0.0))
    table = pd.read_csv("lines.csv").ffill()
    table["time"] = times = np.arange(50) * DT
    table.to_csv("record.csv", index=False)
    columns = {name: table[name].to_numpy() for name in "yu"}
    mf4("record.mf4", [(times, columns)], datetime(2026, 3, 2, 8, 0, tzinfo=UTC))
    from scipy.io import savemat
    savemat("record.mat", {"time": times, **columns})
    h5py = pytest.importorskip("h5py")
    with h5py.File("record.h5", "w") as file:
        file["time"] = times
        for name, values in columns.items():
            file[name] = values
    for folder, plugin in (("run", "MCAP"), ("old", "SQLITE3")):
        bag(folder, plugin, [(f"/{name}", EPOCH + (times * 1e9).round(), None, values)
                             for name, values in columns.items()])
    named = {"outputs": "y1=/y.data", "inputs": "u1=/u.data"}
    return {"record.mf4": {}, "record.mat": {}, "record.h5": {}, "run": named, "old/old.db3": named}


def test_every_kind_is_the_same_record(here):
    model = load_record_model(CONTINUOUS)
    for name, chosen in same_record(here).items():
        expected, found = read_record("record.csv", model), read_record(name, model, **chosen)
        for one, other in zip(expected[:2], found[:2], strict=True):
            np.testing.assert_array_equal(one, other)
    study = qpmhe.studies.Study(models=[CONTINUOUS], records=["run"], qps=[0], backends=["banded"],
                                solver_iterations=[None], reading=chosen)
    assert [cell.steps for cell in study.cells()] == [50]


@pytest.mark.slow
@covering(
    strength=1, out=["out.csv", "out.jsonl", "out.parquet"],
    name=["record.csv", "record.jsonl", "record.parquet", "record.mf4", "record.mat", "record.h5",
          "run", "old/old.db3"],
)
def test_killed_runs_resume_byte_for_byte(here, name, out):
    """SIGKILL at a random row, and while a checkpoint, or the Parquet file, takes its place."""
    chosen = same_record(here).get(name, {})
    table = pd.read_csv("record.csv")
    table.to_parquet("record.parquet")
    put("record.jsonl", table.to_json(orient="records", lines=True, double_precision=15).split())
    options = {"checkpoint_every": 10, **chosen}
    estimate(CONTINUOUS, name, f"whole-{out}", **options)
    generator = np.random.default_rng(len(name + out))
    options["checkpoint_seconds"] = 0.0
    kills = [("row", generator.integers(12, 25)), ("replace", generator.integers(1, 3)),
             ("row", generator.integers(1, 9))]
    for place, number in [*kills, ("replace", 3)] if out == "out.parquet" else kills:
        assert killed(CONTINUOUS, name, out, place, int(number), **options) == -signal.SIGKILL
    done = estimate(CONTINUOUS, name, out, resume=True, **options)
    assert done.before + done.samples == 50
    assert done.before >= 10
    assert get(out) == get(f"whole-{out}")


@pytest.mark.slow
def test_bad_files_are_one_line_each(here):
    mf4("record.mf4", [(T1, {"y": FAST}), (T2 + 1e9, {"other": SLOW})])
    from scipy.io import savemat
    savemat("record.mat", {"time": T1, "y": FAST})
    h5py = pytest.importorskip("h5py")
    with h5py.File("record.h5", "w") as file:
        file["time"], file["y"] = T1, FAST
    bag("run", "MCAP", [("/y", EPOCH + np.arange(20), None, SLOW)])
    for name in ("record.mf4", "record.mat", "record.h5", "run/run.mcap"):
        whole = get(name)
        for content in (whole[: len(whole) // 2], whole[:20], b"no such thing", b""):
            cut = Path(f"cut{Path(name).suffix}")
            cut.write_bytes(content)
            mend = "'mcap recover cut.mcap -o whole.mcap'" if cut.suffix == ".mcap" else ""
            refused(str(cut), f"{cut}: it cannot be read as", "cut off", mend)
        Path("renamed.csv").write_bytes(whole)
        refused("renamed.csv", "renamed.csv: it is", "name the file, in .")
        refused(f"nowhere{Path(name).suffix}", "No such file")
    refused("record.mf4", "'y' lasts from 0.0 to", "two clocks")
    refused("record.mf4", "no column for column 'speed'", "'y', 'other'", columns=["speed"])
    mf4("many.mf4", [(T2, {f"signal {k:03d}": SLOW for k in range(60)} | {"Speed_kmh": SLOW})])
    refused("many.mf4", "the nearest first, 'Speed_kmh'", "and 21 more", columns=["speed_km"])


@pytest.mark.parametrize(("backwards", "moved"), [(1, -0.25), (7, -0.25), (7, np.nan), (7, np.inf)])
def test_output_is_kept_up_to_a_time_that_goes_backwards_or_is_none(here, backwards, moved):
    times = T2.copy()
    times[backwards:backwards + 2] += moved
    what = "time goes backwards" if np.isfinite(moved) else f"is {moved + 0.0}; correct the file"
    h5py = pytest.importorskip("h5py")
    with h5py.File("record.h5", "w") as file:
        file["time"], file["y1"] = times, SLOW
        file["b/time"], file["b/y2"] = T2, SLOW
    message = refused("record.h5", what, f"value {backwards + 1}",
                      "column 'y1'", read=lambda name: estimate(DISCRETE, name))
    put("rows.csv", ["time,y1,y2", *(f"{t},{y},{y}" for t, y in zip(
        T2[:backwards], SLOW, strict=False))])
    estimate(DISCRETE, "rows.csv", "rows-out.csv")
    assert get("out.csv") == get("rows-out.csv"), message
    mf4("record.mf4", [(np.r_[T2, T2[-1]], {"y1": np.r_[SLOW, 0.0], "y2": np.r_[SLOW, 0.0]})])
    refused("record.mf4", "is in sample 20 already",
            read=lambda name: estimate(DISCRETE, name, overwrite=True))
    assert estimate(DISCRETE, "record.mf4", overwrite=True, skip_repeated=True).samples == 20
    with h5py.File("first.h5", "w") as file:
        file["time"], file["y1"], file["y2"] = np.r_[np.nan, T2[1:]], SLOW, SLOW
    refused("first.h5", "the time of value 1 is nan")


@pytest.mark.parametrize("kind", ["h5", "mat", "7.3"])
def test_a_time_that_is_not_there_is_refused_before_anything_is_written(here, kind):
    from scipy.io import savemat

    name = "record.h5" if kind == "h5" else "record.mat"
    variables = {"stamp": T2, "y1": SLOW, "y2": SLOW}
    if kind == "h5":
        with pytest.importorskip("h5py").File(name, "w") as file:
            for one, values in variables.items():
                file[f"log/{one}"] = values
    elif kind == "mat":
        savemat(name, {"log": variables})
    else:
        pytest.importorskip("pymatreader")
        mat73(name, {"log": variables})
    refused(name, "no variable 'stmp' for the time; the nearest are 'stamp', '", "--time NAME",
            read=lambda name: estimate(DISCRETE, name, time="stmp"))
    assert os.listdir() == [name]
    assert estimate(DISCRETE, name, time="Stamp").samples == 20


def test_a_folder_without_metadata_is_no_bag_yet(here):
    bag("run", "MCAP", [("/y", EPOCH + np.arange(20), None, SLOW)])
    Path("run/metadata.yaml").unlink()
    refused("run", "has no metadata.yaml; name a file", "the .mcap or .db3 file in it",
            "'ros2 bag reindex run'")
    assert len(read("run/run.mcap")) == 20


@pytest.mark.parametrize(("name", "module", "extra"), [
    ("x.mf4", "asammdf", "mf4"), ("x.h5", "h5py", "hdf5"), ("x.mcap", "rosbags.highlevel", "ros"),
    ("x.mat", "pymatreader", "mat"), ("x.csv", "pandas", "studies"),
    ("x.parquet", "pyarrow", "studies"),
])
def test_a_missing_package_is_named_with_its_command(here, monkeypatch, name, module, extra):
    if name == "x.mat":
        mat73(name, {"time": T2, "y": SLOW})
    else:
        Path(name).write_bytes(b"MDF     " + bytes(100))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(qpmhe.errors.InvalidInputError, match=rf"pip install 'qpmhe\[{extra}\]'"):
        read(name)
    assert os.listdir() == [name]
