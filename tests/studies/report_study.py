"""One small study for the tests of summary and report, really run, once a process."""

from __future__ import annotations

import atexit
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

import pandas as pd

from qpmhe.studies import Store, Study, run, write_report

BACKENDS = ("daqp", "osqp", "proxqp")


@cache
def stored() -> Store:
    """Three backends, two caps, three seeds of 40 steps; and a second, shorter horizon."""
    folder = Path(mkdtemp(prefix="qpmhe-report-"))
    atexit.register(rmtree, folder, ignore_errors=True)
    store = Store(folder / "study.sqlite")
    for backends, caps, horizon in ((BACKENDS, (2, None), 10), (("daqp", "proxqp"), (None,), 4)):
        study = Study(
            backends=backends, qps=(0, 2), solver_iterations=caps, horizons=(horizon,), seeds=3,
            steps=40,
        )
        run(study, store, jobs=1, progress=False)
    return store


@cache
def written() -> Path:
    """Its report."""
    return write_report(stored(), stored().path.parent / "report")


def frame() -> pd.DataFrame:
    """Its cells, a fresh copy."""
    return stored().frame()


def spoilt(backend: str, seed: int, reason: str) -> pd.DataFrame:
    """The same with one backend's runs of one seed failed, as the store has failed cells."""
    rows = frame()
    failed = (rows["backend"] == backend) & (rows["seed"] == seed)
    numbers = rows.select_dtypes("float").columns.difference(["noise_level"])
    rows.loc[failed, "outcome"], rows.loc[failed, "reason"] = "failed", reason
    rows.loc[failed, numbers] = float("nan")
    for name in ("times", "reasons", "rmse_states", "rmse_settled_states", "shared"):
        rows[name] = rows[name].astype(object).where(~failed, None)
    return rows
