"""A record that is cut off and gone on with gives the very bytes of one that was not."""

import contextlib
import io
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import CheckpointError, RecordError, estimate_record
from qpmhe.records.checkpoints import load

from . import process
from .conftest import CONTINUOUS, DISCRETE, FUSED
from .oscillator import lines

OPTIONS = {"step_time": False, "checkpoint_every": 20, "checkpoint_seconds": 0.0}


def put(name, text, end="\n"):
    Path(name).write_text("\n".join(text) + end)


def rows(path):
    return path.read_bytes().count(b"\n") if path.exists() else 0


def test_killed_at_random_moments(here):
    text, out = lines(500), here / "out.csv"
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **OPTIONS)
    generator = np.random.default_rng(5)
    resumed_from = []
    for target in (120, 300):
        running = process.start(CONTINUOUS, "-", out, resume=True, **OPTIONS)
        running.stdin.write("\n".join([*text[:451], ""]).encode())
        running.stdin.flush()  # and not closed: it cannot come to its end before it is killed
        while running.poll() is None and rows(out) < target:
            time.sleep(0.01)
        time.sleep(generator.uniform(0.0, 0.05))
        running.kill()
        running.communicate()
        # All that stands there is whole rows, and those of the uninterrupted run.
        assert out.read_bytes().endswith(b"\n")
        assert Path("whole.csv").read_bytes().startswith(out.read_bytes())
        resumed_from.append(load(here / "out.csv.checkpoint").samples)
    told = estimate_record(CONTINUOUS, "record.csv", out, resume=True, **OPTIONS)
    assert out.read_bytes() == Path("whole.csv").read_bytes()
    assert told.before == resumed_from[-1]
    assert told.before + told.samples == 500
    assert 0 < resumed_from[0] <= resumed_from[1] < 500


def test_interrupted_by_the_user(here):
    text, out = lines(90), here / "out.csv"
    put("record.csv", text)
    # Nothing is written to the disk by the clock: the last checkpoint is kept at the end.
    options = {**OPTIONS, "checkpoint_seconds": 1e9}
    running = process.start(CONTINUOUS, "-", out, **options)
    running.stdin.write("\n".join([*text[:56], ""]).encode())
    running.stdin.flush()  # and not closed: it waits for more
    while running.poll() is None and rows(out) < 55:
        time.sleep(0.01)
    assert load(here / "out.csv.checkpoint").samples == 0
    running.send_signal(signal.SIGINT)
    code, _, error = process.finish(running)
    assert code != 0
    assert "--resume" in error
    assert load(here / "out.csv.checkpoint").samples == 40
    with pytest.raises(CheckpointError, match="after 40 samples"):
        estimate_record(CONTINUOUS, "record.csv", out, **options)
    assert rows(out) == 55
    estimate_record(CONTINUOUS, "record.csv", out, resume=True, **options)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **options)
    assert out.read_bytes() == Path("whole.csv").read_bytes()


# The solvers that start warm: what they keep must not make a difference.
@pytest.mark.parametrize("backend", ["auto", "osqp", "piqp"])
def test_with_every_way_of_starting_warm(here, backend):
    if backend not in ("auto", "osqp"):
        pytest.importorskip(backend)
    text = lines(70)
    put("record.csv", text)
    # Few iterations, so that where a solver starts is seen in where it stops.
    options = {**OPTIONS, "backend": backend, "max_solver_iterations": 5}
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **options)
    others = {"rarely": {"checkpoint_seconds": 1e9}, "seven": {"checkpoint_every": 7}}
    for name, other in others.items():
        estimate_record(CONTINUOUS, "record.csv", f"{name}.csv", **(options | other))
    # When it is written makes no difference, when it is taken does: what is tested can be seen.
    assert Path("rarely.csv").read_bytes() == Path("whole.csv").read_bytes()
    assert backend != "osqp" or Path("seven.csv").read_bytes() != Path("whole.csv").read_bytes()
    for cut in (33, 62):
        put("record.csv", [*text[:cut], "0.0,what"])
        with pytest.raises(RecordError, match="resume"):
            estimate_record(CONTINUOUS, "record.csv", "out.csv", overwrite=True, **options)
        assert rows(Path("out.csv")) - 1 >= load(Path("out.csv.checkpoint")).samples >= 20
        put("record.csv", text)
        told = estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **options)
        assert told.before == 20 * ((cut - 2) // 20)
        assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


@pytest.mark.parametrize("irregular", [True, False])
def test_with_a_model_of_fused_calls(here, irregular):
    pytest.importorskip("casadi")
    text = lines(90, irregular=irregular, gaps=0.03 if irregular else 0.0)
    put("record.csv", text)
    estimate_record(FUSED, "record.csv", "whole.csv", **OPTIONS)
    for cut in (25, 48, 61):
        put("record.csv", [*text[:cut], "0.0,what"])
        with pytest.raises(RecordError, match="resume"):
            estimate_record(FUSED, "record.csv", "out.csv", overwrite=True, **OPTIONS)
        put("record.csv", text)
        assert estimate_record(FUSED, "record.csv", "out.csv", resume=True, **OPTIONS).before >= 20
        assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


@pytest.mark.parametrize("end", ["\n", ""])
def test_a_record_that_grows(here, end):
    """What came without the next sample's time, or without an end of line, is done again."""
    text = lines(60)
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **OPTIONS)
    for length in (20, 21, 22, 41, 60):
        put("record.csv", [*text[:length], text[length][:-1] if end == "" else text[length]], end)
        estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
        assert rows(Path("out.csv")) == length + 1
    put("record.csv", text)
    told = estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert told.before == 40
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_a_record_cut_at_any_byte(here):
    """Numbers that were cut off are numbers, too, and must not stay in what is gone on with."""
    text, options = [], {**OPTIONS, "max_qps": 0}
    for line in lines(60):  # the time comes last: what is cut is the length of a step
        stamp, y, u = line.split(",")
        text.append(f"{y},{u},{stamp}")
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **options)
    content = Path("record.csv").read_bytes()
    ends = [k for k, byte in enumerate(content) if byte == ord("\n")]
    generator = np.random.default_rng(0)
    # Where a line that is a checkpoint's, or the one behind it, lacks some of its end.
    for k in (20, 21, 40, 41):
        for place in (ends[k], ends[k] - 1, ends[k] - 3, int(generator.integers(ends[50]))):
            Path("record.csv").write_bytes(content[:place])
            with contextlib.suppress(RecordError):
                estimate_record(CONTINUOUS, "record.csv", "out.csv", overwrite=True, **options)
            Path("record.csv").write_bytes(content)
            estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **options)
            assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes(), place


