"""Formulas become MathML when the site is built: a reader's browser typesets and fetches nothing.

The mathematical font is the one that ``ziamath`` carries, without the alphabets of running text.
"""

import html
import re
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

from fontTools import subset
from math_core import LatexError, LatexToMathML
from mkdocs.exceptions import PluginError

FONT = "fonts/mathematics.woff"  # named by css/mathematics.css too

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_PART = re.compile(r"\\begin\{|\\end\{[^}]*\}|\\q?quad\b|\\.|[{}]", re.DOTALL)
# Math fonts give the combining low line no width, so that browsers put it beside a narrow letter.
_COMBINING_LOW_LINE, _OVERLINE = "\N{COMBINING LOW LINE}", "\N{OVERLINE}"
# Chromium enlarges an operator that has an index only within a row.
_ENLARGED = re.compile(r"(<m(?:sub|sup|subsup)>)(<mo minsize[^>]*>[^<]*</mo>)")

# Latin, accents, Greek; punctuation; letters, arrows, operators; delimiters; formulas' alphabets.
_BLOCKS = (
    *(range(0x20, 0x100), range(0x2B0, 0x400), range(0x2000, 0x2070)),
    *(range(0x2100, 0x2150), range(0x2190, 0x2400), range(0x27C0, 0x2800)),
    range(0x1D400, 0x1D800),
)

_converter = LatexToMathML(fancy_error=False)


def mathml(latex: str, display: bool) -> str:
    """Return a formula as a ``<math>`` element; ``LatexError`` for what cannot be typeset."""
    text = _converter.convert_with_local_state(latex, displaystyle=display)
    return _ENLARGED.sub(r"\1<mrow>\2</mrow>", text.replace(_COMBINING_LOW_LINE, _OVERLINE))


def parts(latex: str) -> list[str]:
    r"""Split a formula at each ``\quad`` and ``\qquad`` outside of groups and environments."""
    ends, starts, depth = [], [0], 0
    for found in _PART.finditer(latex):
        if found[0] == "{":
            depth += 1
        elif found[0] == "}" or found[0].startswith(r"\end{"):
            depth -= 1
        elif found[0] == r"\begin{":
            depth += 2  # the brace of its name is closed soon
        elif found[0].endswith("quad") and not depth:
            ends.append(found.start())
            starts.append(found.end())
    pieces = (latex[start:end].strip() for start, end in zip(starts, [*ends, None], strict=True))
    return [piece for piece in pieces if piece]


def displayed(latex: str) -> str:
    """Return a displayed formula, whose parts take several lines where a page is narrow."""
    lines = "".join(f"<div>{mathml(part, True)}</div>" for part in parts(latex))
    return f'<div class="formula">{lines}</div>'


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """Replace what arithmatex has marked in a page, docstrings included."""

    def replacement(found: re.Match[str]) -> str:
        latex = html.unescape(found[3]).strip()
        try:
            return displayed(latex) if found[2] == "[" else mathml(latex, False)
        except LatexError as error:
            raise PluginError(f"{page.file.src_uri}: {latex!r} is not typeset: {error}") from error

    return _FORMULA.sub(replacement, content)


def on_post_build(config: Any, **_: Any) -> None:
    """Write the font beside the pages."""
    target = Path(config.site_dir, FONT)
    target.parent.mkdir(parents=True, exist_ok=True)
    source = distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")
    options = subset.Options(flavor="woff", name_IDs=["*"])
    font = subset.load_font(str(source), options)
    reducer = subset.Subsetter(options)
    reducer.populate(unicodes=[code for block in _BLOCKS for code in block])
    reducer.subset(font)
    subset.save_font(font, str(target), options)
