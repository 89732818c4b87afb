"""Written C without calls of functions that do nothing, and without branches that are decided."""

from __future__ import annotations

import re
from collections.abc import Callable

# A static function that does nothing, or only returns a number.
_IDLE = re.compile(
    r"^static \w+ (\w+)\([^;{)]*\)\n\{\n(?: +(?:\(void\)\w+; ?)+(?:/\*[^\n]*\*/)?\n)*"
    r"(?: +return (\d);\n)?\}\n", re.M
)
_BRANCH = re.compile(r"^( *)if \(", re.M)
# Behind such numbers.
_SIMPLER = (
    (re.compile(r"^ +\*?\w+ \|= 0;\n", re.M), ""),
    (re.compile(r" \|\| 0(?=\))|(?<=\()0 \|\| "), ""),
    (re.compile(r" && !0\b|(?<![\w)])!0 && "), ""),
    (re.compile(r"\bif \([^()\n]* && 0\)"), "if (0)"),
)
# What stands before a statement, and the word that says that it holds another one.
_BLANK = re.compile(r"(?:\s|/\*.*?\*/)*(?=(?P<word>for|while|if|do)\b)?", re.S)
_ELSE = re.compile(r"(?:\s|/\*.*?\*/)*else\b", re.S)
# A statement may begin behind such a line, other than that of a condition or a loop.
_ENDS = (";", "{", "}", "*/", "\x01")
# No more blanks stand before one.
_NEAR = 200


def folded(text: str, value: Callable[[str], bool | None]) -> str:
    """The text with such calls replaced; ``value`` says whether a condition holds, if decided."""
    for name, number in _IDLE.findall(text):
        text = _without_calls(text, name, number)
    for pattern, left in _SIMPLER:
        text = pattern.sub(left, text)
    # An alternative of nothing but such calls goes, too.
    return re.sub(r"\n *else \{\n *\}\n", "\n", _without_branches(text, value))


def _without_calls(text: str, name: str, number: str) -> str:
    """The text with the calls of an idle function replaced by its number, or left out."""
    # A pattern that begins with a literal is found ten times as fast.
    call = re.compile(rf"{name}(?<!static void {name})(?<!\w{name})\(")
    start = 0
    while (found := call.search(text, start)):
        start, first = found.end(), text.rfind("\n", 0, found.start()) + 1
        end = _closing(text, start)
        if text.startswith("static ", first) or re.search(r"\+\+|--|[^=!<>]=[^=]", text[start:end]):
            continue
        if text[first : found.start()].isspace() and text.startswith(";\n", end):
            if text[:first].rstrip().endswith(_ENDS):
                text, start = text[:first] + text[end + 2 :], first
        elif number:
            text, start = text[: found.start()] + number + text[end:], found.start()
    return text


def _without_branches(text: str, value: Callable[[str], bool | None]) -> str:
    """The text without conditions that are decided, unless there is an alternative."""
    start = 0
    while (found := _BRANCH.search(text, start)):
        start, indent = found.end(), found[1]
        close = _closing(text, start)
        condition = text[start : close - 1]
        holds = value(condition)
        if holds is None and "||" not in condition:
            known = {one: value(one) for one in condition.split(" && ")}
            holds = False if False in known.values() else None
            if holds is None and True in known.values():
                left = " && ".join(one for one in known if not known[one])
                text = text[:start] + left + text[close - 1 :]
        # What a loop or another branch without braces holds must stay one statement.
        before = text[max(found.start() - _NEAR, 0) : found.start()].rstrip()
        if holds is None or not before.endswith(_ENDS):
            continue
        if text.startswith(" {\n", close):
            first = close + 3
            last = text.index(f"\n{indent}}}", first) + 1
            end = text.index("\n", last) + 1
            if text[last:end] != f"{indent}}}\n":
                continue
        else:
            first, behind = close + 1, _behind(text, close)
            if _ELSE.match(text, behind):
                continue
            last = end = text.index("\n", behind) + 1
            if text[close] == " ":  # on the same line
                text, last = f"{text[:first]}\n{indent}    {text[first:]}", last + 1
                first, last = first + 1, last + len(indent) + 4
                end = last
        kept = re.sub(r"^    ", "", text[first:last], flags=re.M) if holds else ""
        text, start = text[: found.start()] + kept + text[end:], found.start()
    return text


def _closing(text: str, start: int, pair: str = "()") -> int:
    """Behind the parenthesis, or brace, that closes one before ``start``."""
    depth = 1
    while depth:
        depth += (text[start] == pair[0]) - (text[start] == pair[1])
        start += 1
    return start


def _behind(text: str, start: int) -> int:
    """Behind the statement that begins here, with those within it."""
    found = _BLANK.match(text, start)
    assert found is not None
    start, word = found.end(), found["word"]
    if text.startswith("{", start):
        return _closing(text, start + 1, "{}")
    if word is None:
        return text.index(";", start) + 1
    start += len(word)
    if word == "do":
        return text.index(";", _behind(text, start)) + 1
    end = _behind(text, _closing(text, text.index("(", start) + 1))
    other = _ELSE.match(text, end) if word == "if" else None
    return end if other is None else _behind(text, other.end())
