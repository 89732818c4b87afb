"""What a study consists of, from Python and from files, and models whose files change."""

import hashlib
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from qpmhe.errors import BackendError, InvalidInputError, ModelError, OptionError, QpmheError
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


def keys(**options):
    return [cell.key for cell in Study(**options).cells()]


def test_the_defaults_are_all_native_backends_on_the_reactor():
    study = Study()
    assert study.backends == tuple(name for name in available() if ":" not in name)
    capped = sum(backend(name).iteration_cap for name in study.backends)
    cells = study.cells()
    # One observer; four other numbers of QPs; five caps where there are caps.
    assert len(cells) == 20 * (1 + 4 * (5 * capped + len(study.backends) - capped))
    assert len({cell.key for cell in cells}) == len(set(cells)) == len(cells)


def test_cells_that_would_be_the_same_are_one():
    assert keys(backends=["banded"], solver_iterations=[1, 5], seeds=1, qps=[1]) == [
        "batch_reactor/banded/i=1/cap=none/N=10/candidate/T=150/seed=0"
    ]
    assert keys(backends=["osqp", "auto"], qps=[0], starts=["candidate", "best"], seeds=1) == [
        "batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0"
    ]
    assert len(keys(backends=["osqp"] * 2, horizons=[None, 10, 10], qps=[1, 1], seeds=[3, 3],
                    solver_iterations=[2], models=["batch_reactor"] * 2)) == 1
    # Single values stand for lists, and any iterable is one.
    assert len(keys(models="batch_reactor", backends="osqp", qps=2, horizons=4, starts="best",
                    solver_iterations=None, seeds=range(1, 3), noise_levels=2)) == 2


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


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"models": []}, StudyError, "models is empty"),
        ({"models": [3]}, StudyError, "models has 3; expected the name"),
        ({"models": ["chain_of_masses(2)"]}, ModelError, "plain values by keyword"),
        ({"models": ["chain_of_masses(masses=open)"]}, ModelError, "plain values"),
        ({"models": ["chain_of_masses(masses=0)"]}, ModelError, "masses is 0"),
        ({"models": ["no.such.module:make"]}, ModelError, "cannot import no.such.module"),
        ({"models": [f"{ODD}:missing"]}, ModelError, "missing"),
        ({"models": [f"{ODD}:not_callable"]}, ModelError, "not_callable"),
        ({"models": [f"{ODD}:cannot_be_made"]}, ModelError, "no such reactor"),
        ({"models": [f"{ODD}:three_parts"]}, ModelError, "expected (system, observer, cost"),
        ({"models": [f"{ODD}:wrong_part"]}, ModelError, "for its cost"),
        ({"backends": []}, StudyError, "backends is empty"),
        ({"qps": [1.5]}, OptionError, "qps is 1.5"),
        ({"horizons": [2.0]}, OptionError, "horizons is 2.0"),
        ({"noise_levels": [0.0]}, OptionError, "noise_levels is 0.0"),
        ({"noise_levels": []}, StudyError, "noise_levels is empty"),
        ({"seeds": [-1]}, OptionError, "seeds is -1"),
        ({"covariances": 1}, OptionError, "covariances is 1"),
        ({"cell_timeout": float("inf")}, OptionError, "cell_timeout is inf"),
        ({"folder": 3}, StudyError, "folder is 3"),
        ({"seed": 1}, OptionError, "Did you mean seeds?"),
    ],
)
def test_what_does_not_fit_is_refused(options, error, words):
    with pytest.raises(error, match=re.escape(words)) as caught:
        Study(**options)
    assert isinstance(caught.value, QpmheError)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seeds = 3", "sedes = 3", "unknown key 'sedes'; expected some of models, records"),
        ("# every option", "[study]", "unknown key 'study'"),
        ('"batch_reactor"', '"batch_reactr"', "expected one of batch_reactor"),
        ("masses=1", "mases=1", "mases"),
        ('"osqp"', '"osq"', "backend 'osq' is not known; expected one of auto"),
        ('"none"', '"converged"', '\'converged\'; expected an integer >= 0. "none"'),
        ("[5, ", "[5, 0, ", "solver_iterations is 0"),
        ('"default"', '"converged"', "horizons is 'converged'"),
        ('"best"', '"bets"', "starts is 'bets'"),
        ("steps = 20", "steps = 2.5", "steps is 2.5"),
        ('"time"', '"speed"', "measure is 'speed'"),
        ("deadline = 0.01", "deadline = -1", "deadline is -1"),
        ("seeds = 3", "seeds 3", "no valid TOML"),
    ],
)
def test_what_does_not_fit_in_a_file_has_its_line(tmp_path, old, new, words):
    text, path = GOOD.replace(old, new), tmp_path / "study.toml"
    path.write_text(text)
    with pytest.raises(StudyError, match=re.escape(words)) as caught:
        Study.from_toml(path)
    assert str(path) in str(caught.value)
    if "TOML" not in words:  # of a list over several lines, the line of its key
        lines = text.splitlines()
        wrong = next(k for k, line in enumerate(GOOD.splitlines()) if old in line)
        while not re.match(r"\w+ =|\[", lines[wrong]):
            wrong -= 1
        assert f", line {wrong + 1}:" in str(caught.value)


