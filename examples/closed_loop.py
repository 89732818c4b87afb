"""Model predictive control on estimates that must keep a deadline: a pendulum held upright.

A motor turns a pendulum's axis; beyond 0.8 rad its torque cannot hold it any more. Only the angle
is measured, with noise, and one measurement in thirty is grossly wrong. An unknown load acts on
the axis and changes halfway; the estimators find it as a third state. The controller is CasADi's:
one nonlinear program, built once and started at its former solution.

Each sample runs as on the machine. u(t) is applied and y(t) arrives; the estimator
predicts x(t+1), and from it the controller finds u(t+1), for which the simulation waits. An
estimate that is late is not used: the controller then continues from the model's prediction of
the former one. So moving horizon estimation (MHE) solves as many QPs as its time budget, half of
the deadline, allows: the rest is for a QP under way when the budget ends.

The same controller runs on a constant-gain observer, on an extended Kalman filter (without a test
that throws outliers away), on MHE over that observer, and on a state measured without error.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

import qpmhe
from qpmhe.plots import save, step_times, trajectories
from qpmhe.plots.style import LIGHT, MEASURED

Array = NDArray[np.float64]

DT = 0.04  # s
GRAVITY, FRICTION, TORQUE = 15.0, 0.2, 10.0  # 1/s^2, 1/s, 1/s^2: torques by moment of inertia
AHEAD = 40  # the controller's horizon in samples
START = np.array([0.3, 0.0, 0.0])
GUESS = np.zeros(3)
LOADS = 1.0, -1.0  # 1/s^2, in the first and in the second half

NOISE, OUTLIERS, SIZE = 0.02, 1 / 30, 0.5  # rad, share, rad
DISTURBANCE = np.array([0.002, 0.05, 0.1])  # rad, rad/s, 1/s^2, standard deviations of a step
PRIOR = np.array([0.3, 1.0, 1.0])
HORIZON = 20
UPRIGHT = 0.8  # rad


class Loop(NamedTuple):
    """One closed loop: states x(0), ..., what was estimated and done of each, seconds."""

    states: Array
    used: Array
    torques: Array
    measurements: Array
    estimating: Array
    controlling: Array
    late: int
    run: qpmhe.Run


def step() -> Any:
    """Angle from upright (rad), speed (rad/s) and load (1/s^2), one Runge-Kutta step on."""

    def rate(x: Any) -> Any:
        return ca.vertcat(x[1], GRAVITY * ca.sin(x[0]) - FRICTION * x[1] + u + x[2], 0.0)

    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    k1 = rate(x)
    k2 = rate(x + DT / 2 * k1)
    k3 = rate(x + DT / 2 * k2)
    k4 = rate(x + DT * k3)
    return ca.Function("step", [x, u], [x + DT / 6 * (k1 + 2 * (k2 + k3) + k4)])


def stage_cost(x: Any, u: Any) -> Any:
    """1 - cos(angle) is the height that is missing."""
    return 10.0 * (1.0 - ca.cos(x[0])) + 0.1 * x[1] ** 2 + 0.01 * u[0] ** 2


class Controller:
    """Torques that minimise the cost of the next samples, by multiple shooting and Ipopt."""

    def __init__(self, f: Any) -> None:
        xs, us, start = ca.SX.sym("x", 3, AHEAD), ca.SX.sym("u", 1, AHEAD), ca.SX.sym("start", 3)
        stages = ca.horzcat(start, xs)
        gaps = [xs[:, k] - f(stages[:, k], us[:, k]) for k in range(AHEAD)]
        cost = sum(stage_cost(stages[:, k], us[:, k]) for k in range(AHEAD))
        cost += 20.0 * stage_cost(stages[:, AHEAD], [0.0])  # stands for what comes after
        # The limit on time is for a start from nowhere; warm, a tenth of it is enough.
        options: dict[str, Any] = {
            "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 80, "max_wall_time": 0.5},
            "print_time": False,
        }
        program = {"x": ca.veccat(us, xs), "p": start, "f": cost, "g": ca.vertcat(*gaps)}
        self._solver = ca.nlpsol("mpc", "ipopt", program, options)
        limit = np.concatenate([np.full(AHEAD, TORQUE), np.full(3 * AHEAD, np.inf)])
        self._bounds: dict[str, Any] = {"lbx": -limit, "ubx": limit, "lbg": 0.0, "ubg": 0.0}
        self._plan: Array | None = None

    def __call__(self, x: Array) -> Array:
        """The torque u (1,) for the state x; the best that Ipopt has where its time is up."""
        if self._plan is None:
            self._plan = np.concatenate([np.zeros(AHEAD), np.tile(x, AHEAD)])
        found = self._solver(x0=self._plan, p=x, **self._bounds)["x"].full().ravel()
        us, xs = found[:AHEAD], found[AHEAD:].reshape(-1, 3)
        self._plan = np.concatenate([us[1:], us[-1:], xs[1:].ravel(), xs[-1]])
        torque: Array = np.clip(us[:1], -TORQUE, TORQUE)
        return torque


def estimators(system: qpmhe.System, deadline: float) -> dict[str, qpmhe.MovingHorizonEstimator]:
    """Without QPs, an estimator is its observer."""
    disturbance, prior, noise = np.diag(DISTURBANCE**2), np.diag(PRIOR**2), np.diag([NOISE**2])
    gain = qpmhe.design_luenberger(
        system, np.zeros(3), [0.0], disturbance=disturbance, noise=100 * noise
    )
    kalman = qpmhe.ExtendedKalman(prior=prior, disturbance=disturbance, noise=noise)
    cost = qpmhe.RobustCost(
        prior=np.linalg.inv(prior), disturbance=np.linalg.inv(disturbance),
        noise=qpmhe.Huber(np.linalg.inv(noise), threshold=1.345),
    )

    def estimator(
        observer: qpmhe.Observer, max_qps: int | None, budget: float | None = None
    ) -> qpmhe.MovingHorizonEstimator:
        return qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=HORIZON, initial_state=GUESS, max_qps=max_qps,
            time_budget=budget, engine="python",
        )

    return {
        "observer": estimator(gain, 0),
        "Kalman filter": estimator(kalman, 0),
        "MHE": estimator(gain, None, 0.5 * deadline),
    }


def simulate(
    system: qpmhe.System, controller: Controller, mhe: qpmhe.MovingHorizonEstimator | None,
    steps: int, seed: int, deadline: float,
) -> Loop:
    """Close the loop over an estimator, or over the true state where there is none."""
    rng = np.random.default_rng(seed)
    x, u, known = START.copy(), np.zeros(1), GUESS if mhe else START
    states, used, torques, ys, estimates = [x], [known], [], [], []
    estimating, controlling, late = [], [], 0
    for t in range(steps):
        x[2] = LOADS[2 * t >= steps]
        y = x[:1] + NOISE * rng.standard_normal(1)
        y += SIZE * rng.choice([-1.0, 1.0]) * (rng.random() < OUTLIERS)
        w = DISTURBANCE * [1.0, 1.0, 0.0] * rng.standard_normal(3)
        if mhe is None:
            known = system.f(x, u)
        else:
            began = perf_counter()
            estimate = mhe.update(y, u)
            estimating.append(perf_counter() - began)
            estimates.append(estimate)
            in_time = estimating[-1] <= deadline
            late += not in_time
            known = estimate.state if in_time else system.f(known, u)
        began = perf_counter()
        following = controller(known)
        controlling.append(perf_counter() - began)
        x = system.f(x, u) + w
        states.append(x)
        used.append(known)
        torques.append(u)
        ys.append(y)
        u = following
    return Loop(
        np.array(states), np.array(used), np.array(torques), np.array(ys), np.array(estimating),
        np.array(controlling), late, qpmhe.Run.of(GUESS, estimates),
    )


def tabulate(loops: dict[str, list[Loop]], deadline: float) -> Table:
    table = Table(
        title=f"Closed loop, {len(loops['MHE'])} records; deadline {1e3 * deadline:g} ms",
        caption=f"cost: mean of a sample; upright: share of samples within {UPRIGHT:g} rad;\n"
        "RMSE: of the states that the controller started from; times: median and 99th percentile",
        box=box.SIMPLE, collapse_padding=True, pad_edge=False,
    )
    table.add_column("state from", no_wrap=True)
    for heading in (
        "cost", "upright\n%", "RMSE\nrad", "\nrad/s", "late\n%", "update\nms", "\np99",
        "MPC\nms", "\np99",
    ):
        table.add_column(heading, justify="right")
    for name, runs in loops.items():
        costs = [
            stage_cost(x, u)
            for run in runs for x, u in zip(run.states[:-1], run.torques, strict=True)
        ]
        upright = np.mean([np.abs(run.states[:, 0]) < UPRIGHT for run in runs])
        errors = np.concatenate([run.used - run.states for run in runs])
        rmse = np.sqrt(np.mean(errors**2, axis=0))
        seconds = [np.concatenate([run[k] for run in runs]) for k in (4, 5)]
        table.add_row(
            name, f"{np.mean(costs):.2f}", f"{100 * upright:.0f}",
            *(f"{value:.3f}" for value in rmse[:2]),
            f"{100 * sum(run.late for run in runs) / len(costs):.1f}" if seconds[0].size else "",
            *(
                f"{1e3 * np.percentile(each, level):.2f}" if each.size else ""
                for each in seconds for level in (50, 99)
            ),
        )
    return table


def draw(loops: dict[str, list[Loop]], deadline: float) -> Figure:
    """Angle and torque of the first record, and the times of MHE."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(7.2, 7.4), layout="constrained")
        axes = figure.subplots(3, 1, height_ratios=(1.3, 1.0, 1.0))
        axes[1].sharex(axes[0])
        first = {name: runs[0] for name, runs in loops.items()}
        times = DT * np.arange(len(first["MHE"].states), dtype=np.float64)
        trajectories(
            times, None,
            {
                name: np.column_stack((run.states[:, 0], np.append(run.torques, np.nan)))
                for name, run in first.items()
            },
            ("angle from upright (rad)", "torque (1/s²)"), "time t (s)", axes=axes[:2],
        )
        axes[0].plot(
            times[:-1], first["MHE"].measurements[:, 0], zorder=1,
            **MEASURED | {"label": "measured (MHE's loop)"},
        )
        axes[0].set_ylim(-UPRIGHT, UPRIGHT)  # who leaves has fallen
        axes[1].axhspan(-TORQUE, TORQUE, color="0.96", zorder=0)
        handles, names = axes[0].get_legend_handles_labels()
        axes[0].get_legend().remove()
        figure.legend(handles, names, loc="outside upper center", ncols=5)
        step_times(first["MHE"].run, deadline=deadline, axes=axes[2])
        axes[2].set_xlim(right=5e6 * deadline)  # the deadline's label is right of its line
        axes[2].set(xlabel="time of an MHE update (µs)", ylabel="share that took longer")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=250, help="samples of a record")
    parser.add_argument("--seeds", type=int, default=3, help="number of records")
    parser.add_argument("--deadline", type=float, default=10.0,
                        help="deadline of an estimate, in ms")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for the figure")
    arguments, console = parser.parse_args(), Console()
    deadline = 1e-3 * arguments.deadline

    model = step()
    system = qpmhe.from_casadi(model, lambda x: x[0])
    loops: dict[str, list[Loop]] = {}
    for seed in track(range(arguments.seeds), "records", console=console):
        candidates = {**estimators(system, deadline), "full state": None}
        for name, mhe in candidates.items():
            controller = Controller(model)
            loop = simulate(system, controller, mhe, arguments.steps, seed, deadline)
            loops.setdefault(name, []).append(loop)
    console.print(tabulate(loops, deadline))
    shares = [loop.run.share(qpmhe.Status.TIME_UP) for loop in loops["MHE"]]
    qps = np.concatenate([loop.run.qps for loop in loops["MHE"]])
    console.print(
        f"MHE: {qps.mean():.1f} QPs per sample; its budget of {500 * deadline:g} ms ended "
        f"{np.mean(shares):.0%} of the sequences."
    )
    for path in save(draw(loops, deadline), arguments.out / "closed_loop"):
        console.print(f"wrote {path}")


if __name__ == "__main__":
    main()
