#!/bin/sh
# What happens: the block that python-control's OptimalEstimationProblem.create_mhe_iosystem makes begins with a full window of
# zeros, which count as measurements. A state that rests at 1 and is measured without an error is estimated as 0.3 after one
# sample and 0.71 after three, though no prior was given. And the output at time t is the prediction from the measurements
# before t: y(t) does not change it.
# Why most guess wrong: a moving horizon estimator begins with a short window, or with none, and its output at t is thought of
# as the estimate that has used the sample at t.
# Who meets it: people who simulate such a block in closed loop, or compare its errors with another estimator's: the transient
# has nothing to do with the prior, and errors are compared one sample apart.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/program.py" <<'PROGRAM'
import sys

import control
import control.optimal as optimal
import numpy as np

plant = control.ss([[1.0]], [[1.0]], [[1.0]], 0, True)  # x(t+1) = x(t) + w(t), y = x + v
problem = optimal.OptimalEstimationProblem(
    plant, np.arange(5), optimal.gaussian_likelihood_cost(plant, [[0.01]], [[0.1]]),
    disturbance_indices=[0],
)
times, y = np.arange(12), np.ones(12)
other = y + 0.5 * (times == 8)
block = problem.create_mhe_iosystem()
one, changed = (np.ravel(control.input_output_response(block, times, each).outputs) for each in (y, other))
print("control", control.__version__, "numpy", np.__version__)
print("estimates of a state that is 1 at all times:", one.round(3))
print("with another y(8), from t = 7 on they change by", (changed - one)[7:].round(3))
late = np.array_equal(one[:9], changed[:9]) and abs(changed[9] - one[9]) > 0.05
if not (one[0] == 0.0 and one[3] < 0.75 and abs(one[10] - 1.0) < 1e-3 and late):
    sys.exit("this has changed")
PROGRAM
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 control==0.10.2
"$folder/venv/bin/python" "$folder/program.py"
