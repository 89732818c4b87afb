#!/bin/sh
# What happens: in CasADi 3.6.5 graph_substitute of an expression that ends in the transpose of a vector gives a column where
# the expression is a row. There is no error; substitute, on the same expression, gives a row. Behind a further operation, or
# in 3.8.2, both give rows.
# Why most guess wrong: a substitution changes symbols, and no shape; and a vector's transpose has the same numbers in the same
# order, so that the function's entries are right one by one.
# Who meets it: programs that cut a graph at inner nodes and put it together again, as for Jacobians by parts, on machines
# with an older CasADi: a product with the result has another shape, or is an outer product in place of an inner one.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/program.py" <<'PROGRAM'
import sys

import casadi as ca

x, y = ca.MX.sym("x", 3), ca.MX.sym("y", 3)
matrix = ca.MX(ca.DM([[1, 2, 3], [4, 5, 6], [7, 8, 10]]))
print("casadi", ca.__version__)
found = []
for name, row in (("x'", x.T), ("(x + 1)'", (x + 1).T), ("x' A", ca.mtimes(x.T, matrix))):
    by_graph = ca.graph_substitute(row, [x], [2 * y]).shape
    plainly = ca.substitute([row], [x], [2 * y])[0].shape
    print(f"{name:10} {row.shape}  graph_substitute {by_graph}  substitute {plainly}")
    found.append((by_graph, plainly))
turned = (3, 1) if ca.__version__ == "3.6.5" else (1, 3)
if found != [(turned, (1, 3)), (turned, (1, 3)), ((1, 3), (1, 3))]:
    sys.exit("this has changed")
PROGRAM
for versions in "numpy==1.26.4 casadi==3.6.5" "numpy==2.4.6 casadi==3.8.2"; do
    python3 -m venv --clear "$folder/venv"
    # Two words.
    # shellcheck disable=SC2086
    "$folder/venv/bin/pip" install --quiet --disable-pip-version-check $versions
    "$folder/venv/bin/python" "$folder/program.py"
done
