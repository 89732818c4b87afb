"""Systems with observers, costs and scenarios, for studies, tests and examples."""

from collections.abc import Callable

from .batch_reactor import batch_reactor
from .battery_cell import battery_cell
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


def catalogue() -> dict[str, Callable[..., Example]]:
    """The functions that make the models, by name.

    Every function can be called without arguments; some take keyword arguments, such as the
    number of masses.

    Examples
    --------
    >>> import qpmhe
    >>> system, observer, cost, scenario = qpmhe.models.catalogue()["chain_of_masses"](masses=1)
    >>> system.n
    6
    """
    functions: tuple[Callable[..., Example], ...] = (
        batch_reactor, van_der_pol, cstr, pendulum, vehicle, quadrotor, chain_of_masses,
        battery_cell,
    )
    return {function.__name__: function for function in functions}
