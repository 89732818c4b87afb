"""Places that are full, closed or broken: a message, and what was written stays."""

import contextlib
import errno
import os
import resource
from pathlib import Path

import pytest

from qpmhe.records import WriteError, estimate_record
from qpmhe.records.checkpoints import load

from . import process
from .conftest import DISCRETE
from .test_resume import put, rows

OPTIONS = {"step_time": False, "checkpoint_every": 20, "checkpoint_seconds": 0.0}


@pytest.fixture
def record(here):
    put("record.csv", ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(200))])
    estimate_record(DISCRETE, "record.csv", "whole.csv", **OPTIONS)
    Path("small.csv").write_text("time,y1,y2\n0,1,2\n")
    estimate_record(DISCRETE, "small.csv", "small.out.csv", **OPTIONS)
    return here


@contextlib.contextmanager
def room(size):
    """No file may grow beyond a size: to a program that is a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(here):
    return {item.name for item in here.iterdir()}


def test_full_while_rows_are_written(record):
    # Checkpoints have room, all rows have not.
    limit = Path("whole.csv").stat().st_size - 300
    assert limit > Path("whole.csv.checkpoint").stat().st_size
    with room(limit), pytest.raises(WriteError) as caught:
        estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    done = rows(Path("out.csv")) - 1
    assert 100 < done < 200
    assert f"The {done} samples before are in out.csv" in str(caught.value)
    assert "continue by --resume" in str(caught.value)
    assert Path("whole.csv").read_bytes().startswith(Path("out.csv").read_bytes())
    estimate_record(DISCRETE, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_full_when_a_checkpoint_is_written(record):
    # The one of no samples has room, and so have some rows; the next one has not.
    limit = Path("whole.csv.checkpoint").stat().st_size - 999
    assert Path("small.out.csv.checkpoint").stat().st_size < limit
    with room(limit), pytest.raises(WriteError, match=r"checkpoint.*20 samples.*--resume"):
        estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    assert "out.csv.checkpoint.tmp" not in names(record)
    assert load(record / "out.csv.checkpoint").samples == 0
    estimate_record(DISCRETE, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


@pytest.mark.parametrize("size", [0, 100])
def test_full_from_the_beginning(record, size):
    with room(size), pytest.raises(WriteError, match=r"cannot write.*Make room.*--out"):
        estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    assert Path("out.csv").read_bytes() == b""
    estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_full_when_the_parquet_file_is_made(record, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    write = parquet.ParquetWriter.write_batch

    def full(self, batch, *options):
        write(self, batch, *options)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    words = r"No space.*All rows are in .*part\.csv.*--resume"
    with monkeypatch.context() as patch:
        patch.setattr(parquet.ParquetWriter, "write_batch", full)
        with pytest.raises(WriteError, match=words):
            estimate_record(DISCRETE, "record.csv", "out.parquet", **OPTIONS)
    assert {"out.parquet.tmp", "out.parquet"}.isdisjoint(names(record))
    assert rows(Path("out.parquet.part.csv")) == 201
    estimate_record(DISCRETE, "record.csv", "out.parquet", resume=True, **OPTIONS)
    assert parquet.read_table("out.parquet").num_rows == 200


@pytest.mark.parametrize("number", [errno.EIO, errno.EDQUOT])
def test_a_disk_that_does_not_synchronise(record, monkeypatch, number):
    import qpmhe.records.output as output

    class Os:
        def __getattr__(self, name):
            return getattr(os, name)

        def fsync(self, file):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(output, "os", Os())
    with pytest.raises(WriteError, match=f"cannot write out.csv: {os.strerror(number)}"):
        estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("record.csv > /dev/full", "cannot write standard output: No space left"),
        ("record.csv >&-", "standard output is closed; name a file by --out"),
        ("- <&-", "standard input: it is closed; pipe a record into it"),
    ],
)
def test_the_command_says_so(record, line, words):
    code, _, error = process.shell(f"qpmhe estimate {DISCRETE} {line}")
    assert words in error
    assert "Traceback" not in error
    assert "Exception ignored" not in error
    assert code == 2
