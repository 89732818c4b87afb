"""The results of a study for other programs: CSV, Parquet and LaTeX."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np

from .._checks import checked_path, make_folder, need
from ..errors import InvalidInputError, OptionError
from .environment import environment_words
from .report.answers import cases
from .report.words import cap_words, qps_words
from .row import SHOWN
from .store import Store, opened
from .summary import student, summarise, with_observers

_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
}


def export(store: Store | str | Path, path: str | Path) -> Path:
    """Write a store into the file ``path``, and return it.

    ``.csv`` and ``.parquet`` files hold all cells, with versions and machine in ``environment``;
    in CSV, lists and ``reasons`` are JSON texts; in Parquet, only ``reasons`` is. A ``.tex`` file
    holds the tables of `Study.to_latex`, of all cells. The folder is made, an existing file
    replaced. Raises `OptionError` if the name ends differently, `StoreError` if the store cannot be
    read, `InvalidInputError` if the file cannot be written or a package is missing.
    """
    target = checked_path("the file", path)
    if target.suffix not in (".csv", ".parquet", ".tex"):
        raise OptionError(f"the file is {str(path)!r}; expected a name in .csv, .parquet or .tex.")
    held = opened(store)
    frame, places = held.frame(), held.meta()["environments"]
    frame["environment"] = [
        environment_words(places[k], [backend])
        for k, backend in zip(frame["environment"], frame["backend"], strict=True)
    ]
    lists = ("rmse_states", "rmse_settled_states", "times") if target.suffix == ".csv" else ()
    for name in ("reasons", *lists):
        frame[name] = frame[name].map(_text)
    make_folder(target.parent)
    try:
        if target.suffix == ".tex":
            target.write_text(tables(held), encoding="utf-8")
        elif target.suffix == ".csv":
            frame.to_csv(target, index=False)
        else:
            need("pyarrow", "a Parquet file")
            frame.to_parquet(target, engine="pyarrow", index=False)
    except OSError as error:
        raise InvalidInputError(f"cannot write {target}: {error.strerror or error}.") from error
    return target


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, float):  # pandas may put NaN for None
        return None
    return json.dumps(value if isinstance(value, (list, dict)) else value.tolist())


def tables(store: Store | str | Path, keys: Set[str] | None = None) -> str:
    """One table per model and horizon, of the cells with these keys; of all if left out."""
    held = opened(store)
    frame = held.frame()
    if keys is not None:
        frame = frame[frame["key"].isin(keys)]
    if frame.empty:
        raise InvalidInputError(f"{held.path} has no cell of this study; run it first.")
    places = held.meta()["environments"]
    backends = set(frame["backend"])
    machines = [environment_words(places[k], backends) for k in sorted(set(frame["environment"]))]
    found = cases(summarise(with_observers(frame)))
    return "\n".join(_table(case.title, case.summary, machines) for case in found)


def escaped(text: str) -> str:
    r"""A text in which LaTeX sees no commands: ``a_b`` becomes ``a\_b``."""
    return re.sub(r"[\\~^&%$#_{}]", lambda found: _SPECIAL[found[0]], text)


def with_error(mean: float, error: float) -> str:
    """A mean and its standard error with two digits of the error, at most four of the mean."""
    if not math.isfinite(mean):
        return "--"
    size = max(abs(mean), error if math.isfinite(error) else 0.0)
    if size == 0.0:
        return "$0$"
    exponent = _exponent(size, 4)
    if not -3 <= exponent < 5:
        inner = with_error(mean / 10.0**exponent, error / 10.0**exponent).strip("$")
        return rf"$({inner}) \cdot 10^{{{exponent}}}$"
    places = (3 if math.isfinite(error) else 2) - exponent
    if math.isfinite(error) and error > 0.0:
        places = min(places, 1 - _exponent(error, 2))
    rounded = f"{error:.{max(0, places)}f}"
    # Where the seeds agree to all digits, or there is one only, the mean stands alone.
    known = math.isfinite(error) and float(rounded) > 0.0
    return f"${mean:.{max(0, places)}f}" + (rf" \pm {rounded}$" if known else "$")


def _exponent(value: float, digits: int) -> int:
    """The power of ten of a number rounded to these digits: 0 for 0.99996, which is 1.000."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])


def _table(title: str, rows: Any, machines: list[str]) -> str:
    shown = {name: one for name, one in SHOWN.items() if one.latex and rows[name].notna().any()}
    starts = ["start"] if rows["start"].nunique() > 1 else []
    # A cost says little where the error is known.
    if rows["rmse"].notna().any():
        shown.pop("cost", None)
    seeds = int(rows["seeds"].max())
    numbers = [str(one.latex) for one in shown.values()]
    heads = ["backend", "QPs", "cap", *starts, *numbers, "failed runs"]
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
            with_error(one.scale * float(row[name]), one.scale * _half(row, name) / quantile)
            for name, one in shown.items()
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
