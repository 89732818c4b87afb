"""The report: an HTML file that needs no network, figures as PNG and SVG, the summary as CSV."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._checks import make_folder
from ...errors import InvalidInputError
from ...plots import COLORS, save, trajectories
from ...plots.style import inches_of
from ..environment import environment_words
from ..store import Store, opened
from ..summary import PROBLEM, RANKED_BY, TOLERANCE, cells_of, pareto_front, summarise
from . import figures
from .answers import Case, cases, chosen, failures, file_name, limitations
from .drawing import Axis, Drawing, Mark, Panel, Style, interactive, static, styles
from .figures import SOLVED, Profile
from .words import (
    cap_words,
    configuration_words,
    listed,
    missing,
    percent,
    qps_heading,
    qps_words,
    ranked,
    usual_first,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_LIBRARIES = ("pandas", "plotly", "itables", "jinja2")

#: States that the page draws, and a file.
MOST_STATES, _MOST_STATIC = 12, 6
# Inches that a column of panels needs.
_COLUMN = 2.2
# Bytes of trajectories that the page may hold.
_TRAJECTORY_BYTES = 1_000_000
_METRICS = {
    "rmse": "RMSE",
    "rmse_settled": "RMSE after settling",
    "rmse_excess": f"RMSE above the best (%, at least {100 * TOLERANCE:g})",
    "cost_ratio": "J / converged J",
    "cost": "mean J",
}
# Settings with a unit, and what None means in a setting.
_HEADINGS = {"deadline": "deadline (s)", "cell_timeout": "cell timeout (s)", "qps": "QPs"}
_NONE = {
    "qps": "converged", "horizons": "the model's", "steps": "the model's", "backends": "all",
    "git": "not in a repository", "threads": "not limited",
}
# How the lines of a trajectory look.
_ROLES = {
    "truth": Style(COLORS["truth"], "circle", "o", "", "solid", "-"),
    "observer": Style(COLORS["observer"], "circle", "o", "", "dash", "--"),
    "estimate": Style(COLORS["estimate"], "circle", "o", "", "solid", "-"),
}
_SIGNIFICANT = """function (value, type) {
  if (type === 'sort' && (value === null || Number.isNaN(value))) { return Infinity; }
  if (type !== 'display') { return value; }
  if (value === null || Number.isNaN(value)) { return '\\u2013'; }
  if (!Number.isFinite(value)) { return value > 0 ? '\\u221e' : '-\\u221e'; }
  const scaled = value * SCALE, size = Math.abs(scaled);
  if (size === 0) { return '0'; }
  if (size >= 99950 || size < 1e-4) { return scaled.toExponential(2); }
  if (size >= 999.5) { return Math.round(scaled).toLocaleString('en'); }
  return scaled.toPrecision(3);
}"""
# The page's script waits for the table; initComplete comes too late to be evaluated by itables.
_TELL = """function () {
  if (window.configurationTable) { return; }
  window.configurationTable = this.api();
  window.dispatchEvent(new Event('configurationTable'));
}"""
# Shown while there are columns out of sight; the page's script gives it its work.
_FURTHER = '<button id="further" type="button">more columns →</button>'
# Column of the summary, heading, and the factor to what is shown (None: a count); what decides
# comes first.
_NUMBERS: tuple[tuple[str, str, float | None], ...] = (
    ("rmse", "RMSE", 1.0),
    ("rmse_half", "±\u00a095\u00a0%", 1.0),
    ("cost_ratio", "J / converged", 1.0),
    ("time_median", "time median (µs)", 1e6),
    ("time_p99", "time 99\u00a0% (µs)", 1e6),
    ("late", "late (%)", 100.0),
    ("nees", "NEES", 1.0),
    ("failures", "failed runs", None),
    ("failed_steps", "failed steps (%)", 100.0),
    ("fallback", "fallback (%)", 100.0),
    ("improved", "improved (%)", 100.0),
    ("cap_hits", "cap hits (%)", 100.0),
    ("rmse_settled", "RMSE settled", 1.0),
    ("cost", "mean J", 1.0),
    ("time_half", "time ±\u00a095\u00a0% (µs)", 1e6),
    ("time_p95", "time 95\u00a0% (µs)", 1e6),
    ("time_max", "time max (µs)", 1e6),
    ("kept", "kept (%)", 100.0),
    ("qps_mean", "QPs used", 1.0),
    ("solver_iterations_mean", "solver iterations", 1.0),
    ("seeds", "seeds", None),
)
_ORDER = ("time median (µs)", "RMSE", "mean J")
_WHY = {
    "CONVERGED": "converged", "UNCONVERGED": "not converged", "NO_DECREASE": "no decrease",
    "SOLVER_STOPPED": "solver stopped",
    "SOLVER_FAILED": "solver failed", "MODEL_FAILED": "model failed", "TIME_UP": "time up",
    "ROWS_DROPPED": "rows dropped", "CANDIDATE_OUTSIDE": "candidate outside",
}


def write_report(
    source: Store | str | Path | tuple[DataFrame, Mapping[str, Any]], out: str | Path, *,
    width: str | float | None = None,
) -> Path:
    """Write ``index.html``, figures as PNG and SVG, and ``summary.csv`` into a folder.

    The figures show accuracy against time, what caps cost, step times and a run; where the study
    varies them, the error against N, noise level and i.

    Parameters
    ----------
    source : Store, path or (frame, meta)
        A store or its file; or only its frame and meta, then without trajectories.
    out : path
        The folder; it is made.
    width : {"single", "double"} or float, optional
        For a paper: also write the figures as PDF of this width; see `qpmhe.plots.save`.

    Returns
    -------
    Path
        The HTML file, which needs nothing from the network.

    Raises
    ------
    StoreError, InvalidInputError, OptionError
        If the store cannot be read or has no finished cell, the folder cannot be made, a library is
        missing, or the width is invalid.
    """
    check_libraries()
    inches = inches_of(width)
    held: Any = source
    if not (isinstance(held, tuple) or hasattr(held, "frame")):
        held = opened(held)
    frame, meta = held if isinstance(held, tuple) else (held.frame(), held.meta())
    if not len(frame):
        raise InvalidInputError(
            "the study has no finished cell to report; run it first."
        )
    folder = make_folder(out)
    summary = summarise(frame)
    deadline = (meta.get("study") or {}).get("deadline")
    found = [
        Part(case, cells_of(frame, case.summary.iloc[0], PROBLEM), deadline)
        for case in cases(summary)
    ]
    if not isinstance(held, tuple):
        for part in found:
            part.runs = choose_runs(held, part.cells, part.case, _TRAJECTORY_BYTES // len(found))
    drawn, profile = styles(sorted(summary["backend"])), figures.profiles(frame)
    page, unfinished = folder / "index.html", folder / "index.html.part"
    try:
        # A former report stays whole where the new one cannot be written.
        unfinished.write_text(_page(frame, summary, meta, found, drawn, profile), "utf-8")
        unfinished.replace(page)
        summary.assign(environment=" | ".join(_machines(meta, summary))).to_csv(
            folder / "summary.csv", index=False)
        for name, figure in files(found, drawn, profile, inches).items():
            save(figure, folder / name, width=inches)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise InvalidInputError(
            f"cannot write the report into {folder}: {error.strerror or error}. The store is as it "
            "was; make room, or name another folder, and write the report again."
        ) from error
    return page


def check_libraries() -> None:
    """Raise an `InvalidInputError` where a library that the report needs is missing."""
    absent = [name for name in _LIBRARIES if not find_spec(name)]
    if absent:
        raise InvalidInputError(
            f"the report needs {listed(absent)}, not installed here: pip install 'qpmhe[studies]'."
        )


@dataclass
class Runs:
    """The runs of one case that a report holds, the best first."""

    first: Mapping[str, Any] | None = None  # has the real states
    observer: list[Any] | None = None  # an encoded array for each state
    all: dict[str, list[Any]] = field(default_factory=dict)  # the same, by the cell's key
    entries: list[tuple[str, str]] = field(default_factory=list)  # key and words
    static: list[tuple[str, Any]] = field(default_factory=list)  # words and trajectory
    left_out: int = 0  # runs for which there was no room


@dataclass
class Part:
    """What a report says about one case."""

    case: Case
    cells: DataFrame
    deadline: float | None
    runs: Runs = field(default_factory=Runs)

    def state_labels(self) -> list[str]:
        """Names of the states, at most `MOST_STATES`: the model's, or numbers without a run."""
        if self.runs.first is not None:
            return [str(one) for one in self.runs.first["labels"]][:MOST_STATES]
        sizes = [len(one) for one in self.case.summary["rmse_states"] if isinstance(one, list)]
        return [f"state {j + 1}" for j in range(min(max(sizes, default=0), MOST_STATES))]


