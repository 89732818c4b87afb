"""The work of ``qpmhe compare``, ``study`` and ``export``."""

import signal
import subprocess
import sys

import pandas as pd
import pytest

from qpmhe.cli import compare as commands
from qpmhe.errors import InvalidInputError, OptionError, QpmheError
from qpmhe.studies import Store

from .commands import command

ODD = f'{__file__.rpartition("/")[0]}/odd_models.py'


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
        "--solver-iterations", "none", "--horizons", "default,3", "--noise-levels", "1,2",
        "--seeds", 1, "--steps", 10, "--jobs", 1,
    )
    frame = Store(path).frame()
    assert set(frame["outcome"]) == {"done"}
    assert (set(frame["horizon"]), set(frame["noise_level"])) == ({3, 10}, {1.0, 2.0})
    assert set(frame["qps"].dropna()) == {0, 2}
    assert len(frame) == 2 * 2 * 3
    assert shown == [(path, out)]
    assert "12/12" in text


def test_options_that_do_not_fit_are_refused(tmp_path):
    for option, value, words in (
        ("--qps", "0,two", "--qps has 'two'; expected integers >= 0 separated by commas"),
        ("--solver-iterations", "", "--solver-iterations has ''"),
        ("--horizons", "0", "--horizons has '0'; expected integers >= 1"),
        ("--noise-levels", "1,x", "--noise-levels is '1,x'; expected numbers"),
    ):
        with pytest.raises(OptionError, match=words):
            command("compare", "--store", tmp_path / "s.sqlite", "--out", tmp_path, option, value)
    assert list(tmp_path.iterdir()) == []


def study_file(tmp_path, **options):
    file = tmp_path / "mine.toml"
    settings = {"backends": ["banded"], "qps": [1], "seeds": 2, "steps": 10, **options}
    file.write_text("".join(f"{key} = {value!r}\n" for key, value in settings.items()))
    return file


def test_a_study_file_names_store_and_report_and_failed_cells_are_reported(tmp_path, shown):
    file, store = study_file(tmp_path, models=[f"{ODD}:raises"]), tmp_path / "mine.sqlite"
    text = command("study", file, "--jobs", 1)
    assert "1 of 2 cells failed; the report gives the reasons." in text
    assert "2 of 2 cells were there already" in command("study", file, "--out", tmp_path / "there")
    command("export", store, tmp_path / "cells.csv")
    assert len(pd.read_csv(tmp_path / "cells.csv")) == 2
    file = study_file(tmp_path, models=[f"{ODD}:raises"], seeds=[1])
    words = "no cell of the study finished, 1 failed;.*ZeroDivisionError.*--retry-failed"
    with pytest.raises(QpmheError, match=words):  # the cell of seed 0 does not count
        command("study", file, "--store", store, "--jobs", 1)
    # The report is there all the same.
    outs = [tmp_path / name for name in ("mine-report", "there")]
    assert shown[:2] == [(store, out) for out in outs]
    assert len(shown) == 3


def test_what_the_report_needs_is_missed_before_any_cell_runs(tmp_path, monkeypatch):
    with pytest.raises(InvalidInputError, match="cannot make the folder"):
        command("study", study_file(tmp_path), "--out", tmp_path / "mine.toml" / "out")
    monkeypatch.setattr("qpmhe.studies.report.page.find_spec", lambda one: one != "itables")
    for words in (["compare", "--backend", "banded", "--store", tmp_path / "s.sqlite"],
                  ["study", study_file(tmp_path)]):
        with pytest.raises(InvalidInputError, match=r"the report needs itables.*qpmhe\[studies\]"):
            command(*words, "--out", tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_an_ended_study_ends_its_workers_and_says_how_to_resume(tmp_path, signum):
    code = """
import os, sys
from qpmhe.cli import app
from qpmhe.studies.store import Writer
put, signum = Writer.put, int(sys.argv[3])
def last(writer, result):
    put(writer, result)
    os.kill(os.getpid(), signum)
Writer.put = last
sys.argv = ["qpmhe", "compare", "--backend", "banded", "--qps", "1", "--seeds", "50",
            "--jobs", "2", "--store", sys.argv[1], "--out", sys.argv[2]]
app.main()
"""
    path = tmp_path / "s.sqlite"
    ended = subprocess.run(
        [sys.executable, "-c", code, str(path), str(tmp_path / "report"), str(int(signum))],
        capture_output=True, text=True, timeout=300, check=False,
    )
    assert ended.returncode == 128 + signum
    assert "the same command resumes the study" in " ".join(ended.stdout.split())
    assert "resource_tracker" not in ended.stderr
    assert "Traceback" not in ended.stderr
    assert 1 <= len(Store(path).frame()) < 50
