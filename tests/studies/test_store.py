import json
import os
import sqlite3
from contextlib import closing, suppress

import numpy as np
import pandas as pd
import pytest

from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.models.loading import find
from qpmhe.studies import Store, StoreError, Study, export, summarise
from qpmhe.studies import store as module
from qpmhe.studies.cell import Cell, Task, compute, failure

SETTINGS = Study(backends=["banded"], deadline=1e-6).settings()
BOTH = ("accuracy", "time")


def task(seed=0, parts=BOTH, qps=1, **options):
    cell = Cell("batch_reactor", "banded", qps, None, 10, "candidate", seed, 12)
    return Task(cell, find("batch_reactor"), frozenset(parts), 60.0, **options)


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
        if name in ("environment", "finished", "parts"):
            continue
        if name == "times":
            np.testing.assert_array_equal(row[name], result[name])
        elif name == "solver_iterations":
            assert pd.isna(row[name])
        else:
            np.testing.assert_equal(row[name], result[name], name)
    assert row["late"] == 1.0  # the deadline is a microsecond
    assert pd.isna(frame["qps"].iloc[1])
    assert np.isnan(frame["nees"].iloc[1])
    assert str(frame["qps"].dtype) == str(frame["solver_iterations"].dtype) == "Int64"
    found = store.trajectory(result["key"])
    for name in ("times", "states", "estimates"):
        np.testing.assert_array_equal(found.pop(name), result["trajectory"].pop(name))
    assert found == result["trajectory"]
    assert store.trajectory("no such key") is None


def test_meta_tells_settings_and_environments(path):
    result = compute(task())
    other = {**compute(task(1)), "environment": {**result["environment"], "cpu": "abacus"}}
    store = stored(path, result, other, compute(task(2)))
    meta = store.meta()
    assert meta["study"] == SETTINGS
    assert meta["schema"] == module.SCHEMA
    assert meta["environments"] == [result["environment"], other["environment"]]
    assert list(store.frame()["environment"]) == [0, 1, 0]
    stored(path, settings={**SETTINGS, "deadline": None})
    assert [item["deadline"] for item in store.meta()["studies"]] == [1e-6, None]
    assert store.frame()["late"].isna().all()


def test_parts_that_are_measured_later_are_added(path):
    accurate, timed = compute(task(parts=["accuracy"])), compute(task(shared=True))
    store = stored(path, accurate)
    before = store.frame().iloc[0]
    assert before["times"] is None
    assert np.isnan(before["time_median"])
    assert not before["shared"]
    stored(path, timed)
    (row,) = store.frame().to_dict("records")
    assert row["cost_ratio"] == accurate["cost_ratio"]
    assert row["time_median"] == timed["time_median"]
    assert row["shared"]
    # A failure takes nothing away from what is there.
    stored(path, failure(task(parts=(*BOTH, "covariance")), "too late"))
    (after,) = store.frame().to_dict("records")
    assert (after["outcome"], after["rmse"]) == ("done", row["rmse"])
    with store.writing() as writer:
        assert writer.present(retry_failed=False) == {row["key"]: frozenset(BOTH)}


def test_a_failure_that_is_mended_is_replaced(path):
    store = stored(path, failure(task(), "died"))
    row = store.frame().iloc[0]
    assert (row["outcome"], row["reason"]) == ("failed", "died")
    assert np.isnan(row["rmse"])
    with store.writing() as writer:
        assert list(writer.present(retry_failed=False)) == [row["key"]]
        assert writer.present(retry_failed=True) == {}
    stored(path, compute(task()))
    (mended,) = store.frame().to_dict("records")
    assert (mended["outcome"], mended["reason"]) == ("done", "")
    assert np.isfinite(mended["rmse"])


def test_a_store_without_rows_is_an_empty_frame(path):
    frame = stored(path).frame()
    assert len(frame) == 0
    assert {"key", "late", "times", "environment"} <= set(frame.columns)


def test_a_model_file_that_changed_is_refused(path):
    store = Store(path)
    with store.writing() as writer:
        writer.begin(SETTINGS, {"mine.py:make": "aaaa"})
    with store.writing() as writer, pytest.raises(StoreError, match="has changed since"):
        writer.begin(SETTINGS, {"mine.py:make": "bbbb"})
    assert len(store.meta()["studies"]) == 1


