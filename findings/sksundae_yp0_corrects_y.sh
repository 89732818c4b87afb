#!/bin/sh
# What happens: scikit-sundae's IDA has the options calc_initcond="y0" and "yp0". With a wrong guess of an algebraic state in
# y0, "y0" fails and "yp0" corrects y0.
# Why most guess wrong: the names seem to say which of the two is computed. "yp0" means SUNDIALS' IDA_YA_YDP_INIT, which
# computes the algebraic components of y and the derivatives of the others; "y0" means IDA_Y_INIT, which computes all of y
# from derivatives that must be right.
# Who meets it: everybody who starts a DAE from a measured or estimated state, whose algebraic part is never consistent.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scikit-sundae==1.2.0
"$folder/venv/bin/python" - 2>/dev/null <<'PROGRAM'
import numpy
import sksundae

print("scikit-sundae", sksundae.__version__)


def residual(t, y, yp, out):
    out[0] = yp[0] + y[1]
    out[1] = y[1] - y[0] ** 2


found = {}
for option in ("y0", "yp0"):
    solver = sksundae.ida.IDA(residual, algebraic_idx=[1], calc_initcond=option, rtol=1e-8, atol=1e-10)
    try:
        solution = solver.solve(numpy.array([0.0, 1.0]), numpy.array([2.0, 17.0]), numpy.array([-17.0, 0.0]))
        found[option] = solution.y[0]
        print(option, "starts at", solution.y[0], "and ends at", solution.y[-1])
    except RuntimeError as error:
        found[option] = None
        print(option, "raises", error)
assert found["y0"] is None, "the behaviour has changed"
assert numpy.allclose(found["yp0"], [2.0, 4.0]), "the behaviour has changed"
PROGRAM
