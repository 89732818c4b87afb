"""State of charge of a real lithium-ion cell, estimated from its measured current and voltage.

Run ``python examples/battery_soc.py --data DIR``, where DIR holds ``c20_25degC.mat``,
``udds_25degC.mat`` and ``hwfet_25degC.mat`` of P. Kollmeyer and M. Skells, *Samsung INR21700
30T 3Ah Li-ion Battery Data*, McMaster University, Mendeley Data, doi 10.17632/9xyvy2njj3.

The model is an equivalent circuit in steps of 1 s, with states x = (SOC, v1, v2), the current
I < 0 on discharge as its input and the terminal voltage as its output:

    SOC+ = SOC + I dt / (3600 Q),    v_j+ = a_j v_j + R_j (1 - a_j) I,    a_j = exp(-dt / tau_j),
    y = OCV(SOC) + v1 + v2 + R0 I.

Every estimator starts at SOC 0.6, while the cell is full. Two observers are tried, and moving
horizon estimation (MHE) on each with i = 0, 1 and 2 QPs per sample:

- a constant gain K = (k, 0, 0). A - K C is triangular with eigenvalues 1 - k OCV'(SOC), a_1 and
  a_2, and OCV' lies between 0 and 2 / k: it converges from everywhere, but slowly;
- the extended Kalman filter, which is faster but comes without such a proof. MHE takes its
  covariance to weigh the prior.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d

import qpmhe

Array = NDArray[np.float64]

C20, CYCLES = "c20_25degC.mat", {"UDDS": "udds_25degC.mat", "HWFET": "hwfet_25degC.mat"}
SOURCE = "get the data at https://doi.org/10.17632/9xyvy2njj3"

CAPACITY = 3.036  # Ah, of the C/20 discharge
R0, R1, R2 = 6.5e-3, 7.3e-3, 15e-3  # Ohm; with the time constants, from a fit on UDDS
DECAY = np.exp(-1.0 / np.array([np.inf, 3.1, 400.0]))  # of SOC, v1, v2 in 1 s
PER_AMPERE = np.array([1 / (3600 * CAPACITY), R1 * (1 - DECAY[1]), R2 * (1 - DECAY[2])])

START = np.array([0.6, 0.0, 0.0])
SETTLING = 300  # s, left out of the errors
HORIZON = 120  # s
HEADINGS = "cycle", "observer", "estimate", "RMSE %", "worst %", "settled s", "step us", "QP us"

# The circuit is wrong by some 15 mV, for about a minute at a time. White noise that tells as
# little about the state has the same spectral density at low frequencies, hence the factor.
NOISE = np.diag([0.015 * np.sqrt(2 * 50.0)]) ** 2
# The tester's current is good to 75 mA, which is 2.5 % of the charge in an hour: 0.04 % per root
# second. R1 and R2 are good to 20 %, which is 7 mV in v1 and 10 mV in v2 at these currents.
DISTURBANCE = np.diag([0.025 / 60, 0.007 * np.sqrt(2 / 3.1), 0.010 * np.sqrt(2 / 400.0)]) ** 2
# Any SOC between 0 and 1 has a standard deviation of 0.3; the voltages are good to 10 mV.
PRIOR = np.diag([0.3, 0.010, 0.010]) ** 2
# OCV rises by about 1 V from empty to full: a time constant of 200 s, a few of the model error's.
GAIN = np.array([1 / 200.0, 0.0, 0.0])


class DataError(Exception):
    """Measured data that are not there or not what they should be."""


class OpenCircuitVoltage:
    """OCV(SOC) with a continuous, positive slope; straight lines go on beyond 0 and 1.

    The slope is interpolated linearly between the knots, and the voltage is its integral, so
    that the one is exactly the derivative of the other.
    """

    def __init__(self, voltage: Array) -> None:
        self.steps = voltage.size - 1
        self.knots = np.linspace(0.0, 1.0, voltage.size)
        self.slopes = np.maximum(np.gradient(voltage, self.knots), 0.05)
        self.values = integral(self.knots, self.slopes)
        self.values += np.mean(voltage - self.values)

    def __call__(self, soc: Array) -> Array:
        """The voltage in V, of the shape of soc."""
        below = np.clip((soc * self.steps).astype(np.intp), 0, self.steps)
        slope = 0.5 * (self.slopes[below] + self.slope(soc))
        return self.values[below] + slope * (soc - self.knots[below])

    def slope(self, soc: Array) -> Array:
        """The derivative in V."""
        return np.interp(soc, self.knots, self.slopes)


class Result(NamedTuple):
    """One estimator on one cycle: the error of x(0), ..., x(T) in % SOC, and seconds a step."""

    observer: str
    name: str
    error: Array
    times: Array
    solve_times: Array


def integral(x: Array, y: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(x))])


def load(folder: Path, name: str) -> tuple[Array, Array, Array, Array]:
    """Time (s), voltage (V), current (A) and counted charge (Ah), repeated times left out."""
    path = folder / name
    if not path.is_file():
        raise DataError(f"{path} is not there; {SOURCE}.")
    try:
        meas = loadmat(path, squeeze_me=True)["meas"][()]
        data = np.array([meas[key] for key in ("Time", "Voltage", "Current", "Ah")], dtype=float)
    except Exception as error:  # whatever the reader makes of a file that is something else
        raise DataError(f"{path} cannot be read ({error}); {SOURCE}.") from error
    # The tester logs an instant twice where it goes on to the next step of its programme.
    new = np.concatenate([[True], np.diff(np.maximum.accumulate(data[0])) > 0])
    time, voltage, current, charge = data[:, new]
    found, counted = integral(time, current)[-1] / 3600, charge[-1] - charge[0]
    if not abs(found - counted) < 0.01 * np.ptp(charge):  # NaN is no agreement either
        raise DataError(f"{path}: {found:.3f} Ah by current, {counted:.3f} by counter; {SOURCE}.")
    return time - time[0], voltage, current, charge


def load_cycle(folder: Path, name: str) -> tuple[Array, Array, Array]:
    """Voltage (T, 1) and current (T, 1) of each second, and the true SOC at their T + 1 ends.

    Both are means: charge is kept, and the voltage goes with the current it was under.
    """
    time, voltage, current, charge = load(folder, name)
    grid = np.arange(int(time[-1]) + 1.0)
    y, u = (np.diff(np.interp(grid, time, integral(time, x))) for x in (voltage, current))
    return y[:, None], u[:, None], 1.0 + np.interp(grid, time, charge - charge[0]) / CAPACITY


def load_ocv(folder: Path) -> OpenCircuitVoltage:
    """The mean of discharge and charge at C/20, each over its own charge.

    The counter finds 3 % more on charge. Were that true, charging would take less voltage than
    discharging gives, above SOC 0.75; and the cell rests at the 4.186 V of any full charge.
    """
    _, voltage, current, charge = load(folder, C20)
    branches = []
    for branch in (current < -0.01, current > 0.01):
        order = np.argsort(charge[branch], kind="stable")
        soc = (charge[branch][order] - charge[branch].min()) / np.ptp(charge[branch])
        branches.append(np.interp(np.linspace(0, 1, 1001), soc, voltage[branch][order]))
    # Smoothed over 0.5 % SOC, a few of the file's samples, for a slope without their noise;
    # the odd continuation keeps the slopes at both ends.
    mean = np.pad(np.mean(branches, axis=0), 50, mode="reflect", reflect_type="odd")
    return OpenCircuitVoltage(gaussian_filter1d(mean, 5.0)[50:-50])


def cell(ocv: OpenCircuitVoltage) -> qpmhe.System:
    """The equivalent circuit; its functions take x (..., 3) and u (..., 1)."""
    A = np.diag(DECAY)

    def h_jacobian(x: Array) -> Array:
        slopes = np.ones((*x.shape[:-1], 1, 3))
        slopes[..., 0, 0] = ocv.slope(x[..., 0])
        return slopes

    return qpmhe.System(
        lambda x, u: DECAY * x + PER_AMPERE * u,
        lambda x, u: ocv(x[..., :1]) + x[..., 1:2] + x[..., 2:] + R0 * u,
        n=3, p=1, m=1,
        f_jacobian=lambda x: np.broadcast_to(A, (*x.shape, 3)), h_jacobian=h_jacobian,
        states=qpmhe.Box([0.0, -np.inf, -np.inf], [1.0, np.inf, np.inf]),
    )


def observe(system: qpmhe.System, observer: qpmhe.Observer, ys: Array, us: Array) -> Array:
    """The observer on its own, z+ = f(z, u) + L(z, y - h(z, u)), without an estimator."""
    states, covariance = [START], observer.initial_covariance()
    for y, u in zip(ys, us, strict=True):
        z = states[-1]
        sample = qpmhe.Sample(
            system, u, system.f_jacobian(z, u), system.h_jacobian(z, u), covariance=covariance
        )
        correction, covariance = observer.correct(z, y - system.h(z, u), sample)
        states.append(system.f(z, u) + correction)
    return np.array(states)


def study(
    system: qpmhe.System, ys: Array, us: Array, soc: Array, advance: Callable[[int], None]
) -> Iterator[Result]:
    """Both observers, each alone and under MHE with i = 0, 1, 2."""
    kalman = qpmhe.ExtendedKalman(prior=PRIOR, disturbance=DISTURBANCE, noise=NOISE)
    for name, observer, prior in (
        ("constant gain", qpmhe.Luenberger(GAIN), PRIOR),
        ("Kalman filter", kalman, qpmhe.ObserverPrior()),
    ):
        cost = qpmhe.QuadraticCost.from_covariances(
            prior=prior, disturbance=DISTURBANCE, noise=NOISE
        )
        z = observe(system, observer, ys, us)
        yield Result(name, "alone", 100 * (z[:, 0] - soc), np.empty(0), np.empty(0))
        for i in (0, 1, 2):
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=HORIZON, initial_state=START, max_qps=i
            )
            x, times, solve_times = [START[None]], [], []
            for k in range(0, len(ys), 100):  # a run goes on where the last one ended
                run = mhe.run(ys[k : k + 100], us[k : k + 100])
                x.append(run.states[1:])
                times.append(run.times)
                solve_times.append(run.solve_times)
                advance(len(run))
            yield Result(name, f"MHE, i={i}", 100 * (np.concatenate(x)[:, 0] - soc),
                         np.concatenate(times), np.concatenate(solve_times))


def tabulate(results: dict[str, list[Result]]) -> Table:
    table = Table(
        title=f"State of charge after {SETTLING} s, horizon {HORIZON} s",
        caption="settled: below 5 % for a minute; QP: the solver's part of a step",
        box=box.SIMPLE, collapse_padding=True, pad_edge=False,
    )
    for k, heading in enumerate(HEADINGS):
        table.add_column(heading, justify="right" if k > 2 else "left")
    for cycle, runs in results.items():
        for k, run in enumerate(runs):
            late = run.error[SETTLING:]
            minutes = np.convolve(np.abs(run.error) < 5.0, np.ones(60), "valid")
            spent = (f"{1e6 * t.mean():.0f}" if t.size else "" for t in run[-2:])
            table.add_row(
                cycle, run.observer, run.name, f"{np.sqrt(np.mean(late**2)):.2f}",
                f"{np.abs(late).max():.1f}", f"{np.argmax(minutes > 59.5)}", *spent,
                end_section=k % 4 == 3,
            )
    return table


def draw(results: dict[str, list[Result]], truth: dict[str, Array]) -> Figure:
    """The SOC and its error over time, a column for each cycle, in Okabe and Ito's colours."""
    mpl.rcParams.update({
        "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
        "axes.edgecolor": "#AAAAAA", "xtick.color": "#AAAAAA", "ytick.color": "#AAAAAA",
        "xtick.labelcolor": "#333333", "ytick.labelcolor": "#333333", "grid.color": "#EBEBEB",
    })
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(2, len(results), sharex="col", sharey="row")
    for (cycle, runs), (top, bottom) in zip(results.items(), axes.T, strict=True):
        minutes = np.arange(truth[cycle].size) / 60.0
        top.plot(minutes, 100 * truth[cycle], color="#000000", lw=2.0, label="truth")
        for run, ink in ((runs[0], "#E69F00"), (runs[3], "#0072B2"), (runs[7], "#009E73")):
            label = f"{run.observer}, {run.name}"
            top.plot(minutes, 100 * truth[cycle] + run.error, color=ink, lw=1.0, label=label)
            bottom.plot(minutes, run.error, color=ink, lw=1.0)
        top.set_title(cycle)
        bottom.axhspan(-2.5, 2.5, color="#F3F3F3", lw=0, zorder=0)
        bottom.set(xlabel="time (min)", ylim=(-12, 12), xlim=(0, minutes[-1]))
    axes[0, 0].set(ylabel="state of charge (%)", ylim=(0, 103))
    axes[1, 0].set_ylabel("error of state of charge (%)")
    axes[1, 0].text(0.99, 2.7, "within 2.5 %", color="#777777", ha="right",
                    transform=axes[1, 0].get_yaxis_transform())
    entries = axes[0, 0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside upper center", ncols=4, frameon=False)
    return figure


def main() -> int:
    parser = argparse.ArgumentParser(description="Estimate the state of charge of a real cell.")
    parser.add_argument("--data", type=Path, required=True, help="folder of the .mat files")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the figure")
    arguments, console = parser.parse_args(), Console()
    try:
        system = cell(load_ocv(arguments.data))
        records = {cycle: load_cycle(arguments.data, name) for cycle, name in CYCLES.items()}
        arguments.out.mkdir(parents=True, exist_ok=True)
    except (DataError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    results = {}
    with Progress(console=console) as progress:
        for cycle, record in records.items():
            task = progress.add_task(cycle, total=6 * len(record[0]))
            results[cycle] = list(study(system, *record, partial(progress.advance, task)))
    console.print(tabulate(results))
    runs = [run for each in results.values() for run in each]
    gap = max(np.abs(runs[k].error - runs[k + 1].error).max() for k in range(0, len(runs), 4))
    console.print(f"MHE with i = 0 and the observer alone differ by at most {gap:g} %.")
    times, solving = (np.concatenate([run[which] for run in runs]) for which in (3, 4))
    console.print(f"{times.size} MHE steps at {times.size / times.sum():.0f} a second, "
                  f"{solving.sum() / times.sum():.0%} of the time in the QP solver.")
    figure = draw(results, {cycle: record[2] for cycle, record in records.items()})
    for kind in ("png", "svg"):
        figure.savefig(arguments.out / f"battery_soc.{kind}", dpi=160)
    console.print(f"Figure: {arguments.out / 'battery_soc.png'} and .svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
