"""Implicit steps: qpmhe, do-mpc, acados and CasADi's rootfinder on algebraic and stiff models.

Estimators of two generators with algebraic angles and voltages, of a fermentation of penicillin,
and of a reaction with diffusion, n = 24. All discretise by Radau IIA steps of order 5, as many a
sample, and have the same weights, horizon and record. do-mpc solves each window with Ipopt. Prior
and disturbance of do-mpc differ (see the page on do-mpc), so that errors compare only roughly.
Samples take turns; times are of one run, on one thread, and count once the windows are full.

Steps of these models and of some without stiffness follow: f and its Jacobian in C, by qpmhe's
methods, by acados' implicit integrator where ACADOS_SOURCE_DIR is set, and by CasADi's
rootfinder `fast_newton`; and how far the values of both are from qpmhe's.
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
from implicit_models import ESTIMATED, MILD, Array, Model
from peers import UnavailableError
from peers.acados_integrator import AcadosIntegrator
from peers.casadi_program import InPlace, compile_library
from report import environment, tell_once
from rich.console import Console
from rich.table import Table
from stopwatch import timed

import qpmhe
from qpmhe.codegen.model_source import model_files
from qpmhe.model.implicit_steps import COLLOCATIONS

HORIZON = 10
#: Relative to the largest rate or state: where the others' Newton iterations end.
TOLERANCE = 1e-10
#: What differs by more has not solved the stages; it gets no ratio.
SAME = 1e-6


def rootfinder(model: Model, x: Array) -> tuple[ca.Function, ca.Function]:
    """The functions f and h, by CasADi's rootfinder on the same stages; x is usual."""
    method, (n, k, m) = COLLOCATIONS["radau"], model.sizes
    (w, u), value, y = model.expressions()
    equations, output = ca.Function("equations", [w, u], [value]), ca.Function("y", [w, u], [y])
    stages, at, held = ca.SX.sym("stages", 3 * (n + k)), ca.SX.sym("x", n), ca.SX.sym("u", m)
    rates, rest, increments = [], [], []
    for i in range(3):
        one = stages[i * (n + k) : (i + 1) * (n + k)]
        both = equations(ca.vertcat(at + one[:n], one[n:]), held)
        increments.append(one[:n])
        rates.append(both[:n])
        rest.append(both[n:])
    for i in range(3):
        flow = sum(float(method.A[i, j]) * rates[j] for j in range(3))
        rest.append(increments[i] - model.dt / model.steps * flow)
    tolerance = TOLERANCE * float(np.abs(x).max())
    options = {"abstol": tolerance, "abstolStep": tolerance}
    solve = ca.rootfinder("stages", "fast_newton", {
        "x": stages, "p": ca.vertcat(at, held), "g": ca.vertcat(*rest),
    }, options)
    X, U = ca.MX.sym("x", n), ca.MX.sym("u", m)
    start = ca.repmat(ca.vertcat(ca.DM.zeros(n), ca.DM(model.guess)), 3)
    following = X
    for _ in range(model.steps):
        following = following + solve(start, ca.vertcat(following, U))[2 * (n + k) :][:n]
    f = ca.Function("f", [X, U], [following])
    if not k:
        return f, ca.Function("h", [X, U], [output(X, U)])
    z = ca.SX.sym("z", k)
    consistent = ca.rootfinder("algebraic", "fast_newton", {
        "x": z, "p": ca.vertcat(at, held), "g": equations(ca.vertcat(at, z), held)[n:],
    }, options)
    found = consistent(ca.DM(model.guess), ca.vertcat(X, U))
    return f, ca.Function("h", [X, U], [output(ca.vertcat(X, found), U)])


def estimator(model: Model, system: qpmhe.System, engine: str, max_qps: int | None) -> Any:
    """An estimator with the weights that all have."""
    covariances = {"disturbance": np.diag(model.disturbance**2), "noise": np.diag(model.noise**2)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(prior=np.diag(model.deviation**2), **covariances),
            qpmhe.QuadraticCost.from_covariances(**covariances), horizon=HORIZON,
            initial_state=first_estimate(model), max_qps=max_qps, engine=engine,
        )