def choose_runs(source: Store, cells: DataFrame, case: Case, most: int) -> Runs:
    """The runs of one case: the best configurations' first, up to this many bytes."""
    runs = Runs()
    seed = cells["seed"].min()
    first = cells[(cells["seed"] == seed) & (cells["outcome"] == "done")]
    pareto = {
        configuration_words(row): bool(row["pareto"]) for _, row in case.summary.iterrows()
    }
    order = sorted(
        (not pareto[configuration_words(row)], float(row[case.by]), configuration_words(row),
         str(row["key"]))
        for _, row in first.iterrows()
    )
    named = [configuration_words(row) for row in chosen(case.summary) or () if row is not None]
    spent = 0
    for behind, _, words, key in order:
        if spent >= most and "observer" not in words and words not in named:
            runs.left_out += 1
            continue
        trajectory = source.trajectory(key)
        if trajectory is None:
            continue
        runs.first = runs.first or trajectory
        encoded = [_encoded(one) for one in np.asarray(trajectory["estimates"]).T[:MOST_STATES]]
        spent += sum(len(one["bdata"]) for one in encoded)
        if words == "observer":
            runs.observer = encoded
        runs.all[key] = encoded
        runs.entries.append((key, words if behind else f"{words} (Pareto front)"))
        if words == "observer" or words in named:
            runs.static.append((words, trajectory))
    runs.entries.sort(key=lambda entry: entry[1].startswith("observer"))
    return runs


