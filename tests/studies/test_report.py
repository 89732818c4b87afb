"""Means and fronts of configurations; answers, figures and page of the report; the terminal."""

import re
from io import StringIO
from itertools import combinations, pairwise
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from matplotlib.image import imread
from rich.console import Console
from scipy.stats import ttest_1samp

from qpmhe.cli.report import show
from qpmhe.errors import InvalidInputError, ShapeError
from qpmhe.plots.style import _resized
from qpmhe.studies.report import cases, write_report
from qpmhe.studies.report.answers import limitations
from qpmhe.studies.report.drawing import Axis, Drawing, Panel, PlotMark, draw, styles
from qpmhe.studies.report.figures import profiles
from qpmhe.studies.report.pictures import Part, chosen_runs, pictures
from qpmhe.studies.report.words import configuration_words, number, seconds
from qpmhe.studies.summary import CONFIGURATION, pareto_front, summarise

from .report_study import frame, spoilt, stored, written


def altered(rows, **changes):
    """The store with other cells, and other words about its trajectories."""
    def trajectory(key):
        kept = stored().trajectory(key)
        return kept and {**kept, **changes}

    return SimpleNamespace(frame=lambda: rows, meta=stored().meta, trajectory=trajectory)


def texts(rows):
    case = next(one for one in cases(summarise(rows)) if one.title.endswith("N = 10"))
    return {answer.question: answer.text for answer in case.answers()}, case


def test_fastest_near_the_best_the_observer_and_failures():
    found, case = texts(frame())
    rows = [row for _, row in case.summary.iterrows()]
    least = min(row.rmse for row in rows)
    first = min((row for row in rows if row.rmse <= 1.01 * least), key=lambda row: row.time_median)
    text = found["Fastest within 1 % of the best RMSE"]
    assert text.startswith(f"{configuration_words(first)}: {seconds(first.time_median)} per step")
    assert f"RMSE {number(first.rmse)} (95 %" in text
    assert found["Failures"] == "No backend failed, in any run or step."
    assert found["Worse than no QP"] == "No configuration."
    found, case = texts(spoilt("osqp", 1, "out of time"))
    observer = case.summary[case.summary.backend == "observer"].iloc[0]
    assert found["Observer alone (no QP)"].startswith(f"RMSE {number(observer.rmse)} ")
    assert found["Failures"] == "Never: daqp and proxqp. Failed: osqp: 2 of 6 runs failed."
    rows = frame()
    rows["reasons"] = [{"SOLVER_FAILED": 4} if one == "osqp" else {} for one in rows.backend]
    words = "osqp, 2 QPs per sample, cap 2: 10 % of the steps, but no run"
    assert words in texts(rows)[0]["Failures"]
    rows = pd.concat([spoilt("osqp", 1, "x").assign(shared=True), rows.assign(environment=1)[:1]])
    after = " ".join(limitations(rows, summarise(rows)))
    for words in ("cores were shared", "2 environments", "2 of 31 runs failed", "fewer runs"):
        assert words in after


def test_what_is_worse_than_no_qp_is_named():
    rows = frame()
    observer = rows[(rows.backend == "observer") & (rows.horizon == 10)].set_index("seed")
    worse = (rows.backend == "osqp") & (rows.solver_iterations == 2) & (rows.horizon == 10)
    late = (rows.backend == "daqp") & rows.solver_iterations.isna() & (rows.horizon == 10)
    for which, name, times in ((worse, "rmse", 4.0), (late, "rmse_settled", 1.5)):
        rows.loc[which, name] = times * observer[name].loc[rows.seed[which]].to_numpy()
    mean, settled = 4.0 * observer.rmse.mean(), 1.5 * observer.rmse_settled.mean()
    assert texts(rows)[0]["Worse than no QP"] == (
        "2 of 6 configurations have a larger error than the observer alone, although J is never "
        "above the candidate's: osqp, 2 QPs per sample, cap 2 "
        f"(RMSE {number(mean)}, 4.00 times); daqp, 2 QPs per sample "
        f"(RMSE after settling {number(settled)}, 1.50 times)."
    )


