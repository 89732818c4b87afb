import subprocess
import sys

from qpmhe.studies import Study

from .killing import kill_and_finish, start

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


def test_a_study_killed_at_random_loses_and_repeats_nothing(tmp_path):
    options = {"backends": ["banded"], "qps": [0, 1], "seeds": 60, "steps": 20}
    cells = Study(**options).cells()
    killed = kill_and_finish(options, len(cells), 2, tmp_path / "store.sqlite", seed=1)
    assert len(cells) == 120
    assert sorted(killed.frame["key"]) == sorted(cell.key for cell in cells)
    assert set(killed.frame["outcome"]) == {"done"}
    assert killed.kept
    assert 0 < max(killed.rows) < 120  # at least one kill met the study in the middle
    # Nothing else is left behind by the run that came to its end.
    assert [item.name for item in tmp_path.iterdir()] == ["store.sqlite"]


def test_two_processes_read_while_one_writes(tmp_path):
    path = tmp_path / "store.sqlite"
    options = {"backends": ["banded"], "qps": [0, 1], "seeds": 20, "steps": 20}
    release = tmp_path / "release"
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
    assert writer.wait(timeout=60) == 0
    for reader in readers:
        answer, error = reader.communicate(timeout=60)
        assert reader.returncode == 0, error
        assert int(answer) > 1
