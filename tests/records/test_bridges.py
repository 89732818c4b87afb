"""The pipes of the page about bridges, without a bus: lines as its commands print them."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from .tools import command

PAGE = (Path(__file__).parents[2] / "docs/how-to/bridges.md").read_text(encoding="utf-8")
MODEL = re.search(r"'''(.*?)'''", PAGE, flags=re.DOTALL)[1]
PIPES = re.findall(r"^```sh\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)
EPOCH, DT = 1_780_000_000, 0.1
VALUES = np.sin(0.1 * np.arange(12)).round(6)


def parts(pipe):
    """The words of the source, the text of what is between, and the words of the command."""
    stages = re.split(r"\s*\\\n    \| ", pipe.rstrip())
    (at,) = (k for k, stage in enumerate(stages) if stage.startswith("qpmhe "))
    return shlex.split(stages[0]), "".join(stages[1:at]) or "cat", shlex.split(stages[at])[2:]


def printed(source):
    """What the source prints of these values, ten a second."""
    for k, value in enumerate(VALUES):
        sec, nanosec = EPOCH + k // 10, k % 10 * 10**8 + 7000
        if "ros2" in source:
            yield f"{sec},{nanosec},map,{value},0.0,-1.0" if "/point" in source else str(value)
            continue
        payload = str(value) if "plant/position" in source else json.dumps(
            {"unit": "m", "position": value})
        form = source[source.index("-f" if "kcat" in source else "-F") + 1]
        known = {
            "%U": f"{sec}.{nanosec:09d}", "%p": payload, "%T": str(10**3 * sec + nanosec // 10**6),
            "%s": payload, r"\n": "\n",
        }
        line = re.sub(r"%\w|\\n", lambda mark, known=known: known[mark[0]], form)
        assert line.endswith("\n") == ("kcat" in source)  # which adds none of its own
        yield line.rstrip("\n")


def kind(pipe):
    return "-".join(word for word in shlex.split(pipe)[:12] if re.fullmatch(r"[\w/]+", word))


def test_the_page_has_a_pipe_for_each_bus():
    assert [parts(pipe)[0][0].partition("=")[0] for pipe in PIPES] == [
        *["PYTHONUNBUFFERED"] * 2, *["mosquitto_sub"] * 2, "kcat"]


@pytest.mark.parametrize("pipe", PIPES, ids=kind)
def test_a_pipe_estimates_each_message(here, pipe):
    Path("track.py").write_text(MODEL)
    source, between, words = parts(pipe)
    text = "".join(f"{line}\n" for line in printed(source))
    read = subprocess.run(["sh", "-c", between], input=text, capture_output=True, text=True,
                          check=True, timeout=60).stdout
    out = words.index("--out") if "--out" in words else len(words)
    answer = command(*words[:out], text=read)
    assert answer.exit_code == 0, answer.output
    rows = answer.stdout.splitlines()
    if "jsonl" in words:
        found = [json.loads(row) for row in rows]
    else:
        names = rows[0].split(",")
        found = [dict(zip(names, row.split(","), strict=True)) for row in rows[1:]]
    assert len(found) == len(VALUES)
    if "date" in between:  # times of arrival
        assert np.all(np.diff([float(row["time"]) for row in found]) > 0.0)
        return
    scale = 1e-3 if "0.001" in words else 1.0
    times = scale * np.array([float(row["time"]) for row in found])
    np.testing.assert_allclose(times - EPOCH, DT * np.arange(12), atol=1e-4)
    # The measurements arrived: a filter of half the model's noise follows them.
    last = [float(row["filtered_x1"]) for row in found]
    np.testing.assert_allclose(last[2:], VALUES[2:], atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("pipe", PIPES, ids=kind)
def test_a_pipe_passes_each_line_on_at_once(here, pipe):
    Path("track.py").write_text(MODEL)
    source, between, words = parts(pipe)
    call = [sys.executable, "-c", "from qpmhe.cli import main; main()", "estimate"]
    out = words.index("--out") if "--out" in words else len(words)
    run = shlex.join([*call, *words[:out], "--quiet"])
    running = subprocess.Popen(["sh", "-c", f"{between} | {run}"], stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE, text=True)
    with running:
        for k, line in enumerate(printed(source)):
            running.stdin.write(f"{line}\n")
            running.stdin.flush()
            if k == 0 and "jsonl" not in words:
                assert running.stdout.readline().startswith("time,")
            if k:
                assert running.stdout.readline()  # or it waits for ever
        running.stdin.close()
        assert running.stdout.read().count("\n") == 1
        assert running.wait(60) == 0
