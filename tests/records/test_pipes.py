"""In a pipe: a line in, a row out, and nothing but rows, whatever models and solvers print."""

import subprocess
import sys
from pathlib import Path

import pytest

import qpmhe

from .oscillator import lines
from .tools import CONTINUOUS, DISCRETE, STEPS, estimate, finish, get, put, shell, start, talk


@pytest.mark.parametrize(("model", "equal"), [(DISCRETE, True), (CONTINUOUS, True),
                                              (CONTINUOUS, False)])
def test_a_row_comes_before_the_next_line_goes_in(here, model, equal):
    """Or, where steps have the length that is measured, with the next one's time."""
    text = STEPS[:13] if model == DISCRETE else lines(12, irregular=False)
    options = {"equal_steps": True} if model == CONTINUOUS and equal else {}
    running = start(model, "-", "-", step_time=False, **options)
    talk(running, text[0])
    rows = [running.stdout.readline()]
    for k, line in enumerate(text[1:]):
        talk(running, line)
        if k or equal:
            rows.append(running.stdout.readline())  # or it waits for ever
    code, out, error = finish(running)
    assert (code, out.count("\n")) == (0, 0 if equal else 1)
    assert "12 samples" in error
    put("record.csv", text)
    estimate(model, **options)
    assert b"".join(rows) + out.encode() == get("out.csv")


def test_errors_of_a_stream_leave_whole_rows(here):
    text = lines(12, irregular=False)
    code, out, error = finish(
        start(CONTINUOUS, "-", "-", step_time=False), "\n".join([*text[:9], "oops,1,2", ""])
    )
    assert code == 2
    assert out.count("\n") == 8  # the header, and all but the one that waited
    assert error.startswith("standard input, line 10, column 'time'")
    assert "--resume" not in error
    assert "Traceback" not in error


def test_a_stream_cannot_be_resumed(here):
    code, out, error = finish(start(CONTINUOUS, "-", "-", resume=True))
    assert (code, out) == (2, "")
    assert "--out" in error


# Past sys.stdout, through a buffer of C's, and through Python's first standard output.
LOUD = '''
import ctypes, os, sys
import numpy as np, qpmhe
from qpmhe.solvers import Backend, Solver, create, register

C = ctypes.CDLL(None)

def shout(when):
    print("python", when)
    sys.__stdout__.write(f"first {when}\\n")
    os.write(1, f"descriptor {when}\\n".encode())
    C.puts(f"library {when}".encode())

class Loud(Solver):
    def __init__(self, options):
        super().__init__(options)
        shout("made")
        self._inner = create("auto", options)

    def _solve(self, qp, start):
        shout("solving")
        return self._inner._solve(qp, start)

register(Backend("loud", Loud, "-"))
print("of the model")
'''
WHO = {"python", "first", "descriptor", "library"}


@pytest.fixture
def loud(here):
    Path("loud.py").write_text(LOUD + Path(DISCRETE.rpartition(":")[0]).read_text())
    put("record.csv", STEPS[:5])
    estimate(DISCRETE)
    return Path("out.csv").read_text()


@pytest.mark.parametrize("closed", ["", "2>&-"])
def test_prints_do_not_get_among_the_rows(loud, closed):
    """Nor into a file, where standard error is closed."""
    before = get("record.csv")
    code, out, error = shell(
        f"qpmhe estimate loud.py:discrete record.csv --no-step-time --backend loud {closed}"
    )
    assert (code, out) == (0, loud)
    for words in ("of the model", *(f"{who} {when}" for who in WHO for when in ("made", "solvi"))):
        assert (words in error) == (not closed)
    assert get("record.csv") == before


@pytest.mark.parametrize("backend", ["auto", "loud"])
def test_whoever_reads_may_stop(loud, backend):
    running = start("loud.py:discrete", "-", "-", backend=backend, quiet=True)
    talk(running, STEPS[0])
    assert running.stdout.readline().startswith(b"time,")
    running.stdout.close()
    running.stdout = None
    code, _, error = finish(running, "\n".join(STEPS[1:5]))
    assert code == 1
    words = {line.partition(" ")[0] for line in error.splitlines()}
    assert words == {"of", *(WHO if backend == "loud" else ())}


AFTERWARDS = """
import os, sys
from qpmhe.records import estimate_record
print("before")
estimate_record("loud.py:discrete", "record.csv", "-", step_time=False, backend="loud")
print("after")
sys.stdout.flush()
os.write(1, b"at the end\\n")
"""


def test_standard_output_is_given_back(loud, capsys):
    done = subprocess.run(
        [sys.executable, "-c", AFTERWARDS], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == f"before\n{loud}after\nat the end\n"
    # Also where it is no descriptor.
    estimate("loud.py:discrete", out="-")
    qpmhe.solvers.unregister("loud")
    assert capsys.readouterr().out == loud
    print("after")
    assert capsys.readouterr().out == "after\n"
