"""Derivatives of an estimate with respect to weights, data and parameters."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.limits import FEASIBLE, STALLED
from ..estimation.problem import Problem, Solved
from ..model.second_derivatives import Curvature, SecondDerivatives
from ..terms.base import Derivatives
from .active_rows import HeldRows
from .optimality import OptimalityMatrix

Array = NDArray[np.float64]

NAMES = (
    "prior", "measurements", "inputs", "parameters", "prior_weight", "disturbance_weight",
    "noise_weight", "disturbance_weights", "noise_weights", "discount",
)


class Gradient:
    r"""The derivative of a scalar function of the trajectory with respect to all data.

    `Sensitivity.adjoint` returns it. A derivative with respect to a matrix is symmetric: for a
    symmetric change dW, the function changes by ``sum(gradient * dW)``. With respect to the
    covariance :math:`C = W^{-1}` it is :math:`-W\, (\cdot)\, W`.

    Attributes
    ----------
    prior : (..., n) array
        By the mean of the prior, z(t-N).
    measurements : (..., K, p) array
        By y of each sample of the window; zero where it is missing.
    inputs : (..., K, m) array
        By u of each sample, the estimator's parameters in the last columns.
    parameters : (..., k) array
        By the estimator's ``parameters``, changed at all samples alike.
    prior_weight : (..., n, n) array
        By the weight of the prior, also where the observer gives it.
    disturbance_weight, noise_weight : (..., r, r) and (..., p, p) array
        By the cost's weights. Samples that came with other weights do not count. Where
        the covariance of w is singular, by the weight (s, s) of its factor, see `Cost`.
    disturbance_weights, noise_weights : (..., K, r, r) and (..., K, p, p) array
        By the weights of each sample, whether usual or its own.
    discount : (...) array
        By the discount.
    """

    def __init__(self, at: _Point, adjoint: Array, forces: Array) -> None:
        # Solutions of the optimality conditions for the cotangent: of states, and of rows.
        self._at, self._adjoint = at, adjoint
        self._tangent = at.residual_tangent(adjoint)
        self._force = np.einsum("kij,...kj->...ki", at.bent, self._tangent)
        self._force += at.rows.on_residuals(forces)

    def _by(self, name: str) -> Array:
        """The derivative by data of terms."""
        at = self._at
        return np.asarray(-sum(
            one.by(name, self._adjoint, self._tangent) for one in at.terms if name in one.data
        ))

    @cached_property
    def prior(self) -> Array:
        return self._by("prior")

    @cached_property
    def measurements(self) -> Array:
        return np.asarray(-self._force[..., self._at.n :])

    @cached_property
    def inputs(self) -> Array:
        curvature, states = self._at.curvature, self._adjoint[..., :-1, :]
        found = np.einsum("...kq,kqm->...km", self._force, curvature.by_input)
        return np.asarray(found + np.einsum("...kn,knm->...km", states, curvature.mixed))

    @cached_property
    def parameters(self) -> Array:
        return np.asarray(self.inputs[..., self._at.known :].sum(axis=-2))

    @cached_property
    def prior_weight(self) -> Array:
        return self._by("prior_weight")

    @cached_property
    def _weights(self) -> Array:
        return self._by("stage_weights")

    @cached_property
    def disturbance_weights(self) -> Array:
        found: Array = self._weights[..., : -self._at.p, : -self._at.p]
        return found

    @cached_property
    def noise_weights(self) -> Array:
        found: Array = self._weights[..., -self._at.p :, -self._at.p :]
        reductions = self._at.reductions
        if reductions is None:
            return found
        return np.asarray(np.swapaxes(reductions, -1, -2) @ found @ reductions)

    @cached_property
    def disturbance_weight(self) -> Array:
        return np.asarray(self.disturbance_weights[..., self._at.usual_w, :, :].sum(axis=-3))

    @cached_property
    def noise_weight(self) -> Array:
        return np.asarray(self.noise_weights[..., self._at.usual_v, :, :].sum(axis=-3))

    @cached_property
    def discount(self) -> Array:
        at, adjoint = self._at, self._adjoint
        slopes = at.by_discount
        found = (adjoint * slopes[0]).sum(axis=(-2, -1))
        return np.asarray(-found - (self._tangent * slopes[1]).sum(axis=(-2, -1)))


class _Point:
    """J, its rows and their derivatives along an estimate; arrays are of its K stages."""

    bent: Array
    curvature: Curvature

    def __init__(self, solved: Solved, parameter_count: int) -> None:
        problem, self.cost = solved.problem, solved.formulation.cost
        trial = problem.evaluate(solved.trajectory.copy())
        if trial.violation == math.inf:
            raise InvalidInputError("the model or the cost has no finite value along the estimate.")
        if trial.violation > FEASIBLE:
            problem = problem.without_violated()
            trial = problem.evaluate(solved.trajectory.copy())
        self.problem, self.trial, self.trajectory = problem, trial, trial.trajectory
        self.residuals = trial.residuals
        count, self.n = self.trajectory.shape[0] - 1, self.trajectory.shape[1]
        self.p = self.residuals.shape[1] - self.n
        self.known = solved.formulation.system.m - parameter_count
        self.usual_w, self.usual_v = (
            np.array([getattr(one, name) is None for one in solved.conditions], np.bool_)
            for name in ("disturbance_weight", "noise_weight")
        )
        self.reductions = _reductions(solved)
        self.jacobian = _jacobian(problem, self.trajectory[:-1])
        found = [term.derivative(trial) for term in problem.terms]
        self.terms = [one for one in found if one is not None]
        self.sums = sums = Derivatives(count, self.n, self.residuals.shape[1])
        for term in self.terms:
            term.add_to(sums)
        self.rows = HeldRows(problem, solved.formulation, trial, self.jacobian)
        self.rows.settle(self.regular, self.gradient)

    def differentiate(self, second: SecondDerivatives) -> tuple[Array, Array]:
        """Set the exact second derivatives; return the blocks of the Hessian of L."""
        inputs, forces = self.problem.inputs, self.forces(self.rows.multipliers)
        self.curvature = second.at(self.trajectory[:-1], inputs, forces)
        self.bent = self.sums.bent_residuals + self.rows.penalty_bent
        own, below = self._blocks(self.sums.bent_states, self.bent)
        own[:-1] -= self.curvature.own
        own += self.rows.curvature(second.scales)
        if not all(np.isfinite(one).all() for one in (own, below, *self.curvature)):
            raise InvalidInputError(
                "the model or the cost has no finite second derivatives along the estimate."
            )
        return own, below

    def forces(self, multipliers: Array) -> Array:
        """The derivative (K, n + p) of L by the residuals."""
        found: Array = self.sums.on_residuals + self.rows.penalty_forces
        return found + self.rows.on_residuals(multipliers)

    def gradient(self, multipliers: Array) -> Array:
        """The derivative (K + 1, n) of L by the states."""
        found = self.rows.on_states(multipliers) + self.rows.penalty_on_states
        found += self.sums.on_states
        return found + self.of_states(self.forces(multipliers))

    def of_states(self, forces: Array) -> Array:
        """Derivatives (..., K + 1, n) by the states of functions with these by the residuals."""
        found = np.zeros((*forces.shape[:-2], *self.trajectory.shape))
        found[..., 1:, :] = forces[..., : self.n]
        found[..., :-1, :] -= np.einsum("kqn,...kq->...kn", self.jacobian, forces)
        return found

    def residual_tangent(self, states: Array) -> Array:
        """The change (..., K, n + p) of the residuals with the states (..., K + 1, n)."""
        change = -np.einsum("kqn,...kn->...kq", self.jacobian, states[..., :-1, :])
        change[..., : self.n] += states[..., 1:, :]
        return np.asarray(change)

    def regular(self) -> tuple[Array, Array]:
        """The blocks of the Gauss-Newton Hessian, which is positive definite."""
        sums = self.sums
        return self._blocks(
            sums.majorised_states, sums.majorised_residuals + self.rows.penalty_bent
        )

    def _blocks(self, on_states: Array, bent: Array) -> tuple[Array, Array]:
        """Diagonal blocks (K + 1, n, n), and those below them (K, n, n)."""
        n, jacobian = self.n, self.jacobian
        weighted = np.matmul(bent, jacobian)
        own = self.rows.penalty_bent_states.copy()
        own[:-1] += np.matmul(jacobian.transpose(0, 2, 1), weighted)
        own[1:] += bent[:, :n, :n]
        own += on_states
        return own, -weighted[:, :n]

    @property
    def by_discount(self) -> tuple[Array, Array]:
        """Derivatives by the discount of J's by the states themselves, and by the residuals."""
        # The newest state has the age of the newest stage.
        ages = np.append(np.arange(len(self.residuals) - 1, -1, -1.0), 0.0) / self.cost.discount
        return (
            ages[:, None] * self.rows.penalty_on_states + self.sums.aged_states,
            ages[:-1, None] * self.rows.penalty_forces + self.sums.aged_residuals,
        )


