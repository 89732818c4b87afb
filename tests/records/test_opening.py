"""What a record may be besides plain lines of text."""

import gzip
from pathlib import Path

import pytest

from qpmhe.errors import OptionError
from qpmhe.records import RecordError, estimate_record

from . import process
from .conftest import CONTINUOUS, DISCRETE
from .oscillator import lines
from .test_resume import put

OPTIONS = {"step_time": False}
SHORT = "time,y1,y2\n0,1,2\n1,2,1\n2,1,2\n"


@pytest.fixture
def record(here):
    put("record.csv", lines(30))
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **OPTIONS)
    return here


def read(content, model=DISCRETE, **options):
    Path("other.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    told = estimate_record(model, "other.csv", "o.csv", overwrite=True, **OPTIONS, **options)
    return told, Path("o.csv").read_text()


def refused(content, **options):
    with pytest.raises(RecordError) as caught:
        read(content, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", ["record.csv.gz", "record.csv"])
def test_gzip(record, name):
    content = Path("record.csv").read_bytes()
    Path(name).write_bytes(gzip.compress(content))
    totals = set()
    estimate_record(
        CONTINUOUS, name, "out.csv", progress=lambda _, total: totals.add(total), **OPTIONS
    )
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()
    assert totals == {None}  # what is read is not what the file's size counts


def test_gzip_in_a_pipe(record):
    Path("record.csv.gz").write_bytes(gzip.compress(Path("record.csv").read_bytes()))
    code, out, error = process.shell(
        f"qpmhe estimate {CONTINUOUS} - --no-step-time < record.csv.gz"
    )
    assert (code, out) == (0, Path("whole.csv").read_text()), error


def test_gzip_that_is_cut_off(record):
    whole = gzip.compress(Path("record.csv").read_bytes())
    for content in (whole[: len(whole) // 2], whole[:10] + b"\xff" * 30 + whole[40:]):
        Path("cut.csv.gz").write_bytes(content)
        with pytest.raises(RecordError, match="cannot be read any further"):
            estimate_record(CONTINUOUS, "cut.csv.gz", "out.csv", overwrite=True, **OPTIONS)
    Path("cut.csv.gz").write_bytes(whole)
    estimate_record(CONTINUOUS, "cut.csv.gz", "out.csv", resume=True, **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"PK\x03\x04", "spreadsheet"),
        (b"BZh91AY", "compressed by bzip2"),
        (b"\xfd7zXZ\0", "xzcat"),
        (b"\x28\xb5\x2f\xfd", "zstd"),
    ],
)
def test_other_kinds_are_named(here, head, words):
    message = refused(head + bytes(100))
    assert words in message
    assert "--encoding" not in message


def test_parquet_by_whatever_name_and_way(record):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    pd.read_csv("record.csv").to_parquet("record.dat")
    estimate_record(CONTINUOUS, "record.dat", "out.csv", **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()
    code, out, error = process.shell(f"qpmhe estimate {CONTINUOUS} - < record.dat")
    assert (code, out) == (2, "")
    assert "it is a Parquet file" in error
    assert "--encoding" not in error


def test_blank_rows(here):
    _, expected = read(SHORT)
    for end in (",,\n,,\n", ",,\n , ,\n,,"):
        told, found = read(SHORT + end)
        assert found == expected
        count = end.count(",,") + end.count(" , ,")
        assert f"{count} rows without any value" in told.notes[0]
    told, found = read("time,y1,y2\n0,1,2\n,,\n1,2,1\n , ,\n2,1,2\n")
    assert found == expected
    assert "2 rows without any value" in told.notes[0]


def test_an_end_that_may_be_cut_off(here):
    told, found = read(SHORT)
    assert told.notes == []
    told, cut = read(SHORT[:-1])
    assert cut == found
    assert "the last line of other.csv, 4, has no end of line" in told.notes[0]
    told, _ = read(SHORT + "3,1,2")
    assert "--resume" in told.notes[0]
    # The number was longer, and is read again.
    Path("other.csv").write_text(SHORT + "3,1,20.25\n")
    estimate_record(DISCRETE, "other.csv", "o.csv", resume=True, **OPTIONS)
    assert Path("o.csv").read_text() == read(SHORT + "3,1,20.25\n")[1]
    code, _, error = process.shell(
        f"printf 'time,y1,y2\\n0,1,2' | qpmhe estimate {DISCRETE} -"
    )
    assert code == 0
    assert "note: the last line of standard input, 2, has no end of line" in error


def test_lines_that_end_in_cr(here):
    message = refused(SHORT.replace("\n", "\r"))
    assert "end lines in LF" in message


def test_lines_above_the_header(here):
    for above in ("# logger v1\n", "Logger,v1\n\nserial,77\n", "a,b,c,d\n"):
        assert "Skip lines above the header by --skip-lines" in refused(above + SHORT)
    assert "delete it if it is a comment" in refused(SHORT + "# stopped\n")
    code, _, error = process.shell(
        f"printf '# logger\\n0,1,2\\n' | qpmhe estimate {DISCRETE} -"
    )
    assert code == 2
    assert "comments" in error


def test_headers_that_are_long_are_not_told_in_full(here):
    names = ",".join(f"channel {k:04d} {'x' * 500}" for k in range(500))
    message = refused(f"{names}\n")
    assert "'channel 0000 xxx" in message
    assert "and 460 more" in message
    assert len(message) < 5000


def test_fields_in_quotation_marks(here):
    _, expected = read(SHORT)
    text = 'time,note,y1,y2\n0,"two, ""so""",1,2\n1,"",2,1\n2,none,1,2\n'
    told, found = read(text)
    assert (found, told.notes) == (expected, [])
    # A mark that is never closed must neither swallow the record nor keep a pipe waiting.
    unbalanced = refused(text + '3,"never closed,1,2\n' * 50)
    assert "line 5: it cannot be split into fields" in unbalanced
    assert "close quotation marks on the line" in unbalanced


def test_the_time_is_no_output(here):
    Path("record.csv").write_text(SHORT)
    for options in ({"outputs": "y1=time"}, {"outputs": "y1=time,y2=y1"}):
        with pytest.raises(OptionError, match="'time' is both the time and"):
            estimate_record(DISCRETE, "record.csv", "out.csv", **options)


@pytest.mark.parametrize("words", [["miss", "-999"], "Miss"])
def test_words_for_missing_values(here, words):
    _, expected = read("time,y1,y2\n0,1,\n1,,1\n2,1,2\n")
    text = "time,y1,y2\n0,1,<NA>\n1,MISS,1\n2,1,2\n"
    assert read(text, missing=words)[1] == expected
    assert "'MISS' is not a number" in refused(text)
    if "-999" in words:
        text = "time,y1,y2\n0,1,-999\n1,-999.00,1\n2,1,2\n"
        assert read(text, missing=words)[1] == expected
        # A time is one all the same.
        assert read("time,y1,y2\n-999,1,2\n", missing=words)[0].samples == 1
    with pytest.raises(OptionError, match="--missing"):
        read(text, missing=[" "])


def test_the_option_for_words(here):
    Path("record.csv").write_text("time,y1,y2\n0,1,none given\n1,-999,1\n2,1,2\n")
    code, out, error = process.shell(
        f"qpmhe estimate {DISCRETE} record.csv --missing -999 --missing 'none given'"
    )
    assert code == 0, error
    assert out.count("MISSING") == 2
