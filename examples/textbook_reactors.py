"""Two textbook reactors on which an extended Kalman filter settles at negative pressures.

Gases react in a closed vessel, the total pressure is measured, and the first guess is wrong. Many
compositions have the same pressure; of these the filter (EKF) finds one that does not exist.

- 2A -> B: Haseltine and Rawlings, Critical evaluation of extended Kalman filtering and
  moving-horizon estimation, Ind. Eng. Chem. Res. 44 (2005), example 1; partial pressures.
- A <-> B + C, 2B <-> C: Rawlings, Mayne and Diehl, Model Predictive Control, 2nd edition, 2017,
  example 4.27; concentrations.

Known remedies are to clip the filter's states at zero, and a chi-square gate on its innovations.
Moving horizon estimation (MHE) with X = {x >= 0} projects its observer onto X, in the filter's own
metric. The reference is Ipopt, which at each time fits all measurements so far.
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Column, Table

import qpmhe
from qpmhe.plots import save, trajectories
from qpmhe.plots.style import LIGHT

Array = NDArray[np.float64]
Way = Callable[..., tuple[Array, float]]  # of a reactor and its pressures
Drawn = tuple[Array, dict[str, Array]]  # true states of a record, and estimates of them

GATE = 10.83  # squared innovation of one output that 99.9 % of the samples stay below
QUIET: dict[str, Any] = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
SHOWN = ("MHE, 2 QPs", "EKF, clipped", "EKF, gated", "EKF")


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
    deviations: tuple[float, float, float]  # of prior, disturbance and noise


def dimer(a: Any, _: Any) -> tuple[Any, ...]:
    reaction = 0.16 * a * a
    return -2 * reaction, reaction


def batch(a: Any, b: Any, c: Any) -> tuple[Any, ...]:
    first, second = 0.5 * a - 0.05 * b * c, 0.2 * b * b - 0.01 * c
    return -first, first - 2 * second, first + second


REACTORS = (
    Reactor("2A → B", dimer, ("A", "B"), "atm", 1.0, 0.1, 100, (3, 1), (0.1, 4.5), (6, 1e-3, 0.1)),
    Reactor(
        "A ⇌ B + C, 2B ⇌ C", batch, ("A", "B", "C"), "mol/L", 32.84, 0.25, 80, (0.5, 0.05, 0),
        (1, 0, 4), (0.5, 1e-3, 0.25),
    ),
)


def model(reactor: Reactor) -> qpmhe.System:
    """One Runge-Kutta step of the reactor, and X."""
    n = len(reactor.start)
    return qpmhe.System.from_ode(
        lambda x: np.stack(reactor.rates(*np.moveaxis(x, -1, 0)), axis=-1),
        lambda x: reactor.output * x.sum(axis=-1), dt=reactor.dt, n=n, p=1,
        states=qpmhe.Box(np.zeros(n), np.full(n, np.inf)),
    )


def simulate(reactor: Reactor, seed: int) -> tuple[Array, Array]:
    """True states, whose disturbances do not make them negative, and measured pressures."""
    rng, f, (_, *deviations) = np.random.default_rng(seed), model(reactor).f, reactor.deviations
    states, pressures = [np.array(reactor.start, float)], []
    for _ in range(reactor.steps):
        v, w = rng.standard_normal(), rng.standard_normal(len(reactor.start))
        pressures.append([reactor.output * states[-1].sum() + deviations[1] * v])
        states.append(np.maximum(f(states[-1], np.zeros(0)) + deviations[0] * w, 0.0))
    return np.array(states), np.array(pressures)


class Clipped(qpmhe.ExtendedKalman):
    """The filter whose states are set to zero where they are negative."""

    def correct(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        """Correct such that z(t+1) >= 0; the covariance is the filter's."""
        correction, covariance = super().correct(z, v, sample)
        ahead = sample.system.f(z, sample.u)
        return np.maximum(ahead + correction, 0.0) - ahead, covariance


