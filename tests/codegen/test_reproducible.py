"""No level of optimisation breaks J(estimate) <= J(candidate), or computes in another order."""

import shutil
import subprocess

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import compiler
from qpmhe.estimation.optimizer import _target
from qpmhe.estimation.problem import Trial

from .cases import case
from .driver import CC, FLAGS, built, driven, recorded, wild

pytestmark = pytest.mark.skipif(CC is None, reason="there is no C compiler")
LEVELS = (("-O0",), ("-O1",), *compiler._LEVELS)
CASES = ("reactor with gaps", "inputs converged", "mixed losses", "narrow conditions")
COMPILERS = [one for one in ("cc", "gcc", "clang") if shutil.which(one)]


@pytest.mark.parametrize("command", COMPILERS)
@pytest.mark.parametrize("name", CASES)
def test_levels_differ_by_contraction_only(name, command, tmp_path):
    """Without contraction of a * b + c to one rounding, all levels give the same bits."""
    start, samples, _ = recorded(name)
    found = []
    for level in LEVELS:
        flags = (*FLAGS, "-ffp-contract=off", *level)
        program = built(name, tmp_path, flags, command)
        found.append([driven(program, start, record) for record in (samples, wild(name))])
    for results in found[1:]:
        for one, other in zip(results, found[0], strict=True):
            assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("level", LEVELS, ids=" ".join)
@pytest.mark.parametrize("name", CASES)
def test_the_verdict_holds_at_every_level(name, level, tmp_path):
    start, samples, _ = recorded(name)
    program = built(name, tmp_path, (*FLAGS, *level))
    for record in (samples, wild(name)):
        found = driven(program, start, record)
        assert (found[:, 0] <= found[:, 1]).all()


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
