"""Colour, marker and dash of each backend, the same in all figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

__all__ = ["OBSERVER", "Style", "styles"]


@dataclass(frozen=True)
class Style:
    """How a backend is drawn.

    Parameters
    ----------
    color : str
        Of Okabe and Ito's palette, which all colour visions tell apart.
    symbol, marker, glyph : str
        The same shape for plotly, for matplotlib, and as a character.
    dash, line : str
        The same dashes for plotly and for matplotlib.
    """

    color: str
    symbol: str
    marker: str
    glyph: str
    dash: str
    line: Any


# Okabe and Ito's without black, which the observer has, and yellow, which is lost on white.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# One more shape than colours: no pair comes again before 42 backends.
_SHAPES = (
    ("circle", "o", "●"), ("square", "s", "■"), ("diamond", "D", "◆"), ("triangle-up", "^", "▲"),
    ("cross", "P", "✚"), ("x", "X", "✖"), ("triangle-down", "v", "▼"),
)
_DASHES: tuple[tuple[str, Any], ...] = (
    ("solid", "-"), ("dash", "--"), ("dot", ":"), ("dashdot", "-."), ("longdash", (0, (9, 3))),
)

OBSERVER = Style("#222222", "star", "*", "★", "dash", "--")


def styles(backends: Iterable[str]) -> dict[str, Style]:
    """A style for each backend, the observer's its own; in alphabetical order."""
    found = {}
    for place, name in enumerate(sorted({str(one) for one in backends} - {"observer"})):
        symbol, marker, glyph = _SHAPES[place % len(_SHAPES)]
        dash, line = _DASHES[place % len(_DASHES)]
        color = _COLORS[place % len(_COLORS)]
        found[name] = Style(color, symbol, marker, glyph, dash, line)
    found["observer"] = OBSERVER
    return found
