#!/bin/sh
# What happens: an FMU by FMI 3 says in its description that it provides directional derivatives; the description that
# FMPy reads says that it does not. The same FMU by FMI 2 is read right.
# Why most guess wrong: the reader validates the file by FMI's schema, and has the attribute for both kinds of interfaces.
# FMI 3 has renamed it to the plural, as it added adjoint derivatives.
# Who meets it: programs that choose between the FMU's derivatives and differences by the description: estimators, optimisers
# and implicit integrators take differences for every FMU by FMI 3, n evaluations and half of the digits.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 FMPy==0.3.32
cd "$folder"
cat > two.xml <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Tank" guid="{tank}">
  <ModelExchange modelIdentifier="tank" providesDirectionalDerivative="true"/>
  <ModelVariables>
    <ScalarVariable name="level" valueReference="1" causality="output" initial="exact"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="rate" valueReference="2"><Real derivative="1"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="1"/></Outputs>
    <Derivatives><Unknown index="2"/></Derivatives>
    <InitialUnknowns><Unknown index="2"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
XML
cat > three.xml <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Tank" instantiationToken="{tank}">
  <ModelExchange modelIdentifier="tank" providesDirectionalDerivatives="true"/>
  <ModelVariables>
    <Float64 name="level" valueReference="1" causality="output" initial="exact" start="1"/>
    <Float64 name="rate" valueReference="2" derivative="1"/>
    <Float64 name="time" valueReference="3" causality="independent" variability="continuous"/>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="1"/>
    <ContinuousStateDerivative valueReference="2"/>
    <InitialUnknown valueReference="2"/>
  </ModelStructure>
</fmiModelDescription>
XML
venv/bin/python - <<'PROGRAM'
import fmpy

print("fmpy", fmpy.__version__)
two, three = (
    fmpy.read_model_description(name).modelExchange.providesDirectionalDerivative
    for name in ("two.xml", "three.xml")
)
print("directional derivatives, stated by both files: by FMI 2", two, "by FMI 3", three)
if not (two is True and three is False):
    raise SystemExit("this has changed")
PROGRAM
