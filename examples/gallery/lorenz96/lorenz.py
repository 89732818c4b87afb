"""Forty variables of weather on a circle, the usual test of data assimilation (Lorenz 1996).

The true state follows the model without disturbance and is measured at each step of 0.05, with
R = I. DAPPER (https://github.com/nansencenter/DAPPER) publishes errors of ensemble methods on it,
for all variables measured: in ``docs/examples/basic_2.py``, with the settings of
``dapper/mods/Lorenz96/sakov2008.py``. As there, the error is the root mean square over the
variables, averaged over time after a burn-in of 20 units of time; a run takes 50.

The variances of the disturbance that filters and estimators assume, the horizons and the numbers of
QPs are those that ``--choose`` finds on other seeds than those of the table.
"""

from __future__ import annotations

import argparse
import itertools
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.console import Console

import qpmhe
from qpmhe.plots import save
from qpmhe.plots.style import LIGHT, line_styles

from ..problem import Array
from ..report import markdown

SIZE, FORCING, DT = 40, 8.0, 0.05
STEPS, BURN, SPIN_UP = 1000, 400, 500
#: Runs of the table, and others that choose the settings.
SEEDS, CHOOSING = range(5), range(100, 102)
#: Variance of the disturbance in an estimator's cost: the true one is 0.
IN_COST = 1e-5
#: DAPPER's errors, all variables measured; commit ae89b30d of June 2026.
PUBLISHED = {
    "iEnKS, 40 members": 0.17, "EnKF, square root, 28 members": 0.18, "EnKF-N, 24 members": 0.18,
    "EnKF, perturbed observations, 40 members": 0.22, "ExtKF": 0.24, "3D-Var": 0.41,
    "optimal interpolation": 0.95,
}
#: What is tried on the seeds that choose: variances in the filter, and horizons.
VARIANCES, HORIZONS = (3e-4, 1e-3, 3e-3, 1e-2), (40, 60)
NEXT = np.roll(np.arange(SIZE), -1)
BEFORE, LAST = np.roll(np.arange(SIZE), 2), np.roll(np.arange(SIZE), 1)


def rate(x: Array) -> Array:
    """Advection, damping and forcing."""
    return (x[..., NEXT] - x[..., BEFORE]) * x[..., LAST] - x + FORCING


def step(x: Array) -> Array:
    """A step of Runge and Kutta: the true state takes the same."""
    k1 = rate(x)
    k2 = rate(x + DT / 2 * k1)
    k3 = rate(x + DT / 2 * k2)
    k4 = rate(x + DT * k3)
    return x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@dataclass(frozen=True)
class Way:
    """An estimator: its observer, the variance that this assumes, and the moving horizon, if any.

    Parameters
    ----------
    name : str
        Its line of the table.
    observer : type
        The filter.
    variance : float
        Of the disturbance in the filter.
    horizon, qps : int
        N, and QPs per sample; 0 for the filter alone.
    """

    name: str
    observer: type[qpmhe.Observer]
    variance: float
    horizon: int = 1
    qps: int = 0

    def estimator(self, system: qpmhe.System, start: Array) -> qpmhe.MovingHorizonEstimator:
        """The estimator; its prior is the filter's."""
        eye, noise = np.eye(SIZE), np.eye(system.p)
        observer: Any = self.observer
        return qpmhe.MovingHorizonEstimator(
            system, observer(prior=eye, disturbance=self.variance * eye, noise=noise),
            qpmhe.QuadraticCost.from_covariances(disturbance=IN_COST * eye, noise=noise),
            horizon=self.horizon, initial_state=start, max_qps=self.qps, engine="python",
        )


class Setup(NamedTuple):
    """Which variables are measured, and what estimates them."""

    name: str
    title: str
    seen: Array
    ways: tuple[Way, ...]

    def system(self) -> qpmhe.System:
        """The model, with this output."""
        seen = self.seen
        return qpmhe.System(step, lambda x: x[..., seen], n=SIZE, p=len(seen))

    def record(self, seed: int, steps: int) -> tuple[Array, Array, Array]:
        """True states from the attractor, measurements, and where the estimates start."""
        rng = np.random.default_rng(seed)
        x = FORCING + rng.standard_normal(SIZE)
        for _ in range(SPIN_UP):
            x = step(x)
        states = np.empty((steps, SIZE))
        for t in range(steps):
            states[t], x = x, step(x)
        measured = states[:, self.seen] + rng.standard_normal((steps, len(self.seen)))
        return states, measured, states[0] + rng.standard_normal(SIZE)


def lines(variances: tuple[float, float, float], horizon: int, qps: int) -> tuple[Way, ...]:
    """The table's: those of EKF and UKF alone, and that of the EKF below the estimators."""
    alone, unscented, below = variances
    mhe = Way(f"MHE, N = {horizon}, {qps} QPs", qpmhe.ExtendedKalman, below, horizon, qps)
    return (
        Way("EKF", qpmhe.ExtendedKalman, alone),
        Way("UKF", qpmhe.UnscentedKalman, unscented),
        replace(mhe, name=f"MHE, N = 10, {qps} QPs", horizon=10),
        mhe,
    )


SETUPS = (
    Setup("full", "All 40 variables measured", np.arange(SIZE), lines((3e-4, 3e-4, 3e-4), 60, 3)),
    Setup("half", "Every second variable measured", np.arange(0, SIZE, 2),
          (*lines((3e-3, 3e-3, 3e-3), 60, 5),
           # The EKF may lose the state, and the estimator on it with it.
           Way("MHE on the UKF, N = 60, 5 QPs", qpmhe.UnscentedKalman, 3e-3, 60, 5))),
)


