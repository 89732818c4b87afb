"""Three rotating masses, the MHE example of do-mpc, estimated with qpmhe and with do-mpc.

Three discs hang on a shaft between two motors, joined by springs; x holds the angles of the discs
(rad), their speeds (rad/s) and the angles of the motors (rad), which follow their setpoints u.
The discs' angles are measured, and the inertia of the first disc is unknown. Model and data are
those of do-mpc's documentation (S. Lucia, A. Tatulea-Codrean, C. Schoppmeyer, S. Engell, Rapid
development of modular and sustainable nonlinear model predictive control solutions, Control
Engineering Practice 60, 2017), with added disturbances of the speeds.

Both get the same record, right-hand side, horizon and covariances. docs/do-mpc.md lists
the remaining differences. Without do-mpc (``pip install do-mpc``), its row is left out.
"""

import argparse
import importlib
import warnings
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.plots import save, trajectories

Array = NDArray[np.float64]

DT, HORIZON, PIECES = 0.1, 10, 10
SPRINGS = np.array([2.697, 2.66, 3.05, 2.86]) * 1e-3  # N m/rad
DAMPERS = np.array([6.78, 8.01, 8.82]) * 1e-5  # N m s/rad
INERTIA = 2.25  # 1e-4 kg m^2, of all three
LAG = 1e-2  # s, of the motors

NOISE = 0.01  # rad
# Standard deviations of the disturbances in one step; those of angles and motors are not real
# but keep both problems well posed.
DISTURBANCE = np.array([1e-3] * 3 + [0.05] * 3 + [1e-3] * 2)
PRIOR = np.array([0.5] * 3 + [1.0] * 3 + [0.5] * 2)
GUESS, GUESS_SPREAD = 1.0, 1.0  # of the inertia in 1e-4 kg m^2
BOUNDS = 0.1, 10.0
EARLY = slice(2 * HORIZON, 50)  # the inertia is being found; no errors before
LATER = slice(EARLY.stop, None)


class Record(NamedTuple):
    """x(0), ..., x(T); u(t) from t to t + 1; y(t) for t = 1, ..., T."""

    states: Array
    inputs: Array
    measurements: Array


class Result(NamedTuple):
    """Estimates of x(1), ..., x(T) with y of their own time, of the inertia, and seconds."""

    states: Array
    inertias: Array
    times: Array


def rate(x: Any, u: Any, inertia: Any) -> Any:
    """dx/dt for CasADi."""
    disc, speed, motor = x[:3], x[3:6], x[6:]
    inertias = 1e-4 * ca.vertcat(inertia, INERTIA, INERTIA)
    twist = SPRINGS * ca.diff(ca.vertcat(motor[0], disc, motor[1]))
    return ca.vertcat(speed, (ca.diff(twist) - DAMPERS * speed) / inertias, (u - motor) / LAG)


def simulate(seed: int, steps: int) -> Record:
    """Setpoints that jump now and then, the discs out of rest at the start."""
    rng = np.random.default_rng(seed)
    x, u = ca.SX.sym("x", 8), ca.SX.sym("u", 2)
    f = ca.integrator("f", "cvodes", {"x": x, "u": u, "ode": rate(x, u, INERTIA)}, 0.0, DT)
    states, inputs = [np.append(rng.uniform(-0.5, 0.5, 6), [0.0, 0.0])], [np.zeros(2)]
    for _ in range(steps):
        following = f(x0=states[-1], u=inputs[-1])["xf"].full().ravel()
        following[3:6] += DISTURBANCE[3:6] * rng.standard_normal(3)
        states.append(following)
        jump = rng.random() < 0.2
        inputs.append(rng.uniform(-np.pi / 2, np.pi / 2, 2) if jump else inputs[-1])
    x_all = np.array(states)
    noise = NOISE * rng.standard_normal((steps, 3))
    return Record(x_all, np.array(inputs[:-1]), x_all[1:, :3] + noise)


