"""Times keep their type and all their digits."""

from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import RecordError
from qpmhe.records.measurements import FieldReader, seconds_between

from .tools import CONTINUOUS, DISCRETE, estimate, get, put

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

START = 1_780_000_000 * 10**9  # in May 2026, in nanoseconds; no float has its last digits


def table(time):
    size = len(time)
    return pa.table({
        "time": time, "y1": pa.array(np.arange(size) % 7.0), "y2": pa.array(np.arange(size) % 3.0),
    })


def nanoseconds(step, size=12, first=START + 100):
    return [first + k * step for k in range(size)]


def stamps(kind, step):
    per = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}[kind.unit]
    whole = [value // per for value in nanoseconds(step)]
    return pa.array(whole, pa.int64()).cast(kind)


@pytest.mark.parametrize(
    ("time", "dt", "scale"),
    [
        (pa.array(nanoseconds(100)), 1e-7, 1e-9),
        (pa.array(list(range(12)), pa.int32()), 1.0, 1.0),
        (pa.array(list(range(12)), pa.uint8()), 1.0, 1.0),
        (pa.array([0.1 * k for k in range(12)], pa.float64()), 0.1, 1.0),
        (pa.array([0.5 * k for k in range(12)], pa.float32()), 0.5, 1.0),
        (stamps(pa.timestamp("ns"), 100), 1e-7, 1.0),
        (stamps(pa.timestamp("ns", "UTC"), 100), 1e-7, 1.0),
        (stamps(pa.timestamp("ns", "Europe/Berlin"), 100), 1e-7, 1.0),
        (stamps(pa.timestamp("us", "America/New_York"), 3600 * 10**9), 3600.0, 1.0),
        (stamps(pa.timestamp("us", "+05:30"), 10**6), 1e-3, 1.0),
        # With the hour that comes twice.
        (pa.array([1_792_884_600_000 + 1_800_000 * k for k in range(12)]).cast(
            pa.timestamp("ms", "Europe/Berlin")), 1800.0, 1.0),
        (stamps(pa.timestamp("ms"), 10**6), 1e-3, 1.0),
        (pa.array(np.arange(20_000, 20_012), pa.int32()).cast(pa.date32()), 86_400.0, 1.0),
        (pa.array([f"2026-05-04T12:00:{k:02d}+02:00" for k in range(12)]), 1.0, 1.0),
    ],
    ids=lambda value: str(getattr(value, "type", "")) or None,
)
def test_parquet_to_parquet(here, time, dt, scale):
    pq.write_table(table(time), "record.parquet")
    summary = estimate(
        DISCRETE, "record.parquet", "out.parquet", dt=dt, time_scale=scale
    )
    assert (summary.samples, summary.inserted) == (12, 0)
    found = pq.read_table("out.parquet").column("time").combine_chunks()
    assert found.type == time.type
    assert found.equals(time)
    # And by way of CSV, where there are no types.
    estimate(DISCRETE, "record.parquet", dt=dt, time_scale=scale)
    stamps = [row.split(",")[0] for row in Path("out.csv").read_text().splitlines()]
    put("text.csv", ["time,y1,y2", *(f"{stamp},1,2" for stamp in stamps[1:])])
    estimate(DISCRETE, "text.csv", "again.csv", dt=dt, time_scale=scale)
    again = Path("again.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in again] == stamps


def test_a_type_of_time_that_text_cannot_be_converted_to(here):
    pq.write_table(table(pa.array(np.arange(12), pa.float16())), "record.parquet")
    estimate(DISCRETE, "record.parquet", "out.parquet")
    assert pq.read_table("out.parquet").column("time").to_pylist() == list(range(12))


@pytest.mark.parametrize(
    ("times", "kind"),
    [
        (["0", "1", "2"], pa.int64()),
        ([str(one) for one in nanoseconds(10**9, 3)], pa.int64()),
        (["0", "1.0", "2"], pa.float64()),
        (["2026-05-04 12:00:00", "2026-05-04 12:00:01"], pa.timestamp("ms")),
        (["2026-05-04T12:00:00Z", "2026-05-04T12:00:01Z"], pa.timestamp("ms", "UTC")),
        (["2026-05-04T12:00:00+02:00", "2026-05-04T11:00:01.5+01:00"],
         pa.timestamp("ns", "UTC")),
        (["0", str(2**63)], pa.float64()),
        (["2026-05-04T12:00:00.000000001", "2026-05-04T12:00:01"], pa.timestamp("ns")),
    ],
)
def test_csv_to_parquet(here, times, kind):
    put("record.csv", ["time,y1,y2", *(f"{time},1,2" for time in times)])
    estimate(DISCRETE, "record.csv", "out.parquet")
    found = pq.read_table("out.parquet").column("time")
    assert found.type == kind
    if pa.types.is_int64(kind):
        assert [str(one) for one in found.to_pylist()] == times


def test_dates_a_nanosecond_apart():
    read = FieldReader().time
    one = read("2026-05-04T12:00:00.123456789")
    assert one.value % 1000 == 789
    assert read("2026-05-04T12:00:00.12345679").value == one.value + 1
    assert read("2026-05-04T12:00:00.12345679+00:00").kind != one.kind
    assert read("2026-05-04T14:00:00+02:00").value == read("2026-05-04T12:00:00Z").value
    later = read("2026-05-04T12:00:01.123456790")
    assert seconds_between(one, later) == pytest.approx(1 + 1e-9, abs=1e-15)
    assert read("2026-05-04T12:00:00,5").value % 10**9 == 5 * 10**8


def test_whole_numbers_are_exact():
    read = FieldReader().time
    assert seconds_between(read(str(START)), read(str(START + 1))) == 1.0
    assert seconds_between(read("1"), read("2.5")) == 1.5


def test_inputs_that_are_true_or_false(here):
    times = [0.1 * k for k in range(20)]
    on = [k % 5 > 2 for k in range(20)]
    frame = {"time": pa.array(times), "y": pa.array(np.sin(times)), "u": pa.array(on)}
    pq.write_table(pa.table(frame), "record.parquet")
    frame["u"] = pa.array([float(one) for one in on])
    pq.write_table(pa.table(frame), "plain.parquet")
    for name in ("record", "plain"):
        estimate(CONTINUOUS, f"{name}.parquet", f"{name}.csv")
    assert get("record.csv") == get("plain.csv")


def test_dates_that_no_calendar_has(here):
    time = pa.array([2**62, 2**62 + 1], pa.int64()).cast(pa.timestamp("us"))
    pq.write_table(table(time), "record.parquet")
    with pytest.raises(RecordError, match=r"row 1, column 'time'.*expected a number, or a date"):
        estimate(DISCRETE, "record.parquet", "out.csv")
