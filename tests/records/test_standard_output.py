"""Standard output holds rows alone, whatever models and solvers print there."""

import subprocess
import sys
from pathlib import Path

import pytest

import qpmhe
from qpmhe.records import estimate_record

from . import process
from .conftest import DISCRETE

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
'''
RECORD = "time,y1,y2\n0,1,2\n1,2,1\n2,1,1\n3,2,2\n"


@pytest.fixture
def loud(here):
    Path("loud.py").write_text(LOUD + Path(DISCRETE.rpartition(":")[0]).read_text())
    Path("record.csv").write_text(RECORD)
    estimate_record(DISCRETE, "record.csv", "out.csv", step_time=False)
    return Path("out.csv").read_text()


WORDS = [
    f"{who} {when}" for who in ("python", "first", "descriptor", "library")
    for when in ("made", "solving")
]


def test_a_solver_that_prints_does_not_print_among_the_rows(loud):
    running = process.start("loud.py:discrete", "-", "-", step_time=False, backend="loud")
    code, out, error = process.finish(running, RECORD)
    assert (code, out) == (0, loud)
    for words in WORDS:
        assert words in error


@pytest.mark.parametrize("closed", ["", "2>&-"])
def test_prints_reach_no_file_where_standard_error_is_closed(loud, closed):
    code, out, error = process.shell(
        f"qpmhe estimate loud.py:discrete record.csv --no-step-time --backend loud {closed}"
    )
    assert (code, out) == (0, loud)
    assert ("descriptor solving" in error) == (not closed)
    assert Path("record.csv").read_text() == RECORD


def test_whoever_reads_may_stop_a_loud_solver(loud):
    running = process.start("loud.py:discrete", "-", "-", backend="loud", quiet=True)
    running.stdin.write(RECORD[:11].encode())
    running.stdin.flush()
    assert running.stdout.readline().startswith(b"time,")
    running.stdout.close()
    running.stdout = None
    code, _, error = process.finish(running, RECORD[11:])
    assert code == 1
    assert {line.partition(" ")[0] for line in error.splitlines()} == {
        "python", "first", "descriptor", "library"
    }


AFTERWARDS = """
import os, sys
from qpmhe.records import estimate_record
print("before")
estimate_record("loud.py:discrete", sys.argv[1], "-", step_time=False, backend="loud")
print("after")
sys.stdout.flush()
os.write(1, b"at the end\\n")
"""


def test_standard_output_is_given_back(loud):
    done = subprocess.run(
        [sys.executable, "-c", AFTERWARDS, "record.csv"], capture_output=True, text=True,
        timeout=60, check=True,
    )
    assert done.stdout == f"before\n{loud}after\nat the end\n"


def test_where_it_is_no_descriptor_it_is_replaced_all_the_same(loud, capsys):
    estimate_record("loud.py:discrete", "record.csv", "-", step_time=False)
    qpmhe.solvers.unregister("loud")
    assert capsys.readouterr().out == loud
    print("after")
    assert capsys.readouterr().out == "after\n"
