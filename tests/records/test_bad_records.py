"""What is wrong with a record is told in one line: where it is, and what to do."""

from pathlib import Path

import pytest

from qpmhe.records import RecordError, estimate_record

from . import process
from .conftest import CONTINUOUS, DISCRETE

GOOD = "time,y,u\n0.0,0.5,0\n0.1,0.6,0\n0.2,0.7,0\n"


def told(content, model=CONTINUOUS, **options):
    Path("record.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordError) as caught:
        estimate_record(model, "record.csv", "out.csv", step_time=False, **options)
    return str(caught.value)


def after(wrong, end="\n"):
    """What is told of a line behind good ones; these are estimated all the same."""
    message = told(GOOD + wrong + end)
    assert message.startswith("record.csv, line 5")
    assert "--resume" in message
    rows = Path("out.csv").read_bytes()
    assert rows.count(b"\n") >= 3
    Path("good.csv").write_text(GOOD)
    estimate_record(CONTINUOUS, "good.csv", "expected.csv", step_time=False)
    assert Path("expected.csv").read_bytes().startswith(rows)
    return message


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("0.3,high,0", ["column 'y'", "'high' is not a number", "blank"]),
        ("0.3,0.5,1_000", ["column 'u'", "'1_000' is not a number"]),
        ("0.3,0.5 V,0", ["column 'y'", "'0.5 V'"]),
        ("0.3,\0\0,0", ["column 'y'", "not a number"]),
        ("0.3,1 2,0", ["'1 2' is not a number"]),
        ("0.3,\"1,5\",0", ["column 'y'", "decimal mark ','", "--decimal"]),
        ("0.3,\"1,000.5\",0", ["column 'y'", "two kinds of decimal marks"]),
        ("0.2,0.5,0", ["column 'time'", "time 0.2 is in line 4 already", "keep one"]),
        ("0.15,0.5,0", ["column 'time'", "time 0.15 is before 0.2 in line 4", "sort"]),
        (",0.5,0", ["column 'time'", "blank"]),
        ("inf,0.5,0", ["column 'time'", "not finite"]),
        ("noon,0.5,0", ["column 'time'", "'noon' is not a number", "2026-05-04T12:00:00"]),
        ("04/05/2026,0.5,0", ["'04/05/2026' is not a number", "--time-format"]),
        ("32.05.2026,0.5,0", ["'32.05.2026' is not a number", "--time-format"]),
        ("2026-01-01 00:00:00,0.5,0", ["column 'time'", "a date, and in line 4 a number"]),
        ("0.3;0.5;0", ["it has 1 field, and the header 3", "correct"]),
        ("0.3,0.5", ["it has 2 fields, and the header 3", "correct"]),
        ("0,3,0,5,0", ["it has 5 fields", "decimal commas"]),
        ("0.3,\"0.5,0", ["quotation marks", "close"]),
        ("900.0,0.5,0", ["gap", "--max-gap", "--time-scale"]),
    ],
)
def test_a_wrong_line(here, wrong, words):
    message = after(wrong)
    for word in words:
        assert word in message
    assert "\n" not in message


@pytest.mark.parametrize("wrong", ["0.3", "0.3,0.5", "0.3,\"0.5"])
def test_a_last_line_that_is_cut_off(here, wrong):
    message = after(wrong, end="")
    assert "cut off" in message or "quotation" in message


def test_a_last_field_that_is_cut_off(here):
    assert "may be cut off" in after("0.3,0.5,-", end="")


def test_bytes_that_are_no_text(here):
    message = told(GOOD.encode() + b"0.3,\xb0,0\n")
    assert "line 5" in message
    assert "byte 5" in message
    assert "--encoding" in message
    assert Path("out.csv").read_bytes().count(b"\n") >= 3
    # With the right encoding it is a text, and no number.
    assert "'°' is not a number" in told(
        GOOD.encode() + b"0.3,\xb0,0\n", encoding="cp1252", overwrite=True
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\n\n \n", "is empty"),
        (b"\xef\xbb\xbf", "is empty"),
        (b"time,y,u\n", "no samples"),
        (b"time,y,u", "no samples"),
        (b"0.0,0.5,0\n0.1,0.6,0\n", "header"),
        (b"t1me,y,u\n0,1,2\n", "--time"),
        (b"time,why,u\n0,1,2\n", "'time', 'why', 'u'"),
        (b"time,y\n0,1\n", "input 'u1'"),
        (b"time,y,y,u\n0,1,1,2\n", "2 columns could all be output"),
        (b"time,y (V),y (mV),u\n0,1,1,2\n", "'y (V)', 'y (mV)'; rename all but one"),
        (b"time,y;u\n0,1;2\n", "--separator"),
        (b"time y u\n0 1 2\n", "--separator"),
        (b"time,y,u\n0,1,\n", "no earlier value"),
        (GOOD.encode("utf-16"), "UTF-16"),
    ],
)
def test_records_without_a_single_sample(here, content, words):
    message = told(content)
    assert words in message
    assert message.startswith("record.csv")


def test_steps_that_a_discrete_model_cannot_take(here):
    message = told("time,y1,y2\n0,1,1\n1,1,1\n2.5,1,1\n", DISCRETE)
    for word in ("record.csv, line 4", "1.5", "resample", "--dt", "from_ode"):
        assert word in message
    assert Path("out.csv").read_bytes().count(b"\n") == 3
    assert "line 3" in told("time,y,u\n0,1,1\n0.15,1,1\n", equal_steps=True, overwrite=True)


def test_files_that_cannot_be_read(here):
    for name in ("nowhere.csv", "."):
        with pytest.raises(RecordError, match="cannot be read"):
            estimate_record(CONTINUOUS, name, "out.csv")
    pytest.importorskip("pyarrow")
    Path("record.parquet").write_bytes(b"PAR1 and nothing else")
    with pytest.raises(RecordError, match="Parquet"):
        estimate_record(CONTINUOUS, "record.parquet", "out.csv")
    assert not Path("out.csv").exists()


def test_a_parquet_file_counts_rows(here):
    pytest.importorskip("pyarrow")
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"time": [0.0, 0.1, 0.1], "y": ["1", "2", "x"], "u": 0.0})
    frame.to_parquet("record.parquet")
    with pytest.raises(RecordError, match=r"row 3, column 'time': time 0\.1 is in row 2"):
        estimate_record(CONTINUOUS, "record.parquet", "out.csv")
    frame["time"] = [0.0, 0.1, 0.2]
    frame.to_parquet("record.parquet")
    with pytest.raises(RecordError, match="row 3, column 'y': 'x' is not a number"):
        estimate_record(CONTINUOUS, "record.parquet", "out.csv", overwrite=True)


def test_the_command_ends_with_2_and_a_line(here):
    Path("record.csv").write_text(GOOD + "0.3,high,0\n")
    code, out, error = process.finish(process.start(CONTINUOUS, "record.csv", "out.csv"))
    assert code == 2
    assert out == ""
    assert error.startswith("record.csv, line 5, column 'y'")
    assert "Traceback" not in error
