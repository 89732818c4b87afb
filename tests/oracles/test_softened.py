"""Nonlinear constraints and soft sets: J as Ipopt minimises it from the same start."""

import numpy as np
import pytest

import qpmhe

from .softened import COSTS, HARD, PENALTIES, SETS, Case

CASES = [(kind, None) for kind in HARD] + [
    (kind, penalty) for kind in HARD + SETS for penalty in PENALTIES
]
BACKENDS = [
    name for name in ("osqp", "proxqp", "piqp", "daqp", "clarabel")
    if name in qpmhe.solvers.available()
]
pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")


def compared(case, backend):
    """How many windows were compared, and how many reach Ipopt's cost to 1e-6 of it."""
    estimator, total, reached = case.estimator(backend=backend, max_qps=None), 0, 0
    for t, y in enumerate(case.measurements):
        estimate = estimator.update(y, case.inputs[t] if case.m else None)
        assert estimate.cost <= estimate.candidate_cost
        if t + 1 < case.horizon or t % 3:
            continue
        window = case.window(estimate)
        minimum, _ = window.minimum(estimate.candidate)
        # A hard constraint may have no trajectory at a cost not above the candidate's.
        if not np.isfinite(minimum) or minimum > estimate.candidate_cost:
            continue
        total += 1
        # A lower local minimum than Ipopt's is none the worse, and a higher one is a minimum, too,
        # if Ipopt stays there.
        if estimate.cost > minimum * (1.0 + 1e-6):
            minimum, _ = window.minimum(estimate.trajectory)
        reached += bool(estimate.cost <= minimum * (1.0 + 1e-6))
    return total, reached


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize(("kind", "penalty"), CASES)
def test_the_cost_is_ipopts(kind, penalty, cost):
    found = [compared(Case(seed, kind, penalty, cost), "auto") for seed in range(2)]
    total, reached = np.sum(found, axis=0)
    assert total >= 3
    assert reached >= total - (1 if kind in HARD else 0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("kind", "penalty"), [
    ("xu", None), ("v", None), ("v", "linear"), ("x", "both"),
    *((kind, penalty) for kind in SETS for penalty in PENALTIES),
])
def test_every_backend_reaches_it(backend, kind, penalty):
    total, reached = compared(Case(5, kind, penalty), backend)
    assert total >= 2
    assert reached == total