def first_estimate(model: Model) -> Array:
    """Half a deviation beside the start."""
    return model.start + 0.5 * model.deviation


def do_mpc_step(model: Model) -> Callable[[Any], Any]:
    """A step of do-mpc's estimator, from (y, the input before) to the filtered state."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import do_mpc

        made = do_mpc.model.Model("continuous", "SX")
        x, z, u = (
            [made.set_variable(kind, f"{kind[1]}{i}") for i in range(size)]
            for kind, size in zip(("_x", "_z", "_u"), model.sizes, strict=True)
        )
        rates, rest, outputs = model.equations(x, z, u, ca)
        for i, rate in enumerate(rates):
            made.set_rhs(f"x{i}", rate, process_noise=True)
        for i, one in enumerate(rest):
            made.set_alg(f"g{i}", one)
        for i, y in enumerate(outputs):
            made.set_meas(f"y{i}", y, meas_noise=True)
        for i, one in enumerate(u):
            made.set_meas(f"u{i}", one, meas_noise=False)
        made.setup()
        mhe = do_mpc.estimator.MHE(made, [])
        mhe.set_param(
            n_horizon=HORIZON, t_step=model.dt, meas_from_data=True, store_full_solution=False,
            state_discretization="collocation", collocation_type="radau", collocation_deg=3,
            collocation_ni=model.steps, store_solver_stats=[],
        )
        mhe.settings.supress_ipopt_output()
        # Its disturbance is a rate.
        mhe.set_default_objective(
            P_x=np.diag(model.deviation**-2.0), P_v=np.diag(model.noise**-2.0),
            P_w=np.diag((model.disturbance / model.dt) ** -2.0),
        )
        mhe.setup()
        mhe.x0, mhe.u0 = first_estimate(model), model.held
        if z:
            mhe.z0 = np.array(model.guess)
        mhe.set_initial_guess()
    return lambda sample: mhe.make_step(np.concatenate(sample)[:, None]).ravel()


def estimates(model: Model, samples: int) -> list[dict[str, Any]]:
    """Times and errors of all estimators on one record."""
    system, generator = model.system(), np.random.default_rng(0)
    own, x, states, inputs, outputs = system.model(), model.start, [], [], []
    n, _, m = model.sizes
    for t in range(samples):
        u = model.held * (1.0 + 0.07 * np.sin(0.1 * t + np.arange(m)))
        states.append(x)
        inputs.append(u)
        outputs.append(own.functions.h(x, u) + model.noise * generator.standard_normal(system.p))
        x = own.functions.f(x, u) + model.disturbance * generator.standard_normal(n)
    calls: dict[str, Callable[[Any], Any]] = {}
    for name, engine, qps in (
        ("qpmhe, C, 1 QP", "compiled", 1), ("qpmhe, C, 2 QPs", "compiled", 2),
        ("qpmhe, C, converged", "compiled", None), ("qpmhe, Python, 2 QPs", "python", 2),
    ):
        mhe = estimator(model, system, engine, qps)
        calls[name] = lambda sample, mhe=mhe: mhe.update(sample[0], sample[1]).filtered
    try:
        by_casadi = qpmhe.from_casadi(*rootfinder(model, model.start), compiled=False)
        slow = estimator(model, by_casadi, "python", 2)
        calls["qpmhe on CasADi's fast_newton, 2 QPs"] = (
            lambda sample: slow.update(sample[0], sample[1]).filtered
        )
    except qpmhe.errors.ModelError as error:  # its Newton iteration does not find the stages
        tell_once(f"{model.name}: left out: fast_newton: {error}")
    try:
        other = do_mpc_step(model)
        calls["do-mpc"] = lambda sample: other((sample[0], sample[2]))
    except ImportError:
        tell_once("left out: do-mpc is not installed")
    times: dict[str, list[float]] = {name: [] for name in calls}
    errors: dict[str, list[Array]] = {name: [] for name in calls}
    for t in range(samples):
        sample = outputs[t], inputs[t], inputs[max(t - 1, 0)]
        for name, call in calls.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found, seconds, _ = timed(call, sample)
            if t > HORIZON:
                times[name].append(seconds)
                errors[name].append((found - states[t]) / model.deviation)
    reference = "do-mpc" if "do-mpc" in calls else next(iter(calls))
    usual = float(np.median(times[reference]))
    return [{
        "model": model.name, "estimator": name, "reference": reference,
        "milliseconds": 1e3 * float(np.median(times[name])),
        "mean_milliseconds": 1e3 * float(np.mean(times[name])),
        "ratio": usual / float(np.median(times[name])),
        "error": float(np.sqrt(np.mean(np.square(errors[name])))),
    } for name in calls]


#: Steps at all states: next states (count, n) and Jacobians (count, n, n) by x.
Steps = Callable[[], tuple[Array, Array]]


def ours(model: Model, method: str, x: Array, u: Array, folder: str) -> Steps:
    """In qpmhe's C."""
    made = model.system(method)
    file, pointer = Path(folder, "model.c"), ctypes.c_void_p
    file.write_text(model_files(made.symbolic)["model.c"], encoding="ascii")
    library = ctypes.CDLL(str(compile_library(file)))
    out, slopes = np.zeros(x.shape), np.zeros((*x.shape, x.shape[1]))

    def call() -> tuple[Array, Array]:
        library.mhe_jacobians(
            ctypes.c_int64(len(x)), pointer(x.ctypes.data), pointer(u.ctypes.data), None,
            ctypes.c_double(made.dt), pointer(out.ctypes.data), None,
            pointer(slopes.ctypes.data), None,
        )
        return out, slopes

    return call


