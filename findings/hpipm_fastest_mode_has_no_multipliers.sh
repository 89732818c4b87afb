#!/bin/sh
# What happens: HPIPM in CasADi's wheel with mode "speed_abs" solves an optimal control QP, reports success, and returns 0 as
# the multiplier of every dynamics row. In its other three modes, with the same primal solution, they are right.
# Why most guess wrong: the modes are named after speed and robustness, so one expects another accuracy and not a result that
# is left out; the bounds' multipliers of the same call are right, and 0 is what a row that does not matter has.
# Who meets it: who takes the fastest mode for real time and reads sensitivities or costates from it, or puts it into an SQP:
# the residual of the Lagrangian's gradient never falls, so that it runs to its cap at every sample.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 casadi==3.8.2
"$folder/venv/bin/python" - <<'PROGRAM'
import casadi
import numpy

print("casadi", casadi.__version__)
stages, n, m = 5, 2, 1
A, B = numpy.array([[1.0, 0.1], [0.0, 1.0]]), numpy.array([[0.0], [0.1]])
states = [casadi.SX.sym(f"x{k}", n) for k in range(stages + 1)]
inputs = [casadi.SX.sym(f"u{k}", m) for k in range(stages)]
unknowns = casadi.vertcat(*(part for pair in zip(states, inputs) for part in pair), states[-1])
cost = sum(casadi.sumsqr(x - 1.0) for x in states[:-1]) + casadi.sumsqr(casadi.vertcat(*inputs))
cost += 10.0 * casadi.sumsqr(states[-1])
rows = casadi.vertcat(*(A @ states[k] + B @ inputs[k] - states[k + 1] for k in range(stages)))
program = {"x": unknowns, "f": cost, "g": rows}
limit = numpy.full(unknowns.numel(), numpy.inf)
low, high = -limit, limit.copy()
low[:n] = high[:n] = 1.0, 0.0
gradient = casadi.Function("gradient", [unknowns], [casadi.gradient(cost, unknowns)])
jacobian = casadi.Function("jacobian", [unknowns], [casadi.jacobian(rows, unknowns)])
residuals = {}
for mode in ("speed_abs", "speed", "balance", "robust"):
    solver = casadi.qpsol("solver", "hpipm", program, {
        "N": stages, "nx": [n] * (stages + 1), "nu": [m] * stages + [0], "ng": [0] * (stages + 1),
        "hpipm": {"mode": mode}, "print_time": False,
    })
    found = solver(lbx=low, ubx=high, lbg=0.0, ubg=0.0)
    at, multipliers = found["x"], numpy.array(found["lam_g"]).ravel()
    lagrangian = gradient(at) + jacobian(at).T @ found["lam_g"] + found["lam_x"]
    residuals[mode] = float(casadi.norm_inf(lagrangian))
    print(f"{mode:9} success {solver.stats()['success']}, cost {float(found['f']):.6f}, largest multiplier of a row "
          f"{abs(multipliers).max():.3g}, gradient of the Lagrangian {residuals[mode]:.1e}")
    assert solver.stats()["success"]
    assert (abs(multipliers).max() == 0.0) == (mode == "speed_abs"), "the behaviour has changed"
assert residuals["speed_abs"] > 1.0 and max(residuals[one] for one in ("speed", "balance", "robust")) < 1e-6
PROGRAM
