"""What a study consists of, from Python and from files, and models whose files change."""

import hashlib
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from qpmhe.errors import BackendError, InvalidInputError, ModelError, OptionError
from qpmhe.models.loading import find, fingerprint, load, module_file
from qpmhe.studies import StoreError, Study, StudyError, run
from qpmhe.studies.cell import Task, compute
from qpmhe_solvers import available, backend

ODD = "tests/studies/odd_models.py"
OWN = "from qpmhe.models import batch_reactor\n\ndef make():\n    return batch_reactor({})\n"
SMALL = {"backends": ["banded"], "qps": [1], "seeds": 1, "steps": 12}
GOOD = """\
# every option
models = [
  "batch_reactor",
  "chain_of_masses(masses=1)",
]
backends = ["daqp", "osqp"]
qps = [0, 2,
       "none"]
solver_iterations = [5, "none"]
horizons = ["default", 4]
noise_levels = [1, 0.5]
starts = ["best"]
seeds = 3
steps = 20
measure = "time"
deadline = 0.01
covariances = true
cell_timeout = 5
"""


def test_the_defaults_are_all_native_backends_on_the_reactor():
    study = Study()
    assert study.backends == tuple(name for name in available() if ":" not in name)
    capped = sum(backend(name).iteration_cap for name in study.backends)
    cells = study.cells()
    # One observer; four other numbers of QPs; five caps where there are caps.
    assert len(cells) == 20 * (1 + 4 * (5 * capped + len(study.backends) - capped))
    assert len({cell.key for cell in cells}) == len(set(cells)) == len(cells)


def test_cells_that_would_be_the_same_are_one():
    def keys(**options):
        return [cell.key for cell in Study(**options).cells()]

    assert keys(backends=["banded"], solver_iterations=[1, 5], seeds=1, qps=[1]) == [
        "batch_reactor/banded/i=1/cap=none/N=10/candidate/T=150/seed=0"
    ]
    assert keys(backends=["osqp", "auto"], qps=[0], starts=["candidate", "best"], seeds=1) == [
        "batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0"
    ]
    # Single values stand for lists, and any iterable is one.
    assert len(keys(models="batch_reactor", backends=["osqp"] * 2, qps=2, horizons=[None, 10],
                    starts="best", solver_iterations=None, seeds=range(1, 3), noise_levels=2)) == 2