class Gated(qpmhe.ExtendedKalman):
    """The filter that ignores a measurement too far from what it expects."""

    def correct(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        """Correct unless the gate is shut."""
        c = sample.h_jacobian
        if v @ np.linalg.solve(c @ sample.covariance @ c.T + self._noise, v) > GATE:
            sample = replace(sample, observed=np.zeros(v.size, bool))
        return super().correct(z, v, sample)


def estimate(
    reactor: Reactor, pressures: Array, kind: Any = qpmhe.ExtendedKalman, max_qps: int | None = 0,
    **options: Any,
) -> tuple[Array, float]:
    """States of a run, and the share of its steps in which inequalities were dropped."""
    n = len(reactor.start)
    p, q, r = np.square(reactor.deviations)
    prior, observer = np.eye(n) / p, None
    if not isinstance(kind, float):
        observer = kind(prior=p * np.eye(n), disturbance=q * np.eye(n), noise=[[r]])
        prior = qpmhe.ObserverPrior()
    cost = qpmhe.QuadraticCost(prior=prior, disturbance=np.eye(n) / q, noise=1.0 / r)
    mhe = qpmhe.MovingHorizonEstimator(
        model(reactor), observer or qpmhe.Luenberger(np.full(n, kind)), cost, horizon=10,
        initial_state=reactor.guess, max_qps=max_qps, **options,
    )
    with np.errstate(all="ignore"):  # a runaway observer overflows
        run = mhe.run(pressures)
    return run.states, run.share(qpmhe.Status.ROWS_DROPPED)


def ipopt(reactor: Reactor) -> Way:
    """Estimation from all measurements so far, converged; each start is the last solution."""
    import casadi as ca

    n, k = len(reactor.start), [0]
    x = ca.SX.sym("x", n)
    for part in (0.0, 0.5, 0.5, 1.0):
        k.append(ca.vertcat(*reactor.rates(*ca.vertsplit(x + part * reactor.dt * k[-1]))))
    step = ca.Function("f", [x], [x + reactor.dt / 6 * (k[1] + 2 * k[2] + 2 * k[3] + k[4])])
    states, measured = ca.SX.sym("x", n, reactor.steps + 1), ca.SX.sym("y", reactor.steps)
    p, q, r = np.square(reactor.deviations)
    j, solvers = ca.sumsqr(states[:, 0] - ca.DM(reactor.guess)) / p, []
    for t in range(reactor.steps):
        j += ca.sumsqr(states[:, t + 1] - step(states[:, t])) / q
        j += (measured[t] - reactor.output * ca.sum1(states[:, t])) ** 2 / r
        program = {"x": ca.vec(states[:, : t + 2]), "p": measured[: t + 1], "f": j}
        solvers.append(ca.nlpsol("s", "ipopt", program, QUIET))

    def run(_: Reactor, pressures: Array) -> tuple[Array, float]:
        newest = [found := np.array(reactor.guess, float)]
        for t, solver in enumerate(solvers):
            start = np.append(found, np.array(step(found[-n:])))
            found = np.array(solver(x0=start, p=pressures[: t + 1], lbx=0.0)["x"]).ravel()
            newest.append(np.maximum(found[-n:], 0.0))  # Ipopt relaxes bounds by 1e-8
        return np.array(newest), 0.0

    return run


def rows(reactor: Reactor) -> dict[str, Way]:
    """What is compared, by its name in the table."""
    plain = partial(estimate, project_observer=False)
    found: dict[str, Way] = {
        "EKF": plain, "EKF, clipped": partial(plain, kind=Clipped),
        "EKF, gated": partial(plain, kind=Gated),
        "MHE, plain EKF, 2 QPs": partial(plain, max_qps=2), "EKF, projected": estimate,
    }
    for name, count in (("1 QP", 1), ("2 QPs", 2), ("5 QPs", 5), ("converged", None)):
        found[f"MHE, {name}"] = partial(estimate, max_qps=count)
    for gain in (0.001, 0.003, 0.01):
        found[f"gain {gain:g}, plain"] = partial(plain, kind=gain)
        found[f"gain {gain:g}, projected"] = partial(estimate, kind=gain)
        found[f"MHE, gain {gain:g}, 2 QPs"] = partial(estimate, kind=gain, max_qps=2)
    if find_spec("casadi") is not None:
        found["Ipopt, all measurements"] = ipopt(reactor)
    return found


def draw(shown: list[Drawn]) -> Figure:
    """The records at the median of the filter's error; a column a reactor, grey where x < 0."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(8.4, 6.2), layout="constrained")
        grid = figure.subplots(3, 2, squeeze=False)
        for reactor, axes, (truth, lines) in zip(REACTORS, grid.T, shown, strict=True):
            panels = list(axes[: len(reactor.species)])
            trajectories(
                reactor.dt * np.arange(reactor.steps + 1.0), truth, lines,
                [f"{name} ({reactor.unit})" for name in reactor.species],
                "time t (unit of the rate constants)", axes=panels,
            )
            panels[0].set_title(reactor.title)
            for panel, top in zip(panels, np.max(truth, axis=0), strict=True):
                panel.set_ylim(-1.5 * top, 2.5 * top)
                panel.axhspan(-1.5 * top, 0.0, color="0.92", zorder=0)
            panels[0].get_legend().remove()
        grid[2, 0].axis("off")
        grid[2, 0].legend(*grid[0, 0].get_legend_handles_labels(), loc="center", frameon=False)
    return figure


def compare(reactor: Reactor, seeds: int) -> tuple[Table, Drawn]:
    """The table of a reactor, and what to draw of it."""
    records = [simulate(reactor, seed) for seed in range(seeds)]
    headings = (Column(x, justify="right") for x in ("median", "worst", "negative %", "dropped %"))
    table = Table("estimator", *headings, title=f"{reactor.title}: settled RMSE ({reactor.unit})")
    lines, middle = {}, 0
    for name, way in track(rows(reactor).items(), reactor.title):
        found = [way(reactor, pressures) for _, pressures in records]
        lines[name] = [states for states, _ in found]
        errors = np.array(lines[name]) - [real for real, _ in records]
        rmse = np.sqrt(np.mean(errors[:, reactor.steps // 2 :] ** 2, axis=(1, 2)))
        shares = np.array(lines[name]).min(axis=2) < 0.0, [share for _, share in found]
        texts = [f"{x:.4f}" if x < 100.0 else f"{x:.0e}" for x in (np.median(rmse), rmse.max())]
        table.add_row(name, *texts, *(f"{100 * np.mean(each):.0f}" for each in shares))
        if name == "EKF":
            middle = int(np.argsort(rmse)[seeds // 2])
    return table, (records[middle][0], {name: lines[name][middle] for name in SHOWN})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="number of records")
    parser.add_argument("--out", type=Path, help="folder for the figure, if one is wanted")
    arguments, console = parser.parse_args(), Console()
    # Of the plain observers, which are far from the estimates here.
    warnings.simplefilter("ignore", qpmhe.ObserverWarning)
    shown = []
    for reactor in REACTORS:
        table, drawn = compare(reactor, arguments.seeds)
        console.print(table)
        shown.append(drawn)
    if arguments.out is not None:
        console.print(*save(draw(shown), arguments.out / "textbook_reactors"), sep="\n")


if __name__ == "__main__":
    main()
