"""Places that exist already, are full, closed or broken: a message, and nothing is lost."""

import contextlib
import errno
import os
import resource
import time
from pathlib import Path

import pytest

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.records import CheckpointError, RecordError, WriteError
from qpmhe.records.checkpoints import load

from .tools import DISCRETE, STEPS, estimate, get, pipe, put, rows, shell, start, talk

OPTIONS = {"checkpoint_every": 20, "checkpoint_seconds": 0.0}
CHECKPOINT = Path("out.csv.checkpoint")


@pytest.fixture
def text(here):
    put("record.csv", STEPS)
    return STEPS


def resumed_is_whole():
    estimate(DISCRETE, resume=True, **OPTIONS)
    estimate(DISCRETE, out="expected.csv", **OPTIONS)
    assert get("out.csv") == get("expected.csv")


def test_rows_that_no_checkpoint_knows_are_not_lost(text, monkeypatch):
    running = start(DISCRETE, "-", "out.csv", resume=True, step_time=False)
    talk(running, *text[:41])
    while running.poll() is None and rows("out.csv") < 41:
        time.sleep(0.01)
    running.kill()
    running.communicate()
    written = get("out.csv")
    assert (rows("out.csv"), load(CHECKPOINT).samples) == (41, 0)
    # The stream that goes on, or another record, would take the rows away.
    put("later.csv", [text[0], *text[31:]])
    pipe(monkeypatch, [text[0], *text[41:]])
    for record in ("-", "later.csv"):
        with pytest.raises(CheckpointError, match=r"not contain the sample of time 0;.*--overwr"):
            estimate(DISCRETE, record, resume=True)
        assert get("out.csv") == written
    pipe(monkeypatch, [text[0], "stamp,1,2"])
    with pytest.raises(RecordError):
        estimate(DISCRETE, "-", resume=True)
    assert get("out.csv") == written
    pipe(monkeypatch, text)
    assert estimate(DISCRETE, "-", resume=True).samples == 200
    estimate(DISCRETE, out="whole.csv")
    assert get("out.csv") == get("whole.csv")


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", ["c.csv", "c.parquet", "c.parquet.part.csv"])
def test_files_of_others(text, name, resume):
    pytest.importorskip("pyarrow")
    Path(name).write_text("precious\n")
    out = name.removesuffix(".part.csv")
    with pytest.raises(InvalidInputError, match=f"{name} exists already.*--overwrite"):
        estimate(DISCRETE, out=out, resume=resume)
    assert Path(name).read_text() == "precious\n"
    estimate(DISCRETE, out=out, overwrite=True)
    assert b"precious" not in get(out)


def test_finished_results_of_ours(text):
    estimate(DISCRETE, checkpoint_every=7)
    written = get("out.csv")
    with pytest.raises(CheckpointError, match=r"finished.*--resume.*--overwrite"):
        estimate(DISCRETE, horizon=2)
    assert get("out.csv") == written
    estimate(DISCRETE, horizon=2, overwrite=True)
    assert get("out.csv") != written


def test_where_there_is_nothing_to_lose(text):
    Path("out.csv").touch()
    put("empty.csv", text[:1])
    for _ in range(2):
        with pytest.raises(RecordError, match="no samples"):
            estimate(DISCRETE, "empty.csv")
    # A checkpoint of no samples was written, and the process ended before the header was.
    Path("out.csv").unlink()
    assert load(CHECKPOINT).samples == 0
    assert estimate(DISCRETE, resume=True).samples == 200