@pytest.mark.slow
def test_accuracy_alone_and_nothing_at_all(tmp_path):
    rows = frame().query("horizon == 10").assign(times=None, cost_ratio=np.nan)
    rows[["time_median", "time_p95", "time_p99", "time_max"]] = np.nan
    found, _ = texts(rows)
    assert "accuracy only" in found["Fastest"]
    assert any("No times" in note for note in limitations(rows, summarise(rows)))
    text = write_report(altered(rows), tmp_path).read_text(encoding="utf-8")
    for words in ("Accuracy against time", "Time per step", "Performance profile"):
        assert f"<h2>{words}" not in text
    for words in ("true cost J", "J / converged J"):
        assert words not in text
    assert "Stopping the solver early" in text
    found, _ = texts(frame().assign(outcome="failed", reason="crash"))
    assert found["Result"] == "No configuration finished all its runs."
    with pytest.raises(InvalidInputError, match="no finished cell"):
        write_report((frame()[:0], {}), tmp_path)


def test_profiles_against_their_definition():
    rows = frame()
    found = profiles(rows)
    assert [(one.backend, one.problems) for one in found] == [
        ("daqp", 6), ("osqp", 6), ("proxqp", 6)]
    words = rows.apply(configuration_words, axis=1)
    times = {
        one.backend: rows[(words == one.words) & (rows.cost_ratio <= 1.01)]
        .set_index(["horizon", "seed"]).time_median for one in found
    }
    least = pd.DataFrame(times).min(axis=1)
    for one in found:
        for tau in (1.0, 1.5, 3.0, 100.0):
            mine = times[one.backend]
            share = (mine <= tau * least[mine.index]).sum() / 6
            assert (one.ratios <= tau).sum() / one.problems == share


@pytest.mark.slow
@pytest.mark.parametrize("inches", [None, 3.3])
def test_no_text_is_clipped_or_covered(inches):
    rows = frame()
    parts = []
    for case in cases(summarise(rows)):
        cells = rows[rows.horizon == case.summary.horizon.iloc[0]]
        runs = chosen_runs(stored(), cells, case)
        assert 1 < len(runs) <= 3
        assert runs[-1][0] == "observer"
        parts.append(Part(case, cells, 1e-3, runs))
    found = pictures(parts, styles(sorted(rows.backend)), profiles(rows), inches)
    assert len(found) == 9 + 2  # the errors against N and i
    for figure in (one.figure for one in found.values()):
        with _resized(figure, inches):
            figure.draw_without_rendering()
            drawn_box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
            assert min(drawn_box.x0, drawn_box.y0) >= -0.01
            assert drawn_box.x1 <= width + 0.01
            assert drawn_box.y1 <= height + 0.01
            titles = [figure._suptitle, *figure.legends]
            for axes in figure.axes:
                titles += [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]
            boxes = [one.get_window_extent() for one in titles
                     if one is not None and (one in figure.legends or one.get_text())]
            assert not [pair for pair in combinations(boxes, 2) if pair[0].overlaps(pair[1])]


def embedded(page):
    """The texts of the page's script elements, as a browser ends them."""
    return re.findall(r"<script[^>]*>(.*?)</script>", page.read_text("utf-8"), re.DOTALL)


def test_the_report_is_whole_and_needs_no_network():
    page = written()
    folder, text = page.parent, page.read_text(encoding="utf-8")
    assert page.stat().st_size < 1e6
    assert not re.findall(r"""<(?:script|link|img|iframe)[^>]*(?:src|href)\s*=\s*["']?http""", text)
    stems = {f"batch-reactor-N-{n}-{kind}" for n in (4, 10)
             for kind in ("accuracy-time", "anytime", "step-times", "run")}
    stems |= {"profile", "batch-reactor-daqp-error-N", "batch-reactor-daqp-error-i"}
    assert {path.name for path in folder.iterdir()} == {
        "index.html", "summary.csv", *(f"{stem}.{end}" for stem in stems for end in ("png", "svg"))
    }
    for stem in stems:
        assert imread(folder / f"{stem}.png")[..., :3].std() > 0.02
    rows = summarise(frame())
    table = pd.read_csv(folder / "summary.csv")
    assert table.rmse.to_numpy() == pytest.approx(rows.rmse.to_numpy())
    assert f"numpy {stored().meta()['environments'][0]['versions']['numpy']}" in text
    # The page's figures are those of the files.
    elements = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(elements) == len(stems)
    for element in elements:
        ElementTree.fromstring(element)
    ids = re.findall(r' id="([^"]*)"', text)
    assert len(ids) == len(set(ids))
    points = re.findall(r'<g data-backend="(\w+)"><title>(.*?)</title>', text, re.DOTALL)
    told = [words for _, words in points if "RMSE settled" in words]
    assert len(told) == len(rows)
    for words in map(configuration_words, (row for _, row in rows.iterrows())):
        assert sum(one.splitlines()[0].removesuffix(" (Pareto front)") == words for one in told)


