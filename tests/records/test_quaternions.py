"""Changes of a quaternion's sign are found, and nothing else is taken for one."""

import numpy as np
import pytest

from qpmhe.records.quaternions import SignChanges

from .tools import command, estimate, put


def attitudes(generator, count, step):
    """Unit quaternions that turn at random, by angles of about `step`."""
    q = np.cumsum(step * generator.standard_normal((count, 4)), axis=0) + generator.normal(size=4)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(6))
def test_each_change_of_sign_is_counted(seed):
    generator = np.random.default_rng(seed)
    q = attitudes(generator, 300, 0.05)
    signs = generator.choice([-1.0, 1.0], 300, p=[0.1, 0.9])
    missing = generator.random(300) < 0.3
    y = generator.uniform(5.0, 9.0, (300, 7))
    place = seed % 4
    y[:, place:place + 4] = np.where(missing[:, None], np.nan, signs[:, None] * q)
    changes = int((np.diff(signs[~missing]) != 0).sum())
    watch, quiet = SignChanges(7), SignChanges(7)
    for t, row in enumerate(y):
        watch.look(row, str(t))
        quiet.look(np.abs(row), str(t))
    names = list("abcdefg")
    (note,) = watch.notes("record.csv", names)
    there = np.flatnonzero(~missing)
    first = there[1 + int(np.argmax(np.diff(signs[there]) != 0))]
    four = ", ".join(names[place:place + 4])
    assert note.startswith(f"{four} of record.csv change sign together at {changes} of the ")
    assert f"first at time {first}." in note
    assert quiet.notes("record.csv", names) == []


def test_fast_turns_noise_and_other_signals_are_no_changes_of_sign():
    generator = np.random.default_rng(0)
    for y in (
        attitudes(generator, 500, 0.4),                       # far from one sample to the next
        generator.standard_normal((500, 4)) * 3.0,
        np.where(np.arange(500) % 2, 1.0, -1.0)[:, None] * np.ones(4),  # of length 2
        np.ones((500, 3)) / np.sqrt(3.0),
    ):
        watch = SignChanges(y.shape[1])
        for t, row in enumerate(y):
            watch.look(row, str(t))
        assert watch.notes("x", list("abcd")) == []


MODEL = """
import numpy as np
import qpmhe

def make():
    system = qpmhe.System(lambda x: x, lambda x: x, n=4, p=4)
    cost = qpmhe.QuadraticCost(prior=np.eye(4), disturbance=np.eye(4), noise=np.eye(4))
    return system, qpmhe.Luenberger(0.3 * np.eye(4)), cost, {
        "horizon": 4, "initial_state": [1, 0, 0, 0], "outputs": list("wxyz")}
"""


def test_the_commands_note_them(here):
    put("model.py", [MODEL])
    signs = np.where(np.arange(12) // 3 % 2, -1.0, 1.0)
    rows = signs[:, None] * attitudes(np.random.default_rng(1), 12, 0.02)
    text = ["time,w,x,y,z", *(f"{t},{','.join(map(str, row))}" for t, row in enumerate(rows))]
    put("record.csv", text)
    part = "w, x, y, z of {} change sign together at 3 of the samples, first at time 3."
    (note,) = estimate("model.py:make").notes
    assert note.startswith(part.format("record.csv"))
    answer = command("model.py:make", "-", text="\n".join([*text, ""]))
    assert part.format("standard input") in " ".join(answer.stderr.split())