def _encoded(values: Any) -> dict[str, str]:
    """An array as plotly reads it, at a quarter of the size of digits."""
    numbers = np.ascontiguousarray(values, dtype="<f4")
    return {"dtype": "f4", "bdata": b64encode(numbers.tobytes()).decode()}


def _run_figure(first: Mapping[str, Any]) -> dict[str, Any]:
    """The real states of a run, and empty lines for the page to fill."""
    labels = [str(one) for one in first["labels"]][:MOST_STATES]
    times, states = _encoded(first["times"]), np.asarray(first["states"])
    n = len(labels)
    drawing = Drawing([
        Panel(
            Axis(f"time ({first['time_unit']})" if j == n - 1 else "", "linear"),
            Axis(labels[j], "linear"),
            [Mark("curve", [], [], role, meta={"role": role, "state": j}) for role in _ROLES
             if role != "truth" or np.isfinite(states[:, j]).any()],
        )
        for j in range(n)
    ], 90 + (170 if n <= 4 else 115) * n, gap=0.12)
    figure = interactive(drawing, _ROLES)
    assert figure is not None
    for trace in figure["data"]:
        role, j = trace["meta"]["role"], trace["meta"]["state"]
        trace |= {"x": times, "name": role, "legendgroup": role, "showlegend": j == 0}
        if role == "truth":
            trace["y"], trace["line"]["width"] = _encoded(states[:, j]), 4
    layout = figure["layout"]
    for j in range(n):
        axis = layout[f"xaxis{j + 1 if j else ''}"]
        axis |= {"showticklabels": j == n - 1, **({"matches": "x"} if j else {})}
    layout |= {
        "showlegend": True, "margin": {"l": 8, "r": 14, "t": 40, "b": 8},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "xanchor": "left"},
    }
    return figure


