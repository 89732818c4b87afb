#!/bin/sh
# What happens: in do-mpc, set_rhs(..., process_noise=True) adds w to the right-hand side. In a discrete model that is the
# next state; in a continuous one it is the derivative, so w moves the state by w times t_step, and P_w is the weight of a
# rate. The same P_w allows 1 / t_step**2 times the variance in the discrete model of the same plant.
# Why most guess wrong: filters take Q as the covariance of the state's increment over a sample, and P_w = inv(Q) reads
# alike in both kinds of model. A simulation with the same meaning shows nothing.
# Who meets it: whoever moves a tuned Q from a Kalman filter into do-mpc's MHE, or changes t_step or the kind of model.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 casadi==3.8.2 do-mpc==5.1.2
"$folder/venv/bin/python" -W ignore - <<'PROGRAM'
import casadi
import do_mpc
import numpy

print("do-mpc", do_mpc.__version__, "casadi", casadi.__version__)
step, moved, filtered = 0.1, {}, {}
for kind in ("discrete", "continuous"):  # a random walk: x+ = x + w, and dx/dt = w
    model = do_mpc.model.Model(kind)
    x = model.set_variable("_x", "x", (1, 1))
    model.set_rhs("x", x if kind == "discrete" else 0.0 * x, process_noise=True)
    model.set_meas("y", x, meas_noise=True)
    model.setup()
    simulator = do_mpc.simulator.Simulator(model)
    simulator.set_param(t_step=step)
    simulator.setup()
    simulator.x0 = numpy.zeros((1, 1))
    simulator.make_step(w0=numpy.ones((1, 1)))
    moved[kind] = float(simulator.x0["x"])
    mhe = do_mpc.estimator.MHE(model, [])
    mhe.settings.supress_ipopt_output()
    mhe.settings.n_horizon, mhe.settings.t_step, mhe.settings.meas_from_data = 3, step, True
    mhe.set_default_objective(P_x=numpy.eye(1), P_v=numpy.eye(1), P_w=numpy.eye(1))
    mhe.setup()
    mhe.x0 = numpy.zeros((1, 1))
    mhe.set_initial_guess()
    for measured in (0.0, 0.0, 0.0, 1.0):
        estimate = mhe.make_step(numpy.array([[measured]]))
    filtered[kind] = float(estimate[0, 0])
    print(f"{kind}: w = 1 moves x by {moved[kind]:.3f}; after the measurements 0, 0, 0 and 1 the estimate is {filtered[kind]:.3f}")
assert abs(moved["discrete"] - 1.0) < 1e-6 and abs(moved["continuous"] - step) < 1e-6, "the behaviour has changed"
assert filtered["discrete"] > 1.5 * filtered["continuous"], "the behaviour has changed"
PROGRAM
