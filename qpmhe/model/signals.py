"""Names, units and values of a model's variables, where its origin knows them."""

from __future__ import annotations

from typing import NamedTuple

# So many variables of a kind are listed; models of plants have thousands of parameters.
_SHOWN = 30


class Signal(NamedTuple):
    """A variable of a model.

    Attributes
    ----------
    name : str
        Its name.
    unit : str
        Its unit; blank if none is given.
    value : float, int, bool or str
        The value at the start: of a state, of an input at rest, of a parameter as it was set.
    nominal : float
        Its typical magnitude, 1 if none is given.
    description : str
        A text about it; blank if none is given.
    """

    name: str
    unit: str = ""
    value: float | int | bool | str = 0.0
    nominal: float = 1.0
    description: str = ""

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class Signals(NamedTuple):
    """The variables of a model, in the order of x, u, y and the parameters.

    Attributes
    ----------
    states, inputs, outputs, parameters : tuple of Signal
        The variables.
    """

    states: tuple[Signal, ...] = ()
    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...] = ()
    parameters: tuple[Signal, ...] = ()

    def __str__(self) -> str:
        return "\n".join(
            f"{name}: {', '.join(map(str, listed[:_SHOWN]))}"
            + (f" and {len(listed) - _SHOWN} more." if len(listed) > _SHOWN else ".")
            for name, listed in zip(self._fields, self, strict=True) if listed
        )
