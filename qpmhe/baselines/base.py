"""What every baseline is made from, and the loop that runs any estimator on a record."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import (
    Array,
    count,
    positive,
    positive_definite,
    positive_semidefinite,
    record,
    vector,
)
from .._linalg import inverse
from ..costs import Cost, ObserverPrior
from ..errors import ModelError, WeightError
from ..estimation.estimate import Estimate
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.residuals import difference
from ..model.system import System, checked_system
from ..observers import Observer

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Problem:
    """What an estimator is to estimate, with covariances for all that is random.

    Parameters
    ----------
    system : System
        The model.
    initial_state : (n,) array_like
        The estimate of x(0).
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array_like
        Covariances of the initial error, of w and of v, in squared units; the first two may be
        singular. r is n, or the number of columns of the system's ``disturbance_matrix``.
    parameters : (k,) array_like
        Values of the system's last k inputs, which are parameters.
    seed : int
        For random numbers.

    Raises
    ------
    ShapeError, WeightError, OptionError, InvalidInputError
        If something does not fit.
    """

    system: System
    initial_state: Array = field(kw_only=True)
    prior: Array = field(kw_only=True)
    disturbance: Array = field(kw_only=True)
    noise: Array = field(kw_only=True)
    parameters: Array = field(default_factory=lambda: np.empty(0), kw_only=True)
    seed: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        system = checked_system(self.system)
        n, r, p = system.n, system.r, system.p
        for name, value in (
            ("initial_state", vector("initial_state", self.initial_state, n)),
            ("prior", positive_semidefinite("prior covariance", self.prior, n)[0]),
            (
                "disturbance",
                positive_semidefinite("disturbance covariance", self.disturbance, r)[0],
            ),
            ("noise", positive_definite("noise covariance", self.noise, p)),
            ("parameters", vector("parameters", self.parameters, np.size(self.parameters))),
            ("seed", count("seed", self.seed, 0)),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def of(
        cls, system: System, observer: Observer, cost: Cost, initial_state: ArrayLike,
        **options: Any,
    ) -> Problem:
        """The problem that a moving horizon estimator of these parts solves.

        Parameters
        ----------
        system, observer, cost : System, Observer and Cost
            Weights of the cost are taken as inverse covariances. Where it has no weight of the
            initial error, the observer's covariance counts.
        initial_state : (n,) array_like
            The estimate of x(0).
        **options
            ``parameters`` and ``seed``.

        Raises
        ------
        WeightError
            If neither cost nor observer have a covariance of the initial error.
        """
        factor, disturbance = cost.disturbance_factor, inverse(cost.disturbance)
        prior = (
            observer.initial_covariance() if isinstance(cost.prior, ObserverPrior)
            else inverse(cost.prior)
        )
        if prior is None:
            raise WeightError(
                "neither the cost nor the observer has a covariance of the initial error; give "
                "the cost a prior."
            )
        return cls(
            system, initial_state=np.asarray(initial_state), prior=prior,
            disturbance=disturbance if factor is None else factor @ disturbance @ factor.T,
            noise=inverse(cost.noise), **options,
        )


    @property
    def covariances(self) -> dict[str, Any]:
        """``prior``, ``disturbance`` and ``noise``, as Kalman-type observers take them."""
        return {"prior": self.prior, "disturbance": self.disturbance, "noise": self.noise}


class Baseline(ABC):
    """An estimator that takes a measurement at a time: a filter, which knows no sets.

    A derived class has ``_begin``, ``_correct`` and ``_predict``. Missing components of y, which
    are not finite, correct nothing.

    Parameters
    ----------
    problem : Problem
        What to estimate.

    Attributes
    ----------
    state, covariance : (n,) and (n, n) array
        Estimate of the newest state, x(t+1) after y(t), and the covariance of its error.
    filtered : (n,) array
        The estimate of x(t) that has used y(t).
    """

    state: Array
    covariance: Array
    filtered: Array

    def __init__(self, problem: Problem) -> None:
        self.problem, system = problem, problem.system
        variances = problem.prior.diagonal()
        # Traced once, where an estimator would trace it; a system alone asks at each call.
        self._system = system.evaluated_by(
            system.model(np.sqrt(np.where(variances > 0.0, variances, 1.0)))
        )
        self._disturbance = system.state_covariance(problem.disturbance)
        self.reset()

    def reset(self, initial_state: ArrayLike | None = None) -> None:
        """Begin anew, at the problem's initial state or at another one (n,)."""
        if initial_state is not None:
            self.problem = replace(self.problem, initial_state=np.asarray(initial_state))
        self.state = self.filtered = self.problem.initial_state
        self.covariance = self.problem.prior
        self._begin()

    def update(
        self, y: ArrayLike, u: ArrayLike | None = None, *, dt: float | None = None
    ) -> Array:
        """Take y(t) (p,) and u(t) (m,), and estimate x(t+1).

        Parameters
        ----------
        y, u : array_like
            As for `qpmhe.MovingHorizonEstimator.update`.
        dt : float, optional
            Length of the step, if not the sampling time.

        Raises
        ------
        ShapeError, InvalidInputError
            If an argument does not fit.
        """
        system, behind = self._system, self.problem.parameters
        given = vector(
            "u", np.empty(0) if u is None else u, system.m - behind.size, finite=False
        )
        full = np.concatenate((given, behind))
        if dt is not None:
            system, full = system.timed, np.append(full, positive("dt", dt))
        measured = vector("y", y, system.p, finite=False)
        there = np.isfinite(measured)
        with np.errstate(all="ignore"):
            if there.any():
                self._correct(system, measured, full, there)
            self.filtered = self.state
            self._predict(system, full)
        return self.state

    def run(self, measurements: ArrayLike, inputs: ArrayLike | None = None) -> Run:
        """Take a record, Y (T, p) and U (T, m), from the present state on.

        Returns
        -------
        Run
            With covariances; its costs are NaN, as a filter has none.
        """
        system = self.problem.system
        y = record("Y", measurements, system.p)
        u = None if inputs is None else record(
            "U", inputs, system.m - self.problem.parameters.size
        )
        return follow(self, self.state, y, u, covariances=True)

    @abstractmethod
    def _begin(self) -> None:
        """Set up what it remembers beside state and covariance, from these."""

    @abstractmethod
    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        """Change state and covariance by the components of y that are there."""

    @abstractmethod
    def _predict(self, system: System, u: Array) -> None:
        """Change state and covariance to those of the next time."""


