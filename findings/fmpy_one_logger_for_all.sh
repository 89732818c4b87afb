#!/bin/sh
# What happens: of two FMUs by FMI 2 that live in one process, each instantiated by FMPy with a logger of its own, all messages
# arrive at the logger that was given last, those of the first FMU as well.
# Why most guess wrong: instantiate_fmu takes the logger as an argument of one instance, and FMI hands it to each instance in
# a structure of its own.
# Who meets it: co-simulations and estimators with several FMUs, or several instances of one: warnings and errors are
# written down for the wrong unit, unless the logger reads the instance's name in each message.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 FMPy==0.3.32 pythonfmu==0.7.0
cd "$folder"
for name in Pump Valve; do
    cat > $name.py <<MODEL
from pythonfmu import Fmi2Causality, Fmi2Slave, Real
from pythonfmu.enums import Fmi2Status


class $name(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.x = 0.0
        self.register_variable(Real("x", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.log("a message of the $name", Fmi2Status.warning)
        return True
MODEL
    venv/bin/pythonfmu build -f $name.py >/dev/null
done
venv/bin/python - <<'PROGRAM'
import fmpy
from fmpy.simulation import instantiate_fmu

print("fmpy", fmpy.__version__)
arrived, units = [], []
for name in ("Pump", "Valve"):

    def logger(component, instance, status, category, message, name=name):
        arrived.append((name, instance.decode(), message.decode()))

    description = fmpy.read_model_description(f"{name}.fmu")
    unit = instantiate_fmu(
        fmpy.extract(f"{name}.fmu"), description, "CoSimulation", debug_logging=True, logger=logger
    )
    unit.setupExperiment()
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    units.append(unit)
for unit in units:
    unit.doStep(0.0, 1.0)
said = [one for one in arrived if one[2].startswith("a message")]
for name, instance, message in said:
    print(f"the logger of the {name} gets, from the instance {instance}: {message}")
assert [(name, message[-5:].strip()) for name, _, message in said] == [
    ("Valve", "Pump"), ("Valve", "Valve")
], "the behaviour has changed"
PROGRAM
