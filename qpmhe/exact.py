"""The convex subproblem with the cost as it is, where a QP would majorise it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import SolveStatus

from .costs import Cost, Huber, Loss, Power, Quadratic, QuadraticCost, RobustCost
from .errors import OptionError
from .estimation.problem import Problem, Trial
from .exact_program import ExactProgram, discounts
from .model.system import System

__all__ = ["ExactSolution", "ExactStep"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ExactSolution:
    """What came of one convex subproblem.

    Parameters
    ----------
    d : (K + 1, n) array or None
        The increments; None exactly when the status is FAILED.
    status : SolveStatus
        SOLVED as the solver says, STOPPED for an iterate without its word, or FAILED.
    predicted : float
        The true cost of the linearised residuals at d, recomputed; NaN without d. The step
        promises to lower J from the trial's cost to this.
    iterations : int or None
        The solver's own count.
    message : str
        What went wrong.
    """

    d: Array | None
    status: SolveStatus
    predicted: float = float("nan")
    iterations: int | None = None
    message: str = ""

    @property
    def solved(self) -> bool:
        """Whether the solver reports an optimum."""
        return self.status is SolveStatus.SOLVED


class ExactStep:
    r"""Minimise the true convex losses of the linearised residuals.

    .. math::
        \min_d\; \gamma^K \rho_p(x_0 + d_0 - \bar x)
        + \sum_{i<K} \gamma^{K-1-i} l(r_i + E d_{i+1} - G_i d_i)

    in the increments d of a trajectory, with :math:`r_i = (w_i, v_i)`,
    :math:`G_i = [A_i; C_i]` and :math:`E = [I; 0]`, subject to the sets as in `Subproblem`:
    exact on the states, linearised on disturbances and noises. Where `Subproblem` puts
    quadratic forms that touch the losses at the trajectory, this keeps the losses, so that
    one step does what a sequence of reweighted QPs converges to.

    The program is stated once for each window length, and afterwards only its parameters
    are set. Clarabel solves it. Where y is missing, its loss and the rows of V that it is
    in are left out.

    Parameters
    ----------
    system : System
        Dimensions and sets.
    cost : QuadraticCost or RobustCost
        The cost, with losses of this library.

    Raises
    ------
    OptionError
        If a loss is not `Quadratic`, `Huber` or `Power`.
    """

    def __init__(self, system: System, cost: Cost) -> None:
        import cvxpy  # late: it takes a second

        self._cp: Any = cvxpy
        self._system, self._cost, self._losses = system, cost, _losses(cost)
        self._programs: dict[int, ExactProgram] = {}

    def prepare(self, count: int) -> None:
        """State and compile the program of windows with this many stages.

        Parameters
        ----------
        count : int
            K.
        """
        if count in self._programs:
            return
        program = ExactProgram(self._cp, self._system, self._cost, self._losses, count)
        for parameter in program.problem.parameters():
            parameter.value = np.zeros(parameter.shape)
        program.problem.get_problem_data(self._cp.CLARABEL, enforce_dpp=True)
        self._programs[count] = program

    def solve(
        self, problem: Problem, trial: Trial, jacobian: Array, time_limit: float | None = None
    ) -> ExactSolution:
        """Solve the subproblem around a trial; never raises an `Exception`.

        Parameters
        ----------
        problem : Problem
            The problem, bound to the window; sets that it leaves out are left out here.
        trial : Trial
            The trajectory to linearise at.
        jacobian : (K, n + p, n) array
            Jacobians of (f, h) at its first K states.
        time_limit : float, optional
            Seconds for Clarabel, > 0.
        """
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                return self._solve(problem, trial, jacobian, time_limit)
        except Exception as error:  # the wall: whatever the modelling layer or solver raises
            return _failed(f"{type(error).__name__}: {error}")

    def _solve(
        self, problem: Problem, trial: Trial, jacobian: Array, time_limit: float | None
    ) -> ExactSolution:
        data = (trial.trajectory, trial.residuals, jacobian, problem.prior, problem.stage_weights)
        if not all(np.isfinite(array).all() for array in data):
            return _failed("the subproblem's data are not finite")
        self.prepare(jacobian.shape[0])
        program = self._programs[jacobian.shape[0]]
        program.set(problem, trial, jacobian)
        d, status, iterations, message = program.solve(time_limit)
        if d is None:
            return ExactSolution(None, status, iterations=iterations, message=message)
        predicted = self._predicted(problem, trial, jacobian, d)
        return ExactSolution(d, status, predicted, iterations, message)

    def _predicted(self, problem: Problem, trial: Trial, jacobian: Array, d: Array) -> float:
        linear = trial.residuals - np.matmul(jacobian, d[:-1, :, None])[:, :, 0]
        linear[:, : self._system.n] += d[1:]
        costs = self._cost.stage_costs(linear, problem.stage_weights)
        offset = trial.trajectory[0] + d[0] - problem.prior
        prior = self._cost.prior_cost(offset, problem.prior_weight)
        factors = discounts(self._cost, linear.shape[0])
        return float(factors[0]) * prior + float(factors[1:].dot(costs))


def _losses(cost: Cost) -> tuple[Loss, Loss, Loss]:
    if isinstance(cost, QuadraticCost):
        plain = Quadratic(np.eye(cost.n))
        return plain, plain, Quadratic(np.eye(cost.p))
    if not isinstance(cost, RobustCost):
        raise OptionError(
            f"cost is {cost!r}; the exact subproblem needs a QuadraticCost or a RobustCost. "
            "Take the QP for others."
        )
    losses = cost.prior_loss, cost.disturbance_loss, cost.noise_loss
    for loss in losses:
        # A subclass may have changed the function.
        if type(loss) not in (Quadratic, Huber, Power):
            raise OptionError(
                f"the loss {type(loss).__name__} cannot be stated as a convex program; expected "
                "Quadratic, Huber or Power. Take the QP for others."
            )
    return losses


def _failed(message: str) -> ExactSolution:
    return ExactSolution(None, SolveStatus.FAILED, message=message)
