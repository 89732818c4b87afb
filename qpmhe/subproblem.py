"""The convex QP of P_t, linearised around a trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP
from qpmhe_solvers.qp import band_of

from .costs import QuadraticCost
from .linearization import StageTerms
from .problem import Problem, Trial
from .sets import Box
from .system import System
from .window import Window

__all__ = ["Subproblem"]

Array = NDArray[np.float64]


class Subproblem:
    r"""Gauss-Newton QPs in the increments d of a trajectory.

    The objective is half of J with linearised residuals (see `StageTerms`): its gradient
    at d = 0 is that of J/2, its Hessian the Gauss-Newton one. Sets become

    - bounds on d from X,
    - rows ``w_i + d_{i+1} - A_i d_i`` in W and ``v_i - C_i d_i`` in V, linearised.

    One QP is kept for each window length and overwritten at each use.

    Parameters
    ----------
    system : System
        Dimensions, Jacobians and sets.
    cost : QuadraticCost
        The weights.
    horizon : int
        The longest window, N.
    """

    def __init__(self, system: System, cost: QuadraticCost, horizon: int) -> None:
        self._system = system
        self._n = n = system.n
        self._terms = StageTerms(horizon, n, system.p)
        self._disturbance_band = band_of(cost.disturbance)
        self._bounded_w = _bounded(system.disturbances)
        self._bounded_v = _bounded(system.noises)
        self._rows = self._bounded_w.size + self._bounded_v.size
        self._qps: dict[int, QP] = {}

    def at_candidate(self, problem: Problem, window: Window) -> QP:
        """The QP around the candidate, from what the window has kept."""
        first = window.first
        return self._assemble(problem, problem.candidate(window), window.terms, first)

    def at(self, problem: Problem, trial: Trial) -> QP | None:
        """The QP around any trajectory; None where the model has no Jacobians there."""
        states, terms, n = trial.trajectory[:-1], self._terms, self._n
        count = states.shape[0]
        try:
            terms.jacobian[:count, :n] = self._system.f_jacobian.batch(states, problem.inputs)
            terms.jacobian[:count, n:] = self._system.h_jacobian.batch(states, problem.inputs)
        except Exception:  # a user's Jacobian outside its domain
            return None
        if not np.isfinite(terms.jacobian[:count]).all():
            return None
        terms.set_all(problem.stage_weights, trial.residuals, trial.weighted)
        return self._assemble(problem, trial, terms, 0)

    def _assemble(self, problem: Problem, trial: Trial, terms: StageTerms, first: int) -> QP:
        n, count = self._n, trial.residuals.shape[0]
        qp = self._qps.get(count)
        if qp is None:
            qp = self._qps[count] = QP(count + 1, n, self._rows)
            qp.row_next[:-1, : self._bounded_w.size] = np.eye(n)[self._bounded_w]
        last, band, gradient = first + count, qp.band, qp.gradient
        weight = problem.stage_weights
        if weight.ndim == 2:
            disturbance_band = self._disturbance_band
            band[count] = disturbance_band
        else:
            disturbance_band = np.array([band_of(w[:n, :n]) for w in weight])
            band[count] = disturbance_band[-1]
            disturbance_band = disturbance_band[:-1]
        np.add(terms.panel[first + 1 : last], disturbance_band, out=band[1:count])
        np.add(terms.panel[first], problem.prior_band, out=band[0])
        np.add(terms.own[first + 1 : last], terms.following[first : last - 1],
               out=gradient[1:count])
        offset = trial.trajectory[0] - problem.prior
        np.add(terms.own[first], problem.prior_weight @ offset, out=gradient[0])
        gradient[count] = terms.following[last - 1]
        if self._rows or problem.states is not None or qp.bounded:
            self._bound(qp, problem, trial, terms.jacobian[first:last])
        return qp

    def _bound(self, qp: QP, problem: Problem, trial: Trial, jacobian: Array) -> None:
        n = self._n
        qp.bounded = problem.states is not None
        if problem.states is not None:
            np.subtract(problem.states.lower, trial.trajectory, out=qp.lower)
            np.subtract(problem.states.upper, trial.trajectory, out=qp.upper)
        else:
            qp.lower[...], qp.upper[...] = -np.inf, np.inf
        if self._rows:
            split = self._bounded_w.size
            w, v = slice(0, split), slice(split, None)
            qp.row_own[:-1, w] = -jacobian[:, self._bounded_w]
            qp.row_own[:-1, v] = -jacobian[:, n + self._bounded_v]
            _set_rows(qp, w, problem.disturbances, self._bounded_w, trial.residuals[:, :n])
            _set_rows(qp, v, problem.noises, self._bounded_v, trial.residuals[:, n:])


def _set_rows(
    qp: QP, rows: slice, box: Box | None, components: NDArray[np.intp], values: Array
) -> None:
    if box is None:
        qp.row_lower[:-1, rows], qp.row_upper[:-1, rows] = -np.inf, np.inf
    else:
        qp.row_lower[:-1, rows] = box.lower[components] - values[:, components]
        qp.row_upper[:-1, rows] = box.upper[components] - values[:, components]


def _bounded(box: Box | None) -> NDArray[np.intp]:
    """Components with a finite bound: the others need no row."""
    if box is None:
        return np.empty(0, dtype=np.intp)
    return np.flatnonzero(np.isfinite(box.lower) | np.isfinite(box.upper))
