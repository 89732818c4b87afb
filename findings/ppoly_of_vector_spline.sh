#!/bin/sh
# What happens: PPoly.from_spline refuses a B-spline whose values are vectors, with the words of a Fortran routine about
# the number of coefficients; component by component it works, and the B-spline itself evaluates well.
# Why most guess wrong: make_interp_spline and PPoly both take vectors, and the conversion's page says "BSpline or tck".
# Who meets it: whoever turns interpolated curves of several outputs into polynomials, for code generation or bounds.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PROGRAM'
import numpy
import scipy
from scipy.interpolate import PPoly, make_interp_spline

print("numpy", numpy.__version__, "scipy", scipy.__version__)
x = numpy.arange(5.0)
values = numpy.stack([x**2, x**3], axis=1)
spline = make_interp_spline(x, values)
print("the spline at 2.5:", spline(2.5))
try:
    PPoly.from_spline(spline)
except Exception as error:
    print("PPoly.from_spline:", type(error).__name__, error)
else:
    raise SystemExit("the behaviour has changed: vectors are taken")
parts = [PPoly.from_spline(make_interp_spline(x, values[:, j])) for j in range(2)]
print("component by component:", [float(part(2.5)) for part in parts])
assert numpy.allclose([part(2.5) for part in parts], spline(2.5))
PROGRAM
