"""Systems with observers, costs and scenarios, for studies, tests and examples."""

from .batch_reactor import BatchReactor, batch_reactor
from .scenario import Record, Scenario

__all__ = ["BatchReactor", "Record", "Scenario", "batch_reactor"]
