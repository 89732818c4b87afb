"""A swing model with algebraic angles and voltages: qpmhe, do-mpc, and CasADi's rootfinder.

Two generators at two buses with loads of constant power, n = 4 and k = 4; phasor measurement units
measure one voltage and the difference of the angles, a tachometer one speed. All discretise by one
Radau IIA step of order 5 a sample and have the same weights, horizon and record. do-mpc solves
each window with Ipopt. Prior and disturbance of do-mpc differ (see the page on do-mpc), so that
errors compare only roughly. Samples take turns; times are medians of one run, on one thread, and
count once the windows are full. Last come steps of models without stiffness by Radau IIA, in times
of a Runge-Kutta step.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import io
import json
import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import casadi as ca
import numpy as np
from peers.casadi_program import compile_library
from report import environment
from rich.console import Console
from rich.table import Table
from stopwatch import timed
from swing import equations

import qpmhe
from qpmhe.codegen.model_source import model_files
from qpmhe.model.implicit_steps import COLLOCATIONS

N, K, P, M, DT, HORIZON = 4, 4, 3, 2, 0.05, 10
GUESS = np.array([0.0, 1.0, 0.0, 1.0])
START, USUAL = np.array([0.2, 0.0, 0.25, 0.0]), np.array([0.65, 0.75])
FIRST = np.array([0.25, 0.0, 0.2, 0.0])  # the first estimate
PRIOR, NOISE = np.full(N, 0.1), np.full(P, 0.01)
DISTURBANCE = np.array([0.002, 0.02, 0.002, 0.02])


def system() -> qpmhe.System:
    """The model, in NumPy."""
    def part(index: int) -> Callable[..., Any]:
        def function(x: Any, z: Any, u: Any) -> Any:
            parts = ([one[..., i] for i in range(size)] for one, size in ((x, N), (z, K), (u, M)))
            return np.stack(equations(*parts, np)[index], -1)

        return function

    return qpmhe.System.from_dae(
        part(0), part(1), part(2), dt=DT, n=N, k=K, p=P, m=M, algebraic_guess=GUESS
    )


def rootfinder() -> tuple[ca.Function, ca.Function]:
    """The functions f and h, by CasADi's rootfinder on the same stages."""
    method = COLLOCATIONS["radau"]
    stages, x, u = ca.SX.sym("w", 3 * (N + K)), ca.SX.sym("x", N), ca.SX.sym("u", M)
    rates, rest, increments = [], [], []
    for i in range(3):
        one = stages[i * (N + K) : (i + 1) * (N + K)]
        rate, residual, _ = equations(
            ca.vertsplit(x + one[:N]), ca.vertsplit(one[N:]), ca.vertsplit(u), ca
        )
        increments.append(one[:N])
        rates.append(ca.vertcat(*rate))
        rest.append(ca.vertcat(*residual))
    for i in range(3):
        flow = sum(float(method.A[i, j]) * rates[j] for j in range(3))
        rest.append(increments[i] - DT * flow)
    options = {"abstol": 1e-12, "abstolStep": 1e-12}
    solve = ca.rootfinder("stages", "fast_newton", {
        "x": stages, "p": ca.vertcat(x, u), "g": ca.vertcat(*rest),
    }, options)
    z = ca.SX.sym("z", K)
    _, residual, y = equations(ca.vertsplit(x), ca.vertsplit(z), ca.vertsplit(u), ca)
    at = ca.rootfinder("algebraic", "fast_newton", {
        "x": z, "p": ca.vertcat(x, u), "g": ca.vertcat(*residual),
    }, options)
    output = ca.Function("output", [x, z, u], [ca.vertcat(*y)])
    X, U = ca.MX.sym("x", N), ca.MX.sym("u", M)
    given = ca.vertcat(X, U)
    start = ca.repmat(ca.vertcat(ca.DM.zeros(N), ca.DM(GUESS)), 3)
    f = ca.Function("f", [X, U], [X + solve(start, given)[2 * (N + K) :][:N]])
    return f, ca.Function("h", [X, U], [output(X, at(ca.DM(GUESS), given), U)])


