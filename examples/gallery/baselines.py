"""What every problem is compared with, all with the same covariances."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import qpmhe
from qpmhe.tuning import Weights

from .problem import Array, Problem, Way

# Squared innovation of one sensor that 99.7 % of the good samples stay below; rejections in a row
# after which the gate opens.
GATE: dict[str, Any] = {"probability": 0.997, "reopen": 10}
ITERATIONS = 10
QPS = {"1 QP": 1, "2 QPs": 2, "5 QPs": 5, "converged": None}


class IteratedKalman(qpmhe.ExtendedKalman):
    """The iterated extended Kalman filter: its update is a Gauss-Newton search.

    References
    ----------
    Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Trans.
    Automat. Contr. 38 (1993).
    """

    def correct(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        """Predict from the updated state; L(z, 0) = 0."""
        updated, covariance = self.filter(z, v, sample)
        system, u = sample.system, sample.u
        a = system.f_jacobian(updated, u)
        ahead = a @ covariance @ a.T + self._disturbance_of(sample)
        return system.f(updated, u) - system.f(z, u), 0.5 * (ahead + ahead.T)

    def filter(self, z: Array, v: Array, sample: Any) -> tuple[Array, Array]:
        """Linearise h anew at each iterate."""
        system, u, p = sample.system, sample.u, sample.covariance
        at, expected, c = z, system.h(z, u), sample.h_jacobian
        for _ in range(ITERATIONS):
            rows, r, left = self._seen(c, v + expected - system.h(at, u) - c @ (z - at), sample)
            gain = np.linalg.solve(rows @ p @ rows.T + r, rows @ p).T
            before, at = at, z + gain @ left
            c = system.h_jacobian(at, u)
            if np.all(np.abs(at - before) <= 1e-9 * np.sqrt(p.diagonal())):
                break
        rows, r, _ = self._seen(c, v, sample)
        gain = np.linalg.solve(rows @ p @ rows.T + r, rows @ p).T
        closed = np.eye(z.size) - gain @ rows
        return at, closed @ p @ closed.T + gain @ r @ gain.T


def filters(problem: Problem, weights: Weights) -> dict[str, Way]:
    """The baselines, as the field has them: they know no X."""
    kinds: dict[str, Any] = {}
    if problem.constant_gain is not None:
        kinds["constant gain"] = problem.constant_gain(weights)
    kinds["EKF"] = qpmhe.ExtendedKalman
    if hasattr(qpmhe, "Gate"):
        kinds["EKF, gated"] = partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate(**GATE))
    kinds |= {"EKF, iterated": IteratedKalman, "UKF": qpmhe.UnscentedKalman}
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=weights.prior, disturbance=weights.disturbance, noise=weights.noise
    )
    return {
        name: partial(
            problem.estimator, weights=weights, observer=kind, cost=cost, max_qps=0,
            project_observer=False, horizon=1,
        )
        for name, kind in kinds.items()
    }


def estimators(problem: Problem, weights: Weights) -> dict[str, Way]:
    """The baselines, moving horizon estimation with 1, 2, 5 or all QPs, and the folder's own."""
    ways = filters(problem, weights)
    for name, count in QPS.items():
        ways[f"MHE, {name}"] = partial(problem.estimator, weights=weights, max_qps=count)
    return ways | ({} if problem.own is None else problem.own(problem, weights))
