"""Models whose files change between two studies."""

import hashlib
import sys
from dataclasses import replace

import numpy as np
import pytest

from qpmhe.errors import ModelError, QpmheError
from qpmhe.models.loading import find, fingerprint, load, module_file
from qpmhe.studies import StoreError, Study, run
from qpmhe.studies.cell import Task, compute

OWN = "from qpmhe.models import batch_reactor\n\ndef make():\n    return batch_reactor({})\n"
HELPER = "method = {!r}\n"
SMALL = {"backends": ["banded"], "qps": [1], "seeds": 1, "steps": 12}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("changing", "changing_package"):
            del sys.modules[name]


def package(folder, method="euler"):
    inside = folder / "changing_package"
    (inside / "deep").mkdir(parents=True, exist_ok=True)
    for place in (inside, inside / "deep"):
        (place / "__init__.py").touch()
    (inside / "model.py").write_text(
        "from .middle import method\n" + OWN.format("method=method")
    )
    (inside / "middle.py").write_text("from changing_package.deep.method import method\n")
    (inside / "deep" / "method.py").write_text(HELPER.format(method))
    return "changing_package.model:make"


def alone(folder, method="euler"):
    (folder / "changing.py").write_text(OWN.format(f"method={method!r}"))
    return "changing:make"


def of_file(folder, method="euler"):
    (folder / "sub").mkdir(exist_ok=True)
    alone(folder / "sub", method)
    return "sub/changing.py:make"


@pytest.mark.parametrize("write", [package, alone, of_file])
def test_figures_of_the_old_file_are_not_shown_for_the_new_one(here, write):
    model = write(here)
    study = Study(models=[model], **SMALL)
    (old,) = run(study, here / "old.sqlite", progress=False).frame()["rmse"]
    write(here, "rk4")
    study = Study(models=[model], **SMALL)
    with pytest.raises(StoreError, match="has changed since"):
        run(study, here / "old.sqlite", progress=False)
    (new,) = run(study, here / "new.sqlite", progress=False).frame()["rmse"]
    (rk4,) = run(
        Study(models=["batch_reactor(method='rk4')"], **SMALL), here / "rk4.sqlite",
        progress=False,
    ).frame()["rmse"]
    assert new == rk4 != old
    write(here)
    study = Study(models=[model], **SMALL)
    assert list(run(study, here / "old.sqlite", progress=False).frame()["rmse"]) == [old]


@pytest.mark.parametrize("write", [package, alone, of_file])
def test_a_process_that_has_imported_the_old_file_imports_the_new_one(here, write):
    def matrix(model):
        return load(find(model)).system.f(np.array([3.0, 1.0]), None)

    old = matrix(write(here))
    new = matrix(write(here, "rk4"))
    assert not np.array_equal(old, new)
    np.testing.assert_array_equal(new, matrix("batch_reactor(method='rk4')"))


@pytest.mark.parametrize("write", [package, alone, of_file])
def test_a_worker_with_another_file_does_not_run_it(here, write):
    study = Study(models=[write(here)], **SMALL)
    (cell,) = study.cells()
    source = study.sources[0]
    task = Task(cell, source, frozenset({"accuracy"}), 60.0)
    assert compute(task)["outcome"] == "done"
    other = replace(task, source=replace(source, fingerprint="0" * 16))
    row = compute(other)
    assert row["outcome"] == "failed"
    assert "is another here than where the study was started" in row["reason"]


def test_what_a_fingerprint_covers(here):
    package(here)
    inside = here / "changing_package"
    first = fingerprint(inside / "model.py")
    (inside / "unused.py").write_text("method = 3\n")
    assert fingerprint(inside / "model.py") == first
    (inside / "model.py").write_text((inside / "model.py").read_text() + "from . import unused\n")
    second = fingerprint(inside / "model.py")
    (inside / "unused.py").write_text("method = 4\nimport elsewhere, numpy\nfrom .... import x\n")
    third = fingerprint(inside / "model.py")
    (here / "elsewhere.py").write_text("")
    assert len({first, second, third}) == 3
    assert fingerprint(inside / "model.py") == third
    # A file that imports none of its neighbours goes by its own bytes, as in older stores.
    for text in (OWN, "def make(:", "\0"):
        lone = here / "lone.py"
        lone.write_text(text)
        assert fingerprint(lone) == hashlib.sha256(text.encode()).hexdigest()[:16]


def test_modules_without_a_file_of_their_own(here):
    for place in ("sys", "no.such.module", "changing.nothing"):
        assert module_file(place) is None
    (here / "changing.py").write_text("raise RuntimeError\n")
    assert module_file("changing.nothing") is None
    assert module_file("changing") == (here / "changing.py").resolve()
    assert find("batch_reactor").fingerprint == ""
    with pytest.raises(ModelError, match=r"cannot import sys\.no"):
        load(find("sys.no:make"))
    with pytest.raises(QpmheError, match="changing"):
        find("changing.py/x.py:make")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (OWN.format(""), r"names no function; expected tanks\.py:make\."),
        ("def _helper(): pass\ndef needy(a): pass\n", "has no function without arguments"),
        ("def open(:", r"expected tanks\.py:function\."),
    ],
)
def test_a_file_without_a_function_is_answered_by_its_functions(here, code, words):
    (here / "tanks.py").write_text(code)
    with pytest.raises(ModelError, match=words):
        find("tanks.py")


@pytest.mark.parametrize("name", ["changing.py:make", "changing:make"])
def test_what_a_function_raises_has_file_and_line(here, name):
    (here / "changing.py").write_text('def make():\n    raise RuntimeError("boom")\n')
    words = r"changing\.py, line 2: model '.*' cannot be made: RuntimeError: boom\."
    with pytest.raises(ModelError, match=words):
        load(find(name))
