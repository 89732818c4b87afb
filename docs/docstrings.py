"""The docstrings as the reference shows them: mathematics as Markdown, groups of arguments."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":math:`([^`]+)`")
_DIRECTIVE = re.compile(r"^( *)\.\. math::[ ]*\n((?:\1 +.*\n|\s*\n)+)", re.MULTILINE)
# Arguments that are named together, without a type: griffe takes that of the first for all.
_GROUP = re.compile(r"^\s*(\w+(?:, \w+)+)$", re.MULTILINE)


def _block(found: re.Match[str]) -> str:
    lines = (line.strip() for line in found[2].strip().splitlines())
    body = "\n".join(f"{found[1]}{line}" for line in lines if line)
    return f"{found[1]}$$\n{body}\n{found[1]}$$\n\n"


class Docstrings(griffe.Extension):
    """Turns ``:math:`` roles and ``.. math::`` directives into what arithmatex reads.

    Each of several arguments that are named together gets its own type and default.
    """

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite an object's docstring before it is parsed, and correct what is parsed."""
        if obj.docstring:
            text = _DIRECTIVE.sub(_block, obj.docstring.value + "\n")
            obj.docstring.value = _ROLE.sub(r"$\1$", text).rstrip()
            if isinstance(obj, (griffe.Class, griffe.Function)):
                _correct_groups(obj, obj.docstring)


def _correct_groups(owner: griffe.Class | griffe.Function, docstring: griffe.Docstring) -> None:
    named = {name for group in _GROUP.findall(docstring.value) for name in group.split(", ")}
    # Without them in the signature, as of some data classes yet, griffe would warn.
    known = bool(named) and all(name in owner.parameters for name in named)
    for section in docstring.parsed if known else ():
        if isinstance(section, griffe.DocstringSectionParameters):
            for one in section.value:
                if one.name in named:
                    signature = owner.parameters[one.name]
                    one.annotation, one.value = signature.annotation, signature.default
