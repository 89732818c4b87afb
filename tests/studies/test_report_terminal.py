import re
from io import StringIO

import pandas as pd
import pytest
from rich.console import Console

from qpmhe.cli.report import show, show_report
from qpmhe.errors import QpmheError
from qpmhe.studies.summary import summarise

from .report_study import frame, stored


def recorder(width: int) -> Console:
    return Console(width=width, record=True, color_system=None, file=StringIO())


def shown(summary: pd.DataFrame, width: int, **options: bool) -> str:
    console = recorder(width)
    show(console, summary, **options)
    return console.export_text()


def headings(text: str) -> set[str]:
    """Of the first table, those of one line, and the last words of the others."""
    (line, *_) = (line for line in text.splitlines() if line.strip().startswith("backend"))
    return set(re.split(r"\s{2,}", line.strip()))


@pytest.mark.parametrize("width", [80, 120, 200])
def test_nothing_is_cut_and_the_room_is_used(width):
    text = shown(summarise(frame()), width)
    assert "…" not in text
    assert "observer" in text
    told = headings(text)
    assert {"RMSE", "conv.", "median", "impr."} <= told
    assert ("99 %" in told) == (width >= 120)
    assert ({"95 %", "kept", "back", "hits", "max"} <= told) == (width == 200)
    assert ("No room here, but in the report" in " ".join(text.split())) == (width < 200)
    assert not {"late", "NEES"} & told


@pytest.mark.parametrize("width", [80, 120, 200])
def test_what_was_asked_for_is_shown_at_any_width(width):
    rows = frame().query("horizon == 10")
    # As wide as they get: generic backends, two starts, failed runs.
    rows = rows.assign(late=0.9995, nees=1230.0, backend="qpsolvers:" + rows.backend)
    rows = pd.concat([rows, rows.assign(start="best")])
    text = shown(summarise(rows), width)
    assert {"late", "NEES", "RMSE", "median"} <= headings(text)
    assert "> 99.9 %" in text
    assert "1,230" in text
    assert "…" not in text


def test_best_of_a_column_is_marked_once():
    summary = summarise(frame().query("horizon == 10"))
    lines = shown(summary, 120).splitlines()
    head = next(line for line in lines if line.strip().startswith("backend"))
    rows = [line for line in lines if re.match(r"\s*(daqp|osqp|proxqp|observer) ", line)]
    assert len(rows) == len(summary)
    assert "median" in head
    times = [line for line in rows if re.search(r"[µm]s\*", line)]
    assert times
    assert all(line.split()[0] == "observer" for line in times)
    near = summary[summary.rmse <= summary.rmse.min() * 1.001]
    best = near.loc[near.time_median.idxmin()]
    marked = [line for line in rows if f"{best.rmse:.3f}*" in line]
    assert [line.split()[0] for line in marked] == [best.backend]
    assert sum(line.rstrip().endswith("front") for line in rows) == summary.pareto.sum()


def test_many_configurations_are_cut_to_the_telling_ones():
    rows = frame().query("horizon == 10")
    capped = rows[rows.solver_iterations == 2]
    more = [
        capped.assign(solver_iterations=capped.solver_iterations + cap, rmse=capped.rmse * 2)
        for cap in range(1, 13)
    ]
    summary = summarise(pd.concat([rows, *more]))
    assert len(summary) == 7 + 3 * 12
    text = shown(summary, 120)
    told = int(re.search(r"(\d+) of 43 configurations", text).group(1))
    lines = [line for line in text.splitlines() if re.match(r"\s*(daqp|osqp|proxqp|obs\w+) ", line)]
    assert len(lines) == told < 20
    assert {line.split()[0] for line in lines} == {"daqp", "osqp", "proxqp", "observer"}
    assert sum(line.rstrip().endswith("front") for line in lines) == summary.pareto.sum()


def test_report_shows_and_writes(tmp_path):
    console = recorder(120)
    show_report(console, stored().path, tmp_path / "out")
    assert (tmp_path / "out" / "index.html").is_file()
    text = console.export_text()
    assert "Fastest within 1 % of the best RMSE" in text
    assert "index.html" in text.replace("\n", "")


def test_no_store(tmp_path):
    with pytest.raises(QpmheError, match=r"none\.sqlite"):
        show_report(recorder(80), tmp_path / "none.sqlite", tmp_path / "out")
    assert not (tmp_path / "out").exists()
