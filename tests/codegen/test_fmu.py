"""The estimator as an FMU, run by FMPy beside the Python step."""

import shutil
import subprocess
import zipfile

import numpy as np
import pytest

from qpmhe import codegen
from qpmhe.errors import CompilationError, OptionError

from .cases import case

fmpy = pytest.importorskip("fmpy")
fmi2 = pytest.importorskip("fmpy.fmi2")
validation = pytest.importorskip("fmpy.validation")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


def unit_of(path, folder):
    """The FMU, unpacked and instantiated, and the value reference of each variable."""
    description = fmpy.read_model_description(str(path), validate=True)
    fmpy.extract(str(path), unzipdir=str(folder))
    unit = fmi2.FMU2Slave(
        guid=description.guid, unzipDirectory=str(folder), instanceName="one",
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    unit.instantiate()
    references = {one.name: one.valueReference for one in description.modelVariables}
    return unit, references, float(description.defaultExperiment.stepSize)


def start(unit):
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()


def numbered(references, name, count):
    return [references[f"{name}[{j + 1}]"] for j in range(count)]


@pytest.mark.parametrize("name", ["reactor with gaps", "inputs converged"])
def test_it_is_the_python_step(tmp_path, name):
    one = case(name)
    n, p, m = one.system.n, one.system.p, one.system.m
    reference = one.estimator("python")
    header, source, path = codegen.write(reference, tmp_path, name="unit", fmu=True)
    assert [file.name for file in (header, source, path)] == ["unit.h", "unit.c", "unit.fmu"]
    assert not validation.validate_fmu(str(path))
    unit, references, step = unit_of(path, tmp_path / "unpacked")
    assert step == (one.system.dt or 1.0)
    start(unit)
    np.testing.assert_array_equal(unit.getReal(numbered(references, "state", n)), one.start)
    kept = None
    found = []
    regular = [sample for sample in one.samples if "dt" not in sample]
    for t, sample in enumerate(regular):
        if t == 10:
            kept = unit.getFMUstate()
            saved = unit.serializeFMUstate(kept)
        unit.setReal(numbered(references, "y", p), list(sample["y"]))
        if m:
            unit.setReal(numbered(references, "u", m), list(sample["u"]))
        unit.doStep(t * step, step)
        expected = reference.update(**sample)
        found.append(unit.getReal(numbered(references, "state", n)))
        np.testing.assert_allclose(found[-1], expected.state, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            unit.getReal(numbered(references, "filtered", n)), expected.filtered, rtol=1e-9,
            atol=1e-9,
        )
        cost, candidate = unit.getReal([references["cost"], references["candidate_cost"]])
        assert cost == pytest.approx(expected.cost, rel=1e-9)
        assert cost <= candidate == pytest.approx(expected.candidate_cost, rel=1e-9)
        assert unit.getInteger([references["status"], references["qps"]]) == [
            expected.status.value, expected.qps
        ]
    # The same record again, from a state that was serialised in the middle.
    unit.freeFMUstate(kept)
    unit.setFMUstate(unit.deSerializeFMUstate(saved))
    for sample, expected in zip(regular[10:], found[10:], strict=True):
        unit.setReal(numbered(references, "y", p), list(sample["y"]))
        if m:
            unit.setReal(numbered(references, "u", m), list(sample["u"]))
        unit.doStep(0.0, step)
        assert unit.getReal(numbered(references, "state", n)) == expected
    unit.terminate()
    unit.freeInstance()


def test_the_initial_state_is_a_parameter(tmp_path):
    one = case("reactor")
    *_, path = codegen.write(one.estimator("python"), tmp_path, name="unit", fmu=True)
    unit, references, step = unit_of(path, tmp_path / "unpacked")
    other = one.start + np.array([0.5, -0.02])
    unit.setReal(numbered(references, "initial_state", 2), list(other))
    start(unit)
    reference = one.estimator("python")
    for _ in range(2):  # and after a reset
        reference.reset(other)
        for t, sample in enumerate(one.samples[:6]):
            unit.setReal(numbered(references, "y", 1), list(sample["y"]))
            unit.doStep(t * step, step)
            np.testing.assert_allclose(
                unit.getReal(numbered(references, "state", 2)), reference.update(**sample).state,
                rtol=1e-9,
            )
        unit.reset()
        unit.setReal(numbered(references, "initial_state", 2), list(other))
        start(unit)
    unit.freeInstance()


def test_what_is_refused(tmp_path):
    one = case("inputs")
    mhe = one.estimator("python")
    *_, path = codegen.write(mhe, tmp_path, name="unit", fmu=True)
    unit, references, step = unit_of(path, tmp_path / "unpacked")
    start(unit)
    unit.setReal(numbered(references, "u", 2), [0.0, 0.0])
    with pytest.raises(fmpy.fmi1.FMICallException):
        unit.doStep(0.0, 2.0 * step)
    with pytest.raises(fmpy.fmi1.FMICallException):
        unit.setReal([references["cost"]], [1.0])
    unit.setReal(numbered(references, "u", 2), [np.nan, 0.0])
    with pytest.raises(fmpy.fmi1.FMICallException):
        unit.doStep(0.0, step)
    unit.setReal(numbered(references, "u", 2), [0.0, 0.0])
    unit.doStep(0.0, step)
    unit.freeInstance()
    with pytest.raises(OptionError, match="fmu is 1"):
        codegen.write(mhe, tmp_path, fmu=1)


def test_it_needs_a_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(CompilationError, match="there is no C compiler"):
        codegen.write(case("reactor").estimator("python"), tmp_path, fmu=True)


def test_equal_estimators_make_equal_files_that_hold_their_sources(tmp_path):
    one = case("reactor").estimator("python")
    first, second = (
        codegen.write(one, tmp_path / folder, name="unit", fmu=True)[2] for folder in "ab"
    )
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = archive.namelist()
        assert {"sources/unit.h", "sources/unit.c", "sources/unit_fmu.c"} < set(names)
        assert archive.read("sources/unit.c") == (tmp_path / "a" / "unit.c").read_bytes()
        archive.extractall(tmp_path)
    done = subprocess.run(
        # The standard's functions have parameters that a unit need not use.
        ["cc", "-std=c99", "-Wall", "-Wextra", "-Wno-unused-parameter", "-pedantic", "-Werror",
         "-c", "unit_fmu.c"],
        cwd=tmp_path / "sources", capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