def test_files_that_hold_no_study_are_refused(tmp_path):
    path = tmp_path / "study.toml"
    for content, words in ((None, "cannot read"), (b"\xff\xfe\x00", "no text in UTF-8"),
                           (b"# seeds = 3\n", "is empty; name at least one of models")):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(StudyError, match=words):
            Study.from_toml(path)


def test_a_backend_that_is_not_installed_is_refused_by_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "osqp", None)
    with pytest.raises(BackendError, match="'osqp' is not installed; pip install osqp"):
        Study(backends=["osqp"])


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


def test_modules_without_a_file_of_their_own(here):
    (here / "changing.py").write_text("raise RuntimeError\n")
    for place in ("sys", "no.such.module", "changing.nothing"):
        assert module_file(place) is None
    assert module_file("changing") == (here / "changing.py").resolve()
    with pytest.raises(ModelError, match=r"cannot import sys\.no"):
        load(find("sys.no:make"))
    with pytest.raises(QpmheError, match="changing"):
        find("changing.py/x.py:make")


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("tanks.py", OWN.format(""), r"names no function; expected tanks\.py:make\."),
        ("tanks.py", "def _helper(): pass\ndef needy(a): pass\n",
         "has no function without arguments"),
        ("tanks.py", "def open(:", r"expected tanks\.py:function\."),
        ("changing.py:make", 'def make():\n    raise RuntimeError("boom")\n',
         r"changing\.py, line 2: model '.*' cannot be made: RuntimeError: boom\."),
        ("changing:make", 'def make():\n    raise RuntimeError("boom")\n',
         r"changing\.py, line 2: model '.*' cannot be made: RuntimeError: boom\."),
    ],
)
def test_messages_about_a_model_s_file(here, name, code, words):
    (here / re.sub(r"(\.py)?(:make)?$", ".py", name, count=1)).write_text(code)
    with pytest.raises(InvalidInputError, match=words):
        load(find(name))


def test_arguments_of_a_model_in_a_file(here):
    (here / "mine.py").write_text(
        "from qpmhe.models import batch_reactor\n"
        "def make(method='euler'):\n    return batch_reactor(method)\n"
    )
    name = "mine.py:make(method='rk4')"
    source = replace(Study(models=[name], **SMALL).sources[0].model, name=name)
    value = load(source).system.f(np.array([3.0, 1.0]), None)
    zoo = load(find("batch_reactor(method='rk4')")).system.f(np.array([3.0, 1.0]), None)
    np.testing.assert_array_equal(value, zoo)
