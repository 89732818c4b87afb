"""A record that is cut off and gone on with gives the very bytes of one that was not."""

import contextlib
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import CheckpointError, RecordError
from qpmhe.records.checkpoints import load

from .oscillator import lines
from .tools import (
    CONTINUOUS,
    DISCRETE,
    FUSED,
    STEPS,
    cut_off,
    estimate,
    finish,
    get,
    pipe,
    put,
    rows,
    start,
    talk,
)

OPTIONS = {"step_time": False, "checkpoint_every": 20, "checkpoint_seconds": 0.0}


def test_killed_at_random_moments(here):
    text = lines(500)
    put("record.csv", text)
    estimate(CONTINUOUS, out="whole.csv", **OPTIONS)
    generator, resumed_from = np.random.default_rng(5), []
    for target in (120, 300):
        running = start(CONTINUOUS, "-", "out.csv", resume=True, **OPTIONS)
        talk(running, *text[:451])
        while running.poll() is None and rows("out.csv") < target:
            time.sleep(0.01)
        time.sleep(generator.uniform(0.0, 0.05))
        running.kill()
        running.communicate()
        # All that stands there is whole rows, and those of the uninterrupted run.
        assert get("out.csv").endswith(b"\n")
        assert get("whole.csv").startswith(get("out.csv"))
        resumed_from.append(load(Path("out.csv.checkpoint")).samples)
    summary = estimate(CONTINUOUS, resume=True, **OPTIONS)
    assert get("out.csv") == get("whole.csv")
    assert summary.before == resumed_from[-1]
    assert summary.before + summary.samples == 500
    assert 0 < resumed_from[0] <= resumed_from[1] < 500


def test_interrupted_by_the_user(here):
    text = lines(90)
    put("record.csv", text)
    # Nothing is written to the disk by the clock: the last checkpoint is kept at the end.
    options = {**OPTIONS, "checkpoint_seconds": 1e9}
    running = start(CONTINUOUS, "-", "out.csv", **options)
    talk(running, *text[:56])
    while running.poll() is None and rows("out.csv") < 55:
        time.sleep(0.01)
    assert load(Path("out.csv.checkpoint")).samples == 0
    running.send_signal(signal.SIGINT)
    code, _, error = finish(running)
    assert code != 0
    assert "--resume" in error
    assert load(Path("out.csv.checkpoint")).samples == 40
    with pytest.raises(CheckpointError, match="after 40 samples"):
        estimate(CONTINUOUS, **options)
    assert rows("out.csv") == 55
    estimate(CONTINUOUS, resume=True, **options)
    estimate(CONTINUOUS, out="whole.csv", **options)
    assert get("out.csv") == get("whole.csv")


# Solvers that start warm, and models of fused calls: what they keep must not make a difference.
@pytest.mark.parametrize("backend", ["auto", "osqp", "piqp"])
@pytest.mark.parametrize("model", [CONTINUOUS, FUSED], ids=["plain", "fused"])
def test_with_every_way_of_starting_warm(here, model, backend):
    for name in {backend, "casadi"} - {"auto"}:
        pytest.importorskip(name)
    text = lines(90, irregular=backend != "piqp", gaps=0.03 if backend != "piqp" else 0.0)
    put("record.csv", text)
    # Few iterations, so that where a solver starts is seen in where it stops.
    options = {**OPTIONS, "backend": backend, "max_solver_iterations": 5}
    estimate(model, out="whole.csv", **options)
    others = {"rarely": {"checkpoint_seconds": 1e9}, "seven": {"checkpoint_every": 7}}
    for name, other in others.items():
        estimate(model, out=f"{name}.csv", **options | other)
    # When it is written makes no difference, when it is taken does: what is tested can be seen.
    assert get("rarely.csv") == get("whole.csv")
    assert backend != "osqp" or get("seven.csv") != get("whole.csv")
    for cut in (33, 62):
        cut_off(text, cut, model, **options)
        assert rows("out.csv") - 1 >= load(Path("out.csv.checkpoint")).samples >= 20
        assert estimate(model, resume=True, **options).before >= 20
        assert get("out.csv") == get("whole.csv")


@pytest.mark.parametrize("end", ["\n", ""])
def test_a_record_that_grows(here, end):
    """What came without the next sample's time, or without an end of line, is done again."""
    text = lines(60)
    put("record.csv", text)
    estimate(CONTINUOUS, out="whole.csv", **OPTIONS)
    for length in (20, 21, 22, 41, 60):
        put("record.csv", [*text[:length], text[length][:-1] if end == "" else text[length]], end)
        estimate(CONTINUOUS, resume=True, **OPTIONS)
        assert rows("out.csv") == length + 1
    put("record.csv", text)
    assert estimate(CONTINUOUS, resume=True, **OPTIONS).before == 40
    assert get("out.csv") == get("whole.csv")


