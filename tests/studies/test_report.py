import json
import re
import resource
import subprocess
import sys
from dataclasses import dataclass
from io import StringIO
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread
from rich.console import Console

from qpmhe.cli.report import show
from qpmhe.errors import InvalidInputError
from qpmhe.plots.style import _resized
from qpmhe.studies.report import cases, write_report
from qpmhe.studies.report.answers import failures, limitations
from qpmhe.studies.report.drawing import styles
from qpmhe.studies.report.figures import anytime, profiles, spreads
from qpmhe.studies.report.page import Part, choose_runs, files
from qpmhe.studies.report.words import configuration_words, number, percent, seconds
from qpmhe.studies.summary import summarise

from .report_study import frame, spoilt, stored, written


@dataclass
class Altered:
    """The store with other cells."""

    rows: pd.DataFrame

    def frame(self):
        return self.rows

    def meta(self):
        return stored().meta()

    def trajectory(self, key):
        return stored().trajectory(key)


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
    found, case = texts(spoilt("osqp", 1, "out of time"))
    observer = case.summary[case.summary.backend == "observer"].iloc[0]
    assert found["Observer alone (no QP)"].startswith(f"RMSE {number(observer.rmse)} ")
    assert found["Failures"] == "Never: daqp and proxqp. Failed: osqp: 2 of 6 runs failed."
    rows = frame()
    rows["reasons"] = [{"SOLVER_FAILED": 4} if one == "osqp" else {} for one in rows.backend]
    words = "osqp, 2 QPs per sample, cap 2: 10 % of the steps, but no run"
    assert words in texts(rows)[0]["Failures"]


def test_what_is_worse_than_no_qp_is_named():
    assert texts(frame())[0]["Worse than no QP"] == "No configuration."
    rows = frame()
    observer = rows[(rows.backend == "observer") & (rows.horizon == 10)].set_index("seed")
    worse = (rows.backend == "osqp") & (rows.solver_iterations == 2) & (rows.horizon == 10)
    rows.loc[worse, "rmse"] = 4.0 * observer.rmse.loc[rows.seed[worse]].to_numpy()
    late = (rows.backend == "daqp") & rows.solver_iterations.isna() & (rows.horizon == 10)
    rows.loc[late, "rmse_settled"] = (
        1.5 * observer.rmse_settled.loc[rows.seed[late]].to_numpy()
    )
    mean = 4.0 * observer.rmse.mean()
    settled = 1.5 * observer.rmse_settled.mean()
    assert texts(rows)[0]["Worse than no QP"] == (
        "2 of 6 configurations have a larger error than the observer alone, although J is never "
        "above the candidate's: osqp, 2 QPs per sample, cap 2 "
        f"(RMSE {number(mean)}, 4.00 times); daqp, 2 QPs per sample "
        f"(RMSE after settling {number(settled)}, 1.50 times)."
    )
    early = rows.assign(rmse=frame().rmse)
    assert texts(early)[0]["Worse than no QP"].startswith(
        "1 of 6 configurations has a larger error after settling than the observer alone")
    rows.loc[worse, "rmse"] = np.inf
    assert "osqp, 2 QPs per sample, cap 2 (RMSE ∞); daqp" in texts(rows)[0]["Worse than no QP"]


def test_one_backend_at_one_cap_is_not_drawn():
    rows = summarise(frame())
    assert anytime(rows[rows["solver_iterations"].isna()]) is not None
    assert anytime(rows[rows["solver_iterations"].isna() & (rows["backend"] != "osqp")
                        & (rows["backend"] != "proxqp")]) is None


def test_most_of_what_is_worse_is_counted():
    rows = frame().query("horizon == 10 and backend != 'observer'")
    assert "Worse than no QP" not in texts(rows)[0]  # without the observer
    worse = (rows.assign(solver_iterations=cap, rmse=rows.rmse * 100.0) for cap in (1, 2, 3))
    rows = pd.concat([frame().query("horizon == 10 and backend == 'observer'"), *worse])
    text = texts(rows.drop_duplicates(["backend", "solver_iterations", "seed"]))[0]
    assert text["Worse than no QP"].startswith("9 of 9 configurations have")
    assert text["Worse than no QP"].endswith("; and 3 more.")