def refused(path, words):
    """Reading and writing are refused, and the file stays as it is."""
    before = path.read_bytes()
    with pytest.raises(StoreError, match=words):
        Store(path).frame()
    with pytest.raises(StoreError, match=words), Store(path).writing():
        pass
    assert path.read_bytes() == before


def test_a_file_that_is_not_there_is_told_to_readers(path):
    for read in (Store(path).frame, Store(path).meta, lambda: Store(path).trajectory("x")):
        with pytest.raises(StoreError, match="there is no store"):
            read()
    assert not path.exists()


def test_what_is_no_file_is_told_with_the_remedy(path):
    os.mkfifo(path)
    before = sorted(path.parent.iterdir())
    for store in (path, path.parent):
        for use in (Store(store).frame, lambda at=store: Store(at).writing().__enter__()):
            with pytest.raises(StoreError, match="is no regular file; name one"):
                use()
    assert sorted(path.parent.iterdir()) == before


def test_a_file_that_is_no_store_is_refused(path):
    path.write_text("seed,rmse\n" * 100)
    refused(path, "no SQLite file")
    path.unlink()
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE songs (title)")
    connection.close()
    refused(path, "of another program")


def test_a_store_of_another_version_is_refused(path):
    stored(path)
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {module.SCHEMA + 1}")
    connection.close()
    refused(path, f"schema version {module.SCHEMA + 1}; this qpmhe reads")


