"""Existing files are never lost without --overwrite."""

import io
import os
import time
from pathlib import Path

import pytest

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.records import CheckpointError, RecordError, WriteError, estimate_record
from qpmhe.records.checkpoints import load

from . import process
from .conftest import CONTINUOUS, DISCRETE
from .oscillator import lines
from .test_resume import put, rows

OPTIONS = {"step_time": False}


@pytest.fixture
def text(here):
    found = ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(60))]
    put("record.csv", found)
    return found


def piped(monkeypatch, text):
    stream = io.TextIOWrapper(io.BytesIO("\n".join([*text, ""]).encode()))
    monkeypatch.setattr("sys.stdin", stream)


def test_killed_before_the_first_checkpoint_by_number(text, here, monkeypatch):
    out = here / "live.csv"
    running = process.start(DISCRETE, "-", out, resume=True, **OPTIONS)
    running.stdin.write("\n".join([*text[:41], ""]).encode())
    running.stdin.flush()
    while running.poll() is None and rows(out) < 41:
        time.sleep(0.01)
    running.kill()
    running.communicate()
    written = out.read_bytes()
    assert rows(out) == 41
    assert load(here / "live.csv.checkpoint").samples == 0
    # The stream that goes on would take the rows away.
    piped(monkeypatch, [text[0], *text[41:]])
    with pytest.raises(CheckpointError, match="does not contain the sample of time 0;") as caught:
        estimate_record(DISCRETE, "-", out, resume=True, **OPTIONS)
    assert "--overwrite" in str(caught.value)
    assert out.read_bytes() == written
    piped(monkeypatch, [text[0], "stamp,1,2"])
    with pytest.raises(RecordError):
        estimate_record(DISCRETE, "-", out, resume=True, **OPTIONS)
    assert out.read_bytes() == written
    piped(monkeypatch, text)
    told = estimate_record(DISCRETE, "-", out, resume=True, **OPTIONS)
    assert (told.before, told.samples) == (0, 60)
    estimate_record(DISCRETE, "record.csv", "whole.csv", **OPTIONS)
    assert out.read_bytes() == Path("whole.csv").read_bytes()


def test_a_finished_short_stream_is_not_lost_either(text, monkeypatch):
    piped(monkeypatch, text[:31])
    estimate_record(DISCRETE, "-", "live.csv", **OPTIONS)
    written = Path("live.csv").read_bytes()
    piped(monkeypatch, [text[0], *text[31:]])
    with pytest.raises(CheckpointError, match="does not contain the sample of time 0;"):
        estimate_record(DISCRETE, "-", "live.csv", resume=True, **OPTIONS)
    assert Path("live.csv").read_bytes() == written


def test_another_record_does_not_take_the_rows_of_a_short_one(text):
    estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    put("later.csv", [text[0], *text[31:]])
    with pytest.raises(CheckpointError, match="does not contain the sample of time 0;"):
        estimate_record(DISCRETE, "later.csv", "out.csv", resume=True, **OPTIONS)
    assert rows(Path("out.csv")) == 61


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("name", ["c.csv", "c.parquet", "c.parquet.part.csv"])
def test_files_of_others(text, name, resume):
    pytest.importorskip("pyarrow")
    Path(name).write_text("precious\n")
    out = name.removesuffix(".part.csv")
    with pytest.raises(InvalidInputError, match=f"{name} exists already.*--overwrite"):
        estimate_record(DISCRETE, "record.csv", out, resume=resume, **OPTIONS)
    assert Path(name).read_text() == "precious\n"
    estimate_record(DISCRETE, "record.csv", out, overwrite=True, **OPTIONS)
    assert b"precious" not in Path(out).read_bytes()


def test_finished_results_of_ours(text):
    estimate_record(DISCRETE, "record.csv", "out.csv", checkpoint_every=7, **OPTIONS)
    written = Path("out.csv").read_bytes()
    with pytest.raises(CheckpointError, match=r"finished.*--resume.*--overwrite"):
        estimate_record(DISCRETE, "record.csv", "out.csv", horizon=2, **OPTIONS)
    assert Path("out.csv").read_bytes() == written
    estimate_record(DISCRETE, "record.csv", "out.csv", horizon=2, overwrite=True, **OPTIONS)
    assert Path("out.csv").read_bytes() != written


def test_where_there_is_nothing_to_lose(text):
    Path("out.csv").touch()
    put("empty.csv", text[:1])
    for _ in range(2):
        with pytest.raises(RecordError, match="no samples"):
            estimate_record(DISCRETE, "empty.csv", "out.csv", **OPTIONS)
    # A checkpoint of no samples was written, and the process ended before the header was.
    Path("out.csv").unlink()
    assert load(Path("out.csv.checkpoint")).samples == 0
    told = estimate_record(DISCRETE, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert (told.before, told.samples) == (0, 60)


def test_a_record_by_another_name(text):
    content = Path("record.csv").read_bytes()
    os.link("record.csv", "link.csv")
    Path("soft.csv").symlink_to("record.csv")
    for name in ("link.csv", "soft.csv"):
        with pytest.raises(OptionError, match="record itself"):
            estimate_record(DISCRETE, "record.csv", name, overwrite=True, **OPTIONS)
    code, _, error = process.shell(
        f"qpmhe estimate {DISCRETE} - --out link.csv --overwrite < record.csv"
    )
    assert code == 2
    assert "record itself" in error
    assert Path("record.csv").read_bytes() == content


def test_places_where_nothing_can_be(text):
    Path("file").touch()
    for out in ("/proc/nowhere/out.csv", "file/out.csv"):
        with pytest.raises(WriteError, match=f"cannot write {out}: .*--out"):
            estimate_record(DISCRETE, "record.csv", out, **OPTIONS)
    Path("folder.csv").mkdir()
    os.mkfifo("pipe.csv")
    for out in ("folder.csv", "pipe.csv"):
        with pytest.raises(OptionError, match="no file"):
            estimate_record(DISCRETE, "record.csv", out, **OPTIONS)


@pytest.mark.parametrize("place", [30, -30])
def test_results_that_were_edited(here, place):
    options = {**OPTIONS, "checkpoint_every": 20}
    text = lines(60)
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "out.csv", **options)
    before = Path("out.csv").read_bytes()
    known = load(here / "out.csv.checkpoint").offset
    place = place if place > 0 else known + place
    edited = bytearray(before)
    edited[place] ^= 1
    Path("out.csv").write_bytes(edited)
    with pytest.raises(CheckpointError, match="was changed"):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **options)
    assert Path("out.csv").read_bytes() == edited
    # What stands behind the checkpoint is computed again in any case.
    Path("out.csv").write_bytes(before[: known + 5] + b"#" + before[known + 6 :])
    estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **options)
    assert Path("out.csv").read_bytes() == before