def files(
    parts: list[Part], drawn: Mapping[str, Style], profile: list[Profile],
    inches: float | None = None,
) -> dict[str, Figure]:
    """The figures that are written beside the page, by the name of the file."""
    import pandas as pd

    found: dict[str, Any] = {}

    def size(width: float, height: float) -> tuple[float, float]:
        return (width, height) if inches is None else (inches, min(height, 0.8 * inches + 0.4))

    summary = pd.concat([part.case.summary for part in parts])
    for title, (drawing, looks) in figures.sweeps(summary).items():
        found[file_name(title)] = static(drawing, looks, size(5.4, 3.8), title.rpartition(" ")[0])
    for part in parts:
        case, rows = part.case, part.case.summary
        starts = sorted(rows["start"].unique(), key=usual_first)
        start = str(starts[0])
        of_start = f"; start {start}" if len(starts) > 1 else ""

        def columns(words: list[str], **more: str) -> list[tuple[str, dict[str, str]]]:
            room = len(words) if inches is None else max(1, int(inches / _COLUMN))
            words = words[-room:] if room > 1 or "2" not in words else ["2"]
            return [(qps_heading(one), {"qps": one, **more}) for one in words]

        one = figures.accuracy(rows, case.by, RANKED_BY[case.by], rows["pareto"])
        if one is not None:
            found[f"{case.key}-accuracy-time"] = static(
                one, drawn, size(8.6, 4.8), f"{case.title}\nlarger: more QPs per sample; hollow: "
                "capped; pale: runs failed; bars: 95 %",
            )
        one = figures.anytime(rows)
        rest = case.whole[(case.whole["backend"] != "observer") & (case.whole["start"] == start)]
        if one is not None and len(rest):
            words = ranked(map(qps_words, rest["qps"]))
            found[f"{case.key}-anytime"] = static(
                one, drawn, size(1.4 + 2.1 * max(2, len(words)), 5.0),
                f"{case.title}{of_start}", columns(words, start=start),
            )
        spreads = [
            one for one in figures.spreads(part.cells)
            if one.backend == "observer" or (one.cap == "none" and one.start == start)
        ]
        words = ranked(one.qps for one in spreads if one.backend != "observer")
        one = figures.times(spreads, part.deadline)
        if one is not None and words:
            found[f"{case.key}-step-times"] = static(
                one, drawn,
                size(1.6 + 2.3 * max(2, len(words)), 1.5 + 0.27 * len(one.panels[0].y.values)),
                f"{case.title}\nno cap on the solver{of_start}", columns(words),
            )
        if part.runs.static:
            found[f"{case.key}-run"] = _run_file(part.runs)
    one = figures.performance(profile)
    if one is not None:
        found["profile"] = static(
            one, drawn, size(7.2, 4.2),
            f"Solved: J on average within {percent(SOLVED)} of the converged one",
        )
    return found


def _run_file(runs: Runs) -> Figure:
    first = runs.static[0][1]
    labels = [str(one) for one in first["labels"]][:_MOST_STATIC]
    n = len(labels)
    truth = np.asarray(first["states"])[:, :n]
    figure: Figure = trajectories(
        np.asarray(first["times"]), truth if np.isfinite(truth).any() else None,
        {words: np.asarray(one["estimates"])[:, :n] for words, one in runs.static[:6]},
        labels, f"time t ({first['time_unit']})",
    )[0].figure
    return figure


def _machines(meta: Mapping[str, Any], summary: DataFrame) -> list[str]:
    return [environment_words(one, summary["backend"]) for one in meta.get("environments") or []]


def _page(
    frame: DataFrame, summary: DataFrame, meta: Mapping[str, Any], parts: list[Part],
    drawn: Mapping[str, Style], profile: list[Profile],
) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    jinja = Environment(
        loader=PackageLoader("qpmhe.studies.report", "."), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )
    here, found = Path(__file__).parent, [part.case for part in parts]
    overall = figures.performance(profile)
    data = {
        "cases": {part.case.key: _figures(part, drawn, overall) for part in parts},
        "columns": {"backend": 0, "case": 1},
    }
    done, seeds = int((frame["outcome"] == "done").sum()), frame["seed"].nunique()
    models = listed([str(model) for model in dict.fromkeys(frame["model"])])
    study = dict(meta.get("study") or {})
    if study.get("records"):  # they have neither
        study = {key: one for key, one in study.items() if key not in ("seeds", "noise_levels")}
    several = "" if study.get("records") else f"{seeds} seed{'s' * (seeds != 1)}, "
    return jinja.get_template("page.html.j2").render(
        title=f"Backends compared: {models}",
        subtitle=f"{len(frame)} runs ({done} finished, {len(frame) - done} failed) of "
        f"{sum(len(case.summary) for case in found)} configurations, "
        f"{several}up to {int(frame['steps'].max())} steps each.",
        css=(here / "page.css").read_text(encoding="utf-8"),
        script=(here / "page.js").read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
        bundle=_bundle(),
        table=_table(found),
        data=embedded(data),
        cases=found,
        styles=[(name, style) for name, style in drawn.items() if name in set(frame["backend"])],
        timed=bool(frame["time_median"].notna().any()),
        costs=bool(frame["cost_ratio"].notna().any()),
        problems=profile[0].problems if profile else 0,
        solved=percent(SOLVED),
        profile_words="; ".join(one.words for one in profile),
        most_states=MOST_STATES,
        trajectories=any(part.runs.all for part in parts),
        left_out=sum(part.runs.left_out for part in parts),
        limitations=limitations(frame, summary),
        failures=failures(frame),
        settings=_flat(study),
        environments=[_flat(one) for one in meta.get("environments") or []],
        machines=_machines(meta, summary),
        sweeps=listed([
            words for name, (words, _) in figures.AXES.items()
            if summary[name].nunique(dropna=False) > 1
        ]),
    )


