"""The same studies on a local Dask cluster of two workers."""

import json
import logging
import socket
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

from qpmhe.studies import Store, Study, StudyError, run, runner
from qpmhe.studies.store import Writer

distributed = pytest.importorskip("distributed", reason="Dask is not installed")

# What Dask and its own dependencies warn of is theirs.
pytestmark = pytest.mark.filterwarnings("ignore")

ODD = "tests/studies/odd_models.py"
SMALL = {"backends": ["banded"], "qps": [0, 1], "seeds": 4, "steps": 12}


@pytest.fixture(scope="module")
def address():
    import dask

    # A busy machine restarts workers slowly, and such a cluster takes that for their end.
    patient = dask.config.set({"distributed.deploy.lost-worker-timeout": "600s"})
    with warnings.catch_warnings(), patient:
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as made:
            yield made.scheduler_address


def server(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", *arguments, "--no-dashboard"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )


def test_results_are_those_of_this_machine(address, tmp_path):
    study = Study(**SMALL)
    there = run(study, tmp_path / "there.sqlite", scheduler=address, progress=False).frame()
    here = run(study, tmp_path / "here.sqlite", progress=False).frame()
    assert set(there["outcome"]) == {"done"}
    there, here = there.set_index("key").sort_index(), here.set_index("key").sort_index()
    assert list(there.index) == list(here.index)
    for name in ("rmse", "rmse_settled", "cost_ratio", "improved"):
        np.testing.assert_array_equal(there[name], here[name])
    assert there["shared"].all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "words", "timeout"),
    [
        ("raises", "ZeroDivisionError", 60.0),
        ("is_killed", "the process that ran it died, twice", 60.0),
        ("hangs", "out of time: the process that ran it did not answer", 6.0),
    ],
)
def test_a_cell_that_ends_its_worker_is_a_row(address, tmp_path, model, words, timeout):
    study = Study(
        models=[f"{ODD}:{model}"], backends=["banded"], qps=[1], seeds=4, steps=12,
        cell_timeout=timeout,
    )
    store = run(study, tmp_path / "store.sqlite", scheduler=address, progress=False)
    frame = store.frame().set_index("seed")
    assert sorted(frame.index) == [0, 1, 2, 3]
    assert frame["outcome"].to_dict() == {0: "done", 1: "failed", 2: "done", 3: "done"}
    assert words in frame["reason"][1]


@pytest.mark.parametrize("given", ["nonsense", "", "http://127.0.0.1:80", "tcp://", 8786])
def test_what_is_no_address_is_refused(tmp_path, given):
    with pytest.raises(StudyError, match=r"gives no Dask workers .*such as tcp://10") as caught:
        run(Study(**SMALL), tmp_path / "store.sqlite", scheduler=given, progress=False)
    assert str(caught.value).startswith(f"the scheduler is {given!r}")
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_is_no_scheduler_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "_CONNECT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts, and never answers
        given = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(StudyError, match="gives no Dask workers"):
            run(Study(**SMALL), tmp_path / "store.sqlite", scheduler=given, progress=False)
    assert list(tmp_path.iterdir()) == []


def kill_after(rows, process, monkeypatch):
    """Kill a process as soon as this many rows are stored."""
    put, stored = Writer.put, []

    def counting(writer, result):
        put(writer, result)
        stored.append(result)
        if len(stored) == rows:
            process.kill()

    monkeypatch.setattr(Writer, "put", counting)


@pytest.mark.slow
def test_a_scheduler_that_dies_loses_nothing_and_the_same_call_resumes(tmp_path, monkeypatch):
    path, contact = tmp_path / "store.sqlite", tmp_path / "scheduler.json"
    study = Study(**{**SMALL, "seeds": 100, "steps": 150})
    scheduler = server(
        "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
        "--scheduler-file", str(contact),
    )
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
        kill_after(10, scheduler, monkeypatch)
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