@pytest.mark.slow
def test_no_text_of_a_user_reaches_into_the_script_elements(tmp_path):
    label = "]]><!--<script></script>"
    rows = spoilt("proxqp", 1, "</script><b>out of time").query("horizon == 4")
    plain = embedded(write_report((rows, stored().meta()), tmp_path / "plain"))
    rows = rows.assign(model=f"m.py:make(label={label!r})")
    page = write_report(altered(rows, labels=(label, "y")), tmp_path)
    assert embedded(page) == plain
    text = page.read_text(encoding="utf-8")
    assert "&lt;/script&gt;&lt;b&gt;out of time" in text
    assert "</script><b>" not in text
    assert text.count("<script>") == 1
    assert re.search(r"]]&gt;(<!--|&lt;!--)", text)


def shown(summary, width):
    """What the terminal shows, the lines of its table, and its headings, or their last words."""
    console = Console(width=width, record=True, color_system=None, file=StringIO())
    show(console, summary)
    text = console.export_text()
    assert "…" not in text
    rows = [line.strip() for line in text.splitlines()
            if re.match(r"\s*(backend|daqp|osqp|proxqp|observer) ", line)]
    return text, rows[1:], set(re.split(r"\s{2,}", rows[0]))


@pytest.mark.slow
@pytest.mark.parametrize("width", [80, 120, 200])
def test_the_terminals_room_is_used(width):
    text, _, headings = shown(summarise(frame().query("horizon == 10")), width)
    assert {"RMSE", "conv.", "median", "impr."} <= headings
    assert ("99 %" in headings) == (width >= 120)
    assert ({"95 %", "kept", "back", "hits", "max"} <= headings) == (width == 200)
    assert ("Only in the report, for want of room" in " ".join(text.split())) == (width < 200)
    assert not {"late", "NEES"} & headings
    # What was asked for is shown at any width.
    rows = frame().query("horizon == 10").assign(late=0.9995, nees=1230.0)
    text, _, headings = shown(summarise(pd.concat([rows, rows.assign(start="best")])), width)
    assert {"late", "NEES", "RMSE", "median"} <= headings
    assert "> 99.9 %" in text
    assert "1,230" in text


@pytest.mark.slow
def test_the_best_of_a_column_is_marked_once_and_of_many_rows_those_that_matter_are_shown():
    rows = frame().query("horizon == 10")
    summary = summarise(rows)
    _, lines, _ = shown(summary, 120)
    assert len(lines) == len(summary)
    assert {line.split()[0] for line in lines if re.search(r"[µm]s\*", line)} == {"observer"}
    near = summary[summary.rmse <= summary.rmse.min() * 1.001]
    best = near.loc[near.time_median.idxmin()]
    assert [line.split()[0] for line in lines if f"{best.rmse:.3f}*" in line] == [best.backend]
    assert sum(line.endswith("front") for line in lines) == summary.pareto.sum()
    many = [rows[rows.solver_iterations == 2].assign(solver_iterations=cap) for cap in range(3, 15)]
    text, lines, _ = shown(summarise(pd.concat([rows, *many])), 120)
    assert len(lines) == int(re.search(r"(\d+) of 43 configurations", text).group(1)) < 20


def cells_of(rows, row):
    for key in CONFIGURATION:
        rows = rows[rows[key].isna() if pd.isna(row[key]) else rows[key] == row[key]]
    return rows


