"""A sample that comes with weights, sides, sensors or a step length, for the C step."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..estimation.conditions import Conditions
from ..model.sets import ConvexSet
from .directions import Directions
from .layout import SET_NAMES, Layout


class SampleRecord:
    """One ``mhe_sample``, filled again for each sample.

    Attributes
    ----------
    record : array
        The structure, with pointers to the arrays of this object.
    """

    def __init__(
        self, layout: Layout, directions: Directions, y: NDArray[Any], u: NDArray[Any]
    ) -> None:
        n, p = layout.nx, layout.ny
        self.record = np.zeros(1, layout.sample_type())
        self._fields, self._kept, self._directions = self.record[0], (y, u), directions
        self._fields["y"], self._fields["u"] = y.ctypes.data, u.ctypes.data
        self._arrays: dict[str, Any] = {
            "noise_weight": np.zeros((p, p)), "disturbance_weight": np.zeros((n, n)),
            "sampled": np.zeros(p, np.uint8),
            **{name: np.zeros(1, layout.set_type(name)) for name in SET_NAMES},
        }
        self._addresses = {name: array.ctypes.data for name, array in self._arrays.items()}

    def fill(self, dt: float | None, own: Conditions | None) -> None:
        """Set the sample's step length and conditions."""
        fields = self._fields
        fields["step"] = dt or 0.0
        for name, array in self._arrays.items():
            value = None if own is None else getattr(own, name)
            if value is None:
                fields[name] = 0
                continue
            if isinstance(value, ConvexSet):
                self._directions.write_sides(name, array[0], value)
            elif name == "disturbance_weight":
                array[...] = self._directions.weight_of_d(value)
            else:
                array[...] = value
            fields[name] = self._addresses[name]
