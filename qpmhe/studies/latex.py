"""The results of a study as LaTeX tables."""

from __future__ import annotations

import math
import re
from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InvalidInputError
from .environment import environment_words
from .report.answers import cases
from .report.words import cap_words, qps_words
from .store import Store
from .summary import student, summarise

# Column of the summary, heading, and the factor to what is shown.
_COLUMNS = (
    ("rmse", "RMSE", 1.0), ("cost", r"$J$", 1.0), ("cost_ratio", r"$J / J^*$", 1.0),
    ("time_median", r"time ($\mu$s)", 1e6), ("late", r"late (\%)", 100.0),
    ("improved", r"improved (\%)", 100.0), ("failed_steps", r"failed steps (\%)", 100.0),
)
_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
}


def tables(store: Store | str | Path, keys: Set[str] | None = None) -> str:
    """One table a model and horizon, of the cells with these keys; of all if left out."""
    held = store if isinstance(store, Store) else Store(store)
    frame = held.frame()
    if keys is not None:
        frame = frame[frame["key"].isin(keys)]
    if frame.empty:
        raise InvalidInputError(f"{held.path} has no cell of this study; run it first.")
    places = held.meta()["environments"]
    backends = set(frame["backend"])
    machines = [environment_words(places[k], backends) for k in sorted(set(frame["environment"]))]
    return "\n".join(_table(case.title, case.summary, machines) for case in cases(summarise(frame)))


def escaped(text: str) -> str:
    r"""A text in which LaTeX sees no commands: ``a_b`` becomes ``a\_b``."""
    return re.sub(r"[\\~^&%$#_{}]", lambda found: _SPECIAL[found[0]], text)


def with_error(mean: float, error: float) -> str:
    """A mean and its standard error, rounded to two digits of the error."""
    if not math.isfinite(mean):
        return "--"
    if not (math.isfinite(error) and error > 0.0):
        return f"${mean:.3g}$" if 1e-3 <= abs(mean) < 1e4 or mean == 0.0 else _power(mean, 0.0)
    exponent = math.floor(math.log10(max(abs(mean), error)))
    if not -3 <= exponent < 5:
        return _power(mean, error)
    places = max(0, 1 - math.floor(math.log10(error)))
    return rf"${mean:.{places}f} \pm {error:.{places}f}$"


def _power(mean: float, error: float) -> str:
    exponent = math.floor(math.log10(max(abs(mean), error)))
    inner = with_error(mean / 10.0**exponent, error / 10.0**exponent).strip("$")
    return rf"$({inner}) \cdot 10^{{{exponent}}}$" if error else rf"${inner} \cdot 10^{{{exponent}}}$"


def _table(title: str, rows: Any, machines: list[str]) -> str:
    shown = [one for one in _COLUMNS if rows[one[0]].notna().any()]
    starts = ["start"] if rows["start"].nunique() > 1 else []
    # A cost says little where the error is known.
    if rows["rmse"].notna().any():
        shown = [one for one in shown if one[0] != "cost"]
    seeds = int(rows["seeds"].max())
    heads = ["backend", "QPs", "cap", *starts, *(words for _, words, _ in shown), "failed runs"]
    lines = [
        f"% {title}".replace("\n", " "),
        *(f"% {words}".replace("\n", " ") for words in machines),
        f"% {seeds} run{'s' * (seeds > 1)} of each configuration"
        + ("; mean \\pm standard error of the mean" if seeds > 1 else "")
        + ". Needs \\usepackage{booktabs}.",
        rf"\begin{{tabular}}{{l{'r' * (len(heads) - 1)}}}",
        r"\toprule", " & ".join(heads) + r" \\", r"\midrule",
    ]
    for _, row in rows.iterrows():
        # The half-width of the 95 % limits is Student's quantile times the standard error.
        count = row["seeds"] - row["failures"]
        quantile = float(student(np.array([count]))[0]) if count > 1 else math.nan
        cells = [
            with_error(scale * float(row[name]), scale * _half(row, name) / quantile)
            for name, _, scale in shown
        ]
        failed = f"{row['failures']} of {row['seeds']}" if row["failures"] else "0"
        lines.append(" & ".join([
            escaped(str(row["backend"])), qps_words(row["qps"]),
            cap_words(row["solver_iterations"]), *(str(row[name]) for name in starts), *cells,
            failed,
        ]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _half(row: Any, name: str) -> float:
    """Half the width of the limits; a side may be cut where the quantity cannot lie."""
    mean = float(row[name])
    return max(float(row[f"{name}_high"]) - mean, mean - float(row[f"{name}_low"]))
