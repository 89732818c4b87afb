"""The written C at levels of optimisation: clean, the Python step's, and true to the verdict."""

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler, system_of, write
from qpmhe.codegen.library import planned
from qpmhe.errors import OptionError
from tests.covering import covering

from .cases import FEATURES, case
from .clean import wild
from .test_agreement import same

CC = shutil.which("cc")
pytestmark = [
    pytest.mark.skipif(CC is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
FLAGS = tuple(flag for flag in compiler._FLAGS if flag not in ("-shared", "-fPIC"))
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")
EXACT = ("-Wshadow", "-Wconversion")
# With sanitizers GCC 12 warns of indices that loops of one output do not reach; they watch these.
WATCHED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-Wno-array-bounds")
LEVELS = (("-O0",), ("-O1",), *compiler._LEVELS)
COSTS = "cost", "candidate_cost", "restored_cost"
DRIVER = r"""
#include <stdio.h>
#include "mhe.h"
static mhe_estimator e;
static mhe_workspace k;
static mhe_estimate out;
int main(void)
{
    mhe_real x0[MHE_NX], y[MHE_NY], u[MHE_NU + 1];
    if (fread(x0, sizeof x0, 1, stdin) != 1) return 2;
    mhe_reset(&e, &mhe_default_settings, x0);
    while (fread(y, sizeof y, 1, stdin) == 1) {
        if (MHE_NU && fread(u, sizeof *u * MHE_NU, 1, stdin) != 1) return 2;
        mhe_update(&e, &k, y, MHE_NU ? u : 0, &out);
        fwrite(&out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


def estimates(one, samples, folder, flags, real="double"):
    """What the written code makes of a case's measurements and inputs."""
    write(one.estimator("python"), folder, real=real)
    (folder / "main.c").write_text(DRIVER)
    command = [CC, "-std=c99", *flags, "-o", "main", "main.c", "mhe.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    mhe = one.estimator("python")
    layout, _ = planned(system_of(mhe), mhe.observer, mhe.cost, mhe.settings, real)
    rows = [one.start, *(sample[key] for sample in samples for key in ("y", "u") if key in sample)]
    with np.errstate(over="ignore"):
        data = np.concatenate(rows).astype(layout.number)
    done = subprocess.run(
        [folder / "main"], input=data.tobytes(), capture_output=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr.decode()
    found = np.frombuffer(done.stdout, layout.estimate_type())
    assert len(found) == len(samples)
    restored = (found["status"] & qpmhe.Status.RESTORED.value) > 0
    limits = np.where(restored, found["restored_cost"], found["candidate_cost"])
    assert (found["cost"] <= limits).all()
    return found


# Some cases of each feature, each at one level of optimisation.
SOME = [name for table in FEATURES.values() for name in list(table)[::7]]


@pytest.mark.slow
@pytest.mark.parametrize(("part", "level"), list(enumerate((0, 1, 2, 2, 2, 2))))
def test_the_compiled_step_is_clean(part, level, tmp_path):
    """Under sanitizers, in a process that loads them first: samples of all sorts, and wild ones.

    Most of them at the level at which sanitizers compile in a tenth of the time.
    """
    sanitizer = subprocess.check_output([CC, "-print-file-name=libasan.so"], text=True).strip()
    if not os.path.isabs(sanitizer):
        pytest.skip("the compiler has no sanitizer that can be loaded first")
    environment = os.environ | {
        "LD_PRELOAD": sanitizer, "ASAN_OPTIONS": "detect_leaks=0", "PYTHONMALLOC": "malloc",
        "CC": " ".join((CC, *WATCHED, *STRICT, *EXACT)), "QPMHE_CACHE_DIR": str(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-m", "tests.codegen.clean", str(level), *SOME[part::6]], env=environment,
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


SINGLE_TOO = "inputs", "states in a polytope", "algebraic", "layered"


@pytest.mark.parametrize("name", [
    "inputs", "euler", "extended", "unscented", "mixed losses", "states in a polytope",
    "fewer disturbances in sets", "held with gaps", "soft states", "constraints", "restored",
    "restarted extended", "algebraic", "radau", "layered",
])
def test_the_written_code_is_the_python_step(name, tmp_path):
    one = case(name)
    samples = [each | {"y": np.resize(each["y"], one.system.p)} for each in one.samples]
    reference = one.estimator("python")
    expected = [reference.update(sample["y"], sample.get("u")) for sample in samples]
    ways = [("double", 10 * one.tolerance), ("float", 2e-2)]
    for real, tolerance in ways[: 1 + (name in SINGLE_TOO)]:
        found = estimates(one, samples, tmp_path, (*FLAGS, *WATCHED, *STRICT), real=real)
        for got, true in zip(found, expected, strict=True):
            assert (got["time"], got["length"]) == (true.time, len(true.trajectory) - 1)
            assert real == "float" or got["status"] == true.status.value
            for part in ("trajectory", "candidate", "filtered", *COSTS):
                wanted = np.atleast_1d(getattr(true, part))
                same(np.atleast_1d(got[part])[: len(wanted)], wanted, tolerance, part)


# A time budget is kept by a clock that counts seconds in double precision; no float is 1e200.
SINGLE = [name for name in SOME if "in time" not in name and "1e200" not in name]


@pytest.mark.parametrize("name", SINGLE)
def test_single_precision_computes_nothing_in_double(name, tmp_path):
    _, source = write(case(name).estimator("python"), tmp_path, real="float")
    command = [CC, "-std=c99", *STRICT, *EXACT, "-Wdouble-promotion", "-fsyntax-only", source]
    subprocess.run(command, check=True)


def test_units_beyond_single_precision_are_refused(tmp_path):
    mhe = case("constraints of 1e200").estimator("python")
    with pytest.raises(OptionError, match=r"unit of constraints .*of real='float'"):
        write(mhe, tmp_path, real="float")


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("arm-none-eabi-nm")),
    reason="there is no compiler for microcontrollers",
)
@pytest.mark.parametrize(
    "name", sorted({"soft states", "restored", "restarted extended", *SINGLE[::4]})
)
def test_a_microcontroller_needs_no_double_precision(name, tmp_path):
    _, source = write(case(name).estimator("python"), tmp_path, real="float")
    made = tmp_path / "mhe.o"
    cortex = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
    subprocess.run(
        ["arm-none-eabi-gcc", "-std=c99", *cortex, "-O2", *STRICT, "-c", "-o", made, source],
        check=True,
    )
    called = subprocess.run(
        ["arm-none-eabi-nm", "-u", made], capture_output=True, text=True, check=True
    ).stdout.split()
    functions = "a?(cos|sin|tan)h?|sqrt|exp|log|log1p|pow|fabs|fmax|fmin|atan2|floor"
    wide = re.compile(rf"__aeabi_(d\w*|\w+2d)|{functions}")
    assert "memcpy" in called
    assert not [one for one in called if wide.fullmatch(one)]


@pytest.mark.slow
@covering(
    strength=1, level=["-O1", "-O2", "-O3"],
    name=["extended", "fewer disturbances in sets", "unscented prior"],
)
def test_compiles_without_warnings_when_it_is_optimised(name, level, tmp_path):
    _, source = write(case(name).estimator("python"), tmp_path)
    command = [CC, "-std=c99", level, *STRICT, *EXACT, "-c", "-o", tmp_path / "mhe.o", source]
    subprocess.run(command, check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mixed losses", "states in both"])
def test_levels_differ_by_contraction_only(name, tmp_path):
    """Without contraction of a * b + c to one rounding, all levels give the same bits.

    With it, none breaks J(estimate) <= J(candidate).
    """
    one, bits = case(name), set()
    samples = [
        sample | {"y": np.resize(sample["y"], one.system.p)}
        for sample in (*one.samples, *wild(one))
    ]
    for level in LEVELS:
        for contraction in ("-ffp-contract=off", "-ffp-contract=fast")[: 1 + (level in LEVELS[2:])]:
            flags = (*FLAGS, contraction, *level)
            found = estimates(one, samples, tmp_path, flags)
            if contraction == "-ffp-contract=off":
                bits.add(found.tobytes())
    assert len(bits) == 1


@pytest.mark.slow
def test_code_without_infinities_is_not_compiled(tmp_path, monkeypatch):
    for flag in ("-ffast-math", "-Ofast", "-ffinite-math-only"):
        with pytest.raises(subprocess.CalledProcessError):
            estimates(case("reactor"), [], tmp_path, (flag,))
    monkeypatch.setenv("CC", f"{CC} -ffast-math")
    with pytest.warns(qpmhe.errors.EngineWarning, match="NaN and infinity have a meaning"):
        assert case("reactor").estimator("compiled").engine == "python"


def symbols(path, *options):
    done = subprocess.run(["nm", *options, path], capture_output=True, text=True, check=True)
    return {line.split()[-1] for line in done.stdout.splitlines()}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nm") is None, reason="there is no nm")
def test_exports_its_public_names_and_needs_libm_only(tmp_path):
    public = {f"reactor_{name}" for name in (
        "amend", "default_settings", "recompute", "reset", "run", "sizes", "update", "set", "undo",
        "update_members", "update_special", "update_undoable",
    )}
    libm = {"fmax", "fmin", "fabs", "sin", "cos", "sincos", "exp", "log", "log1p", "sqrt"}
    memory = {"memcpy", "memset", "memmove", "_GLOBAL_OFFSET_TABLE_"}
    for name, real in (("tank conditions", "float"), ("unscented prior", "double")):
        header, source = write(case(name).estimator("python"), tmp_path, name="reactor", real=real)
        made = tmp_path / "reactor.o"
        subprocess.run([CC, "-std=c99", "-O1", "-c", "-o", made, source], check=True)
        assert symbols(made, "-g", "--defined-only") == public
        assert symbols(made, "-u") <= memory | libm | {f"{one}f" for one in libm}
        assert public <= set(re.findall(r"\b(reactor_\w+)[(;]", header.read_text()))
