"""What every problem is compared with, all with the same covariances."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import qpmhe
from qpmhe.tuning import Weights

from .problem import Array, Problem, Way

ITERATIONS = 10
QPS = {"1 QP": 1, "2 QPs": 2, "5 QPs": 5, "converged": None}


class IteratedKalman(qpmhe.Observer):
    """The iterated extended Kalman filter: its update is a Gauss-Newton search.

    Parameters
    ----------
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array
        As for `qpmhe.ExtendedKalman`.

    References
    ----------
    Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Trans.
    Automat. Contr. 38 (1993).
    """

    needs_jacobians = True

    def __init__(self, *, prior: Array, disturbance: Array, noise: Array) -> None:
        self._prior, self._disturbance, self._noise = prior, disturbance, noise

    def check(self, system: qpmhe.System, initial_state: Array) -> None:
        """The covariances are those of the problem."""

    def initial_covariance(self) -> Array:
        """P(0)."""
        return self._prior

    def correct(self, z: Array, v: Array, sample: qpmhe.Sample) -> tuple[Array, Array]:
        """Predict from the updated state; L(z, 0) = 0."""
        updated, covariance = self.filter(z, v, sample)
        system, u = sample.system, sample.u
        a = system.f_jacobian(updated, u)
        ahead = a @ covariance @ a.T + system.state_covariance(self._disturbance)
        return system.f(updated, u) - system.f(z, u), 0.5 * (ahead + ahead.T)

    def filter(self, z: Array, v: Array, sample: qpmhe.Sample) -> tuple[Array, Array]:
        """Linearise h anew at each iterate."""
        system, u, p = sample.system, sample.u, sample.covariance
        there = np.ones(v.size, bool) if sample.observed is None else sample.observed
        if not there.any():
            return z, p
        at, c, r = z, sample.h_jacobian[there], self._noise[np.ix_(there, there)]
        y = (v + system.h(z, u))[there]
        for _ in range(ITERATIONS):
            gain = np.linalg.solve(c @ p @ c.T + r, c @ p).T
            before, at = at, z + gain @ (y - system.h(at, u)[there] - c @ (z - at))
            c = system.h_jacobian(at, u)[there]
            if np.all(np.abs(at - before) <= 1e-9 * np.sqrt(p.diagonal())):
                break
        gain = np.linalg.solve(c @ p @ c.T + r, c @ p).T
        closed = np.eye(z.size) - gain @ c
        return at, closed @ p @ closed.T + gain @ r @ gain.T


def filters(problem: Problem, weights: Weights) -> dict[str, Way]:
    """The baselines, as the field has them: they know no X."""
    kinds: dict[str, Any] = {}
    if problem.constant_gain is not None:
        kinds["constant gain"] = problem.constant_gain(weights)
    kinds |= {
        "EKF": qpmhe.ExtendedKalman,
        "EKF, gated": partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate()),
        "EKF, iterated": IteratedKalman, "UKF": qpmhe.UnscentedKalman,
    }
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
