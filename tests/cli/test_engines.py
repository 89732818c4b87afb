"""The engine of command lines, records and studies, whatever the cache holds."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import qpmhe
from qpmhe.cli.app import app
from qpmhe.codegen.compiler import find_compiler
from qpmhe.models.loading import find
from qpmhe.records import CheckpointError, checkpoints, estimate_record
from qpmhe.studies.cell import Task, _estimator
from qpmhe.studies.experiment import Source
from qpmhe.studies.paper import PaperStudy
from qpmhe.studies.row import Cell

pytest.importorskip("casadi")
needed = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
MODEL = """
import casadi, numpy as np, qpmhe

def make(**options):
    x = casadi.SX.sym("x", 2)
    f = casadi.Function("f", [x], [casadi.vertcat(0.9 * x[0] + 0.1 * x[1], 0.8 * x[1])])
    system = qpmhe.from_casadi(f, casadi.Function("h", [x], [x[0]]), compiled=False)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10 * np.eye(2), noise=4.0)
    return system, qpmhe.Luenberger([0.3, 0.1]), cost, {
        "horizon": 4, "initial_state": [0.0, 0.0], "dt": 1.0, **options}

def asks_for_python():
    return make(engine="python")

def with_a_branch():
    system = qpmhe.System(lambda x: [0.9 * x[0], 0.8 * float(x[1])], lambda x: x[:1], n=2, p=1)
    return (system, *make()[1:])
