"""C source in single precision: no number and no function of double precision is left."""

from __future__ import annotations

import re

# Functions of <math.h> with a twin in single precision. What is generic, such as isfinite, is not.
_FUNCTIONS = (
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "copysign", "cos",
    "cosh", "erf", "erfc", "exp", "exp2", "expm1", "fabs", "fdim", "floor", "fma", "fmax", "fmin",
    "fmod", "hypot", "lgamma", "log", "log10", "log1p", "log2", "nearbyint", "pow", "remainder",
    "rint", "round", "sin", "sinh", "sqrt", "tan", "tanh", "tgamma", "trunc",
)
_QUIET = r"/\*.*?\*/|//[^\n]*|\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'"
# A constant that is converted where it stands stays: the compiler does it.
_NUMBER = (
    r"(?<![\w.])(?<!real\))(?P<number>(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])"
)
_CALL = rf"(?<![\w.>])(?P<call>{'|'.join(_FUNCTIONS)})(?=\s*\()"
_PARTS = re.compile(f"{_QUIET}|{_NUMBER}|{_CALL}", re.S)


def in_single_precision(text: str) -> str:
    """The source with ``f`` behind each constant and each function's name."""

    def single(match: re.Match[str]) -> str:
        return match[0] + "f" if match["number"] or match["call"] else match[0]

    return _PARTS.sub(single, text)
