"""Two textbook reactors on which an extended Kalman filter settles at negative pressures.

Gases react in a closed vessel, the total pressure is measured, and the first guess is wrong. Many
compositions have the same pressure; of these the filter (EKF) finds one that does not exist.

- 2A -> B: Haseltine and Rawlings, Critical evaluation of extended Kalman filtering and
  moving-horizon estimation, Ind. Eng. Chem. Res. 44 (2005), example 1; partial pressures.
- A <-> B + C, 2B <-> C: Rawlings, Mayne and Diehl, Model Predictive Control, 2nd edition, 2017,
  example 4.27; concentrations.

A known remedy is to clip the filter's states at zero. Moving horizon estimation (MHE) with
X = {x >= 0} projects its observer onto X, in the filter's own metric. The reference is Ipopt, which
at each time fits all measurements so far. The records are simulated, so the covariances are right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import qpmhe
from qpmhe.plots import trajectories
from qpmhe.plots.style import LIGHT
from qpmhe.tuning import Weights

from ..problem import Array, Problem, Record, Result, Way

SEEDS, FEW = 10, 2
HORIZON = 10
GAINS = 0.001, 0.003, 0.01  # the last one is the baseline
QUIET: dict[str, Any] = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
SHOWN = "MHE, 2 QPs", "EKF, clipped", "EKF, gated", "EKF"


class Reactor(NamedTuple):
    """A problem as its source states it."""

    name: str
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
    Reactor(
        "reactors_dimer", "2A → B", dimer, ("A", "B"), "atm", 1.0, 0.1, 100, (3, 1), (0.1, 4.5),
        (6, 1e-3, 0.1),
    ),
    Reactor(
        "reactors_batch", "A ⇌ B + C, 2B ⇌ C", batch, ("A", "B", "C"), "mol/L", 32.84, 0.25, 80,
        (0.5, 0.05, 0), (1, 0, 4), (0.5, 1e-3, 0.25),
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

    def filter(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        """The measurement update, clipped too."""
        updated, covariance = super().filter(z, v, sample)
        return np.maximum(updated, 0.0), covariance


class Ipopt:
    """Estimation from all measurements so far, converged; each start is the last solution."""

    engine = "Ipopt"

    def __init__(self, reactor: Reactor, start: Array) -> None:
        import casadi as ca

        self.reset(start)
        n, k = len(reactor.start), [0]
        x = ca.SX.sym("x", n)
        for part in (0.0, 0.5, 0.5, 1.0):
            k.append(ca.vertcat(*reactor.rates(*ca.vertsplit(x + part * reactor.dt * k[-1]))))
        following = x + reactor.dt / 6 * (k[1] + 2 * k[2] + 2 * k[3] + k[4])
        self._step = ca.Function("f", [x], [following])
        states, measured = ca.SX.sym("x", n, reactor.steps + 1), ca.SX.sym("y", reactor.steps)
        p, q, r = np.square(reactor.deviations)
        j, self._solvers = ca.sumsqr(states[:, 0] - ca.DM(reactor.guess)) / p, []
        for t in range(reactor.steps):
            j += ca.sumsqr(states[:, t + 1] - self._step(states[:, t])) / q
            j += (measured[t] - reactor.output * ca.sum1(states[:, t])) ** 2 / r
            program = {"x": ca.vec(states[:, : t + 2]), "p": measured[: t + 1], "f": j}
            self._solvers.append(ca.nlpsol("s", "ipopt", program, QUIET))

    def reset(self, start: Array) -> None:
        """Begin again."""
        self._start = np.array(start, float)

    def run(self, pressures: Array, _: None) -> SimpleNamespace:
        """What the gallery reads of a run."""
        n, found, filtered, times = len(self._start), self._start, [], []
        for t, solver in enumerate(self._solvers):
            began = perf_counter()
            start = np.append(found, np.array(self._step(found[-n:])))
            found = np.array(solver(x0=start, p=pressures[: t + 1], lbx=0.0)["x"]).ravel()
            filtered.append(np.maximum(found[-2 * n : -n], 0.0))  # Ipopt relaxes bounds by 1e-8
            times.append(perf_counter() - began)
        return SimpleNamespace(filtered=np.array(filtered), times=np.array(times))


def problems(_: Path, quick: bool) -> list[Problem]:
    """Both reactors."""
    return [problem(reactor, FEW if quick else SEEDS) for reactor in REACTORS]


def problem(reactor: Reactor, seeds: int) -> Problem:
    """Records that differ in their noise, from the one wrong guess; their second half judges."""
    n, guess = len(reactor.start), np.array(reactor.guess, float)
    p, q, r = np.square(reactor.deviations)
    records = []
    for states, pressures in (simulate(reactor, seed) for seed in range(seeds)):
        records.append(
            Record("simulated", pressures, None, states[:-1], [guess], reactor.steps // 2)
        )
    return Problem(
        reactor.name, reactor.title, model(reactor), records,
        Weights(p * np.eye(n), q * np.eye(n), np.array([[r]]), HORIZON),
        lambda x, real: np.sqrt(np.mean((x - real) ** 2, axis=1)), reactor.unit, max(reactor.start),
        own=partial(own, reactor), note=NOTE,
        constant_gain=lambda _: qpmhe.Luenberger(np.full(n, GAINS[-1])),
    )


NOTE = (
    f"constant gain: {GAINS[-1]:g}. lost: an error above the largest true value. EKF, projected: "
    "onto X, in its own metric. Ipopt fits all measurements so far, converged."
)


def own(reactor: Reactor, problem: Problem, weights: Weights) -> dict[str, Way]:
    """Remedies for the filter, constant gains, and Ipopt."""
    way = partial(problem.estimator, weights=weights)
    plain = partial(way, project_observer=False)
    found: dict[str, Way] = {
        "EKF, clipped": partial(plain, observer=Clipped, max_qps=0),
        "EKF, projected": partial(way, max_qps=0),
        "MHE, plain EKF, 2 QPs": partial(plain, max_qps=2),
        "MHE, UKF, 2 QPs": partial(way, observer=qpmhe.UnscentedKalman, max_qps=2),
    }
    for gain in GAINS:
        constant = {
            "observer": qpmhe.Luenberger(np.full(len(reactor.start), gain)),
            "weights": replace(weights, arrival="constant"),
        }
        found[f"gain {gain:g}, projected"] = partial(way, max_qps=0, **constant)
        found[f"MHE, gain {gain:g}, 2 QPs"] = partial(way, max_qps=2, **constant)
    if find_spec("casadi") is not None:
        found["Ipopt"] = partial(Ipopt, reactor)
    return found


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Figure:
    """The runs at the median of the filter's error; a column a reactor, grey where x < 0."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(8.4, 6.2), layout="constrained")
        grid = figure.subplots(3, 2, squeeze=False)
        for reactor, problem, found, axes in zip(
            REACTORS, problems, results, grid.T, strict=True
        ):
            by_name = {one.estimator: one for one in found}
            which = by_name["EKF"].which
            truth = problem.records[which].truth
            tops = np.max(truth, axis=0)
            # A filter that is lost leaves the panels, instead of filling them with its swings.
            drawn = {name: by_name[name].estimates[which] for name in SHOWN}
            drawn = {name: np.where(abs(x) < 20.0 * tops, x, np.nan) for name, x in drawn.items()}
            panels = list(axes[: len(reactor.species)])
            trajectories(
                reactor.dt * np.arange(float(reactor.steps)), truth,
                drawn, [f"{name} ({reactor.unit})" for name in reactor.species],
                "time t (unit of the rate constants)", axes=panels,
            )
            panels[0].set_title(reactor.title)
            for panel, top in zip(panels, tops, strict=True):
                panel.set_ylim(-1.5 * top, 2.5 * top)
                panel.axhspan(-1.5 * top, 0.0, color="0.92", zorder=0)
            panels[0].get_legend().remove()
        grid[2, 0].axis("off")
        grid[2, 0].legend(*grid[0, 0].get_legend_handles_labels(), loc="center", frameon=False)
    return figure
