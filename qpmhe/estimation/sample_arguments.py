"""The arguments of an update as arrays: y(t), u(t) with the parameters behind it, conditions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers, vector
from ..costs import Cost
from ..errors import InvalidInputError, ShapeError
from ..model.system import System
from .conditions import ConditionReader, Conditions

Array = NDArray[np.float64]


class SampleArguments:
    """Reads the arguments of one sample.

    Parameters
    ----------
    system, cost
        Those of the estimator.
    nominal : sequence of float
        The parameters, which are the last of the system's inputs.
    """

    def __init__(self, system: System, cost: Cost, nominal: tuple[float, ...]) -> None:
        if len(nominal) > system.m:
            raise ShapeError(
                f"parameters has {len(nominal)} numbers; expected at most {system.m}, the system's "
                "known inputs: parameters are the last of these. Make the system with a larger m."
            )
        #: Numbers in the u of `update`.
        self.inputs = system.m - len(nominal)
        self.usual_input = np.append(np.zeros(self.inputs), nominal)
        #: Each sample's u with its parameters, overwritten.
        self.input = self.usual_input.copy()
        #: The shape of y.
        self.outputs = (system.p,)
        self.conditions = ConditionReader(system, cost)
        self._has_parameters, self._partial = bool(nominal), np.empty(system.p)

    def measurement(self, y: ArrayLike | None) -> Array:
        """y(t), NaN where it is missing."""
        p = self.outputs[0]
        return np.full(p, np.nan) if y is None else vector("y", y, p, finite=False)

    def sampled(self, y: ArrayLike | None, sensors: ArrayLike) -> tuple[Array, Conditions | None]:
        """y(t) with NaN where it was not sampled, and the conditions that say so."""
        index, own = self.conditions.sensors(sensors)
        self._partial.fill(np.nan)
        if y is not None:
            if type(y) is np.ndarray and y.ndim == 1 and y.dtype == np.float64:
                given = y
            else:
                given = np.atleast_1d(numbers("y", y, finite=False))
            if given.shape != index.shape:
                raise ShapeError(
                    f"y has shape {given.shape}; expected {index.shape}, a component for each of "
                    f"sensors={index.tolist()}."
                )
            self._partial[index] = given
        return self._partial, own

    def read_input(
        self, u: ArrayLike | None, parameters: ArrayLike | None, usual: Conditions,
        call: str = "update(y, u)",
    ) -> Array:
        """u(t), the parameters behind the rest."""
        count, full = self.inputs, self.input
        if u is None:
            if count:
                raise InvalidInputError(
                    f"{call[-2]} is missing; the system has {count} "
                    f"input{'s' * (count != 1)}: {call}."
                )
        elif count == 0:
            beside = " beside its parameters" if self._has_parameters else ""
            raise InvalidInputError(
                f"u was given, but the system has no inputs{beside}; leave it out."
            )
        else:
            full[:count] = vector("u", u, count, finite=False)
        if parameters is not None:
            full[count:] = self.conditions.parameters(parameters, usual)
        elif usual.parameters is not None:
            full[count:] = usual.parameters
        return full


def with_parameters(inputs: Array | None, samples: int, usual: Conditions) -> Array | None:
    """The inputs of a record, with the usual parameters behind them."""
    if usual.parameters is None:
        return inputs
    behind = np.tile(usual.parameters, (samples, 1))
    return behind if inputs is None else np.hstack((inputs, behind))
