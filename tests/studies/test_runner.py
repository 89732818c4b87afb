"""Studies in worker processes of this machine and on a Dask cluster."""

import io
import json
import logging
import socket
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest
from rich.console import Console
from solvers.hostile_backend import CrashingOnce, entry
from solvers.problems import registered

import qpmhe_solvers
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies import Store, StoreError, Study, StudyError, run, runner
from qpmhe.studies import store as store_module
from qpmhe.studies.store import Writer

from .commands import command

try:
    import distributed
except ImportError:
    distributed = None

ODD = "tests/studies/odd_models.py"
SMALL = {"backends": ["banded"], "qps": [0, 1], "seeds": 2, "steps": 12}
DEATHS = {
    "crashes": "the process that ran it died, twice (SIGSEGV",
    "is_killed": "the process that ran it died, twice",
    "hangs": "out of time: the process that ran it did not answer",
    "raises": "ZeroDivisionError: division by zero",
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "store.sqlite"


def console():
    return Console(file=io.StringIO(), width=120)


def counted(monkeypatch):
    """Cells that are handed to the workers."""
    handed, plain = [], runner._results

    def results(workers, tasks):
        handed.extend(task.cell.key for task in tasks)
        return plain(workers, tasks)

    monkeypatch.setattr(runner, "_results", results)
    return handed


def test_a_study_runs_once_and_more_cells_are_added(path, monkeypatch):
    handed, out = counted(monkeypatch), console()
    study = Study(**SMALL)
    store = run(study, path, progress=out)
    frame = store.frame()
    assert sorted(frame["key"]) == sorted(handed) == sorted(cell.key for cell in study.cells())
    assert set(frame["outcome"]) == {"done"}
    assert "were there already" not in out.file.getvalue()
    for row in frame.itertuples():  # first seeds keep their trajectory
        assert (store.trajectory(row.key) is None) == (row.seed != 0)
    (environment,) = store.meta()["environments"]
    assert (environment["threads"], "git" in environment) == ("1", True)

    handed.clear()
    before = frame[["key", "finished"]].to_dict("records")
    more = run(Study(**{**SMALL, "seeds": 3}), store, progress=out)
    assert [key[-6:] for key in handed] == ["seed=2"] * 2
    assert "4 of 6 cells were there already" in out.file.getvalue()
    assert more.frame()[["key", "finished"]].to_dict("records")[:4] == before
    handed.clear()
    run(Study(**SMALL), path, progress=False)
    assert handed == []


def test_a_backend_that_crashes_is_isolated_and_the_qp_is_kept(path, tmp_path):
    banded = qpmhe_solvers.backend("banded")
    mine = qpmhe_solvers.Backend("mine", lambda options: banded.factory(options), "banded")
    with registered(entry(CrashingOnce)), registered(mine):
        names = ["crashingonce", "banded", "mine"]
        study = Study(**{**SMALL, "backends": names, "qps": [1], "seeds": 1})
        store = run(study, path, progress=False, keep_failing=tmp_path / "failing")
    frame = store.frame().set_index("backend")
    assert set(frame["outcome"]) == {"done"}
    # A backend that was registered here runs there.
    assert frame.loc["mine", "rmse"] == frame.loc["banded", "rmse"]
    assert frame.loc[["mine", "banded"], "reason"].tolist() == ["", ""]
    assert frame.loc["crashingonce", "reason"] == (
        "the backend ran in a separate process, since the cell's process died twice (SIGSEGV(-11))"
    )
    failed = {flags: n for flags, n in frame.loc["crashingonce", "reasons"].items()
              if "SOLVER_FAILED" in flags}
    assert list(failed.values()) == [1]
    (folder,) = (tmp_path / "failing").iterdir()  # the others have none
    (file,) = folder.glob("*-failed.npz")  # beside wrong claims of success
    assert qpmhe_solvers.load(file).backend == "crashingonce"
    assert "SOLVED" in command("solve-qp", tmp_path / "failing", "--backend", "banded")


def test_a_full_disk_in_the_middle_is_reported_and_the_same_call_goes_on(path, monkeypatch):
    plain = store_module._create

    def small(connection):
        plain(connection)
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count = {pages + 3}")

    study = Study(**{**SMALL, "seeds": 20})
    monkeypatch.setattr(store_module, "_create", small)
    with pytest.raises(StoreError, match="disk is full; all cells that were stored are safe"):
        run(study, path, progress=False)
    monkeypatch.undo()
    before = Store(path).frame()
    assert 0 < len(before) < 40
    after = run(study, path, progress=False).frame()
    assert sorted(after["key"]) == sorted(cell.key for cell in study.cells())
    assert list(after["finished"][: len(before)]) == list(before["finished"])


def ends_alone(path, models, **where):
    """Of two cells of each model, that of seed 1 ends its process; reasons by model."""
    study = Study(
        models=[f"{ODD}:{model}" for model in models], backends=["banded"], qps=[1], seeds=2,
        steps=12, cell_timeout=6.0,
    )
    frame = run(study, path, **{"progress": False} | where).frame()
    assert frame.set_index("seed")["outcome"].groupby("seed").agg(set).to_dict() == {
        0: {"done"}, 1: {"failed"}}
    failed = frame[frame["seed"] == 1]
    for model, reason in zip(failed["model"], failed["reason"], strict=True):
        assert DEATHS[model.rpartition(":")[2]] in reason
    return study


@pytest.mark.parametrize("model", ["crashes", "is_killed", "hangs"])
def test_cells_that_fail_or_end_their_process_are_rows_and_can_be_tried_again(
    path, monkeypatch, model
):
    out = console()
    study = ends_alone(path, (model, "raises"), jobs=2, progress=out)
    assert "2 failed" in out.file.getvalue()
    handed = counted(monkeypatch)
    run(study, path, progress=False)
    assert handed == []
    again = Study(**{**SMALL, "models": [f"{ODD}:raises"], "qps": [1]})
    run(again, path, jobs=1, progress=False, retry_failed=True)
    assert [key[-6:] for key in handed] == ["seed=1"]


def test_accuracy_and_time_are_measured_apart_and_whole_turns_are_no_errors(path):
    """Two crossings of a heading that wraps are no errors, nor jumps in the figures."""
    options = {"models": ["vehicle"], "backends": ["banded"], "qps": [0, 1], "steps": 100}
    run(Study(**options, seeds=1, measure="accuracy", covariances=True), path, progress=False)
    store = Store(path)
    frame = store.frame()
    assert frame["times"].isna().all()
    for row in frame.itertuples():
        assert row.rmse_states[2] < 0.1
        assert row.nees < 30.0
        drawn = store.trajectory(row.key)
        assert np.abs(np.diff(drawn["states"][:, 2])).max() > 6.0
        assert np.abs(drawn["estimates"] - drawn["states"])[:, 2].max() < 1.0
    run(Study(**options, seeds=1, measure="time"), path, progress=False)
    timed = store.frame()
    assert list(timed["key"]) == list(frame["key"])
    assert timed["time_median"].gt(0).all()
    assert list(timed["cost_ratio"]) == list(frame["cost_ratio"])
    assert not timed["shared"].any()  # one at a time, as nothing else was asked for
    assert store.meta()["studies"][1]["jobs"] == 1
    run(Study(**{**options, "steps": 12}, seeds=[7, 8], measure="time"), path, jobs=2,
        progress=False)
    assert store.frame().set_index("seed")["shared"][[7, 8]].all()


def test_what_does_not_fit_is_refused(path, monkeypatch):
    monkeypatch.setattr(runner, "_CONNECT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts, and never answers
        there = [{"scheduler": one} for one in (
            "nonsense", "", 8786, f"tcp://127.0.0.1:{silent.getsockname()[1]}")]
        for options, error, words in (
            ({"jobs": 0}, OptionError, "jobs is 0"),
            ({"jobs": 2, "scheduler": "tcp://127.0.0.1:1"}, OptionError, "leave it out"),
            ({"progress": 3}, OptionError, "progress is 3"),
            ({"study": "study.toml"}, StudyError, r"expected a qpmhe\.studies\.Study"),
            *((one, StudyError, f"the scheduler is {one['scheduler']!r}.* gives no Dask workers "
               ".*such as tcp://10") for one in there if distributed),
            ({"missing": "joblib"}, InvalidInputError, r"pip install 'qpmhe\[studies\]'"),
            ({"missing": "distributed", **there[0]}, InvalidInputError,
             r"pip install 'qpmhe\[dask\]'"),
        ):
            if (module := options.pop("missing", None)) is not None:
                monkeypatch.setitem(sys.modules, module, None)
            with pytest.raises(error, match=words):
                run(**{"study": Study(**SMALL), "store": path, "progress": False} | options)
    assert not path.exists()


# What Dask and its own dependencies warn of is theirs.
on_dask = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def address():
    dask = pytest.importorskip("dask")
    # A busy machine restarts workers slowly, and such a cluster takes that for their end.
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "600s"})
    with warnings.catch_warnings(), patient:
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as made:
            yield made.scheduler_address


