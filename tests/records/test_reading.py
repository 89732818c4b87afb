"""What a record may be, and what is wrong with one: where it is, and what to do, in one line."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from qpmhe.errors import OptionError
from qpmhe.estimation.steps import Steps
from qpmhe.records import ReadingOptions, RecordError

from .oscillator import discrete, lines
from .tools import CONTINUOUS, DISCRETE, estimate, get, put, rows, shell

pa = pytest.importorskip("pyarrow")
pd = pytest.importorskip("pandas")
pq = pytest.importorskip("pyarrow.parquet")


START = 1_780_000_000 * 10**9  # in May 2026, in nanoseconds; no float has its last digits
NUMBERS = list(range(12))
GOOD = "time,y,u\n0.0,0.5,0\n0.1,0.6,0\n0.2,0.7,0\n"
SHORT = "time,y1,y2\n0,1,2\n1,2,1\n2,1,2\n"


def read(content, model=DISCRETE, **options):
    """The summary and the results of a record."""
    Path("record.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    return estimate(model, overwrite=True, **options), Path("out.csv").read_text()


def refused(content, model=CONTINUOUS, **options):
    with pytest.raises(RecordError) as caught:
        read(content, model, **options)
    message = str(caught.value)
    assert message.startswith("record.csv")
    assert "\n" not in message
    assert len(message) < 5000
    return message


def test_wrong_lines(here):
    put("record.csv", [GOOD], "")
    estimate(CONTINUOUS, out="expected.csv")
    for wrong, *words in (
        ("0.3,high,0\n", "column 'y'", "'high' is not a number", "blank"),
        ("0.3,0.5,1_000\n", "column 'u'", "'1_000' is not a number"),
        ('0.3,"1,5",0\n', "column 'y'", "decimal mark ','", "--decimal"),
        ("0.2,0.5,0\n", "column 'time'", "time 0.2 is in line 4 already", "keep one"),
        ("0.15,0.5,0\n", "column 'time'", "time 0.15 is before 0.2 in line 4", "sort"),
        (",0.5,0\n", "column 'time'", "blank"), ("inf,0.5,0\n", "column 'time'", "not finite"),
        ("04/05/2026,0.5,0\n", "'04/05/2026' is not a number", "--time-format", "'.%f'"),
        ("s,V,A\n", "'s' is not a number", "delete the line if it holds units"),
        ("2026-01-01 00:00:00,0.5,0\n", "column 'time'", "a date, and in line 4 a number"),
        ("0,3,0,5,0\n", "it has 5 fields", "decimal commas"),
        ('0.3,"0.5,0\n', "quotation marks", "close"),
        ("900.0,0.5,0\n", "gap", "--max-gap", "--time-scale"),
        ("# stopped\n", "delete it if it is a comment"),
        ("0.3", "cut off"), ('0.3,"0.5', "quotation"), ("0.3,0.5,-", "may be cut off"),
        ("0.3,\udcb0,0\n", "byte 5", "--encoding"),
    ):
        message = refused(GOOD.encode() + wrong.encode(errors="surrogateescape"))
        assert message.startswith("record.csv, line 5"), message
        for word in (*words, "--resume"):
            assert word in message, wrong
        # The good ones are estimated all the same.
        assert rows() >= 3
        assert get("expected.csv").startswith(get("out.csv"))
    # With the right encoding it is a text, and no number.
    assert "'°' is not a number" in refused(GOOD.encode() + b"0.3,\xb0,0\n", encoding="cp1252")


def test_records_without_a_single_sample_and_files_that_cannot_be_read(here):
    for content, words in (
        (b"\n\n \n", "is empty"), (b"\xef\xbb\xbf", "is empty"),
        (b"time,y,u\n", "no samples"), (b"time,y,u", "no samples"),
        (b"0.0,0.5,0\n0.1,0.6,0\n", "header"), (b"t1me,y,u\n0,1,2\n", "--time"),
        (b"T,y,u\n0,1,1\n", "'T' may be a temperature"),
        (b"clock,T [K],y,u\n0,1,1,1\n", "'T [K]' has no unit of time"),
        (b"time,y (V),y (mV),u\n0,1,1,2\n", "'y (V)', 'y (mV)'; rename all but one"),
        (b"time,y;u\n0,1;2\n", "--separator"), (b"time y u\n0 1 2\n", "--separator"),
        (b"PK\x03\x04" + bytes(100), "spreadsheet"), (GOOD.encode("utf-16"), "UTF-16"),
        (f"Logger,v1\n\nserial,77\n{GOOD}".encode(), "Skip lines above the header with --skip"),
        (",".join(f"channel {k:04d} {'x' * 500}" for k in range(500)).encode(), "and 460 more"),
    ):
        message = refused(content)
        assert words in message, content[:40]
        assert "--encoding" not in message
    Path("out.csv").unlink(missing_ok=True)
    Path("nothing.parquet").write_bytes(b"PAR1 and nothing else")
    for name, words in (("nowhere.csv", "cannot be read"), (".", "it is a folder"),
                        ("nothing.parquet", "Parquet")):
        with pytest.raises(RecordError, match=words):
            estimate(CONTINUOUS, name, overwrite=True)
    assert not Path("out.csv").exists()
    frame = pd.DataFrame({"time": [0.0, 0.1, 0.2], "y": ["1", "2", "x"], "u": 0.0})
    frame.to_parquet("record.parquet")
    with pytest.raises(RecordError, match="row 3, column 'y': 'x' is not a number"):
        estimate(CONTINUOUS, "record.parquet", overwrite=True)


def test_gzip_and_parquet_by_whatever_name(here):
    text, totals = lines(30), set()
    put("record.csv", text)
    estimate(CONTINUOUS, out="whole.csv")
    packed = gzip.compress(get("record.csv"))
    Path("packed.csv").write_bytes(packed)
    pd.read_csv("record.csv").to_parquet("record.dat")
    for name in ("packed.csv", "record.dat"):
        estimate(CONTINUOUS, name, overwrite=True, progress=lambda _, total: totals.add(total))
        assert get("out.csv") == get("whole.csv")
        assert (totals == {None}) == (name == "packed.csv")  # its size counts other bytes
    for content in (packed[: len(packed) // 2], packed[:10] + b"\xff" * 30 + packed[40:]):
        Path("cut.csv.gz").write_bytes(content)
        with pytest.raises(RecordError, match="cannot be read any further"):
            estimate(CONTINUOUS, "cut.csv.gz", overwrite=True)
    code, out, error = shell(f"qpmhe estimate {CONTINUOUS} - < record.dat")
    assert (code, out) == (2, "")
    assert "it is a Parquet file" in error


@pytest.mark.parametrize(("name", "values"), [
    ("separator", (5, "", ";;", '"')), ("decimal", (5, "x", None)), ("encoding", (None, "", "\0")),
    ("missing", (None, [None], [b"x"], " ", {"x": 1})), ("skip_lines", (-1, 1.5, None)),
    ("skip_repeated", ("no", None)), ("log_time", ("no", 1)), ("time_format", (5,)),
    ("same_time", (0.0, "x")), ("format", ("xml", None)),
])  # fmt: skip
def test_reading_options_of_another_form_are_refused_by_name(name, values):
    for value in values:
        option = name.replace("_", "-")
        with pytest.raises(OptionError, match=rf"^--{option} is .*; expected "):
            ReadingOptions(**{name: value})
    assert ReadingOptions(missing=-9).missing == ("-9",)


def test_ways_of_writing_a_record_make_no_difference(here):
    _, expected = read(SHORT)
    for content, options, note in (
        (SHORT[:-1], {}, "the last line of record.csv, 4, has no end of line"),
        (f"{SHORT},,\n , ,\n,,", {}, "3 rows without any value"),
        ('time,note,y1,y2\n0,"two, ""so""",1,2\n1,"",2,1\n2,none,1,2\n', {}, None),
        ("sep=;\n" + SHORT.replace(",", ";"), {}, None),
        ("\ufeff" + SHORT.replace(",", "\t"), {}, None),
        (SHORT.replace("time", "T,t / s").replace("\n0", "\n,0").replace("\n1", "\n,1")
         .replace("\n2", "\n,2"), {}, None),
        (SHORT.replace(",", " ").replace("\n", "\r\n\r\n"), {"separator": "space"}, None),
        ("a\n\n# by hand\n" + SHORT, {"skip_lines": 3}, None),
        ("time (s);Level / m;Flow\n0;1;2\n1;2;1\n2;1;2\n",
         {"outputs": "y1=Level,y2=flow [l/s]", "time": "Time"}, None),
        ('"Time, h","Level ""1""",x\n"0",1,2\n"1",2,1\n2,"1",2\n',
         {"time": "Time, h", "outputs": '"y1=Level ""1""",y2=x', "separator": ","}, None),
        (SHORT.replace("\n2,", "\n1,7,7\n1.0,,\n2,"), {"skip_repeated": True}, None),
    ):
        summary, found = read(content, **options)
        assert found == expected, content
        assert summary.repeated == (2 if "skip_repeated" in options else 0)
        assert [note in one for one in summary.notes] == [True] * bool(note), content
    expected = None
    for form, options in (
        ("{}", {}), ("04.05.2026 12:00:0{}", {}), ("{}000", {"time_scale": 1e-3}),
        ("05/04/2026 0{}", {"time_format": "%m/%d/%Y %S"}), ("{},000", {}),
    ):
        text = [f"{form.format(t)};{t % 2};1,5" for t in range(9)]
        _, found = read("\n".join(["time;y1;y2", *text, ""]), **options)
        found = [row.partition(",")[2] for row in found.splitlines()]
        expected = expected or found
        assert found == expected, form
    _, expected = read("time,y1,y2\n0,1,\n1,,1\n2,,2\n")
    text = "time,y1,y2\n0,1,<NA>\n1,MISS,1\n2,-999.00,2\n"
    assert read(text, missing=["miss", "-999"])[1] == expected
    assert "'MISS' is not a number" in refused(text, DISCRETE)
    # A time is one all the same.
    assert read("time,y1,y2\n-999,1,2\n", missing="-999")[0].samples == 1