def test_means_and_limits_are_students_and_the_excess_is_paired_by_seed():
    rows = frame()
    summary = summarise(rows)
    assert len(summary) == 7 + 3
    for _, row in summary.iterrows():
        cells = cells_of(rows, row)
        assert (len(cells), row.seeds, row.failures) == (3, 3, 0)
        group = summary[summary.horizon == row.horizon]
        front = pareto_front(group.time_median, group.rmse, 1e-3)
        assert group.pareto.tolist() == front.tolist()
        best = cells_of(rows, group.loc[group.rmse.idxmin()]).set_index("seed").rmse
        cells = cells.assign(rmse_excess=cells.rmse / cells.seed.map(best) - 1.0)
        for name in ("rmse", "rmse_settled", "cost_ratio", "time_p99", "rmse_excess"):
            values = cells[name].to_numpy(float)
            assert row[name] == pytest.approx(values.mean(), rel=1e-12)
            if np.ptp(values) > 1e-9 * abs(values.mean()):
                low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
                least = -np.inf if name == "rmse_excess" else 0.0
                assert row[f"{name}_low"] == pytest.approx(max(least, low), rel=1e-9)
                assert row[f"{name}_high"] == pytest.approx(high, rel=1e-9)
        assert row.rmse_states == pytest.approx(np.mean([*cells["rmse_states"]], axis=0))
    alone = summarise(rows[rows.seed == 0])  # one seed has no limits
    assert alone.rmse.notna().all()
    assert alone[["rmse_low", "time_median_high"]].isna().all(axis=None)
    with pytest.raises(InvalidInputError, match="time_p99"):
        summarise(rows.drop(columns="time_p99"))


def test_shares_stay_shares_and_failed_cells_are_counted_and_left_out_of_means():
    rows = spoilt("osqp", 1, "out of time")
    rows.loc[rows.seed == 0, "improved"] = 0.0
    rows["reasons"] = [{"IMPROVED": 30, "SOLVER_FAILED": 10}] * len(rows)
    summary = summarise(rows)
    osqp = summary["backend"] == "osqp"
    assert (summary.failures == osqp).all()
    assert not summary.pareto[osqp].any()
    row = summary[osqp].iloc[0]
    assert row.rmse == pytest.approx(cells_of(rows, row).rmse.dropna().mean())
    assert summary.failed_steps.tolist() == pytest.approx([0.25] * len(summary))
    assert row.reasons == {"IMPROVED": 0.75, "SOLVER_FAILED": 0.25}
    assert (row.improved_low, row.improved_high) == (0.0, 1.0)


points = arrays.arrays(
    float, st.tuples(st.integers(0, 12), st.just(2)),
    elements=st.sampled_from([0.0, 1.0, 2.0, 3.0, 4.0, np.nan, np.inf]),
)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(points)
def test_front_against_its_definition(rows):
    finite = np.isfinite(rows).all(axis=1)
    expected = [
        bool(fine) and not any(
            other_fine and (other <= row).all() and (other < row).any()
            for other, other_fine in zip(rows, finite, strict=True)
        )
        for row, fine in zip(rows, finite, strict=True)
    ]
    assert pareto_front(rows[:, 0], rows[:, 1]).tolist() == expected
    times, errors = [1.0, 2.0, 3.0, 4.0], [1.0, 0.9995, 0.998, 0.5]
    assert pareto_front(times, errors, 1e-3).tolist() == [True, False, True, True]
    with pytest.raises(ShapeError, match=r"\(2,\) and \(3,\)"):
        pareto_front([1, 2], [1, 2, 3])


def test_a_legend_of_many_names_and_the_ticks_fit():
    names = [f"an estimator with name {k}" for k in range(9)]
    marks = [PlotMark("line", [1e-4, 3e-2], [1.0, 2.0], name) for name in names[1:]]
    marks.append(PlotMark("level", [1e-4, 3e-2], [1.5, 1.5], names[0]))
    axis = Axis("time", "time", [7e-5, 4e-2])
    drawing = Drawing([Panel(axis, Axis("RMSE", "error", [1.0, 2.0]), marks)])
    figure = draw(drawing, styles(names), (5.6, 5.0), "", [("a", {}), ("b", {})]).figure
    figure.canvas.draw()
    (legend,) = figure.legends
    ends = legend.get_window_extent().extents
    assert 0.0 <= ends[0] < ends[2] <= figure.bbox.width
    # A level is drawn dashed, whatever its style elsewhere.
    assert legend.get_lines()[0].get_linestyle() == "--"
    labels = [one.get_window_extent() for one in figure.axes[0].get_xticklabels()]
    assert [one.get_text() for one in figure.axes[0].get_xticklabels()] == [
        "100 µs", "1 ms", "10 ms"]
    assert all(a.x1 < b.x0 for a, b in pairwise(labels))
