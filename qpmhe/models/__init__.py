"""Systems with observers, costs and scenarios, for studies, tests and examples."""

from .batch_reactor import BatchReactor, batch_reactor
from .chain import ChainOfMasses, chain_of_masses
from .scenario import Record, Scenario

__all__ = [
    "BatchReactor",
    "ChainOfMasses",
    "Record",
    "Scenario",
    "batch_reactor",
    "chain_of_masses",
]