"""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A folder with a model, an empty cache, and the usual "auto"."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    monkeypatch.setenv("COLUMNS", "160")
    Path("model.py").write_text(MODEL)
    return tmp_path


def command(*arguments):
    answer = CliRunner().invoke(app, [str(one) for one in arguments])
    return answer.exit_code, " ".join(answer.output.split())


def record(samples):
    ys = np.random.default_rng(0).standard_normal(samples).round(3)
    Path("record.csv").write_text("\n".join(["t,y1", *(f"{t},{y}" for t, y in enumerate(ys)), ""]))


OPTIONS = {"step_time": False, "checkpoint_every": 5, "checkpoint_seconds": 0.0, "resume": True}


def estimated(out, **options):
    return estimate_record("model.py:make", "record.csv", out, **OPTIONS | options).engine


def identity(out):
    found = checkpoints.load(Path(f"{out}.checkpoint")).identity
    return found["engine"], found["engine at work"]


@needed
def test_a_record_that_resumes_keeps_its_engine(here, monkeypatch):
    record(12)
    assert estimated("first.csv") == "python"
    assert identity("first.csv") == ("auto", "python")
    assert command("compile", "model.py:make")[0] == 0
    assert estimated("second.csv") == "compiled"
    assert identity("second.csv") == ("auto", "compiled")
    record(20)
    # The cache is full for the one, and empty for the other.
    assert estimated("first.csv") == "python"
    assert estimated("whole.csv") == "compiled"
    monkeypatch.setenv("QPMHE_CACHE_DIR", str(here / "another"))
    assert estimated("second.csv") == "compiled"
    assert Path("second.csv").read_bytes() == Path("whole.csv").read_bytes()
    assert identity("second.csv") == ("auto", "compiled")
    assert estimated("third.csv", engine="python", overwrite=True) == "python"
    assert Path("first.csv").read_bytes() == Path("third.csv").read_bytes()
    # Another engine than before only by name, and then it is refused.
    record(30)
    with pytest.raises(CheckpointError, match="engine 'auto', now 'compiled'"):
        estimated("first.csv", engine="compiled")
    monkeypatch.setenv("CC", "/nowhere/cc")
    with (
        pytest.warns(qpmhe.errors.EngineWarning),
        pytest.raises(CheckpointError, match="engine at work 'compiled', now 'python'"),
    ):
        estimated("second.csv")
    assert estimated("first.csv") == "python"


@needed
def test_the_command_says_which_engine_ran_and_compile_what_it_made(here):
    record(12)
    arguments, rows = ("estimate", "model.py:make", "record.csv", "--out"), []
    for name, options, engine in (
        ("one", (), False), ("two", (), True), ("three", ("--engine", "python"), False)
    ):
        code, output = command(*arguments, f"{name}.csv", *options)
        assert code == 0
        assert ("engine compiled" in output) == engine
        rows.append(list(csv.DictReader(Path(f"{name}.csv").read_text().splitlines())))
        code, output = command("compile", "model.py:with_a_branch", "model.py:make")
        assert code == 1
        assert "model.py:with_a_branch: not compiled: no C code" in output
        assert "model.py:make, N = 4: " in output
        assert ("compiled and checked in" if name == "one" else "in the cache already") in output
        (library,) = (here / "cache").glob("mhe-*.so")
        assert str(library) in output
    for one, two, three in zip(*rows, strict=True):
        assert {**one, "step_time": 0} == {**three, "step_time": 0}
        assert float(one["cost"]) == pytest.approx(float(two["cost"]), rel=1e-9)


@needed
def test_doctor_says_what_there_is_and_what_each_model_runs(here, monkeypatch):
    models = [f"model.py:{name}" for name in ("make", "asks_for_python", "with_a_branch")]
    code, output = command("doctor", *models, "nothing")
    assert code == 0
    for text in (
        f"Python {sys.version.split()[0]}", np.__version__, "correct with -O",
        "model.py:make 2 CasADi python its library is not in the cache; qpmhe.compile makes it.",
        "model.py:asks_for_python 2 CasADi python it asks for engine='python'.",
        "model.py:with_a_branch 2 as written python the system has no CasADi form (f is not traced",
        "nothing none model 'nothing' is not known",
    ):
        assert text in output, text
    assert "Steps of models in continuous time" not in output  # these are maps
    command("compile", "model.py:make")
    text = "model.py:make 2 CasADi compiled its library is in the cache: mhe-"
    assert text in command("doctor", *models)[1]
    monkeypatch.setenv("QPMHE_ENGINE", "python")
    monkeypatch.setenv("COLUMNS", "80")
    answer = CliRunner().invoke(app, ["doctor", "model.py:make", "cstr"])
    assert "QPMHE_ENGINE" in answer.output
    assert max(map(len, answer.output.splitlines())) <= 80
    (row,) = [one.split() for one in answer.output.splitlines() if "at most" in one]
    assert row[:3] == ["cstr", "rk4", "1"]
    assert 0.0 <= float(row[3]) < 0.1
    assert row[-1] == "us"
    assert float(row[-2]) > 0.0


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script")
def test_without_a_compiler_or_with_a_broken_one(here, monkeypatch):
    monkeypatch.setenv("CC", "/nowhere/cc")
    code, output = command("compile", "model.py:make")
    assert code == 1
    assert "model.py:make: not compiled: there is no C compiler" in output
    code, output = command("doctor", "model.py:make")
    assert code == 0
    assert "C compiler CC is '/nowhere/cc', which does not exist" in output
    assert "CasADi python there is no C compiler" in output
    path = here / "cc"
    path.write_text("#!/bin/sh\necho out of cheese >&2\nexit 1\n")
    path.chmod(0o755)
    monkeypatch.setenv("CC", str(path))
    code, output = command("doctor", "model.py:make")
    assert code == 0
    assert "gives no version" in output
    assert "out of cheese" in output


@needed
def test_studies_run_the_python_step_whatever_the_cache_holds():
    Path("scenario.py").write_text(MODEL + """
def whole():
    return *make()[:3], qpmhe.models.van_der_pol().scenario
""")
    source = Source(find("scenario.py:whole"))
    cell = Cell(source.name, "banded", 1, None, 4, "candidate", 0, 5)
    example = qpmhe.models.loading.load(source.model)
    qpmhe.compile(*example[:3], horizon=4, initial_state=[0.0, 0.0])
    free = qpmhe.MovingHorizonEstimator(*example[:3], horizon=4, initial_state=[0.0, 0.0])
    assert free.engine == "compiled"
    assert _estimator(Task(cell, source, frozenset(("accuracy",)), 10.0)).engine == "python"
    assert PaperStudy().estimator(2).settings.engine == "python"
