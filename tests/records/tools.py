"""Records, results, and `qpmhe estimate` in a process of its own, to be interrupted and killed."""

import io
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qpmhe.cli.app import app
from qpmhe.records import RecordError, estimate_record

_MODELS = Path(__file__).with_name("oscillator.py")
CONTINUOUS, DISCRETE = f"{_MODELS}:continuous", f"{_MODELS}:discrete"
#: A record of the discrete model.
STEPS = ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(200))]
OPTIONS = {"checkpoint_every": 20, "checkpoint_seconds": 0.0}

_CODE = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
from rich.console import Console
from qpmhe.cli.estimate import run
from qpmhe.errors import QpmheError
from qpmhe.records import Latency

try:
    run(Console(stderr=True, width=1000), *sys.argv[1:4], **eval(sys.argv[4]))
except QpmheError as error:
    print(error, file=sys.stderr)
    sys.exit(2)
"""


def estimate(model, record="record.csv", out="out.csv", **options):
    return estimate_record(model, record, out, **{"step_time": False} | options)


def command(*words, text=None):
    """The answer of `qpmhe estimate`."""
    return CliRunner().invoke(app, ["estimate", *words], input=text)


def put(name, text, end="\n"):
    Path(name).write_text("\n".join(text) + end)


def get(name):
    return Path(name).read_bytes()


def rows(path="out.csv"):
    return Path(path).read_bytes().count(b"\n") if Path(path).exists() else 0


def pipe(monkeypatch, text):
    stream = io.TextIOWrapper(io.BytesIO("\n".join([*text, ""]).encode()))
    monkeypatch.setattr("sys.stdin", stream)


def cut_off(text, cut, model=CONTINUOUS, **options):
    """Estimate a record that breaks off, and mend it."""
    put("record.csv", [*text[:cut], "0.0,what"])
    with pytest.raises(RecordError, match="resume"):
        estimate(model, overwrite=True, **options)
    put("record.csv", text)


def start(model, out, **options):
    """A process that reads a pipe."""
    return subprocess.Popen(
        [sys.executable, "-c", _CODE, model, "-", out, repr({"step_time": False} | options)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )


_KILLED = """
import os, signal, sys
from qpmhe.records import estimate_record

place, number, model, record, out, options = sys.argv[1:]
left, replace = int(number), os.replace

def step(*paths):
    global left
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    if place == "replace":
        replace(*paths)

if place == "replace":
    os.replace = step
estimate_record(model, record, out, resume=True, step_time=False, **eval(options),
                progress=step if place == "row" else None)
"""


def killed(model, record, out, place, number, **options):
    """The exit code of a process that kills itself at a row, or as a file takes its place."""
    words = [place, str(number), model, record, out, repr(options)]
    return subprocess.run(
        [sys.executable, "-c", _KILLED, *words], capture_output=True, check=False, timeout=120
    ).returncode


def talk(running, *text, until=0, out="out.csv"):
    """Without closing its input, wait for a number of lines in its results."""
    running.stdin.write("\n".join([*text, ""]).encode())
    running.stdin.flush()
    while running.poll() is None and rows(out) < until:
        time.sleep(0.01)


def finish(running, text=""):
    """What it answers: exit code, standard output and standard error."""
    out, error = running.communicate(text.encode(), timeout=60)
    return running.returncode, (out or b"").decode(), error.decode()


def shell(line):
    """Exit code, standard output and standard error of a line with `qpmhe` in it."""
    call = f'{sys.executable} -c "from qpmhe.cli import main; main()"'
    done = subprocess.run(
        ["sh", "-c", line.replace("qpmhe ", f"{call} ", 1)], capture_output=True, text=True,
        stdin=subprocess.DEVNULL, timeout=120, check=False,
    )
    return done.returncode, done.stdout, done.stderr
