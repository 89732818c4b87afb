"""Studies on measured records, and what a paper takes from a store."""

import csv
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import qpmhe
from qpmhe.errors import InvalidInputError, OptionError
from qpmhe.studies import Store, Study, export, run, summarise, write_report
from qpmhe.studies.experiment import experiment
from qpmhe.studies.export import escaped, with_error

from .commands import command
from .report_study import stored

MODEL = """
import qpmhe

def make():
    system, observer, cost, _ = qpmhe.models.batch_reactor()
    return system, observer, cost, {"horizon": 5, "initial_state": [3.0, 0.0], "outputs": ("P",)}
"""


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


def estimator(qps, **options):
    return qpmhe.MovingHorizonEstimator(
        *qpmhe.models.batch_reactor()[:3], horizon=5, initial_state=[3.0, 0.0], max_qps=qps,
        **options,
    )


GRID = ("--backend", "daqp", "--qps", "0,1,none", "--solver-iterations", "none", "--jobs", 1)


def test_a_record_is_compared_by_its_costs_and_where_truth_is_known_by_errors(here):
    text = command("compare", "--model", "mine.py:make", "--record", "log.csv", *GRID,
                   "--store", "s.sqlite", "--out", "out")
    assert "Fastest within 1 % of the best J / converged J: daqp" in text
    assert "Worse than no QP" not in text
    assert re.search(r"qpmhe \S+, numpy \S+, daqp \S+; .* cores; Python 3", text)
    frame = Store("s.sqlite").frame().set_index("qps")
    assert set(frame["model"]) == {"mine.py:make on log.csv"}
    assert set(frame["steps"]) == {40}  # the missing line is a sample without measurement
    assert frame["rmse"].isna().all()
    y = here.measurements.copy()
    y[20] = np.nan
    runs = {qps: estimator(qps).run(y) for qps in (0, 1, None)}
    for qps in (0, 1):
        row = frame.loc[qps]
        assert row["cost"] == pytest.approx(runs[qps].costs.mean(), rel=1e-6)
        ratio = np.mean(runs[qps].costs / runs[None].costs)
        assert row["cost_ratio"] == pytest.approx(ratio, rel=1e-6)
    assert "The true states are not known" in Path("out/index.html").read_text(encoding="utf-8")

    command("compare", "--model", "mine.py:make", "--record", "log.csv", "--truth", "x1=A", *GRID,
            "--store", "t.sqlite", "--out", "out", "--steps", 30)
    frame = Store("t.sqlite").frame().set_index("qps")
    errors = (runs[1].states[:31] - here.states[:31])[:, 0]
    errors = np.delete(errors, 20)  # nothing was written at the time of the gap
    found = frame.loc[1, "rmse_states"]
    assert found[0] == pytest.approx(np.sqrt((errors**2).mean()), rel=1e-4)
    assert np.isnan(found[1])
    assert frame["rmse"].gt(0).all()
    assert frame["rmse_settled"].isna().all()  # without a scenario nobody knows from when on


def test_a_record_in_python_and_in_a_file(here, tmp_path):
    study = Study(models=["mine.py:make"], records=["log.csv"], reading={"truth": "x1=A"},
                  backends=["banded"], qps=[1], seeds=5)
    (cell,) = study.cells()
    assert (cell.model, cell.seed, cell.horizon) == ("mine.py:make on log.csv", 0, 5)
    file = tmp_path / "study.toml"
    file.write_text('models = ["mine.py:make"]\nrecords = ["log.csv"]\nbackends = ["banded"]\n'
                    'qps = [1]\nseeds = 5\n[reading]\ntruth = "x1=A"\n')
    assert Study.from_toml(file) == study
    frame = run(study, "s.sqlite", jobs=1, progress=False).frame()
    assert frame["outcome"].tolist() == ["done"]
    with (tmp_path / "log.csv").open("a") as log:
        log.write("4.0;7;2;x\n")
    with pytest.raises(qpmhe.studies.StoreError, match="has changed since"):
        run(Study(models=["mine.py:make"], records=["log.csv"], reading={"truth": "x1=A"},
                  backends=["banded"], qps=[1]), "s.sqlite", progress=False)
    row = run(study, "new.sqlite", jobs=1, progress=False).frame().iloc[0]
    assert (row["outcome"], "differs from the one" in row["reason"]) == ("failed", True)
    assert Store("new.sqlite").frame()["rmse"].isna().all()


def test_steps_of_any_length_are_those_of_the_record(here, tmp_path):
    times = np.cumsum([0.0, *np.tile([0.1, 0.13, 0.1], 6)])
    rows = [f"{t:.2f},{y:.17g}\n" for t, y in zip(times, here.measurements[:, 0], strict=False)]
    (tmp_path / "uneven.csv").write_text("time,P\n" + "".join(rows))
    study = Study(models=["mine.py:make"], records=["uneven.csv"], backends=["banded"], qps=[1])
    store = run(study, "s.sqlite", jobs=1, progress=False)
    kept = store.trajectory(store.frame()["key"][0])
    np.testing.assert_allclose(kept["times"][:-1], times)
    mhe = estimator(1, backend="banded")
    found = [mhe.update(y, dt=dt).state
             for y, dt in zip(here.measurements, np.diff(kept["times"]), strict=False)]
    np.testing.assert_allclose(kept["estimates"][1:], found, rtol=1e-6)
    assert np.isnan(kept["states"]).all()


