"""What a worker makes of a cell, whatever happens in it."""

import pickle

import numpy as np
import pytest

import qpmhe_solvers
from qpmhe.models import batch_reactor
from qpmhe.models.loading import find
from qpmhe.studies import cell as module
from qpmhe.studies.cell import Cell, Task, compute

ODD = "tests/studies/odd_models.py"


def task(model="batch_reactor", backend="banded", seed=1, parts=("accuracy",), **options):
    cell = Cell(model, backend, 1, None, 10, "candidate", seed, 30)
    return Task(cell, find(model), frozenset(parts), **{"timeout": 60.0, **options})


@pytest.mark.parametrize(
    ("model", "words"),
    [("raises", "ZeroDivisionError: division by zero"), ("leaves", "SystemExit: 3")],
)
def test_whatever_is_raised_becomes_a_row(model, words):
    row = compute(task(f"{ODD}:{model}"))
    assert (row["outcome"], row["reason"]) == ("failed", words)
    assert row["model"] == f"{ODD}:{model}"
    assert compute(task(f"{ODD}:{model}", seed=0))["outcome"] == "done"


def test_an_interruption_by_the_user_is_no_failure(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compute(task())


def test_a_cell_gives_up_between_two_steps():
    row = compute(task(timeout=1e-9))
    assert row["outcome"] == "failed"
    assert row["reason"] == "out of time: 1 of 30 steps were done."


def test_a_reference_that_runs_out_of_time_costs_the_ratio_only(monkeypatch):
    def late(*_):
        raise module.OutOfTimeError("3 of 30 steps were done.")

    monkeypatch.setattr(module, "_reference", late)
    row = compute(task())
    assert row["outcome"] == "done"
    assert np.isfinite(row["rmse"])
    assert np.isnan(row["cost_ratio"])
    assert "reference ran out of time" in row["reason"]


def test_the_trajectory_is_kept_where_it_is_wanted():
    assert "trajectory" not in compute(task())
    kept = compute(task(keep=True))["trajectory"]
    scenario = batch_reactor().scenario
    record = scenario.simulate(1, 30)
    np.testing.assert_array_equal(kept["states"], record.states)
    np.testing.assert_allclose(kept["times"], scenario.dt * np.arange(31))
    np.testing.assert_array_equal(kept["estimates"][0], scenario.initial_estimate)
    assert kept["labels"] == list(scenario.labels)
    assert (kept["title"], kept["time_unit"]) == (scenario.title, scenario.time_unit)


def test_a_users_backend_travels_with_the_task():
    banded = qpmhe_solvers.backend("banded")
    entry = qpmhe_solvers.Backend("mine", banded.factory, "banded", inequalities=False)
    sent = pickle.loads(pickle.dumps(task(backend="mine", registered=entry)))
    try:
        row = compute(sent)
        assert (row["outcome"], row["backend"]) == ("done", "mine")
        assert compute(sent)["rmse"] == row["rmse"]  # registered once is enough
        assert row["rmse"] == compute(task())["rmse"]
    finally:
        qpmhe_solvers.unregister("mine")


def test_the_environment_names_versions_and_processor():
    found = compute(task())["environment"]
    assert found["versions"]["numpy"] == np.__version__
    assert {"qpmhe", "scipy"} <= set(found["versions"])
    assert found["cpu"]
    assert found["cores"] >= 1
    assert set(found) == {"versions", "cpu", "cores", "python", "os", "host", "threads"}