def test_accuracy_or_times_alone_and_nothing_at_all(tmp_path):
    rows = frame().query("horizon == 10").assign(times=None)
    rows[["time_median", "time_p95", "time_p99", "time_max"]] = np.nan
    found, _ = texts(rows)
    assert "accuracy only" in found["Fastest"]
    assert "RMSE" in found["Most accurate"]
    assert any("No times" in note for note in limitations(rows, summarise(rows)))
    text = write_report(Altered(rows), tmp_path / "accuracy").read_text(encoding="utf-8")
    assert "Accuracy against time" not in text
    assert "Time per step" not in text
    assert "Stopping the solver early" in text
    found, _ = texts(frame().assign(outcome="failed", reason="crash"))
    assert found["Result"] == "No configuration finished all its runs."
    with pytest.raises(InvalidInputError, match="no finished cell"):
        write_report((frame()[:0], {}), tmp_path)

    page = write_report(Altered(frame().query("horizon == 10").assign(cost_ratio=np.nan)), tmp_path)
    text, (_, data) = page.read_text(encoding="utf-8"), embedded(page)
    assert "Performance profile" not in text
    assert "true cost J" not in text
    assert not (tmp_path / "profile.png").exists()
    (case,) = data["cases"].values()
    assert case["profile"] is None
    assert "cost_ratio" not in case["accuracy"]
    assert case["anytime"]["layout"]["yaxis"]["title"]["text"] == "RMSE"


def test_limitations_and_failures_follow_the_data():
    rows = frame()
    before = " ".join(limitations(rows, summarise(rows)))
    assert "3 seeds" in before
    assert "shared" not in before
    fewer = spoilt("osqp", 1, "x")
    found = failures(fewer)
    assert {row["configuration"] for row in found} == {
        "osqp, 2 QPs per sample", "osqp, 2 QPs per sample, cap 2"
    }
    assert all(row["seeds"] == [1] and row["reason"] == "x" for row in found)
    rows = pd.concat([fewer.assign(shared=True), rows.assign(environment=1)[:1]])
    after = " ".join(limitations(rows, summarise(rows)))
    assert "cores were shared" in after
    assert "2 environments" in after
    assert "2 of 31 runs failed" in after
    assert "fewer runs" in after