@pytest.mark.parametrize("share", [0.001, 0.02, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_store_is_refused_and_left_alone(path, share):
    stored(path, *(compute(task(seed, keep=True)) for seed in range(40)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    before = path.read_bytes()
    damaged = r"damaged or truncated|no SQLite file"
    with pytest.raises(StoreError, match=damaged), Store(path).writing():
        pass
    assert path.read_bytes() == before
    path.write_bytes(whole)
    assert len(Store(path).frame()) == 40


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


@pytest.mark.parametrize("seed", range(4))
def test_flipped_bytes_are_no_traceback(path, content, seed):
    generator, damaged = np.random.default_rng(seed), 0
    used = np.flatnonzero(np.frombuffer(content, np.uint8))  # pages are mostly zeros
    for _ in range(60):
        changed = bytearray(content)
        for place in generator.choice(used, 2):
            changed[place] ^= int(generator.integers(1, 256))
        path.write_bytes(changed)
        try:
            read(path)
        except StoreError as error:
            damaged += str(path) in str(error)
    assert damaged > 20


@pytest.mark.parametrize(
    "change",
    [
        "cells SET rmse_states = '[1,'", "cells SET seed = 'x'", "cells SET times = x'00'",
        "cells SET rmse = 'much'", "cells SET reason = CAST(x'ff' AS TEXT)",
        "studies SET settings = '{}'", "studies SET settings = NULL",
        "environments SET settings = '['", "trajectories SET content = '[1,'",
        "trajectories SET content = '{}'",
    ],
)
def test_damage_is_named_with_the_remedy(path, content, change):
    path.write_bytes(content)
    read(path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(f"UPDATE {change}")
    with pytest.raises(StoreError, match=r"store\.sqlite: it is damaged .* take an earlier copy"):
        read(path)


def test_a_table_that_is_not_there_is_damage(path, content):
    path.write_bytes(content)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("DROP TABLE studies")
    with pytest.raises(StoreError, match="damaged"):
        read(path)


def test_an_empty_file_is_a_new_store(path):
    path.touch()
    with pytest.raises(StoreError, match="is empty: no study"):
        Store(path).frame()
    assert len(stored(path, compute(task())).frame()) == 1


def test_two_studies_may_write(path):
    store = stored(path, compute(task()))
    with store.writing() as one, store.writing() as other:
        one.put(compute(task(1)))
        other.put(compute(task(2)))
        one.put(compute(task(2)))
        assert list(store.frame()["seed"]) == [0, 1, 2]
    assert list(path.parent.iterdir()) == [path]


def test_a_store_locked_by_another_program_is_told(path, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    store, result = stored(path, compute(task())), compute(task(1))
    other = sqlite3.connect(path, isolation_level=None)
    try:
        with store.writing() as writer:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(StoreError, match="another program has locked it"):
                writer.put(result)
            other.execute("ROLLBACK")
            writer.put(result)
    finally:
        other.close()
    assert len(store.frame()) == 2


def test_a_store_that_cannot_be_written_is_told(path, monkeypatch):
    store, plain = stored(path, compute(task())), module._connect
    monkeypatch.setattr(
        module, "_connect",
        lambda path, mode: plain(path, "ro" if path.suffix == ".sqlite" else mode),
    )
    with pytest.raises(StoreError, match="make file and folder writable"), store.writing() as one:
        one.put(compute(task(1)))
    monkeypatch.undo()
    assert len(store.frame()) == 1


def test_a_folder_that_is_not_there_is_told(tmp_path):
    store = Store(tmp_path / "nowhere" / "store.sqlite")
    with pytest.raises(StoreError, match="check that the folder exists"), store.writing():
        pass


def test_a_full_disk_loses_nothing_that_is_stored(path):
    store = stored(path)
    results = [compute(task(seed, keep=True)) for seed in range(60)]
    put = 0
    with store.writing() as writer:
        # SQLite's own limit, met with the error of a full disk.
        (pages,) = writer._connection.execute("PRAGMA page_count").fetchone()
        writer._connection.execute(f"PRAGMA max_page_count = {pages + 12}")
        with suppress(StoreError):
            for result in results:
                writer.put(result)
                put += 1
        with pytest.raises(StoreError, match="disk is full"):
            writer.put(results[put])
    assert 0 < put < 60
    assert list(store.frame()["key"]) == [result["key"] for result in results[:put]]
    stored(path, *results[put:])
    assert list(store.frame()["key"]) == [result["key"] for result in results]


@pytest.mark.parametrize("path_given", [3, None, b"store"])
def test_a_store_needs_a_name(path_given):
    with pytest.raises(InvalidInputError, match="expected the name of a file"):
        Store(path_given)


def exported(tmp_path, name):
    store = stored(
        tmp_path / "store.sqlite", compute(task(parts=(*BOTH, "covariance"))),
        compute(task(1, qps=None)), compute(task(2, parts=["accuracy"])),
        failure(task(3), "one, two\n\"three\""),
    )
    return store.frame(), export(store, tmp_path / name)


def assert_same(frame, back):
    assert list(back.columns) == list(frame.columns)
    for name in frame.columns:
        for one, other in zip(frame[name], back[name], strict=True):
            if isinstance(one, (list, np.ndarray)):
                np.testing.assert_array_equal(np.asarray(one), np.asarray(other, np.float32
                                              if name == "times" else np.float64))
            elif one is None or (not isinstance(one, dict) and pd.isna(one)):
                assert other is None or pd.isna(other), name
            else:
                assert one == other, name


def test_csv_brings_everything_back(tmp_path):
    frame, path = exported(tmp_path, "cells.csv")
    back = pd.read_csv(
        path, keep_default_na=False, na_values={
            name: [""] for name in frame.columns if name not in ("reason", "reasons")
        },
    )
    for name in ("reasons", "rmse_states", "rmse_settled_states", "times"):
        back[name] = [json.loads(text) if isinstance(text, str) and text else None
                      for text in back[name]]
    assert_same(frame, back)


def test_parquet_brings_everything_back(tmp_path):
    frame, path = exported(tmp_path, "cells.parquet")
    back = pd.read_parquet(path)
    back["reasons"] = [json.loads(text) if isinstance(text, str) else None
                       for text in back["reasons"]]
    assert_same(frame, back)


def test_an_export_that_cannot_be_made_is_told(tmp_path, monkeypatch):
    store = stored(tmp_path / "store.sqlite", compute(task()))
    with pytest.raises(OptionError, match=r"expected a name in \.csv or \.parquet"):
        export(store, tmp_path / "cells.xlsx")
    for name in ("cells.csv", "cells.parquet"):
        with pytest.raises(InvalidInputError, match="cannot write"):
            export(store, tmp_path / "nowhere" / name)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InvalidInputError, match=r"needs pyarrow.*pip install 'qpmhe\[studies\]'"):
        export(store, tmp_path / "cells.parquet")
