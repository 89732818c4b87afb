"""The same studies on a local Dask cluster of two workers."""

import json
import logging
import socket
import subprocess
import sys
import threading
import time
import warnings

import numpy as np
import pytest

from qpmhe.studies import cluster
from qpmhe.studies.errors import SchedulerError
from qpmhe.studies.grid import Study
from qpmhe.studies.runner import run
from qpmhe.studies.store import Store
from qpmhe.studies.writer import Writer

distributed = pytest.importorskip("distributed", reason="Dask is not installed")

# What Dask and its own dependencies warn of is theirs.
pytestmark = pytest.mark.filterwarnings("ignore")

ODD = "tests/studies/odd_models.py"
SMALL = {"backends": ["banded"], "qps": [0, 1], "seeds": 4, "steps": 12}


@pytest.fixture(scope="module")
def address():
    with warnings.catch_warnings():
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


@pytest.mark.parametrize(
    ("model", "words", "timeout"),
    [
        ("raises", "ZeroDivisionError", 60.0),
        ("is_killed", "the process that ran it died, twice", 60.0),
        ("hangs", "out of time: the process that ran it was ended", 6.0),
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


def refusal(path, address):
    """What is said about an address; in a thread, so that waiting without end is noticed."""
    said = []

    def ask():
        try:
            run(Study(**SMALL), path, scheduler=address, progress=False)
        except SchedulerError as error:
            said.append(str(error))

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(120)
    assert not thread.is_alive()
    assert not path.exists()
    (words,) = said
    return words


@pytest.fixture
def no_client(monkeypatch):
    """A client that is half made complains half a minute later."""
    def made(*_, **__):
        raise AssertionError

    monkeypatch.setattr(distributed, "Client", made)


def test_a_scheduler_that_is_not_there_is_told_before_anything_is_written(
    tmp_path, monkeypatch, no_client
):
    monkeypatch.setattr(cluster, "_CONNECT", 1.0)
    words = refusal(tmp_path / "store.sqlite", "tcp://127.0.0.1:9")
    assert "no Dask scheduler answers at 'tcp://127.0.0.1:9'" in words


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("nonsense", "missing port"),
        ("", "missing port"),
        ("http://127.0.0.1:80", "unknown address scheme 'http'"),
        ("nonsense://x", "unknown address scheme 'nonsense'"),
        ("tcp://", "missing port"),
        ("tcp://:8786", "host or port"),
        ("tcp://127.0.0.1:0", "host or port"),
        ("tcp://127.0.0.1:87860", "host or port"),
        ("tcp://1:2:3", "invalid address"),
        (8786, "it is no text"),
    ],
)
def test_what_is_no_address_is_refused_without_asking_anybody(
    tmp_path, monkeypatch, no_client, address, words
):
    monkeypatch.setattr("qpmhe.studies.address._identity", None)
    said = refusal(tmp_path / "store.sqlite", address)
    assert said.startswith(f"the scheduler's address is {address!r}")
    assert words in said
    assert "such as tcp://10.0.0.1:8786" in said


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"\x08" + 15 * b"\x00"])
def test_a_port_of_another_program_is_told(tmp_path, monkeypatch, no_client, greeting):
    monkeypatch.setattr(cluster, "_CONNECT", 1.0)
    taken = []

    def serve(listening):
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            taken.append(connection)
            connection.sendall(greeting)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = threading.Thread(target=serve, args=(listening,))
        server.start()
        try:
            address = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
            words = refusal(tmp_path / "store.sqlite", address)
        finally:
            listening.shutdown(socket.SHUT_RDWR)
            server.join()
            for connection in taken:
                connection.close()
    assert f"no Dask scheduler answers at {address!r}" in words
    assert taken


def test_the_address_of_a_worker_is_told(address, tmp_path):
    with distributed.Client(address, set_as_default=False) as client:
        worker = next(iter(client.scheduler_info()["workers"]))
    words = refusal(tmp_path / "store.sqlite", worker)
    assert f"a Dask worker answers at {worker!r}, not a scheduler" in words
    assert repr(address) in words


@pytest.fixture
def dask_log():
    """What Dask and tornado tell the user."""
    told = []

    class Collecting(logging.Handler):
        def emit(self, record):
            told.append(record.getMessage())

    handler = Collecting()
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado")]
    for logger in loggers:
        logger.addHandler(handler)
    yield told
    for logger in loggers:
        logger.removeHandler(handler)


def kill_after(rows, process, monkeypatch):
    """Kill a process as soon as this many rows are stored."""
    put, stored = Writer.put, []

    def counting(writer, result):
        put(writer, result)
        stored.append(result)
        if len(stored) == rows:
            process.kill()

    monkeypatch.setattr(Writer, "put", counting)


def test_a_scheduler_that_dies_loses_nothing_and_the_same_call_goes_on(
    tmp_path, monkeypatch, dask_log
):
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
        # joblib waits for workers ten seconds only, and a busy machine starts them slowly.
        with distributed.Client(address, timeout=300, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=300)
        monkeypatch.setattr(cluster, "_CONNECT", 300.0)
        dask_log.clear()
        kill_after(10, scheduler, monkeypatch)
        with pytest.raises(SchedulerError, match="give the same command again"):
            run(study, path, scheduler=address, progress=False)
    finally:
        scheduler.kill()
        if worker is not None:
            worker.terminate()
            worker.wait()
        scheduler.wait()
    assert dask_log == []
    frame = Store(path).frame()
    assert 10 <= len(frame) < 200
    assert set(frame["outcome"]) == {"done"}  # what the cluster could not do is no failure
    assert not frame["shared"].any()  # one worker with one thread
    fewer = Study(**{**SMALL, "seeds": 10, "steps": 150})
    after = run(fewer, path, progress=False).frame()
    assert list(after["finished"][: len(frame)]) == list(frame["finished"])
    assert {cell.key for cell in fewer.cells()} <= set(after["key"])
