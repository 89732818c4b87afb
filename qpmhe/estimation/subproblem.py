"""The convex QP of P_t, linearised around a trajectory."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus
from qpmhe_solvers.solver import ContainedSolver

from ..model.functions import raised_along
from ..model.residuals import difference
from ..model.system import System
from ..terms.base import QuadraticModel, Term, Trial
from ..terms.forms import WholeForm
from ..terms.linearization import Span
from ..terms.rows import Rows
from ..terms.soft import BEYOND, Penalties, Softened
from ..terms.sum import diagonal_of_first, rows_of_first
from .constraints import Constraints
from .elimination import SINGULAR, Around, Eliminated, Elimination
from .limits import RIDGE
from .problem import Problem
from .region import Metric

Array = NDArray[np.float64]

_EPSILON = float(np.finfo(np.float64).eps)
# Share of the diagonal that is rounding for any factorisation.
_LOST = 1e-13


class Subproblem:
    r"""Gauss-Newton QPs in the increments d of a trajectory.

    The objective is half of J with linearised residuals (see `StageTerms`): its gradient
    at d = 0 is that of J/2, its Hessian the Gauss-Newton one. Sets become

    - bounds on d, and rows on ``x_i + d_i``, from X;
    - rows on ``w_i + d_{i+1} - A_i d_i`` from W and on ``v_i - C_i d_i`` from V; a direction
      without disturbance gives an equality row, which `solve` eliminates;
    - rows on the linearised nonlinear constraints.

    Soft rows are not among them: `directly` and, with slack variables, `softened` add these, where
    a solution without them violates one.

    `damp` adds :math:`\tfrac\mu2 (|d_0|_D^2 + \sum_i |d_{i+1} - A_i d_i|_{Q_i}^2)` to the
    objective: it rescales the weights of the prior and of the disturbances, has no unit, and leaves
    the gradient at d = 0. D is the diagonal of what prior and data say about d_0 where the
    disturbances are free (Marquardt's scaling, SIAM Journal on Applied Mathematics 11, 1963, of the
    condensed problem): it does not grow with Q, as the diagonal of the QP's Hessian does.

    There is one QP, of the present window length; each use overwrites it.
    """

    def __init__(
        self, system: System, constraints: Constraints, horizon: int,
        penalties: Penalties | None = None, form: WholeForm | None = None,
    ) -> None:
        from scipy.linalg.lapack import dpbtrf  # late: twice the cost of importing NumPy

        n, p = system.n, system.p
        self._n, self._p, self._pbtrf = n, p, dpbtrf
        self._form = form or WholeForm(n, p)
        self._terms = self._form.terms(horizon)
        states, w, v = constraints.states, constraints.disturbances, constraints.noises
        # Bounds of states are the QP's own.
        self._x_rows = states.matrix[states.bounds :] if states else np.empty((0, n))
        self._w_rows = w.matrix if w else np.empty((0, n))
        self._v_rows = v.matrix if v else np.empty((0, p))
        g = constraints.constraints
        self._g_rows = np.empty(0, np.intp) if g is None else g.components
        sizes = (len(one) for one in (self._w_rows, self._v_rows, self._x_rows, self._g_rows))
        ends = np.cumsum([0, *sizes])
        self._rows = int(ends[-1])
        self._w, self._v, self._x, self._g = (slice(a, b) for a, b in pairwise(ends))
        self._penalties = penalties
        self._softened = None if penalties is None else penalties.softened
        # Of the directions without disturbance, if there are any.
        self._elimination: Elimination | None = None
        if w is not None and w.fixed.any():
            self._elimination = Elimination(constraints, n, p)
        self._around: Around  # what that reads of the present QP
        self._eliminated: Eliminated | None = None  # the last QP without them
        self._along: Softened | None = None  # its soft rows, once they are needed
        self._functions = system.constraints
        #: Whether QPs have inequalities.
        self.has_inequalities: bool = constraints.has_inequalities or penalties is not None
        #: Whether there are soft rows or nonlinear constraints.
        self.extended: bool = self._functions is not None or penalties is not None
        # Multipliers of the nonlinear constraints in the last QP of the sequence, (K + 1, T).
        self._forces: Array | None = None
        self._qp: QP | None = None
        self._terms_of_cost: tuple[Term, ...] = ()  # of the present QP
        self._has_ridge = False
        # Its band without damping or ridge, once it has one; and the band of the damping, with the
        # trial around which that is.
        self._undamped: Array | None = None
        self._damping: Array
        self._information: Array  # the diagonal D
        self._damped_trial: Trial | None = None
        #: Why `at` returned None the last time.
        self.failure = ""
        self._model: QuadraticModel  # of the present QP

    def at(self, problem: Problem, trial: Trial) -> QP | None:
        """The QP around a trajectory; None, and why in `failure`, where the Jacobians fail.

        The window holds the candidate's terms already.
        """
        if trial.trajectory is problem.candidate.trajectory:
            return self._assemble(problem, trial, problem.span, True)
        states, terms, model = trial.trajectory[:-1], self._terms, problem.model
        count = states.shape[0]
        try:
            slopes = terms.linearise(model.evaluation, states, problem.inputs)
        except Exception as error:  # a user's Jacobian outside its domain
            self.failure = raised_along(
                error,
                {"the Jacobian of f": model.f_jacobian, "the Jacobian of h": model.h_jacobian},
                states,
                problem.inputs,
            )
            return None
        if not np.isfinite(np.square(slopes).sum()):
            self.failure = "the Jacobian of f or h is not finite along the trajectory."
            return None
        terms.residuals[:count] = trial.residuals
        terms.set_all(count, trial.weights)
        return self._assemble(problem, trial, Span(terms, 0, count), False)

    def damp(self, qp: QP, problem: Problem, trial: Trial, mu: float) -> None:
        """Give the QP that is around a trial this much damping."""
        if self._damped_trial is not trial:
            self._damping, self._damped_trial = self._damping_band(problem, trial), trial
        if self._undamped is None:
            self._undamped = qp.band.copy()
        np.multiply(self._damping, mu, out=qp.band)
        qp.band += self._undamped
        self._has_ridge = False
        if self._elimination is not None:
            rows, side = rows_of_first(problem.terms, trial)
            added = np.diag(np.sqrt(mu * self._information))
            self._around.damping = mu
            self._around.first = (
                np.concatenate((rows, added)), np.append(side, np.zeros(len(added)))
            )

    def _damping_band(self, problem: Problem, trial: Trial) -> Array:
        """The band that a damping of 1 adds."""
        form, information = self._form, self.metric(problem, trial).information
        band = form.damping(self._minus_jacobian, trial.weights)
        form.diagonal_of(band[0])[...] += information
        self._information = information
        return band

    def metric(self, problem: Problem, trial: Trial) -> Metric:
        """The metric of the damping of the QP that is around a trial."""
        form, slopes, weights = self._form, self._minus_jacobian, trial.weights
        freed = form.freed(slopes, weights, lambda: problem.constraints.basis)
        information = diagonal_of_first(problem.terms, trial)
        found = information + freed.information
        if np.isfinite(found).all():
            information = found
        return Metric(form, slopes, weights, freed.spread, information)

    def nearest_point(self, problem: Problem, trial: Trial) -> QP | None:
        """The QP for the nearest trajectory that satisfies the linearised sets; None as in `at`.

        Its metric is the Gauss-Newton Hessian of J.
        """
        self._forces, forces = None, self._forces
        qp = self.at(problem, trial)
        self._forces = forces
        if qp is not None:
            qp.gradient[...] = 0.0
            if self._elimination is not None:
                around = self._around
                around.residuals = np.zeros_like(around.residuals)
                around.first = around.first[0], np.zeros_like(around.first[1])
        return qp

    def solve(self, qp: QP, solver: ContainedSolver, limit: float | None) -> Solution:
        """Solve a QP by a backend, within a time limit in seconds."""
        if self._elimination is None or qp is not self._qp:
            return solver.solve(qp, None, limit)
        eliminated = self._eliminated = self._elimination.of(self._around, qp, self._w)
        self._along = None
        if eliminated is None:
            return Solution(None, SolveStatus.FAILED, 0, message=SINGULAR)
        found = eliminated.solution
        if found is None:
            found = eliminated.restored(solver.solve(eliminated.qp, None, limit))
        return found

    def give_ridge(self, qp: QP) -> bool:
        """Give a QP whose Hessian is singular up to rounding a ridge; whether it has got one.

        Vague priors, and weights that a loss takes from outliers, leave such a Hessian. Whether it
        has a factor, and where a solver stops, is then rounding.
        """
        if self._has_ridge or qp is not self._qp or self._elimination is not None:
            return False
        diagonal, less = qp.diagonal, np.array(qp.lapack_band, order="F")
        less[0] -= _LOST * less[0]
        if self._pbtrf(less, lower=1, overwrite_ab=1)[1] == 0:
            return False
        self._has_ridge = True
        if self._undamped is None:
            self._undamped = qp.band.copy()
        weights = np.zeros_like(diagonal)
        for term in self._terms_of_cost:
            term.add_weights(weights)
        diagonal += RIDGE * diagonal + _EPSILON * weights
        return True

    def correct_rows(self, qp: QP, problem: Problem, around: Trial, trial: Trial) -> None:
        """Shift the rows of the QP around a trajectory by its linearisation error at a trial.

        With the same matrices, W and V then hold for the true residuals of a point near the
        trial up to third order: a second-order correction. The rows are also tightened: by a
        share of the shift, for the third order, and by twice what the solver's step misses.
        """
        n = self._n
        step = difference(problem.model.state_residual, trial.trajectory, around.trajectory)
        linearised = around.residuals + np.matmul(self._minus_jacobian, step[:-1, :, None])[:, :, 0]
        linearised[:, :n] += step[1:]
        curvature = trial.residuals - linearised
        if problem.wraps:
            problem.wrap(curvature, trial.trajectory)
        bent = None if trial.values is None else self._bent(qp, around, trial, step)
        if self._softened is not None and self._penalties is not None:
            values = self._penalties.values(trial.trajectory, trial.residuals, trial.values)
            self._softened.bend(values, step, curvature)
        values = qp.rows_times(step)
        missed = np.maximum(qp.row_lower - values, values - qp.row_upper)
        margin = 2.0 * np.maximum(missed, 0.0)
        margin[:-1, self._w] += BEYOND * np.abs(curvature[:, :n] @ self._w_rows.T)
        margin[:-1, self._v] += BEYOND * np.abs(curvature[:, n:] @ self._v_rows.T)
        if bent is not None and around.values is not None:
            margin[:, self._g] += BEYOND * np.abs(bent[:, self._g_rows])
            bent += around.values
        self._set_rows(qp, problem, around.residuals + curvature, around.trajectory, bent)
        inwards = np.where(qp.row_upper - qp.row_lower > 4.0 * margin, margin, 0.0)
        qp.row_lower += inwards
        qp.row_upper -= inwards

    def _bent(self, qp: QP, around: Trial, trial: Trial, step: Array) -> Array:
        """The linearisation error (K + 1, T) of the nonlinear constraints at a trial."""
        assert trial.values is not None
        assert around.values is not None
        bent = np.zeros(trial.values.shape)
        change = trial.values - around.values
        bent[:, self._g_rows] = change[:, self._g_rows] - qp.rows_times(step)[:, self._g]
        return np.where(np.isfinite(bent), bent, 0.0)

    def misses(self, solution: Solution) -> bool:
        """Whether a solution without the soft rows misses one of them."""
        soft, d = self._softened, solution.d
        return soft is not None and d is not None and bool(soft.misses(d).any())

    def directly(self, qp: QP, deadline: float) -> Solution | None:
        """The solution with the soft rows, without slack variables; None where it is not found."""
        base, soft = self._with_soft_rows(qp)
        found = soft.directly(base, deadline)
        return None if found is None else self._restored(qp, base, soft, found)

    def softened(self, qp: QP) -> QP:
        """The QP with slack variables."""
        base, soft = self._with_soft_rows(qp)
        return soft.lifted(base)

    def lowered(self, qp: QP, solution: Solution, deadline: float) -> Solution:
        """A solution of the QP with slack variables, as one of the QP without."""
        base, soft = self._with_soft_rows(qp)
        return self._restored(qp, base, soft, soft.lowered(base, solution, deadline))

    def _with_soft_rows(self, qp: QP) -> tuple[QP, Softened]:
        """The QP that the soft rows join, and these, after noise-free directions have left."""
        soft, eliminated = self._softened, self._eliminated
        assert soft is not None
        if eliminated is None:
            return qp, soft
        if self._along is None:
            self._along = soft.along(eliminated.step, eliminated.along)
        return eliminated.qp, self._along

    def _restored(self, qp: QP, base: QP, soft: Softened, found: Solution) -> Solution:
        """A solution with the soft rows in all unknowns, whose multipliers are kept."""
        forces = soft.forces(base, found)
        if self._eliminated is not None:
            found = self._eliminated.restored(found)
        self._note(qp, found, forces)
        return found

    def start(self) -> None:
        """Start a new sequence of QPs, with unknown multipliers."""
        self._forces = None
        if self._softened is not None:
            self._softened.start()

    def note(self, qp: QP, solution: Solution) -> None:
        """Take a solution's multipliers: the next QP has the curvature of active constraints."""
        if self._functions is not None:
            self._note(qp, solution, np.zeros((qp.stages, self._functions.size)))

    def _note(self, qp: QP, solution: Solution, forces: Array | None) -> None:
        self._forces = None  # those of an older QP may be far too large
        if forces is not None:
            if solution.row_duals is not None:
                hard = solution.row_duals.reshape(qp.stages, -1)[:, self._g]
                forces[:, self._g_rows] = np.maximum(hard, 0.0)
            if forces.any() and np.isfinite(forces).all():
                self._forces = forces

    def predicted(self, qp: QP, best: Trial, step: Array) -> float:
        """The decrease of J that the QP predicts for its step."""
        if self._softened is None:
            return abs(float(np.vdot(qp.gradient, step)))
        decrease = best.penalty - 2.0 * qp.objective(step) - self._softened.penalty(step)
        return max(decrease, 0.0)

    def forget(self) -> None:
        """Rebuild the QP at its next use, since an interrupt may have left it half written."""
        self._qp = None

    def _assemble(self, problem: Problem, trial: Trial, span: Span, is_candidate: bool) -> QP:
        stages, qp = len(trial.trajectory), self._qp
        self._undamped, self._has_ridge = None, False
        self._terms_of_cost = problem.terms
        if qp is None or qp.stages != stages:
            qp = self._new_qp(stages)
        self._minus_jacobian, functions, slopes = span.minus_jacobian, self._functions, None
        if functions is not None:
            along = trial.trajectory, problem.inputs, trial.residuals, span.minus_jacobian
            slopes = functions.linearised(*along)
        model = self._model
        model.span, model.is_candidate, model.slopes = span, is_candidate, slopes
        for term in problem.terms:
            term.add_model(model, trial)
        forces, curvature = self._forces, None
        if functions is not None and forces is not None and len(forces) == stages:
            curvature = self._add_curvature(qp, *functions.curvature(*along, forces))
        if self._elimination is not None:
            first = rows_of_first(problem.terms, trial)
            self._around = Around(span.minus_jacobian, trial.residuals, trial.weights, first)
            self._around.curvature = curvature
        if problem.constrained:
            self._set_inequalities(qp, problem, trial, slopes)
        return qp

    def _add_curvature(
        self, qp: QP, own: Array, below: Array, following: Array
    ) -> tuple[Array, Array]:
        n, band = self._n, qp.band
        own[1:] += following
        for c in range(n):
            band[:, c, : n - c] += own[:, c:, c]
            band[:-1, c, n - c : 2 * n - c] += below[:, :, c]
        return own, below

    def _new_qp(self, stages: int) -> QP:
        """A QP of another length in place of the present one."""
        self._qp = qp = self._form.qp(stages, self._rows)
        qp.bounded = False  # until there are bounds
        if self._rows:
            qp.row_next[:-1, self._w] = self._w_rows
            qp.row_own[:, self._x] = self._x_rows
        self._model = QuadraticModel(qp)
        return qp

    def _set_inequalities(
        self, qp: QP, problem: Problem, trial: Trial, slopes: tuple[Array, Array] | None
    ) -> None:
        n, states = self._n, problem.constraints.states
        qp.bounded = states is not None and bool(states.bounds)
        if states is not None and qp.bounded:
            bounds, components = slice(0, states.bounds), states.components
            points = trial.trajectory[:, components]
            qp.lower[...], qp.upper[...] = -np.inf, np.inf
            qp.lower[:, components] = states.lower[..., bounds] - points
            qp.upper[:, components] = states.upper[..., bounds] - points
        if self._rows:
            minus = self._minus_jacobian
            np.matmul(self._w_rows, minus[:, :n], out=qp.row_own[:-1, self._w])
            np.matmul(self._v_rows, minus[:, n:], out=qp.row_own[:-1, self._v])
            if slopes is not None and trial.values is not None:
                own, following = (one[:, self._g_rows] for one in slopes)
                usable = np.isfinite(own).all(axis=2) & np.isfinite(trial.values[:, self._g_rows])
                usable[:-1] &= np.isfinite(following).all(axis=2)
                # A row that cannot be linearised here is left out; the true problem has it.
                self._left_out = ~usable
                qp.row_own[:, self._g] = np.where(usable[:, :, None], own, 0.0)
                qp.row_next[:-1, self._g] = np.where(usable[:-1, :, None], following, 0.0)
            self._set_rows(qp, problem, trial.residuals, trial.trajectory, trial.values)

    def _set_rows(
        self, qp: QP, problem: Problem, residuals: Array, trajectory: Array, values: Array | None
    ) -> None:
        n, constraints = self._n, problem.constraints
        for place, rows, points in (
            (self._w, constraints.disturbances, residuals[:, :n]),
            (self._v, constraints.noises, residuals[:, n:]),
            (self._x, constraints.states, trajectory),
        ):
            if rows is not None and place.start < place.stop:
                _set_sides(qp, place, rows, points)
        if constraints.constraints is not None and values is not None:
            _set_sides(qp, self._g, constraints.constraints, values)
            qp.row_upper[:, self._g][self._left_out] = np.inf


def _set_sides(qp: QP, place: slice, rows: Rows, points: Array) -> None:
    """Write the sides of a set's rows that are rows of the QP: the last ones, or all of them."""
    values, stages = rows.values(points), slice(0, len(points))
    last = slice(values.shape[1] - (place.stop - place.start), None)
    qp.row_lower[stages, place] = (rows.lower - values)[:, last]
    qp.row_upper[stages, place] = (rows.upper - values)[:, last]