def innovation(system: System, y: Array, outputs: Array) -> Array:
    """What y is above outputs h, (p,) or (B, p), angles within half a turn."""
    return difference(system.output_residual, np.broadcast_to(y, outputs.shape), outputs)


def deviations(system: System, states: Array, weights: Array) -> tuple[Array, Array]:
    """The mean (n,) of states (B, n), and what each is from it; angles within half a turn."""
    first = states[0]
    apart = difference(system.state_residual, states, np.broadcast_to(first, states.shape))
    mean = weights @ apart
    return first + mean, apart - mean


def follow(
    estimator: Any, start: Array, measurements: Array, inputs: Array | None = None,
    steps: Array | None = None, *, covariances: bool = False,
    each: Callable[[int], object] = lambda _done: None,
) -> Run:
    """Run an estimator on a record.

    Parameters
    ----------
    estimator : object
        With ``update(y, u)``, which returns the estimate (n,) of x(t+1), or an object with such a
        ``state``. It may leave out u where there are no inputs, and it has a keyword ``dt`` where
        steps have other lengths. Its ``covariance`` (n, n) is that of the estimate's error.
    start : (n,) array
        The estimate of x(0).
    measurements, inputs : (T, p) and (T, m) array
        The record.
    steps : (T,) array, optional
        Lengths of the steps.
    covariances : bool
        Whether to collect covariances.
    each : callable
        each(t) is called after t steps.

    Returns
    -------
    Run
        Costs are NaN, unless the estimates are those of a `qpmhe.MovingHorizonEstimator`.

    Raises
    ------
    ModelError
        If what it returns is no state, or it takes no ``dt`` where it needs one.
    """
    name, update = type(estimator).__name__, getattr(estimator, "update", None)
    if not callable(update):
        raise ModelError(f"a {name} is no estimator; expected an object with update(y, u).")
    needs_input, takes_dt = _arguments(update)
    if steps is not None and not takes_dt:
        raise ModelError(
            f"{name}.update takes no dt, but the record's steps have several lengths; expected "
            "update(y, u, dt=...)."
        )
    n, estimates, times, filtered, errors = start.size, [], [], [], []
    states = [start.copy()]
    is_mhe = isinstance(estimator, MovingHorizonEstimator)
    for t, y in enumerate(measurements):
        given = () if inputs is None and not needs_input else (
            None if inputs is None else inputs[t],
        )
        options = {} if steps is None else {"dt": steps[t]}
        began = perf_counter()
        found = update(y, *given, **options)
        times.append(perf_counter() - began)
        estimates.append(found)
        value = np.array(getattr(found, "state", found), np.float64)
        if value.shape != (n,):
            raise ModelError(
                f"{name}.update returned an estimate of shape {value.shape}; expected ({n},), the "
                "state x(t+1)."
            )
        states.append(value)
        filtered.append(getattr(estimator, "filtered", np.full(n, np.nan)))
        if covariances:
            errors.append(
                estimator.newest_covariance() if is_mhe else _covariance(estimator, found, n)
            )
        each(t + 1)
    matrices = np.array(errors) if errors and not all(one is None for one in errors) else None
    if estimates and all(isinstance(one, Estimate) for one in estimates):
        return Run.of(start, estimates, matrices)
    total, array = len(estimates), np.array(states)
    none, unknown = np.zeros(total, np.intp), np.full(total, np.nan)
    return Run(
        states=array, filtered=np.array(filtered, np.float64).reshape(-1, n), costs=unknown,
        candidate_costs=unknown.copy(), times=np.array(times), solve_times=unknown.copy(),
        qps=none, solver_iterations=none - 1, flags=none.copy(), observer_states=array,
        covariances=matrices, engine=name,
    )


def _arguments(update: Callable[..., Any]) -> tuple[bool, bool]:
    """Whether a second argument must be given, and whether ``dt`` can be."""
    try:
        known = inspect.signature(update).parameters
    except (TypeError, ValueError):  # of an extension module
        return False, True
    named = [one for one in known.values() if one.kind in (
        one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    free = any(one.kind is one.VAR_KEYWORD for one in known.values())
    return len(named) > 1 and named[1].default is inspect.Parameter.empty, free or "dt" in known


def _covariance(estimator: Any, found: Any, n: int) -> Array | None:
    value = getattr(found, "covariance", getattr(estimator, "covariance", None))
    if value is None:
        return None
    matrix = np.array(value, np.float64)
    if matrix.shape != (n, n):
        raise ModelError(
            f"the covariance of {type(estimator).__name__} has shape {matrix.shape}; expected "
            f"({n}, {n})."
        )
    return matrix