def test_steps_gaps_and_units_that_are_taken_for_them(here):
    def content(times):
        return "\n".join(["time,y1,y2", *(f"{t},{k % 7},{k % 3}" for k, t in enumerate(times)), ""])

    message = refused("time,y1,y2\n0,1,1\n1,1,1\n2.5,1,1\n", DISCRETE)
    for word in ("record.csv, line 4", "1.5", "resample", "--dt", "from_ode"):
        assert word in message
    assert rows() == 3
    assert "line 3" in refused("time,y,u\n0,1,1\n0.15,1,1\n", equal_steps=True)
    milliseconds = content(range(0, 50_000, 1000))
    message = refused(milliseconds, DISCRETE, dt=1.0)
    assert message.startswith("record.csv, line 3: ")
    assert "--max-gap" in message
    summary, _ = read(milliseconds, dt=1.0, time_scale=1e-3)
    assert (summary.samples, summary.inserted, summary.notes) == (50, 0, [])
    summary, _ = read("time,y,u\n0,1,1\n0.0001,1,1\n0.0002,1,1\n", CONTINUOUS)
    assert "2 of 2 steps are shorter" in summary.notes[0]
    assert "--time-scale" in summary.notes[0]
    assert "line 152" in refused(content([*range(150), *range(900, 950)]), DISCRETE, dt=1.0)
    summary = estimate(DISCRETE, dt=1.0, max_gap=750, resume=True)
    assert (summary.before, summary.samples, summary.inserted) == (100, 100, 750)
    # Two usual ones, gaps of all sizes, and long ones.
    for spacings in ([5, 5, 1, 5, 1, *[5] * 30], [2, 9, 4, 30, 2, 7, 3, 12], [501]):
        steps = Steps(discrete()[0], usual=1.0)
        assert [steps.between(float(one), 0.0).inserted + 1 for one in spacings] == spacings


