"""Written C has what its estimator uses, and computes the numbers of all of it."""

import re
import shutil
import subprocess
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from qpmhe import codegen
from qpmhe.codegen import Needs, write
from qpmhe.codegen.library import generated
from qpmhe.codegen.strip import stripped

from .cases import CASES, case
from .test_written import DRIVER, EXACT, STRICT

CC = shutil.which("cc")
HEADERS = {"<math.h>", "<tgmath.h>", "<stddef.h>", "<string.h>", '"mhe.h"'}
FOLDER = Path(codegen.__file__).parent
HEADER = """#ifndef A_H
#define A_H
#define A_ONE 1 /* used */
#define A_NONE 0
#define A_KIND 2
#define A_SIZE(n) ((n) + A_ONE)
#ifdef __cplusplus
extern "C" {
#endif
typedef struct {
    double a[A_SIZE(2)];
} a_type;
#endif
"""


def source(text):
    """What is left of a source, beside a header that stays as it is but for what is not used."""
    header, left = stripped(HEADER, text)
    assert "#ifndef A_H\n" in header
    assert '#ifdef __cplusplus\nextern "C" {\n#endif\n' in header
    assert "A_ONE 1 /* used */" in header
    return left


@pytest.mark.parametrize(("condition", "holds"), [
    ("A_ONE", True), ("A_NONE", False), ("!A_NONE", True), ("!A_ONE && B", False),
    ("A_KIND == 2 /* two */", True), ("A_KIND != 2", False), ("BOTH", False), ("EITHER", True),
    ("A_KIND & 1", False), ("A_KIND & 2", True), ("!(A_ONE || A_NONE)", False),
    ("A_KIND > 1", True), ("A_NONE || A_KIND - 2 || A_ONE * A_KIND == 2", True), ("0", False),
])
def test_conditions_are_decided_as_the_preprocessor_decides_them(condition, holds):
    macros = "#define B 3\n#define BOTH (A_ONE && A_NONE)\n#define EITHER (BOTH || A_KIND)\n"
    left = source(f"{macros}void f(void)\n{{\n    if ({condition}) yes();\n}}\n")
    assert left.lstrip() == f"void f(void)\n{{\n{'    yes();' * holds}\n}}\n".replace("\n\n", "\n")
    if CC:
        text = f"{HEADER}{macros}#if {condition}\nint yes;\n#endif\n"
        done = subprocess.run(
            [CC, "-E", "-P", "-"], input=text, capture_output=True, text=True, check=True
        )
        assert ("int yes;" in done.stdout) == holds


@pytest.mark.parametrize("text", [
    "#if defined(C) && A_NONE\nx\n#endif\n",
    # What is defined where the compiler decides is not known.
    "#ifndef C\n#define C 1\n#endif\nvoid f(void)\n{\n    if (C) g();\n}\n",
])
def test_what_the_compiler_decides_stays(text):
    assert source(text) == text


def test_what_is_not_used_goes_with_its_comment():
    assert source("""/* A headline. */

/* Of nothing. */
static int gone(void) { return 0; }

/* Of the first. */
static int first(void)
{
    return 1;
}

/* Uses the first, but nobody uses it; see "second". */
static int second(int (*f)(void)) { return first() + f(); }

#define LONG(a) \\
    (a + \\
     SHORT)
#define SHORT 1

/* Another headline. */

/* Of what stays. */
static int third(void)
{
    if (A_NONE) {
        int a = 1;
    }
    return abs(3);
}

int fourth(void) { return third(); }

/* A headline of nothing. */

static int fifth(void) { return 5; }
""") == """/* Another headline. */

/* Of what stays. */
static int third(void)
{
    return abs(3);
}

int fourth(void) { return third(); }
"""


def test_only_the_compiler_and_precision_decide_what_is_compiled():
    for path in (FOLDER / "c").iterdir():
        for line in re.findall(r"^#\s*(?:el)?if.*", path.read_text(), re.M):
            assert re.search(COMPILERS, line), (path.name, line)


