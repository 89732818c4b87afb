"""Where an estimator starts, and whether what it is made of fits together there."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import numbers
from .._linalg import inverse
from ..costs import Cost, lifted
from ..errors import InvalidInputError, ModelError, ObserverWarning, ShapeError
from ..model.system import System
from ..observers import Observer
from ..observers.projection import NearestPoint

Array = NDArray[np.float64]


def nominal_parameters(parameters: ArrayLike | None) -> tuple[float, ...]:
    """The usual values of the parameters; empty without any."""
    if parameters is None:
        return ()
    values = np.atleast_1d(numbers("parameters", parameters))
    if values.ndim != 1:
        raise ShapeError(
            f"parameters has shape {values.shape}; expected (k,), the usual values of the system's "
            "last k inputs."
        )
    return tuple(values.tolist())


def require(value: object, kind: type, name: str, expected: str) -> None:
    """Check the type of an argument."""
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name} is {shown(value)}; expected a {expected}.")


def check_cost(system: System, cost: Cost) -> None:
    """Check that a cost is for the system's states, disturbances and outputs."""
    n = system.n if cost.observer_prior is not None and cost.r == system.r else cost.n
    if (n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, the system's."
        )
    if cost.r != system.r:
        raise ShapeError(
            f"the cost is for {cost.r} disturbances; expected {system.r}, "
            + ("one for each state. Give the system a disturbance_matrix if there are fewer."
               if system.disturbance_matrix is None
               else "one for each column of the system's disturbance_matrix.")
        )


def check_start(
    system: System, observer: Observer, cost: Cost, state: Array, name: str = "initial_state",
    u: Array | None = None, metric: str = "observer",
) -> tuple[Array, System]:
    """Check that model and observer work at an initial state.

    Returns the state, projected onto X, and the system as it is evaluated from there on.
    """
    try:
        start, is_moved = inside(system, observer, cost, state, metric)
        if is_moved:
            warnings.warn(
                f"{name} is {state.tolist()}, outside of the state set {system.states!r}; the "
                f"estimator starts at the nearest point of the set, {start.tolist()}.",
                ObserverWarning,
                stacklevel=4,
            )
        state = start
        system = system.at(state, np.zeros(system.m) if u is None else u)
        observer.check(system, state)
    except ModelError as error:
        if name == "initial_state":
            raise
        raise ModelError(f"{name}: {error}") from error
    return state, system


def with_scaled_constraints(system: System, observer: Observer, cost: Cost, state: Array) -> System:
    """The system, its constraints in standard deviations of what they are functions of."""
    if system.constraints is None:
        return system
    functions, matrix = system.constraints.copy(), system.disturbance_matrix
    covariance = observer.initial_covariance()
    of_d = lifted(cost, matrix, covariance)
    functions.use_scales(
        state, cost.prior_deviations(covariance, matrix), inverse(of_d.disturbance),
        inverse(of_d.noise), None if of_d.space is None else of_d.space.to_disturbances,
    )
    return system.with_constraints(functions)


def inside(
    system: System, observer: Observer, cost: Cost, state: Array, metric: str
) -> tuple[Array, bool]:
    """An initial state in X, in its turn, and whether it was projected."""
    if system.states is None:
        return state, False
    if system.turns is not None:
        state = system.turns(state)
    nearest = NearestPoint(system.states, metric == "diagonal")
    if nearest.contains(state):
        return state, False
    weight = observer.metric
    if weight is None:
        weight = cost.initial_weight(observer.initial_covariance())
    if weight.shape[0] != system.n:
        return state, False  # `Observer.check` then reports the wrong size
    return nearest(state, inverse(weight)).point, True
