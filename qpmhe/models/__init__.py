"""Systems with observers, costs and scenarios, for studies, tests and examples."""

from .batch_reactor import batch_reactor
from .battery_cell import battery_cell
from .catalogue import catalogue
from .chain import chain_of_masses
from .cstr import cstr
from .example import Example
from .pendulum import pendulum
from .quadrotor import quadrotor
from .scenario import Record, Scenario
from .van_der_pol import van_der_pol
from .vehicle import vehicle

__all__ = [
    "Example", "Record", "Scenario", "batch_reactor", "battery_cell", "catalogue",
    "chain_of_masses", "cstr", "pendulum", "quadrotor", "van_der_pol", "vehicle",
]