# MHE_VECTORS is defined by a part where the compiler has __AVX2__.
COMPILERS = (
    "_H$|__cplusplus|__GNUC__|__FAST_MATH__|__STDC_VERSION__|_WIN32|CASADI|casadi|LINKED"
    "|MHE_VECTORS"
)


@pytest.mark.parametrize(("text", "left"), [
    # Calls of functions that do nothing.
    ("    idle(e, f(2));\n    b();\n", "    b();\n"),
    ("    if (a)\n        idle(e, 1);\n    b();\n", None),
    ("    idle(e, i++);\n", None), ("    idle(e, i = 2);\n", None),
    # Numbers in the place of functions that only return one.
    ("    *s |= none(e);\n    b();\n", "    b();\n"), ("    none(e);\n    b();\n", "    b();\n"),
    ("    x = none(e) + 1;\n", "    x = 0 + 1;\n"),
    ("    if (a || none(e)) {\n        b();\n    }\n", "    if (a) {\n        b();\n    }\n"),
    ("    if (none(e)) return;\n    b();\n", "    b();\n"),
    ("    x = !none(e) && b();\n", "    x = b();\n"),
    ("    while (a && !none(e)) b();\n", "    while (a) b();\n"),
    ("    if (a == 1 && none(e))\n        c = b(2,\n              3);\n    b();\n", "    b();\n"),
    ("    if (one(e))\n        b();\n    b();\n", "    b();\n    b();\n"),
    # Branches that are decided, unless there is an alternative.
    ("    if (A_NONE) {\n        int x = 1;\n    }\n    b();\n", "    b();\n"),
    ("    if (A_ONE) {\n        for (;;) {\n            b();\n        }\n    }\n",
     "    for (;;) {\n        b();\n    }\n"),
    ("    if (!A_ONE) return;\n    b();\n", "    b();\n"),
    ("    if (A_ONE) return;\n", "    return;\n"),
    ("    if (A_NONE) {\n        b();\n    } else {\n        c();\n    }\n", None),
    ("    if (A_NONE)\n        b();\n    else\n        c();\n", None),
    ("    if (A_NONE && x)\n        c();\n    b();\n", "    b();\n"),
    ("    if (A_ONE && x > 1) b();\n", "    if (x > 1) b();\n"),
    ("    if (A_NONE || x)\n        b();\n", None),
    # Statements that hold others, without braces around them.
    ("    for (;;)\n        if (A_NONE) b();\n    c();\n", None),
    ("    if (x)\n        if (A_NONE) b();\n    c();\n", None),
    ("    if (x)\n        b();\n    else\n        if (A_ONE) c();\n    d();\n", None),
    ("    do\n        if (A_NONE) b();\n    while (x);\n", None),
    ("    for (;;)\n        if (A_ONE)\n            b();\n    c();\n", None),
    ("    if (A_NONE)\n        for (;;) {\n            b();\n            c();\n        }\n"
     "    d();\n", "    d();\n"),
    ("    if (A_NONE)\n        for (x = 0;\n             x < 2; x++)\n            b();\n    d();\n",
     "    d();\n"),
    ("    if (A_ONE)\n        while (x) {\n            b();\n            c();\n        }\n"
     "    d();\n", "    while (x) {\n        b();\n        c();\n    }\n    d();\n"),
    ("    if (A_NONE)\n        if (x)\n            b();\n        else if (y)\n            c();\n"
     "        else {\n            d();\n        }\n    e();\n", "    e();\n"),
    ("    if (A_NONE)\n        do {\n            b();\n        } while (x);\n    d();\n",
     "    d();\n"),
    ("    if (A_NONE) b(); else c();\n    d();\n", None),
    ("    for (;;)\n        idle(e, 1);\n    b();\n", None),
])
def test_what_does_nothing_goes(text, left):
    functions = (
        "static void idle(int *e, int i)\n{\n    (void)e; (void)i;\n}\n\n"
        "static int none(int *e)\n{\n    (void)e;\n    return 0;\n}\n\n"
        "static int one(int *e)\n{\n    (void)e;\n    return 1;\n}\n\n"
    )
    found = source(f"{functions}void all(int *e)\n{{\n{text}}}\n")
    if left is None:
        assert text in found
    else:
        assert found.lstrip() == f"void all(int *e)\n{{\n{left}}}\n"