def embedded(value: Any) -> str:
    """JSON for a script element that no text in it can end or extend."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _figures(part: Part, drawn: Mapping[str, Style], overall: Drawing | None) -> dict[str, Any]:
    summary, runs = part.case.summary, part.runs
    measures = _measures(part, drawn)
    rest = summary[summary["backend"] != "observer"]
    qps = [(word, word) for word in ranked(map(qps_words, rest["qps"]))]
    caps = [(word, word) for word in ranked(map(cap_words, rest["solver_iterations"]))]
    starts = [(str(one), str(one)) for one in sorted(rest["start"].unique(), key=usual_first)]
    numbers = [word for word, _ in qps if word.isdigit()]
    return {
        "accuracy": {metric: figure for metric, (_, figure) in measures.items()},
        "anytime": interactive(figures.anytime(summary), drawn),
        "times": interactive(figures.times(figures.spreads(part.cells), part.deadline), drawn),
        "profile": interactive(overall, drawn),
        "trajectories": None if runs.first is None else _run_figure(runs.first),
        "runs": {"observer": runs.observer, "all": runs.all},
        "menus": {
            "accuracy": {"metric": [(metric, label) for metric, (label, _) in measures.items()]},
            "anytime": {"qps": qps, "start": starts},
            "times": {"qps": qps, "cap": caps, "start": starts},
            "trajectories": {"run": runs.entries},
        },
        "defaults": {
            "qps": "2" if "2" in numbers else numbers[-1] if numbers else "converged",
            "cap": "none",
            "start": starts[0][0] if starts else None,
            "run": runs.entries[0][0] if runs.entries else None,
        },
    }


def _measures(part: Part, drawn: Mapping[str, Style]) -> dict[str, tuple[str, Any]]:
    """Accuracy against time by each measure of the study: its label and its figure."""
    labels = [f"RMSE of {label}" for label in part.state_labels()]
    summary = figures.with_states(part.case.summary, len(labels))
    whole = summary["failures"] == 0
    found = {}
    states = {f"rmse_{j}": label for j, label in enumerate(labels, start=1)}
    for metric, label in (_METRICS | states).items():
        by = "rmse" if metric == "rmse_excess" else metric
        front = whole & pareto_front(
            summary["time_median"].where(whole), summary[by].where(whole), TOLERANCE
        )
        rows = _in_percent(summary) if metric == "rmse_excess" else summary
        figure = interactive(figures.accuracy(rows, metric, label, front), drawn)
        if figure is not None:
            found[metric] = label, figure
    return found


def _in_percent(summary: DataFrame) -> DataFrame:
    """The excess over the best in per cent, no less than the tolerance, for a logarithmic axis."""
    names = ("rmse_excess", "rmse_excess_low", "rmse_excess_high")
    least = 100.0 * TOLERANCE
    return summary.assign(**{name: (100.0 * summary[name]).clip(lower=least) for name in names})


def _flat(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (_HEADINGS.get(str(key), str(key).replace("_", " ")), _words(value, _NONE.get(str(key))))
        for key, value in content.items()
    ]


def _words(value: Any, nothing: str | None = None) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(one)}" for key, one in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return ", ".join(_words(one, nothing) for one in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return (nothing or "none") if value is None else str(value)


def _bundle() -> str:
    """DataTables as itables ships it: script and style, to be put into the page once."""
    from itables.javascript import generate_init_offline_itables_html
    from itables.options import dt_bundle

    return generate_init_offline_itables_html(dt_bundle)


def _table(cases: list[Case]) -> str:
    """HTML of the table; numbers are sorted as numbers, whatever is shown."""
    import pandas as pd
    from itables import JavascriptFunction, to_html_datatable

    frame = pd.concat([_columns(case) for case in cases], ignore_index=True)
    single = {
        name for name in ("model", "N", "start") if frame[name].astype(str).nunique() == 1
    }
    empty = {
        name for _, name, _ in _NUMBERS if frame[name].isna().all() and name != "mean J"
    }
    frame = frame.drop(columns=sorted(single | empty))
    places = {name: place for place, name in enumerate(frame.columns)}
    definitions: list[dict[str, Any]] = [
        {"targets": [places["case"]], "visible": False, "columnControl": []},
    ]
    for _, name, scale in _NUMBERS:
        if name in places:
            definition: dict[str, Any] = {
                "targets": [places[name]],
                "className": "dt-right",
                "columnControl": ["order", ["searchNumber"]],
            }
            if scale is not None:
                words = _SIGNIFICANT.replace("SCALE", repr(scale))
                definition["render"] = JavascriptFunction(words)
            definitions.append(definition)
    definitions += [
        {"targets": [places[name]], "columnControl": ["order", ["searchList"]],
         "className": "dt-right" if name in ("N", "QPs", "cap") else "dt-left"}
        for name in ("front", "backend", "model", "N", "start", "QPs", "cap") if name in places
    ]
    lengths: list[int | Mapping[str, Any]] = [10, 25, 50, 100, {"label": "all", "value": -1}]
    html = to_html_datatable(
        frame, connected=False, table_id="configurations",
        classes="compact hover row-border nowrap",
        maxBytes=0, maxRows=0, maxColumns=0, showIndex=False, display_logo_when_loading=False,
        columnDefs=definitions, columnControl=["order", ["search"]],
        ordering={"indicators": False, "handler": True},
        order=[[next(places[one] for one in _ORDER if one in places), "asc"]],
        pageLength=25, lengthMenu=lengths, scrollX=True,
        fixedColumns={"start": 1},
        language={"search": "", "searchPlaceholder": "search", "lengthMenu": "_MENU_ rows",
                  "info": "_START_ to _END_ of _TOTAL_ configurations",
                  "infoFiltered": "(of _MAX_)", "infoEmpty": "no configuration",
                  "zeroRecords": "no configuration passes the filters"},
        text_in_header_can_be_selected=False,
        layout={"topStart": {"pageLength": {}}, "topEnd": {"div": {"html": _FURTHER}, "search": {}},
                "bottomStart": {"info": {}}, "bottomEnd": {"paging": {}}},
        style="width:100%", drawCallback=JavascriptFunction(_TELL),
    )
    return str(html)


def _columns(case: Case) -> DataFrame:
    import pandas as pd

    rows = case.summary.assign(
        rmse_half=(case.summary["rmse_high"] - case.summary["rmse_low"]) / 2,
        time_half=(case.summary["time_median_high"] - case.summary["time_median_low"]) / 2,
    )
    frame = pd.DataFrame({
        "backend": rows["backend"].astype(str),
        "case": case.key,
        "model": rows["model"].astype(str),
        "N": ["usual" if missing(one) else str(int(one)) for one in rows["horizon"]],
        "start": rows["start"].astype(str),
        "QPs": _ordered([qps_words(one) for one in rows["qps"]]),
        "cap": _ordered([cap_words(one) for one in rows["solver_iterations"]]),
        "front": ["front" if one else "" for one in rows["pareto"]],
    })
    for name, heading, scale in _NUMBERS:
        frame[heading] = rows[name].astype(int if scale is None else float).to_numpy()
    frame["RMSE by state"] = [_numbers(one) for one in rows["rmse_states"]]
    frame["why a sequence ended"] = [_why(one) for one in rows["reasons"]]
    return frame


def _ordered(words: list[str]) -> Any:
    import pandas as pd

    return pd.Categorical(words, ranked(words), ordered=True)


def _numbers(values: Any) -> str:
    return ", ".join(f"{one:.3g}" for one in values) if isinstance(values, list) else ""


def _why(shares: Any) -> str:
    if not isinstance(shares, dict):
        return ""
    return ", ".join(
        f"{_WHY[flag]} {percent(share)}" for flag, share in shares.items() if flag in _WHY
    )
