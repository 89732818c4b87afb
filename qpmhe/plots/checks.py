"""Checks of what is to be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, numbers
from ..errors import InvalidInputError, ShapeError
from ..estimation.estimate import Estimate
from ..estimation.run import Run


def check_run(run: Any) -> None:
    """Raise an InvalidInputError for anything but a Run."""
    if not isinstance(run, Run):
        raise InvalidInputError(
            f"run is of type {type(run).__name__}; expected a qpmhe.Run, as "
            "MovingHorizonEstimator.run returns it. plots.window draws one Estimate, "
            "plots.trajectories any arrays."
        )


def check_estimate(estimate: Any) -> None:
    """Raise an InvalidInputError for anything but an Estimate."""
    if not isinstance(estimate, Estimate):
        raise InvalidInputError(
            f"estimate is of type {type(estimate).__name__}; expected a qpmhe.Estimate, as "
            "MovingHorizonEstimator.update returns it. plots.states draws a Run."
        )


def sample_times(times: ArrayLike) -> NDArray[Any]:
    """The times of samples, (T + 1,), numbers or dates, checked."""
    given = np.asarray(times)
    if given.ndim != 1:
        raise ShapeError(f"times have shape {given.shape}; expected (T + 1,), one per state.")
    return given


def curve(name: str, values: ArrayLike, length: int, n: int) -> Array:
    """A row of n states at each of the times, (length, n); (length,) is accepted for n = 1."""
    array = numbers(name, values, finite=False)
    if array.ndim == 1 and n == 1:
        array = array[:, None]
    if array.shape != (length, n):
        raise ShapeError(
            f"{name} has shape {array.shape}; expected ({length}, {n}), a row for each of the "
            "times x(0), ..., x(T) and a column for each state with a label."
        )
    return array


def named_curves(
    estimates: Mapping[str, ArrayLike], length: int, n: int, most: int
) -> dict[str, Array]:
    """The `curve` of each label, at most `most`."""
    if not isinstance(estimates, Mapping):
        raise InvalidInputError(
            f"estimates are of type {type(estimates).__name__}; expected a mapping of labels to "
            "arrays, such as {'estimate': run.states}."
        )
    if len(estimates) > most:
        raise InvalidInputError(
            f"estimates are {len(estimates)}: {', '.join(map(str, estimates))}; expected at most "
            f"{most}, so that readers can distinguish them. Draw the others into other axes."
        )
    return {
        label: curve(f"estimates[{label!r}]", values, length, n)
        for label, values in estimates.items()
    }
