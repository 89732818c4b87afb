"""What a record may be, and what is wrong with one: where it is, and what to do, in one line."""

import gzip
from pathlib import Path

import pytest

from qpmhe.errors import OptionError
from qpmhe.records import RecordError
from qpmhe.records.steps import Steps

from .oscillator import discrete, lines
from .tools import CONTINUOUS, DISCRETE, estimate, get, put, rows, shell

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


WRONG_LINES = [
    ("0.3,high,0\n", ["column 'y'", "'high' is not a number", "blank"]),
    ("0.3,0.5,1_000\n", ["column 'u'", "'1_000' is not a number"]),
    ("0.3,\0\0,0\n", ["column 'y'", "not a number"]),
    ("0.3,1 2,0\n", ["'1 2' is not a number"]),
    ("0.3,\"1,5\",0\n", ["column 'y'", "decimal mark ','", "--decimal"]),
    ("0.3,\"1,000.5\",0\n", ["column 'y'", "two kinds of decimal marks"]),
    ("0.2,0.5,0\n", ["column 'time'", "time 0.2 is in line 4 already", "keep one"]),
    ("0.15,0.5,0\n", ["column 'time'", "time 0.15 is before 0.2 in line 4", "sort"]),
    (",0.5,0\n", ["column 'time'", "blank"]),
    ("inf,0.5,0\n", ["column 'time'", "not finite"]),
    ("noon,0.5,0\n", ["column 'time'", "'noon' is not a number", "2026-05-04T12:00:00"]),
    ("04/05/2026,0.5,0\n", ["'04/05/2026' is not a number", "--time-format", "'.%f'"]),
    ("s,V,A\n", ["'s' is not a number", "delete the line if it holds units"]),
    ("0.3,n/v,0\n", ["'n/v' is not a number", "leave it blank", "--missing"]),
    ("32.05.2026,0.5,0\n", ["'32.05.2026' is not a number", "--time-format"]),
    ("2026-01-01 00:00:00,0.5,0\n", ["column 'time'", "a date, and in line 4 a number"]),
    ("0.3;0.5;0\n", ["it has 1 field, and the header 3", "correct"]),
    ("0,3,0,5,0\n", ["it has 5 fields", "decimal commas"]),
    ("0.3,\"0.5,0\n", ["quotation marks", "close"]),
    ("0.3,\"never closed,0\n" * 50, ["cannot be split into fields", "close quotation marks"]),
    ("900.0,0.5,0\n", ["gap", "--max-gap", "--time-scale"]),
    ("# stopped\n", ["delete it if it is a comment"]),
    ("0.3", ["cut off"]), ("0.3,0.5", ["cut off"]), ("0.3,\"0.5", ["quotation"]),
    ("0.3,0.5,-", ["may be cut off"]),
    (b"0.3,\xb0,0\n", ["byte 5", "--encoding"]),
]


def test_wrong_lines(here):
    put("record.csv", [GOOD], "")
    estimate(CONTINUOUS, out="expected.csv")
    for wrong, words in WRONG_LINES:
        content = GOOD.encode() + (wrong if isinstance(wrong, bytes) else wrong.encode())
        message = refused(content)
        assert message.startswith("record.csv, line 5"), message
        for word in (*words, "--resume"):
            assert word in message, wrong
        # The good ones are estimated all the same.
        assert get("out.csv").count(b"\n") >= 3
        assert get("expected.csv").startswith(get("out.csv"))
    assert "%f is a fraction" in refused(b"time,y,u\n04/05/2026 12:00:00.5,0,0\n",
                                         time_format="%d/%m/%Y %H:%M:%S")
    # With the right encoding it is a text, and no number.
    assert "'°' is not a number" in refused(GOOD.encode() + b"0.3,\xb0,0\n", encoding="cp1252")


NO_SAMPLES = [
    (b"", "is empty"), (b"\n\n \n", "is empty"), (b"\xef\xbb\xbf", "is empty"),
    (b"time,y,u\n", "no samples"), (b"time,y,u", "no samples"),
    (b"0.0,0.5,0\n0.1,0.6,0\n", "header"),
    (b"t1me,y,u\n0,1,2\n", "--time"),
    (b"time,why,u\n0,1,2\n", "'time', 'why', 'u'"),
    (b"time,y\n0,1\n", "input 'u1'"),
    (b"time,y,y,u\n0,1,1,2\n", "2 columns could all be output"),
    (b"time,y (V),y (mV),u\n0,1,1,2\n", "'y (V)', 'y (mV)'; rename all but one"),
    (b"time,y;u\n0,1;2\n", "--separator"), (b"time y u\n0 1 2\n", "--separator"),
    (b"time,y,u\n0,1,\n", "no earlier value"),
    (GOOD.encode("utf-16"), "UTF-16"),
    (b"PK\x03\x04" + bytes(100), "spreadsheet"), (b"BZh91AY" + bytes(100), "bzip2"),
    (b"\xfd7zXZ\0" + bytes(100), "xzcat"), (b"\x28\xb5\x2f\xfd" + bytes(100), "zstd"),
    (GOOD.replace("\n", "\r").encode(), "end lines in LF"),
    (f"# logger v1\n{GOOD}".encode(), "Skip lines above the header with --skip-lines"),
    (f"Logger,v1\n\nserial,77\n{GOOD}".encode(), "Skip lines above the header with --skip-lines"),
    (",".join(f"channel {k:04d} {'x' * 500}" for k in range(500)).encode(), "and 460 more"),
]


