"""The command line, called; and one small study, really run, once a process."""

import atexit
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from typer.testing import CliRunner

from qpmhe.cli.app import app
from qpmhe.studies import Store, Study, run, write_report

BACKENDS = ("daqp", "osqp", "proxqp")


def command(*words):
    """Output of a command, in one line; its error is raised."""
    answer = CliRunner().invoke(app, [str(word) for word in words])
    if answer.exception is not None:
        raise answer.exception
    return " ".join(answer.output.split())


@cache
def stored():
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
def written():
    """Its report."""
    return write_report(stored(), stored().path.parent / "report")


def frame():
    """Its cells, a fresh copy."""
    return stored().frame()


def spoilt(backend, seed, reason):
    """The same with one backend's runs of one seed failed, as the store has failed cells."""
    rows = frame()
    failed = (rows["backend"] == backend) & (rows["seed"] == seed)
    numbers = rows.select_dtypes("float").columns.difference(["noise_level"])
    rows.loc[failed, "outcome"], rows.loc[failed, "reason"] = "failed", reason
    rows.loc[failed, numbers] = float("nan")
    for name in ("times", "reasons", "rmse_states", "rmse_settled_states", "shared"):
        rows[name] = rows[name].astype(object).where(~failed, None)
    return rows
