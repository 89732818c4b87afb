"""The convex subproblem of one window length as a cvxpy program in parameters."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import SolveStatus

from .costs import Cost, Huber, Loss, Power, Quadratic
from .estimation.problem import Problem, Trial
from .model.sets import ConvexSet
from .model.system import System

__all__ = ["ExactProgram", "discounts"]

Array = NDArray[np.float64]

# Asked for in turn: where the first cannot be reached, the solver may bring nothing at all.
_TOLERANCES = (1e-10, 1e-8)


class ExactProgram:
    """The subproblem of one window length, in parameters."""

    def __init__(
        self, cp: Any, system: System, cost: Cost, losses: tuple[Loss, Loss, Loss], count: int
    ) -> None:
        n, q = system.n, system.n + system.p
        self._cp, self._n, self._losses = cp, n, losses
        self._prior_loss, w_loss, v_loss = losses
        factors = discounts(cost, count)
        self._d = d = cp.Variable((count + 1, n))
        self._root = np.zeros((q, q))
        self._root[:n, :n] = _root_of(cost.disturbance, w_loss)
        self._residuals = cp.Parameter((count, q))
        self._jacobian = [cp.Parameter((count, q)) for _ in range(n)]
        # Rows are whitened residuals: each is a row of r times the root of its weight.
        white = self._residuals + d[1:] @ self._root[:n] - _applied(cp, self._jacobian, d)
        self._prior_root, self._offset = cp.Parameter((n, n)), cp.Parameter((1, n))
        prior = self._offset + d[:1] @ self._prior_root
        self._terms = terms = [
            _Term(cp, self._prior_loss, prior, factors[:1]),
            _Term(cp, w_loss, white[:, :n], factors[1:]),
            _Term(cp, v_loss, white[:, n:], factors[1:]),
        ]
        self._states = _Rows(cp, system.states, n, d, None)
        self._disturbances = _Rows(cp, system.disturbances, n, d[1:], d)
        self._noises = _Rows(cp, system.noises, system.p, None, d)
        constraints = [one for term in terms for one in term.constraints]
        for rows in (self._states, self._disturbances, self._noises):
            constraints += rows.constraints
        self.problem = cp.Problem(cp.Minimize(sum(term.value for term in terms)), constraints)

    def set(self, problem: Problem, trial: Trial, jacobian: Array) -> None:
        """Put the numbers of a trial in."""
        n, root = self._n, self._roots(problem.stage_weights)
        self._residuals.value = white = np.matmul(trial.residuals[:, None, :], root)[:, 0]
        columns = np.matmul(jacobian.transpose(0, 2, 1), root)
        for j, parameter in enumerate(self._jacobian):
            parameter.value = columns[:, j]
        prior_root = _root_of(problem.prior_weight, self._prior_loss)
        self._prior_root.value = prior_root
        self._offset.value = offset = (trial.trajectory[:1] - problem.prior) @ prior_root
        for term, now in zip(self._terms, (offset, white[:, :n], white[:, n:]), strict=True):
            term.scale_to(now)
        self._states.set(problem.states, trial.trajectory, None, None)
        self._disturbances.set(
            problem.disturbances, trial.residuals[:, :n], jacobian[:, :n], None
        )
        self._noises.set(
            problem.noises, trial.residuals[:, n:], jacobian[:, n:], problem.observed
        )

    def _roots(self, weights: Array) -> Array:
        """Roots of the stage weights, of all stages or of each."""
        n, loss = self._n, self._losses[2]
        if weights.ndim == 2:
            self._root[n:, n:] = _root_of(weights[n:, n:], loss)
            return self._root
        roots = np.repeat(self._root[None], weights.shape[0], axis=0)
        for root, weight in zip(roots, weights, strict=True):
            root[n:, n:] = _root_of(weight[n:, n:], loss)
        return roots

    def solve(
        self, time_limit: float | None = None
    ) -> tuple[Array | None, SolveStatus, int | None, str]:
        """The increments, how far to trust them, the solver's count, and its words."""
        cp, problem, message = self._cp, self.problem, ""
        best: tuple[Array, int | None] | None = None
        began = perf_counter()
        clock: dict[str, float] = {}
        for tolerance in _TOLERANCES:
            if time_limit is not None:
                clock["time_limit"] = time_limit - (perf_counter() - began)
                if clock["time_limit"] <= 0.0:
                    message = message or "no time remained for Clarabel"
                    break
            try:
                problem.solve(
                    solver=cp.CLARABEL, enforce_dpp=True, warm_start=False,
                    tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance, **clock,
                )
            except cp.SolverError as error:
                message = f"Clarabel failed: {error}"
                continue
            iterations = problem.solver_stats.num_iters if problem.solver_stats else None
            message = f"Clarabel reports {problem.status}"
            d = None if self._d.value is None else np.array(self._d.value, dtype=np.float64)
            if d is None or not np.isfinite(d).all():
                continue
            if problem.status == cp.OPTIMAL:
                return d, SolveStatus.SOLVED, iterations, ""
            if best is None:
                best = d, iterations
        if best is None:
            return None, SolveStatus.FAILED, None, message
        return best[0], SolveStatus.STOPPED, best[1], message