def by_fast_newton(model: Model, x: Array, u: Array, folder: str) -> Steps:
    """CasADi's rootfinder, in C; a loop in C goes over the states."""
    f, _ = rootfinder(model, x)
    n, _, m = model.sizes
    X, U = ca.MX.sym("x", n), ca.MX.sym("u", m)
    value = f(X, U)
    both = ca.Function("both", [X, U], [value, ca.densify(ca.jacobian(value, X))])
    with contextlib.chdir(folder):
        file = both.map(len(x)).generate("both.c")
        library = str(compile_library(Path(file).absolute()))
    call = InPlace(ca.external(both.map(len(x)).name(), library))
    for given, values in zip(call.arguments.values(), (x, u), strict=True):
        given[:] = values.ravel()

    def run() -> tuple[Array, Array]:
        call()
        out, slopes = call.results.values()
        return out.reshape(x.shape), slopes.reshape(len(x), n, n).transpose(0, 2, 1)

    return run


def by_acados(model: Model, x: Array, u: Array, reuses: bool) -> Steps:
    """By acados' integrator."""
    n, _, m = model.sizes
    (w, held), value, _ = model.expressions()
    equations = ca.Function("equations", [w, held], [value])
    guesses = np.tile(np.array(model.guess), (len(x), 1))
    rates = equations(np.hstack((x, guesses)).T, u.T).full()[:n]
    made = AcadosIntegrator(
        equations, n, m, model.dt, model.steps, model.guess,
        TOLERANCE * float(np.abs(rates).max()), reuses,
    )
    out, slopes = np.zeros(x.shape), np.zeros((*x.shape, n))

    def run() -> tuple[Array, Array]:
        failed = made.steps(x, u, out, slopes)
        if failed:
            out[:] = np.nan
        return out, slopes.transpose(0, 2, 1)

    return run


