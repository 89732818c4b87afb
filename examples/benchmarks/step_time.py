"""Time of one update on the paper's example: qpmhe beside CasADi with Ipopt, in one run.

Both estimate the same records and are timed in turn, sample by sample, so that a change of
the machine's speed meets both. Ipopt's program is built once for each window length and
started at the candidate. The ratio counts; the microseconds are those of this machine.
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
    ipopt = IpoptComparison(study).estimator(None)
    estimators = {
        i: qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=scenario.horizon,
            initial_state=scenario.initial_estimate, backend="banded", max_qps=i,
        )
        for i in ours
    }
    for t, y in enumerate(study.record().measurements):
        reference = ipopt.update(y)
        for i, mhe in estimators.items():
            estimate = mhe.update(y)
            if t >= 2 * scenario.horizon:  # programs are built in the first steps
                ours[i].append(estimate.step_time)
                excess[i].append(estimate.cost / reference.cost - 1)
        if t >= 2 * scenario.horizon:
            theirs.append(reference.step_time)

base = float(np.median(theirs))
table = Table(title="One update, batch reactor n = 2, N = 10", title_justify="left")
for name in ("estimator", "median us", "J above Ipopt's (median)", "times faster than Ipopt"):
    table.add_column(name, justify="left" if name == "estimator" else "right")
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
    f"casadi {version('casadi')}, qpmhe {qpmhe.__version__}; {len(theirs)} updates each.\n"
    "Ipopt solves multiple shooting (states and disturbances) with tol 1e-8 and exact Hessians,\n"
    "model functions evaluated by CasADi's virtual machine; plain NumPy model on our side.",
    highlight=False,
)
