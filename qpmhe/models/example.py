"""What every model of the zoo consists of."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..costs import QuadraticCost
from ..model.system import System
from ..observers import Observer
from .scenario import Scenario

Array = NDArray[Any]


class Selection:
    """An output of some of the n state components, and its Jacobian."""

    def __init__(self, n: int, components: slice | list[int]) -> None:
        self._components, self._matrix = components, np.eye(n)[components]

    def output(self, x: Array) -> Array:
        """The components of x, (..., p)."""
        return x[..., self._components]

    def jacobian(self, x: Array) -> Array:
        """The same matrix everywhere, (..., p, n)."""
        return np.broadcast_to(self._matrix, (*x.shape[:-1], *self._matrix.shape))


class Example(NamedTuple):
    """A system with all that its estimation needs; every function of `qpmhe.models` returns one.

    It unpacks in this order. An `OptionError` is raised where an argument of the function, such
    as the method of discretisation, is not one that it names.

    Parameters
    ----------
    system : System
    observer : Observer
        The auxiliary observer, stable in the scenario.
    cost : QuadraticCost
        Weights, the inverse covariances of the scenario and of the initial error.
    scenario : Scenario
        How the system is simulated, ``scenario.simulate(seed)``, and where the estimation starts.
    """

    system: System
    observer: Observer
    cost: QuadraticCost
    scenario: Scenario


def make_example(
    system: System, observer: Observer, *, prior: ArrayLike, disturbance: ArrayLike,
    noise: ArrayLike, **scenario: Any,
) -> Example:
    """An example from standard deviations, by which its cost weighs and its scenario draws."""
    P, Q, R = (np.diag(np.square(one)) for one in (prior, disturbance, noise))
    cost = QuadraticCost.from_covariances(prior=P, disturbance=Q, noise=R)
    drawn = Scenario(system, disturbance_covariance=Q, noise_covariance=R, **scenario)
    return Example(system, observer, cost, drawn)
