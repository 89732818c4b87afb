"""Time of one update on the paper's example: qpmhe beside CasADi with Ipopt, in one run.

Both estimate the same records, in turn, so that a change of the machine's speed meets both.
Ipopt's program is built once for each window length and started at the candidate. The ratio
counts; the microseconds are those of this machine.
"""

import argparse
import platform
from importlib.metadata import version

import numpy as np
from rich.console import Console
from rich.table import Table

import qpmhe
from qpmhe.studies import IpoptComparison, PaperStudy

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=150, help="samples of each record")
parser.add_argument("--seeds", type=int, default=3, help="number of records")
arguments = parser.parse_args()

ours: dict[int, list[float]] = {0: [], 1: [], 2: []}
theirs: list[float] = []
excess: dict[int, list[float]] = {i: [] for i in ours}
for seed in range(arguments.seeds):
    study = PaperStudy(seed, arguments.steps)
    system, observer, cost, scenario = study.model
    settled = slice(2 * scenario.horizon, None)  # programs are built in the first steps
    reference = IpoptComparison(study).run(None)
    theirs += list(reference.times[settled])
    for i in ours:
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=scenario.horizon,
            initial_state=scenario.initial_estimate, backend="banded", max_qps=i,
        )
        run = mhe.run(study.record().measurements)
        ours[i] += list(run.times[settled])
        excess[i] += list(run.costs[settled] / reference.costs[settled] - 1.0)

base = float(np.median(theirs))
table = Table(title="One update, batch reactor n = 2, N = 10", title_justify="left")
for name in ("estimator", "median us", "J above Ipopt's\n(median)", "times faster\nthan Ipopt"):
    table.add_column(name, justify="left" if name == "estimator" else "right", no_wrap=True)
table.add_row("CasADi + Ipopt converged", f"{base * 1e6:.0f}", "", "1")
for i, times in ours.items():
    median = float(np.median(times))
    table.add_row(
        f"qpmhe, banded, i = {i}", f"{median * 1e6:.0f}", f"{np.median(excess[i]):.1e}",
        f"{base / median:.1f}",
    )
console = Console()
console.print(table)
console.print(
    f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}, "
    f"casadi {version('casadi')},\nqpmhe {qpmhe.__version__}; {len(theirs)} updates each. "
    "Ipopt: state trajectory as variables, tol 1e-8, exact Hessians, CasADi's virtual\n"
    "machine. qpmhe: plain NumPy model.",
    highlight=False,
)
