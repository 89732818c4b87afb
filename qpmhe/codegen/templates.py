"""The package's C templates, and names in them."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from string import Template
from typing import Any


@cache
def template(name: str) -> str:
    """Text of a file among the package's C templates."""
    return files(__package__).joinpath("c", name).read_text(encoding="ascii")


def renamed(text: str, name: str) -> str:
    """The text with the prefix ``mhe`` of all names replaced."""
    return re.sub(
        r"\b(?:mhe|MHE)_", lambda found: f"{name if found[0] == 'mhe_' else name.upper()}_", text
    )


def prologue() -> str:
    """Short names for what the header defines."""
    return (
        # GCC 12.2 and others lose the order of elements in masked loads (GCC bug 114375).
        # CasADi's functions test each argument's pointer, which if-conversion makes a mask.
        "#if defined(__GNUC__) && !defined(__clang__)\n"
        # 12.2 also takes stores of 64 bytes for dead where a loop copies eight doubles.
        '#pragma GCC optimize ("no-tree-loop-if-convert", "no-strict-aliasing")\n#endif\n'
        "#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)\n"
        '#error "NaN and infinity have a meaning here: leave out -ffast-math and the like"\n'
        "#endif\n"
        "#include <math.h>\n#include <stddef.h>\n#include <string.h>\n\n"
        "#define real mhe_real\n#define NX MHE_NX\n#define NY MHE_NY\n#define NU MHE_NU\n"
        "#define SIZE(n) ((n) > 0 ? (n) : 1)\n\n"
        "/* The larger one; b where a is NaN. Unlike fmax, it is no call. */\n"
        "static real mhe_max(real a, real b) { return a > b ? a : b; }\n\n"
    )


def filled(name: str, values: dict[str, Any]) -> str:
    """A template with its values."""
    return Template(template(f"{name}.c")).substitute(values)
