"""What a study consists of, from Python and from files, and models whose files change."""

import re
import sys
from dataclasses import replace

import pytest

from qpmhe.errors import BackendError, ModelError, OptionError
from qpmhe.studies import StoreError, Study, StudyError, run
from qpmhe.studies.cell import Task, compute
from qpmhe_solvers import available, backend

ODD = "tests/studies/odd_models.py"
OWN = "from qpmhe.models import batch_reactor\n\ndef make():\n    return batch_reactor(method)\n"
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


def test_the_defaults_are_all_native_backends_and_cells_that_would_be_the_same_are_one():
    study = Study()
    assert study.backends == tuple(name for name in available() if ":" not in name)
    capped = sum(backend(name).iteration_cap for name in study.backends)
    cells = study.cells()
    # One observer; four other numbers of QPs; five caps where there are caps.
    assert len(cells) == 20 * (1 + 4 * (5 * capped + len(study.backends) - capped))
    assert len({cell.key for cell in cells}) == len(set(cells)) == len(cells)

    def keys(**options):
        return [cell.key for cell in Study(**options).cells()]

    assert keys(backends=["banded"], solver_iterations=[1, 5], seeds=1, qps=[1]) == [
        "batch_reactor/banded/i=1/cap=none/N=10/candidate/T=150/seed=0"
    ]
    assert keys(backends=["osqp", "auto"], qps=[0], starts=["candidate", "best"], seeds=1) == [
        "batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0"
    ]
    # Single values stand for lists, and any iterable is one.
    assert len(keys(backends=["osqp"] * 2, qps=2, horizons=[None, 10], starts="best",
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
    assert [cell.seed for cell in cells[:: len(cells) // 3]] == [0, 1, 2]


def test_what_does_not_fit_is_refused_in_a_file_with_its_line(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "osqp", None)
    for error, name, value, words in (
        (ModelError, "models", ["chain_of_masses(masses=open)"], "plain values by keyword"),
        (ModelError, "models", ["chain_of_masses(masses=0)"], "masses is 0"),
        (ModelError, "models", [f"{ODD}:cannot_be_made"], "no such reactor"),
        (ModelError, "models", [f"{ODD}:three_parts"], "expected (system, observer, cost"),
        (BackendError, "backends", ["osqp"], "'osqp' is not installed; pip install osqp"),
        (OptionError, "qps", [1.5], "qps is 1.5"), (OptionError, "seeds", [-1], "seeds is -1"),
        (OptionError, "seeds", 1.5, "seeds is 1.5; expected an integer >= 1"),
        (OptionError, "seed", 1, "Did you mean seeds?"),
    ):
        with pytest.raises(error, match=re.escape(words)):
            Study(**{name: value})
    monkeypatch.undo()
    path = tmp_path / "study.toml"
    with pytest.raises(StudyError, match="cannot read"):
        Study.from_toml(path)
    for old, new, line, words in (
        ("seeds = 3", "sedes = 3", 13, "unknown key 'sedes'; expected some of models, records"),
        ('"batch_reactor"', '"batch_reactr"', 2, "expected one of batch_reactor"),
        ('"osqp"', '"osq"', 6, "backend 'osq' is not known; expected one of auto"),
        ('"none"', '"converged"', 7, '\'converged\'; expected an integer >= 0. "none"'),
        ('"best"', '"bets"', 12, "starts is 'bets'"), ('"time"', '"fast"', 15, "measure is 'fast'"),
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
    yield tmp_path
    for name in [one for one in sys.modules if one.startswith("changing_package")]:
        del sys.modules[name]


def write(folder, method="euler"):
    """A package whose model depends on a file of its own, by way of another one."""
    inside = folder / "changing_package"
    (inside / "deep").mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("__init__", ""), ("model", "from .middle import method\n" + OWN), ("deep/__init__", ""),
        ("middle", "from changing_package.deep.method import method\n"),
        ("deep/method", f"method = {method!r}\n"),
    ):
        (inside / f"{name}.py").write_text(text)
    return "changing_package.model:make"


@pytest.mark.slow
def test_figures_of_the_old_file_are_not_shown_for_the_new_one(here):
    def rmse(model, name):
        study = Study(models=[model], **SMALL)
        return run(study, here / name, jobs=1, progress=False).frame()["rmse"].tolist()

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
    assert row.outcome == "failed"
    assert "differs from the one that the study was started with" in row.reason
    write(here)
    assert rmse(model, "old.sqlite") == old


def test_a_study_file_names_models_and_calls_no_other_function(monkeypatch, tmp_path):
    (tmp_path / "study").mkdir()
    (tmp_path / "packages").mkdir()
    mark = tmp_path / "mark"
    (tmp_path / "packages" / "some_models.py").write_text(
        "from pathlib import Path\nimport qpmhe\nfrom qpmhe.models import Example, batch_reactor\n"
        "def make() -> Example:\n    return batch_reactor()\n"
        "def parts() -> 'tuple[qpmhe.System, qpmhe.Observer, qpmhe.Cost, qpmhe.models.Scenario]':\n"
        "    return batch_reactor()\n"
        "def touch(path):\n    Path(path).touch()\n    return batch_reactor()\n"
        "def said(path) -> str:\n    Path(path).touch()\n"
        "def unknown(path) -> 'Nowhere':\n    Path(path).touch()\n"
        "class Maker:\n    def __init__(self, path) -> None:\n        Path(path).touch()\n"
    )
    monkeypatch.syspath_prepend(tmp_path / "packages")
    for place in ("study/beside.py", "above.py"):
        (tmp_path / place).write_text(
            "from qpmhe.models import batch_reactor\nfrom some_models import touch\n"
            "def make():\n    return batch_reactor()\n"
        )
    file = tmp_path / "study" / "study.toml"

    def read(model):
        file.write_text(f'models = ["{model}"]\nbackends = ["banded"]\n')
        return Study.from_toml(file)

    given = f"(path='{mark}')"
    for model, words in (
        ("os:mkfifo" + given, "standard library"), ("pathlib:Path.touch" + given, "models has|the"),
        (f"shutil:copy(src='{file}', dst='{mark}')", "standard library"),
        ("some_models:touch" + given, r"as in def touch\(...\) -> qpmhe.models.Example"),
        ("some_models:said" + given, "annotate it"),
        ("some_models:unknown" + given, "annotate it"),
        ("some_models:Maker" + given, "annotate it"),
        ("beside.py:touch" + given, "beside.py does not define touch itself"),
        ("../above.py:make", "outside of the study's folder"),
        (f"{tmp_path / 'above.py'}:make", "outside of the study's folder"),
    ):
        with pytest.raises(StudyError, match=words) as caught:
            read(model)
        assert f"{file}, line 1:" in str(caught.value)
        assert not mark.exists()
    for model in ("batch_reactor", "beside.py:make", "some_models:make", "some_models:parts"):
        assert len(read(model).sources) == 1
    # In Python the caller names the function.
    assert len(Study(models=["some_models:touch" + given], backends=["banded"]).sources) == 1
    assert mark.exists()