def test_places_where_nothing_can_be(text):
    Path("file").touch()
    Path("folder.csv").mkdir()
    os.mkfifo("pipe.csv")
    os.link("record.csv", "link.csv")
    Path("soft.csv").symlink_to("record.csv")
    content = get("record.csv")
    for out, error, words in (
        ("/proc/nowhere/out.csv", WriteError, "cannot write /proc/nowhere/out.csv: .*--out"),
        ("file/out.csv", WriteError, "cannot write file/out.csv: .*--out"),
        ("folder.csv", OptionError, "no file"), ("pipe.csv", OptionError, "no file"),
        ("link.csv", OptionError, "record itself"), ("soft.csv", OptionError, "record itself"),
        ("out.xlsx", OptionError, r"\.parquet"),
    ):
        with pytest.raises(error, match=words):
            estimate(DISCRETE, out=out, overwrite=True)
    assert get("record.csv") == content


@contextlib.contextmanager
def room(size):
    """No file may grow beyond a size: to a program that is a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_while_rows_or_a_checkpoint_are_written(text):
    put("small.csv", text[:2])
    for name in ("record", "small"):
        estimate(DISCRETE, f"{name}.csv", f"{name}.out.csv", **OPTIONS)
    whole, small = (
        Path(f"{name}.out.csv{end}").stat().st_size
        for name, end in (("record", ".checkpoint"), ("small", ".checkpoint"))
    )
    # Checkpoints have room, all rows have not.
    limit = Path("record.out.csv").stat().st_size - 300
    assert limit > whole
    with room(limit), pytest.raises(WriteError, match="continue with --resume") as caught:
        estimate(DISCRETE, **OPTIONS)
    done = rows("out.csv") - 1
    assert 100 < done < 200
    assert f"The {done} samples before are in out.csv" in str(caught.value)
    resumed_is_whole()
    # A checkpoint of no samples has room, and so have some rows; the next one has not.
    assert small < whole - 999
    with room(whole - 999), pytest.raises(WriteError, match=r"checkpoint.*20 samples.*--resume"):
        estimate(DISCRETE, overwrite=True, **OPTIONS)
    assert not Path("out.csv.checkpoint.tmp").exists()
    assert load(CHECKPOINT).samples == 0


@pytest.mark.parametrize("size", [0, 100])
def test_full_from_the_beginning(text, size):
    with room(size), pytest.raises(WriteError, match=r"cannot write.*Make room.*--out"):
        estimate(DISCRETE, **OPTIONS)
    assert get("out.csv") == b""
    resumed_is_whole()


def test_full_when_the_parquet_file_is_made(text, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    write = parquet.ParquetWriter.write_batch

    def full(self, batch, *options):
        write(self, batch, *options)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    words = r"No space.*All rows are in .*part\.csv.*--resume"
    with monkeypatch.context() as patch:
        patch.setattr(parquet.ParquetWriter, "write_batch", full)
        with pytest.raises(WriteError, match=words):
            estimate(DISCRETE, out="out.parquet", **OPTIONS)
    assert not Path("out.parquet").exists()
    assert not Path("out.parquet.tmp").exists()
    assert rows("out.parquet.part.csv") == 201
    estimate(DISCRETE, out="out.parquet", resume=True, **OPTIONS)
    assert parquet.read_table("out.parquet").num_rows == 200


def test_a_disk_that_does_not_synchronise(text, monkeypatch):
    import qpmhe.records.output as output

    class Os:
        def __getattr__(self, name):
            return getattr(os, name)

        def fsync(self, file):
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(output, "os", Os())
    with pytest.raises(WriteError, match=f"cannot write out.csv: {os.strerror(errno.EIO)}"):
        estimate(DISCRETE, **OPTIONS)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("record.csv > /dev/full", "cannot write standard output: No space left"),
        ("record.csv >&-", "standard output is closed; name a file with --out"),
        ("- <&-", "standard input: it is closed; pipe a record into it"),
        ("- --out record.csv --overwrite < record.csv", "record itself"),
    ],
)
def test_the_command_says_so(text, line, words):
    code, _, error = shell(f"qpmhe estimate {DISCRETE} {line}")
    assert words in error
    assert "Traceback" not in error
    assert "Exception ignored" not in error
    assert code == 2
    assert get("record.csv").count(b"\n") == 201
