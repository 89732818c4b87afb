"""The work of ``qpmhe compare``, ``study`` and ``export``, on models and on measured records."""

import csv
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import qpmhe
from qpmhe.cli import compare as commands
from qpmhe.errors import InvalidInputError, OptionError, QpmheError
from qpmhe.studies import Store, Study, export, run, write_report
from qpmhe.studies.experiment import experiment
from qpmhe.studies.export import escaped, with_error

from .report_study import command, stored

MODEL = """
import qpmhe

def make():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    return system, observer, cost, {"horizon": 5, "initial_state": [3.0, 0.0], "outputs": ("P",)}
"""
GRID = ("--backend", "daqp", "--qps", "0,1,none", "--solver-iterations", "none", "--jobs", 1,
        "--model", "mine.py:make", "--record", "log.csv", "--out", "out")
GIVEN = {"models": ["mine.py:make"], "records": ["log.csv"], "backends": ["banded"], "qps": [1]}
ODD = f'{__file__.rpartition("/")[0]}/odd_models.py'


@pytest.fixture
def shown(monkeypatch):
    """Calls of the report, which has tests of its own."""
    calls = []
    monkeypatch.setattr(commands, "show_report", lambda _, store, out: calls.append((store, out)))
    return calls


@pytest.mark.slow
def test_compare_runs_the_study_of_its_options(tmp_path, shown):
    path, out = tmp_path / "store.sqlite", tmp_path / "report"
    for option, value, words in (
        ("--qps", "0,two", "--qps has 'two'; expected integers >= 0 separated by commas"),
        ("--horizons", "0", "--horizons has '0'; expected integers >= 1"),
        ("--noise-levels", "1,x", "--noise-levels is '1,x'; expected numbers"),
    ):
        with pytest.raises(OptionError, match=words):
            command("compare", "--store", path, "--out", out, option, value)
    assert list(tmp_path.iterdir()) == []
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


def study_file(tmp_path, **options):
    file = tmp_path / "mine.toml"
    settings = {"backends": ["banded"], "qps": [1], "seeds": 2, "steps": 10, **options}
    file.write_text("".join(f"{key} = {value!r}\n" for key, value in settings.items()))
    return file


def test_a_study_file_names_store_and_report_and_failed_cells_are_reported(tmp_path, shown):
    shutil.copy(ODD, tmp_path / "odd_models.py")
    file = study_file(tmp_path, models=["odd_models.py:raises"])
    store = tmp_path / "mine.sqlite"
    text = command("study", file, "--jobs", 1)
    assert re.search(r"1 of 2 cells failed: .*ZeroDivisionError", text)
    assert "2 of 2 cells were there already" in command("study", file, "--out", tmp_path / "there")
    command("export", store, tmp_path / "cells.csv")
    assert len(pd.read_csv(tmp_path / "cells.csv")) == 2
    file = study_file(tmp_path, models=["odd_models.py:raises"], seeds=[1])
    words = "no cell of the study finished, 1 failed;.*ZeroDivisionError.*--retry-failed"
    with pytest.raises(QpmheError, match=words):  # the cell of seed 0 does not count
        command("study", file, "--store", store, "--jobs", 1)
    # The report is there all the same.
    outs = [tmp_path / name for name in ("mine-report", "there", "mine-report")]
    assert shown == [(store, out) for out in outs]


