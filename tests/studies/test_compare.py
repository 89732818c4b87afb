"""The work of ``qpmhe compare``, ``study`` and ``export``."""

import signal
import subprocess
import sys

import pandas as pd
import pytest
from typer.testing import CliRunner

from qpmhe.cli import compare as commands
from qpmhe.cli.app import app
from qpmhe.errors import InvalidInputError, OptionError, QpmheError
from qpmhe.studies import Store

ODD = f'{__file__.rpartition("/")[0]}/odd_models.py'


def command(*words):
    """Output of a command, in one line; its error is raised."""
    answer = CliRunner().invoke(app, [str(word) for word in words])
    if answer.exception is not None:
        raise answer.exception
    return " ".join(answer.output.split())


@pytest.fixture
def shown(monkeypatch):
    """Calls of the report, which has tests of its own."""
    calls = []
    monkeypatch.setattr(commands, "show_report", lambda _, store, out: calls.append((store, out)))
    return calls


def test_compare_runs_the_study_of_its_options(tmp_path, shown):
    path, out = tmp_path / "store.sqlite", tmp_path / "report"
    text = command(
        "compare", "--store", path, "--out", out, "--backend", "daqp", "--qps", "0,2, none",
        "--solver-iterations", "none", "--horizons", "default,3", "--seeds", 1, "--steps", 10,
        "--jobs", 1,
    )
    frame = Store(path).frame()
    assert set(frame["outcome"]) == {"done"}
    assert set(frame["horizon"]) == {3, 10}
    assert set(frame["qps"].dropna()) == {0, 2}
    assert len(frame) == 2 * 3
    assert shown == [(path, out)]
    assert "6/6" in text


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--qps", "0,two", "--qps has 'two'; expected integers >= 0 between commas, or 'none'"),
        ("--qps", "converged", "--qps has 'converged'"),
        ("--solver-iterations", "", "--solver-iterations has ''"),
        ("--horizons", "converged", "--horizons has 'converged'"),
            ("--horizons", "0", "--horizons has '0'; expected integers >= 1"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, option, value, words):
    with pytest.raises(OptionError, match=words):
        command("compare", "--store", tmp_path / "s.sqlite", "--out", tmp_path, option, value)
    assert list(tmp_path.iterdir()) == []


def study_file(tmp_path, **options):
    file = tmp_path / "mine.toml"
    settings = {"backends": ["banded"], "qps": [1], "seeds": 2, "steps": 10, **options}
    file.write_text("".join(f"{key} = {value!r}\n" for key, value in settings.items()))
    return file


def test_a_study_file_names_store_and_report(tmp_path, shown):
    file, store = study_file(tmp_path), tmp_path / "mine.sqlite"
    command("study", file)
    assert len(Store(store).frame()) == 2
    assert "2 of 2 cells were there already" in command("study", file, "--out", tmp_path / "there")
    assert shown == [(store, tmp_path / "mine-report"), (store, tmp_path / "there")]
    command("export", store, tmp_path / "cells.csv")
    assert len(pd.read_csv(tmp_path / "cells.csv")) == 2


@pytest.mark.parametrize("name", ["pandas", "itables"])
def test_a_library_of_the_report_is_missed_before_any_cell_runs(tmp_path, monkeypatch, name):
    monkeypatch.setattr("qpmhe.studies.report.page.find_spec", lambda one: one != name)
    for words in (["compare", "--backend", "banded", "--store", tmp_path / "s.sqlite"],
                  ["study", study_file(tmp_path)]):
        with pytest.raises(InvalidInputError, match=rf"the report needs {name}.*qpmhe\[studies\]"):
            command(*words, "--out", tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["mine.toml"]


def test_a_folder_that_cannot_be_is_refused_before_any_cell_runs(tmp_path):
    with pytest.raises(InvalidInputError, match="cannot make the folder"):
        command("study", study_file(tmp_path), "--out", tmp_path / "mine.toml" / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["mine.toml"]


def test_failed_cells_are_reported(tmp_path, shown):
    text = command("study", study_file(tmp_path, models=[f"{ODD}:raises"]))
    assert "1 of 2 cells failed; the report gives the reasons." in text
    assert len(shown) == 1


def test_a_study_of_which_every_cell_failed_is_an_error(tmp_path, shown):
    store = tmp_path / "s.sqlite"
    command(  # cells of other studies do not count
        "compare", "--store", store, "--out", tmp_path, "--backend", "banded", "--qps", 1,
        "--solver-iterations", "none", "--steps", 10, "--jobs", 1, "--seeds", 1,
    )
    file = study_file(tmp_path, models=[f"{ODD}:raises"], seeds=[1])
    words = "no cell of the study finished, 1 failed;.*ZeroDivisionError.*--retry-failed"
    for _ in range(2):  # also where they had failed before
        with pytest.raises(QpmheError, match=words):
            command("study", file, "--store", store, "--jobs", 1)
    assert len(shown) == 3  # the report is there all the same


def test_a_terminated_study_ends_its_workers_and_says_how_to_resume(tmp_path):
    code = """
import os, signal, sys
from qpmhe.cli import app
from qpmhe.studies.store import Writer
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
    assert "the same command resumes the study" in " ".join(ended.stdout.split())
    assert "resource_tracker" not in ended.stderr
    assert "Traceback" not in ended.stderr
    assert 1 <= len(Store(path).frame()) < 50


def test_an_interrupted_study_says_how_to_resume(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "run", interrupted)
    answer = CliRunner().invoke(app, [
        "compare", "--store", str(tmp_path / "s.sqlite"), "--out", str(tmp_path),
        "--backend", "banded",
    ])
    assert answer.exit_code != 0
    assert "the same command resumes the study" in " ".join(answer.output.split())
