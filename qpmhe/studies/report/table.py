"""The table of all configurations, with itables (DataTables), offline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .words import cap_words, missing, percent, qps_words, ranked

if TYPE_CHECKING:
    from pandas import DataFrame

    from .answers import Case

__all__ = ["bundle", "table"]

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
    ("time_half", "time ±\u00a095\u00a0% (µs)", 1e6),
    ("time_p95", "time 95\u00a0% (µs)", 1e6),
    ("time_max", "time max (µs)", 1e6),
    ("kept", "kept (%)", 100.0),
    ("qps_mean", "QPs used", 1.0),
    ("solver_iterations_mean", "solver iterations", 1.0),
    ("seeds", "seeds", None),
)
_WHY = {
    "CONVERGED": "converged", "NO_DECREASE": "no decrease", "SOLVER_STOPPED": "solver stopped",
    "SOLVER_FAILED": "solver failed", "MODEL_FAILED": "model failed", "TIME_UP": "time up",
    "ROWS_DROPPED": "rows dropped", "CANDIDATE_OUTSIDE": "candidate outside",
}


def bundle() -> str:
    """DataTables as itables ships it: script and style, to be put into the page once."""
    from itables.javascript import generate_init_offline_itables_html
    from itables.options import dt_bundle

    return generate_init_offline_itables_html(dt_bundle)


def table(cases: list[Case]) -> str:
    """HTML of the table; numbers are sorted as numbers, whatever is shown."""
    import pandas as pd
    from itables import JavascriptFunction, to_html_datatable

    frame = pd.concat([_columns(case) for case in cases], ignore_index=True)
    single = {
        name for name in ("model", "N", "start") if frame[name].astype(str).nunique() == 1
    }
    empty = {
        name for _, name, _ in _NUMBERS
        if frame[name].isna().all() and name != "RMSE"
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
        order=[[places["time median (µs)"], "asc"]] if "time median (µs)" in places
        else [[places["RMSE"], "asc"]],
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