@dataclass(frozen=True, eq=False)
class Result:
    """Errors (S, T) of all runs of an estimator, and its time for a step in seconds."""

    way: Way
    errors: Array
    seconds: float

    def of_runs(self, burn: int) -> Array:
        """The error of each run, averaged after the burn-in."""
        means: Array = self.errors[:, burn:].mean(axis=1)
        return means


def judged(setup: Setup, way: Way, seeds: Sequence[int], steps: int) -> Result:
    """Run an estimator on the records of some seeds."""
    errors, times = [], []
    for seed in seeds:
        states, measured, start = setup.record(seed, steps)
        mhe = way.estimator(setup.system(), start)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", qpmhe.ObserverWarning)
            run = mhe.run(measured)
        errors.append(np.sqrt(np.mean((run.filtered - states) ** 2, axis=1)))
        times.append(np.median(run.times))
    return Result(way, np.array(errors), float(np.median(times)))


def choices(setup: Setup) -> Iterator[Way]:
    """What is tried on the seeds that choose."""
    for kind in (qpmhe.ExtendedKalman, qpmhe.UnscentedKalman):
        for variance in VARIANCES:
            yield Way(f"{kind.__name__}, {variance:g}", kind, variance)
    for mhe in [one for one in setup.ways if one.horizon in HORIZONS]:
        for variance, horizon in itertools.product(VARIANCES[:3], HORIZONS):
            kind = mhe.observer.__name__
            yield replace(
                mhe, name=f"MHE on {kind}, N = {horizon}, {mhe.qps} QPs, {variance:g}",
                variance=variance, horizon=horizon,
            )


def table(setup: Setup, results: Sequence[Result], burn: int) -> list[str]:
    """Its lines, in the order of the errors, with DAPPER's where there are some."""
    found = []
    for one in results:
        runs = one.of_runs(burn)
        variance = f"{one.way.variance:g}"
        found.append((runs.mean(), [
            one.way.name, variance, f"{runs.mean():.3f}", f"{runs.min():.3f} to {runs.max():.3f}",
            f"{1e3 * one.seconds:.2g}",
        ]))
    if len(setup.seen) == SIZE:
        found += [(e, [f"DAPPER: {name}", "", f"{e:.2f}", "", ""]) for name, e in PUBLISHED.items()]
    columns = ["estimator", "variance in the filter", "error", "of each run", "ms a step"]
    rows = [cells for _, cells in sorted(found, key=lambda one: one[0])]
    return markdown(columns, rows)


def verdict(setup: Setup, results: Sequence[Result], burn: int) -> str:
    """Who has the lowest error, as it is published: with two digits."""
    found = {one.way.name: round(one.of_runs(burn).mean(), 2) for one in results}
    if len(setup.seen) == SIZE:
        found |= {f"DAPPER: {name}" : error for name, error in PUBLISHED.items()}
    least = min(found.values())
    return f"Lowest error, {least:.2f}: {'; '.join(n for n, e in found.items() if e == least)}."


def draw(setups: Sequence[Setup], results: Sequence[Sequence[Result]]) -> Figure:
    """Errors of the first run over time, the mean over a unit of time; without the UKF's."""
    width = round(1.0 / DT)
    with rc_context(LIGHT):
        figure = Figure(figsize=(8.4, 6.0), layout="constrained")
        panels = figure.subplots(len(setups), 1, sharex=True, squeeze=False)[:, 0]
        for panel, setup, found in zip(panels, setups, results, strict=True):
            shown = {one.way.name: one for one in found if one.way.name != "UKF"}
            for style, (name, one) in zip(line_styles(shown), shown.items(), strict=True):
                smooth = np.convolve(one.errors[0], np.full(width, 1.0 / width), "valid")
                times = 0.5 + DT * np.arange(len(smooth))
                panel.plot(times, smooth, linewidth=1.4, label=name, **style)
            if len(setup.seen) == SIZE:
                panel.axhline(PUBLISHED["iEnKS, 40 members"], color="0.4", linewidth=0.8,
                              label="DAPPER: iEnKS, mean")
            panel.set(title=setup.title, ylabel="RMS error")
            panel.set_ylim(0.0, 3.0 * float(np.median(found[0].errors[0])))
            panel.legend(loc="upper right", ncols=2, fontsize="small")
        panels[-1].set_xlabel("time t")
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, and draw."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.gallery.lorenz96", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="one short run")
    parser.add_argument("--choose", action="store_true", help="try settings on other seeds")
    given, console = parser.parse_args(arguments), Console()
    steps, burn = (60, 20) if given.quick else (STEPS, BURN)
    if given.choose:
        steps, burn = BURN, BURN // 2
    seeds, text, results = SEEDS[:1] if given.quick else SEEDS, [], []
    for setup in SETUPS:
        text += [f"## {setup.title}", ""]
        ways = choices(setup) if given.choose else iter(setup.ways)
        found = []
        for way in ways:
            found.append(judged(setup, way, CHOOSING if given.choose else seeds, steps))
            mean = found[-1].of_runs(burn).mean()
            console.print(f"{setup.title}: {way.name}: {mean:.3f}", highlight=False)
        results.append(found)
        words = verdict(setup, found, burn)
        console.print(words, highlight=False, soft_wrap=True)
        text += [*table(setup, found, burn), "", words, ""]
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"lorenz96{'_choices' if given.choose else ''}.md"
    path.write_text("\n".join(text), encoding="utf-8")
    files = [path]
    if not given.choose:
        files += save(draw(SETUPS, results), given.out / "lorenz96")
    console.print("wrote", *files, highlight=False, soft_wrap=True)
    return 0
