"""Plant faults in simulated records, and judge what `qpmhe.diagnose` names first.

    python examples/studies/planted_faults.py --seeds 3 [--held-back] [--gaps] [--healthy 300]

prints a table, in Markdown, of faults and of healthy runs: how often the cause, or one that the
finding says cannot be told from it, was named first, and how often the filter with the record
corrected as the findings say was further from the true states than the one without.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from fault_systems import DEVELOPED, HELD_BACK, SYSTEMS

import qpmhe

OUTLIERS, SIZE = 0.03, 15.0  # share, and deviations of the noise
LEAST = 250  # samples of a record, at least
# A fault is hidden if the record without it is hardly more likely, as a logarithm.
HIDDEN = 20.0
HARM = 1.1  # of the filter's error with a finding's remedy to that without


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
    states : array
        The true ones at the measurements.
    """

    system: Any
    observer: Any
    cost: Any
    settings: dict[str, Any]
    measurements: np.ndarray
    inputs: np.ndarray | None
    labels: tuple[str, ...]
    states: np.ndarray

    def run(self, engine: str = "auto") -> qpmhe.Run:
        """Estimate the record."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", qpmhe.PriorWarning)
            warnings.simplefilter("ignore", qpmhe.ModelWarning)  # of a Q that is too small
            mhe = qpmhe.MovingHorizonEstimator(
                self.system, self.observer, self.cost, engine=engine, **self.settings
            )
            warnings.simplefilter("ignore", qpmhe.ObserverWarning)  # a fault may drive it away
            return mhe.run(self.measurements, self.inputs)

    @property
    def deviations(self) -> np.ndarray:
        """Of the noise, as the cost says."""
        return np.sqrt(np.linalg.inv(self.cost.noise).diagonal())


def healthy(model: str, seed: int) -> Case:
    """A record of a system, as its scenario says."""
    made, parameters = SYSTEMS[model]
    system, observer, cost, scenario = made()
    record = scenario.simulate(seed, max(LEAST, scenario.steps))
    settings = {"horizon": scenario.horizon, "initial_state": scenario.initial_estimate}
    inputs = record.inputs
    if parameters:
        settings["parameters"] = inputs[0, -parameters:]
        inputs = inputs[:, :-parameters]
    return Case(
        system, observer, cost, settings, record.measurements, inputs, scenario.labels,
        record.states[:-1],
    )


def weighted(model: str, seed: int, disturbance: float = 1.0, noise: float = 1.0) -> Case:
    """Weights of the cost that are too large by these factors: covariances too small."""
    case = healthy(model, seed)
    cost = qpmhe.QuadraticCost(
        prior=case.cost.prior, disturbance=disturbance * case.cost.disturbance,
        noise=noise * case.cost.noise,
    )
    return case._replace(cost=cost)


def one_noise(model: str, seed: int) -> Case:
    """The variance of one sensor's noise is a tenth of the true one."""
    case, factors = healthy(model, seed), np.ones(healthy(model, seed).measurements.shape[1])
    factors[seed % len(factors)] = np.sqrt(10.0)
    cost = qpmhe.QuadraticCost(
        prior=case.cost.prior, disturbance=case.cost.disturbance,
        noise=factors[:, None] * case.cost.noise * factors,
    )
    return case._replace(cost=cost)


def measured(model: str, seed: int, change: Callable[..., None]) -> Case:
    """Measurements that a function changes: of the array, deviations, a generator, a sensor."""
    case = healthy(model, seed)
    y = case.measurements.copy()
    sensors = 2 if model == "vehicle" else y.shape[1]  # the others are angles
    change(y, case.deviations, np.random.default_rng(seed), seed % sensors)
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


def outlying(y: np.ndarray, deviations: np.ndarray, generator: Any, _: int) -> None:
    """Some of the measurements."""
    hit = generator.random(y.shape) < OUTLIERS
    y[hit] += (SIZE * deviations * generator.standard_normal(y.shape))[hit]


