"""A record that is cut off and gone on with gives the very bytes of one that was not."""

import contextlib
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import CheckpointError, RecordError
from qpmhe.records.checkpoints import load, save

from .oscillator import as_json, lines
from .tools import (
    CONTINUOUS,
    DISCRETE,
    OPTIONS,
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

CHECKPOINT = Path("out.csv.checkpoint")


def resume(record="record.csv", model=CONTINUOUS, **options):
    return estimate(model, record, resume=True, **OPTIONS | options)


def whole(text, model=CONTINUOUS, kind="csv", **options):
    """The results without an interruption."""
    put(f"record.{kind}", text)
    estimate(model, f"record.{kind}", f"whole.{kind}", overwrite=True, **OPTIONS | options)
    return get(f"whole.{kind}")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_killed_at_random_moments(here, kind):
    text, out, more = lines(500), f"out.{kind}", {}
    if kind == "jsonl":
        text, more = as_json(text), {"outputs": "y1=y"}
    expected = whole(text, kind=kind, **more)
    generator, known = np.random.default_rng(5), [0]
    for target in (120, 300):
        running = start(CONTINUOUS, out, resume=True, format=kind, **OPTIONS, **more)
        talk(running, *text[:451], until=target, out=out)
        time.sleep(generator.uniform(0.0, 0.05))
        running.kill()
        running.communicate()
        # All that stands there is whole rows, and those of the uninterrupted run.
        assert get(out).endswith(b"\n")
        assert expected.startswith(get(out))
        known.append(load(Path(f"{out}.checkpoint")).samples)
    summary = resume(f"record.{kind}", out=out, **more)
    assert get(out) == expected
    assert (summary.before, summary.samples) == (known[2], 500 - known[2])
    assert 0 < known[1] <= known[2] < 500


def test_interrupted_by_the_user(here):
    text = lines(90)
    expected = whole(text)
    # Nothing is written to the disk by the clock: the last checkpoint is kept at the end.
    options = {**OPTIONS, "checkpoint_seconds": 1e9}
    running = start(CONTINUOUS, "out.csv", **options)
    talk(running, *text[:56], until=55)
    assert load(CHECKPOINT).samples == 0
    running.send_signal(signal.SIGINT)
    code, _, error = finish(running)
    assert (code != 0, "--resume" in error) == (True, True)
    assert (load(CHECKPOINT).samples, rows()) == (40, 55)
    resume(**options)
    assert get("out.csv") == expected


def test_what_solvers_keep_for_the_next_start_makes_no_difference(here):
    text = lines(70)
    # Few iterations, so that where a solver starts is seen in where it stops.
    options = {"backend": "osqp", "max_solver_iterations": 5}
    expected = whole(text, **options)
    # When it is written makes no difference, when it is taken does: what is tested can be seen.
    assert whole(text, **options, checkpoint_seconds=1e9) == expected
    assert whole(text, **options, checkpoint_every=7) != expected
    for cut in (33, 62):
        cut_off(text, cut, **OPTIONS, **options)
        assert resume(**options).before >= 20
        assert get("out.csv") == expected


@pytest.mark.slow
def test_a_record_cut_at_any_byte(here):
    """Numbers that were cut off are numbers, too, and must not stay in what is gone on with."""
    # The time comes last: what is cut is the length of a step.
    turned = [",".join(line.split(",")[k] for k in (1, 2, 0)) for line in lines(60)]
    expected = whole(turned, max_qps=0)
    content = get("record.csv")
    ends = [k for k, byte in enumerate(content) if byte == ord("\n")]
    generator = np.random.default_rng(0)
    # Where a line that is a checkpoint's, or the one behind it, lacks some of its end.
    for k in (20, 21, 40, 41):
        for place in (ends[k], ends[k] - 1, ends[k] - 3, int(generator.integers(ends[50]))):
            Path("record.csv").write_bytes(content[:place])
            with contextlib.suppress(RecordError):
                estimate(CONTINUOUS, overwrite=True, max_qps=0, **OPTIONS)
            Path("record.csv").write_bytes(content)
            resume(max_qps=0)
            assert get("out.csv") == expected, place


def test_the_usual_step_is_remembered(here, monkeypatch):
    text = [STEPS[0], *(row for t, row in enumerate(STEPS[1:41]) if t not in (20, 21))]
    expected = whole(text, DISCRETE)
    put("record.csv", text[:21])
    estimate(DISCRETE, **OPTIONS)
    pipe(monkeypatch, [text[0], *text[21:]])  # a gap is the first thing that there is to see
    summary = resume("-", DISCRETE)
    assert (summary.before, summary.inserted) == (20, 2)
    assert get("out.csv") == expected


@pytest.fixture
def cut(here):
    """A record of which 40 samples are known to the checkpoint."""
    text = lines(60)
    cut_off(text, 51, **OPTIONS)
    return text


def refused(words, model=CONTINUOUS, **options):
    before = get("out.csv")
    with pytest.raises(CheckpointError, match=words):
        resume(model=model, **options)
    assert get("out.csv") == before


def test_other_options_or_models_or_records_are_refused(cut):
    source = Path(CONTINUOUS.rpartition(":")[0]).read_text()
    Path("same.py").write_text(source)
    assert resume(model="same.py:continuous").before == 40
    Path("copy.py").write_text(source.replace("0.5 * x[..., 1]", "0.7 * x[..., 1]"))
    refused("was made with file", "copy.py:continuous")
    for options, words in (
        ({"horizon": 7}, "horizon 6, now 7"), ({"initial_state": [0.4, 0.0]}, "initial_state"),
        ({"max_qps": None}, "max_qps 2, now None"), ({"equal_steps": True}, "equal_steps"),
        ({"checkpoint_every": 30}, "checkpoint_every 20, now 30"), ({"outputs": "y=u"}, "not thos"),
        ({"covariances": "std"}, "covariances 'none', now 'std'"),
    ):
        refused(words, **options)
    stamp, _, u = cut[12].split(",")
    for text in ([*cut[:12], f"{stamp},0.123,{u}", *cut[13:]], cut[:20]):
        put("record.csv", text)
        refused("first 40 samples")


def test_damaged_checkpoints_and_results_that_do_not_belong_to_them(cut):
    content, sound, known = get("out.csv"), get(CHECKPOINT), load(CHECKPOINT).offset
    assert b"pickle" not in sound
    for changed, words in (
        (content[:30] + b"#" + content[31:], "was changed"), (content[:500], "shorter"),
        (content[: known - 30] + b"#" + content[known - 29 :], "was changed"),
    ):
        Path("out.csv").write_bytes(changed)
        refused(words)
    # What stands behind the checkpoint is computed again in any case.
    Path("out.csv").write_bytes(content[: known + 5] + b"#" + content[known + 6 :])
    save(CHECKPOINT, replace(load(CHECKPOINT), versions={"qpmhe": "0.0"}))
    assert "0.0" in resume().notes[0]
    assert get("out.csv").startswith(content)
    Path("out.csv").unlink()
    with pytest.raises(CheckpointError, match="is missing"):
        resume()
    other = sound.replace(b'"samples": 40', b'"samples": 20')
    assert other != sound
    places = np.random.default_rng(0).integers(len(sound) // 2, size=20)
    flipped = [sound[:k] + bytes([sound[k] ^ 0xFF]) + sound[k + 1 :] for k in places]
    for damaged in (b"", b"x", sound[: len(sound) // 2], sound[:-1], other, *flipped):
        CHECKPOINT.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="--overwrite"):
            load(CHECKPOINT)
