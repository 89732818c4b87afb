"""Of a long record the first samples are filtered first, and the search finds the same."""

from dataclasses import replace

import numpy as np
import pytest

from qpmhe.diagnosis import search
from qpmhe.diagnosis.bank import FilterBank, Hypothesis
from qpmhe.diagnosis.faults import Evidence
from qpmhe.model.system import System

TOTAL = 900
A = np.array([[0.9, 0.1], [-0.2, 0.8]])
SYSTEM = System(lambda x, u: x @ A.T + u * [0.0, 1.0], lambda x, u: x, n=2, p=2, m=1)
Q, R = 0.01 * np.eye(2), 0.04 * np.eye(2)


def record(fault):
    """The evidence of a record with a fault, from a filter that begins at the true state."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(TOTAL // 20), 20)[:, None]
    if fault == "a late sign":  # the input rests elsewhere
        u[:700] = 0.0
    x, y = np.zeros((TOTAL, 2)), np.zeros((TOTAL, 2))
    spread = np.where(np.arange(TOTAL) > 300, 0.6 if fault == "a late wind" else 0.1, 0.1)
    for t in range(TOTAL):
        y[t] = x[t] + 0.2 * rng.standard_normal(2)
        if t + 1 < TOTAL:
            x[t + 1] = SYSTEM.f(x[t], u[t]) + spread[t] * rng.standard_normal(2)
    if fault == "noise":
        y[:, 0] += 0.4 * rng.standard_normal(TOTAL)
    elif fault == "bias":
        y[400:500, 1] += 1.0
    elif fault == "input":
        u = u / 1.3
    elif fault == "late":
        y[1:] = y[:-1].copy()
    elif fault == "a late sign":
        u = -20 * u
    base = Hypothesis(y, u, R, Q, np.zeros(2), np.eye(2))
    bank = FilterBank(SYSTEM, None)
    return Evidence(bank, base, bank.run([base]), [np.zeros(2)])


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["none", "noise", "bias", "input", "late", "a late sign", "a late wind"])
def test_the_faults_are_those_of_the_whole_search(fault, monkeypatch):
    evidence = record(fault)
    counts, found = [], []
    run = FilterBank.run

    def counted(self, hypotheses):
        counts[-1] += sum(len(one.measurements) for one in hypotheses)
        return run(self, hypotheses)

    monkeypatch.setattr(FilterBank, "run", counted)
    monkeypatch.setattr(search, "_PART", 150)
    for long in (4, 10**9):
        monkeypatch.setattr(search, "_LONG", long)
        counts.append(0)
        with np.errstate(all="ignore"):  # as a diagnosis searches
            faults, _ = search.search(replace(evidence, shared={}))
        names = [(one.kind, one.subject, {k.kind for k in one.equals}) for one in faults]
        found.append((names, [one.value for one in faults]))
    assert found[0][0] == found[1][0]
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0.02)
    assert bool(faults) == (fault != "none")
    if fault in ("none", "noise", "input", "late"):  # others are later than the first samples
        assert counts[0] < 0.6 * counts[1]


@pytest.mark.slow
def test_an_input_that_rests_first_is_not_ruled_out(monkeypatch):
    """It explains little of each sample, so that innovations look as they should without it."""
    monkeypatch.setattr(search, "_PART", 300)
    rng, total = np.random.default_rng(0), 3000
    system = System(lambda x, u: 0.9 * x + u, lambda x, u: x, n=1, p=1, m=1)
    u, x, y = 0.013 * rng.standard_normal((total, 1)), np.zeros(1), np.zeros((total, 1))
    u[:310] = 0.0
    for t in range(total):
        y[t] = x + 0.1 * rng.standard_normal()
        x = 0.9 * x - u[t] + 0.02 * rng.standard_normal()
    base = Hypothesis(y, u, 0.01 * np.eye(1), 4e-4 * np.eye(1), np.zeros(1), np.eye(1))
    bank = FilterBank(system, None)
    with np.errstate(all="ignore"):
        faults, _ = search.search(Evidence(bank, base, bank.run([base]), [np.zeros(1)]))
    assert [one.kind for one in faults] == ["sign"]