def saturated(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """A quarter of the record is above what the sensor can measure."""
    y[:, sensor] = np.minimum(y[:, sensor], np.quantile(y[:, sensor], 0.75))


def biased_for_a_time(y: np.ndarray, deviations: np.ndarray, _: Any, sensor: int) -> None:
    """Five deviations of the noise, for a fifth of the record."""
    y[2 * len(y) // 5 : 3 * len(y) // 5, sensor] += 5.0 * deviations[sensor]


def drifting(y: np.ndarray, deviations: np.ndarray, _: Any, sensor: int) -> None:
    """From a third of the record on, to ten deviations of the noise at its end."""
    first = len(y) // 3
    y[first:, sensor] += 10.0 * deviations[sensor] * np.linspace(0.0, 1.0, len(y) - first)


def scaled(factor: float) -> Callable[..., None]:
    """A sensor with another gain."""
    def change(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
        y[:, sensor] *= factor

    return change


def rounded(y: np.ndarray, deviations: np.ndarray, _: Any, sensor: int) -> None:
    """To multiples of six deviations of the noise."""
    step = 6.0 * deviations[sensor]
    y[:, sensor] = step * np.round(y[:, sensor] / step)


def stuck(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """A tenth of the record repeats a number."""
    first = len(y) // 2
    y[first : first + len(y) // 10, sensor] = y[first, sensor]


def delayed(samples: int) -> Callable[..., None]:
    """All sensors late, or early if negative."""
    def change(y: np.ndarray, *_: Any) -> None:
        if samples > 0:
            y[samples:] = y[:-samples].copy()
        else:
            y[:samples] = y[-samples:].copy()
            y[samples:] = np.nan

    return change


def one_delayed(y: np.ndarray, _: Any, __: Any, sensor: int) -> None:
    """One sensor, by three samples."""
    y[3:, sensor] = y[:-3, sensor].copy()


def correlated(y: np.ndarray, deviations: np.ndarray, generator: Any, sensor: int) -> None:
    """Further noise of a sensor, of twice its deviation, that decays by a tenth a sample."""
    kept, value = 0.9, 0.0
    for t in range(len(y)):
        value = kept * value + np.sqrt(1.0 - kept**2) * generator.standard_normal()
        y[t, sensor] += 2.0 * deviations[sensor] * value


def noisier(y: np.ndarray, deviations: np.ndarray, generator: Any, sensor: int) -> None:
    """From half of the record on, four times the deviation."""
    half = len(y) // 2
    more = np.sqrt(15.0) * deviations[sensor]
    y[half:, sensor] += more * generator.standard_normal(len(y) - half)


def lagging(model: str, seed: int) -> Case:
    """A sensor that follows what it measures with a time constant of four samples."""
    case = healthy(model, seed)
    y, kept = case.measurements.copy(), np.exp(-0.25)
    sensor = seed % (2 if model == "vehicle" else y.shape[1])
    true = np.array([case.system.h(x, u) for x, u in zip(case.states, _full(case), strict=True)])
    shown = true[:, sensor].copy()
    for t in range(1, len(y)):
        shown[t] = kept * shown[t - 1] + (1.0 - kept) * true[t, sensor]
    y[:, sensor] += shown - true[:, sensor]
    return case._replace(measurements=y)


def _full(case: Case) -> np.ndarray:
    """The inputs with the parameters."""
    inputs = np.zeros((len(case.measurements), 0)) if case.inputs is None else case.inputs
    behind = np.tile(case.settings.get("parameters", []), (len(inputs), 1))
    return np.hstack((inputs, behind))


def _rows(case: Case, rows: np.ndarray) -> Case:
    return case._replace(
        measurements=case.measurements[rows], states=case.states[rows],
        inputs=None if case.inputs is None else case.inputs[rows],
    )


def dropped(model: str, seed: int) -> Case:
    """Five rows are missing in one place, and three in another."""
    case = healthy(model, seed)
    total = len(case.measurements)
    first, second = 2 * total // 5, 7 * total // 10
    gone = [*range(first, first + 5), *range(second, second + 3)]
    return _rows(case, np.delete(np.arange(total), gone))


def doubled(model: str, seed: int) -> Case:
    """One row in twenty is there twice."""
    case = healthy(model, seed)
    total = len(case.measurements)
    twice = np.random.default_rng(seed).choice(np.arange(20, total), total // 20, replace=False)
    return _rows(case, np.sort(np.append(np.arange(total), twice)))


def jittering(model: str, seed: int) -> Case:
    """Measured at times that are off by 0.4 steps (one deviation)."""
    case, generator = healthy(model, seed), np.random.default_rng(seed)
    f, h, u, length = case.system.timed.f, case.system.h, _full(case), case.system.dt
    y, x = case.measurements.copy(), case.states
    late = np.clip(0.4 * generator.standard_normal(len(y)), -0.9, 0.9)
    for t in range(1, len(y)):
        k, share = (t, late[t]) if late[t] >= 0.0 else (t - 1, 1.0 + late[t])
        if share > 0.0:
            moved = f(x[k], np.append(u[k], share * length))
            y[t] += h(moved, u[t]) - h(x[t], u[t])
    return case._replace(measurements=y)


def wrong_parameter(model: str, seed: int) -> Case:
    """A parameter of the model is a quarter too large."""
    case = healthy(model, seed)
    settings = {**case.settings, "parameters": 1.25 * case.settings["parameters"]}
    return case._replace(settings=settings)


def with_gaps(case: Case, seed: int) -> Case:
    """Without all measurements of two stretches, and one in twenty of the others."""
    y, generator = case.measurements.copy(), np.random.default_rng(1000 + seed)
    y[generator.random(y.shape) < 0.05] = np.nan
    for first in generator.integers(30, len(y) - 30, 2):
        y[first : first + 15] = np.nan
    return case._replace(measurements=y)


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
    scenario = SYSTEMS[model][0]().scenario
    system, total = scenario.system, len(case.measurements)
    generator, length = np.random.default_rng(seed), step * scenario.dt
    spread_w = np.sqrt(scenario.disturbance_covariance.diagonal())
    spread_v = np.sqrt(scenario.noise_covariance.diagonal())

    def move(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        return system.timed.f(x, np.append(u, dt)) if dt else x

    x, y, inputs, states = scenario.initial_state, [], [], []
    for t in range(int(total * (1.0 + drift)) + 1):
        u = np.zeros(0) if scenario.inputs is None else scenario.inputs(t, x)
        inputs.append(u)
        states.append(x)
        while len(y) < total and len(y) * (1.0 + drift) < t + 1:
            at = move(x, u, (len(y) * (1.0 + drift) - t) * length)
            y.append(system.h(at, u) + spread_v * generator.standard_normal(system.p))
        x = move(x, u, length) + spread_w * generator.standard_normal(system.n)
        if system.states is not None:
            x = np.clip(x, system.states.lower, system.states.upper)
    behind = SYSTEMS[model][1]
    return case._replace(
        measurements=np.array(y), states=np.array(states)[:total],
        inputs=np.array(inputs)[:total, : system.m - behind] if system.m else None,
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
    states = np.zeros((total, 3))
    for t in range(total):
        states[t] = x
        y[t] = x[0] + 0.05 * generator.standard_normal()
        x = f(x, inputs[t]) + np.sqrt(disturbance.diagonal()) * generator.standard_normal(3)
    noise = [[0.05**2]]
    cost = qpmhe.QuadraticCost.from_covariances(prior=prior, disturbance=disturbance, noise=noise)
    observer = qpmhe.ExtendedKalman(prior=prior, disturbance=disturbance, noise=noise)
    settings = {"horizon": 20, "initial_state": [0.8, 0.0, 1.0]}
    return Case(system, observer, cost, settings, y, inputs, ("x1", "x2", "gain"), states)


Plant = Callable[[str, int], Case]


def _measured(change: Callable[..., None]) -> Plant:
    return lambda model, seed: measured(model, seed, change)


_ANY = ("vehicle", "van_der_pol", "cstr", "battery_cell", "tanks", "motor", "rod", "predators")
_DRIVEN = ("vehicle", "cstr", "battery_cell", "tanks", "motor", "rod")
_SEVERAL = ("vehicle", "tanks", "motor", "rod", "predators")

#: By fault: what it is, its kind in a diagnosis, how it is planted, and in which systems; the
#: first of them are those of the tests.
FAULTS: dict[str, tuple[str, Plant, tuple[str, ...]]] = {
    "R too small, by 8": (
        "noise", lambda model, seed: weighted(model, seed, noise=8.0), _ANY),
    "R too large, by 8": (
        "noise", lambda model, seed: weighted(model, seed, noise=0.125), _ANY),
    "R of one sensor too small, by 10": ("noise", one_noise, _SEVERAL),
    "Q too small, by 50": (
        "disturbance", lambda model, seed: weighted(model, seed, disturbance=50.0), _ANY),
    "Q too large, by 50": (
        "disturbance", lambda model, seed: weighted(model, seed, disturbance=0.02), _ANY),
    "biased sensor, 4 sigma, from a third on": ("bias", _measured(biased), _ANY),
    "biased sensor, 5 sigma, for a fifth": ("bias", _measured(biased_for_a_time), _ANY),
    "sensor that drifts, to 10 sigma": ("ramp", _measured(drifting), _ANY),
    "gain of a sensor 1.05": ("gain", _measured(scaled(1.05)), _ANY),
    "gain of a sensor 0.9": ("gain", _measured(scaled(0.9)), _ANY),
    "sensor in another unit, 1000 times": ("gain", _measured(scaled(1000.0)), _ANY),
    "dead sensor, half of the time": ("dead", _measured(dead), _ANY),
    "stuck sensor, a tenth of the time": ("dead", _measured(stuck), _ANY),
    "saturated sensor, a quarter of the time": ("saturated", _measured(saturated), _ANY),
    "quantised sensor, 6 sigma": ("quantised", _measured(rounded), _ANY),
    "swapped sensors": ("swapped", _measured(swapped), _SEVERAL),
    "outliers, 3 %": ("outliers", _measured(outlying), _ANY),
    "noise of a sensor correlated, 0.9": ("coloured", _measured(correlated), _ANY),
    "noise of a sensor four times, from half on": ("change", _measured(noisier), _ANY),
    "sensor with a lag of 4 samples": ("lag", lagging, _ANY),
    "one sample late": ("shift", _measured(delayed(1)), _DRIVEN),
    "four samples late": ("shift", _measured(delayed(4)), _DRIVEN),
    "two samples early": ("shift", _measured(delayed(-2)), _DRIVEN),
    "one sensor three samples late": ("shift", _measured(one_delayed), _SEVERAL),
    "steps 1.25 times as long": (
        "step", lambda model, seed: timed(model, seed, step=1.25), _ANY),
    "steps 0.8 times as long": ("step", lambda model, seed: timed(model, seed, step=0.8), _ANY),
    "clock that drifts, 3 %": (
        "clock", lambda model, seed: timed(model, seed, drift=0.03), _DRIVEN),
    "times that scatter by 0.4 steps": ("jitter", jittering, _ANY),
    "rows missing, 5 and 3": ("dropped", dropped, _ANY),
    "rows there twice, 5 %": ("doubled", doubled, _ANY),
    "wrong sign of an input": (
        "sign", lambda model, seed: scaled_input(model, seed, -1.0), _DRIVEN),
    "gain of an input 1.2": (
        "input", lambda model, seed: scaled_input(model, seed, 1.0 / 1.2), _DRIVEN),
    "input in another unit, a thousandth": (
        "input", lambda model, seed: scaled_input(model, seed, 1e-3), _DRIVEN),
    "parameter 1.25 times too large": ("parameter", wrong_parameter, ("heater", "tanks")),
    "parameter that is not excited": ("unseen", unseen, ("oscillator",)),
}


class Judged(NamedTuple):
    """What a diagnosis says of a run, and how far the filters are off with and without it.

    Parameters
    ----------
    kind : str
        Of the first finding; blank where there is none.
    causes : set of str
        This kind, and those that it cannot be told from.
    ratio : float
        Of the errors with the record corrected to those without.
    seconds : float
        How long it took.
    likelihood : float
        Of the record as it is, as a logarithm.
    text : str
        The finding.
    """

    kind: str
    causes: set[str]
    ratio: float
    seconds: float
    likelihood: float
    text: str


def judge(case: Case) -> Judged:
    """Diagnose a run, and compare the filters with the truth."""
    run = case.run()
    began = time.perf_counter()
    found = qpmhe.diagnose(run, labels=case.labels)
    seconds = time.perf_counter() - began
    first = found.findings[0] if found.findings else None
    states = case.states[found.first :]
    scale = np.maximum(states.std(axis=0), np.sqrt(np.linalg.inv(case.cost.prior).diagonal()))
    errors = [
        float(np.sqrt(np.mean(((one.corrected[:, : states.shape[1]] - states) / scale) ** 2)))
        for one in (found.best, found.null)
    ]
    ratio = errors[0] / errors[1] if np.isfinite(errors[1]) and errors[1] > 0.0 else 1.0
    kind = first.kind if first else ""
    return Judged(
        kind, {kind, *(first.equals if first else ())}, ratio, seconds,
        float(found.null.likelihoods[0]), str(first or ""),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--held-back", action="store_true", help="The systems held back.")
    parser.add_argument("--gaps", action="store_true", help="Records with gaps.")
    parser.add_argument("--healthy", type=int, default=0, help="Healthy runs, in place of faults.")
    parser.add_argument("--only", default="", help="Faults whose title has this in it.")
    parser.add_argument("--show", action="store_true", help="Findings that are wrong.")
    given = parser.parse_args()
    chosen = [*(HELD_BACK if given.held_back else DEVELOPED)]
    print("| fault | named first | named instead | harmful |\n| --- | --- | --- | --- |")
    counts: Counter[str] = Counter()
    if given.healthy:
        seeds = range(given.first_seed, given.first_seed + given.healthy // len(chosen))
        _row("none", "", lambda model, seed: healthy(model, seed), chosen, seeds, given, counts)
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    for title, (kind, plant, models) in FAULTS.items() if not given.healthy else ():
        some = [model for model in models if model in chosen]
        if some and given.only in title:
            _row(title, kind, plant, some, seeds, given, counts)
    total = max(1, counts["runs"])
    print(
        f"\n{counts['right']} of {counts['runs']} right ({counts['right'] / total:.1%}), "
        f"{counts['none']} without a finding, {counts['hidden']} of them hidden, "
        f"{counts['harmful']} harmful "
        f"({counts['harmful'] / total:.1%}); {counts['milliseconds'] / 1000 / total:.2f} s each"
    )


def _row(
    title: str, kind: str, plant: Plant, models: list[str], seeds: range, given: Any,
    counts: Counter[str],
) -> None:
    others: Counter[str] = Counter()
    right = harmful = runs = 0
    for model in models:
        for seed in seeds:
            case = plant(model, seed)
            judged = judge(with_gaps(case, seed) if given.gaps else case)
            is_right, is_harmful = kind in judged.causes, judged.ratio > HARM
            runs, right, harmful = runs + 1, right + is_right, harmful + is_harmful
            counts["milliseconds"] += round(1000 * judged.seconds)
            if not is_right:
                others[f"{model}: {judged.kind or 'none'}"] += 1
                if not judged.kind and kind:
                    counts["none"] += 1
                    others[f"{model}: none"] -= 1
                    usual = healthy(model, seed)
                    usual = with_gaps(usual, seed) if given.gaps else usual
                    shown = judge(usual).likelihood - judged.likelihood
                    is_hidden = len(case.states) == len(healthy(model, seed).states) and (
                        shown < HIDDEN)
                    counts["hidden"] += is_hidden
                    others[f"{model}: none, hidden" if is_hidden else f"{model}: none"] += 1
            if given.show and (not is_right or is_harmful):
                print(f"  {title}, {model}, {seed}, {judged.ratio:.2f}: {judged.text}", flush=True)
    instead = ", ".join(f"{one} {count}" for one, count in others.most_common() if count)
    print(f"| {title} | {right} of {runs} | {instead} | {harmful} |", flush=True)
    counts.update(runs=runs, right=right, harmful=harmful)


if __name__ == "__main__":
    main()
