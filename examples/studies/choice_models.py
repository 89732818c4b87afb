"""Models of the zoo with other observers, costs, starts, sets and noise, for a study.

A study's axes are backends, caps, horizons, starts of the QPs and seeds. What else is compared
here is a model of its own each, ``choice_models.py:observed(model='cstr', observer='extended')``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

import qpmhe
from qpmhe.models import Example, Record, Scenario, catalogue
from qpmhe.observers import Observer

#: The record about whose mean constant gains are designed; no study has this seed.
DESIGN_SEED = 1_000_000
#: Share of the samples with an outlier in each output, and its size in standard deviations.
SHARE, SIZE = 0.05, 20.0


def observed(
    model: str, observer: str = "own", prior: str = "constant", distance: float = 1.0
) -> Example:
    """A model of the zoo with another observer, prior weight or initial estimate.

    Parameters
    ----------
    model : str
        Its name in the catalogue.
    observer : {"own", "constant", "steady", "extended", "unscented"}
        That of the zoo, or one for the scenario's covariances. Constant gains are designed
        about the mean state and input of a record.
    prior : {"constant", "observer"}
        The zoo's constant weight, or the inverse of the observer's covariance.
    distance : float
        The initial error in units of the zoo's. An estimate outside of X is moved into it.
    """
    example = catalogue()[model]()
    cost, scenario = example.cost, example.scenario
    if prior == "observer":
        cost = qpmhe.QuadraticCost(disturbance=cost.disturbance, noise=cost.noise)
    start = scenario.initial_state + distance * (
        scenario.initial_estimate - scenario.initial_state
    )
    if isinstance(example.system.states, qpmhe.Box):
        start = np.clip(start, example.system.states.lower, example.system.states.upper)
    return Example(
        example.system, _observer(example, observer), cost,
        replace(scenario, initial_estimate=start),
    )


def _observer(example: Example, kind: str) -> Observer:
    if kind == "own":
        return example.observer
    system, scenario = example.system, example.scenario
    covariances = {
        "disturbance": scenario.disturbance_covariance, "noise": scenario.noise_covariance,
    }
    prior = np.linalg.inv(example.cost.prior)
    if kind == "extended":
        return qpmhe.ExtendedKalman(prior=prior, **covariances)
    if kind == "unscented":
        return qpmhe.UnscentedKalman(prior=prior, **covariances)
    record = scenario.simulate(DESIGN_SEED)
    inputs = () if record.inputs is None else (record.inputs.mean(axis=0),)
    states = record.states
    if system.state_residual is not None:  # angles that do not jump
        steps = system.state_residual(states[1:], states[:-1])
        states = np.vstack((states[:1], states[0] + np.cumsum(steps, axis=0)))
    about = (system, states.mean(axis=0), *inputs)
    if kind == "steady":
        return qpmhe.SteadyStateKalman(*about, prior=prior, **covariances)
    if kind == "constant":
        return qpmhe.design_luenberger(*about, **covariances)
    raise ValueError(f"no observer {kind!r} here")


def without_states(model: str) -> Example:
    """A model of the zoo whose estimator does not know X; the simulation keeps it.

    Parameters
    ----------
    model : str
        Its name in the catalogue.
    """
    example = catalogue()[model]()
    return example._replace(system=example.system.with_sets({"states": None}))


def one_sided(model: str, known: bool) -> Example:
    """A model of the zoo whose disturbances are never negative.

    Parameters
    ----------
    model : str
        Its name in the catalogue.
    known : bool
        Whether the estimator knows it.
    """
    example = catalogue()[model]()
    n = example.system.n
    bounded = example.system.with_sets({"disturbances": qpmhe.Box(np.zeros(n), np.full(n, np.inf))})
    return example._replace(
        system=bounded if known else example.system,
        scenario=replace(example.scenario, system=bounded),
    )


@dataclass(frozen=True, eq=False)
class OutlierScenario(Scenario):
    """A scenario some of whose measurements are grossly wrong."""

    def simulate(self, seed: int, steps: int | None = None) -> Record:
        """The record of `Scenario.simulate`, with outliers in a share of the measurements."""
        record = super().simulate(seed, steps)
        rng = np.random.default_rng([seed, 1])
        shape = record.measurements.shape
        hit = (rng.random(shape) < SHARE) * rng.choice([-SIZE, SIZE], shape)
        outliers = hit * np.sqrt(np.diag(self.noise_covariance))
        return replace(record, measurements=record.measurements + outliers)


def outlying(model: str, loss: str = "quadratic", observer: str = "own") -> Example:
    """A model of the zoo with outliers in its records.

    Parameters
    ----------
    model : str
        Its name in the catalogue.
    loss : {"quadratic", "huber"}
        The noise's loss in the cost.
    observer : str
        As in `observed`.
    """
    system, chosen, cost, plain = observed(model, observer)
    scenario = OutlierScenario(
        **{item.name: getattr(plain, item.name) for item in fields(Scenario)}
    )
    if loss == "huber":
        noise = qpmhe.Huber(cost.noise, threshold=1.345, per_component=True)
        cost = qpmhe.RobustCost(prior=cost.prior, disturbance=cost.disturbance, noise=noise)
    return Example(system, chosen, cost, scenario)
