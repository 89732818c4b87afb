"""The work of ``qpmhe compare``, ``study`` and ``export``."""

import io

import pandas as pd
import pytest
from rich.console import Console

from qpmhe.cli import compare as commands
from qpmhe.errors import OptionError
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


def test_failed_cells_are_told(tmp_path, console, shown):
    file = tmp_path / "mine.toml"
    file.write_text(
        f'models = ["{__file__.rpartition("/")[0]}/odd_models.py:raises"]\n'
        'backends = ["banded"]\nqps = [1]\nseeds = 2\nsteps = 10\n'
    )
    commands.study(console, file)
    assert "1 cells failed; their rows tell why." in console.file.getvalue()


def test_an_interrupted_study_tells_how_to_go_on(tmp_path, console, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        commands.compare(console, store=tmp_path / "s.sqlite", out=tmp_path, backends=["banded"])
    assert "the same command goes on" in " ".join(console.file.getvalue().split())
