"""The report: one HTML file that needs no network, static figures, and the summary as CSV."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from ...errors import InvalidInputError
from ...plots import save
from ..summary import TOLERANCE, pareto_front, summarise
from . import interactive, static, static_time
from .answers import Case, cases, failures, limitations
from .interactive_time import distribution, performance
from .profile import SOLVED, Profile, profiles
from .runs import MOST_STATES, Runs, choose
from .style import Style, styles
from .table import bundle, table
from .times import spreads
from .words import listed, missing, percent, usual_first

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Source", "write_report"]

#: Bytes of trajectories that the page may hold.
_TRAJECTORY_BYTES = 1_000_000
_METRICS = (
    ("rmse", "RMSE"),
    ("rmse_settled", "RMSE after settling"),
    ("rmse_excess", f"RMSE above the best (%, at least {100 * TOLERANCE:g})"),
    ("cost_ratio", "J / converged J"),
)
# Settings with a unit, and what None means in a setting.
_HEADINGS = {"deadline": "deadline (s)", "cell_timeout": "cell timeout (s)", "qps": "QPs"}
_NONE = {
    "qps": "converged", "horizons": "the model's", "steps": "the model's", "backends": "all",
    "git": "not in a repository", "threads": "not limited",
}


class Source(Protocol):
    """What a report is made of; `qpmhe.studies.Store` is one."""

    def frame(self) -> DataFrame:
        """One row a cell."""
        ...

    def meta(self) -> Mapping[str, Any]:
        """``study`` (settings), ``environments`` (list of mappings)."""
        ...

    def trajectory(self, key: str) -> Mapping[str, Any] | None:
        """Times, states, estimates, labels, title and time_unit of a cell; None if not kept."""
        ...


def write_report(
    source: Source | tuple[DataFrame, Mapping[str, Any]], out: str | Path
) -> Path:
    """Write ``index.html``, figures as PNG and SVG, and ``summary.csv`` into a folder.

    Parameters
    ----------
    source : Source or (frame, meta)
        A store; or its frame and meta alone, then without trajectories.
    out : path
        The folder; it is made.

    Returns
    -------
    Path
        The HTML file. It holds all that it shows and asks for nothing over the network.

    Raises
    ------
    InvalidInputError
        If there is no finished cell, the folder cannot be made, or a library is missing.
    """
    _check_libraries()
    frame, meta = source if isinstance(source, tuple) else (source.frame(), source.meta())
    if not len(frame):
        raise InvalidInputError(
            "the study has no finished cell, so that there is nothing to report; run it first."
        )
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot make the folder {folder}: {error.strerror}.") from error
    summary = summarise(frame)
    found = cases(summary)
    drawn = styles(summary["backend"])
    profile = profiles(frame)
    deadline = (meta.get("study") or {}).get("deadline")
    runs = {
        case.key: Runs() if isinstance(source, tuple)
        else choose(source, _cells(frame, case), case, _TRAJECTORY_BYTES // len(found))
        for case in found
    }
    page = folder / "index.html"
    page.write_text(_page(frame, meta, found, drawn, profile, deadline, runs), encoding="utf-8")
    summary.to_csv(folder / "summary.csv", index=False)
    for case in found:
        cells = _cells(frame, case)
        for name, figure in static.figures(case, cells, drawn, deadline, runs[case.key]).items():
            save(figure, folder / f"{case.key}-{name}")
    overall = static_time.performance(profile, drawn)
    if overall is not None:
        save(overall, folder / "profile")
    return page


def _check_libraries() -> None:
    absent = [name for name in ("pandas", "plotly", "itables", "jinja2") if not find_spec(name)]
    if absent:
        raise InvalidInputError(
            f"the report needs {listed(absent)}, not installed here: pip install 'qpmhe[studies]'."
        )


def _cells(frame: DataFrame, case: Case) -> DataFrame:
    first = case.summary.iloc[0]
    chosen = frame["model"] == first["model"]
    for name in ("horizon", "steps"):
        column, value = frame[name], first[name]
        same = column.isna() if missing(value) else (column == value).fillna(False)
        chosen &= same.astype(bool)
    return frame[chosen]


def _page(
    frame: DataFrame,
    meta: Mapping[str, Any],
    found: list[Case],
    drawn: Mapping[str, Style],
    profile: list[Profile],
    deadline: float | None,
    runs: Mapping[str, Runs],
) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    jinja = Environment(
        loader=PackageLoader("qpmhe.studies.report", "."), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )
    parts = Path(__file__).parent
    data = {
        "cases": {
            case.key: _figures(case, _cells(frame, case), drawn, profile, deadline, runs[case.key])
            for case in found
        },
        "columns": {"backend": 0, "case": 1},
    }
    done = int((frame["outcome"] == "done").sum())
    models = listed([str(model) for model in dict.fromkeys(frame["model"])])
    return jinja.get_template("page.html.j2").render(
        title=f"Backends compared: {models}",
        subtitle=f"{len(frame)} runs ({done} finished, {len(frame) - done} failed) of "
        f"{sum(len(case.summary) for case in found)} configurations, "
        f"{frame['seed'].nunique()} seeds, up to {int(frame['steps'].max())} steps each.",
        css=(parts / "page.css").read_text(encoding="utf-8"),
        script=(parts / "page.js").read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
        bundle=bundle(),
        table=table(found),
        # "</" would end the script element wherever it stands, in a user's text too.
        data=_json(data).replace("</", "<\\/"),
        cases=found,
        styles=[(name, style) for name, style in drawn.items() if name in set(frame["backend"])],
        metrics=_METRICS,
        problems=profile[0].problems if profile else 0,
        solved=percent(SOLVED),
        profile_words="; ".join(one.words for one in profile),
        most_states=MOST_STATES,
        trajectories=any(one.all for one in runs.values()),
        left_out=sum(one.left_out for one in runs.values()),
        limitations=limitations(frame, summary=_joined(found)),
        failures=failures(frame),
        settings=_flat(meta.get("study") or {}),
        environments=[_flat(one) for one in meta.get("environments") or []],
    )


def _joined(found: list[Case]) -> DataFrame:
    import pandas as pd

    return pd.concat([case.summary for case in found])


def _figures(
    case: Case,
    frame: DataFrame,
    drawn: Mapping[str, Style],
    profile: list[Profile],
    deadline: float | None,
    runs: Runs,
) -> dict[str, Any]:
    from .words import cap_words, qps_words

    summary = case.summary
    whole = summary["failures"] == 0
    measures = {}
    for metric, label in _METRICS:
        by = "rmse" if metric == "rmse_excess" else metric
        front = whole & pareto_front(
            summary["time_median"].where(whole), summary[by].where(whole), TOLERANCE
        )
        rows = _in_percent(summary) if metric == "rmse_excess" else summary
        measures[metric] = interactive.accuracy(rows, drawn, metric, label, front)
    rest = summary[summary["backend"] != "observer"]
    qps = [
        (word, word) for word in sorted(
            {qps_words(one) for one in rest["qps"]}, key=lambda w: (not w.isdigit(), w.zfill(9))
        )
    ]
    caps = [
        (word, word) for word in sorted(
            {cap_words(one) for one in rest["solver_iterations"]},
            key=lambda w: (not w.isdigit(), w.zfill(9)),
        )
    ]
    starts = [(str(one), str(one)) for one in sorted(rest["start"].unique(), key=usual_first)]
    numbers = [word for word, _ in qps if word.isdigit()]
    return {
        "accuracy": measures,
        "anytime": interactive.anytime(summary, drawn, "RMSE") if len(rest) else None,
        "times": distribution(spreads(frame), drawn, deadline),
        "profile": performance(profile, drawn),
        "trajectories": runs.figure,
        "runs": {"observer": runs.observer, "all": runs.all},
        "menus": {
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


def _in_percent(summary: DataFrame) -> DataFrame:
    """The excess over the best in per cent, no less than the tolerance, for a logarithmic axis."""
    names = ("rmse_excess", "rmse_excess_low", "rmse_excess_high")
    least = 100.0 * TOLERANCE
    return summary.assign(**{name: (100.0 * summary[name]).clip(lower=least) for name in names})


def _json(value: Any) -> str:
    from plotly.utils import PlotlyJSONEncoder

    return json.dumps(value, cls=PlotlyJSONEncoder, separators=(",", ":"))


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
