"""A study that is killed, and read meanwhile."""

import subprocess
import sys
import time

import numpy as np

from qpmhe.studies import Store, StoreError, Study, run

# It waits before its last row: however fast the machine, it is met in the middle.
_WRITE = """
import sys, time
from qpmhe.studies import Study, run
from qpmhe.studies.store import Writer

options, path, rows = sys.argv[1:]
put = Writer.put


def held(writer, result):
    while len(writer.present(False)) >= int(rows):
        time.sleep(0.01)
    put(writer, result)


Writer.put = held
run(Study(**eval(options)), path, jobs=2, progress=False)
"""
OPTIONS = {"backends": ["banded"], "qps": [0, 1], "seeds": 15, "steps": 20}


def seen(path, known):
    """What identifies each row's result, read while another process writes."""
    try:
        frame = Store(path).frame()
    except StoreError as error:
        if "no store" in str(error) or "is empty" in str(error):
            return known
        raise
    now = {row.key: (row.finished, row.times.tobytes()) for row in frame.itertuples()}
    assert all(now.get(key) == value for key, value in known.items())
    return now


def test_a_study_killed_at_random_and_read_meanwhile_loses_and_repeats_nothing(tmp_path):
    path, study, known = tmp_path / "store.sqlite", Study(**OPTIONS), {}
    cells = study.cells()
    target = np.random.default_rng(1).integers(1, len(cells) - 1)
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITE, repr(OPTIONS), str(path), str(len(cells) - 1)],
        stderr=subprocess.DEVNULL,
    )
    try:
        while process.poll() is None and len(known) < target:
            known = seen(path, known)
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    known = seen(path, known)
    assert 0 < len(known) < len(cells)
    frame = run(study, path, jobs=1, progress=False).frame()
    assert sorted(seen(path, known)) == sorted(cell.key for cell in cells)
    assert set(frame["outcome"]) == {"done"}
    # Nothing else is left behind by the run that came to its end.
    assert [item.name for item in tmp_path.iterdir()] == ["store.sqlite"]