def test_a_discrete_record_is_complete_with_its_last_line(here):
    text = ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(45))]
    put("record.csv", text)
    estimate_record(DISCRETE, "record.csv", "whole.csv", **OPTIONS)
    put("record.csv", text[:41])
    estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    put("record.csv", text)
    told = estimate_record(DISCRETE, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert (told.before, told.samples) == (40, 5)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_a_record_that_was_mended_by_leaving_lines_out(here):
    text = lines(60)
    put("record.csv", [*text[:56], "x"])
    with pytest.raises(RecordError):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", **OPTIONS)
    put("record.csv", text[:46])
    estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **OPTIONS)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_the_usual_step_is_remembered(here, monkeypatch):
    text = ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(40) if t not in (20, 21))]
    put("record.csv", text)
    estimate_record(DISCRETE, "record.csv", "whole.csv", **OPTIONS)
    put("record.csv", text[:21])
    estimate_record(DISCRETE, "record.csv", "out.csv", **OPTIONS)
    # A gap is the first thing that there is to see.
    stream = io.TextIOWrapper(io.BytesIO("\n".join([text[0], *text[21:], ""]).encode()))
    monkeypatch.setattr("sys.stdin", stream)
    told = estimate_record(DISCRETE, "-", "out.csv", resume=True, **OPTIONS)
    assert (told.before, told.inserted) == (20, 2)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


@pytest.mark.parametrize("again", [True, False])
def test_standard_input_from_the_beginning_or_behind_the_cut(here, monkeypatch, again):
    text = lines(50)
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "whole.csv", **OPTIONS)
    put("record.csv", [*text[:31], "0,0"])
    with pytest.raises(RecordError):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", **OPTIONS)
    rest = text if again else [text[0], *text[21:]]
    stream = io.TextIOWrapper(io.BytesIO("\n".join([*rest, ""]).encode()))
    monkeypatch.setattr("sys.stdin", stream)
    told = estimate_record(CONTINUOUS, "-", "out.csv", resume=True, **OPTIONS)
    assert (told.before, told.samples) == (20, 30)
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_standard_input_that_leaves_rows_out(here, monkeypatch):
    text = lines(50)
    put("record.csv", [*text[:31], "0,0"])
    with pytest.raises(RecordError):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", **OPTIONS)
    before = Path("out.csv").read_bytes()
    # The rows up to 29 stand there, and the checkpoint knows of 20.
    for rest in (text[31:], []):
        stream = io.TextIOWrapper(io.BytesIO("\n".join([text[0], *rest, ""]).encode()))
        monkeypatch.setattr("sys.stdin", stream)
        with pytest.raises(CheckpointError, match=f"sample of time {text[21].split(',')[0]};"):
            estimate_record(CONTINUOUS, "-", "out.csv", resume=True, **OPTIONS)
        assert Path("out.csv").read_bytes() == before


def test_parquet_is_made_when_the_record_has_ended(here):
    pytest.importorskip("pyarrow")
    pd = pytest.importorskip("pandas")
    text = lines(50)
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "whole.parquet", **OPTIONS)
    put("record.csv", [*text[:31], "0,0"])
    with pytest.raises(RecordError, match=r"out\.parquet\.part\.csv"):
        estimate_record(CONTINUOUS, "record.csv", "out.parquet", **OPTIONS)
    assert not Path("out.parquet").exists()
    assert rows(Path("out.parquet.part.csv")) - 1 == 29
    put("record.csv", text)
    estimate_record(CONTINUOUS, "record.csv", "out.parquet", resume=True, **OPTIONS)
    pd.testing.assert_frame_equal(
        pd.read_parquet("out.parquet"), pd.read_parquet("whole.parquet"), check_exact=True
    )
    assert sorted(item.name for item in here.iterdir()) == [
        "out.parquet", "record.csv", "whole.parquet"
    ]
