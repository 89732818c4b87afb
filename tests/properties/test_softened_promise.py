"""J, penalties included, is never above the candidate's: judged by CasADi from its definition."""

import numpy as np
import pytest
from oracles.softened import COSTS, HARD, PENALTIES, SETS, Case

import qpmhe
from qpmhe import Status
from qpmhe_solvers import RawSolution, Solver
from qpmhe_solvers.options import SolverOptions

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")


class Liar(Solver):
    """Claims success for the right step, for noise, for NaN, or raises."""

    def __init__(self, seed):
        super().__init__(SolverOptions())
        self.draw = np.random.default_rng(seed)
        self.honest = qpmhe.solvers.create("auto")

    def _solve(self, qp, start):
        kind = self.draw.integers(5)
        if kind == 0:
            raise RuntimeError("no")
        if kind == 1:
            return RawSolution(np.full((qp.stages, qp.n), np.nan), True, 1)
        if kind == 2:
            return RawSolution(self.draw.normal(size=(qp.stages, qp.n)), True, 1)
        found = self.honest.solve(qp)
        duals = (None, None) if kind == 3 or found.d is None else (
            self.draw.normal(size=qp.size), self.draw.normal(size=qp.stages * qp.rows)
        )
        return RawSolution(found.d, True, 1, *duals)


def drawn(seed):
    """A case, random options of its estimator, and its measurements, some missing."""
    draw = np.random.default_rng([seed, 7])
    kind = str(draw.choice(HARD + SETS))
    soft = kind in SETS or draw.random() < 0.6
    case = Case(
        seed, kind, str(draw.choice(PENALTIES)) if soft else None, str(draw.choice(COSTS))
    )
    backend = str(draw.choice(["auto", "liar", *qpmhe.solvers.available()[:6]]))
    options = {
        "backend": Liar(seed) if backend == "liar" else backend,
        "max_qps": [0, 1, 2, None][draw.integers(4)],
        "warm_start": bool(draw.random() < 0.3),
        "candidate": "reinitialized" if draw.random() < 0.2 else "observer",
        "infeasible": str(draw.choice(["drop_rows", "keep_candidate"])),
    }
    if draw.random() < 0.3 and backend not in ("liar", "auto"):
        options["max_solver_iterations"] = int(draw.integers(1, 6))
    measurements = case.measurements.copy()
    measurements[draw.random(measurements.shape) < 0.1] = np.nan
    measurements[draw.random(len(measurements)) < 0.05] *= 30.0
    return case, options, measurements


@pytest.mark.parametrize("seed", range(200))
def test_the_cost_is_never_above_the_candidates(seed):
    case, options, measurements = drawn(seed)
    estimator = case.estimator(**options)
    for t, y in enumerate(measurements):
        estimate = estimator.update(y, case.inputs[t] if case.m else None)
        if not estimate.candidate_cost < 1e100:
            break  # an observer that diverges: another way of computing J overflows
        window = case.window(estimate, measurements)
        cost, missed = window.judged(estimate.trajectory)
        bound, outside = window.judged(estimate.candidate)
        assert cost <= bound * (1.0 + 1e-9)
        assert estimate.cost == pytest.approx(cost, rel=1e-7)
        assert estimate.candidate_cost == pytest.approx(bound, rel=1e-7)
        if estimate.improved and not estimate.dropped:
            assert missed <= 1e-6
        if missed > 1e-6:
            assert estimate.dropped or not estimate.improved
            assert Status.CANDIDATE_OUTSIDE in estimate.status
            assert outside > 1e-9