@pytest.mark.parametrize("name", CASES)
def test_written_code_reads_well_and_compiles_without_warnings(name, tmp_path):
    files = write(case(name).estimator("python"), tmp_path)
    if CC:
        command = [CC, "-std=c99", *STRICT, *EXACT, "-fsyntax-only", files[1]]
        subprocess.run(command, check=True)
    header, written = (path.read_text() for path in files)
    conditions = re.findall(r"#\s*(?:el)?if.*", header + written)
    assert [one for one in conditions if not re.search(COMPILERS, one)] == []
    assert set(re.findall(r"^#include (.*)", written, re.M)) <= HEADERS
    for text in (header, written):
        for pattern in (
            r"\n\n\n", r"\{\n\n", r"\n\n\s*\}", r"\{\s*\}", r"\*/\n*\Z", r"\*/\n\n/\*.*\*/\n\n",
            r"#(if|else|elif).*\n#(else|elif|endif)", "\x01", "\x02",
        ):
            assert re.search(pattern, text) is None, pattern
    macros = re.findall(r"^#define (\w+)", header + written, re.M)
    for_users = {f"MHE_MOST_{one.name.upper()}" for one in fields(Needs)[:4]} | {"MHE_MEMORY"}
    assert for_users < {*macros}
    # Every loop has a bound, but for one of CasADi's functions.
    assert ("MHE_MOST_FLOPS" in macros) == (name != "matrix expressions")
    for_users |= {"MHE_MOST_FLOPS"}
    for macro in {*macros} - for_users:
        assert len(re.findall(rf"\b{macro}\b", header + written)) > 1, macro


@pytest.mark.slow
@pytest.mark.skipif(CC is None, reason="there is no C compiler")
@pytest.mark.parametrize(("name", "real", "level"), [
    ("inputs", "double", "-O2"), ("gated in states", "double", "-O1"),
    ("fewer disturbances in sets", "float", "-O1"), ("held in sets", "double", "-O2"),
    ("graduated reinitialized", "double", "-O3"), ("unscented prior", "float", "-O2"),
    ("tank in time", "double", "-O1"), ("matrix expressions", "double", "-O1"),
    ("angles across the seam", "double", "-O3"),
])
def test_the_numbers_are_the_same(name, real, level, tmp_path):
    one = case(name)
    mhe = one.estimator("python")
    whole, _ = generated(
        mhe.system, mhe.observer, mhe.cost, mhe.settings, "mhe", real, mhe.usual
    )
    number = np.float64 if real == "double" else np.float32
    inputs = int(re.search(r"#define MHE_NU (\d+)", whole["mhe.h"])[1])
    rows = [one.start]
    for sample in one.samples:
        rows += [np.resize(sample["y"], one.system.p), np.resize(sample.get("u", 1.0), inputs)]
    data = np.concatenate(rows).astype(number).tobytes()
    sizes, estimates = [], []
    for folder in (tmp_path / "whole", tmp_path / "stripped"):
        folder.mkdir()
        if folder.name == "stripped":
            write(mhe, folder, real=real)
        else:
            for file, text in whole.items():
                (folder / file).write_text(text)
        (folder / "main.c").write_text(DRIVER)
        flags = ["-std=c99", level, "-ffp-contract=off"]
        for command in (["-c", "mhe.c"], ["-o", "main", "main.c", "mhe.o", "-lm"]):
            subprocess.run([CC, *flags, *command], cwd=folder, check=True)
        done = subprocess.run(["./main"], cwd=folder, input=data, capture_output=True, check=True)
        estimates.append(done.stdout)
        sizes.append((folder / "mhe.o").stat().st_size)
    lines = [
        sum(len(path.read_text().splitlines()) for path in tmp_path.glob(f"{folder}/mhe.[ch]"))
        for folder in ("whole", "stripped")
    ]
    assert len(estimates[0]) > 100 * len(one.samples)
    assert estimates[0] == estimates[1]
    assert sizes[1] < 1.02 * sizes[0]
    assert lines[1] < 0.9 * lines[0]