class Sensitivity:
    r"""Derivatives of an estimate, as `MovingHorizonEstimator.sensitivity` returns them.

    With the states x of the window, its data and weights :math:`\theta`, the true cost J and the
    active rows :math:`c(x, \theta) = 0`, the estimate satisfies the optimality conditions
    :math:`\partial_x L = 0,\ c = 0` of :math:`L = J + \lambda^\top c`. The implicit function
    theorem gives

    .. math::
        \begin{pmatrix} \partial_{xx} L & \partial_x c^\top \\ \partial_x c & 0 \end{pmatrix}
        \begin{pmatrix} \mathrm d x \\ \mathrm d \lambda \end{pmatrix}
        = - \begin{pmatrix} \partial_{x\theta} L \\ \partial_\theta c \end{pmatrix}
        \mathrm d \theta

    with the exact Hessian, second derivatives of the model and of the losses included. The
    matrix is banded: it is factored once, in O(N n^3), and each derivative is one solve.

    The prior's mean and weight are data here: their dependence on the weights, through the observer
    before the window, is not included. The attributes of `Gradient` are also available here, as
    derivatives of the whole trajectory, (N_t + 1, n, ...) with their shapes behind. They take one
    solve per state; `adjoint` takes one, and `along` one per direction.

    Attributes
    ----------
    trajectory : (N_t + 1, n) array
        The estimate that was differentiated.
    converged : bool
        Whether the estimate is a minimiser: a Newton step would lower J by less than a thousand
        times the estimator's ``tolerance``, and the second-order condition holds.
    step : (N_t + 1, n) array
        The Newton step from the trajectory to the minimiser, in the states' units.
    active : tuple of ActiveRow
        The active rows, with their multipliers. Noise-free directions are not listed.
    weakly_active : tuple of ActiveRow
        Rows at which the derivative jumps: at their side, with a multiplier near zero.
    exact : bool
        Whether the model's second derivatives are exact, and not differences of its Jacobians.
    warning : str
        Why the derivatives need care; blank if they do not.
    """

    def __init__(
        self, solved: Solved, second: SecondDerivatives, tolerance: float, parameter_count: int
    ) -> None:
        self._at = at = _Point(solved, parameter_count)
        blocks = at.differentiate(second)
        rows, trial, problem = at.rows, at.trial, at.problem
        # A positive definite Hessian gives the units.
        typical = np.diagonal(at.regular()[0], axis1=1, axis2=2)
        self._matrix = matrix = OptimalityMatrix(
            *blocks, rows.stage, rows.on_own, rows.on_next, typical
        )
        self.trajectory: Array = trial.trajectory
        side = -at.gradient(rows.multipliers)[None], -rows.gaps[None]
        self.step: Array = matrix.solve(*side)[0][0]
        decrease = 0.5 * abs(matrix.square(self.step))
        most = max(STALLED * tolerance * abs(trial.cost), problem.rounding_cost(trial))
        small = math.isfinite(trial.cost) and decrease <= most
        self.converged: bool = small and matrix.definite
        self.active, self.weakly_active = rows.named(problem.time)
        self.exact: bool = second.exact
        self.warning: str = self._warning(decrease, trial.cost, small)

    def __getattr__(self, name: str) -> Array:
        if name not in NAMES:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        found: Array = getattr(self._whole, name)
        return found

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *NAMES]

    def __repr__(self) -> str:
        text = f"Sensitivity of {len(self.trajectory)} states, {len(self.active)} rows active"
        return f"{text}. {self.warning}".strip()

    @cached_property
    def _whole(self) -> Gradient:
        """The derivatives of each number of the trajectory."""
        shape = self.trajectory.shape
        return self.adjoint(np.eye(self.trajectory.size).reshape(*shape, *shape))

    def _warning(self, decrease: float, cost: float, small: bool) -> str:
        said = []
        if not small:
            said.append(
                f"The estimate has not converged: a Newton step would lower J = {cost:.6g} by "
                f"{decrease:.3g}. The derivatives match the minimiser's only "
                "to first order in `step`; take max_qps=None, or a smaller tolerance."
            )
        if not self._matrix.definite:
            said.append(
                "The Hessian of J is not positive definite on the active rows: the estimate is not "
                "a strict minimiser, and the derivatives may not exist."
            )
        if self.weakly_active:
            said.append(
                "Weakly active, so that the derivative jumps there: "
                f"{', '.join(map(str, self.weakly_active))}."
            )
        return " ".join(said)

    def adjoint(self, cotangent: ArrayLike) -> Gradient:
        """The derivative of a function of the trajectory, from its gradient there; one solve.

        Parameters
        ----------
        cotangent : (..., N_t + 1, n) or (n,) array_like
            The function's gradient: by the whole trajectory, or by the newest state alone. Leading
            dimensions stand for several functions at once.

        Returns
        -------
        Gradient
            Its derivatives, with the leading dimensions of the cotangent in front.

        Raises
        ------
        ShapeError
            If the cotangent has another shape.
        """
        given = numbers("cotangent", cotangent)
        shape = self.trajectory.shape
        if given.shape == shape[1:]:
            newest, given = given, np.zeros(shape)
            given[-1] = newest
        if given.shape[-2:] != shape:
            raise ShapeError(
                f"cotangent has shape {given.shape}; expected (..., {shape[0]}, {shape[1]}), as "
                f"the trajectory, or ({shape[1]},) for the newest state alone."
            )
        lead = given.shape[:-2]
        states, forces = self._matrix.solve(given.reshape(-1, *shape))
        return Gradient(self._at, states.reshape(given.shape), forces.reshape(*lead, -1))

    def along(self, **changes: ArrayLike) -> Array:
        """The derivative of the trajectory along a change; one solve for each.

        For a weight that depends on k parameters, for instance, pass its derivatives dR (k, p, p):
        ``along(noise_weight=dR)``.

        Parameters
        ----------
        **changes : array_like
            Changes by the names and shapes of `Gradient`, with the same leading dimensions; changes
            of matrices are symmetric. Several names change together.

        Returns
        -------
        (..., N_t + 1, n) array
            The change of the trajectory.

        Raises
        ------
        OptionError, ShapeError
            If a name or a shape is wrong.
        """
        at = self._at
        lead, given = self._checked(changes)
        count, n, p = len(at.residuals), at.n, at.p
        # The change of the residuals, of the slopes of J by them, and by the states themselves.
        moved, slopes = np.zeros((*lead, count, n + p)), np.zeros((*lead, count + 1, n))
        moved[..., n:] += given["measurements"]
        known = given["inputs"]
        known[..., at.known :] += given["parameters"][..., None, :]
        moved -= np.einsum("kqm,...km->...kq", at.curvature.by_input, known)
        slopes[..., :-1, :] -= np.einsum("knm,...km->...kn", at.curvature.mixed, known)
        forces = np.einsum("kij,...kj->...ki", at.bent, moved)
        w, v = given["disturbance_weights"], given["noise_weights"]
        w += at.usual_w[:, None, None] * given["disturbance_weight"][..., None, :, :]
        v += at.usual_v[:, None, None] * given["noise_weight"][..., None, :, :]
        if at.reductions is not None:
            v = at.reductions @ v @ np.swapaxes(at.reductions, -1, -2)
        r = w.shape[-1]
        weights = np.zeros((*lead, count, r + p, r + p))
        weights[..., :r, :r], weights[..., r:, r:] = w, v
        for term in at.terms:
            term.change({**given, "stage_weights": weights}, slopes, forces)
        by_discount, change = at.by_discount, given["discount"][..., None, None]
        slopes += change * by_discount[0]
        slopes += at.of_states(forces + change * by_discount[1])
        gaps = at.rows.of_residuals(moved)
        size = math.prod(lead)
        found, _ = self._matrix.solve(-slopes.reshape(size, count + 1, n), -gaps.reshape(size, -1))
        return found.reshape(slopes.shape)

    def _checked(self, changes: dict[str, ArrayLike]) -> tuple[tuple[int, ...], dict[str, Array]]:
        """The leading dimensions of changes, and all changes: zeros where none was given."""
        lead: tuple[int, ...] | None = None
        unknown = sorted(set(changes) - set(NAMES))
        if unknown or not changes:
            raise OptionError(
                f"along was given {', '.join(unknown) or 'nothing'}; expected changes of one or "
                f"more of {', '.join(NAMES)}."
            )
        none = self.adjoint(np.zeros(self.trajectory.shape))
        shapes = {name: getattr(none, name).shape for name in NAMES}
        found = {}
        for name, change in changes.items():
            given, shape = numbers(name, change), shapes[name]
            first = given.shape[: given.ndim - len(shape)]
            if given.shape != first + shape or lead not in (None, first):
                raise ShapeError(
                    f"{name} has shape {given.shape}; expected (..., {str(shape)[1:]}, with the "
                    "same leading dimensions in all changes."
                )
            lead, found[name] = first, given.copy()
        assert lead is not None
        return lead, {name: found.get(name, np.zeros(lead + shapes[name])) for name in NAMES}


def _jacobian(problem: Problem, states: Array) -> Array:
    """The Jacobians (K, n + p, n) of f and h along states."""
    model = problem.model
    try:
        slopes = [np.asarray(one) for one in model.evaluation.linear(states, problem.inputs)]
    except Exception as error:
        raise InvalidInputError(
            f"the model has no Jacobians along the estimate: {error}"
        ) from error
    return np.concatenate(slopes, axis=1)


def _reductions(solved: Solved) -> Array | None:
    """`Cost.reduction` of each sample (K, p, p); None where nothing is missing."""
    observed, cost = solved.problem.observed, solved.formulation.cost
    if observed is None:
        return None
    return np.array([
        cost.reduction(there, own.noise_weight)
        for there, own in zip(observed, solved.conditions, strict=True)
    ])
