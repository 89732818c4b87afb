"""Pipes, and places that exist already, are full or closed: a message, and nothing is lost."""

import contextlib
import os
import resource
from pathlib import Path

import pytest

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.records import CheckpointError, WriteError
from qpmhe.records.checkpoints import load

from .oscillator import lines
from .tools import (
    CONTINUOUS,
    DISCRETE,
    OPTIONS,
    STEPS,
    estimate,
    finish,
    get,
    pipe,
    put,
    rows,
    shell,
    start,
    talk,
)

CHECKPOINT = Path("out.csv.checkpoint")


@pytest.fixture
def text(here):
    put("record.csv", STEPS)
    return STEPS


def test_rows_that_no_checkpoint_knows_are_not_lost(text, monkeypatch):
    running = start(DISCRETE, "out.csv", resume=True)
    talk(running, *text[:41], until=41)
    running.kill()
    running.communicate()
    written = get("out.csv")
    assert (rows("out.csv"), load(CHECKPOINT).samples) == (41, 0)
    # The stream that goes on, or another record, would take the rows away.
    put("later.csv", [text[0], *text[31:]])
    for record, rest in (("-", text[41:]), ("later.csv", [])):
        pipe(monkeypatch, [text[0], *rest])
        with pytest.raises(CheckpointError, match=r"not contain the sample of time 0;.*--overwr"):
            estimate(DISCRETE, record, resume=True)
        assert get("out.csv") == written
    pipe(monkeypatch, text)  # from the beginning
    assert estimate(DISCRETE, "-", resume=True).samples == 200
    estimate(DISCRETE, out="whole.csv")
    assert get("out.csv") == get("whole.csv")


def test_what_is_there_is_replaced_only_if_that_is_asked_for(text):
    pytest.importorskip("pyarrow")
    for name, resume in (("c.csv", True), ("d.parquet.part.csv", False)):
        Path(name).write_text("precious\n")
        out = name.removesuffix(".part.csv")
        with pytest.raises(InvalidInputError, match=f"{name} exists already.*--overwrite"):
            estimate(DISCRETE, out=out, resume=resume)
        assert Path(name).read_text() == "precious\n"
        estimate(DISCRETE, out=out, overwrite=True)
    written = get("c.csv")
    with pytest.raises(CheckpointError, match=r"finished.*--resume.*--overwrite"):
        estimate(DISCRETE, out="c.csv", horizon=2)
    assert get("c.csv") == written


def test_places_where_nothing_can_be(text):
    os.mkfifo("pipe.csv")
    Path("soft.csv").symlink_to("record.csv")
    content = get("record.csv")
    for out, error, words in (
        ("/proc/nowhere/out.csv", WriteError, "cannot write /proc/nowhere/out.csv: .*--out"),
        ("pipe.csv", OptionError, "no file"), ("soft.csv", OptionError, "record itself"),
        ("out.xlsx", OptionError, r"\.parquet"),
    ):
        with pytest.raises(error, match=words):
            estimate(DISCRETE, out=out, overwrite=True)
    assert get("record.csv") == content


@contextlib.contextmanager
def room(size):
    """No file may grow beyond a size: to a program that is a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_while_rows_or_a_checkpoint_are_written(text):
    estimate(DISCRETE, **OPTIONS)
    whole, size = get("out.csv"), Path("out.csv").stat().st_size - 300
    large = CHECKPOINT.stat().st_size
    for limit, words in (
        (0, r"cannot write.*Make room.*--out"),
        # A checkpoint of no samples has room, and so have some rows; the next one has not.
        (large - 999, r"checkpoint.*20 samples.*--resume"),
        # Checkpoints have room, all rows have not.
        (size, r"The 1\d\d samples before are in out.csv.*continue with --resume"),
    ):
        assert not limit or size > limit - 1 > 0
        with room(limit), pytest.raises(WriteError, match=words):
            estimate(DISCRETE, overwrite=True, **OPTIONS)
        assert limit > 0 or get("out.csv") == b""
        assert not Path("out.csv.checkpoint.tmp").exists()
        estimate(DISCRETE, resume=True, **OPTIONS)
        assert get("out.csv") == whole


@pytest.mark.slow
def test_the_command_says_so(text):
    for line, words in (
        ("record.csv > /dev/full", "cannot write standard output: No space left"),
        ("record.csv >&-", "standard output is closed; name a file with --out"),
        ("- <&-", "standard input: it is closed; pipe a record into it"),
        ("- --out record.csv --overwrite < record.csv", "record itself"),
    ):
        code, _, error = shell(f"qpmhe estimate {DISCRETE} {line}")
        assert (code, words in error) == (2, True), error
        assert "Traceback" not in error
        assert "Exception ignored" not in error
        assert rows("record.csv") == 201


@pytest.mark.parametrize(
    ("model", "equal"), [(DISCRETE, True), (CONTINUOUS, True), (CONTINUOUS, False)],
    ids=["discrete", "equal", "measured"],
)
def test_a_row_comes_before_the_next_line_goes_in(here, model, equal):
    """Or, where steps have the length that is measured, with the next one's time."""
    text = STEPS[:13] if model == DISCRETE else lines(12, irregular=False)
    options = {"equal_steps": True} if model == CONTINUOUS and equal else {}
    running = start(model, "-", **options)
    talk(running, text[0])
    found = [running.stdout.readline()]
    for k, line in enumerate(text[1:]):
        talk(running, line)
        if k or equal:
            found.append(running.stdout.readline())  # or it waits for ever
    code, out, error = finish(running)
    assert (code, out.count("\n")) == (0, 0 if equal else 1)
    assert "12 samples" in error
    put("record.csv", text)
    estimate(model, **options)
    assert b"".join(found) + out.encode() == get("out.csv")


# Past sys.stdout, through a buffer of C's, and through Python's first standard output.
LOUD = '''
import ctypes, os, sys
import numpy as np, qpmhe
from qpmhe.solvers import Backend, Solver, create, register

C = ctypes.CDLL(None)

def shout(when):
    print("python", when)
    sys.__stdout__.write(f"first {when}\\n")
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
WHO = ("python", "first", "library")


@pytest.mark.slow
def test_prints_do_not_get_among_the_rows(here):
    """Nor into a file, where standard error is closed."""
    Path("loud.py").write_text(LOUD + Path(DISCRETE.rpartition(":")[0]).read_text())
    put("record.csv", STEPS[:5])
    estimate(DISCRETE)
    before = get("record.csv")
    for closed in ("", "2>&-"):
        code, out, error = shell(
            f"qpmhe estimate loud.py:discrete record.csv --no-step-time --backend loud {closed}"
        )
        assert (code, out) == (0, Path("out.csv").read_text())
        for words in ("of the model", *(f"{who} {w}" for who in WHO for w in ("made", "solvi"))):
            assert (words in error) == (not closed)
        assert get("record.csv") == before
