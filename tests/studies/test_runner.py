"""Studies in worker processes of this machine and on a Dask cluster."""

import io
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from rich.console import Console

import qpmhe_solvers
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies import Store, StoreError, Study, StudyError, run, runner
from qpmhe.studies import store as store_module
from qpmhe.studies.store import Writer
from tests.solvers.hostile_backend import CrashingOnce, entry
from tests.solvers.problems import registered

from .report_study import command

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


@pytest.fixture
def handed(monkeypatch):
    """Keys of the cells that are handed to the workers."""
    keys, plain = [], runner._results

    def results(workers, tasks):
        keys.extend(task.cell.key for task in tasks)
        return plain(workers, tasks)

    monkeypatch.setattr(runner, "_results", results)
    return keys


@pytest.mark.slow
def test_a_study_runs_once_and_more_cells_are_added(path, handed):
    out = Console(file=io.StringIO(), width=120)
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
    more = run(Study(**{**SMALL, "seeds": 3}), store, jobs=1, progress=out).frame()
    assert [key[-6:] for key in handed] == ["seed=2"] * 2
    assert "4 of 6 cells were there already" in out.file.getvalue()
    assert list(more["finished"])[:4] == list(frame["finished"])


def test_a_full_disk_is_reported_and_the_same_call_goes_on(path, monkeypatch):
    plain = store_module._create

    def small(connection):
        plain(connection)
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count = {pages + 3}")

    study = Study(**{**SMALL, "seeds": 20})
    with monkeypatch.context() as patched:
        patched.setattr(store_module, "_create", small)
        with pytest.raises(StoreError, match="disk is full; all cells that were stored are safe"):
            run(study, path, jobs=1, progress=False)
    before = Store(path).frame()
    assert 0 < len(before) < 40
    after = run(study, path, jobs=1, progress=False).frame()
    assert sorted(after["key"]) == sorted(cell.key for cell in study.cells())
    assert list(after["finished"][: len(before)]) == list(before["finished"])


@pytest.mark.slow
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
    reasons = frame.loc["crashingonce", "reasons"]
    assert [n for flags, n in reasons.items() if "SOLVER_FAILED" in flags] == [1]
    (folder,) = (tmp_path / "failing").iterdir()  # the others have none
    (file,) = folder.glob("*-failed.npz")  # beside wrong claims of success
    assert qpmhe_solvers.load(file).backend == "crashingonce"
    assert "SOLVED" in command("solve-qp", tmp_path / "failing", "--backend", "banded")


# It waits before its last row: however fast the machine, it is met in the middle.
_WRITE = """
import sys, time
from qpmhe.studies import Study, run
from qpmhe.studies import store as store_module
from qpmhe.studies.store import Writer

put = Writer.put
def held(writer, result):
    while len(writer.present(False)) >= int(sys.argv[3]):
        time.sleep(0.01)
    put(writer, result)
Writer.put = held
run(Study(**eval(sys.argv[1])), sys.argv[2], jobs=2, progress=False)
"""


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


@pytest.mark.slow
def test_a_study_killed_at_random_and_read_meanwhile_loses_and_repeats_nothing(tmp_path, path):
    options, known = {**SMALL, "seeds": 15}, {}
    cells = Study(**options).cells()
    target = np.random.default_rng(1).integers(1, len(cells) - 1)
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITE, repr(options), str(path), str(len(cells) - 1)],
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
    frame = run(Study(**options), path, jobs=1, progress=False).frame()
    assert sorted(seen(path, known)) == sorted(cell.key for cell in cells)
    assert set(frame["outcome"]) == {"done"}
    # Nothing else is left behind by the run that came to its end.
    assert [item.name for item in tmp_path.iterdir()] == ["store.sqlite"]


def ends_alone(path, models, **where):
    """Of two cells of each model, that of seed 1 ends its process; reasons by model."""
    study = Study(
        models=[f"{ODD}:{model}" for model in models], backends=["banded"], qps=[1], seeds=2,
        steps=12, cell_timeout=6.0 if "hangs" in models else 60.0,
    )
    frame = run(study, path, progress=False, **where).frame()
    assert frame.set_index("seed")["outcome"].groupby("seed").agg(set).to_dict() == {
        0: {"done"}, 1: {"failed"}}
    failed = frame[frame["seed"] == 1]
    for model, reason in zip(failed["model"], failed["reason"], strict=True):
        assert DEATHS[model.rpartition(":")[2]] in reason
    return study


