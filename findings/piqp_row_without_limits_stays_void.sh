#!/bin/sh
# What happens: PIQP is set up with a row of G whose limits are both infinite. Later update(h_l=..., h_u=...) gives it finite
# ones. The solver says that it has solved the QP, and x violates the row: it was set to zero at the setup. With G handed over
# again in the same call, the row holds. Where the limits of a row go and come back in later updates, the dense solver answers
# in the same way; the sparse one stops at its cap, far away.
# Why most guess wrong: update takes limits alone, and infinite ones are allowed and documented as none; three lines on
# the standard error stream at the setup speak of rows "set to zero", not of later limits.
# Who meets it: receding horizons, where limits come and go with the samples: measurements that are missing, rows dropped.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 piqp==0.7.0
"$folder/venv/bin/python" - <<'PROGRAM' 2>&1
import sys

import numpy as np
import piqp
from scipy.sparse import csc_matrix

print("piqp", piqp.__version__)
infinity = np.array([np.inf, np.inf])
G, one = np.array([[1.0, 1.0], [1.0, -1.0]]), np.ones(2)
found = {}
for kind, made, matrix in (
    ("sparse", piqp.SparseSolver, csc_matrix), ("dense", piqp.DenseSolver, np.asarray)
):
    for case in "from the start", "for a while", "with G again":
        solver, rows = made(), matrix(G)
        low, high = (-infinity, infinity) if case != "for a while" else (-one, one)
        solver.setup(matrix(np.eye(2)), one, None, None, rows, low, high, None, None)
        solver.solve()
        if case == "for a while":
            solver.update(h_l=-infinity, h_u=infinity)
            solver.solve()
        solver.update(h_l=-one, h_u=one, **({"G": rows} if case == "with G again" else {}))
        status = solver.solve().name
        x = np.array(solver.result.x)
        found[kind, case] = (status, round(float((abs(G @ x) - 1.0).max()), 6))
        print(f"{kind}, without limits {case}: {status}, x {x.round(6)}, misses a row by {found[kind, case][1]}")
solved, wrong, right = "PIQP_SOLVED", 1.0, 0.0
for (kind, case), (status, miss) in found.items():
    if (kind, case) == ("sparse", "for a while"):
        as_described = status == "PIQP_MAX_ITER_REACHED" and miss > 1.0
    else:
        expected = right if case == "with G again" else wrong
        as_described = status == solved and abs(miss - expected) < 1e-4
    if not as_described:
        sys.exit("this has changed")
PROGRAM
