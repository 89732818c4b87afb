"""The batch reactor with gross outliers: a quadratic cost against Huber's loss of the noise.

About one measurement in twenty is off by 8, more than the output itself. Both
costs have the same weights, start, horizon and number of QPs; they differ in the noise's loss.
All errors of the first seconds come from the wrong start, with and without outliers, so the script
reports the settled errors beside those of all times.

The outliers also hit the auxiliary observer, whose state z(t-N) is the prior. So the script tries
a second observer, which applies a fitting error v up to 1 in full and a fifth of the rest:
L(z, v) = K phi(v), with v^2 / 5 <= v phi(v) <= v^2. It is an output injection with
L(z, 0) = 0, and |L(z, v)| <= |K| |v|, so it keeps the bound (eq:kappa) of the constant gain.
A plain clip of v would keep that, too. But the reactor has a mode that does not decay by itself,
and a clipped correction brings a large error of it back at constant speed: not exponentially.
Neither observer is proved here to be globally exponentially stable.
"""

import argparse
from pathlib import Path

import numpy as np

import qpmhe
from qpmhe.plots import save, trajectories
from qpmhe.plots.style import MEASURED

SHARE, SIZE = 0.05, 8.0
SETTLED = 3.0  # s

reactor = qpmhe.models.batch_reactor()
scenario = reactor.scenario
gain = reactor.observer.gain
weights = {"prior": reactor.cost.prior, "disturbance": reactor.cost.disturbance}
observers = {
    "constant gain": reactor.observer,
    "saturating": qpmhe.OutputInjection(
        lambda _, v: gain @ (0.2 * v + 0.8 * np.clip(v, -1.0, 1.0))
    ),
}
costs = {
    "quadratic": reactor.cost,
    "Huber": qpmhe.RobustCost(**weights, noise=qpmhe.Huber(reactor.cost.noise, threshold=1.345)),
}


def simulate(seed):
    """States, measurements without and with outliers, and where those are."""
    states, clean = scenario.simulate(seed)
    rng = np.random.default_rng([seed, 1])
    hit = rng.random(clean.shape) < SHARE
    return states, clean, clean + hit * rng.choice([-SIZE, SIZE], clean.shape), hit


def estimate(measurements, cost, observer, max_qps):
    mhe = qpmhe.MovingHorizonEstimator(
        reactor.system, observer, cost, horizon=scenario.horizon,
        initial_state=scenario.initial_estimate, max_qps=max_qps,
    )
    return mhe.run(measurements).states


def rmse(errors):
    """Root mean square over seeds and times, of all times and of the settled ones."""
    squares = np.sum(np.square(errors), axis=-1)
    return np.sqrt([squares.mean(), squares[:, round(SETTLED / scenario.dt) :].mean()])


def figure_of(states, measurements, hit, estimates):
    """States and estimates, and below them the output with its measurements."""
    times = scenario.dt * np.arange(len(states))
    axes = trajectories(
        times, with_output(states), {name: with_output(x) for name, x in estimates.items()},
        (*scenario.labels, "y (crosses: outliers)"), "time t (s)",
    )
    figure, panel = axes[0].figure, axes[-1]
    # The last state has no measurement.
    panel.plot(times[:-1], measurements, zorder=1, **MEASURED)
    at = hit[:, 0]
    panel.plot(times[:-1][at], measurements[at], "x", color=MEASURED["color"], markersize=5)
    return figure


def with_output(states):
    return np.column_stack((states, states.sum(axis=1)))


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--seeds", type=int, default=10, help="number of simulated records")
parser.add_argument("--qps", type=int, default=5, help="QPs per sample")
parser.add_argument("--out", type=Path, default=Path("results"), help="folder for the figure")
arguments = parser.parse_args()

records = [simulate(seed) for seed in range(arguments.seeds)]
truth = np.array([states for states, *_ in records])


def report(name, observer, cost, max_qps, clean=False):
    runs = [
        estimate(record[1 if clean else 2], costs[cost], observers[observer], max_qps)
        for record in records
    ]
    errors = rmse(np.array(runs) - truth)
    print(f"{name:<28}{observer:<16}{errors[0]:9.3f}{errors[1]:12.3f}")
    return errors, runs[0]


print(f"RMSE of the state over {arguments.seeds} records, {arguments.qps} QPs per sample")
print(f"{'':<28}{'observer':<16}{'all t':>9}{f't >= {SETTLED:g} s':>12}")
for observer in observers:
    report("observer alone", observer, "quadratic", 0)
quadratic, left = report("MHE, quadratic", "constant gain", "quadratic", arguments.qps)
report("MHE, quadratic", "saturating", "quadratic", arguments.qps)
huber, right = report("MHE, Huber", "constant gain", "Huber", arguments.qps)
report("MHE, Huber", "saturating", "Huber", arguments.qps)
clean, _ = report(
    "MHE, quadratic, no outliers", "constant gain", "quadratic", arguments.qps, clean=True
)
print("Relative to the quadratic cost with the constant gain:")
print(f"{'MHE, Huber':<44}{huber[0] / quadratic[0]:9.2f}{huber[1] / quadratic[1]:12.2f}")
print(f"{'no outliers':<44}{clean[0] / quadratic[0]:9.2f}{clean[1] / quadratic[1]:12.2f}")

states, _, measurements, hit = records[0]
figure = figure_of(states, measurements, hit, {"quadratic": left, "Huber": right})
for path in save(figure, arguments.out / "outliers"):
    print("wrote", path)