def test_a_record_cut_at_any_byte(here):
    """Numbers that were cut off are numbers, too, and must not stay in what is gone on with."""
    # The time comes last: what is cut is the length of a step.
    turned = [",".join(line.split(",")[k] for k in (1, 2, 0)) for line in lines(60)]
    put("record.csv", turned)
    options = {**OPTIONS, "max_qps": 0}
    estimate(CONTINUOUS, out="whole.csv", **options)
    content = get("record.csv")
    ends = [k for k, byte in enumerate(content) if byte == ord("\n")]
    generator = np.random.default_rng(0)
    # Where a line that is a checkpoint's, or the one behind it, lacks some of its end.
    for k in (20, 21, 40, 41):
        for place in (ends[k], ends[k] - 1, ends[k] - 3, int(generator.integers(ends[50]))):
            Path("record.csv").write_bytes(content[:place])
            with contextlib.suppress(RecordError):
                estimate(CONTINUOUS, overwrite=True, **options)
            Path("record.csv").write_bytes(content)
            estimate(CONTINUOUS, resume=True, **options)
            assert get("out.csv") == get("whole.csv"), place


def test_a_discrete_record_is_complete_with_its_last_line_and_its_step_remembered(
    here, monkeypatch
):
    text = [STEPS[0], *(row for t, row in enumerate(STEPS[1:41]) if t not in (20, 21))]
    put("record.csv", text)
    estimate(DISCRETE, out="whole.csv", **OPTIONS)
    put("record.csv", text[:21])
    estimate(DISCRETE, **OPTIONS)
    pipe(monkeypatch, [text[0], *text[21:]])  # a gap is the first thing that there is to see
    summary = estimate(DISCRETE, "-", resume=True, **OPTIONS)
    assert (summary.before, summary.inserted) == (20, 2)
    assert get("out.csv") == get("whole.csv")


def test_a_record_that_was_mended_by_leaving_lines_out(here):
    text = lines(60)
    cut_off(text, 56, **OPTIONS)
    put("record.csv", text[:46])
    estimate(CONTINUOUS, resume=True, **OPTIONS)
    estimate(CONTINUOUS, out="whole.csv", **OPTIONS)
    assert get("out.csv") == get("whole.csv")


def test_standard_input_from_the_beginning_or_behind_the_cut(here, monkeypatch):
    text = lines(50)
    put("record.csv", text)
    estimate(CONTINUOUS, out="whole.csv", **OPTIONS)
    cut_off(text, 31, **OPTIONS)
    before = get("out.csv")
    # The rows up to 29 stand there, and the checkpoint knows of 20.
    for rest in (text[31:], []):
        pipe(monkeypatch, [text[0], *rest])
        with pytest.raises(CheckpointError, match=f"sample of time {text[21].split(',')[0]};"):
            estimate(CONTINUOUS, "-", resume=True, **OPTIONS)
        assert get("out.csv") == before
    for rest in (text, [text[0], *text[21:]]):
        cut_off(text, 31, **OPTIONS)
        pipe(monkeypatch, rest)
        summary = estimate(CONTINUOUS, "-", resume=True, **OPTIONS)
        assert (summary.before, summary.samples) == (20, 30)
        assert get("out.csv") == get("whole.csv")


def test_parquet_is_made_when_the_record_has_ended(here):
    pytest.importorskip("pyarrow")
    pd = pytest.importorskip("pandas")
    text = lines(50)
    cut_off(text, 31, **OPTIONS)
    estimate(CONTINUOUS, out="whole.parquet", **OPTIONS)
    put("record.csv", [*text[:31], "0,0"])
    with pytest.raises(RecordError, match=r"out\.parquet\.part\.csv"):
        estimate(CONTINUOUS, out="out.parquet", **OPTIONS)
    assert not Path("out.parquet").exists()
    assert rows("out.parquet.part.csv") - 1 == 29
    put("record.csv", text)
    estimate(CONTINUOUS, out="out.parquet", resume=True, **OPTIONS)
    found, expected = (pd.read_parquet(f"{name}.parquet") for name in ("out", "whole"))
    pd.testing.assert_frame_equal(found, expected, check_exact=True)
    assert [item.name for item in here.glob("out.parquet*")] == ["out.parquet"]
