"""The paper's figure from Python: the batch reactor with i = 0, 2, 5 QPs and converged."""

import argparse
from pathlib import Path

import numpy as np

import qpmhe
from qpmhe.plots import save, trajectories

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--seed", type=int, default=0, help="seed of the noise")
parser.add_argument("--out", type=Path, default=Path("results"), help="folder for the figure")
arguments = parser.parse_args()

system, observer, cost, scenario = qpmhe.models.batch_reactor()
states, measurements = scenario.simulate(arguments.seed)
estimates = {}
for label, iterations in {"i = 0": 0, "i = 2": 2, "i = 5": 5, "converged": None}.items():
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=10, initial_state=scenario.initial_estimate,
        max_qps=iterations,
    )
    run = mhe.run(measurements)
    estimates[label] = run.states
    rmse = np.sqrt(np.mean(np.sum((run.states - states) ** 2, axis=1)))
    print(f"{label:>9}: RMSE {rmse:.3f}, {run.share(qpmhe.Status.IMPROVED):.0%} of steps improved")

times = scenario.dt * np.arange(len(states))
axes = trajectories(times, states, estimates, scenario.labels, "time t (s)")
for path in save(axes[0].figure, arguments.out / "paper_figure"):
    print("wrote", path)
