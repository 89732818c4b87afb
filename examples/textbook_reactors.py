"""Two textbook reactors on which an extended Kalman filter settles at negative pressures.

Gases react in a closed vessel, the total pressure is measured, and the first guess is wrong. Many
compositions have the same pressure; of these the filter (EKF) finds one that does not exist. It is
the standard argument for moving horizon estimation (MHE) with constraints x >= 0.

- 2A -> B: Haseltine and Rawlings, Critical evaluation of extended Kalman filtering and
  moving-horizon estimation, Ind. Eng. Chem. Res. 44 (2005), example 1. States are partial pressures.
- A <-> B + C, 2B <-> C: Rawlings, Mayne and Diehl, Model Predictive Control, 2nd edition, 2017,
  example 4.27. States are concentrations.

Known remedies are tried beside ours: states clipped at zero after each step of the filter, and a
chi-square gate on its innovations. `MovingHorizonEstimator` projects its observer onto X = {x >= 0}
in the filter's own metric; ``project_observer=False`` is the paper's plain observer. Ipopt fits each
record as a whole at each time, from the first guess on: the reference.
"""

import argparse
import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

import qpmhe
from qpmhe.plots import save, trajectories
from qpmhe.plots.style import LIGHT

Array = NDArray[np.float64]

GATE = 10.83  # squared innovation of one output that 99.9 % of the samples stay below
GAINS = (0.001, 0.003, 0.01)
EKF = "EKF"


class Reactor(NamedTuple):
    """A problem as its source states it."""

    title: str
    rates: Callable[..., tuple[Any, ...]]  # of the components, for NumPy and CasADi
    species: tuple[str, ...]
    unit: str
    output: float  # y = output * sum(x)
    dt: float
    steps: int
    start: tuple[float, ...]
    guess: tuple[float, ...]
    prior: float  # standard deviations
    disturbance: float
    noise: float
    horizon: int = 10


def dimer(a: Any, b: Any) -> tuple[Any, ...]:
    reaction = 0.16 * a * a
    return -2 * reaction, reaction


def batch(a: Any, b: Any, c: Any) -> tuple[Any, ...]:
    first, second = 0.5 * a - 0.05 * b * c, 0.2 * b * b - 0.01 * c
    return -first, first - 2 * second, first + second


REACTORS = (
    Reactor("2A → B", dimer, ("A", "B"), "atm", 1.0, 0.1, 100, (3.0, 1.0), (0.1, 4.5), 6.0, 0.001, 0.1),
    Reactor(
        "A ⇌ B + C, 2B ⇌ C", batch, ("A", "B", "C"), "mol/L", 32.84, 0.25, 80, (0.5, 0.05, 0.0),
        (1.0, 0.0, 4.0), 0.5, 0.001, 0.25,
    ),
)


def model(reactor: Reactor, bounded: bool = True) -> qpmhe.System:
    """One Runge-Kutta step of the reactor, with X or without."""
    n = len(reactor.start)
    return qpmhe.System.from_ode(
        lambda x: np.stack(reactor.rates(*np.moveaxis(x, -1, 0)), axis=-1),
        lambda x: reactor.output * x.sum(axis=-1), dt=reactor.dt, n=n, p=1,
        states=qpmhe.Box(np.zeros(n), np.full(n, np.inf)) if bounded else None,
    )


def simulate(reactor: Reactor, seed: int) -> tuple[Array, Array]:
    """True states, whose disturbances do not make them negative, and measured pressures."""
    rng, f = np.random.default_rng(seed), model(reactor).f
    states, pressures = [np.array(reactor.start)], []
    for _ in range(reactor.steps):
        x = states[-1]
        pressures.append([reactor.output * x.sum() + reactor.noise * rng.standard_normal()])
        w = reactor.disturbance * rng.standard_normal(x.size)
        states.append(np.maximum(f(x, np.zeros(0)) + w, 0.0))
    return np.array(states), np.array(pressures)


