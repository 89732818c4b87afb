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
    vector,
)
from .._linalg import inverse
from ..costs import Cost, ObserverPrior
from ..errors import InvalidInputError, ModelError, ShapeError, WeightError
from ..estimation.estimate import Estimate
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..estimation.time_index import PairedRecord, has_times, index_of, paired_record
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

    def run(
        self, measurements: ArrayLike, inputs: ArrayLike | None = None, *, time_unit: Any = "s"
    ) -> Run:
        """Take a record from the present state on.

        Parameters
        ----------
        measurements, inputs, time_unit
            As for `qpmhe.MovingHorizonEstimator.run`: an index of times is the time axis.

        Returns
        -------
        Run
            With covariances; its costs are NaN, as a filter has none.

        Raises
        ------
        ShapeError, InvalidInputError
            If a shape is wrong, or the times of measurements and inputs do not match or are no
            steps of the model.
        """
        system = self.problem.system
        paired = paired_record(
            system, measurements, inputs, system.m - self.problem.parameters.size, time_unit
        )
        return _followed_in_time(self, self.state, paired, time_unit, covariances=True)

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
    each: Callable[[int], object] = lambda _done: None, time_unit: Any = "s",
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
    measurements, inputs : (T, p) and (T, m) array_like, DataFrame or Series
        The record. An index of times is read as by `qpmhe.MovingHorizonEstimator.run`, for such
        an estimator, a `Baseline`, or one whose ``problem`` is the `Problem`.
    steps : (T,) array_like, optional
        Lengths of the steps.
    covariances : bool
        Whether to collect covariances.
    each : callable
        each(t) is called after t steps.
    time_unit : str or pandas.Timedelta
        The model's unit of time, for an index of times.

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
    index = index_of(measurements)
    if index is not None and (system := _system_of(estimator)) is not None:
        if steps is not None and has_times(index):
            raise InvalidInputError(
                "steps are given, and the index of the measurements has their lengths; leave out "
                "steps."
            )
        width = 0 if inputs is None else int(np.prod(np.asarray(inputs).shape[1:]))
        paired = paired_record(system, measurements, inputs, width, time_unit)
        if paired.times is not None:
            return _followed_in_time(
                estimator, first, paired, time_unit, covariances=covariances, each=each
            )
    elif has_times(index):
        raise InvalidInputError(
            f"the measurements have an index of times, and {name} does not say the steps of its "
            "model; give it an attribute problem, its qpmhe.baselines.Problem, or give arrays "
            "(.to_numpy()), which are paired by position."
        )
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


def _system_of(estimator: Any) -> System | None:
    """The system whose steps an index of times is made of, if the estimator says it."""
    if isinstance(estimator, MovingHorizonEstimator):
        return estimator.system
    problem = getattr(estimator, "problem", None)
    return problem.system if isinstance(problem, Problem) else None


def _followed_in_time(
    estimator: Any, start: Array, paired: PairedRecord, time_unit: Any, **options: Any
) -> Run:
    """Follow a record whose rows are paired, and keep its times."""
    run = follow(
        estimator, start, paired.measurements, paired.inputs, paired.lengths, **options
    )
    if paired.times is not None:
        run.keep_times(paired.times, time_unit)
    return run


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
