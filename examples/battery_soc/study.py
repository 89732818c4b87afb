"""State of charge of a real lithium-ion cell: observers, Kalman filter, moving horizon estimation.

Run ``python examples/battery_soc/study.py --data DIR --out results``. DIR holds drive cycles of
P. Kollmeyer and M. Skells, *Samsung INR21700 30T 3Ah Li-ion Battery Data*, McMaster University,
Mendeley Data, doi 10.17632/9xyvy2njj3; every ``*.mat`` in it other than the C/20 and HPPC tests is
taken for one. The model comes from ``samsung_30t.json``, which `identify.py` made without them.

All estimators have the same model and the same noise, and start at SOC 0.6 while the cell is full.
The tester logs every 0.1 s; they get means over 2 s. The fast time constant of the circuit is 6 s,
that of the SOC minutes, and the output equation is the exact mean for a constant current.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from measurements import DOI, DataError, drive_cycles, load, resample
from model import (
    PRIOR,
    START,
    Array,
    Cell,
    constant_gain,
    disturbance,
    estimator,
    noise,
    system_of,
)
from report import draw, starts_table, stress_table, table
from rich.console import Console
from rich.progress import Progress

import qpmhe

DT = 2.0  # s
SETTLING = 300.0  # s, left out of the errors
QUICK = 900.0  # s, what --quick takes of each cycle
STARTS = 0.2, 0.4, 0.6, 0.8, 1.0
OUTLIERS = 0.02  # share of the samples
PRIORS = {
    "prior too small": np.diag([0.01, 0.001, 0.001, 0.01]) ** 2,
    "prior too large": np.diag([0.3, 0.3, 0.3, 0.15]) ** 2,
}


class Cycle(NamedTuple):
    """Voltage and current (T, 1), and the SOC (T + 1,) by the tester's counter."""

    name: str
    voltage: Array
    current: Array
    soc: Array
    warmest: float


class Result(NamedTuple):
    """One estimator under one condition: the error of SOC (T + 1,) in %, and s for each step."""

    cycle: str
    condition: str
    start: float
    estimator: str
    error: Array
    times: Array

    def figures(self) -> dict[str, object]:
        """What the tables and the JSON file tell."""
        late = self.error[round(SETTLING / DT) :]
        minute = round(60.0 / DT)
        within = np.convolve(np.abs(self.error) < 5.0, np.ones(minute), "valid") > minute - 0.5
        return {
            "cycle": self.cycle, "condition": self.condition, "start": self.start,
            "estimator": self.estimator,
            "rmse_percent": round(float(np.sqrt(np.mean(late**2))), 3),
            "max_percent": round(float(np.abs(late).max()), 3),
            "rmse_from_0_s_percent": round(float(np.sqrt(np.mean(self.error**2))), 3),
            "settled_s": float(DT * np.argmax(within)) if within.any() else None,
            "step_us": round(1e6 * float(np.mean(self.times)), 1),
        }


def read(cell: Cell, path: Path, length: float | None) -> Cycle:
    """A drive cycle in steps of DT, or its first seconds; the cell is full where it begins."""
    record = resample(load(path.parent, path.name), DT)
    steps = len(record.voltage) if length is None else min(round(length / DT), len(record.voltage))
    if DT * steps <= SETTLING + 60.0:
        raise DataError(f"{path} lasts {DT * steps:g} s; expected more than {SETTLING + 60:g} s.")
    return Cycle(
        path.name.split("_")[0].upper(), record.voltage[:steps], record.current[:steps],
        1.0 + record.charge[: steps + 1] / cell.capacity, float(record.temperature[:steps].max()),
    )


def kalman(cell: Cell, prior: Array, noisier: float = 1.0, livelier: float = 1.0) -> qpmhe.Observer:
    """The plain extended Kalman filter, with the covariances multiplied as told."""
    return qpmhe.ExtendedKalman(
        prior=prior, disturbance=livelier * disturbance(cell, DT), noise=noisier * noise(DT)
    )