def step_times(model: Model, count: int) -> dict[str, Any]:
    """Microseconds of f and its Jacobian, and the largest relative difference from our radau."""
    generator, (n, k, _) = np.random.default_rng(0), model.sizes
    x = model.start + model.deviation * generator.uniform(-1.0, 1.0, (count, n))
    u = np.tile(model.held, (count, 1))
    calls: dict[str, Steps] = {}
    with tempfile.TemporaryDirectory() as folder:
        for method in ("radau",) if k else ("rk4", "midpoint", "radau"):
            calls[method] = ours(model, method, x, u, folder)
        calls["fast_newton"] = by_fast_newton(model, x, u, folder)
    try:
        calls["acados"] = by_acados(model, x, u, False)
        calls["acados, one Jacobian"] = by_acados(model, x, u, True)
    except UnavailableError as error:
        tell_once(f"left out: acados: {error}")
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(40):
        for name, call in calls.items():
            times[name].append(timed(lambda _, call=call: call(), None)[1] / count)
    right = calls["radau"]()
    sizes = [np.abs(one).max(axis=0) for one in right]
    sizes[1] = np.maximum(sizes[1], 1e-3 * sizes[1].max())  # entries that are next to nothing
    differences = {
        name: max(
            float((np.abs(found - own) / size).max())
            for found, own, size in zip(call(), right, sizes, strict=True)
        ) for name, call in calls.items() if name not in ("rk4", "midpoint", "radau")
    }
    return {
        "model": model.name,
        "us": {name: 1e6 * float(np.median(values)) for name, values in times.items()},
        "least_us": {name: 1e6 * min(values) for name, values in times.items()},
        "differences": differences,
    }


def show_steps(console: Console, rows: list[dict[str, Any]]) -> None:
    """Print the table of steps."""
    table = Table(
        title="f and its Jacobian in C, least of 40 runs: radau in microseconds and in times of "
        "rk4 and midpoint; the others in times of radau, and how far they are from it",
        title_justify="left",
    )
    for column in ("model", "radau us", "/ rk4", "/ midpoint", "acados", "differs",
                   "fast_newton", "differs"):
        table.add_column(column, justify="left" if column == "model" else "right")
    for row in rows:
        us, gaps = row["least_us"], row["differences"]
        # The faster of its ways that solves the stages.
        acados = min(
            (one for one in us if one.startswith("acados")),
            key=lambda one: us[one] if gaps[one] < SAME else np.inf, default=None,
        )
        cells = [
            f"{us['radau'] / us[one]:.2g}" if one in us else "-" for one in ("rk4", "midpoint")
        ]
        for one in (acados, "fast_newton"):
            solved = one and gaps[one] < SAME
            cells += [f"{us[one] / us['radau']:.2g}"] if solved else ["-"]
            cells += [f"{gaps[one]:.0e}"] if one else ["-"]
        table.add_row(row["model"], f"{us['radau']:.3g}", *cells)
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=150)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder")
    arguments = parser.parse_args()
    console = Console()
    if console.width < 110:
        console = Console(width=110)
    surroundings = environment(("qpmhe", "casadi", "do-mpc"))
    rows = []
    for model in ESTIMATED:
        rows += (own := estimates(model, arguments.samples))
        table = Table(title=f"A step of the estimator: {model.name}", title_justify="left")
        for column in ("estimator", "median ms", "mean ms", f"{own[0]['reference']} takes",
                       "rms error, in deviations of the prior"):
            table.add_column(column, justify="left" if column == "estimator" else "right")
        for row in own:
            table.add_row(
                row["estimator"], f"{row['milliseconds']:.3g}", f"{row['mean_milliseconds']:.3g}",
                f"{row['ratio']:.3g} times", f"{row['error']:.4f}",
            )
        console.print(table)
    steps = [step_times(model, 400) for model in (*MILD, *ESTIMATED)]
    show_steps(console, steps)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "algebraic.json").write_text(json.dumps({
        "environment": surroundings, "rows": rows, "steps": steps,
    }, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
