"""A checkpoint that does not fit is refused, and nothing is touched."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import CheckpointError, RecordError, estimate_record
from qpmhe.records.checkpoints import load, save

from .conftest import CONTINUOUS
from .oscillator import lines
from .test_resume import OPTIONS, put


@pytest.fixture
def cut(here):
    """A record of which 40 samples are known to the checkpoint."""
    text = lines(60)
    put("record.csv", [*text[:51], "x"])
    with pytest.raises(RecordError):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", **OPTIONS)
    put("record.csv", text)
    return text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"horizon": 7}, "horizon 6, now 7"),
        ({"initial_state": [0.4, 0.0]}, "initial_state"),
        ({"max_qps": None}, "max_qps 2, now None"),
        ({"equal_steps": True}, "equal_steps"),
        ({"checkpoint_every": 30}, "checkpoint_every 20, now 30"),
        ({"covariances": "std"}, "covariances 'none', now 'std'"),
        ({"outputs": "y=u"}, "not those"),
    ],
)
def test_other_options_are_refused(cut, options, words):
    before = Path("out.csv").read_bytes()
    with pytest.raises(CheckpointError, match=words):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **(OPTIONS | options))
    assert Path("out.csv").read_bytes() == before
    estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, step_time=False)


def test_another_record_is_refused(cut):
    stamp, _, u = cut[12].split(",")
    changed = [*cut[:12], f"{stamp},0.123,{u}", *cut[13:]]
    for text in (changed, cut[:20]):
        put("record.csv", text)
        with pytest.raises(CheckpointError, match="first 40 samples"):
            estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)


def test_another_model_is_refused(cut, here):
    copy = here / "copy.py"
    source = Path(CONTINUOUS.rpartition(":")[0]).read_text()
    copy.write_text(source + "\n# another file\n")
    with pytest.raises(CheckpointError, match="file"):
        estimate_record(f"{copy}:continuous", "record.csv", "out.csv", resume=True, **OPTIONS)
    # The same file under another name is the same.
    copy.with_name("same.py").write_text(source)
    told = estimate_record("same.py:continuous", "record.csv", "out.csv", resume=True, **OPTIONS)
    assert told.before == 40


def test_another_model_of_the_same_module_is_refused(cut, here, monkeypatch):
    monkeypatch.syspath_prepend(here)
    source = Path(CONTINUOUS.rpartition(":")[0]).read_text()
    path = here / "model_of_a_module.py"
    path.write_text(source)
    name, options = "model_of_a_module:continuous", {**OPTIONS, "overwrite": True}
    put("half.csv", cut[:51])
    estimate_record(name, "half.csv", "out.csv", **options)
    path.write_text(source.replace("0.5 * x[..., 1]", "0.7 * x[..., 1]"))
    before = Path("out.csv").read_bytes()
    with pytest.raises(CheckpointError, match="was made with file"):
        estimate_record(name, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert Path("out.csv").read_bytes() == before
    path.write_text(source)
    assert estimate_record(name, "record.csv", "out.csv", resume=True, **OPTIONS).before == 40


def test_results_that_do_not_belong_to_the_checkpoint(cut):
    whole = Path("out.csv").read_bytes()
    Path("out.csv").write_bytes(whole[:500])
    with pytest.raises(CheckpointError, match="shorter"):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
    Path("out.csv").unlink()
    with pytest.raises(CheckpointError, match="gone"):
        estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
    estimate_record(CONTINUOUS, "record.csv", "out.csv", overwrite=True, **OPTIONS)
    assert Path("out.csv").read_bytes().startswith(whole)


def test_damaged_checkpoints(cut):
    path = Path("out.csv.checkpoint")
    sound = path.read_bytes()
    generator = np.random.default_rng(0)
    damaged = [b"", b"x", sound[: len(sound) // 2], sound[:-1]]
    for _ in range(20):
        wrong = bytearray(sound)
        wrong[generator.integers(len(sound) // 2)] ^= 0xFF
        damaged.append(bytes(wrong))
    before = Path("out.csv").read_bytes()
    for content in damaged:
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="--overwrite"):
            load(path)
    assert Path("out.csv").read_bytes() == before


def test_a_checkpoint_keeps_every_bit(cut):
    path = Path("out.csv.checkpoint")
    found = load(path)
    state = {
        "a": np.array([[np.nan, -0.0, 5e-324]]), "c": [1, None, [True, "x"]], "b": np.float64(0.1),
        "d": {"e": np.bool_(True), "f": np.empty((0, 3))},
    }
    save(path, replace(found, state=state, inputs=[0.1 + 0.2], usual_step=None))
    again = load(path)
    assert again.state["a"].tobytes() == state["a"].tobytes()
    assert again.state["a"].shape == (1, 3)
    assert again.state["c"] == state["c"]
    assert again.state["d"]["e"]
    assert again.state["d"]["f"].shape == (0, 3)
    assert again.state["b"] == 0.1
    assert again.inputs == [0.1 + 0.2]
    assert again.identity == found.identity
    # No pickled objects: nothing in it can run.
    assert b"pickle" not in path.read_bytes()


def test_versions_are_told(cut):
    path = Path("out.csv.checkpoint")
    save(path, replace(load(path), versions={"qpmhe": "0.0"}))
    told = estimate_record(CONTINUOUS, "record.csv", "out.csv", resume=True, **OPTIONS)
    assert "0.0" in told.notes[0]


def test_a_solver_object_and_options_that_json_knows_otherwise(here):
    Path("mine.py").write_text(
        "import numpy as np, qpmhe\n"
        "def make():\n"
        "    system, observer, cost, scenario = qpmhe.models.batch_reactor()\n"
        "    return qpmhe.MovingHorizonEstimator(system, observer, cost, horizon=np.int64(4),\n"
        "        initial_state=(3, 0), backend=qpmhe.solvers.create('banded'))\n"
    )
    text = ["time,y", *(f"{k / 10},{5 - k / 50}" for k in range(60))]
    put("record.csv", text)
    estimate_record("mine.py:make", "record.csv", "whole.csv", time_scale=np.int64(1), **OPTIONS)
    put("record.csv", text[:51])
    estimate_record("mine.py:make", "record.csv", "out.csv", **OPTIONS)
    put("record.csv", text)
    told = estimate_record("mine.py:make", "record.csv", "out.csv", resume=True, **OPTIONS)
    assert told.before == 40
    assert Path("out.csv").read_bytes() == Path("whole.csv").read_bytes()
