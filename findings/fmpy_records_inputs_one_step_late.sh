#!/bin/sh
# What happens: in FMPy's result of a co-simulation FMU the row of time t holds, for an input, the value that was applied
# from the step before on, u(t - dt), beside the outputs of t; a ramp is held from the start of each step; and of two rows of
# the input with the same time, the first value of the jump is never applied.
# Why most guess wrong: the input was given as a table over time, and the result has the same times and the same name.
# Who meets it: records for identification and estimation that are made with an FMU. Whoever pairs row by row has each
# input one step late.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 FMPy==0.3.32 pythonfmu==0.7.0
cd "$folder"
cat > integrator.py <<'MODEL'
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Integrator(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.u = self.x = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("x", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.x += step * self.u
        return True
MODEL
venv/bin/pythonfmu build -f integrator.py >/dev/null
venv/bin/python - <<'PROGRAM'
import fmpy
import numpy

print("fmpy", fmpy.__version__)
kind = [("time", float), ("u", float)]
given = numpy.array([(0.0, 0.0), (1.0, 1.0), (1.0, 5.0), (3.0, 5.0)], dtype=kind)  # a ramp, then a jump at 1
result = fmpy.simulate_fmu(
    "Integrator.fmu", start_time=0.0, stop_time=3.0, output_interval=0.5, input=given, output=["u", "x"]
)
print(" time   u(t) given   u recorded   x")
for time, u, x in result:
    before = numpy.interp(time, [0.0, 1.0], [0.0, 1.0]) if time < 1.0 else 5.0
    print(f"{time:5.1f} {before:9.1f} {u:12.1f} {x:9.2f}")
recorded = dict(zip(result["time"].tolist(), result["u"].tolist()))
assert recorded[0.5] == 0.0 and recorded[1.0] == 0.5 and recorded[1.5] == 5.0, "the behaviour has changed"
PROGRAM