def test_spreads_and_profile_against_their_definitions():
    rows = frame()
    (one,) = (one for one in spreads(rows.query("horizon == 10"))
              if (one.backend, one.cap) == ("daqp", "2"))
    mine = rows.query("horizon == 10 and backend == 'daqp' and solver_iterations == 2")
    times = np.concatenate(list(mine.times)).astype(float)
    assert one.steps == 120 == times.size
    shares = (0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
    assert one.quantiles == pytest.approx(np.quantile(times, shares).tolist())

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
    assert profiles(rows.query("seed == 0 and horizon == 10")) == []  # one problem
    assert profiles(rows.assign(cost_ratio=2.0)) == []  # nothing is solved


def test_thirty_backends_look_different():
    drawn = styles([f"solver {k:02d}" for k in range(30)]).values()
    assert len({(one.color, one.symbol) for one in drawn}) == 31
    assert len({(one.color, one.dash) for one in drawn}) == 31


def test_numbers_durations_and_shares_in_words():
    for words, cases_of in {
        number: {0.0: "0", 0.012345: "0.0123", 0.99999: "1.00", 1234567.0: "1.23e+06",
                 999.9: "1,000", -2.5: "-2.50", float("inf"): "∞", float("nan"): "–"},  # noqa: RUF001
        seconds: {1.234e-6: "1.23 µs", 0.0009999: "1.00 ms", 0.0123: "12.3 ms", 2.0: "2.00 s"},
        percent: {0: "0 %", 1e-5: "< 0.1 %", 0.123: "12.3 %", 0.99999: "> 99.9 %", 1: "100 %"},
    }.items():
        assert {value: words(value) for value in cases_of} == cases_of


def test_a_menu_entry_for_each_state():
    rows, (_, data) = summarise(frame()), embedded(written())
    case = data["cases"]["batch-reactor-N-10"]
    entries = dict(case["menus"]["accuracy"]["metric"])
    assert list(entries)[:5] == ["rmse", "rmse_settled", "rmse_excess", "cost_ratio", "cost"]
    assert list(entries.values())[5:] == ["RMSE of x1 (A)", "RMSE of x2 (B)"]
    assert set(case["accuracy"]) == set(entries)
    for j in (0, 1):
        drawn = sorted(
            y for trace in case["accuracy"][f"rmse_{j + 1}"]["data"]
            if trace["meta"].get("backend") for y in trace["y"]
        )
        expected = [one[j] for one in rows[rows.horizon == 10].rmse_states]
        assert drawn == pytest.approx(sorted(expected))
        assert case["accuracy"][f"rmse_{j + 1}"]["layout"]["yaxis"]["title"]["text"] == (
            entries[f"rmse_{j + 1}"]
        )
    (one, *_) = cases(rows)
    assert Part(one, frame(), None).state_labels() == ["state 1", "state 2"]  # without names


@pytest.mark.parametrize("inches", [None, 3.3])
def test_no_text_is_clipped_or_covered(inches):
    rows = frame()
    parts = []
    for case in cases(summarise(rows)):
        cells = rows[rows.horizon == case.summary.horizon.iloc[0]]
        runs = choose_runs(stored(), cells, case, 100_000)
        assert runs.observer is not None
        few = choose_runs(stored(), cells, case, 0)  # where there is room for few
        assert few.left_out == len(runs.all) - len(few.all) > 0
        parts.append(Part(case, cells, 1e-3, runs))
    found = files(parts, styles(sorted(rows.backend)), profiles(rows), inches)
    assert len(found) == 9 + 2  # the errors against N and i
    for figure in found.values():
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


def test_report_is_whole_and_needs_no_network():
    page = written()
    folder, text = page.parent, page.read_text(encoding="utf-8")
    assert page.stat().st_size < 8e6
    assert not re.findall(r"""<(?:script|link|img|iframe)[^>]*(?:src|href)\s*=\s*["']?http""", text)
    stems = {f"batch-reactor-N-{n}-{kind}" for n in (4, 10)
             for kind in ("accuracy-time", "anytime", "step-times", "run")}
    stems |= {"profile", "batch-reactor-daqp-error-N", "batch-reactor-daqp-error-i"}
    assert {path.name for path in folder.iterdir()} == {
        "index.html", "summary.csv", *(f"{stem}.{end}" for stem in stems for end in ("png", "svg"))
    }
    for stem in stems:
        assert imread(folder / f"{stem}.png")[..., :3].std() > 0.02
    table = pd.read_csv(folder / "summary.csv")
    assert table.rmse.to_numpy() == pytest.approx(summarise(frame()).rmse.to_numpy())
    versions = stored().meta()["environments"][0]["versions"]
    assert f"numpy {versions['numpy']}" in text


def embedded(page):
    """The texts of the page's script elements, as a browser ends them, and the figures' data."""
    text = page.read_text(encoding="utf-8")
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", text, re.DOTALL)
    return scripts, next(json.loads(one) for one in scripts if one.startswith('{"cases"'))


def test_the_figures_are_what_plotly_takes():
    graph_objects = pytest.importorskip("plotly.graph_objects")
    _, data = embedded(written())
    for case in data["cases"].values():
        figures = [case[name] for name in ("anytime", "times", "profile", "trajectories")]
        for figure in [*figures, *case["accuracy"].values()]:
            graph_objects.Figure(figure)  # raises where plotly does not know a property
            assert figure["data"]


def test_no_text_of_a_user_reaches_into_the_script_elements(tmp_path):
    label = "]]><!--<script></script>"

    class Labelled(Altered):
        def trajectory(self, key):
            return {**stored().trajectory(key), "labels": [label, "y"]}

    rows = spoilt("proxqp", 1, "</script><b>out of time").query("horizon == 4")
    plain = embedded(write_report((rows, stored().meta()), tmp_path / "plain"))[0]
    page = write_report(Labelled(rows.assign(model=f"m.py:make(label={label!r})")), tmp_path)
    scripts, data = embedded(page)
    assert 'id="trajectories"' not in (tmp_path / "plain" / "index.html").read_text()
    assert len(scripts) == len(plain)
    # "<!--" and then "<script" would keep a browser within the element beyond its end.
    assert [one.count("<!--") for one in scripts] == [one.count("<!--") for one in plain]
    text = page.read_text(encoding="utf-8")
    assert "&lt;/script&gt;&lt;b&gt;out of time" in text
    assert "</script><b>" not in text
    titles = [
        axis["title"]["text"] for case in data["cases"].values()
        for name, axis in case["trajectories"]["layout"].items() if name.startswith("yaxis")
    ]
    assert titles == [label, "y"]


def test_a_full_disk_leaves_the_former_report(tmp_path):
    page = tmp_path / "index.html"
    page.write_text("the former one")
    content = frame().query("horizon == 4"), stored().meta()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # to a program, a full disk
    try:
        with pytest.raises(InvalidInputError, match=r"cannot write the report into .*make room"):
            write_report(content, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [
        ("index.html", "the former one")]


def test_libraries_are_loaded_late():
    code = (
        "import sys, qpmhe.studies.report, qpmhe.cli.report;"
        "print([m for m in ('pandas', 'plotly', 'itables', 'matplotlib.pyplot')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def shown(summary, width):
    """What the terminal shows, and the headings of its first table, or their last words."""
    console = Console(width=width, record=True, color_system=None, file=StringIO())
    show(console, summary)
    text = console.export_text()
    assert "…" not in text
    (line, *_) = (line for line in text.splitlines() if line.strip().startswith("backend"))
    return text, set(re.split(r"\s{2,}", line.strip()))


def table_lines(text):
    return [line for line in text.splitlines() if re.match(r"\s*(daqp|osqp|proxqp|obs\w+) ", line)]


@pytest.mark.parametrize("width", [80, 120, 200])
def test_the_terminals_room_is_used(width):
    text, headings = shown(summarise(frame()), width)
    assert {"RMSE", "conv.", "median", "impr."} <= headings
    assert ("99 %" in headings) == (width >= 120)
    assert ({"95 %", "kept", "back", "hits", "max"} <= headings) == (width == 200)
    assert ("Only in the report, for want of room" in " ".join(text.split())) == (width < 200)
    assert not {"late", "NEES"} & headings
    # What was asked for is shown at any width: generic backends, two starts, failed runs.
    rows = frame().query("horizon == 10")
    rows = rows.assign(late=0.9995, nees=1230.0, backend="qpsolvers:" + rows.backend)
    text, headings = shown(summarise(pd.concat([rows, rows.assign(start="best")])), width)
    assert {"late", "NEES", "RMSE", "median"} <= headings
    assert "> 99.9 %" in text
    assert "1,230" in text


def test_the_best_of_a_column_is_marked_once_and_of_many_rows_those_that_matter_are_shown():
    rows = frame().query("horizon == 10")
    summary = summarise(rows)
    lines = table_lines(shown(summary, 120)[0])
    assert len(lines) == len(summary)
    assert {line.split()[0] for line in lines if re.search(r"[µm]s\*", line)} == {"observer"}
    near = summary[summary.rmse <= summary.rmse.min() * 1.001]
    best = near.loc[near.time_median.idxmin()]
    assert [line.split()[0] for line in lines if f"{best.rmse:.3f}*" in line] == [best.backend]
    assert sum(line.rstrip().endswith("front") for line in lines) == summary.pareto.sum()
    capped = rows[rows.solver_iterations == 2]
    summary = summarise(pd.concat([rows, *(
        capped.assign(solver_iterations=capped.solver_iterations + cap, rmse=capped.rmse * 2)
        for cap in range(1, 13)
    )]))
    text, _ = shown(summary, 120)
    lines = table_lines(text)
    assert len(lines) == int(re.search(r"(\d+) of 43 configurations", text).group(1)) < 20
    assert {line.split()[0] for line in lines} == {"daqp", "osqp", "proxqp", "observer"}
    assert sum(line.rstrip().endswith("front") for line in lines) == summary.pareto.sum()