def test_a_file_is_the_same_study_as_in_python_and_the_product_of_its_lists(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(GOOD)
    study = Study.from_toml(path)
    assert study == Study(
        models=["batch_reactor", "chain_of_masses( masses = 1 )"], backends=["daqp", "osqp"],
        qps=[0, 2, None], solver_iterations=[5, None], horizons=[None, 4], starts=["best"],
        seeds=3, steps=20, measure="time", deadline=0.01, covariances=True, cell_timeout=5.0,
        noise_levels=[1, 0.5],
    )
    cells = study.cells()
    # The observer, and two backends with two caps at i = 2 and converged; daqp has a cap, too.
    assert len(cells) == 3 * 2 * 2 * 2 * (1 + 2 * 2 * 2)
    assert {cell.horizon for cell in cells if cell.model == "batch_reactor"} == {4, 10}
    assert {cell.steps for cell in cells} == {20}
    assert [cell.seed for cell in cells[:: len(cells) // 3]] == [0, 1, 2]
    path.write_text("seeds = 20\n")
    assert Study.from_toml(path) == Study()


def test_what_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "osqp", None)
    for error, name, value, words in (
        (StudyError, "models", [], "models is empty"),
        (StudyError, "models", [3], "models has 3; expected the name"),
        (ModelError, "models", ["chain_of_masses(masses=open)"], "plain values by keyword"),
        (ModelError, "models", ["chain_of_masses(masses=0)"], "masses is 0"),
        (ModelError, "models", ["no.such.module:make"], "cannot import no.such.module"),
        (ModelError, "models", [f"{ODD}:missing"], "missing"),
        (ModelError, "models", [f"{ODD}:not_callable"], "not_callable"),
        (ModelError, "models", [f"{ODD}:cannot_be_made"], "no such reactor"),
        (ModelError, "models", [f"{ODD}:three_parts"], "expected (system, observer, cost"),
        (ModelError, "models", [f"{ODD}:wrong_part"], "for its cost"),
        (StudyError, "backends", [], "backends is empty"),
        (BackendError, "backends", ["osqp"], "'osqp' is not installed; pip install osqp"),
        (OptionError, "qps", [1.5], "qps is 1.5"),
        (OptionError, "noise_levels", [0.0], "noise_levels is 0.0"),
        (OptionError, "seeds", [-1], "seeds is -1"),
        (OptionError, "covariances", 1, "covariances is 1"),
        (OptionError, "cell_timeout", float("inf"), "cell_timeout is inf"),
        (StudyError, "folder", 3, "folder is 3"),
        (OptionError, "seed", 1, "Did you mean seeds?"),
    ):
        with pytest.raises(error, match=re.escape(words)):
            Study(**{name: value})


def test_what_does_not_fit_in_a_file_has_its_line(tmp_path):
    path = tmp_path / "study.toml"
    with pytest.raises(StudyError, match="cannot read"):
        Study.from_toml(path)
    for old, new, line, words in (
        ("seeds = 3", "sedes = 3", 13, "unknown key 'sedes'; expected some of models, records"),
        ("# every option", "[study]", 1, "unknown key 'study'"),
        ('"batch_reactor"', '"batch_reactr"', 2, "expected one of batch_reactor"),
        ("masses=1", "mases=1", 2, "mases"),
        ('"osqp"', '"osq"', 6, "backend 'osq' is not known; expected one of auto"),
        ('"none"', '"converged"', 7, '\'converged\'; expected an integer >= 0. "none"'),
        ("[5, ", "[5, 0, ", 9, "solver_iterations is 0"),
        ('"default"', '"converged"', 10, "horizons is 'converged'"),
        ('"best"', '"bets"', 12, "starts is 'bets'"),
        ("steps = 20", "steps = 2.5", 14, "steps is 2.5"),
        ('"time"', '"speed"', 15, "measure is 'speed'"),
        ("seeds = 3", "seeds 3", None, "no valid TOML"),
        (GOOD, "# seeds = 3\n", None, "is empty; name at least one of models"),
        (GOOD, "\udcff", None, "no text in UTF-8"),
    ):
        path.write_text(GOOD.replace(old, new), errors="surrogateescape")
        with pytest.raises(StudyError, match=re.escape(words)) as caught:
            Study.from_toml(path)
        assert str(path) + (f", line {line}:" if line else "") in str(caught.value)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [item for item in sys.path if item])
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
    (inside / "deep" / "method.py").write_text(f"method = {method!r}\n")
    return "changing_package.model:make"


def alone(folder, method="euler"):
    (folder / "changing.py").write_text(OWN.format(f"method={method!r}"))
    return "changing:make"


def of_file(folder, method="euler"):
    (folder / "sub").mkdir(exist_ok=True)
    alone(folder / "sub", method)
    (folder / "study.toml").write_text('models = ["sub/changing.py:make"]\nseeds = 1\n')
    assert {cell.model for cell in Study.from_toml(folder / "study.toml").cells()} == {
        "sub/changing.py:make"
    }
    return "sub/changing.py:make"


@pytest.mark.parametrize("write", [package, alone, of_file])
def test_figures_of_the_old_file_are_not_shown_for_the_new_one(here, write):
    def rmse(model, name):
        return run(Study(models=[model], **SMALL), here / name, jobs=1, progress=False).frame()[
            "rmse"].tolist()

    model = write(here)
    old, source = rmse(model, "old.sqlite"), Study(models=[model], **SMALL).sources[0]
    write(here, "rk4")
    with pytest.raises(StoreError, match="has changed since"):
        rmse(model, "old.sqlite")
    # This process has imported the old file, and imports the new one.
    assert rmse(model, "new.sqlite") == rmse("batch_reactor(method='rk4')", "rk4.sqlite") != old
    (cell,) = Study(models=[model], **SMALL).cells()
    other = replace(source, model=replace(source.model, fingerprint="0" * 16))
    row = compute(Task(cell, other, frozenset({"accuracy"}), 60.0))  # a worker with another file
    assert row["outcome"] == "failed"
    assert "differs from the one that the study was started with" in row["reason"]
    write(here)
    assert rmse(model, "old.sqlite") == old


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


def test_arguments_of_a_model_in_a_file_and_messages_about_it(here):
    (here / "mine.py").write_text(
        "from qpmhe.models import batch_reactor\n"
        "def make(method='euler'):\n    return batch_reactor(method)\n"
    )
    name = "mine.py:make(method='rk4')"
    source = replace(Study(models=[name], **SMALL).sources[0].model, name=name)
    values = [load(one).system.f(np.array([3.0, 1.0]), None)
              for one in (source, find("batch_reactor(method='rk4')"))]
    np.testing.assert_array_equal(*values)
    boom = 'def make():\n    raise RuntimeError("boom")\n'
    place = r"changing\.py, line 2: model '.*' cannot be made: RuntimeError: boom\."
    for name, code, words in (
        ("tanks.py", OWN.format(""), r"names no function; expected tanks\.py:make\."),
        ("tanks.py", "def _helper(): pass\ndef needy(a): pass\n", "no function without arguments"),
        ("tanks.py", "def open(:", r"expected tanks\.py:function\."),
        ("changing.py:make", boom, place), ("changing:make", boom, place),
        ("sys.no:make", "", r"cannot import sys\.no"), ("changing.py/x.py:make", boom, "changing"),
    ):
        file = re.sub(r"(\.py)?(/x\.py)?(:make)?$", ".py", name, count=1)
        (here / file).write_text(code)
        with pytest.raises(InvalidInputError, match=words):
            load(find(name))
    for place in ("sys", "no.such.module", "changing.nothing"):
        assert module_file(place) is None
    assert module_file("changing") == (here / "changing.py").resolve()
