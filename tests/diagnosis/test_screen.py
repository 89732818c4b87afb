"""A long record is searched by stretches first, and the search finds what it finds without."""

from dataclasses import replace

import numpy as np
import pytest

from qpmhe.diagnosis import screen
from qpmhe.diagnosis.bank import FilterBank, Hypothesis
from qpmhe.diagnosis.faults import Evidence
from qpmhe.diagnosis.search import search
from qpmhe.diagnosis.sensor_memory import MemoryBank
from qpmhe.model.system import System

TOTAL = 2600
A = np.array([[0.9, 0.1], [-0.2, 0.8]])
SYSTEM = System(lambda x, u: x @ A.T + u * [0.0, 1.0], lambda x, u: x, n=2, p=2, m=1)
Q, R = 0.01 * np.eye(2), 0.04 * np.eye(2)


def record(fault):
    """The evidence of a record with a fault, from a filter that begins at the true state."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(TOTAL // 20), 20)[:, None]
    if fault == "a late sign":  # the input rests elsewhere, also where a stretch begins
        u[:1900] = u[2000:] = 0.0
    x, y = np.zeros((TOTAL, 2)), np.zeros((TOTAL, 2))
    for t in range(TOTAL):
        y[t] = x[t] + 0.2 * rng.standard_normal(2)
        if t + 1 < TOTAL:
            x[t + 1] = SYSTEM.f(x[t], u[t]) + 0.1 * rng.standard_normal(2)
    if fault == "noise":
        y[:, 0] += 0.4 * rng.standard_normal(TOTAL)
    elif fault == "bias":
        y[1000:1100, 1] += 1.0
    elif fault == "input":
        u = u / 1.3
    elif fault == "late":
        y[1:] = y[:-1].copy()
    elif fault == "a late sign":
        u = -20 * u
    elif fault == "lag":
        kept = np.exp(-0.25)
        shown = x[:, 0].copy()
        for t in range(1, TOTAL):
            shown[t] = kept * shown[t - 1] + (1 - kept) * x[t, 0]
        y[:, 0] += shown - x[:, 0]
    base = Hypothesis(y, u, R, Q, np.zeros(2), np.eye(2))
    bank = FilterBank(SYSTEM, None)
    return Evidence(bank, base, bank.run([base]), [np.zeros(2)])


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["a late sign", "late", "none", "bias", "input", "noise", "lag"])
def test_the_first_fault_and_what_equals_it_are_those_of_the_whole_search(fault, monkeypatch):
    evidence = record(fault)
    counts = []
    run = FilterBank.run

    def counted(self, hypotheses):
        counts[-1] += sum(len(one.measurements) for one in hypotheses)
        return run(self, hypotheses)

    monkeypatch.setattr(FilterBank, "run", counted)
    found = []
    for long in (4, 10**9):
        monkeypatch.setattr(screen, "_LONG", long)
        counts.append(0)
        with np.errstate(all="ignore"):  # as a diagnosis searches
            faults, _ = search(replace(evidence, shared={}))
        names = [(one.kind, one.subject, {k.kind for k in one.equals}) for one in faults]
        found.append((names, [one.value for one in faults]))
    assert found[0][0] == found[1][0]
    # Each is the top of a parabola, and those of a lag go through different values.
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0.1)
    assert bool(faults) == (fault != "none")
    assert counts[0] < 0.6 * counts[1], counts


def test_a_stretch_of_a_memory_begins_with_what_it_has_followed():
    evidence = record("none")
    bank = MemoryBank(evidence.bank, [1])
    one = bank.hypothesis(evidence.base, [1], (0.7, 0.3, 0.7, 0.3), 1.0, 0.0)
    part, state = bank.part(1000, 200, TOTAL), np.array([0.3, -0.7])
    begun = part.started(one.part(1000, 200), state)
    np.testing.assert_allclose(begun, [0.3, -0.7, -0.7])
    coloured = bank.hypothesis(evidence.base, [1], (0.7, 0.0, 1.0, 1.0), 0.5, 0.5)
    np.testing.assert_allclose(part.started(coloured.part(1000, 200), state), [0.3, -0.7, 0.0])
    # Behind the first samples, the filter of a stretch is the one of the record.
    whole = bank.run([one])
    some = part.run([replace(
        one.part(1000, 200), bank=part, start=part.started(one.part(1000, 200),
                                                           whole.states[1000, :2]))])
    np.testing.assert_allclose(some.states[60:], whole.states[1060:1200], atol=1e-6)
