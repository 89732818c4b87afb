"""Random estimation problems against a second implementation of everything that is promised.

A few hundred steps by default, ``--fuzz-steps 100000`` for as many as one likes.
"""

import copy
from collections import Counter

import numpy as np
import pytest

import qpmhe
from qpmhe.estimation.problem import Problem
from qpmhe.observers.projection import NearestPoint

from .fuzz_independent import WRITINGS, Case, WrongStepError, fuzz, table
from .independent import Held

SEED = 1
# Steps of each by default, and in the sample: whatever is compiled takes its time to be made.
FEW = {"numpy": (120, 40), "casadi": (180, 90), "jax": (90, 45)}
WAYS = [(source, writing) for source, writings in WRITINGS.items() for writing in writings]


@pytest.mark.parametrize(("source", "writing"), WAYS)
def test_every_step_is_what_it_says(pytestconfig, source, writing):
    if source != "numpy":
        pytest.importorskip(source)
    share = {"numpy": 0.6, "casadi": 0.3, "jax": 0.1}[source] / len(WRITINGS[source])
    least = FEW[source][not pytestconfig.option.all]
    steps = max(least, round(share * pytestconfig.option.fuzz_steps))
    seed = pytestconfig.option.fuzz_seed
    counts, failures = fuzz(steps, seed, source=source, writing=writing, estimators=2)
    print(table(counts))
    assert failures == []
    assert counts["steps"] == steps


@pytest.mark.parametrize(
    ("source", "writing", "seed"), [("numpy", "matmul", 3), ("casadi", "compiled", 2)]
)
def test_states_are_held_as_the_formulas_say(source, writing, seed):
    pytest.importorskip(source)
    counts, failures = fuzz(240, seed, source=source, writing=writing)
    assert failures == []
    assert counts["held", True] >= 80


def scaled(array, place, factor):
    array[place] *= factor


SPOILS = {
    "model": lambda case: case.model.numbers[0][0].__setitem__(0, case.model.A[0, 0] + 1e-3),
    "output": lambda case: case.model.numbers[2][-1].__setitem__(-1, case.model.C[-1, -1] + 1e-3),
    "weight": lambda case: scaled(case.price.weights[1], (0, 0), 1.0 + 1e-6),
    "noise weight": lambda case: scaled(case.price.weights[2], (-1, -1), 1.0 + 1e-6),
    "discount": lambda case: setattr(case.price, "discount", case.price.discount * (1.0 - 1e-6)),
    "gain": lambda case: (
        scaled(case.watcher.gain, (0, 0), 1.01), scaled(case.watcher.R, (0, 0), 1.01)
    ),
}


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("seed", [3, 4])
def test_what_differs_a_little_is_noticed(monkeypatch, seed, spoil):
    case = Case(seed, "numpy", "batched")
    case.model = copy.deepcopy(case.model)  # that of the system is as it was
    configure = case.configure

    def configured():
        mhe = configure()
        SPOILS[spoil](case)
        return mhe

    monkeypatch.setattr(case, "configure", configured)
    with pytest.raises(WrongStepError):
        case.run(60, Counter())


def test_another_hold_is_noticed(monkeypatch):
    see = Held.see

    def seen(self, candidate, samples):
        see(self, candidate, samples)
        self.weight = self.weight * (1.0 + 1e-3)

    monkeypatch.setattr(Held, "see", seen)
    words = "the hold's weight"
    _, failures = fuzz(800, SEED, source="numpy", writing="batched", estimators=1, until=words)
    assert any(words in failure for failure in failures)


def test_a_cost_that_is_too_low_is_noticed(monkeypatch):
    update = qpmhe.MovingHorizonEstimator.update

    def flattering(self, *arguments, **options):
        estimate = update(self, *arguments, **options)
        estimate.cost *= 1.0 - 1e-7
        return estimate

    monkeypatch.setattr(qpmhe.MovingHorizonEstimator, "update", flattering)
    _, failures = fuzz(30, SEED, source="numpy", writing="batched", until="cost is")
    assert "cost is" in failures[0]


def test_memory_of_the_estimator_that_is_handed_out_is_noticed(monkeypatch):
    update, memory = qpmhe.MovingHorizonEstimator.update, {}

    def careless(self, *arguments, **options):
        estimate = update(self, *arguments, **options)
        own = memory.setdefault((id(self), estimate.candidate.shape), estimate.candidate.copy())
        own[...] = estimate.candidate
        estimate.candidate = own
        return estimate

    monkeypatch.setattr(qpmhe.MovingHorizonEstimator, "update", careless)
    _, failures = fuzz(400, SEED, source="numpy", writing="batched", until="handed out")
    assert any("handed out" in failure for failure in failures)


def test_a_projection_in_another_metric_is_noticed(monkeypatch):
    nearest = NearestPoint.__call__

    def clipping(self, point, covariance):
        return nearest(self, point, np.eye(point.size))

    monkeypatch.setattr(NearestPoint, "__call__", clipping)
    words = "the candidate goes to"
    _, failures = fuzz(500, SEED, source="numpy", writing="batched", estimators=1, until=words)
    assert any(words in failure for failure in failures)


def test_a_row_that_is_dropped_in_secret_is_noticed(monkeypatch):
    monkeypatch.setattr(Problem, "missed_rows", lambda self, trial: ())
    words = "dropped set()"
    _, failures = fuzz(800, SEED, source="numpy", writing="batched", estimators=1, until=words)
    assert any(words in failure for failure in failures)
