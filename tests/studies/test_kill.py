"""A study that is killed again and again, and read meanwhile.

``python -c "from tests.studies.test_kill import report; report(1000, 5)"`` does it at length.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from qpmhe.studies import Store, StoreError, Study

# From so many rows on it waits for a file: however fast the machine, it is met in the middle.
_WRITE = """
import os, sys, time
from qpmhe.studies import Study, run
from qpmhe.studies.store import Writer

options, path, rows, release = sys.argv[1:]
put = Writer.put


def held(writer, result):
    while len(writer.present(False)) >= int(rows) and not os.path.exists(release):
        time.sleep(0.01)
    put(writer, result)


Writer.put = held
run(Study(**eval(options)), path, jobs=2, progress=False)
"""
_READ = """
import sys, time
from qpmhe.studies import Store, StoreError

rows, reads = 0, 0
while rows < int(sys.argv[2]):
    try:
        found = len(Store(sys.argv[1]).frame())
    except StoreError as error:
        assert "no store" in str(error) or "is empty" in str(error), error
        continue
    assert found >= rows
    rows, reads = found, reads + 1
    if reads == 1:
        print("reading", flush=True)
    time.sleep(0.01)
print(reads)
"""


def start(options, path, rows, release):
    """A study in a process of its own, which goes beyond so many rows once a file is there."""
    return subprocess.Popen(
        [sys.executable, "-c", _WRITE, repr(options), str(path), str(rows), str(release)],
        stderr=subprocess.DEVNULL,
    )


def seen(path):
    """What identifies each row's result, and all rows."""
    try:
        frame = Store(path).frame()
    except StoreError:  # it was killed before there was a store
        return {}, None
    return {row.key: (row.finished, row.times.tobytes()) for row in frame.itertuples()}, frame


def kill_and_finish(options, cells, kills, path, seed):
    """Start a study, kill it at random moments, and let it finish: rows, rows after each kill."""
    generator, known, rows = np.random.default_rng(seed), {}, []
    release = path.with_name("release")
    for target in np.sort(generator.integers(0, int(0.9 * cells), kills)):
        process = start(options, path, cells - 1, release)
        while process.poll() is None and len(seen(path)[0]) < target:
            time.sleep(0.02)
        time.sleep(generator.uniform(0.0, 0.5))
        process.kill()
        process.wait()
        now, _ = seen(path)
        assert all(now.get(key) == value for key, value in known.items())
        known = now
        rows.append(len(now))
    release.touch()
    assert start(options, path, cells - 1, release).wait() == 0
    release.unlink()
    now, frame = seen(path)
    assert all(now.get(key) == value for key, value in known.items())
    return frame, rows


def test_a_study_killed_at_random_loses_and_repeats_nothing(tmp_path):
    options = {"backends": ["banded"], "qps": [0, 1], "seeds": 30, "steps": 20}
    cells = Study(**options).cells()
    frame, rows = kill_and_finish(options, len(cells), 2, tmp_path / "store.sqlite", seed=1)
    assert sorted(frame["key"]) == sorted(cell.key for cell in cells)
    assert set(frame["outcome"]) == {"done"}
    assert 0 < max(rows) < len(cells) == 60  # at least one kill met the study in the middle
    # Nothing else is left behind by the run that came to its end.
    assert [item.name for item in tmp_path.iterdir()] == ["store.sqlite"]


def test_two_processes_read_while_one_writes(tmp_path):
    path, release = tmp_path / "store.sqlite", tmp_path / "release"
    options = {"backends": ["banded"], "qps": [0, 1], "seeds": 20, "steps": 20}
    writer = start(options, path, 20, release)
    readers = [
        subprocess.Popen(
            [sys.executable, "-c", _READ, str(path), "40"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]
    for reader in readers:
        assert reader.stdout.readline() == "reading\n", reader.communicate()
    release.touch()  # both have read what was written so far
    assert writer.wait(timeout=300) == 0
    for reader in readers:
        answer, error = reader.communicate(timeout=300)
        assert reader.returncode == 0, error
        assert int(answer) > 1


def report(cells, kills, seed=0):
    """Print what became of this many cells killed so many times."""
    options = {"backends": ["banded"], "qps": [1], "seeds": cells, "steps": 20}
    with tempfile.TemporaryDirectory() as folder:
        frame, rows = kill_and_finish(options, cells, kills, Path(folder) / "store.sqlite", seed)
        print(
            f"rows after each kill {rows}; in the end {len(frame)} rows, "
            f"{frame['key'].nunique()} distinct, outcomes "
            f"{frame['outcome'].value_counts().to_dict()}; files {sorted(os.listdir(folder))}"
        )
