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

from qpmhe_solvers.values import shown

from .._checks import (
    Array,
    count,
    numbers,
    positive,
    positive_definite,
    positive_semidefinite,
    record,
    vector,
)
from .._linalg import inverse
from ..costs import Cost, ObserverPrior
from ..errors import InvalidInputError, ModelError, ShapeError, WeightError
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
        InvalidInputError, ShapeError, OptionError
            If something does not fit.
        """
        if not isinstance(observer, Observer):
            raise InvalidInputError(f"observer is {shown(observer)}; expected a qpmhe.Observer.")
        if not isinstance(cost, Cost):
            raise InvalidInputError(f"cost is {shown(cost)}; expected a qpmhe.Cost.")
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
    """A filter: an estimator that takes one measurement at a time and ignores sets.

    A derived class has ``_correct`` and ``_predict``, and ``_begin`` where it remembers more than
    state and covariance. Components of y that are not finite are missing: they correct nothing.

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
        if not isinstance(problem, Problem):
            raise InvalidInputError(
                f"problem is {shown(problem)}; expected a qpmhe.baselines.Problem."
            )
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

    def _begin(self) -> None:
        """Set up further memory from the state and the covariance, where a filter has any."""

    @abstractmethod
    def _correct(self, system: System, y: Array, u: Array, there: Mask) -> None:
        """Change state and covariance by the components of y that are there."""

    @abstractmethod
    def _predict(self, system: System, u: Array) -> None:
        """Change state and covariance to those of the next time."""


def innovation(system: System, y: Array, outputs: Array) -> Array:
    """The innovation y - h, (p,) or (B, p), with angles within half a turn."""
    return difference(system.output_residual, np.broadcast_to(y, outputs.shape), outputs)


def deviations(system: System, states: Array, weights: Array) -> tuple[Array, Array]:
    """The mean (n,) of states (B, n), and their differences from it; angles within half a turn."""
    first = states[0]
    apart = difference(system.state_residual, states, np.broadcast_to(first, states.shape))
    mean = weights @ apart
    return first + mean, apart - mean


def follow(
    estimator: Any, start: ArrayLike, measurements: ArrayLike, inputs: ArrayLike | None = None,
    steps: ArrayLike | None = None, *, covariances: bool = False,
    each: Callable[[int], object] = lambda _done: None,
) -> Run:
    """Run an estimator on a record.

    Parameters
    ----------
    estimator : object
        Its ``update(y, u)`` returns the estimate (n,) of x(t+1), or an object with such a
        ``state``. Without inputs, ``update(y)`` will do; steps of several lengths need a keyword
        ``dt``. It may have attributes ``covariance`` (n, n), the covariance of the estimate's
        error, and ``filtered`` (n,), the estimate of x(t) that has used y(t).
    start : (n,) array_like
        The estimate of x(0).
    measurements, inputs : (T, p) and (T, m) array_like
        The record.
    steps : (T,) array_like, optional
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
    InvalidInputError, ModelError, ShapeError
        If an argument does not fit, or an estimate; if ``update`` cannot be called as the record
        needs it. Exceptions of ``update`` itself pass through.
    """
    name, update = type(estimator).__name__, getattr(estimator, "update", None)
    if isinstance(estimator, type) or not callable(update):
        raise ModelError(
            f"the estimator is {shown(estimator)}; expected an object with update(y, u)."
        )
    first = vector("start", start, np.size(start))
    y = _rows("measurements", measurements)
    u = None if inputs is None else _rows("inputs", inputs, len(y))
    lengths = None if steps is None else _rows("steps", steps, len(y))
    options: dict[str, Any] = {} if lengths is None else {"dt": None}
    alone = u is None and _takes(update, None, **options)
    if not (alone or _takes(update, None, None, **options)):
        raise ModelError(
            f"{name}.update cannot be called as update(y, u{', dt=...' * bool(options)}), as this "
            "record needs it; expected update(y, u), with a keyword dt for steps of several "
            "lengths."
        )
    n, is_mhe = first.size, isinstance(estimator, MovingHorizonEstimator)
    unknown = np.full(n, np.nan)
    states, estimates, times, filtered, errors = [first], [], [], [], []
    for t in range(len(y)):
        given = () if alone else (None if u is None else u[t],)
        if lengths is not None:
            options["dt"] = lengths[t]
        began = perf_counter()
        found = update(y[t], *given, **options)
        times.append(perf_counter() - began)
        estimates.append(found)
        states.append(_read(f"the estimate of {name}", getattr(found, "state", found), n))
        filtered.append(_read(f"{name}.filtered", getattr(estimator, "filtered", unknown), n))
        if covariances:
            value = estimator.known_covariances()[-1] if is_mhe else getattr(
                found, "covariance", getattr(estimator, "covariance", None))
            errors.append(_read(
                f"the covariance of {name}", unknown * unknown[:, None] if value is None else value,
                n, n,
            ))
        each(t + 1)
    matrices = None if np.isnan(errors).all() else np.array(errors)
    if estimates and all(isinstance(one, Estimate) for one in estimates):
        return Run.of(first, estimates, matrices)
    array, none, costs = np.array(states), np.zeros(len(y), np.intp), np.full(len(y), np.nan)
    return Run(
        states=array, filtered=np.array(filtered).reshape(-1, n), costs=costs,
        candidate_costs=costs.copy(), times=np.array(times), solve_times=costs.copy(),
        qps=none, solver_iterations=none - 1, flags=none.copy(), observer_states=array,
        covariances=matrices, engine=name,
    )


def _takes(update: Callable[..., Any], *arguments: Any, **options: Any) -> bool:
    try:
        inspect.signature(update).bind(*arguments, **options)
    except TypeError:
        return False
    except ValueError:  # an extension module does not say
        return True
    return True


def _rows(name: str, values: ArrayLike, count: int | None = None) -> Array:
    array = numbers(name, values, finite=False)
    if array.ndim == 0 or count not in (None, len(array)):
        raise ShapeError(
            f"{name} has shape {array.shape}; expected {'T' if count is None else count} rows, one "
            "a sample."
        )
    return array


def _read(what: str, value: Any, *shape: int) -> Array:
    """A copy of an array of the estimator."""
    array = numbers(what, value, finite=False)
    if array.shape != shape or value is None:
        raise ShapeError(
            f"{what} is {shown(value)}, of shape {array.shape}; expected an array of shape {shape}."
        )
    return array