def test_what_the_report_needs_is_missed_before_any_cell_runs(tmp_path, monkeypatch):
    with pytest.raises(InvalidInputError, match="cannot make the folder"):
        command("study", study_file(tmp_path), "--out", tmp_path / "mine.toml" / "out")
    monkeypatch.setattr("qpmhe.studies.report.page.find_spec", lambda one: one != "jinja2")
    for words in (["compare", "--backend", "banded", "--store", tmp_path / "s.sqlite"],
                  ["study", study_file(tmp_path)]):
        with pytest.raises(InvalidInputError, match=r"the report needs jinja2.*qpmhe\[studies\]"):
            command(*words, "--out", tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_an_ended_study_ends_its_workers_and_says_how_to_resume(tmp_path, signum):
    code = """
import os, signal, sys
from qpmhe.cli import app
from qpmhe.studies.store import Writer
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
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


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A model without a scenario, and a record with a gap, an odd column, and a known state."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MODEL)
    record = qpmhe.models.batch_reactor().scenario.simulate(0, 40)
    rows = [(f"{0.1 * t:.1f}", *record.measurements[t], record.states[t, 0], "x")
            for t in range(40) if t != 20]
    with (tmp_path / "log.csv").open("w", newline="") as file:
        csv.writer(file, delimiter=";").writerows(
            [("time (s)", "P (bar)", "A", "comment"), *rows])
    return record


@pytest.mark.slow
def test_a_record_is_compared_by_its_costs_and_where_truth_is_known_by_errors(here):
    text = command("compare", *GRID, "--store", "s.sqlite", "--keep-failing", "failing")
    assert "Fastest within 1 % of the best J / converged J: daqp" in text
    assert "Worse than no QP" not in text
    assert "failing has no QPs" in text
    frame = Store("s.sqlite").frame().set_index("qps")
    assert set(frame["model"]) == {"mine.py:make on log.csv"}
    assert set(frame["steps"]) == {40}  # the missing line is a sample without measurement
    assert frame["rmse"].isna().all()
    y = here.measurements.copy()
    y[20] = np.nan
    runs = {qps: qpmhe.MovingHorizonEstimator(
        *qpmhe.models.batch_reactor()[:3], horizon=5, initial_state=[3.0, 0.0], max_qps=qps
    ).run(y) for qps in (0, 1, None)}
    for qps in (0, 1):
        assert frame.loc[qps, "cost"] == pytest.approx(runs[qps].costs.mean(), rel=1e-6)
        ratio = np.mean(runs[qps].costs / runs[None].costs)
        assert frame.loc[qps, "cost_ratio"] == pytest.approx(ratio, rel=1e-6)
    page = Path("out/index.html").read_text(encoding="utf-8")
    assert "The true states are not known" in page
    assert "configurations, up to 40 steps each" in page  # no seeds
    command("compare", *GRID, "--truth", "x1=A", "--store", "t.sqlite", "--steps", 30)
    frame = Store("t.sqlite").frame().set_index("qps")
    errors = (runs[1].states[:31] - here.states[:31])[:, 0]
    errors = np.delete(errors, 20)  # nothing was written at the time of the gap
    found = frame.loc[1, "rmse_states"]
    assert found == pytest.approx([np.sqrt((errors**2).mean()), np.nan], rel=1e-4, nan_ok=True)
    assert frame["rmse_settled"].isna().all()  # without a scenario nobody knows from when on


def test_a_record_in_a_study_file_and_what_does_not_fit_it(here, tmp_path):
    study = Study(**GIVEN, reading={"truth": "x1=A"}, seeds=5)
    (cell,) = study.cells()
    assert (cell.model, cell.seed, cell.horizon) == ("mine.py:make on log.csv", 0, 5)
    file = tmp_path / "study.toml"
    lines = [f"{name} = {value!r}\n" for name, value in GIVEN.items()]
    file.write_text("".join([*lines, 'seeds = 5\n[reading]\ntruth = "x1=A"\n']))
    assert Study.from_toml(file) == study
    for options, words in (
        ({"records": ["none.csv"]}, "the record 'none.csv' cannot be read"),
        ({"reading": {"tuth": "A"}}, "reading has the key 'tuth'; .* Did you mean truth?"),
        ({"reading": {"truth": "x1=B"}}, "no column for true state 'x1'"),
        ({"noise_levels": [2.0]}, "noise_levels is .2.0., but the noise of measured records"),
        ({"records": []}, "is enough for a record"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            Study(**GIVEN | options)
    assert run(study, "s.sqlite", jobs=1, progress=False).frame()["outcome"].tolist() == ["done"]
    with (tmp_path / "log.csv").open("a") as log:
        log.write("4.0;7;2;x\n")
    with pytest.raises(qpmhe.studies.StoreError, match="has changed since"):
        run(Study(**GIVEN, reading={"truth": "x1=A"}), "s.sqlite", progress=False)


def test_noise_levels_scale_what_is_simulated():
    study = Study(backends=["banded"], qps=[0], seeds=1, steps=30, noise_levels=[1, 2])
    assert [cell.key.partition("/T=30/")[2] for cell in study.cells()] == [
        "seed=0", "noise=2/seed=0"]
    system, none, drawn = qpmhe.models.batch_reactor().system, np.zeros((30, 0)), []
    for level in (1.0, 2.0):
        x, y = experiment(study.sources[0]).record(0, 30, level)
        drawn.append((x[1:] - system.f.batch(x[:-1], none), y - system.h.batch(x[:-1], none)))
    for usual, loud in zip(*drawn, strict=True):
        np.testing.assert_allclose(loud, 2.0 * usual, atol=1e-9)


@pytest.mark.slow
def test_latex_tables_have_means_with_standard_errors_and_say_so(tmp_path):
    study = Study(backends=["daqp", "osqp"], qps=[0, 2], solver_iterations=[2, None],
                  horizons=[10], seeds=3, steps=40)
    text = study.to_latex(stored())
    assert r"batch_reactor, N = 10" in text.splitlines()[0]
    assert text.splitlines()[1].startswith("% qpmhe ")
    assert r"3 runs of each configuration; mean \pm standard error of the mean" in text
    assert "proxqp" not in text
    frame = stored().frame().query(
        "backend == 'osqp' and horizon == 10 and solver_iterations == 2", engine="python"
    )
    (line,) = (one for one in text.splitlines() if one.startswith("osqp & 2 & 2 &"))
    assert with_error(frame.rmse.mean(), frame.rmse.std() / 3**0.5) in line
    assert export(stored(), tmp_path / "all.tex").read_text().count(r"\begin{tabular}") == 2
    with pytest.raises(InvalidInputError, match="has no cell of this study"):
        Study(backends=["daqp"], qps=[3], seeds=1).to_latex(stored())
    for mean, error, words in (
        (0.3236, 0.0164, r"$0.324 \pm 0.016$"), (0.5, np.nan, "$0.500$"),
        (1.00003, 4e-6, "$1.000$"), (0.99996, 4e-6, "$1.000$"), (1.0, 0.0, "$1.000$"),
        (3.24e-7, 1.2e-8, r"$(3.24 \pm 0.12) \cdot 10^{-7}$"), (np.nan, 1.0, "--"),
    ):
        assert with_error(mean, error) == words
    assert escaped("a_b%c\\d") == r"a\_b\%c\textbackslash{}d"


@pytest.mark.slow
def test_figures_against_horizon_noise_and_qps_come_in_one_call(tmp_path):
    study = Study(backends=["banded"], qps=[0, 1, 2], solver_iterations=[None], horizons=[3, 6],
                  noise_levels=[1, 2], seeds=2, steps=20, measure="accuracy")
    store = run(study, tmp_path / "s.sqlite", jobs=1, progress=False)
    write_report(store, tmp_path / "out", width="single")
    names = {path.stem for path in (tmp_path / "out").glob("*error-*.pdf")}
    assert names == {
        *(f"batch-reactor-banded-noise-{level}-error-{axis}" for level in (1, 2) for axis in "Ni"),
        *(f"batch-reactor-banded-N-{n}-error-noise" for n in (3, 6)),
    }
    head = (tmp_path / "out" / f"{names.pop()}.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", head)
    assert float(box[1]) == pytest.approx(84 / 25.4 * 72, rel=1e-3)
    with pytest.raises(OptionError, match="width is 'wide'; expected 'single'"):
        write_report(store, tmp_path / "out", width="wide")


@pytest.mark.parametrize(("given", "words"), [
    (("A=ekf", "A=ukf"), "--estimator has the name 'A' for 'ekf' and for 'ukf'"),
    (("missing.py:make",), "estimator 'missing.py:make': cannot read"),
    (("=ekf",), "estimator '=ekf' is not known; expected one of ekf, ukf"),
])
def test_estimators_that_do_not_fit_are_named(given, words):
    options = [one for name in given for one in ("--estimator", name)]
    with pytest.raises(InvalidInputError, match=re.escape(words)):
        command("compare", "--backend", "banded", *options)
