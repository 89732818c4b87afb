#!/bin/sh
# What happens: a CasADi interpolant of kind "bspline" is 0 outside of its grid, value and derivative, without a warning;
# one of kind "linear" continues its last pieces.
# Why most guess wrong: SciPy's splines continue their last polynomial, and the two kinds of CasADi share one constructor.
# Who meets it: models with measured curves (voltage over charge, pump curves), where an estimate or a sigma point leaves the
# table by 1e-6: the sensor's model jumps from full scale to 0 and its derivative vanishes, so that no gradient leads back.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 casadi==3.8.2
"$folder/venv/bin/python" - <<'PROGRAM'
import casadi
import numpy

print("casadi", casadi.__version__)
charge = numpy.linspace(0.0, 1.0, 9)
voltage = 3.0 + charge + 0.2 * charge**3
x = casadi.MX.sym("x")
found = {}
for kind in ("linear", "bspline"):
    curve = casadi.interpolant("curve", kind, [charge], voltage)
    slope = casadi.Function("slope", [x], [casadi.jacobian(curve(x), x)])
    found[kind] = [(float(curve(at)), float(slope(at))) for at in (1.0, 1.0 + 1e-6, 1.1)]
    print(kind, "value and slope at 1, 1 + 1e-6, 1.1:", found[kind])
assert abs(found["bspline"][0][0] - 4.2) < 1e-9
assert found["bspline"][1] == found["bspline"][2] == (0.0, 0.0), "the behaviour has changed"
assert found["linear"][2][0] > 4.2, "the behaviour has changed"
PROGRAM