def test_types_of_times_stay_and_come_back_from_csv(here):
    nanoseconds = pa.array([START + 100 * k for k in NUMBERS])
    for time, dt, scale in (
        (nanoseconds, 1e-7, 1e-9), (pa.array(NUMBERS, pa.uint8()), 1.0, 1.0),
        (pa.array([0.5 * k for k in NUMBERS], pa.float32()), 0.5, 1.0),
        (pa.array(np.arange(12), pa.float16()), 1.0, 1.0),  # text cannot be converted to it
        (nanoseconds.cast(pa.timestamp("ns", "+05:30")), 1e-7, 1.0),
        # With the hour that comes twice.
        (pa.array([1_792_884_600_000 + 1_800_000 * k for k in NUMBERS]).cast(
            pa.timestamp("ms", "Europe/Berlin")), 1800.0, 1.0),
        (pa.array(np.arange(20_000, 20_012), pa.int32()).cast(pa.date32()), 86_400.0, 1.0),
        (pa.array([f"2026-05-04T12:00:{k:02d}+02:00" for k in NUMBERS]), 1.0, 1.0),
    ):
        y = pa.array(np.arange(12) % 7.0)
        pq.write_table(pa.table({"time": time, "y1": y, "y2": y}), "record.parquet")
        options = {"dt": dt, "time_scale": scale, "overwrite": True}
        estimate(DISCRETE, "record.parquet", "out.parquet", **options)
        found = pq.read_table("out.parquet").column("time").combine_chunks()
        assert found.to_pylist() == time.to_pylist()
        assert found.type == time.type or time.type == pa.float16()
        estimate(DISCRETE, "record.parquet", **options)
        kept = [row.split(",")[0] for row in Path("out.csv").read_text().splitlines()]
        put("text.csv", ["time,y1,y2", *(f"{stamp},1,2" for stamp in kept[1:])])
        estimate(DISCRETE, "text.csv", "again.csv", **options)
        again = Path("again.csv").read_text().splitlines()
        assert [row.split(",")[0] for row in again] == kept
