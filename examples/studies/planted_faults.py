"""Plant faults in records of the zoo, and count how often `qpmhe.diagnose` names them first.

    python examples/studies/planted_faults.py --seeds 20

prints a table, in Markdown, of faults and of healthy runs.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import qpmhe

OUTLIERS, SIZE = 0.03, 15.0  # share, and deviations of the noise


class Case(NamedTuple):
    """An estimator's parts and a record, with a fault or without.

    Parameters
    ----------
    system, observer, cost
        As the user believes them to be.
    settings : dict
        Options of the estimator.
    measurements, inputs : array
        The record.
    labels : sequence of str
        Names of the states.
    """

    system: Any
    observer: Any
    cost: Any
    settings: dict[str, Any]
    measurements: np.ndarray
    inputs: np.ndarray | None
    labels: tuple[str, ...]

    def run(self, engine: str = "auto") -> qpmhe.Run:
        """Estimate the record."""
        mhe = qpmhe.MovingHorizonEstimator(
            self.system, self.observer, self.cost, engine=engine, **self.settings
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", qpmhe.ObserverWarning)  # a fault may drive it away
            return mhe.run(self.measurements, self.inputs)


def healthy(model: str, seed: int) -> Case:
    """A record of a model of the zoo, as its scenario says."""
    system, observer, cost, scenario = qpmhe.models.catalogue()[model]()
    record = scenario.simulate(seed)
    settings = {"horizon": scenario.horizon, "initial_state": scenario.initial_estimate}
    return Case(
        system, observer, cost, settings, record.measurements, record.inputs, scenario.labels
    )


def weighted(model: str, seed: int, disturbance: float = 1.0, noise: float = 1.0) -> Case:
    """Weights of the cost that are too large by these factors: covariances too small."""
    case = healthy(model, seed)
    cost = qpmhe.QuadraticCost(
        prior=case.cost.prior, disturbance=disturbance * case.cost.disturbance,
        noise=noise * case.cost.noise,
    )
    return case._replace(cost=cost)


def measured(model: str, seed: int, change: Callable[..., None]) -> Case:
    """Measurements that a function changes: of the array, deviations, a generator, a sensor."""
    case = healthy(model, seed)
    y = case.measurements.copy()
    deviations = np.sqrt(np.linalg.inv(case.cost.noise).diagonal())
    change(y, deviations, np.random.default_rng(seed), seed % y.shape[1])
    return case._replace(measurements=y)


def biased(y: np.ndarray, deviations: np.ndarray, _: Any, sensor: int) -> None:
    """Four deviations of the noise, from a third of the record on."""
    y[len(y) // 3 :, sensor] += 4.0 * deviations[sensor]


def dead(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """Half of the record repeats a number."""
    y[len(y) // 2 :, sensor] = y[len(y) // 2, sensor]


def swapped(y: np.ndarray, *_: Any) -> None:
    """The first two sensors."""
    y[:, :2] = y[:, 1::-1]


def late(y: np.ndarray, *_: Any) -> None:
    """By one sample."""
    y[1:] = y[:-1].copy()


def outlying(y: np.ndarray, deviations: np.ndarray, generator: Any, _: int) -> None:
    """Some of the measurements."""
    hit = generator.random(y.shape) < OUTLIERS
    y[hit] += (SIZE * deviations * generator.standard_normal(y.shape))[hit]


def saturated(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """A quarter of the record is above what the sensor can measure."""
    y[:, sensor] = np.minimum(y[:, sensor], np.quantile(y[:, sensor], 0.75))


def in_thousandths(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """The numbers of a sensor are a thousand times as large, as in millimetres."""
    y[:, sensor] *= 1000.0


def scaled_input(model: str, seed: int, factor: float) -> Case:
    """One of the inputs, in another unit or with the wrong sign."""
    case = healthy(model, seed)
    assert case.inputs is not None
    inputs = case.inputs.copy()
    inputs[:, seed % inputs.shape[1]] *= factor
    return case._replace(inputs=inputs)


def timed(model: str, seed: int, step: float = 1.0, drift: float = 0.0) -> Case:
    """True steps longer than the model's, or samples of y at the times t (1 + drift)."""
    case = healthy(model, seed)
    scenario = qpmhe.models.catalogue()[model]().scenario
    system, total = scenario.system, scenario.steps
    generator, length = np.random.default_rng(seed), step * scenario.dt
    spread_w = np.sqrt(scenario.disturbance_covariance.diagonal())
    spread_v = np.sqrt(scenario.noise_covariance.diagonal())

    def move(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        return system.timed.f(x, np.append(u, dt)) if dt else x

    x, y, inputs = scenario.initial_state, [], []
    for t in range(int(total * (1.0 + drift)) + 1):
        u = np.zeros(0) if scenario.inputs is None else scenario.inputs(t, x)
        inputs.append(u)
        while len(y) < total and len(y) * (1.0 + drift) < t + 1:
            at = move(x, u, (len(y) * (1.0 + drift) - t) * length)
            y.append(system.h(at, u) + spread_v * generator.standard_normal(system.p))
        x = move(x, u, length) + spread_w * generator.standard_normal(system.n)
        if system.states is not None:
            x = np.clip(x, system.states.lower, system.states.upper)
    return case._replace(
        measurements=np.array(y), inputs=np.array(inputs)[:total] if system.m else None
    )


def unseen(_: str, seed: int) -> Case:
    """A damped oscillator that estimates the gain of an input, which is zero throughout."""
    generator, total = np.random.default_rng(seed), 300

    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        moved = [x[..., 0] + 0.1 * x[..., 1], x[..., 1] - 0.2 * x[..., 0] - 0.02 * x[..., 1]]
        return np.stack((moved[0], moved[1] + 0.1 * x[..., 2] * u[..., 0], x[..., 2]), axis=-1)

    system = qpmhe.System(f, lambda x: x[..., :1], n=3, p=1, m=1)
    prior, disturbance = np.diag([1.0, 1.0, 0.25]), np.diag([1e-4, 1e-3, 1e-6])
    x, inputs, y = np.array([1.0, 0.0, 1.5]), np.zeros((total, 1)), np.zeros((total, 1))
    for t in range(total):
        y[t] = x[0] + 0.05 * generator.standard_normal()
        x = f(x, inputs[t]) + np.sqrt(disturbance.diagonal()) * generator.standard_normal(3)
    noise = [[0.05**2]]
    cost = qpmhe.QuadraticCost.from_covariances(prior=prior, disturbance=disturbance, noise=noise)
    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=disturbance, noise=noise)
    settings = {"horizon": 20, "initial_state": [0.8, 0.0, 1.0]}
    return Case(system, observer, cost, settings, y, inputs, ("x1", "x2", "gain"))


