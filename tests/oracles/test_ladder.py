"""Where the candidate violates W or V: Ipopt's constrained minimum from the same start."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest

import qpmhe

Array = np.ndarray


class Case(NamedTuple):
    system: qpmhe.System
    estimator: qpmhe.MovingHorizonEstimator
    cost: qpmhe.QuadraticCost
    f: Any  # of CasADi
    h: Any
    measurements: Array


def made(seed: int) -> Case:
    """A random nonlinear system with tight W and V, in every third of which 0 is no w."""
    draw = np.random.default_rng(seed)
    n, horizon = int(draw.integers(1, 4)), int(draw.integers(3, 7))
    p = min(int(draw.integers(1, 3)), n)
    a = draw.normal(size=(n, n))
    a *= draw.uniform(0.5, 1.05) / max(float(np.abs(np.linalg.eigvals(a)).max()), 1e-3)
    b, c = 0.4 * draw.normal(size=(n, n)), draw.normal(size=(p, n))
    w_lower, w_upper = -draw.uniform(0.02, 0.3, n), draw.uniform(0.02, 0.3, n)
    if seed % 3 == 0:
        j = int(draw.integers(n))
        w_lower[j], w_upper[j] = 0.02, 0.4
    v_lower, v_upper = -draw.uniform(0.1, 0.6, p), draw.uniform(0.1, 0.6, p)
    states = qpmhe.Box(-draw.uniform(1, 3, n), draw.uniform(1, 3, n)) if seed % 2 else None

    def f(x: Array) -> Array:
        return x @ a.T + 0.5 * np.sin(x @ b.T)

    def h(x: Array) -> Array:
        return x @ c.T + 0.03 * (x @ c.T) ** 2

    system = qpmhe.System(
        f, h, n=n, p=p, states=states, disturbances=qpmhe.Box(w_lower, w_upper),
        noises=qpmhe.Box(v_lower, v_upper),
    )
    cost = qpmhe.QuadraticCost(
        prior=np.diag(draw.uniform(0.5, 3, n)), disturbance=np.diag(draw.uniform(1, 20, n)),
        noise=np.diag(draw.uniform(1, 20, p)),
    )
    x, measurements = draw.uniform(-1, 1, n), []
    low, high = (states.lower, states.upper) if states else (np.full(n, -9.0), np.full(n, 9.0))
    for _ in range(horizon + 6):
        measurements.append(h(x) + draw.uniform(v_lower, v_upper))
        x = np.clip(f(x) + draw.uniform(w_lower, w_upper), low, high)
    estimator = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger(0.6 * a @ np.linalg.pinv(c)), cost, horizon=horizon,
        initial_state=np.clip(draw.uniform(-1.5, 1.5, n), low, high), max_qps=None,
    )
    a_, b_, c_ = ca.DM(a), ca.DM(b), ca.DM(c)
    return Case(
        system, estimator, cost, lambda x: a_ @ x + 0.5 * ca.sin(b_ @ x),
        lambda x: c_ @ x + 0.03 * (c_ @ x) ** 2, np.array(measurements),
    )


def ipopt_minimum(case: Case, candidate: Array, measurements: Array) -> float:
    """The constrained minimum that Ipopt reaches from the candidate; infinity if it fails."""
    system, cost, count = case.system, case.cost, len(measurements)
    x = ca.SX.sym("x", system.n, count + 1)
    w = [x[:, i + 1] - case.f(x[:, i]) for i in range(count)]
    v = [ca.DM(measurements[i]) - case.h(x[:, i]) for i in range(count)]
    offset = x[:, 0] - ca.DM(candidate[0])
    objective = ca.bilin(ca.DM(cost.prior), offset, offset)
    objective += sum(ca.bilin(ca.DM(cost.disturbance), one, one) for one in w)
    objective += sum(ca.bilin(ca.DM(cost.noise), one, one) for one in v)
    solve = ca.nlpsol(
        "solve", "ipopt", {"x": ca.vec(x), "f": objective, "g": ca.vertcat(*w, *v)},
        {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
         "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 500},
    )
    states, disturbances, noises = system.states, system.disturbances, system.noises
    assert disturbances is not None
    assert noises is not None
    bounds = [
        np.concatenate([np.tile(getattr(one, side), count) for one in (disturbances, noises)])
        for side in ("lower", "upper")
    ]
    free = np.full(system.n, np.inf)
    found = solve(
        x0=candidate.ravel(), lbg=bounds[0], ubg=bounds[1],
        lbx=np.tile(states.lower if states else -free, count + 1),
        ubx=np.tile(states.upper if states else free, count + 1),
    )
    return float(found["f"]) if solve.stats()["success"] else np.inf


@pytest.mark.filterwarnings("ignore::qpmhe.ObserverWarning")
@pytest.mark.parametrize("first", range(0, 40, 8))
def test_the_minimum_is_ipopts_where_that_is_feasible_and_not_above_the_candidates(
    first: int,
) -> None:
    compared = 0
    for seed in range(first, first + 8):
        case = made(seed)
        horizon = case.estimator.horizon
        for t, y in enumerate(case.measurements):
            estimate = case.estimator.update(y)
            if t < horizon - 1 or t % 2 or qpmhe.Status.CANDIDATE_OUTSIDE not in estimate.status:
                continue
            window = case.measurements[t + 1 - horizon : t + 1]
            minimum = ipopt_minimum(case, estimate.candidate, window)
            if minimum > estimate.candidate_cost:
                continue
            compared += 1
            assert estimate.improved, (seed, t)
            assert estimate.dropped == (), (seed, t)
            # A lower local minimum than Ipopt's is none the worse.
            assert estimate.cost <= minimum * (1.0 + 1e-6), (seed, t)
    assert compared >= 15