@on_dask
def test_results_of_a_cluster_are_those_of_this_machine(address, path, tmp_path):
    study = Study(**SMALL)
    there = run(study, path, scheduler=address, progress=False).frame()
    here = run(study, tmp_path / "here.sqlite", progress=False).frame()
    assert set(there["outcome"]) == {"done"}
    there, here = there.set_index("key").sort_index(), here.set_index("key").sort_index()
    for name in ("rmse", "rmse_settled", "cost_ratio", "improved"):
        np.testing.assert_array_equal(there[name], here[name])
    assert there["shared"].all()


@pytest.mark.slow
@on_dask
def test_a_cell_that_ends_its_worker_is_a_row(address, path):
    ends_alone(path, ("is_killed", "hangs"), scheduler=address)


@pytest.mark.slow
@on_dask
def test_a_scheduler_that_dies_loses_nothing_and_the_same_call_resumes(
    path, tmp_path, monkeypatch
):
    pytest.importorskip("distributed")

    def server(*arguments):
        return subprocess.Popen(
            [sys.executable, "-m", *arguments, "--no-dashboard"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )

    contact, put, stored = tmp_path / "scheduler.json", Writer.put, []
    study = Study(**{**SMALL, "seeds": 100, "steps": 150})
    scheduler = server(
        "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
        "--scheduler-file", str(contact),
    )

    def counting(writer, result):
        put(writer, result)
        stored.append(result)
        if len(stored) == 10:
            scheduler.kill()

    worker = None
    try:
        until = time.monotonic() + 300
        while not (contact.exists() and contact.read_text().strip()):
            assert time.monotonic() < until
            time.sleep(0.1)
        address = json.loads(contact.read_text())["address"]
        worker = server(
            "distributed.cli.dask_worker", address, "--nworkers", "1", "--nthreads", "1"
        )
        monkeypatch.setattr(runner, "_CONNECT", 300.0)
        monkeypatch.setattr(Writer, "put", counting)
        with pytest.raises(StudyError, match="give the same command again"):
            run(study, path, scheduler=address, progress=False)
    finally:
        scheduler.kill()
        if worker is not None:
            worker.terminate()
            worker.wait()
        scheduler.wait()
    frame = Store(path).frame()
    assert 10 <= len(frame) < 200
    assert set(frame["outcome"]) == {"done"}  # what the cluster could not do is no failure
    assert not frame["shared"].any()  # one worker with one thread
    fewer = Study(**{**SMALL, "seeds": 10, "steps": 150})
    after = run(fewer, path, progress=False).frame()
    assert list(after["finished"][: len(frame)]) == list(frame["finished"])
    assert {cell.key for cell in fewer.cells()} <= set(after["key"])