def test_records_without_a_single_sample(here):
    for content, words in NO_SAMPLES:
        message = refused(content)
        assert words in message, content[:40]
        assert "--encoding" not in message


def test_files_that_cannot_be_read(here):
    Path("nothing.parquet").write_bytes(b"PAR1 and nothing else")
    for name, words in (("nowhere.csv", "cannot be read"), (".", "cannot be read"),
                        ("nothing.parquet", "Parquet")):
        if "Parquet" in words:
            pytest.importorskip("pyarrow")
        with pytest.raises(RecordError, match=words):
            estimate(CONTINUOUS, name)
    assert not Path("out.csv").exists()


def test_a_parquet_file_counts_rows(here):
    pytest.importorskip("pyarrow")
    pd = pytest.importorskip("pandas")
    for times, words in (([0.0, 0.1, 0.1], r"column 'time': time 0\.1 is in row 2"),
                         ([0.0, 0.1, 0.2], "column 'y': 'x' is not a number")):
        frame = pd.DataFrame({"time": times, "y": ["1", "2", "x"], "u": 0.0})
        frame.to_parquet("record.parquet")
        with pytest.raises(RecordError, match=f"row 3, {words}"):
            estimate(CONTINUOUS, "record.parquet", overwrite=True)


def test_gzip_and_parquet_by_whatever_name(here):
    text, totals = lines(30), set()
    put("record.csv", text)
    estimate(CONTINUOUS, out="whole.csv")
    packed = gzip.compress(get("record.csv"))
    for name in ("record.csv.gz", "packed.csv"):
        Path(name).write_bytes(packed)
        estimate(CONTINUOUS, name, overwrite=True, progress=lambda _, total: totals.add(total))
        assert get("out.csv") == get("whole.csv")
    assert totals == {None}  # what is read is not what the file's size counts
    code, out, error = shell(f"qpmhe estimate {CONTINUOUS} - --no-step-time < packed.csv")
    assert (code, out) == (0, Path("whole.csv").read_text()), error
    for content in (packed[: len(packed) // 2], packed[:10] + b"\xff" * 30 + packed[40:]):
        Path("cut.csv.gz").write_bytes(content)
        with pytest.raises(RecordError, match="cannot be read any further"):
            estimate(CONTINUOUS, "cut.csv.gz", overwrite=True)
    Path("cut.csv.gz").write_bytes(packed)
    estimate(CONTINUOUS, "cut.csv.gz", resume=True)
    assert get("out.csv") == get("whole.csv")
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    pd.read_csv("record.csv").to_parquet("record.dat")
    estimate(CONTINUOUS, "record.dat", overwrite=True)
    assert get("out.csv") == get("whole.csv")
    code, out, error = shell(f"qpmhe estimate {CONTINUOUS} - < record.dat")
    assert (code, out) == (2, "")
    assert "it is a Parquet file" in error


WRITINGS = [
    (SHORT[:-1], {}, "the last line of record.csv, 4, has no end of line"),
    (f"{SHORT},,\n,,\n", {}, "2 rows without any value"),
    (f"{SHORT},,\n , ,\n,,", {}, "3 rows without any value"),
    (SHORT.replace("\n1", "\n,,\n1"), {}, "1 rows without"),
    ('time,note,y1,y2\n0,"two, ""so""",1,2\n1,"",2,1\n2,none,1,2\n', {}, None),
    ("sep=;\n" + SHORT.replace(",", ";"), {}, None),
    (SHORT.replace("\n", "\r\n\r\n"), {}, None),
    ("\ufeff" + SHORT.replace(",", "\t"), {}, None),
    (SHORT.replace(",", "|"), {}, None),
    (SHORT.replace(",", " "), {"separator": "space"}, None),
    ("a\n\n# by hand\n" + SHORT, {"skip_lines": 3}, None),
    ("time (s);Level / m;Flow [l/s]\n0;1;2\n1;2;1\n2;1;2\n",
     {"outputs": "y1=Level,y2=flow", "time": "Time"}, None),
    ("time;Level;Flow\n0;1;2\n1;2;1\n2;1;2\n",
     {"outputs": "y1=Level [m],y2=Flow (l/s)", "time": "time (s)"}, None),
    ('"Time, h","Level ""1""",x\n"0",1,2\n"1",2,1\n2,"1",2\n',
     {"time": "Time, h", "outputs": '"y1=Level ""1""",y2=x', "separator": ","}, None),
    (SHORT.replace("\n2,", "\n1,7,7\n1.0,,\n2,"), {"skip_repeated": True}, None),
]


def test_ways_of_writing_a_record_make_no_difference(here):
    _, expected = read(SHORT)
    for content, options, note in WRITINGS:
        summary, found = read(content, **options)
        assert found == expected, content
        assert summary.repeated == (2 if "skip_repeated" in options else 0)
        assert [note in one for one in summary.notes] == [True] * bool(note), content


def test_ways_of_writing_times_make_no_difference(here):
    expected = None
    for form, options in (
        ("{}", {}), ("04.05.2026 12:00:0{}", {}), ("4.5.2026 12:00:0{}.000", {}),
        ("05/04/2026 0{}", {"time_format": "%m/%d/%Y %S"}), ("{},000", {}),
        ("{}000", {"time_scale": 1e-3}),
    ):
        text = [f"{form.format(t)};{t % 2};1,5" for t in range(9)]
        _, found = read("\n".join(["time;y1;y2", *text, ""]), **options)
        found = [row.partition(",")[2] for row in found.splitlines()]
        expected = expected or found
        assert found == expected, form


def test_an_end_that_may_be_cut_off_is_read_again(here):
    summary, _ = read(SHORT + "3,1,2")
    assert "--resume" in summary.notes[0]
    put("record.csv", [SHORT + "3,1,20.25"])
    estimate(DISCRETE, resume=True)
    found = Path("out.csv").read_text()
    assert found == read(SHORT + "3,1,20.25\n")[1]
    code, _, error = shell(f"printf 'time,y1,y2\\n0,1,2' | qpmhe estimate {DISCRETE} -")
    assert code == 0
    assert "note: the last line of standard input, 2, has no end of line" in error


@pytest.mark.parametrize("words", [["miss", "-999"], "Miss"])
def test_words_for_missing_values(here, words):
    _, expected = read("time,y1,y2\n0,1,\n1,,1\n2,1,2\n")
    text = "time,y1,y2\n0,1,<NA>\n1,MISS,1\n2,1,2\n"
    assert read(text, missing=words)[1] == expected
    assert "'MISS' is not a number" in refused(text, DISCRETE)
    if "-999" in words:
        text = "time,y1,y2\n0,1,-999\n1,-999.00,1\n2,1,2\n"
        assert read(text, missing=words)[1] == expected
        # A time is one all the same.
        assert read("time,y1,y2\n-999,1,2\n", missing=words)[0].samples == 1
    with pytest.raises(OptionError, match="--missing"):
        read(text, missing=[" "])


def test_steps_that_a_discrete_model_cannot_take(here):
    message = refused("time,y1,y2\n0,1,1\n1,1,1\n2.5,1,1\n", DISCRETE)
    for word in ("record.csv, line 4", "1.5", "resample", "--dt", "from_ode"):
        assert word in message
    assert rows("out.csv") == 3
    assert "line 3" in refused("time,y,u\n0,1,1\n0.15,1,1\n", equal_steps=True)


def test_gaps_and_units_that_are_taken_for_them(here):
    def content(times):
        return "\n".join(["time,y1,y2", *(f"{t},{k % 7},{k % 3}" for k, t in enumerate(times)), ""])

    milliseconds = content(range(0, 50_000, 1000))
    message = refused(milliseconds, DISCRETE, dt=1.0)
    assert message.startswith("record.csv, line 3: ")
    assert "--max-gap" in message
    summary, _ = read(milliseconds, dt=1.0, time_scale=1e-3)
    assert (summary.samples, summary.inserted, summary.notes) == (50, 0, [])
    assert "line 152" in refused(content([*range(150), *range(900, 950)]), DISCRETE, dt=1.0)
    summary = estimate(DISCRETE, dt=1.0, max_gap=750, resume=True)
    assert (summary.before, summary.samples, summary.inserted) == (100, 100, 750)
    summary, _ = read(content(range(0, 100, 10)), dt=1.0)
    assert summary.inserted == 81
    assert "--time-scale" in summary.notes[0]


@pytest.mark.parametrize("spacings", [
    [5, 5, 1, 5, 1, 5, 5, 5, 5, 5, 5],  # two usual ones
    [2, 9, 4, 30, 2, 7, 3, 12],  # gaps of all sizes
    [1, *[5] * 30],
    [501],
])
def test_gaps_that_are_gaps(spacings):
    found = Steps(discrete()[0], usual=1.0)
    assert [found.between(float(one), 0.0).inserted + 1 for one in spacings] == spacings


def test_a_continuous_record_with_blanks_in_other_marks_is_the_same(here):
    text = lines(15)
    put("record.csv", text)
    estimate(CONTINUOUS, out="expected.csv")
    put("record.csv", [line.replace(",", ";").replace(".", ",") for line in text])
    estimate(CONTINUOUS)
    assert get("out.csv") == get("expected.csv")