def observe(
    system: qpmhe.System, observer: qpmhe.Observer, start: Array, cycle: Cycle
) -> tuple[Array, Array]:
    """The observer without an estimator: z(0), ..., z(T) and the seconds each step took."""
    states, covariance, times = [start], observer.initial_covariance(), []
    for y, u in zip(cycle.voltage, cycle.current, strict=True):
        began, z = perf_counter(), states[-1]
        sample = qpmhe.Sample(
            system, u, system.f_jacobian(z, u), system.h_jacobian(z, u), covariance=covariance
        )
        correction, covariance = observer.correct(z, y - system.h(z, u), sample)
        states.append(system.f(z, u) + correction)
        times.append(perf_counter() - began)
    return np.array(states), np.array(times)


class Bench:
    """Runs estimators on cycles, and keeps what they did.

    Parameters
    ----------
    cell : Cell
        The parameters of the model.
    start : float
        The initial SOC of all estimators, where nothing else is said.
    """

    def __init__(self, cell: Cell, start: float) -> None:
        self.cell, self.start = cell, start
        self.system = system_of(cell, DT)
        self.results: list[Result] = []

    def alone(
        self, name: str, observer: qpmhe.Observer, cycle: Cycle, condition: str = "",
        soc: float | None = None,
    ) -> Result:
        """An observer on its own; its SOC is told within 0 and 1, as everybody would."""
        soc = self.start if soc is None else soc
        states, times = observe(self.system, observer, start_at(soc), cycle)
        return self._keep(name, np.clip(states[:, 0], 0.0, 1.0), times, cycle, condition, soc)

    def mhe(
        self, name: str, max_qps: int | None, cycle: Cycle, condition: str = "",
        soc: float | None = None, prior: Array = PRIOR, observer: qpmhe.Observer | None = None,
    ) -> Result:
        """Moving horizon estimation."""
        soc = self.start if soc is None else soc
        run = estimator(
            self.cell, DT, max_qps=max_qps, start=start_at(soc), prior=prior, observer=observer
        ).run(cycle.voltage, cycle.current)
        return self._keep(name, run.states[:, 0], run.times, cycle, condition, soc)

    def _keep(
        self, name: str, soc: Array, times: Array, cycle: Cycle, condition: str, start: float
    ) -> Result:
        result = Result(cycle.name, condition, start, name, 100.0 * (soc - cycle.soc), times)
        self.results.append(result)
        return result

    def compare(self, cycle: Cycle) -> Iterator[Result]:
        """All estimators, as they are meant."""
        simple = constant_gain(DT)
        yield self.alone("constant gain", simple, cycle)
        yield self.mhe("MHE on it, i=1", 1, cycle, observer=simple)
        yield self.mhe("MHE on it, i=2", 2, cycle, observer=simple)
        yield self.alone("EKF", kalman(self.cell, PRIOR), cycle)
        for name, max_qps in (("i=0", 0), ("i=1", 1), ("i=2", 2), ("converged", None)):
            yield self.mhe(f"MHE, {name}", max_qps, cycle)

    def tuned(self, cycle: Cycle) -> Iterator[Result]:
        """The filter under other covariances: what tuning it on the cycle would give."""
        for noisier in (0.1, 1.0, 10.0):
            for livelier in (0.1, 1.0, 10.0):
                observer = kalman(self.cell, PRIOR, noisier, livelier)
                name = f"EKF, noise x {noisier:g}, disturbance x {livelier:g}"
                yield self.alone(name, observer, cycle, "tuned on the cycle")

    def stress(self, cycle: Cycle) -> Iterator[Result]:
        """The filter and the estimator with outliers and with wrong prior covariances."""
        conditions = {name: (cycle, prior) for name, prior in PRIORS.items()}
        for k, name in enumerate(("2 % off by 0.5 V", "2 % read 0 V")):
            conditions[name] = cycle._replace(voltage=spoil(cycle.voltage, k)), PRIOR
        for condition, (record, prior) in conditions.items():
            yield self.alone("EKF", kalman(self.cell, prior), record, condition)
            yield self.mhe("MHE, i=0", 0, record, condition, prior=prior)
            yield self.mhe("MHE, i=1", 1, record, condition, prior=prior)

    def starts(self, cycle: Cycle) -> Iterator[Result]:
        """Several initial estimates, with outliers as well."""
        spoilt = cycle._replace(voltage=spoil(cycle.voltage, 1))
        for condition, record in (("start", cycle), ("start, 2 % read 0 V", spoilt)):
            for soc in STARTS:
                yield self.alone("EKF", kalman(self.cell, PRIOR), record, condition, soc)
                yield self.mhe("MHE, i=1", 1, record, condition, soc)