def with_qpmhe(record: Record, max_qps: int | None) -> Result:
    """The inertia is a ninth state without noise, in units of 1e-4 kg m^2."""
    x, u = ca.SX.sym("x", 9), ca.SX.sym("u", 2)
    value, step = x[:8], DT / PIECES
    for _ in range(PIECES):  # the motors are too fast for one Runge-Kutta step of DT
        k1 = rate(value, u, x[8])
        k2 = rate(value + step / 2 * k1, u, x[8])
        k3 = rate(value + step / 2 * k2, u, x[8])
        k4 = rate(value + step * k3, u, x[8])
        value = value + step / 6 * (k1 + 2 * (k2 + k3) + k4)
    f = ca.Function("f", [x, u], [ca.vertcat(value, x[8])])
    limit = np.full(8, np.inf)
    system = qpmhe.from_casadi(
        f, lambda x: x[:3],
        states=qpmhe.Box(np.append(-limit, BOUNDS[0]), np.append(limit, BOUNDS[1])),
        disturbances=qpmhe.Box(np.append(-limit, 0.0), np.append(limit, 0.0)),
    )
    disturbance, noise = np.diag(DISTURBANCE**2), NOISE**2 * np.eye(3)
    # The observer's gain is for the guessed inertia, which it leaves as it is.
    known = ca.Function("known", [x[:8], u], [ca.substitute(value, x[8], GUESS)])
    gain = qpmhe.design_luenberger(
        qpmhe.from_casadi(known, lambda x: x[:3]), np.zeros(8), np.zeros(2),
        disturbance=disturbance, noise=noise,
    ).gain
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag(np.append(PRIOR, GUESS_SPREAD) ** 2),
        disturbance=np.diag(np.append(DISTURBANCE, 1.0) ** 2), noise=noise,
    )
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(np.vstack([gain, np.zeros((1, 3))])), cost, horizon=HORIZON,
        initial_state=np.append(np.zeros(8), GUESS), max_qps=max_qps, candidate="reinitialized",
        engine="python",
    )
    # y(0) does not exist in do-mpc's loop; u(T) acts after the end.
    measurements = np.vstack([np.full(3, np.nan), record.measurements])
    run = mhe.run(measurements, np.vstack([record.inputs, record.inputs[-1:]]))
    return Result(run.filtered[1:, :8], run.filtered[1:, 8], run.times[1:])


