import json
import os
import sqlite3
from contextlib import closing

import numpy as np
import pandas as pd
import pytest

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.models.loading import find
from qpmhe.studies import Store, StoreError, Study, export, summarise
from qpmhe.studies import store as module
from qpmhe.studies.cell import Cell, Task, compute, failure
from qpmhe.studies.experiment import Source

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


def test_a_row_comes_back_as_it_was_put(path):
    result = compute(task(parts=(*BOTH, "covariance"), keep=True, shared=True))
    store = stored(path, result, compute(task(1, qps=None)))
    frame = store.frame()
    assert list(frame["seed"]) == [0, 1]
    row = frame.iloc[0]
    for name in module.COLUMNS:
        if name == "solver_iterations":
            assert pd.isna(row[name])
        elif name not in ("environment", "finished", "parts"):
            np.testing.assert_equal(row[name], result[name], name)
    assert row["late"] == 1.0  # the deadline is a microsecond
    assert pd.isna(frame["qps"].iloc[1])
    assert str(frame["qps"].dtype) == str(frame["solver_iterations"].dtype) == "Int64"
    found = store.trajectory(result["key"])
    for name in ("times", "states", "estimates"):
        np.testing.assert_array_equal(found.pop(name), result["trajectory"].pop(name))
    assert found == result["trajectory"]
    assert store.trajectory("no such key") is None


def test_meta_holds_settings_and_environments(path):
    result = compute(task())
    other = {**compute(task(1)), "environment": {**result["environment"], "cpu": "abacus"}}
    store = stored(path, result, other, compute(task(2)))
    meta = store.meta()
    assert (meta["study"], meta["schema"]) == (SETTINGS, module.SCHEMA)
    assert meta["environments"] == [result["environment"], other["environment"]]
    assert list(store.frame()["environment"]) == [0, 1, 0]
    stored(path, settings={**SETTINGS, "deadline": None})
    assert [item["deadline"] for item in store.meta()["studies"]] == [1e-6, None]
    assert store.frame()["late"].isna().all()


def test_parts_that_are_measured_later_are_added_and_failures_replaced(path):
    accurate, timed = compute(task(parts=["accuracy"])), compute(task(shared=True))
    store = stored(path, failure(task(), "died"))
    (row,) = store.frame().to_dict("records")
    assert (row["outcome"], row["reason"]) == ("failed", "died")
    with store.writing() as writer:
        assert list(writer.present(retry_failed=False)) == [row["key"]]
        assert writer.present(retry_failed=True) == {}
    stored(path, accurate)
    (before,) = store.frame().to_dict("records")
    assert (before["outcome"], before["times"], before["shared"]) == ("done", None, False)
    stored(path, timed)
    (row,) = store.frame().to_dict("records")
    assert row["cost_ratio"] == accurate["cost_ratio"]
    assert (row["time_median"], row["shared"]) == (timed["time_median"], True)
    # A failure takes nothing away from what is there.
    stored(path, failure(task(parts=(*BOTH, "covariance")), "too late"))
    (after,) = store.frame().to_dict("records")
    assert (after["outcome"], after["rmse"]) == ("done", row["rmse"])
    with store.writing() as writer:
        assert writer.present(retry_failed=False) == {row["key"]: frozenset(BOTH)}


def change(path, command):
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(command)


def refused(path, words):
    """Reading and writing are refused, and the file stays as it is."""
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(StoreError, match=words):
        read(path)
    with pytest.raises(StoreError, match=words), Store(path).writing():
        pass
    assert before is None or path.read_bytes() == before


