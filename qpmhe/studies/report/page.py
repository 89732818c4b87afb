"""The report: an HTML file that needs no network, figures as PNG and SVG, the summary as CSV."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..._checks import make_folder
from ...errors import InvalidInputError
from ...plots import save
from ...plots.style import inches_of
from ..environment import environment_words
from ..store import Store, opened
from ..summary import PROBLEM, cells_of, summarise, with_observers
from . import figures
from .answers import cases, failures, limitations
from .drawing import Picture, Style, styles
from .figures import SOLVED, Profile
from .pictures import MOST_STATES, Part, chosen_runs, pictures
from .table import table
from .words import listed, percent

if TYPE_CHECKING:
    from pandas import DataFrame

_LIBRARIES = ("pandas", "jinja2")

# Settings with a unit, and what None means in a setting.
_HEADINGS = {"deadline": "deadline (s)", "cell_timeout": "cell timeout (s)", "qps": "QPs"}
_NONE = {
    "qps": "converged", "horizons": "the model's", "steps": "the model's", "backends": "all",
    "git": "not in a repository", "threads": "not limited",
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
    folder, frame = make_folder(out), with_observers(frame)
    summary = summarise(frame)
    deadline = (meta.get("study") or {}).get("deadline")
    found = [
        Part(case, cells_of(frame, case.summary.iloc[0], PROBLEM), deadline)
        for case in cases(summary)
    ]
    if not isinstance(held, tuple):
        for part in found:
            part.runs = chosen_runs(held, part.cells, part.case)
    drawn, profile = styles(sorted(summary["backend"])), figures.profiles(frame)
    shown = pictures(found, drawn, profile)
    page, unfinished = folder / "index.html", folder / "index.html.part"
    try:
        # A former report stays whole where the new one cannot be written.
        unfinished.write_text(_page(frame, summary, meta, found, drawn, profile, shown), "utf-8")
        unfinished.replace(page)
        summary.assign(environment=" | ".join(_machines(meta, summary))).to_csv(
            folder / "summary.csv", index=False)
        if inches is not None:
            shown = pictures(found, drawn, profile, inches)
        for name, picture in shown.items():
            save(picture.figure, folder / name, width=inches)
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


def _machines(meta: Mapping[str, Any], summary: DataFrame) -> list[str]:
    return [environment_words(one, summary["backend"]) for one in meta.get("environments") or []]


def _page(
    frame: DataFrame, summary: DataFrame, meta: Mapping[str, Any], parts: list[Part],
    drawn: Mapping[str, Style], profile: list[Profile], shown: Mapping[str, Picture],
) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    jinja = Environment(
        loader=PackageLoader("qpmhe.studies.report", "."), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )
    here, found = Path(__file__).parent, [part.case for part in parts]
    elements = {name: picture.element(f"f{k}") for k, (name, picture) in enumerate(shown.items())}
    errors = [name for name in elements if "-error-" in name]
    done, seeds = int((frame["outcome"] == "done").sum()), frame["seed"].nunique()
    models = listed([str(model) for model in dict.fromkeys(frame["model"])])
    study = dict(meta.get("study") or {})
    study["estimators"] = [
        name if name == made else f"{name} = {made}"
        for name, made in study.get("estimators", {}).items()
    ]
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
        table=table(found),
        pictures=elements,
        errors=errors,
        cases=found,
        styles=[(name, style) for name, style in drawn.items() if name in set(frame["backend"])],
        timed=bool(frame["time_median"].notna().any()),
        costs=bool(frame["cost_ratio"].notna().any()),
        problems=profile[0].problems if profile else 0,
        solved=percent(SOLVED),
        profile_words="; ".join(one.words for one in profile),
        most_states=MOST_STATES,
        limitations=limitations(frame, summary),
        failures=failures(frame),
        settings=_flat(study),
        environments=[_flat(one) for one in meta.get("environments") or []],
        machines=_machines(meta, summary),
    )


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
