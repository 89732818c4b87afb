"""In a pipe: a line in, a row out."""

from pathlib import Path

import pytest

from qpmhe.records import estimate_record

from . import process
from .conftest import CONTINUOUS, DISCRETE
from .oscillator import lines


def talk(running, line):
    running.stdin.write(f"{line}\n".encode())
    running.stdin.flush()


def test_a_row_comes_before_the_next_line_goes_in(here):
    text = ["time,y1,y2", *(f"{t},{t % 7},{t % 3}" for t in range(12))]
    running = process.start(DISCRETE, "-", "-", step_time=False)
    talk(running, text[0])
    rows = [running.stdout.readline()]
    for line in text[1:]:
        talk(running, line)
        rows.append(running.stdout.readline())  # or it waits for ever
    code, out, error = process.finish(running)
    assert (code, out) == (0, "")
    assert "12 samples" in error
    Path("record.csv").write_text("\n".join(text))
    estimate_record(DISCRETE, "record.csv", "out.csv", step_time=False)
    assert b"".join(rows) == Path("out.csv").read_bytes()


@pytest.mark.parametrize("equal", [False, True])
def test_a_step_of_measured_length_waits_for_the_next_time(here, equal):
    text = lines(12, irregular=False)
    running = process.start(
        CONTINUOUS, "-", "-", step_time=False, equal_steps=equal, quiet=True
    )
    talk(running, text[0])
    rows = [running.stdout.readline()]
    for k, line in enumerate(text[1:]):
        talk(running, line)
        if k or equal:
            rows.append(running.stdout.readline())
    code, out, error = process.finish(running)
    assert (code, error) == (0, "")
    assert out.count("\n") == (0 if equal else 1)
    Path("record.csv").write_text("\n".join(text))
    estimate_record(CONTINUOUS, "record.csv", "out.csv", step_time=False, equal_steps=equal)
    assert b"".join(rows).decode() + out == Path("out.csv").read_text()


def test_a_model_that_prints_does_not_print_among_the_rows(here):
    source = Path(DISCRETE.rpartition(":")[0]).read_text()
    Path("loud.py").write_text(source.replace('    system = ', '    print("hello")\n    system = '))
    running = process.start("loud.py:discrete", "-", "-", step_time=False)
    code, out, error = process.finish(running, "time,y1,y2\n0,1,2\n")
    assert code == 0
    assert out.startswith("time,")
    assert out.count("\n") == 2
    assert error.startswith("hello")


def test_errors_of_a_stream_leave_whole_rows(here):
    text = lines(12, irregular=False)
    running = process.start(CONTINUOUS, "-", "-", step_time=False)
    code, out, error = process.finish(running, "\n".join([*text[:9], "oops,1,2"]) + "\n")
    assert code == 2
    assert out.count("\n") == 8  # the header, and all but the one that waited
    assert error.startswith("standard input, line 10, column 'time'")
    assert "--resume" not in error


def test_whoever_reads_may_stop(here):
    text = lines(12, irregular=False)
    running = process.start(CONTINUOUS, "-", "-")
    talk(running, text[0])
    assert running.stdout.readline().startswith(b"time,")
    running.stdout.close()
    running.stdout = None
    code, _, error = process.finish(running, "\n".join(text[1:]))
    assert (code, error) == (1, "")


def test_a_stream_cannot_be_resumed(here):
    code, out, error = process.finish(process.start(CONTINUOUS, "-", "-", resume=True))
    assert (code, out) == (2, "")
    assert "--out" in error
