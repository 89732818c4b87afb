"""The three models, estimated with filters, with moving horizon estimation and with do-mpc.

All have the covariances of the simulation and the same horizon. The plants, the component that is
judged and do-mpc's rates were set after a look at records of the seeds 0 to 2; the tables have
other seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import qpmhe
from qpmhe.plots import trajectories
from qpmhe.plots.style import LIGHT
from qpmhe.tuning import Weights

from ..problem import Problem, Record, Result, Way
from .plants import PLANTS, Plant, effect_of_rates, simulate

#: Runs of the tables and of a quick look; the record that sets do-mpc's rates and second prior.
SEEDS, FEW, SETTLES = range(10, 15), range(10, 11), 0
HORIZON = 10
SHOWN = "MHE, 2 QPs", "do-mpc", "EKF"


def model(plant: Plant) -> qpmhe.System:
    """The plant by Radau's method, with its bounds as X."""
    n, k, m = plant.n, len(plant.algebraic), len(plant.inputs[0])
    p, least = len(plant.noise), np.array(plant.least)

    def part(index: int) -> Callable[..., Any]:
        def function(*arguments: Any) -> Any:
            parts = [[one[..., i] for i in range(one.shape[-1])] for one in arguments]
            return np.stack(plant.equations(*parts, np)[index], axis=-1)

        return function

    rate, algebraic, output = (part(i) for i in range(3))
    bounded = qpmhe.Box(least[:n], np.full(n, np.inf)) if np.isfinite(least).any() else None
    options: dict[str, Any] = {
        "dt": plant.dt, "n": n, "p": p, "m": m, "states": bounded, "method": "radau",
        "steps": plant.substeps,
    }
    if k:
        return qpmhe.System.from_dae(
            lambda x, z, u: rate(x, z, u, u[..., :0]),
            lambda x, z, u: algebraic(x, z, u, u[..., :0]),
            lambda x, z, u: output(x, z, u, u[..., :0]), k=k, algebraic_guess=plant.algebraic,
            **options,
        )
    if plant.parameters:
        return qpmhe.augment_parameters(
            lambda x, u, theta: rate(x, x[..., :0], u, theta),
            lambda x, u, theta: output(x, x[..., :0], u, theta),
            nominal=plant.guess[n:], drifting=True,
            parameter_bounds=qpmhe.Box(least[n:], np.full(plant.parameters, np.inf)), **options,
        )
    return qpmhe.System.from_ode(
        lambda x, u: rate(x, x[..., :0], u, x[..., :0]),
        lambda x, u: output(x, x[..., :0], u, x[..., :0]), **options,
    )


def problem(plant: Plant, seeds: Sequence[int], quick: bool = False) -> Problem:
    """Records that differ in everything that is drawn; the first half of each lets them settle."""
    steps = 20 if quick else plant.steps
    guess = np.array(plant.guess)
    records = []
    for seed in seeds:
        states, measured, inputs = simulate(plant, seed, steps)
        records.append(Record("simulated", measured, inputs, states, [guess], steps // 2))
    prior, disturbance, noise = (
        np.diag(np.square(one)) for one in (plant.prior, plant.disturbance, plant.noise)
    )
    which = list(plant.error)
    return Problem(
        f"stiff_and_algebraic_{plant.name}", plant.title, model(plant), records,
        Weights(prior, disturbance, noise, HORIZON),
        lambda x, real: np.sqrt(np.mean((x - real)[:, which] ** 2, axis=1)), plant.error_unit,
        plant.lost, own=lambda all_, weights: own(plant, all_, weights),
        note=f"lost: an error above {plant.lost:g}. do-mpc: Radau collocation and Ipopt.",
    )


def problems(_: Path, quick: bool) -> list[Problem]:
    """All of them."""
    return [problem(plant, FEW if quick else SEEDS, quick) for plant in PLANTS]


def own(plant: Plant, problem: Problem, weights: Weights) -> dict[str, Way]:
    """do-mpc with the first prior, and with a settled filter's; nothing if it is not installed.

    Its disturbance is a rate, constant over a sample. The deviation of each rate is such that the
    state has the simulated deviation at the end of the sample. A fast state forgets, so that its
    rate is large.
    """
    if find_spec("do_mpc") is None:
        return {}
    from .peer import DoMpc

    states, measured, inputs = simulate(plant, SETTLES, len(problem.records[0].truth))
    half = len(states) // 2
    effect = effect_of_rates(plant, states[half:], inputs[half:])
    rates = np.diag(np.square(plant.disturbance[: plant.n] / effect))
    filter_ = problem.estimator(np.array(plant.guess), weights, max_qps=0, project_observer=False)
    found = filter_.run(measured, inputs, covariances=True).covariances
    assert found is not None
    settled = found[half:].mean(axis=0)
    priors = {"do-mpc": weights.prior, "do-mpc, EKF's prior": settled}
    return {name: partial(DoMpc, plant, horizon=weights.horizon, prior=prior, rates=rates)
            for name, prior in priors.items()}


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Figure:
    """For each plant, in a column, the run in which the EKF has its median error."""
    with rc_context(LIGHT):
        figure = Figure(figsize=(10.2, 5.0), layout="constrained")
        grid = figure.subplots(2, len(PLANTS), squeeze=False)
        for plant, problem, found, axes in zip(PLANTS, problems, results, grid.T, strict=True):
            by_name = {one.estimator: one for one in found}
            which = by_name["EKF"].which
            truth, at = problem.records[which].truth, [i for i, _ in plant.shown]
            drawn = {n: by_name[n].estimates[which][:, at] for n in SHOWN if n in by_name}
            trajectories(
                plant.dt * np.arange(float(len(truth))), truth[:, at], drawn,
                [name for _, name in plant.shown], f"time t ({plant.unit})", axes=list(axes),
            )
            axes[0].set_title(plant.title)
            if plant is not PLANTS[0]:
                axes[0].get_legend().remove()
    return figure