def test_what_does_not_fit_a_record_is_refused(here):
    for options, words in (
        ({"records": ["none.csv"]}, "the record 'none.csv' cannot be read"),
        ({"records": [3]}, "records has 3; expected the name of a file"),
        ({"reading": {"tuth": "A"}}, "reading has the key 'tuth'; .* Did you mean truth?"),
        ({"reading": 3}, "reading is 3; expected a table"),
        ({"reading": {"truth": "x1=B"}}, "no column for true state 'x1'"),
        ({"noise_levels": [2.0]}, "noise_levels is .2.0., but the noise of measured records"),
    ):
        given = {"models": ["mine.py:make"], "records": ["log.csv"], "backends": ["banded"]}
        with pytest.raises(InvalidInputError, match=words):
            Study(**given | options)


def test_noise_levels_scale_what_is_simulated(tmp_path):
    study = Study(backends=["banded"], qps=[0], seeds=1, steps=30, noise_levels=[1e-6, 1, 2])
    frame = run(study, tmp_path / "s.sqlite", jobs=1, progress=False).frame()
    frame = frame.set_index("noise_level")
    assert frame.loc[1.0, "key"].endswith("/T=30/seed=0")
    assert frame.loc[2.0, "key"].endswith("/T=30/noise=2/seed=0")
    assert len(summarise(frame.reset_index())) == 3
    system = qpmhe.models.batch_reactor().system
    drawn = []
    for level in (1.0, 2.0):
        x, y = experiment(study.sources[0]).record(0, 30, level)
        none = np.zeros((30, 0))
        drawn.append((x[1:] - system.f.batch(x[:-1], none), y - system.h.batch(x[:-1], none)))
    for usual, loud in zip(*drawn, strict=True):
        np.testing.assert_allclose(loud, 2.0 * usual, atol=1e-9)


def test_latex_tables_have_means_with_standard_errors_and_say_so(tmp_path):
    study = Study(backends=["daqp", "osqp"], qps=[0, 2], solver_iterations=[2, None],
                  horizons=[10], seeds=3, steps=40)
    text = study.to_latex(stored())
    assert r"batch_reactor, N = 10" in text.splitlines()[0]
    assert text.splitlines()[1].startswith("% qpmhe ")
    assert r"3 runs of each configuration; mean \pm standard error of the mean" in text
    assert "proxqp" not in text
    frame = stored().frame().query("backend == 'osqp' and horizon == 10 and solver_iterations == 2")
    mean, error = frame.rmse.mean(), frame.rmse.std() / 3**0.5
    (line,) = (one for one in text.splitlines() if one.startswith("osqp & 2 & 2 &"))
    assert with_error(mean, error) in line
    assert text.count(r"\begin{tabular}") == 1
    assert export(stored(), tmp_path / "all.tex").read_text().count(r"\begin{tabular}") == 2
    with pytest.raises(InvalidInputError, match="has no cell of this study"):
        Study(backends=["daqp"], qps=[3], seeds=1).to_latex(stored())


def test_numbers_and_names_in_latex():
    for mean, error, words in (
        (0.3236, 0.0164, r"$0.324 \pm 0.016$"), (1234.5, 56.0, r"$1234 \pm 56$"),
        (3.24e-7, 1.2e-8, r"$(3.24 \pm 0.12) \cdot 10^{-7}$"), (1.0, 4e-16, "$1.000$"),
        (0.5, np.nan, "$0.500$"), (0.0, 0.0, "$0$"), (np.nan, 1.0, "--"),
        (2.0, 3.0, r"$2.0 \pm 3.0$"),
    ):
        assert with_error(mean, error) == words
    assert escaped("a_b%c\\d") == r"a\_b\%c\textbackslash{}d"


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
    assert float(box[1]) == pytest.approx(84 / 25.4 * 72, abs=0.1)
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert summary["environment"].str.startswith("qpmhe ").all()
    with pytest.raises(OptionError, match="width is 'wide'; expected 'single'"):
        write_report(store, tmp_path / "out", width="wide")


def test_figures_keep_their_size_after_they_were_saved_for_a_paper(tmp_path):
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    panel = figure.subplots()
    for k in range(6):
        panel.plot([0, 1], [0, k], label=f"a rather long name {k}")
    legend, widths = figure.legend(loc="outside upper center", ncols=6), []
    panel.xaxis.label.draw = lambda _: widths.append(legend.get_window_extent().width / figure.dpi)
    paths = qpmhe.plots.save(figure, tmp_path / "f", width=3.0)
    assert [path.suffix for path in paths] == [".pdf", ".png", ".svg"]
    assert max(widths) <= 3.0
    assert len(legend._legend_handle_box.get_children()) == 6
    assert (figure.get_figwidth(), panel.xaxis.label.get_fontsize()) == (8.0, 10.0)


def test_the_command_counts_kept_qps_and_a_record_model_alone_names_the_remedy(here):
    text = command("compare", "--model", "mine.py:make", "--record", "log.csv", *GRID,
                   "--store", "kept.sqlite", "--out", "out", "--keep-failing", "failing")
    assert "failing has no QPs" in text
    page = (Path("out") / "index.html").read_text(encoding="utf-8")
    assert "configurations, up to 40 steps each" in page  # no seeds
    (Path("failing") / "cell").mkdir()
    (Path("failing") / "cell" / "one.npz").touch()
    text = command("compare", "--model", "mine.py:make", "--record", "log.csv", *GRID,
                   "--store", "kept.sqlite", "--out", "out", "--keep-failing", "failing")
    assert "failing has 1 QP " in text
    assert "qpmhe solve-qp failing" in text
    with pytest.raises(qpmhe.errors.ModelError, match="is enough for a record"):
        Study(models=["mine.py:make"])
