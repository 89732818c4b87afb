"""What every problem is compared with, all with the same covariances."""

from __future__ import annotations

from functools import partial
from typing import Any

import qpmhe
from qpmhe.baselines import ExtendedKalmanFilter
from qpmhe.baselines import Problem as FilterProblem
from qpmhe.tuning import Weights

from .problem import Array, Problem, Way

ITERATIONS = 10
QPS = {"1 QP": 1, "2 QPs": 2, "5 QPs": 5, "converged": None}


def filters(problem: Problem, weights: Weights) -> dict[str, Way]:
    """The baselines, as the field has them: they know no X."""
    kinds: dict[str, Any] = {}
    if problem.constant_gain is not None:
        kinds["constant gain"] = problem.constant_gain(weights)
    kinds |= {
        "EKF": qpmhe.ExtendedKalman,
        "EKF, gated": partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate()),
        "UKF": qpmhe.UnscentedKalman,
    }
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=weights.prior, disturbance=weights.disturbance, noise=weights.noise
    )

    def iterated(start: Array) -> ExtendedKalmanFilter:
        return ExtendedKalmanFilter(
            FilterProblem(
                problem.system, initial_state=start, prior=weights.prior,
                disturbance=weights.disturbance, noise=weights.noise,
            ),
            iterations=ITERATIONS,
        )

    ways: dict[str, Way] = {
        name: partial(
            problem.estimator, weights=weights, observer=kind, cost=cost, max_qps=0,
            project_observer=False, horizon=1,
        )
        for name, kind in kinds.items()
    }
    return ways | {"EKF, iterated": iterated}


def estimators(problem: Problem, weights: Weights) -> dict[str, Way]:
    """The baselines, moving horizon estimation with 1, 2, 5 or all QPs, and the folder's own."""
    ways = filters(problem, weights)
    for name, count in QPS.items():
        ways[f"MHE, {name}"] = partial(problem.estimator, weights=weights, max_qps=count)
    return ways | ({} if problem.own is None else problem.own(problem, weights))
