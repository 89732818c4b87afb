"""What is put comes back; other files, damage, locks and full disks are reported."""

import json
import os
import sqlite3
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from qpmhe.errors import InvalidInputError
from qpmhe.models.loading import find
from qpmhe.studies import Store, StoreError, Study, export, summarise, write_report
from qpmhe.studies import store as module
from qpmhe.studies.cell import Task, compute, failure
from qpmhe.studies.experiment import Source
from qpmhe.studies.row import Cell

SETTINGS = Study(backends=["banded"], deadline=1e-6).settings()
BOTH = ("accuracy", "time")


def task(seed=0, parts=BOTH, qps=1, **options):
    cell = Cell("batch_reactor", "banded", qps, None, 10, "candidate", seed, 12)
    return Task(cell, Source(find("batch_reactor")), frozenset(parts), 60.0, **options)


def stored(path, *results, settings=SETTINGS):
    store = Store(path)
    with store.writing() as writer:
        writer.begin(settings, {})
        for result in results:
            writer.put(result)
    return store


@pytest.fixture
def path(tmp_path):
    return tmp_path / "store.sqlite"


def test_a_row_comes_back_as_it_was_put_and_the_settings_and_environments(path):
    result = compute(task(parts=(*BOTH, "covariance"), keep=True, shared=True))
    other = replace(
        compute(task(1, qps=None)), environment={**result.environment, "cpu": "a"}
    )
    store = stored(path, result, other)
    frame = store.frame()
    assert (list(frame["seed"]), list(frame["environment"])) == ([0, 1], [0, 1])
    row = frame.iloc[0]
    for name in module.COLUMNS:
        if name == "solver_iterations":
            assert pd.isna(row[name])
        elif name not in ("environment", "finished", "parts"):
            np.testing.assert_equal(row[name], getattr(result, name), name)
    assert row["late"] == 1.0  # the deadline is a microsecond
    assert pd.isna(frame["qps"].iloc[1])
    assert str(frame["qps"].dtype) == str(frame["solver_iterations"].dtype) == "Int64"
    found = store.trajectory(result.key)
    for name in ("times", "states", "estimates"):
        np.testing.assert_array_equal(found.pop(name), result.trajectory.pop(name))
    assert found == result.trajectory
    assert store.trajectory("no such key") is None
    meta = store.meta()
    assert (meta["study"], meta["schema"]) == (SETTINGS, module.SCHEMA)
    assert meta["environments"] == [result.environment, other.environment]
    stored(path, settings={**SETTINGS, "deadline": None})
    assert [item["deadline"] for item in store.meta()["studies"]] == [1e-6, None]
    assert store.frame()["late"].isna().all()


def test_parts_that_are_measured_later_are_added_and_failures_replaced(path):
    accurate, timed = compute(task(parts=["accuracy"])), compute(task(shared=True))

    def after(result):
        (row,) = stored(path, result).frame().to_dict("records")
        return row

    row = after(failure(task(), "died"))
    assert (row["outcome"], row["reason"]) == ("failed", "died")
    with Store(path).writing() as writer:
        assert list(writer.present(retry_failed=False)) == [row["key"]]
        assert writer.present(retry_failed=True) == {}
    row = after(accurate)
    assert (row["outcome"], row["times"], row["shared"]) == ("done", None, False)
    row = after(timed)
    assert (row["cost_ratio"], row["shared"]) == (accurate.cost_ratio, True)
    # A failure takes nothing away from what is there.
    last = after(failure(task(parts=(*BOTH, "covariance")), "too late"))
    assert (last["outcome"], last["time_median"]) == ("done", timed.time_median)


def change(path, command):
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(command)


def read(path):
    store = Store(path)
    store.meta()
    frame = store.frame()
    for key in frame["key"]:
        store.trajectory(key)
    summarise(frame)


