"""The circuit, and a network that learns its error from one drive cycle, judged on the others.

``python -m examples.gallery.battery.learnt --data DIR`` prints the table of the page *Learnt
models*.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import qpmhe

from ..command import DataError
from .cell import DT, STARTS, error, read
from .measurements import HPPC, Array, drive_cycles, load, resample
from .model import Cell, system_of, weights_of

# Every so many steps of the long test of pulses.
THINNED = 20

#: Voltage and current (T, 1) and the counted state of charge (T, 1).
Cycle = tuple[Array, Array, Array]


def pulses(cell: Cell, folder: Path) -> Cycle:
    """The test from which the circuit was identified, until the cell is empty."""
    record = resample(load(folder, HPPC), DT)
    steps = int(np.argmin(record.charge))
    soc = 1.0 + cell.hppc_charge_factor * record.charge[:steps] / cell.capacity
    return record.voltage[:steps], record.current[:steps], soc[:, None]


def left_over(cell: Cell, cycle: Cycle) -> tuple[Array, Array]:
    """What the network sees, (s, v1, v2, I) (T, 4), and the voltage without explanation (T,)."""
    voltage, current, soc = cycle
    system, states = system_of(cell, DT), [np.array([1.0, 0.0, 0.0, 1.0])]
    for known, u in zip(soc, current, strict=True):
        states[-1][0] = known[0]
        states.append(system.f(states[-1], u))
    x = np.array(states[:-1])
    gap = voltage - system.h.batch(x, current)
    return np.hstack((x[:, :3], current)), gap[:, 0]


def trained(inputs: Array, gap: Array) -> Callable[[Array], Array]:
    """A network of two small layers, with scaled inputs and targets."""
    network = MLPRegressor(
        hidden_layer_sizes=(16, 16), activation="tanh", alpha=1e-2, max_iter=300, random_state=0)
    model = TransformedTargetRegressor(
        make_pipeline(StandardScaler(), network), transformer=StandardScaler())
    return qpmhe.from_sklearn(model.fit(inputs, gap))


def judged(cell: Cell, cycle: Cycle, net: Callable[[Array], Array] | None) -> float:
    """RMSE of the state of charge in percentage points over the second half, median of starts."""
    voltage, current, soc = cycle
    found, weights = [], weights_of(cell, DT)
    for start in STARTS[::2]:
        mhe = qpmhe.MovingHorizonEstimator(
            system_of(cell, DT, net), weights.observer(), weights.cost(),
            horizon=weights.horizon, initial_state=[start, 0.0, 0.0, 1.0], max_qps=1,
        )
        gap = error(mhe.run(voltage, current).filtered, soc)
        found.append(np.sqrt(np.mean(gap[len(gap) // 2 :] ** 2)))
    return float(np.median(found))


def rows(folder: Path) -> list[str]:
    """The lines of the table."""
    cell = Cell.read()
    cycles = {name: read(cell, path, False) for name, path in drive_cycles(folder).items()}
    seen = {name: left_over(cell, cycle) for name, cycle in cycles.items()}
    everywhere = [values[::THINNED] for values in left_over(cell, pulses(cell, folder))]
    table = ["| trained on | held out | voltage left | error of the SOC |", "|---|---|---|---|"]
    for held_out, cycle in cycles.items():
        others = [seen[name] for name in cycles if name != held_out]
        names = ", ".join(name for name in cycles if name != held_out)
        inputs, gap = seen[held_out]
        nets: dict[str, Callable[[Array], Array] | None] = {
            "nothing: the circuit alone": None,
            names: trained(*map(np.concatenate, zip(*others, strict=True))),
            f"{names} and pulses": trained(
                *map(np.concatenate, zip(*others, everywhere, strict=True))),
        }
        for name, net in nets.items():
            left = gap if net is None else gap - net(inputs)[:, 0]
            millivolts = 1e3 * np.sqrt(np.mean(left**2))
            table.append(
                f"| {name} | {held_out} | {millivolts:.1f} mV | {judged(cell, cycle, net):.2f} |")
            print(table[-1], flush=True)
    return table


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the .mat files")
    try:
        rows(parser.parse_args().data)
    except DataError as failure:
        print(f"error: {failure}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
