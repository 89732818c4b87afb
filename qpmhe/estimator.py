"""The moving horizon estimator (Definition def:estimator)."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import SolverOptions, create

from ._checks import count, positive, vector
from .costs import ObserverPrior, QuadraticCost
from .errors import InvalidInputError, OptionError, ShapeError
from .estimate import Estimate, Status
from .observers import Observer
from .optimizer import Optimizer
from .problem import Problem
from .run import Run
from .subproblem import Subproblem
from .system import System
from .window import Window

__all__ = ["MovingHorizonEstimator"]

Array = NDArray[np.float64]

# With max_qps=None the sequence ends by convergence; this bounds it where that fails.
_SAFETY_LIMIT = 100


class MovingHorizonEstimator:
    r"""Suboptimal moving horizon estimation with an observer-based candidate.

    At each measurement the auxiliary observer is advanced; its last N steps are a feasible
    candidate for the estimation problem (eq:optiMHE) and its state z(t-N) is the prior. A
    sequence of convex QPs then improves the candidate. An iterate is taken only if it
    satisfies the constraints and its true cost J is no greater than the candidate's
    (eq:estimator); otherwise the candidate is the estimate. Under the assumptions of the
    paper's theorem this is robustly exponentially stable for every horizon, solver and cap.

    Parameters
    ----------
    system : System
        The model and its sets.
    observer : Observer
        The auxiliary observer, such as `Luenberger`.
    cost : QuadraticCost
        Weights of prior, disturbances and noises.
    horizon : int
        N >= 1. Until N samples are there, all of them are used (Remark rem:emtpyN).
    initial_state : (n,) array_like
        Initial estimate, at the time of the first measurement.
    backend : str
        QP solver, one of ``qpmhe.solvers.available()``. ``auto`` uses a banded Cholesky
        factorisation and another solver only where inequalities bind; a named backend is
        always really used.
    max_qps : int or None
        QPs per sample, the paper's i; 0 gives the observer. None goes on to convergence,
        at most 100.
    max_solver_iterations : int or None
        Cap on the solver's own iterations in each QP; None leaves the solver's default.
    solver_tolerance : float
        Absolute tolerance on the QP's residuals.
    tolerance : float
        The sequence of QPs has converged when a QP that was solved lowers J by less than
        this share of it.
    engine : {"python"}
        How the step is carried out.

    Raises
    ------
    InvalidInputError
        If anything does not fit; subclasses tell what (see `qpmhe.errors`).

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> system = qpmhe.System(lambda x: 0.9 * x, lambda x: x, n=1, p=1)
    >>> cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    >>> mhe = qpmhe.MovingHorizonEstimator(
    ...     system, qpmhe.Luenberger([0.3]), cost, horizon=5, initial_state=[0.0])
    >>> estimate = mhe.update([1.0])
    >>> estimate.improved
    True
    """

    def __init__(
        self,
        system: System,
        observer: Observer,
        cost: QuadraticCost,
        *,
        horizon: int,
        initial_state: ArrayLike,
        backend: str = "auto",
        max_qps: int | None = 1,
        max_solver_iterations: int | None = None,
        solver_tolerance: float = 1e-7,
        tolerance: float = 1e-9,
        engine: str = "python",
    ) -> None:
        _is(system, System, "system", "qpmhe.System")
        _is(observer, Observer, "observer", "qpmhe.Luenberger or another observer")
        _is(cost, QuadraticCost, "cost", "qpmhe.QuadraticCost")
        if engine != "python":
            raise OptionError(f"engine is {engine!r}; expected 'python', the only one there is.")
        self.horizon = count("horizon", horizon, 1)
        self.max_qps = max_qps
        qps = _SAFETY_LIMIT
        if max_qps is not None:
            qps = count("max_qps", max_qps, 0, " None stands for convergence.")
        self.system, self.observer, self.cost = system, observer, cost
        if (cost.n, cost.p) != (system.n, system.p):
            raise ShapeError(
                f"the cost is for {cost.n} states and {cost.p} outputs; expected {system.n} "
                f"and {system.p}, the system's."
            )
        self.initial_state: Array = vector("initial_state", initial_state, system.n)
        system.check(self.initial_state, np.zeros(system.m))
        observer.check(system, self.initial_state)
        if isinstance(cost.prior, ObserverPrior) and observer.initial_covariance() is None:
            raise InvalidInputError(
                f"the prior weight is to come from the observer, but {type(observer).__name__} "
                "has no covariance; take qpmhe.ExtendedKalman, or give a constant weight."
            )
        self.backend = backend
        solver = create(
            backend,
            SolverOptions(
                max_iterations=max_solver_iterations,
                absolute_tolerance=positive("solver_tolerance", solver_tolerance),
            ),
        )
        self._linearized = qps > 0
        self._subproblem = Subproblem(system, cost, self.horizon)
        self._problem = Problem(system, cost)
        self._optimizer = Optimizer(
            self._subproblem, solver, qps, positive("tolerance", tolerance)
        )
        self._no_input = np.zeros(system.m)
        self.reset()

    def reset(self, initial_state: ArrayLike | None = None) -> None:
        """Forget all measurements and start again.

        Parameters
        ----------
        initial_state : (n,) array_like, optional
            A new initial estimate; the former one if left out.

        Raises
        ------
        ShapeError, InvalidInputError, ModelError
            If the state has the wrong shape or is not finite, or the model is not defined there.
        """
        if initial_state is not None:
            state = vector("initial_state", initial_state, self.system.n)
            self.system.check(state, np.zeros(self.system.m))
            self.initial_state = state
        self._window = Window(
            self.system, self.observer, self.cost, self.horizon, self.initial_state,
            self._linearized,
        )
        self._state = self.initial_state.copy()

    @property
    def state(self) -> Array:
        """The current estimate of x(t+1), or the initial one before the first measurement."""
        return self._state

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return self._window.time

    def update(self, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """Take the measurement y(t) and the input u(t) in, and estimate x(t+1).

        Solver failures, a model that cannot be evaluated and missing measurements do not
        raise: the step falls back to the candidate, and the estimate's status tells why.

        Parameters
        ----------
        y : (p,) array_like
            y(t); components that are not finite are missing. A scalar will do where p is 1.
        u : (m,) array_like, optional
            u(t), the input that acts from t to t+1 (and on y(t), if h depends on it).
            Needed exactly if the system has inputs.

        Returns
        -------
        Estimate
            The estimate with everything known about it.

        Raises
        ------
        ShapeError, InvalidInputError
            If y or u has the wrong shape; the estimator is left as it was.
        """
        began = perf_counter()
        system, window = self.system, self._window
        y_array = np.asarray(y)
        if y_array.shape != (system.p,) or y_array.dtype != np.float64:
            y_array = vector("y", _without_none(y), system.p, finite=False)
        with np.errstate(all="ignore"):
            missing, failed = window.push(y_array, self._input(u))
            dropped = self._problem.bind(window)
            outcome = self._optimizer.improve(self._problem, window)
        status = outcome.events | (Status.IMPROVED if outcome.improved else Status.CANDIDATE)
        if missing:
            status |= Status.MISSING
        if failed:
            status |= Status.MODEL_FAILED
        if dropped:
            status |= Status.SETS_DROPPED
        candidate = window.candidate.copy()
        trial = outcome.trial
        residuals = trial.residuals
        if window.has_missing or not outcome.improved:
            residuals = residuals.copy()
            residuals[:, system.n :][~window.observed] = np.nan
        estimate = Estimate(
            window.time - 1,
            trial.trajectory if outcome.improved else candidate.copy(),
            residuals,
            trial.cost,
            candidate,
            window.candidate_cost,
            status,
            outcome.message,
            outcome.qps,
            outcome.solver_iterations,
            outcome.solve_time,
        )
        if failed and outcome.improved:
            window.restart(estimate.state)
        self._state = estimate.state
        estimate.step_time = perf_counter() - began
        return estimate

    def _input(self, u: ArrayLike | None) -> Array:
        m = self.system.m
        if u is None:
            if m == 0:
                return self._no_input
            raise InvalidInputError(f"u is missing; the system has {m} inputs: update(y, u).")
        if m == 0:
            raise InvalidInputError("u was given, but the system has no inputs; leave it out.")
        return vector("u", u, m, finite=False)

    def run(self, measurements: ArrayLike, inputs: ArrayLike | None = None) -> Run:
        """Take a whole record, sample by sample, going on from the present state.

        Parameters
        ----------
        measurements : (T, p) array_like
            y(t), ..., y(t+T-1); (T,) will do where p is 1.
        inputs : (T, m) array_like, optional
            The inputs of the same times.

        Returns
        -------
        Run
            Estimates, costs, times and statuses of all steps.

        Raises
        ------
        ShapeError, InvalidInputError
            If a shape is wrong; no sample has been taken then.
        """
        ys = _record("measurements", measurements, self.system.p)
        us: Any = None
        if inputs is not None:
            us = _record("inputs", inputs, self.system.m)
            if us.shape[0] != ys.shape[0]:
                raise ShapeError(
                    f"inputs has {us.shape[0]} samples; expected {ys.shape[0]}, one for each "
                    "measurement."
                )
        start = self._state.copy()
        if us is None:
            estimates = [self.update(y) for y in ys]
        else:
            estimates = [self.update(y, u) for y, u in zip(ys, us, strict=True)]
        return Run(start, estimates)


def _record(name: str, values: ArrayLike, width: int) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 1 and width == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ShapeError(f"{name} has shape {array.shape}; expected (T, {width}), a row a sample.")
    return array


def _without_none(y: Any) -> Any:
    """None stands for a missing number, alone or within a list."""
    if y is None:
        return np.nan
    if isinstance(y, (list, tuple)):
        return [np.nan if item is None else item for item in y]
    return y


def _is(value: object, kind: type, name: str, expected: str) -> None:
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name} is {value!r}; expected a {expected}.")
