"""Studies in worker processes of this machine."""

import io

import numpy as np
import pytest
from rich.console import Console
from solvers.hostile_backend import CrashingOnce, entry
from solvers.problems import registered

import qpmhe
import qpmhe_solvers
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies import Store, StoreError, Study, StudyError, run, runner
from qpmhe.studies import store as store_module

ODD = "tests/studies/odd_models.py"
SMALL = {"backends": ["banded"], "qps": [0, 1], "seeds": 2, "steps": 12}


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
    # The observer's cell is an estimator without QPs.
    system, observer, cost, scenario = qpmhe.models.batch_reactor()
    record = scenario.simulate(1, 12)
    alone = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate, max_qps=0
    ).run(record.measurements)
    row = frame[(frame["backend"] == "observer") & (frame["seed"] == 1)].iloc[0]
    errors = alone.states - record.states
    assert row["rmse_states"] == pytest.approx(np.sqrt((errors**2).mean(axis=0)), rel=1e-12)
    # First seeds keep their trajectory, others do not.
    for row in frame.itertuples():
        assert (store.trajectory(row.key) is None) == (row.seed != 0)
    (environment,) = store.meta()["environments"]
    assert environment["threads"] == "1"
    assert "git" in environment

    handed.clear()
    before = frame[["key", "finished"]].to_dict("records")
    more = run(Study(**{**SMALL, "seeds": 3}), store, progress=out)
    assert [key[-6:] for key in handed] == ["seed=2"] * 2
    assert "4 of 6 cells were there already" in out.file.getvalue()
    assert more.frame()[["key", "finished"]].to_dict("records")[:4] == before
    handed.clear()
    run(Study(**SMALL), path, progress=False)
    assert handed == []


def test_errors_of_a_heading_that_wraps(path):
    """Two crossings in the record: whole turns are no errors, nor jumps in the figures."""
    grid = {"models": ["vehicle"], "backends": ["banded"], "qps": [0, 1], "seeds": 1, "steps": 100}
    run(Study(**grid, measure="accuracy", covariances=True), path, progress=False)
    store = Store(path)
    for row in store.frame().itertuples():
        assert row.rmse_states[2] < 0.1
        assert row.nees < 30.0
        drawn = store.trajectory(row.key)
        assert np.abs(np.diff(drawn["states"][:, 2])).max() > 6.0
        assert np.abs(drawn["estimates"] - drawn["states"])[:, 2].max() < 1.0


def test_accuracy_and_time_are_measured_apart(path):
    run(Study(**SMALL, measure="accuracy"), path, progress=False)
    frame = Store(path).frame()
    assert frame["times"].isna().all()
    assert frame["cost_ratio"].notna().all()
    run(Study(**SMALL, measure="time"), path, progress=False)
    timed = Store(path).frame()
    assert list(timed["key"]) == list(frame["key"])
    assert timed["time_median"].gt(0).all()
    assert list(timed["cost_ratio"]) == list(frame["cost_ratio"])
    assert not timed["shared"].any()  # one at a time, as nothing else was asked for
    assert [item["jobs"] for item in Store(path).meta()["studies"]][1] == 1


def test_cells_that_are_timed_side_by_side_are_marked(path):
    run(Study(**SMALL, measure="time"), path, jobs=2, progress=False)
    assert Store(path).frame()["shared"].all()


@pytest.mark.parametrize(
    ("model", "words", "timeout"),
    [
        ("crashes", "the process that ran it died, twice (SIGSEGV", 60.0),
        ("is_killed", "the process that ran it died, twice (SIGKILL", 60.0),
        ("hangs", "out of time: the process that ran it did not answer", 6.0),
    ],
)
def test_a_cell_that_ends_its_process_is_a_row(path, model, words, timeout):
    study = Study(
        models=[f"{ODD}:{model}"], backends=["banded"], qps=[1], seeds=4, steps=12,
        cell_timeout=timeout,
    )
    frame = run(study, path, jobs=2, progress=False).frame().set_index("seed")
    assert sorted(frame.index) == [0, 1, 2, 3]
    assert frame["outcome"].to_dict() == {0: "done", 1: "failed", 2: "done", 3: "done"}
    assert words in frame["reason"][1]


def test_cells_that_fail_stop_nothing_and_can_be_tried_again(path, monkeypatch):
    study = Study(
        models=[f"{ODD}:is_slow", f"{ODD}:raises"], backends=["banded"], qps=[1], seeds=2,
        steps=12, cell_timeout=3.0,
    )
    out = console()
    frame = run(study, path, progress=out).frame()
    reasons = {row.model: row.reason for row in frame.itertuples() if row.outcome == "failed"}
    assert reasons == {
        f"{ODD}:is_slow": "out of time: 1 of 12 steps were done.",
        f"{ODD}:raises": "ZeroDivisionError: division by zero",
    }
    assert "2 failed" in out.file.getvalue()
    handed = counted(monkeypatch)
    run(study, path, progress=False)
    assert handed == []
    run(study, path, progress=False, retry_failed=True)
    assert [key[-6:] for key in handed] == ["seed=1"] * 2


def test_a_backend_that_was_registered_here_runs_there(path):
    banded = qpmhe_solvers.backend("banded")
    qpmhe_solvers.register(
        qpmhe_solvers.Backend("mine", lambda options: banded.factory(options), "banded")
    )
    try:
        study = Study(**{**SMALL, "backends": ["mine", "banded"], "qps": [1]})
        frame = run(study, path, progress=False).frame()
    finally:
        qpmhe_solvers.unregister("mine")
    assert set(frame["outcome"]) == {"done"}
    rmse = frame.pivot_table(index="seed", columns="backend", values="rmse")
    assert list(rmse["mine"]) == list(rmse["banded"])


def test_a_cell_whose_backend_crashes_is_run_again_with_the_backend_apart(path):
    with registered(entry(CrashingOnce)):
        study = Study(**{**SMALL, "backends": ["crashingonce", "banded"], "qps": [1], "seeds": 1})
        frame = run(study, path, progress=False).frame()
    assert set(frame["outcome"]) == {"done"}
    for row in frame.itertuples():
        if row.backend == "banded":
            assert row.reason == ""
            continue
        assert row.reason == (
            "the backend ran in a process of its own, since the cell's died, twice (SIGSEGV(-11))"
        )
        assert sum(n for flags, n in row.reasons.items() if "SOLVER_FAILED" in flags) == 1


def test_a_full_disk_in_the_middle_is_told_and_the_same_call_goes_on(path, monkeypatch):
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


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"jobs": 0}, OptionError, "jobs is 0"),
        ({"jobs": 1.5}, OptionError, "jobs is 1.5"),
        ({"jobs": 2, "scheduler": "tcp://127.0.0.1:1"}, OptionError, "leave it out"),
    ],
)
def test_options_that_do_not_fit_are_refused(path, options, error, words):
    with pytest.raises(error, match=words):
        run(Study(**SMALL), path, **options)
    with pytest.raises(StudyError, match=r"expected a qpmhe\.studies\.Study"):
        run("study.toml", path)
    assert not path.exists()


def test_a_missing_package_is_told_with_the_command_that_installs_it(path, monkeypatch):
    modules = __import__("sys").modules
    monkeypatch.setitem(modules, "joblib", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'qpmhe\[studies\]'"):
        run(Study(**SMALL), path, progress=False)
    monkeypatch.undo()
    monkeypatch.setitem(modules, "distributed", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'qpmhe\[dask\]'"):
        run(Study(**SMALL), path, progress=False, scheduler="tcp://127.0.0.1:1")
