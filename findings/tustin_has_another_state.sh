#!/bin/sh
# What happens: the discrete system that SciPy and python-control return for "bilinear" (Tustin), and SciPy's for "foh" and
# "backward_diff", has another state than the continuous one; C or D change with it, and with C = I the physical state is
# the output.
# Why most guess wrong: A, B and C come back with the same shapes, for "zoh" and "euler" the state is the physical one, and
# the transfer function is right, so that every test of input and output passes.
# Who meets it: observers, Kalman filters and MHE on such a model: estimates, bounds and initial values of "the state" are
# those of a mixture of state and input. Under a slow sine this costs more than the discretisation itself.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 control==0.10.2
"$folder/venv/bin/python" - <<'PROGRAM'
import control
import numpy
import scipy
from scipy.signal import cont2discrete

print("scipy", scipy.__version__, "control", control.__version__)
A = numpy.array([[0.0, 1.0], [-4.0, -0.4]])
B, C, D, dt = numpy.array([[0.0], [1.0]]), numpy.eye(2), numpy.zeros((2, 1)), 0.1
omega = 2.5  # 25 samples a period
physical = numpy.linalg.solve(1j * omega * numpy.eye(2) - A, B[:, 0])
methods = "zoh", "euler", "foh", "bilinear", "backward_diff"
models = {method: cont2discrete((A, B, C, D), dt, method=method)[:4] for method in methods}
system = control.sample_system(control.ss(A, B, C, D), dt, method="bilinear")
models["control, bilinear"] = system.A, system.B, system.C, system.D
print("amplitudes under a sine, largest relative gap to those of the continuous state:")
for name, (a, b, c, d) in models.items():
    state = numpy.linalg.solve(numpy.exp(1j * omega * dt) * numpy.eye(2) - a, b[:, 0])
    output = c @ state + d[:, 0]
    gaps = [numpy.abs(one - physical).max() / numpy.abs(physical).max() for one in (state, output)]
    print(f"{name:18s} of the state {gaps[0]:.4f}, of the output {gaps[1]:.4f}")
    same = numpy.array_equal(c, C) and numpy.array_equal(d, D)
    assert same == (name in ("zoh", "euler")), "the behaviour has changed"
    assert name not in ("foh", "bilinear", "control, bilinear") or gaps[0] > 2.0 * gaps[1], "the behaviour has changed"
PROGRAM
