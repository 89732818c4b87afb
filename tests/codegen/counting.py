"""Operations that written C executes, counted by compiling it as C++ with a number that counts."""

import shutil
import subprocess

import numpy as np

from qpmhe.codegen.operations import FLOPS

from .test_written import DRIVER

COMPILER = shutil.which("c++")
# Functions that are no operations, as they are none of the bound's.
_SIGNS = ("fabs",)
_TESTS = ("isfinite", "isnan")
_LIBRARY = ("sin", "cos", "tan", "exp", "log", "log1p", "tanh", "atan", "floor", "ceil", "asin")
_LIBRARY_OF_TWO = ("pow", "atan2", "fmod", "fmin", "fmax")
OTHERS = (*_LIBRARY, *_LIBRARY_OF_TWO)
_NAMES = (*FLOPS, *OTHERS)
_AT = {name: _NAMES.index(name) for name in _NAMES}


def _class():
    lines = [
        "#include <cmath>", "#include <cstring>", "#include <cstdint>",
        f"static long long counts[{len(_NAMES)}];",
        "struct counted { double v; counted() = default; counted(double x) : v(x) {} };",
        "static inline counted operator-(counted a) { return -a.v; }",
        "static inline counted operator+(counted a) { return a; }",
    ]
    for sign, kind in zip("+-*/", ("additions", "additions", *FLOPS[1:3]), strict=True):
        lines += [
            f"static inline counted operator{sign}(counted a, counted b) "
            f"{{ counts[{_AT[kind]}]++; return a.v {sign} b.v; }}",
            f"static inline counted &operator{sign}=(counted &a, counted b) "
            f"{{ return a = a {sign} b; }}",
        ]
    lines += [
        f"static inline bool operator{sign}(counted a, counted b) {{ return a.v {sign} b.v; }}"
        for sign in ("<", ">", "<=", ">=", "==", "!=")
    ]
    lines += [f"static inline bool {name}(counted a) {{ return std::{name}(a.v); }}"
              for name in _TESTS]
    lines += [f"static inline counted {name}(counted a) {{ return std::{name}(a.v); }}"
              for name in _SIGNS]
    lines += [
        f"static inline counted {name}(counted a) "
        f"{{ counts[{_AT[key]}]++; return std::{name}(a.v); }}"
        for name, key in (("sqrt", "square_roots"), *((one, one) for one in _LIBRARY))
    ]
    lines += [
        f"static inline counted {name}(counted a, counted b) "
        f"{{ counts[{_AT[name]}]++; return std::{name}(a.v, b.v); }}" for name in _LIBRARY_OF_TWO
    ]
    return "\n".join(lines)


# The same program as for values, around the source itself.
_DRIVER = DRIVER.replace('#include "mhe.h"\n', "").replace(
    "mhe_update(", "memset(counts, 0, sizeof counts);\n        mhe_update("
).replace("&out, sizeof out", "counts, sizeof counts")


def counted(folder, start, samples):
    """Operations of each update of ``mhe.c`` in a folder: an array by names."""
    header, source = ((folder / name).read_text() for name in ("mhe.h", "mhe.c"))
    numbers = "typedef double mhe_real;"
    assert numbers in header
    text = header.replace(numbers, "typedef counted mhe_real;") + source
    text = text.replace('#include "mhe.h"', "")
    (folder / "counted.cpp").write_text(f"{_class()}\n{text}{_DRIVER}")
    subprocess.run(
        [COMPILER, "-std=c++20", "-O1", "-w", "-fpermissive", "-Drestrict=__restrict__",
         "-o", "counted", "counted.cpp"], cwd=folder, check=True,
    )
    given = [np.asarray(start, float).tobytes()]
    for sample in samples:
        given += [np.asarray(sample[one], float).tobytes() for one in ("y", "u") if one in sample]
    done = subprocess.run(
        [folder / "counted"], input=b"".join(given), capture_output=True, check=True
    )
    return np.frombuffer(done.stdout, [(name, np.int64) for name in _NAMES])
