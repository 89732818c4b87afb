"""The estimator as an FMU, run by FMPy beside the Python step."""

import shutil

import numpy as np
import pytest

from qpmhe import Status, codegen, from_fmu
from qpmhe.errors import CompilationError, ModelError

from .cases import case

fmpy = pytest.importorskip("fmpy")
fmi2 = pytest.importorskip("fmpy.fmi2")
validation = pytest.importorskip("fmpy.validation")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


class Unit:
    """An FMU of an estimator, unpacked and instantiated; its variables are read by their names."""

    def __init__(self, mhe, folder, **options):
        *files, path = codegen.write(mhe, folder, name="unit", fmu=True, **options)
        assert [file.name for file in (*files, path)] == ["unit.h", "unit.c", "unit.fmu"]
        assert not validation.validate_fmu(str(path))
        description = fmpy.read_model_description(str(path), validate=True)
        fmpy.extract(str(path), unzipdir=str(folder / "unpacked"))
        self.fmu = fmi2.FMU2Slave(
            guid=description.guid, unzipDirectory=str(folder / "unpacked"), instanceName="one",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )
        self.fmu.instantiate()
        self.places = {one.name: one.valueReference for one in description.modelVariables}
        self.step = float(description.defaultExperiment.stepSize)

    def start(self):
        self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def _places(self, name):
        return [
            place for one, place in self.places.items() if one == name or one.startswith(f"{name}[")
        ]

    def get(self, name):
        return self.fmu.getReal(self._places(name))

    def integer(self, name):
        return self.fmu.getInteger([self.places[name]])[0]

    def set(self, **values):
        for name, value in values.items():
            self.fmu.setReal(self._places(name), list(value))

    def take(self, t=0, **sample):
        self.set(**sample)
        self.fmu.doStep(t * self.step, self.step)
        return self.get("state")


@pytest.mark.parametrize("name", [
    "reactor with gaps", "inputs converged", "radau substeps", "algebraic substeps",
    "algebraic midpoint", "restored noise-free",
])
def test_it_is_the_python_step_from_any_state(name, tmp_path):
    one = case(name)
    reference = one.estimator("python")
    unit, found, start = Unit(reference, tmp_path), [], 1.1 * np.asarray(one.start)
    assert unit.step == (one.system.dt or 1.0)
    unit.start()
    np.testing.assert_array_equal(unit.get("state"), one.start)
    unit.take(**one.samples[0])
    unit.fmu.reset()
    unit.set(initial_state=start)  # a parameter
    unit.start()
    reference.reset(start)
    regular = [sample for sample in one.samples if "dt" not in sample]
    for t, sample in enumerate(regular):
        if t == 10:
            saved = unit.fmu.serializeFMUstate(unit.fmu.getFMUstate())
        found.append(unit.take(t, **sample))
        expected = reference.update(**sample)
        for variable in ("state", "filtered", "cost", "candidate_cost", "restored_cost"):
            wanted = np.atleast_1d(getattr(expected, variable))
            np.testing.assert_allclose(unit.get(variable), wanted, rtol=1e-9, atol=1e-9)
        is_restored = Status.RESTORED in expected.status
        limit = "restored_cost" if is_restored else "candidate_cost"
        assert unit.get("cost") <= unit.get(limit)
        assert unit.fmu.getInteger([unit.places["status"], unit.places["qps"]]) == [
            expected.status.value, expected.qps
        ]
    # The same record again, from a state that was serialised in the middle.
    unit.fmu.setFMUstate(unit.fmu.deSerializeFMUstate(saved))
    assert [unit.take(**sample) for sample in regular[10:]] == found[10:]
    unit.fmu.terminate()
    unit.fmu.freeInstance()


@pytest.mark.slow
def test_what_is_refused(tmp_path, monkeypatch):
    mhe = case("inputs").estimator("python")
    unit = Unit(mhe, tmp_path)
    with pytest.raises(ModelError, match="it is only for co-simulation"):
        from_fmu(tmp_path / "unit.fmu", dt=0.1)
    unit.start()
    unit.take(u=[0.0, 0.0])
    for refused in (
        lambda: unit.fmu.doStep(0.0, 2.0 * unit.step), lambda: unit.set(cost=[1.0]),
        lambda: unit.take(u=[np.nan, 0.0]),
    ):
        with pytest.raises(fmpy.fmi1.FMICallException):
            refused()
    unit.fmu.freeInstance()
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(CompilationError, match="there is no C compiler"):
        codegen.write(mhe, tmp_path, fmu=True)