def estimator(model: qpmhe.System, engine: str, max_qps: int | None) -> Any:
    """An estimator with the weights that all have."""
    covariances = {"disturbance": np.diag(DISTURBANCE**2), "noise": np.diag(NOISE**2)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return qpmhe.MovingHorizonEstimator(
            model, qpmhe.ExtendedKalman(prior=np.diag(PRIOR**2), **covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances), horizon=HORIZON,
            initial_state=FIRST, max_qps=max_qps, engine=engine,
        )


def do_mpc_step() -> Callable[[Any], Any]:
    """A step of do-mpc's estimator, from (y, the input before) to the filtered state."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import do_mpc

        model = do_mpc.model.Model("continuous", "SX")
        x, z, u = (
            [model.set_variable(kind, f"{kind[1]}{i}") for i in range(size)]
            for kind, size in (("_x", N), ("_z", K), ("_u", M))
        )
        rates, rest, outputs = equations(x, z, u, ca)
        for i, rate in enumerate(rates):
            model.set_rhs(f"x{i}", rate, process_noise=True)
        for i, one in enumerate(rest):
            model.set_alg(f"g{i}", one)
        for i, y in enumerate(outputs):
            model.set_meas(f"y{i}", y, meas_noise=True)
        for i, one in enumerate(u):
            model.set_meas(f"u{i}", one, meas_noise=False)
        model.setup()
        mhe = do_mpc.estimator.MHE(model, [])
        mhe.set_param(
            n_horizon=HORIZON, t_step=DT, meas_from_data=True, store_full_solution=False,
            state_discretization="collocation", collocation_type="radau", collocation_deg=3,
            collocation_ni=1, store_solver_stats=[],
        )
        mhe.settings.supress_ipopt_output()
        # Its disturbance is a rate.
        mhe.set_default_objective(
            P_x=np.diag(PRIOR**-2), P_v=np.diag(NOISE**-2), P_w=np.diag((DISTURBANCE / DT) ** -2)
        )
        mhe.setup()
        mhe.x0, mhe.z0, mhe.u0 = FIRST, GUESS, USUAL
        mhe.set_initial_guess()
    return lambda sample: mhe.make_step(np.concatenate(sample)[:, None]).ravel()


def step_times(model: qpmhe.System, x: Any, u: Any) -> dict[str, float]:
    """Microseconds of f and its Jacobian in C: of qpmhe's code, and of CasADi's rootfinder."""
    found, count = {}, len(x)
    f, _ = rootfinder()
    X, U = ca.MX.sym("x", N), ca.MX.sym("u", M)
    value = f(X, U)
    both = ca.Function("both", [X, U], [value, ca.jacobian(value, X)])
    next_states, slopes = np.zeros((count, N)), np.zeros((count, N, N))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("model.c").write_text(model_files(model.symbolic)["model.c"], encoding="ascii")
        library = ctypes.CDLL(str(compile_library(Path("model.c").absolute())))
        both.generate("both.c")
        external = ca.external("both", str(compile_library(Path("both.c").absolute())))
        buffer, run = external.buffer()
        states, inputs = np.zeros(N), np.zeros(M)
        out = np.zeros(N), np.zeros((N, N))
        for i, one in enumerate((states, inputs)):
            buffer.set_arg(i, memoryview(one))
        for i, one in enumerate(out):
            buffer.set_res(i, memoryview(one))
        pointer = ctypes.c_void_p
        times: dict[str, list[float]] = {"qpmhe": [], "fast_newton": []}
        for _ in range(20):
            _, seconds, _ = timed(lambda _: library.mhe_jacobians(
                ctypes.c_int64(count), pointer(x.ctypes.data), pointer(u.ctypes.data), None,
                ctypes.c_double(DT), pointer(next_states.ctypes.data), None,
                pointer(slopes.ctypes.data), None,
            ), None)
            times["qpmhe"].append(seconds / count)

            def all_of_them(_: None) -> float:
                error = 0.0
                for k in range(count):
                    states[:], inputs[:] = x[k], u[k]
                    run()
                    error = max(error, np.abs(out[0] - next_states[k]).max())
                return error

            error, seconds, _ = timed(all_of_them, None)
            times["fast_newton"].append(seconds / count)
        assert error < 1e-8, error
        for name, values in times.items():
            found[name] = 1e6 * float(np.median(values))
    return found


def pendulum(x: Any, u: Any) -> Any:
    """A damped pendulum."""
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0]) - 0.1 * x[..., 1]], -1)


def reactor(x: Any, u: Any) -> Any:
    """The reactor of van de Vusse: two concentrations, two temperatures."""
    a, b, inner, jacket = (x[..., i] for i in range(4))
    first = 1.287e12 * np.exp(-9758.3 / (inner + 273.15))
    second = 9.043e9 * np.exp(-8560.0 / (inner + 273.15))
    heat = first * a * 4.2 - first * b * 11.0 - second * a * a * 41.85
    return np.stack([
        u[..., 0] * (5.1 - a) - first * a - second * a * a, first * (a - b) - u[..., 0] * b,
        u[..., 0] * (130.0 - inner) + 30.8 * (jacket - inner) - heat / 2.81,
        86.7 * (inner - jacket) - 113.0,
    ], -1)


def chain(x: Any, u: Any) -> Any:
    """Cells in a row that exchange and decay."""
    left = np.concatenate([u[..., :1], x[..., :-1]], -1)
    right = np.concatenate([x[..., 1:], x[..., -1:]], -1)
    return 3.0 * (left - 2.0 * x + right) - 0.5 * x**3


#: Rates, steps, and usual states with their deviations.
MILD = {
    "pendulum, n = 2": (pendulum, 0.1, np.zeros(2), 1.0),
    "reactor, n = 4": (reactor, 0.005, np.array([1.2, 0.9, 134.0, 130.0]), 0.03),
    "chain, n = 8": (chain, 0.05, np.zeros(8), 1.0),
    "chain, n = 20": (chain, 0.05, np.zeros(20), 1.0),
}


def linearized(made: qpmhe.System, x: Any, u: Any, folder: str) -> Callable[[Any], Any]:
    """A call of f and its Jacobian in C at all of these states."""
    file, pointer, shape = Path(folder, "model.c"), ctypes.c_void_p, x.shape
    file.write_text(model_files(made.symbolic)["model.c"], encoding="ascii")
    library = ctypes.CDLL(str(compile_library(file)))
    out, slopes = np.zeros(shape), np.zeros((*shape, shape[1]))
    return lambda _: library.mhe_jacobians(
        ctypes.c_int64(len(x)), pointer(x.ctypes.data), pointer(u.ctypes.data), None,
        ctypes.c_double(made.dt), pointer(out.ctypes.data), None, pointer(slopes.ctypes.data), None,
    )


def radau_times() -> dict[str, dict[str, float]]:
    """Microseconds of f and its Jacobian in C, by a step of rk4, of midpoint and of radau."""
    generator, found, count = np.random.default_rng(0), {}, 400
    for name, (rate, dt, usual, deviation) in MILD.items():
        n = len(usual)
        size = np.where(usual == 0.0, 1.0, usual) * deviation
        x = np.ascontiguousarray(usual + size * generator.standard_normal((count, n)))
        u = np.full((count, 1), 0.4)
        times: dict[str, list[float]] = {"rk4": [], "midpoint": [], "radau": []}
        with tempfile.TemporaryDirectory() as folder:
            calls = {
                method: linearized(qpmhe.System.from_ode(
                    rate, lambda x: x[..., :1], dt=dt, n=n, p=1, m=1, method=method
                ), x, u, folder) for method in times
            }
        for _ in range(40):
            for method, call in calls.items():
                times[method].append(timed(call, None)[1] / count)
        found[name] = {one: 1e6 * float(np.median(values)) for one, values in times.items()}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=150)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()
    model, generator = system(), np.random.default_rng(0)
    own, x, states, inputs, outputs = model.model(), START, [], [], []
    for t in range(arguments.samples):
        u = USUAL + np.array([0.05 * np.sin(0.1 * t), -0.03 * np.cos(0.07 * t)])
        states.append(x)
        inputs.append(u)
        outputs.append(own.functions.h(x, u) + NOISE * generator.standard_normal(P))
        x = own.functions.f(x, u) + DISTURBANCE * generator.standard_normal(N)
    truth, U = np.array(states), np.array(inputs)
    calls: dict[str, Callable[[Any], Any]] = {}
    for name, engine, qps in (
        ("qpmhe, C, 1 QP", "compiled", 1), ("qpmhe, C, 2 QPs", "compiled", 2),
        ("qpmhe, C, converged", "compiled", None), ("qpmhe, Python, 2 QPs", "python", 2),
    ):
        mhe = estimator(model, engine, qps)
        calls[name] = lambda sample, mhe=mhe: mhe.update(sample[0], sample[1]).filtered
    slow = estimator(qpmhe.from_casadi(*rootfinder(), compiled=False), "python", 2)
    calls["qpmhe on CasADi's fast_newton, 2 QPs"] = (
        lambda sample: slow.update(sample[0], sample[1]).filtered
    )
    try:
        other = do_mpc_step()
        calls["do-mpc"] = lambda sample: other((sample[0], sample[2]))
    except ImportError:
        Console().print("do-mpc is not installed")
    times = {name: [] for name in calls}
    errors = {name: [] for name in calls}
    for t in range(arguments.samples):
        sample = outputs[t], U[t], U[max(t - 1, 0)]
        for name, call in calls.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found, seconds, _ = timed(call, sample)
            if t > HORIZON:
                times[name].append(seconds)
                errors[name].append(found - truth[t])
    reference = "do-mpc" if "do-mpc" in calls else next(iter(calls))
    usual = np.median(times[reference])
    table = Table(title="A step of the estimator", title_justify="left")
    for column in ("estimator", "ms", f"{reference} takes", "rms error of angles", "of speeds"):
        table.add_column(column, justify="left" if column == "estimator" else "right")
    rows = []
    for name in calls:
        rms, middle = np.sqrt(np.mean(np.square(errors[name]), axis=0)), np.median(times[name])
        rows.append({
            "estimator": name, "milliseconds": 1e3 * middle, "ratio": usual / middle,
            "angles": float(np.sqrt(np.mean(rms[::2] ** 2))),
            "speeds": float(np.sqrt(np.mean(rms[1::2] ** 2))),
        })
        table.add_row(name, f"{1e3 * middle:.3g}", f"{usual / middle:.3g} times",
                      f"{rows[-1]['angles']:.4f}", f"{rows[-1]['speeds']:.4f}")
    Console().print(table)
    steps = step_times(model, np.ascontiguousarray(truth), U)
    Console().print(
        f"f and its Jacobian in C: qpmhe {steps['qpmhe']:.3g} us, CasADi's fast_newton "
        f"{steps['fast_newton']:.3g} us, {steps['fast_newton'] / steps['qpmhe']:.3g} times as long"
    )
    mild = radau_times()
    for name, one in mild.items():
        Console().print(
            f"{name}: rk4 {one['rk4']:.3g} us, midpoint {one['midpoint'] / one['rk4']:.2g} and "
            f"radau {one['radau'] / one['rk4']:.2g} times as long"
        )
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "algebraic.json").write_text(json.dumps({
        "environment": environment(("qpmhe", "casadi", "do-mpc")), "rows": rows, "steps": steps,
        "mild": mild,
    }, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