def with_do_mpc(record: Record) -> Result:
    """The documented way; its w is a rate, and its parameter is constant in each window."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses ONNX, which is of no use here
        import do_mpc  # type: ignore[import-untyped,import-not-found,unused-ignore]  # optional

        model = do_mpc.model.Model("continuous", "SX")
        x = model.set_variable("_x", "x", shape=(8, 1))
        u = model.set_variable("_u", "u", shape=(2, 1))
        inertia = model.set_variable("_p", "inertia")
        model.set_meas("discs", x[:3], meas_noise=True)
        model.set_meas("setpoints", u, meas_noise=False)
        model.set_rhs("x", rate(x, u, inertia), process_noise=True)
        model.setup()

        mhe = do_mpc.estimator.MHE(model, ["inertia"])
        mhe.set_param(
            n_horizon=HORIZON, t_step=DT, meas_from_data=True, store_full_solution=False
        )
        mhe.settings.supress_ipopt_output()
        mhe.set_default_objective(
            P_x=np.diag(PRIOR**-2), P_v=np.eye(3) / NOISE**2,
            P_p=np.array([[GUESS_SPREAD**-2]]), P_w=np.diag((DISTURBANCE / DT) ** -2),
        )
        mhe.bounds["lower", "_p_est", "inertia"], mhe.bounds["upper", "_p_est", "inertia"] = BOUNDS
        mhe.setup()
        mhe.x0, mhe.p_est0 = np.zeros(8), GUESS
        mhe.set_initial_guess()

        states, inertias, times = [], [], []
        for u_now, y in zip(record.inputs, record.measurements, strict=True):
            began = perf_counter()
            found = mhe.make_step(np.append(y, u_now)[:, None])
            times.append(perf_counter() - began)
            states.append(found.ravel())
            inertias.append(float(mhe.p_est0["inertia"]))
    return Result(np.array(states), np.array(inertias), np.array(times))


def error_table(steps: int, seeds: int) -> tuple[Table, list[slice]]:
    """The table without its rows, and the samples of which it holds errors."""
    parts = [EARLY, LATER] if steps > EARLY.stop else [EARLY]
    early = f"early: samples {EARLY.start} to {min(steps, EARLY.stop) - 1}"
    rest = (
        f"{early}, then the rest" if LATER in parts
        else f"{early}; none from {EARLY.stop} on, whose columns are left out"
    )
    table = Table(
        title=f"Root mean square errors, {seeds} records, N = {HORIZON}",
        caption=f"x(t) with y(t); {rest};\n"
        "inertia in 1e-4 kg m²; time: median step, in units of the last row's",
        box=box.SIMPLE, collapse_padding=True, pad_edge=False,
    )
    headings = "angle\nrad", "speed\nrad/s", "inertia\n"
    table.add_column("", no_wrap=True)
    later = headings if LATER in parts else ()
    for heading in (*(f"{name}\nearly" for name in headings), *later, "time\n"):
        table.add_column(heading, justify="right")
    return table, parts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200, help="samples of a record")
    parser.add_argument("--seeds", type=int, default=5, help="number of records")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for the figure")
    arguments, console = parser.parse_args(), Console()
    if arguments.steps <= EARLY.start:
        parser.error(
            f"--steps is {arguments.steps}; expected more than {EARLY.start}: errors are taken "
            f"from sample {EARLY.start} on."
        )
    if arguments.seeds < 1:
        parser.error(f"--seeds is {arguments.seeds}; expected at least 1.")
    ways: dict[str, Callable[[Record], Result]] = {
        "observer": lambda record: with_qpmhe(record, 0),
        "qpmhe, 1 QP": lambda record: with_qpmhe(record, 1),
        "qpmhe, 2 QPs": lambda record: with_qpmhe(record, 2),
        "qpmhe, converged": lambda record: with_qpmhe(record, None),
        "do-mpc": with_do_mpc,
    }
    records = [simulate(seed, arguments.steps) for seed in range(arguments.seeds)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module("do_mpc")
    except ImportError:
        del ways["do-mpc"]
        console.print("do-mpc is not installed (pip install do-mpc): its row is left out.")
    results = {name: [way(record) for record in records] for name, way in ways.items()}

    table, parts = error_table(arguments.steps, arguments.seeds)
    unit = np.median([run.times for run in results[list(results)[-1]]])
    for name, runs in results.items():
        squares = np.array([
            np.column_stack((run.states - record.states[1:], run.inertias - INERTIA)) ** 2
            for run, record in zip(runs, records, strict=True)
        ])
        rmse = [
            np.sqrt(np.mean(squares[:, when, part]))
            for when in parts
            for part in (slice(3), slice(3, 6), slice(8, 9))
        ]
        times = np.median([run.times for run in runs]) / unit
        table.add_row(name, *(f"{value:.4f}" for value in rmse), f"{times:.3f}")
    console.print(table)
    truth = np.column_stack((records[0].states[1:], np.full(arguments.steps, INERTIA)))
    drawn = {
        name: np.column_stack((runs[0].states, runs[0].inertias))[:, [3, 5, 8]]
        for name, runs in results.items() if name in ("qpmhe, 2 QPs", "do-mpc")
    }
    axes = trajectories(
        DT * np.arange(1.0, arguments.steps + 1), truth[:, [3, 5, 8]], drawn,
        ("speed of disc 1 (rad/s)", "speed of disc 3 (rad/s)", "inertia (1e-4 kg m²)"),
        "time t (s)",
    )
    for path in save(axes[0].figure, arguments.out / "do_mpc_masses"):
        console.print(f"wrote {path}")


if __name__ == "__main__":
    main()
