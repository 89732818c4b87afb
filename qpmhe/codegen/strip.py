"""Written C without what the numbers in its header rule out."""

from __future__ import annotations

import re
from collections import Counter

from .fold import folded

# Stands for lines that were left out.
_GAP = "\x01\n"
_DIRECTIVE = re.compile(r"#\s*(if|endif)")
_MACRO = re.compile(r"^#define (\w+)\b(\([^)]*\))?((?:[^\\\n]|\\[^\n]|\\\n)*)\n", re.M)
_FUNCTION = re.compile(
    r"^static [^;={]*?\b(\w+)\([^;{]*\)\s*\{(?:[^\n]*\}\n|.*?^\}\n)", re.M | re.S
)
_PROTOTYPE = re.compile(r"^static [^;={}]*?\b(\w+)\([^;{]*\);\n", re.M)
_QUIET = re.compile(r'/\*.*?\*/|"(?:\\.|[^"\\\n])*"', re.S)
# Warnings of functions without use are switched off around those that many estimators do not need.
_UNUSED = re.compile(
    r'(?:/\*[^\n]*\*/\n)?#if defined\(__GNUC__\)\n#pragma GCC diagnostic push\n'
    r'#pragma GCC diagnostic ignored "-Wunused-function"\n#endif\n(.*?)'
    r'#if defined\(__GNUC__\)\n#pragma GCC diagnostic pop\n#endif\n', re.S
)
_COMMENT = r"/\*(?:(?!\*/).)*\*/\n"
# Of a comment, what it is about was left out: right behind it, or all up to the next headline.
_STALE = re.compile(
    rf"^{_COMMENT}(?:(?:{_GAP})+(?=\n|\Z)|\n(?:\n|{_GAP})*{_GAP}(?:\n|{_GAP})*(?={_COMMENT}\n|\Z))",
    re.M | re.S,
)


def stripped(header: str, source: str) -> tuple[str, str]:
    """Header and source without branches that are decided, and what is without use then.

    The object code is the same wherever the compiler leaves out
    functions that nobody calls, as GCC does from -O1 on.
    """
    macros = _macros(header, 1) | _macros(source, 0)
    texts = [header, _UNUSED.sub(r"\1", source)]
    before: list[str] = []
    while texts != before:
        before = texts
        texts = _without_unused([texts[0], folded(texts[1], lambda one: _value(one, macros))])
    return _tidy(texts[0]), _tidy(texts[1])


def _without_unused(texts: list[str]) -> list[str]:
    """The texts without static functions and macros that only their own definition names."""
    whole = "".join(texts)
    uses = _names(whole) - Counter(one[1] for one in _PROTOTYPE.finditer(whole))
    own = {one[1]: _names(one[0])[one[1]] for one in _FUNCTION.finditer(whole)}

    def kept(one: re.Match[str]) -> str:
        return one[0] if uses[one[1]] > _names(one[0])[one[1]] else _GAP

    def kept_prototype(one: re.Match[str]) -> str:
        return one[0] if uses[one[1]] > own.get(one[1], 0) else _GAP

    texts = [_PROTOTYPE.sub(kept_prototype, text) for text in texts]
    return [_MACRO.sub(kept, _FUNCTION.sub(kept, text)) for text in texts]


def _macros(text: str, guards: int) -> dict[str, str]:
    """The macros that a text defines in any case: inside of so many conditionals at most."""
    found, depth = {}, 0
    for line in text.replace("\\\n", "\x02").splitlines(keepends=True):
        kind = _DIRECTIVE.match(line)
        if kind:
            depth += {"if": 1, "endif": -1}.get(kind[1], 0)
        macro = _MACRO.match(line)
        if macro and not macro[2] and depth <= guards:
            found[macro[1]] = macro[3].replace("\x02", " ")
    return found


def _value(condition: str, macros: dict[str, str]) -> bool | None:
    """Whether a condition holds; None where it depends on the compiler."""

    def expanded(text: str) -> str:
        text = _QUIET.sub("", text)
        return re.sub(r"[A-Za-z_]\w*", lambda one: f"({expanded(macros[one[0]])})", text)

    try:
        text = expanded(condition)
    except KeyError:
        return None
    if not re.fullmatch(r"[\d\s()!&|=<>+*-]+", text):
        return None
    for c, python in (("&&", " and "), ("||", " or "), (r"!(?!=)", " 0 == ")):
        text = re.sub(c if c[0] == "!" else re.escape(c), python, text)
    return bool(eval(text, {"__builtins__": {}}))


def _names(text: str) -> Counter[str]:
    """How often each name occurs in code."""
    return Counter(re.findall(r"[A-Za-z_]\w*", _QUIET.sub(" ", text)))


def _tidy(text: str) -> str:
    """The text without gaps, and without comments on what is not there."""
    before = ""
    while text != before:
        before, text = text, _STALE.sub(_GAP, text)
    return re.sub(r"\n{3,}", "\n\n", text.replace(_GAP, "")).rstrip() + "\n"