class Clipped(qpmhe.ExtendedKalman):
    """The filter whose states are set to zero where they are negative; its covariance stays."""

    def correct(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        correction, covariance = super().correct(z, v, sample)
        ahead = sample.system.f(z, sample.u)
        return np.maximum(ahead + correction, 0.0) - ahead, covariance


class Gated(qpmhe.ExtendedKalman):
    """The filter that ignores measurements which it holds for impossible."""

    def correct(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        c = sample.h_jacobian
        if v @ np.linalg.solve(c @ sample.covariance @ c.T + self._noise, v) > GATE:
            sample = dataclasses.replace(sample, observed=np.zeros(v.size, bool))
        return super().correct(z, v, sample)


def estimate(
    reactor: Reactor, pressures: Array, kind: Any = qpmhe.ExtendedKalman, max_qps: int | None = 0,
    bounded: bool = True, **options: Any,
) -> tuple[Array, float]:
    """States of a run, and the share of its steps in which inequalities were dropped."""
    n = len(reactor.start)
    covariances = {
        "prior": reactor.prior**2 * np.eye(n), "disturbance": reactor.disturbance**2 * np.eye(n),
        "noise": [[reactor.noise**2]],
    }
    if isinstance(kind, float):
        observer, prior = qpmhe.Luenberger(np.full(n, kind)), np.linalg.inv(covariances["prior"])
    else:
        observer, prior = kind(**covariances), qpmhe.ObserverPrior()
    cost = qpmhe.QuadraticCost(
        prior=prior, disturbance=np.linalg.inv(covariances["disturbance"]),
        noise=np.linalg.inv(covariances["noise"]),
    )
    mhe = qpmhe.MovingHorizonEstimator(
        model(reactor, bounded), observer, cost, horizon=reactor.horizon,
        initial_state=reactor.guess, max_qps=max_qps, **options,
    )
    with np.errstate(all="ignore"):  # a runaway observer overflows
        run = mhe.run(pressures)
    return run.states, run.share(qpmhe.Status.ROWS_DROPPED)


def ipopt(reactor: Reactor) -> Callable[[Reactor, Array], tuple[Array, float]]:
    """Estimation from all measurements so far, converged; each start is the last solution."""
    import casadi as ca

    n, dt = len(reactor.start), reactor.dt
    x = ca.SX.sym("x", n)
    k = [ca.vertcat(*reactor.rates(*ca.vertsplit(x)))]
    for part in (0.5, 0.5, 1.0):
        k.append(ca.vertcat(*reactor.rates(*ca.vertsplit(x + part * dt * k[-1]))))
    step = ca.Function("f", [x], [x + dt / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])])
    states, measured = ca.SX.sym("x", n, reactor.steps + 1), ca.SX.sym("y", reactor.steps)
    j = ca.sumsqr(states[:, 0] - ca.DM(reactor.guess)) / reactor.prior**2
    solvers = []
    for t in range(reactor.steps):
        j += ca.sumsqr(states[:, t + 1] - step(states[:, t])) / reactor.disturbance**2
        j += (measured[t] - reactor.output * ca.sum1(states[:, t])) ** 2 / reactor.noise**2
        program = {"x": ca.vec(states[:, : t + 2]), "p": measured[: t + 1], "f": j}
        options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        solvers.append(ca.nlpsol("s", "ipopt", program, options))

    def run(reactor: Reactor, pressures: Array) -> tuple[Array, float]:
        found, newest = np.array(reactor.guess), [np.array(reactor.guess)]
        for t, solver in enumerate(solvers):
            start = np.append(found, np.array(step(found[-n:])))
            found = np.array(solver(x0=start, p=pressures[: t + 1], lbx=0.0)["x"]).ravel()
            newest.append(np.maximum(found[-n:], 0.0))  # Ipopt relaxes bounds by 1e-8
        return np.array(newest), 0.0

    return run


