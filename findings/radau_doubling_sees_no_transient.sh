#!/bin/sh
# What happens: Robertson's kinetics from (1, 0, 0) over one second, by CasADi's Radau collocation of order 5. Between 4 and
# 8 elements the result moves by 1e-11 of its size, though both are wrong by 5e-8; refined further, the changes grow to 1.5e-8
# at 128 elements, and only from about 500 elements on does the error fall.
# Why most guess wrong: an order of 5 and two results that agree in eleven digits look converged. But the second state relaxes
# within a millisecond, every longer element jumps over that, and all of them miss the same amount of product. Halving compares
# a wrong answer with itself.
# Who meets it: whoever checks the step of a stiff model by halving it, from an initial state that is not on the slow manifold.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 casadi==3.8.2
"$folder/venv/bin/python" - <<'PROGRAM'
import casadi
import scipy
from scipy.integrate import solve_ivp

print("casadi", casadi.__version__, "scipy", scipy.__version__)
x = casadi.MX.sym("x", 3)
slow, back, fast = 0.04 * x[0], 1e4 * x[1] * x[2], 3e7 * x[1] ** 2
ode = casadi.vertcat(back - slow, slow - back - fast, fast)
rate = casadi.Function("rate", [x], [ode])
right = solve_ivp(
    lambda t, v: rate(v).full().ravel(), (0.0, 1.0), [1.0, 0.0, 0.0], method="Radau", rtol=1e-12, atol=1e-18,
    first_step=1e-8,
).y[2, -1]
found, errors, changes = {}, {}, {}
for count in (4, 8, 16, 32, 64, 128, 256, 512, 1024):
    step = casadi.integrator("step", "collocation", {"x": x, "ode": ode}, 0, 1, {
        "number_of_finite_elements": count, "collocation_scheme": "radau", "interpolation_order": 3,
        "rootfinder": "newton", "rootfinder_options": {"abstol": 1e-15, "abstolStep": 1e-15},
    })
    found[count] = float(step(x0=[1.0, 0.0, 0.0])["xf"][2])
    errors[count] = abs(found[count] / right - 1.0)
    changes[count] = abs(found[count] - found.get(count // 2, float("nan"))) / right
    print(f"{count:5} elements: error {errors[count]:.1e}, change since half as many {changes[count]:.1e}")
assert errors[8] > 1000.0 * changes[8], "the behaviour has changed"
assert changes[128] > 100.0 * changes[8], "the behaviour has changed"
assert errors[1024] < 1e-2 * errors[8], "the behaviour has changed"
PROGRAM
