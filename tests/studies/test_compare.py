"""The work of ``qpmhe compare``, ``study`` and ``export``."""

import io
import signal
import subprocess
import sys

import pandas as pd
import pytest
from rich.console import Console

from qpmhe.cli import compare as commands
from qpmhe.errors import OptionError, QpmheError
from qpmhe.studies.store import Store


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=140)


@pytest.fixture
def shown(monkeypatch):
    """Calls of the report, which has tests of its own."""
    calls = []
    monkeypatch.setattr(
        "qpmhe.cli.report.report", lambda console, store, out: calls.append((store, out))
    )
    return calls


def test_compare_runs_the_study_of_its_options(tmp_path, console, shown):
    path, out = tmp_path / "store.sqlite", tmp_path / "report"
    commands.compare(
        console, store=path, out=out, backends=["daqp"], qps="0,2, converged",
        solver_iterations="none", horizons="default,3", seeds=1, steps=10, jobs=1,
    )
    frame = Store(path).frame()
    assert set(frame["outcome"]) == {"done"}
    assert set(frame["horizon"]) == {3, 10}
    assert set(frame["qps"].dropna()) == {0, 2}
    assert len(frame) == 2 * 3
    assert shown == [(path, out)]
    assert "6/6" in console.file.getvalue()


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"qps": "0,two"}, "--qps has 'two'; expected integers between commas, or 'converged'"),
        ({"qps": "none"}, "--qps has 'none'"),
        ({"solver_iterations": ""}, "--solver-iterations has ''"),
        ({"horizons": "converged"}, "--horizons has 'converged'"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, console, option, words):
    with pytest.raises(OptionError, match=words):
        commands.compare(console, store=tmp_path / "s.sqlite", out=tmp_path, **option)
    assert list(tmp_path.iterdir()) == []


def test_a_study_file_names_store_and_report(tmp_path, console, shown):
    file = tmp_path / "mine.toml"
    file.write_text('backends = ["banded"]\nqps = [1]\nseeds = 2\nsteps = 10\n')
    commands.study(console, file)
    assert len(Store(tmp_path / "mine.sqlite").frame()) == 2
    commands.study(console, file, out=tmp_path / "there")
    assert "2 of 2 cells were there already" in console.file.getvalue()
    store = tmp_path / "mine.sqlite"
    assert shown == [(store, tmp_path / "mine-report"), (store, tmp_path / "there")]
    commands.export(console, store, tmp_path / "cells.csv")
    assert len(pd.read_csv(tmp_path / "cells.csv")) == 2


ODD = f'{__file__.rpartition("/")[0]}/odd_models.py'


def test_failed_cells_are_told(tmp_path, console, shown):
    file = tmp_path / "mine.toml"
    file.write_text(
        f'models = ["{ODD}:raises"]\nbackends = ["banded"]\nqps = [1]\nseeds = 2\nsteps = 10\n'
    )
    commands.study(console, file)
    assert "1 of 2 cells failed; their rows tell why." in console.file.getvalue()
    assert len(shown) == 1


def test_a_study_of_which_every_cell_failed_is_an_error(tmp_path, console, shown):
    options = {
        "store": tmp_path / "s.sqlite", "out": tmp_path, "backends": ["banded"], "qps": "1",
        "solver_iterations": "none", "steps": 10, "jobs": 1,
    }
    commands.compare(console, **options, seeds=1)  # cells of other studies do not count
    file = tmp_path / "mine.toml"
    file.write_text(
        f'models = ["{ODD}:raises"]\nbackends = ["banded"]\nqps = [1]\nseeds = [1]\nsteps = 10\n'
    )
    words = "no cell of the study was finished, 1 failed;.*ZeroDivisionError.*--retry-failed"
    for _ in range(2):  # also where they had failed before
        with pytest.raises(QpmheError, match=words):
            commands.study(console, file, store=options["store"], jobs=1)
    assert len(shown) == 3  # the report is there all the same


def test_an_ended_study_leaves_in_good_order(tmp_path):
    code = """
import os, signal, sys
from qpmhe.cli import app
from qpmhe.studies.writer import Writer
put = Writer.put
def last(writer, result):
    put(writer, result)
    os.kill(os.getpid(), signal.SIGTERM)
Writer.put = last
sys.argv = ["qpmhe", "compare", "--backend", "banded", "--qps", "1", "--seeds", "50",
            "--jobs", "2", "--store", sys.argv[1], "--out", sys.argv[2]]
app.main()
"""
    path = tmp_path / "s.sqlite"
    ended = subprocess.run(
        [sys.executable, "-c", code, str(path), str(tmp_path / "report")],
        capture_output=True, text=True, timeout=300, check=False,
    )
    assert ended.returncode == 128 + signal.SIGTERM
    assert "the same command goes on" in " ".join(ended.stdout.split())
    assert "resource_tracker" not in ended.stderr
    assert "Traceback" not in ended.stderr
    assert 1 <= len(Store(path).frame()) < 50


def test_an_interrupted_study_tells_how_to_go_on(tmp_path, console, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        commands.compare(console, store=tmp_path / "s.sqlite", out=tmp_path, backends=["banded"])
    assert "the same command goes on" in " ".join(console.file.getvalue().split())