@pytest.mark.slow
@pytest.mark.parametrize("model", ["crashes", "is_killed", "hangs"])
def test_cells_that_fail_or_end_their_process_are_rows_and_can_be_tried_again(path, handed, model):
    study = ends_alone(path, (model, "raises"), jobs=2)
    handed.clear()
    run(study, path, progress=False)
    assert handed == []
    again = Study(**{**SMALL, "models": [f"{ODD}:raises"], "qps": [1]})
    run(again, path, jobs=1, progress=False, retry_failed=True)
    assert [key[-6:] for key in handed] == ["seed=1"]


@pytest.mark.slow
def test_accuracy_and_time_are_measured_apart_and_whole_turns_are_no_errors(path):
    """Two crossings of a heading that wraps are no errors, nor jumps in the figures."""
    options = {"models": ["vehicle"], "backends": ["banded"], "qps": [0, 1], "steps": 100}
    study = Study(**options, seeds=1, measure="accuracy", covariances=True)
    run(study, path, jobs=1, progress=False)
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
    assert timed["time_median"].gt(0).all()
    assert list(timed["cost_ratio"]) == list(frame["cost_ratio"])
    assert not timed["shared"].any()  # one at a time, as nothing else was asked for
    assert store.meta()["studies"][1]["jobs"] == 1


def test_what_does_not_fit_is_refused(path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(runner, "_CONNECT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts, and never answers
        there = {"scheduler": f"tcp://127.0.0.1:{silent.getsockname()[1]}"}
        for options, missing, error, words in (
            ({"jobs": 0}, "", OptionError, "jobs is 0"),
            ({"jobs": 2, **there}, "", OptionError, "leave it out"),
            ({"study": "study.toml"}, "", StudyError, r"expected a qpmhe\.studies\.Study"),
            (there, "", StudyError, "gives no Dask workers.*such as tcp://10"),
            ({}, "joblib", InvalidInputError, r"pip install 'qpmhe\[studies\]'"),
            (there, "distributed", InvalidInputError, r"pip install 'qpmhe\[dask\]'"),
        ):
            if missing:
                monkeypatch.setitem(sys.modules, missing, None)
            with pytest.raises(error, match=words):
                run(**{"study": Study(**SMALL), "store": path, "progress": False} | options)
    assert not path.exists()


_CLUSTER = """
import dask, sys
from distributed import LocalCluster

# A busy machine restarts workers slowly, and such a cluster takes that for their end.
dask.config.set({"distributed.deploy.lost-worker-timeout": "600s"})
options = {"n_workers": int(sys.argv[1]), "threads_per_worker": 1, "dashboard_address": None}
with LocalCluster(**options) as made:
    print(made.scheduler_address, flush=True)
    sys.stdin.read()
"""


@contextmanager
def cluster(workers):
    """The process of a Dask cluster, and its address."""
    pytest.importorskip("distributed")
    with subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", _CLUSTER, str(workers)], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.stdin.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # What Dask and its own dependencies warn of is theirs.
def test_results_of_a_cluster_are_those_of_this_machine(path, tmp_path):
    with cluster(2) as (_, address):
        there = run(Study(**SMALL), path, scheduler=address, progress=False).frame()
        ends_alone(tmp_path / "alone.sqlite", ("is_killed",), scheduler=address)
    here = run(Study(**SMALL), tmp_path / "here.sqlite", progress=False).frame()
    assert set(there["outcome"]) == {"done"}
    there, here = there.set_index("key").sort_index(), here.set_index("key").sort_index()
    for name in ("rmse", "rmse_settled", "cost_ratio", "improved"):
        np.testing.assert_array_equal(there[name], here[name])
    assert there["shared"].all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_dies_loses_nothing_and_the_same_call_resumes(path, monkeypatch):
    put, stored = Writer.put, []
    with cluster(1) as (process, address):
        def counting(writer, result):
            put(writer, result)
            stored.append(result)
            if len(stored) == 10:
                process.kill()

        monkeypatch.setattr(Writer, "put", counting)
        study = Study(**{**SMALL, "seeds": 100, "steps": 150})
        with pytest.raises(StudyError, match="give the same command again"):
            run(study, path, scheduler=address, progress=False)
    frame = Store(path).frame()
    assert 10 <= len(frame) < 200
    assert set(frame["outcome"]) == {"done"}  # what the cluster could not do is no failure
    assert not frame["shared"].any()  # one worker with one thread
    after = run(Study(**{**SMALL, "seeds": 10, "steps": 150}), path, progress=False).frame()
    assert list(after["finished"][: len(frame)]) == list(frame["finished"])