class _Rows:
    """The inequalities of one set at every stage, each of which can be switched off.

    Their moving part is ``M (d_own - J d)``, with d_own absent for the noises and J for the
    states. A row that is switched off reads 0 <= 1, or 0 = 0.
    """

    def __init__(self, cp: Any, one: ConvexSet | None, dimension: int, own: Any, d: Any) -> None:
        self.constraints: list[Any] = []
        self._matrix = np.zeros((0, dimension))
        if one is None:
            return
        bounded = one.bounded_components
        self._matrix = np.vstack((np.eye(dimension)[bounded], one.matrix))
        self._lower = np.append(one.lower[bounded], one.row_lower)
        self._upper = np.append(one.upper[bounded], one.row_upper)
        equal = self._lower == self._upper
        self._sides: list[tuple[Any, NDArray[np.intp], float]] = []
        rows = self._matrix.shape[0]
        stages = d.shape[0] - 1 if own is None else own.shape[0]
        self._switch, self._jacobian = None, []
        moving: Any = 0.0
        if own is not None:
            self._switch = cp.Parameter((stages, rows))
            moving = moving + cp.multiply(self._switch, own @ self._matrix.T)
        if d is not None:
            self._jacobian = [cp.Parameter((stages, rows)) for _ in range(d.shape[1])]
            moving = moving - _applied(cp, self._jacobian, d)
        # What stands on the other side of a row that is switched off: 0, 1 or -1.
        for chosen, off in (
            (np.flatnonzero(equal), 0.0),
            (np.flatnonzero(np.isfinite(self._upper) & ~equal), 1.0),
            (np.flatnonzero(np.isfinite(self._lower) & ~equal), -1.0),
        ):
            if chosen.size:
                side, part = cp.Parameter((stages, chosen.size)), moving[:, chosen]
                relation = part == side if off == 0.0 else off * part <= off * side
                self.constraints.append(relation)
                self._sides.append((side, chosen, off))

    def set(
        self,
        one: ConvexSet | None,
        points: Array,
        jacobian: Array | None,
        observed: NDArray[np.bool_] | None,
    ) -> None:
        """Put the numbers in; without the set if it is None.

        Rows are off where they are about components (K, d) that are not observed.
        """
        if not self.constraints:
            return
        on = np.full((points.shape[0], self._matrix.shape[0]), one is not None)
        if observed is not None:
            on &= ~((self._matrix != 0.0) & ~observed[:, None, :]).any(axis=-1)
        if self._switch is not None:
            self._switch.value = on.astype(np.float64)
        if jacobian is not None:
            products = np.where(on[:, :, None], np.matmul(self._matrix, jacobian), 0.0)
            for j, parameter in enumerate(self._jacobian):
                parameter.value = products[:, :, j]
        value = points @ self._matrix.T
        for side, chosen, off in self._sides:
            limit = self._lower if off < 0.0 else self._upper
            side.value = np.where(on, limit - value, off)[:, chosen]


def _applied(cp: Any, matrices: list[Any], d: Any) -> Any:
    """Rows J_i d_i, from the columns of J as parameters (K, rows)."""
    ones = np.ones((1, matrices[0].shape[1]))
    return sum(cp.multiply(column, d[:-1, j : j + 1] @ ones) for j, column in enumerate(matrices))


class _Term:
    """The losses of whitened residuals (K, d), times their factors, added."""

    def __init__(self, cp: Any, loss: Loss, white: Any, factors: Array) -> None:
        self.constraints: list[Any] = []
        self._scale: Any = None
        if isinstance(loss, Quadratic):
            roots = np.sqrt(factors)[:, None] * np.ones((1, white.shape[1]))
            self.value = cp.sum_squares(cp.multiply(roots, white))
            return
        if loss.per_component:
            size = cp.vec(white, order="C")
            factors = np.repeat(factors, white.shape[1])
        else:
            size = cp.norm(white, 2, axis=1)
        if isinstance(loss, Huber):
            self.value = factors @ cp.huber(size, loss.threshold)
            return
        assert isinstance(loss, Power)
        self._exponent = loss.exponent
        if loss.exponent == 1.0:
            self.value = factors @ cp.abs(size)
            return
        # value^(1/a) 1^(1 - 1/a) >= |share|, the cone itself: exponents are not made rational.
        # The scale keeps the cones near 1, without which Clarabel gives up on large powers.
        value, share = cp.Variable(factors.size), cp.Variable(factors.size)
        self._scale, self._power = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        power = 1.0 / loss.exponent
        if factors.size == 1:  # a column of one row is refused by cvxpy before 1.8
            cone = cp.PowCone3D(value[0], 1.0, share[0], power)
        else:
            cone = cp.PowCone3D(value, np.ones(factors.size), share, power)
        self.constraints = [cp.abs(size) <= self._scale * share, cone]
        self.value = self._power * (factors @ value)

    def scale_to(self, white: Array) -> None:
        """Take the size of whitened residuals as the unit."""
        if self._scale is not None:
            scale = max(1.0, float(np.abs(white).max()))
            self._scale.value, self._power.value = scale, scale**self._exponent


def _root_of(weight: Array, loss: Loss) -> Array:
    """L with W = L L^T, so that s^T W s = |s^T L|^2; zero where W is, in missing components."""
    if loss.per_component:
        return np.diag(np.sqrt(np.diag(weight)))
    there = np.flatnonzero(np.diag(weight) > 0.0)
    root = np.zeros_like(weight)
    if there.size:
        block = np.ix_(there, there)
        root[block] = np.linalg.cholesky(weight[block])
    return root


def discounts(cost: Cost, count: int) -> Array:
    """Factors of the prior, in front, and of the stages."""
    return np.asarray(cost.discount ** np.arange(count, -1.0, -1.0))
