"""Configurations and numbers in readable form."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

USUAL_START = "candidate"


def missing(value: Any) -> bool:
    """Whether a cell of a frame is empty: None, NaN or NA."""
    import pandas as pd

    return value is None or bool(pd.isna(value))


def qps_words(qps: Any) -> str:
    """The cap on QPs per sample; NA is a sequence run to convergence."""
    return "converged" if missing(qps) else str(int(qps))


def qps_heading(words: str) -> str:
    """The heading of a column with so many QPs per sample."""
    return "QPs to convergence" if words == "converged" else f"{words} QP{'s' * (words != '1')}"


def ranked(words: Iterable[str]) -> list[str]:
    """Numbers in their order, words after them; each once."""
    return sorted(set(words), key=lambda word: (not word.isdigit(), word.zfill(9)))


def cap_words(cap: Any) -> str:
    """The cap on a solver's iterations; NA is none."""
    return "none" if missing(cap) else str(int(cap))


def configuration_words(row: Any) -> str:
    """A row's backend, QPs per sample, cap, and start if it is not the usual one."""
    backend, qps, cap = str(row["backend"]), qps_words(row["qps"]), row["solver_iterations"]
    if qps == "0":  # an observer or another estimator
        return backend
    parts = [backend, qps_heading(qps) + (" per sample" if qps != "converged" else "")]
    if not missing(cap):
        parts.append(f"cap {int(cap)}")
    if row["start"] != USUAL_START:
        parts.append(f"start {row['start']}")
    return ", ".join(parts)


def number(value: Any, digits: int = 3) -> str:
    """Three significant digits, without an exponent where that is readable."""
    if missing(value):
        return "–"
    x = float(value)
    if math.isinf(x):
        return "∞" if x > 0 else "-∞"
    if x == 0:
        return "0"
    rounded = float(f"{x:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded)))
    if not -4 <= exponent < 6:
        return f"{rounded:.{digits - 1}e}"
    return f"{rounded:,.{max(0, digits - 1 - exponent)}f}"


def seconds(value: Any) -> str:
    """A duration in s, ms or us with three significant digits."""
    return "–" if missing(value) else _with_unit(float(value), number)


def time_tick(value: float) -> str:
    """A round duration for an axis, without zeros behind the point."""
    return _with_unit(value, "{:.3g}".format)


def _with_unit(value: float, words: Callable[[float], str]) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        # What would be rounded to 1000 of the smaller unit belongs to this one.
        if abs(value) >= 0.9995 * size:
            return f"{words(value / size)} {unit}"
    return f"{words(value / 1e-6)} µs"


def percent(share: Any) -> str:
    """A share in per cent; only exactly 0 and 1 are written as 0 % and 100 %."""
    if missing(share):
        return "–"
    x = 100.0 * float(share)
    if 0 < abs(x) < 0.1:
        return "< 0.1 %" if x > 0 else "> -0.1 %"
    if 99.9 < x < 100:
        return "> 99.9 %"
    return f"{x:.3g} %" if abs(x) < 1000 else f"{x:,.0f} %"


def usual_first(start: Any) -> tuple[bool, str]:
    """A key that sorts the usual start before others."""
    return str(start) != USUAL_START, str(start)


def listed(items: list[str]) -> str:
    """Items as in a sentence: a, b and c."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"