#: By fault: what it is, its kind in a diagnosis, how it is planted, and in which models.
FAULTS: dict[str, tuple[str, Callable[[str, int], Case], tuple[str, ...]]] = {
    "R too small, by 8": (
        "noise", lambda model, seed: weighted(model, seed, noise=8.0),
        ("batch_reactor", "vehicle", "chain_of_masses")),
    "Q too small, by 50": (
        "disturbance", lambda model, seed: weighted(model, seed, disturbance=50.0),
        ("cstr", "vehicle", "quadrotor")),
    "biased sensor, 4 sigma": (
        "bias", lambda model, seed: measured(model, seed, biased),
        ("vehicle", "van_der_pol", "chain_of_masses")),
    "dead sensor, half of the time": (
        "dead", lambda model, seed: measured(model, seed, dead),
        ("batch_reactor", "vehicle", "quadrotor")),
    "swapped sensors": (
        "swapped", lambda model, seed: measured(model, seed, swapped),
        ("vehicle", "quadrotor", "chain_of_masses")),
    "steps 1.25 times as long": (
        "step", lambda model, seed: timed(model, seed, step=1.25),
        ("van_der_pol", "pendulum", "vehicle")),
    "wrong sign of an input": (
        "sign", lambda model, seed: scaled_input(model, seed, -1.0),
        ("battery_cell", "cstr", "vehicle")),
    "sensor in another unit, 1000 times": (
        "gain", lambda model, seed: measured(model, seed, in_thousandths),
        ("van_der_pol", "cstr", "battery_cell")),
    "input in another unit, a thousandth": (
        "input", lambda model, seed: scaled_input(model, seed, 1e-3),
        ("battery_cell", "cstr", "vehicle")),
    "one sample late": (
        "shift", lambda model, seed: measured(model, seed, late),
        ("battery_cell", "cstr", "vehicle")),
    "parameter that is not excited": ("unseen", unseen, ("oscillator",)),
    "outliers, 3 %": (
        "outliers", lambda model, seed: measured(model, seed, outlying),
        ("batch_reactor", "pendulum", "vehicle")),
    "clock that drifts, 3 %": (
        "clock", lambda model, seed: timed(model, seed, drift=0.03),
        ("vehicle", "battery_cell")),
    "saturated sensor, a quarter of the time": (
        "saturated", lambda model, seed: measured(model, seed, saturated),
        ("pendulum", "cstr", "vehicle")),
}


def first_kinds(plant: Callable[[str, int], Case], model: str, seeds: int) -> Counter[str]:
    """How often each kind is the first finding; a blank one where nothing was found."""
    counts: Counter[str] = Counter()
    for seed in range(seeds):
        found = qpmhe.diagnose(plant(model, seed).run()).findings
        counts[found[0].kind if found else ""] += 1
    return counts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    print("| fault | model | named first | named instead |\n| --- | --- | --- | --- |")
    for title, (kind, plant, models) in FAULTS.items():
        for model in models:
            _row(title, model, kind, first_kinds(plant, model, seeds), seeds)
    for model in qpmhe.models.catalogue():
        _row("none", model, "", first_kinds(healthy, model, seeds), seeds)


def _row(title: str, model: str, kind: str, counts: Counter[str], seeds: int) -> None:
    others = [f"{one or 'none'} {count}" for one, count in counts.most_common() if one != kind]
    print(f"| {title} | `{model}` | {counts[kind]} of {seeds} | {', '.join(others)} |", flush=True)


if __name__ == "__main__":
    main()
