"""State of charge of a real cell under drive cycles: as logged, with outliers, with wrong priors.

The model comes from ``samsung_30t.json``, which `identify` made without the cycles. The tester logs
every 0.1 s; the estimators get means over 2 s. The cell is full where a cycle begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from qpmhe.plots.style import LIGHT, REAL, line_styles
from qpmhe.tuning import Weights

from ..baselines import QPS
from ..command import DataError
from ..problem import Array, Problem, Record, Result, Way
from .measurements import drive_cycles, load, resample
from .model import Cell, constant_gain, robust_cost, robust_kalman, system_of, weights_of

DT = 2.0  # s
SHORTEST = 360.0  # s, of a cycle
QUICK = 900.0  # s, what --quick takes of each cycle
STARTS, FEW = (0.2, 0.4, 0.6, 0.8, 1.0), (0.6,)
OUTLIERS = 0.02  # share of the samples
PRIORS = {
    "small": np.diag([0.01, 0.001, 0.001, 0.01]) ** 2,
    "large": np.diag([0.3, 0.3, 0.3, 0.15]) ** 2,
}
ROBUST = {f"MHE, Huber, {name}": count for name, count in QPS.items() if count != 5}
SHOWN = ("EKF", "EKF, gated", "MHE, Huber, 1 QP")


def read(cell: Cell, path: Path, quick: bool) -> tuple[Array, Array, Array]:
    """Voltage and current (T, 1) of a drive cycle in steps of DT, and its SOC (T, 1)."""
    record = resample(load(path.parent, path.name), DT)
    steps = min(len(record.voltage), round(QUICK / DT) if quick else len(record.voltage))
    if DT * steps <= SHORTEST:
        raise DataError(f"{path} lasts {DT * steps:g} s; expected more than {SHORTEST:g} s.")
    soc = 1.0 + record.charge[:steps] / cell.capacity
    return record.voltage[:steps], record.current[:steps], soc[:, None]


def spoil(voltage: Array, to: float | None = None) -> Array:
    """Gross errors: off by 0.5 V to either side, or a reading of a fixed value."""
    rng = np.random.default_rng([20210829, to is not None])
    hit = rng.random(voltage.shape) < OUTLIERS
    off = voltage + rng.choice([-0.5, 0.5], voltage.shape) if to is None else to
    return np.where(hit, off, voltage)


def problems(folder: Path, quick: bool) -> list[Problem]:
    """The cycles as logged, with two kinds of outliers, and with two wrong prior covariances."""
    cell = Cell.read()
    system, by_hand = system_of(cell, DT), weights_of(cell, DT)
    cycles = {
        name: read(cell, path, quick) for name, path in drive_cycles(folder).items()
    }
    starts = [np.array([soc, 0.0, 0.0, 1.0]) for soc in (FEW if quick else STARTS)]

    def records(spoilt: Any = None) -> list[Record]:
        found = []
        for name, (voltage, current, soc) in cycles.items():
            known = np.full((len(soc), 4), np.nan)
            known[:, :1] = soc
            y = voltage if spoilt is None else spoilt(voltage)
            found.append(Record(name, y, current, soc, starts, len(y) // 2, known))
        return found

    def problem(
        stem: str, case: str = "", weights: Weights = by_hand, spoilt: Any = None
    ) -> Problem:
        return Problem(
            stem, f"State of charge{case and ', '}{case}", system, records(spoilt), weights,
            error, "%", 10.0, tuning=None if case or quick else TUNING, own=own,
            constant_gain=lambda _: constant_gain(DT),
        )

    return [
        problem("battery"),
        problem("battery_zeros", "2 % of the voltages read 0 V", spoilt=partial(spoil, to=0.0)),
        problem("battery_outliers", "2 % are off by 0.5 V", spoilt=spoil),
        *(problem(f"battery_{word}_prior", f"prior too {word}", weights_of(cell, DT, prior))
          for word, prior in PRIORS.items()),
    ]


# Only ratios matter to the estimates, so the noise stays. One factor of all disturbances: slow
# errors of one state determine no more.
TUNING: dict[str, Any] = {
    "objective": "truth", "held_out": 0.0, "structure": {"disturbance": "scalar"},
    "observer": robust_kalman, "max_qps": 0,
}


def error(estimates: Array, soc: Array) -> Array:
    """Error of the SOC in percentage points; every estimate is cut to between 0 and 1."""
    return 100.0 * np.abs(np.clip(estimates[:, 0], 0.0, 1.0) - soc[:, 0])


def own(problem: Problem, weights: Weights) -> dict[str, Way]:
    """A filter that outliers and a wrong prior do not lead astray, and a loss that fits it."""
    cost = robust_cost(weights)
    constant = robust_cost(weights, np.linalg.inv(weights.prior))
    found: dict[str, Way] = {
        "MHE, Huber, gain, 2 QPs": partial(
            problem.estimator, weights=weights, observer=constant_gain(DT), cost=constant,
            max_qps=2,
        )
    }
    for name, count in {"EKF, Huber": 0, **ROBUST}.items():
        found[name] = partial(
            problem.estimator, weights=weights, observer=robust_kalman, cost=cost, max_qps=count,
        )
    return found


def draw(problems: Sequence[Problem], results: Sequence[Sequence[Result]]) -> Any:
    """SOC, its error, and its error with outliers over time, a column for each cycle."""
    with rc_context(LIGHT):
        cycles = problems[0].records
        figure = Figure(figsize=(max(4.4 * len(cycles), 5.0), 7.4), layout="constrained")
        axes = figure.subplots(3, len(cycles), sharex="col", sharey="row", squeeze=False)
        for record, (top, plain, spoilt) in zip(cycles, axes.T, strict=True):
            minutes = DT / 60.0 * np.arange(len(record.truth))
            top.plot(minutes, 100 * record.truth[:, 0], **REAL)
            for panel, found in ((plain, results[0]), (spoilt, results[1])):
                lines = {
                    one.estimator: one.middle[:, 0] for one in reversed(found)
                    if one.record == record.name and one.estimator in SHOWN
                }
                for style, name in zip(line_styles(SHOWN), SHOWN, strict=True):
                    how = {"linewidth": 1.2, "label": name, **style}
                    if panel is plain:
                        top.plot(minutes, 100 * np.clip(lines[name], 0.0, 1.0), **how)
                    off = 100 * (np.clip(lines[name], 0.0, 1.0) - record.truth[:, 0])
                    panel.plot(minutes, off, **how)
            top.set_title(record.name)
            spoilt.set(xlabel="time (min)", xlim=(0, minutes[-1]))
        axes[0, 0].set(ylabel="state of charge (%)", ylim=(0, 103))
        axes[1, 0].set(ylabel="error (percentage points)", ylim=(-3, 3))
        axes[2, 0].set(ylabel="error (percentage points),\n2 % of the voltages read 0 V",
                       ylim=(-16, 6))
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center",
                      ncols=2, frameon=False)
    return figure
