"""A study that is killed again and again, and what is left of it in the end.

``python -c "from tests.studies.killing import report; report(1000, 5)"`` does it at length.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from qpmhe.studies import Store, StoreError

# From so many rows on it waits for a file: however fast the machine, it is met in the middle.
_CODE = """
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


@dataclass
class Killed:
    """What happened.

    Parameters
    ----------
    frame : DataFrame
        All rows in the end.
    rows : list of int
        Rows that were there after each kill.
    kept : bool
        Whether every row that was ever seen is still there as it was.
    """

    frame: pd.DataFrame
    rows: list[int]
    kept: bool


def start(
    options: dict[str, object], path: Path, rows: int, release: Path
) -> subprocess.Popen[bytes]:
    """A study in a process of its own, which goes beyond so many rows once a file is there."""
    return subprocess.Popen(
        [sys.executable, "-c", _CODE, repr(options), str(path), str(rows), str(release)],
        stderr=subprocess.DEVNULL,
    )


def _seen(path: Path) -> pd.DataFrame:
    try:
        return Store(path).frame()
    except StoreError:  # it was killed before there was a store
        return pd.DataFrame({"key": [], "finished": [], "times": []})


def kill_and_finish(
    options: dict[str, object], cells: int, kills: int, path: Path, seed: int
) -> Killed:
    """Start a study, kill it at random moments, and let it finish."""
    generator = np.random.default_rng(seed)
    targets = np.sort(generator.integers(0, int(0.9 * cells), kills))
    rows: list[int] = []
    known: dict[str, tuple[str, bytes]] = {}
    kept = True
    release = path.with_name("release")
    for target in targets:
        process = start(options, path, cells - 1, release)
        while process.poll() is None and len(_seen(path)) < target:
            time.sleep(0.02)
        time.sleep(generator.uniform(0.0, 0.5))
        process.kill()
        process.wait()
        frame = _seen(path)
        now = {row.key: (row.finished, row.times.tobytes()) for row in frame.itertuples()}
        kept &= all(now.get(key) == value for key, value in known.items())
        known = now
        rows.append(len(frame))
    release.touch()
    code = start(options, path, cells - 1, release).wait()
    release.unlink()
    assert code == 0
    frame = _seen(path)
    now = {row.key: (row.finished, row.times.tobytes()) for row in frame.itertuples()}
    kept &= all(now.get(key) == value for key, value in known.items())
    return Killed(frame, rows, kept)


def report(cells: int, kills: int, seed: int = 0) -> None:
    """Print what became of this many cells killed so many times."""
    options: dict[str, object] = {
        "backends": ["banded"], "qps": [1], "seeds": cells, "steps": 20,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store.sqlite"
        killed = kill_and_finish(options, cells, kills, path, seed)
        files = sorted(os.listdir(folder))
    print(
        f"rows after each kill {killed.rows}; in the end {len(killed.frame)} rows, "
        f"{killed.frame['key'].nunique()} distinct, outcomes "
        f"{killed.frame['outcome'].value_counts().to_dict()}; earlier rows unchanged: "
        f"{killed.kept}; files {files}"
    )
