#!/bin/sh
# What happens: scipy.interpolate.interp1d of kind "nearest" maps NaN to the last value of its table, "previous" and
# "next" do too, without a word and with the default bounds_error; of kind "linear" it maps NaN to NaN.
# Why most guess wrong: NaN passes through nearly all of NumPy, and bounds_error promises an error outside the table.
# These kinds find the place by a sorted search, in which NaN stands behind all numbers.
# Who meets it: whoever looks up a stepwise curve (a valve's characteristic, a gain schedule) at a missing measurement.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PROGRAM'
import numpy
import scipy
from scipy.interpolate import interp1d

print("numpy", numpy.__version__, "scipy", scipy.__version__)
table = numpy.arange(5.0)
found = {}
for kind in ("linear", "nearest", "nearest-up", "previous", "next"):
    found[kind] = float(interp1d(table, 10.0 + table**2, kind=kind)(numpy.nan))
    print(f"{kind:10} of NaN: {found[kind]}")
assert numpy.isnan(found["linear"])
assert found["nearest"] == found["previous"] == found["next"] == 26.0, "the behaviour has changed"
PROGRAM