def rows(reactor: Reactor, with_ipopt: bool) -> dict[str, Callable[..., tuple[Array, float]]]:
    """What is compared, by its name in the table."""
    found: dict[str, Callable[..., tuple[Array, float]]] = {
        EKF: partial(estimate, bounded=False),
        "EKF, clipped": partial(estimate, kind=Clipped, project_observer=False),
        "EKF, gated": partial(estimate, kind=Gated, bounded=False),
        "MHE, plain EKF, 2 QPs": partial(estimate, max_qps=2, project_observer=False),
    }
    for i in (0, 1, 2, 5, None):
        name = {0: "EKF, projected", 1: "MHE, 1 QP", None: "MHE, converged"}.get(i, f"MHE, {i} QPs")
        found[name] = partial(estimate, max_qps=i)
    for gain in GAINS:
        found[f"gain {gain:g}, plain"] = partial(estimate, kind=gain, project_observer=False)
        found[f"gain {gain:g}, projected"] = partial(estimate, kind=gain)
        found[f"MHE, gain {gain:g}, 2 QPs"] = partial(estimate, kind=gain, max_qps=2)
    if with_ipopt:
        found["Ipopt, all measurements"] = ipopt(reactor)
    return found


def number(value: float) -> str:
    return f"{value:.4f}" if value < 100.0 else f"{value:.0e}"


def draw(curves: list[dict[str, Array]], truths: list[Array]) -> Figure:
    """States of the first records; a column a reactor."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(8.4, 6.2), layout="constrained")
        grid = figure.subplots(3, 2, sharex="col", squeeze=False)
        for column, (reactor, lines, truth) in enumerate(zip(REACTORS, curves, truths, strict=True)):
            axes = list(grid[: len(reactor.species), column])
            trajectories(
                reactor.dt * np.arange(reactor.steps + 1.0), truth, lines,
                [f"{name} ({reactor.unit})" for name in reactor.species], "time t", axes=axes,
            )
            axes[0].set_title(reactor.title)
            for panel, real in zip(axes, truth.T, strict=True):
                panel.get_legend() and panel.get_legend().remove()
                width = max(np.ptp(real), 0.5 * np.max(truth))
                panel.set_ylim(-1.5 * width, 2.5 * width)
                panel.axhspan(-1.5 * width, 0.0, color="0.92", zorder=0)
        grid[2, 0].axis("off")
        grid[1, 0].xaxis.set_tick_params(labelbottom=True)
        grid[2, 0].legend(*grid[0, 0].get_legend_handles_labels(), loc="center", frameon=False)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="number of records")
    parser.add_argument("--no-ipopt", action="store_true", help="leave out the reference")
    parser.add_argument("--out", type=Path, help="folder for the figure, if one is wanted")
    arguments, console = parser.parse_args(), Console()
    try:
        import casadi  # noqa: F401
    except ImportError:
        console.print("CasADi is not installed: the row of Ipopt is left out.")
        arguments.no_ipopt = True
    curves, truths = [], []
    for reactor in REACTORS:
        records = [simulate(reactor, seed) for seed in range(arguments.seeds)]
        half = reactor.steps // 2
        table = Table(title=f"{reactor.title}: settled RMSE ({reactor.unit})")
        for heading in ("estimator", "median", "worst", "negative %", "dropped %"):
            table.add_column(heading, justify="left" if heading == "estimator" else "right")
        first = {}
        for name, way in track(rows(reactor, not arguments.no_ipopt).items(), reactor.title):
            found = [way(reactor, pressures) for _, pressures in records]
            errors = [
                np.sqrt(np.mean((states - real)[half:] ** 2))
                for (states, _), (real, _) in zip(found, records, strict=True)
            ]
            negative = np.mean([(states < 0.0).any(axis=1) for states, _ in found])
            dropped = np.mean([share for _, share in found])
            table.add_row(
                name, number(np.median(errors)), number(np.max(errors)), f"{100 * negative:.0f}",
                f"{100 * dropped:.0f}",
            )
            if name in (EKF, "EKF, clipped", "EKF, gated", "MHE, 2 QPs"):
                first[name] = found[0][0]
        console.print(table)
        curves.append(first)
        truths.append(records[0][0])
    if arguments.out is not None:
        for path in save(draw(curves, truths), arguments.out / "textbook_reactors"):
            console.print(f"wrote {path}")


if __name__ == "__main__":
    main()
