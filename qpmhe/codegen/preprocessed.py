"""Written C with its macros expanded, for a parser that knows none."""

from __future__ import annotations

import re
from collections.abc import Iterator

# A comment, a number, a name, a text, or a sign.
_TOKEN = re.compile(
    r"[A-Za-z_]\w*|\.?\d(?:[eE][+-]|[\w.])*|\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*'|\s+|.", re.S
)
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)
_DEFINE = re.compile(r"(\w+)(\(([^)]*)\))?\s*(.*)", re.S)
_DEFINED = re.compile(r"\bdefined\s*(?:\(\s*(\w+)\s*\)|(\w+))")
# By name: the parameters, None of a macro without them, and the tokens.
_Macros = dict[str, tuple[list[str] | None, list[str]]]


def preprocessed(text: str) -> str:
    """The text for any compiler but GCC and its kin, without ``#include``.

    Parameters
    ----------
    text : str
        C source behind its header.
    """
    macros: _Macros = {}
    found: list[str] = []
    # Whether each conditional around a line holds, and whether a branch of it has held.
    open_: list[tuple[bool, bool]] = []
    pending = ""
    for line in _COMMENT.sub(" ", text.replace("\\\n", " ")).splitlines():
        directive = re.match(r"\s*#\s*(\w+)\s*(.*)", line)
        if directive is None:
            if all(holds for holds, _ in open_):
                pending += f"{line}\n"
            continue
        found.append(_expanded(pending, macros))
        pending = ""
        word, rest = directive[1], directive[2].strip()
        if word in ("if", "ifdef", "ifndef"):
            holds = (rest in macros) == (word == "ifdef") if word != "if" else _holds(rest, macros)
            open_.append((holds, holds))
        elif word in ("else", "elif"):
            _, held = open_.pop()
            holds = not held and (word == "else" or _holds(rest, macros))
            open_.append((holds, held or holds))
        elif word == "endif":
            open_.pop()
        elif word in ("define", "undef") and all(holds for holds, _ in open_):
            _define(word, rest, macros)
    found.append(_expanded(pending, macros))
    return "".join(found)


def _define(word: str, rest: str, macros: _Macros) -> None:
    match = _DEFINE.match(rest)
    assert match is not None, rest
    if word == "undef":
        macros.pop(match[1], None)
        return
    parameters = None
    if match[2]:
        parameters = [one.strip() for one in match[3].split(",") if one.strip()]
    macros[match[1]] = parameters, _TOKEN.findall(match[4].strip())


def _holds(condition: str, macros: _Macros) -> bool:
    """Whether the condition of an ``#if`` holds; names without a definition are 0."""
    text = _DEFINED.sub(lambda one: str(int((one[1] or one[2]) in macros)), condition)
    text = re.sub(r"[A-Za-z_]\w*", "0", _expanded(text, macros))
    for c, python in (("&&", " and "), ("||", " or "), (r"!(?!=)", " not ")):
        text = re.sub(c if c[0] == "!" else re.escape(c), python, text)
    return bool(eval(text.strip(), {"__builtins__": {}}))


def _expanded(text: str, macros: _Macros) -> str:
    return "".join(_tokens(_TOKEN.findall(text), macros, frozenset()))


def _tokens(tokens: list[str], macros: _Macros, hidden: frozenset[str]) -> Iterator[str]:
    """The tokens with macros replaced, but for those that are being replaced."""
    at = 0
    while at < len(tokens):
        token = tokens[at]
        at += 1
        if token not in macros or token in hidden:
            yield token
            continue
        parameters, body = macros[token]
        if parameters is not None:
            start = at
            while start < len(tokens) and tokens[start].isspace():
                start += 1
            if start == len(tokens) or tokens[start] != "(":
                yield token
                continue
            given, at = _arguments(tokens, start + 1)
            values = {
                name: list(_tokens(one, macros, hidden))
                for name, one in zip(parameters, given, strict=True)
            }
            body = [part for one in body for part in values.get(one, [one])]
            body = _TOKEN.findall(re.sub(r"\s*##\s*", "", "".join(body)))
        yield from _tokens(body, macros, hidden | {token})


def _arguments(tokens: list[str], at: int) -> tuple[list[list[str]], int]:
    """The arguments of a macro from behind its parenthesis, and where the tokens go on."""
    given: list[list[str]] = [[]]
    depth = 1
    while True:
        token = tokens[at]
        at += 1
        depth += {"(": 1, ")": -1}.get(token, 0)
        if not depth:
            return given, at
        if token == "," and depth == 1:
            given.append([])
        else:
            given[-1].append(token)
