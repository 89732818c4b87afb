"""The written C at every level of optimisation: clean, as the engine's, and true to the verdict."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler, write
from qpmhe.estimation.optimizer import _target
from qpmhe.estimation.problem import Trial

from .cases import CASES, case
from .driver import (
    CC,
    FLAGS,
    LOG,
    SAMPLE,
    STRICT,
    WATCHED,
    built,
    driven,
    recorded,
    same,
    same_estimates,
    wild,
)

pytestmark = [
    pytest.mark.skipif(CC is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning"),
]
LEVELS = (("-O0",), ("-O1",), *compiler._LEVELS)
FEW = ("reactor with gaps", "inputs converged", "mixed losses", "narrow conditions")
COMPILERS = [one for one in ("cc", "gcc", "clang") if shutil.which(one)]


def turns():
    """All cases at all levels; in the sample each at one, which mostly takes little time."""
    for i, name in enumerate(CASES):
        for k, level in enumerate(compiler._LEVELS):
            marks = () if k == (2, 1, 2, 2, 0, 2)[i % 6] else pytest.mark.slow
            yield pytest.param(name, level, marks=marks, id=f"{name}{level[0]}")


@pytest.mark.parametrize(("name", "level"), list(turns()))
def test_the_written_code_is_the_engines_and_clean(name, level, tmp_path):
    """Under sanitizers: samples of all sorts, late ones, changes, runs, members, and wild ones."""
    one, (start, events, expected) = case(name), recorded(name)
    program = built(name, tmp_path, (*FLAGS, *level, *WATCHED, *STRICT))
    found, log = driven(program, name, start, events)
    tolerance = 10 * one.tolerance
    same_estimates(found, expected, tolerance)
    samples = [parts for kind, _, parts in events if kind == SAMPLE]
    ys, us = (np.array([np.frombuffer(parts[k]) for parts in samples]) for k in range(2))
    run = one.estimator("compiled")._engine.run(ys, us if us.size else None)
    for part in LOG:
        wanted = getattr(run, part)
        wanted = wanted[1:] if part in ("states", "observer_states") else wanted
        same(getattr(log, part), wanted, tolerance, part)
    found, log = driven(program, name, start, wild(name))
    assert (found["cost"] <= found["candidate_cost"]).all()
    assert (log.costs <= log.candidate_costs).all()
    assert np.isfinite(log.states).all()


SINGLE = (
    "inputs", "reactor", "narrow conditions", "states in a polytope", "extended prior",
    "unscented prior", "injection", "steady prior", "mixed losses", "matrix expressions",
)


@pytest.mark.parametrize("name", SINGLE)
def test_single_precision_is_close(name, tmp_path):
    start, events, _ = recorded(name)
    usual = [
        (kind, 0.0, [*parts[:2], *[b""] * 6]) for kind, _, parts in events if kind == SAMPLE
    ]
    single = [
        (kind, number, [np.frombuffer(part).astype(np.float32).tobytes() for part in parts])
        for kind, number, parts in usual
    ]
    flags = (*FLAGS, *WATCHED, *STRICT)
    expected, _ = driven(built(name, tmp_path, flags), name, start, usual)
    program = built(name, tmp_path, flags, real="float")
    found, log = driven(program, name, start.astype(np.float32), single, "float")
    same_estimates(found, expected, 2e-2, statuses=False)
    assert (log.costs <= log.candidate_costs).all()


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", CASES)
def test_compiles_without_warnings(name, real, tmp_path):
    _, source = write(case(name).estimator("python"), tmp_path, real=real)
    extra = ["-Wshadow", "-Wconversion"] if real == "double" else []
    done = subprocess.run(
        ["cc", "-std=c99", *STRICT, *extra, "-fsyntax-only", source], capture_output=True,
        text=True, check=False,
    )
    assert done.returncode == 0, done.stderr[:2000]
    assert set(re.findall(r"^#include (.*)", source.read_text(), re.M)) <= {
        "<math.h>", "<tgmath.h>", "<stddef.h>", "<string.h>", '"mhe.h"'
    }


@pytest.mark.parametrize("command", COMPILERS)
@pytest.mark.parametrize("name", FEW)
def test_levels_differ_by_contraction_only(name, command, tmp_path):
    """Without contraction of a * b + c to one rounding, all levels give the same bits.

    With it, none breaks J(estimate) <= J(candidate).
    """
    start, events, _ = recorded(name)
    bits = set()
    for level in LEVELS:
        for contraction in ("-ffp-contract=off", "-ffp-contract=fast")[: 1 + (level in LEVELS[2:])]:
            program = built(name, tmp_path, (*FLAGS, contraction, *level), command)
            for record in (events, wild(name)):
                found, log = driven(program, name, start, record)
                assert (found["cost"] <= found["candidate_cost"]).all()
                if contraction == "-ffp-contract=off":
                    bits.add((len(record), found.tobytes(), *(
                        getattr(log, part).tobytes() for part in LOG
                    )))
    assert len(bits) == 2


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_code_without_infinities_is_not_compiled(flag, tmp_path, monkeypatch):
    with pytest.raises(subprocess.CalledProcessError):
        built("reactor", tmp_path, (flag,))
    if flag == "-Ofast":  # the engine's own level, which comes later, takes it back
        return
    monkeypatch.setenv("CC", f"{CC} {flag}")
    with pytest.warns(qpmhe.errors.EngineWarning, match="NaN and infinity have a meaning"):
        assert case("reactor").estimator("compiled").engine == "python"


@pytest.mark.parametrize("cost", [1.0, 0.0, -1e-3])
def test_a_better_trajectory_costs_less_whatever_the_sign(cost):
    """Rounding makes J negative where its terms cancel, with weights of hardly any rank."""
    trial = Trial(np.zeros((2, 1)), np.zeros((1, 2)), np.eye(2), cost)
    assert _target(trial) <= cost


def test_where_the_discount_underflows_a_failed_stage_costs_infinity(tmp_path):
    """Zero times infinity: the cost of such a window is infinite, not NaN."""
    start, _, _ = recorded("failed stage")
    for real, number in (("double", np.float64), ("float", np.float32)):
        program = built("failed stage", tmp_path, (*FLAGS, *WATCHED, *STRICT), real=real)
        events = [
            (SAMPLE, 0.0, [number(y).tobytes(), *[b""] * 7])
            for (y,) in (sample["y"] for sample in case("failed stage").samples)
        ]
        found, _ = driven(program, "failed stage", start.astype(number), events, real)
        assert number(0.01) ** 185 == 0
        failed = (found["status"] & qpmhe.Status.FAILED_STAGE.value) > 0
        crashed = (found["status"] & qpmhe.Status.MODEL_FAILED.value) > 0
        assert failed.sum() == 189
        assert (found["cost"] <= found["candidate_cost"]).all()
        assert ((np.isinf(found["candidate_cost"]) == failed) | crashed).all()


def symbols(path, *options):
    done = subprocess.run(["nm", *options, path], capture_output=True, text=True, check=True)
    return {line.split()[-1] for line in done.stdout.splitlines()}


@pytest.mark.skipif(shutil.which("nm") is None, reason="there is no nm")
def test_exports_its_public_names_and_needs_libm_only(tmp_path):
    public = {f"reactor_{name}" for name in (
        "amend", "default_settings", "recompute", "reset", "run", "sizes", "update", "set", "undo",
        "update_members", "update_special", "update_undoable",
    )}
    libm = {"fmax", "fmin", "fabs", "sin", "cos", "sincos", "exp", "log", "log1p", "sqrt"}
    memory = {"memcpy", "memset", "memmove", "_GLOBAL_OFFSET_TABLE_"}
    for name, real in (
        ("matrix expressions", "double"), ("tank", "float"), ("unscented prior", "double"),
    ):
        header, source = write(case(name).estimator("python"), tmp_path, name="reactor", real=real)
        made = tmp_path / "reactor.o"
        subprocess.run(["cc", "-std=c99", "-O1", "-c", "-o", made, source], check=True)
        assert symbols(made, "-g", "--defined-only") == public
        assert symbols(made, "-u") <= memory | libm | {f"{one}f" for one in libm}
        assert public <= set(re.findall(r"\b(reactor_\w+)[(;]", header.read_text()))


BOTH = r"""
#include "one.h"
#include "MHE_tank.h"
#include <stdio.h>
static one_estimator a; static one_workspace ka; static one_estimate oa;
static MHE_tank_estimator b; static MHE_tank_workspace kb; static MHE_tank_estimate ob;
int main(void)
{
    const one_real xa[ONE_NX] = {3, 1}, ya[ONE_NY] = {3.9};
    const MHE_tank_real xb[MHE_TANK_NX] = {0.2f}, yb[MHE_TANK_NY] = {0.3f};
    one_reset(&a, &one_default_settings, xa);
    MHE_tank_reset(&b, &MHE_tank_default_settings, xb);
    for (int t = 0; t < 6; t++) {
        one_update(&a, &ka, ya, 0, &oa);
        MHE_tank_update(&b, &kb, yb, 0, &ob);
    }
    printf("%.17g %.9g\n", oa.trajectory[oa.length * ONE_NX],
           ob.trajectory[ob.length * MHE_TANK_NX]);
    return 0;
}
"""


def test_two_in_one_program_and_from_cpp(tmp_path):
    one = case("states in a box").estimator("python")
    one.reset([3.0, 1.0])
    two = case("one of each").estimator("python")
    write(one, tmp_path, name="one")
    write(two, tmp_path, name="MHE_tank", real="float")
    strict, told = ["-Wall", "-Wextra", "-pedantic", "-Werror"], []
    for language, command in (("c", ["cc", "-std=c99"]), ("cpp", ["c++"])):
        if shutil.which(command[0]) is None:
            continue
        (tmp_path / f"both.{language}").write_text(BOTH)
        for file in ("one", "MHE_tank"):
            subprocess.run(["cc", "-std=c99", *strict, "-c", f"{file}.c"], cwd=tmp_path, check=True)
        subprocess.run(
            [*command, *strict, "-o", "both", f"both.{language}", "one.o", "MHE_tank.o", "-lm"],
            cwd=tmp_path, check=True,
        )
        told.append(subprocess.run([tmp_path / "both"], capture_output=True, check=True).stdout)
    assert len(set(told)) == 1
    for _ in range(6):
        expected = one.update([3.9]).state[0], two.update([0.3]).state[0]
    found = [float(word) for word in told[0].split()]
    assert found == [pytest.approx(expected[0], rel=1e-9), pytest.approx(expected[1], abs=1e-5)]