def test_what_is_no_store_is_refused_with_the_remedy(path, tmp_path):
    for make, words in (
        (lambda: path.write_text("seed,rmse\n" * 100), "no SQLite file"),
        (lambda: change(path, "CREATE TABLE songs (title)"), "of another program"),
        (lambda: change(stored(path).path, f"PRAGMA user_version = {module.SCHEMA + 1}"),
         f"schema version {module.SCHEMA + 1}; this qpmhe reads"),
        (lambda: os.mkfifo(path), "is no regular file; name one"),
    ):
        with pytest.raises(StoreError, match="there is no store"):
            read(path)
        make()
        for use in (read, lambda path: Store(path).writing().__enter__()):
            with pytest.raises(StoreError, match=words):
                use(path)
        path.unlink()
    for use in (Study(backends=["banded"]).to_latex, lambda x: export(x, "a.csv"),
                lambda x: write_report(x, "out")):
        with pytest.raises(InvalidInputError, match=r"is 3; expected a qpmhe\.studies\.Store, or"):
            use(3)
    with pytest.raises(InvalidInputError, match=r"frame is None; expected a pandas\.DataFrame"):
        summarise(None)
    with pytest.raises(StoreError, match="check that the folder exists"):
        Store(tmp_path / "nowhere" / "store.sqlite").writing().__enter__()
    path.touch()
    with pytest.raises(StoreError, match="is empty: no study"):
        read(path)


@pytest.mark.slow
def test_a_truncated_or_changed_store_is_refused_with_the_remedy(path):
    stored(path, compute(task(keep=True)), compute(task(1)), failure(task(2), "out of time"))
    content = path.read_bytes()
    read(path)
    for share in (0.001, 0.02, 0.6, 0.999):
        before = content[: int(share * len(content))]
        path.write_bytes(before)
        words = r"damaged or truncated|no SQLite file"
        with pytest.raises(StoreError, match=words), Store(path).writing():
            pass
        assert path.read_bytes() == before
    damaged, used = 0, np.flatnonzero(np.frombuffer(content, np.uint8))  # most are zeros
    for place in np.random.default_rng(0).choice(used, 60):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            read(path)
        except StoreError as error:
            damaged += str(path) in str(error)
    assert damaged > 10
    for command in ("UPDATE cells SET rmse_states = '[1,'", "UPDATE cells SET times = x'00'",
                    "UPDATE studies SET settings = '{}'", "DROP TABLE studies"):
        path.write_bytes(content)
        change(path, command)
        with pytest.raises(StoreError, match=r"store\.sqlite: it is damaged .* an earlier copy"):
            read(path)


def test_two_studies_may_write_and_a_store_that_is_locked_for_now_loses_nothing(path, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    store, results = stored(path, compute(task())), [compute(task(seed)) for seed in (1, 2)]
    with store.writing() as one, store.writing() as other:
        one.put(results[0])
        other.put(results[0])
        assert list(store.frame()["seed"]) == [0, 1]
    with closing(sqlite3.connect(path, isolation_level=None)) as other, store.writing() as writer:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="another program has locked it"):
            writer.put(results[1])
        other.execute("ROLLBACK")
        writer.put(results[1])
    assert len(store.frame()) == 3
    assert list(path.parent.iterdir()) == [path]


def test_an_export_brings_everything_back(path, tmp_path, monkeypatch):
    store = stored(
        path, compute(task(parts=(*BOTH, "covariance"))), compute(task(1, qps=None)),
        compute(task(2, parts=["accuracy"])), failure(task(3), "one, two\n\"three\""),
    )
    frame = store.frame()
    empty = {name: [""] for name in frame if name not in ("reason", "reasons")}
    csv = pd.read_csv(export(store, tmp_path / "cells.csv"), keep_default_na=False, na_values=empty)
    parquet = pd.read_parquet(export(store, tmp_path / "cells.parquet"))
    lists = {"reasons", "rmse_states", "rmse_settled_states", "times"}
    for back, texts in ((csv, lists), (parquet, {"reasons"})):
        assert list(back) == list(frame)
        assert back["environment"].str.startswith("qpmhe ").all()
        for name in set(back) - {"environment"}:
            for one, other in zip(frame[name], back[name], strict=True):
                if name in texts:
                    other = json.loads(other) if isinstance(other, str) and other else None
                if isinstance(one, (list, np.ndarray)):
                    kind = np.float32 if name == "times" else np.float64
                    np.testing.assert_array_equal(np.asarray(one), np.asarray(other, kind))
                elif isinstance(one, dict):
                    assert one == other
                else:
                    assert pd.isna(other) if pd.isna(one) else one == other, name
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for name, words in (
        ("cells.xlsx", r"expected a name in \.csv, \.parquet or \.tex"),
        ("store.sqlite/a.csv", "cannot make the folder"),
        ("cells.parquet", r"needs pyarrow.*pip install 'qpmhe\[studies\]'"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            export(store, tmp_path / name)
