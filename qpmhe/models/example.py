"""What every model of the zoo consists of."""

from __future__ import annotations

from typing import NamedTuple

from ..costs import QuadraticCost
from ..model.system import System
from ..observers import Observer
from .scenario import Scenario

__all__ = ["Example"]


class Example(NamedTuple):
    """A system with all that its estimation needs, as every function of `qpmhe.models` makes it.

    It unpacks in this order. An `OptionError` is raised where an argument of the function, such
    as the method of discretisation, is not among what it names.

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
