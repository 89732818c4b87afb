"""A checkpoint that does not fit is refused, and nothing is touched."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qpmhe.records import CheckpointError
from qpmhe.records.checkpoints import load, save

from .oscillator import lines
from .test_resume import OPTIONS
from .tools import CONTINUOUS, cut_off, estimate, get, put

SOURCE = Path(CONTINUOUS.rpartition(":")[0])
CHECKPOINT = Path("out.csv.checkpoint")


@pytest.fixture
def cut(here):
    """A record of which 40 samples are known to the checkpoint."""
    text = lines(60)
    cut_off(text, 51, **OPTIONS)
    return text


def refused(words, model=CONTINUOUS, **options):
    before = get("out.csv")
    with pytest.raises(CheckpointError, match=words):
        estimate(model, resume=True, **OPTIONS | options)
    assert get("out.csv") == before


@pytest.mark.parametrize(("options", "words"), [
    ({"horizon": 7}, "horizon 6, now 7"),
    ({"initial_state": [0.4, 0.0]}, "initial_state"),
    ({"max_qps": None}, "max_qps 2, now None"),
    ({"equal_steps": True}, "equal_steps"),
    ({"checkpoint_every": 30}, "checkpoint_every 20, now 30"),
    ({"covariances": "std"}, "covariances 'none', now 'std'"),
    ({"outputs": "y=u"}, "not those"),
])
def test_other_options_are_refused(cut, options, words):
    refused(words, **options)
    estimate(CONTINUOUS, resume=True)


def test_another_record_is_refused(cut):
    stamp, _, u = cut[12].split(",")
    for text in ([*cut[:12], f"{stamp},0.123,{u}", *cut[13:]], cut[:20]):
        put("record.csv", text)
        refused("first 40 samples")


def test_another_model_is_refused(cut, here, monkeypatch):
    source = SOURCE.read_text()
    Path("copy.py").write_text(source + "\n# another file\n")
    refused("file", "copy.py:continuous")
    monkeypatch.syspath_prepend(here)
    path, name = Path("model_of_a_module.py"), "model_of_a_module:continuous"
    path.write_text(source)
    put("half.csv", cut[:51])
    estimate(name, "half.csv", overwrite=True, **OPTIONS)
    path.write_text(source.replace("0.5 * x[..., 1]", "0.7 * x[..., 1]"))
    refused("was made with file", name)
    path.write_text(source)
    assert estimate(name, resume=True, **OPTIONS).before == 40


def test_the_same_model_under_another_name_is_the_same(cut):
    Path("same.py").write_text(SOURCE.read_text())
    assert estimate("same.py:continuous", resume=True, **OPTIONS).before == 40


def test_results_that_do_not_belong_to_the_checkpoint(cut):
    whole, known = get("out.csv"), load(CHECKPOINT).offset
    for place in (30, known - 30):
        edited = bytearray(whole)
        edited[place] ^= 1
        Path("out.csv").write_bytes(edited)
        refused("was changed")
    Path("out.csv").write_bytes(whole[:500])
    refused("shorter")
    Path("out.csv").unlink()
    with pytest.raises(CheckpointError, match="is missing"):
        estimate(CONTINUOUS, resume=True, **OPTIONS)
    # What stands behind the checkpoint is computed again in any case.
    Path("out.csv").write_bytes(whole[: known + 5] + b"#" + whole[known + 6 :])
    estimate(CONTINUOUS, resume=True, **OPTIONS)
    assert get("out.csv").startswith(whole)


def test_damaged_checkpoints(cut):
    sound = get(CHECKPOINT)
    generator = np.random.default_rng(0)
    other = sound.replace(b'"samples": 40', b'"samples": 20')
    assert other != sound
    damaged = [b"", b"x", sound[: len(sound) // 2], sound[:-1], other]
    for _ in range(20):
        wrong = bytearray(sound)
        wrong[generator.integers(len(sound) // 2)] ^= 0xFF
        damaged.append(bytes(wrong))
    for content in damaged:
        CHECKPOINT.write_bytes(content)
        with pytest.raises(CheckpointError, match="--overwrite"):
            load(CHECKPOINT)
    refused("--overwrite")


def test_a_checkpoint_keeps_every_bit(cut):
    found = load(CHECKPOINT)
    state = {
        "a": np.array([[np.nan, -0.0, 5e-324]]), "c": [1, None, [True, "x"]], "b": np.float64(0.1),
        "d": {"e": np.bool_(True), "f": np.empty((0, 3))},
    }
    versions = {"qpmhe": "0.0"}
    save(CHECKPOINT, replace(
        found, state=state, inputs=[0.1 + 0.2], usual_step=None, versions=versions
    ))
    again = load(CHECKPOINT)
    assert again.state["a"].tobytes() == state["a"].tobytes()
    assert (again.state["a"].shape, again.state["d"]["f"].shape) == ((1, 3), (0, 3))
    assert (again.state["c"], again.state["b"], again.inputs) == (state["c"], 0.1, [0.1 + 0.2])
    assert again.state["d"]["e"]
    assert again.identity == found.identity
    # No pickled objects: nothing in it can run.
    assert b"pickle" not in get(CHECKPOINT)
    save(CHECKPOINT, replace(found, versions=versions))
    assert "0.0" in estimate(CONTINUOUS, resume=True, **OPTIONS).notes[0]


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
    estimate("mine.py:make", out="whole.csv", time_scale=np.int64(1), **OPTIONS)
    cut_off(text, 51, "mine.py:make", **OPTIONS)
    assert estimate("mine.py:make", resume=True, **OPTIONS).before == 40
    assert get("out.csv") == get("whole.csv")