def test_what_is_no_store_is_refused_with_the_remedy(path, tmp_path):
    for reader in (Store(path).frame, Store(path).meta, lambda: Store(path).trajectory("x")):
        with pytest.raises(StoreError, match="there is no store"):
            reader()
    for make, words in (
        (lambda: path.write_text("seed,rmse\n" * 100), "no SQLite file"),
        (lambda: change(path, "CREATE TABLE songs (title)"), "of another program"),
        (lambda: change(stored(path).path, f"PRAGMA user_version = {module.SCHEMA + 1}"),
         f"schema version {module.SCHEMA + 1}; this qpmhe reads"),
        (lambda: os.mkfifo(path), "is no regular file; name one"),
    ):
        make()
        refused(path, words)
        path.unlink()
    refused(tmp_path, "is no regular file; name one")
    with pytest.raises(StoreError, match="check that the folder exists"):
        Store(tmp_path / "nowhere" / "store.sqlite").writing().__enter__()
    for name in (3, None, b"store"):
        with pytest.raises(InvalidInputError, match="expected the name of a file"):
            Store(name)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The bytes of a store with a trajectory."""
    path = tmp_path_factory.mktemp("content") / "store.sqlite"
    stored(path, compute(task(keep=True)), compute(task(1)), failure(task(2), "out of time"))
    return path.read_bytes()


def read(path):
    store = Store(path)
    store.meta()
    frame = store.frame()
    for key in frame["key"]:
        store.trajectory(key)
    summarise(frame)


def test_a_truncated_or_changed_store_is_refused_and_no_traceback(path, content):
    for share in (0.001, 0.02, 0.3, 0.6, 0.9, 0.999):
        before = content[: int(share * len(content))]
        path.write_bytes(before)
        words = r"damaged or truncated|no SQLite file"
        with pytest.raises(StoreError, match=words), Store(path).writing():
            pass
        assert path.read_bytes() == before
    path.write_bytes(content)
    read(path)
    generator, damaged = np.random.default_rng(0), 0
    used = np.flatnonzero(np.frombuffer(content, np.uint8))  # pages are mostly zeros
    for _ in range(30):
        changed = bytearray(content)
        for place in generator.choice(used, 2):
            changed[place] ^= int(generator.integers(1, 256))
        path.write_bytes(changed)
        try:
            read(path)
        except StoreError as error:
            damaged += str(path) in str(error)
    assert damaged > 10


def test_damage_is_named_with_the_remedy(path, content):
    for command in (
        "UPDATE cells SET rmse_states = '[1,'", "UPDATE cells SET seed = 'x'",
        "UPDATE cells SET times = x'00'", "UPDATE cells SET rmse = 'much'",
        "UPDATE cells SET reason = CAST(x'ff' AS TEXT)", "UPDATE studies SET settings = '{}'",
        "UPDATE studies SET settings = NULL", "UPDATE environments SET settings = '['",
        "UPDATE trajectories SET content = '{}'", "DROP TABLE studies",
    ):
        path.write_bytes(content)
        change(path, command)
        with pytest.raises(StoreError, match=r"store\.sqlite: it is damaged .* an earlier copy"):
            read(path)


def test_an_empty_file_is_a_new_store_and_two_studies_may_write(path):
    path.touch()
    with pytest.raises(StoreError, match="is empty: no study"):
        Store(path).frame()
    store = stored(path, compute(task()))
    with store.writing() as one, store.writing() as other:
        one.put(compute(task(1)))
        other.put(compute(task(2)))
        one.put(compute(task(2)))
        assert list(store.frame()["seed"]) == [0, 1, 2]
    assert list(path.parent.iterdir()) == [path]


def test_a_store_that_cannot_be_written_for_now_loses_nothing(path, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    store, result = stored(path, compute(task())), compute(task(1))
    with closing(sqlite3.connect(path, isolation_level=None)) as other, store.writing() as writer:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="another program has locked it"):
            writer.put(result)
        other.execute("ROLLBACK")
        writer.put(result)
    plain = module._connect
    monkeypatch.setattr(
        module, "_connect",
        lambda path, mode: plain(path, "ro" if path.suffix == ".sqlite" else mode),
    )
    with pytest.raises(StoreError, match="make file and folder writable"), store.writing() as one:
        one.put(compute(task(2)))
    monkeypatch.undo()
    assert len(store.frame()) == 2


def test_an_export_brings_everything_back(tmp_path):
    store = stored(
        tmp_path / "store.sqlite", compute(task(parts=(*BOTH, "covariance"))),
        compute(task(1, qps=None)), compute(task(2, parts=["accuracy"])),
        failure(task(3), "one, two\n\"three\""),
    )
    frame = store.frame()
    empty = {name: [""] for name in frame if name not in ("reason", "reasons")}
    csv = pd.read_csv(export(store, tmp_path / "cells.csv"), keep_default_na=False, na_values=empty)
    parquet = pd.read_parquet(export(store, tmp_path / "cells.parquet"))
    for back, texts in (
        (csv, ("reasons", "rmse_states", "rmse_settled_states", "times")), (parquet, ("reasons",))
    ):
        for name in texts:
            back[name] = [json.loads(text) if isinstance(text, str) and text else None
                          for text in back[name]]
        assert list(back) == list(frame)
        assert back.pop("environment").str.startswith("qpmhe ").all()
        for name in back:
            for one, other in zip(frame[name], back[name], strict=True):
                if isinstance(one, (list, np.ndarray)):
                    same = np.float32 if name == "times" else np.float64
                    np.testing.assert_array_equal(np.asarray(one), np.asarray(other, same))
                elif one is None or (not isinstance(one, dict) and pd.isna(one)):
                    assert other is None or pd.isna(other), name
                else:
                    assert one == other, name


def test_an_export_that_cannot_be_made_is_reported(tmp_path, monkeypatch):
    store = stored(tmp_path / "store.sqlite", compute(task()))
    with pytest.raises(OptionError, match=r"expected a name in \.csv, \.parquet or \.tex"):
        export(store, tmp_path / "cells.xlsx")
    for kind in ("csv", "parquet", "tex"):
        with pytest.raises(InvalidInputError, match="cannot write"):
            export(store, tmp_path / "nowhere" / f"cells.{kind}")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InvalidInputError, match=r"needs pyarrow.*pip install 'qpmhe\[studies\]'"):
        export(store, tmp_path / "cells.parquet")
