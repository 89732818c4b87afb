"""The docstrings' mathematics, written for reStructuredText, as Markdown."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":math:`([^`]+)`")
_DIRECTIVE = re.compile(r"^( *)\.\. math::[ ]*\n((?:\1 +.*\n|\s*\n)+)", re.MULTILINE)


def _block(found: re.Match[str]) -> str:
    lines = (line.strip() for line in found[2].strip().splitlines())
    body = "\n".join(f"{found[1]}{line}" for line in lines if line)
    return f"{found[1]}$$\n{body}\n{found[1]}$$\n\n"


class RstMath(griffe.Extension):
    """Turns ``:math:`` roles and ``.. math::`` directives into what arithmatex reads."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite an object's docstring before it is parsed."""
        if obj.docstring:
            text = _DIRECTIVE.sub(_block, obj.docstring.value + "\n")
            obj.docstring.value = _ROLE.sub(r"$\1$", text).rstrip()