def start_at(soc: float) -> Array:
    return np.concatenate([[soc], START[1:]])


def spoil(voltage: Array, kind: int) -> Array:
    """Gross errors: off by 0.5 V to either side, or a reading of 0 V."""
    rng = np.random.default_rng([20210829, kind])
    hit = rng.random(voltage.shape) < OUTLIERS
    off = voltage + rng.choice([-0.5, 0.5], voltage.shape) if kind == 0 else 0.0
    return np.where(hit, off, voltage)


def main() -> int:
    parser = argparse.ArgumentParser(description="Estimate the state of charge of a real cell.")
    parser.add_argument("--data", type=Path, required=True, help="folder of the .mat files")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    parser.add_argument("--cycles", nargs="+", help="names, such as udds; all if left out")
    parser.add_argument("--start", type=float, default=0.6, help="initial SOC of the comparison")
    parser.add_argument("--quick", action="store_true", help="the first 15 minutes of each cycle")
    arguments, console = parser.parse_args(), Console()
    if not 0.0 <= arguments.start <= 1.0:
        parser.error(f"--start is {arguments.start:g}; expected a state of charge from 0 to 1")
    cell = Cell.read()
    try:
        files = drive_cycles(arguments.data)
        wanted = [name.upper() for name in arguments.cycles or files]
        unknown = [name for name in wanted if name not in files]
        if unknown:
            known = ", ".join(files)
            raise DataError(f"no cycle {unknown[0]} in {arguments.data}; there are {known}.")
        length = QUICK if arguments.quick else None
        cycles = [read(cell, files[name], length) for name in wanted]
        arguments.out.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    bench, began = Bench(cell, arguments.start), perf_counter()
    with Progress(console=console, transient=True) as progress:
        for cycle in cycles:
            task = progress.add_task(cycle.name, total=None)
            parts = [bench.compare, bench.stress]
            if not arguments.quick:
                parts += [bench.tuned, bench.starts]
            for part in parts:
                for result in part(cycle):
                    progress.update(task, description=f"{cycle.name}: {result.estimator}")
    rows = [result.figures() for result in bench.results]
    console.print(table(rows), stress_table(rows))
    if not arguments.quick:
        for condition in ("start", "start, 2 % read 0 V"):
            console.print(starts_table(rows, condition))
    for cycle in cycles:
        console.print(f"{cycle.name}: {DT * len(cycle.voltage):.0f} s, down to SOC "
                      f"{cycle.soc[-1]:.2f}, at most {cycle.warmest:.1f} degC")
    seconds = perf_counter() - began
    found = {
        "data": {"doi": DOI, "cycles": wanted}, "dt_s": DT, "settling_s": SETTLING,
        "quick": arguments.quick, "seconds": round(seconds, 1), "results": rows,
    }
    (arguments.out / "battery_soc.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(cycles, bench.results, DT).savefig(arguments.out / "battery_soc.png", dpi=150)
    console.print(f"{seconds:.0f} s; {arguments.out / 'battery_soc.json'} and .png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
