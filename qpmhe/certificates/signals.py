"""Disturbances and noises of a run, as they are passed in several ways."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers
from ..errors import ShapeError
from ..run import Run
from ..system import System

__all__ = ["signals"]

Array = NDArray[np.float64]


def signals(
    system: System, run: Run | None, disturbances: ArrayLike, noises: ArrayLike
) -> tuple[Array, Array]:
    """Vectors or lengths at each sample.

    Parameters
    ----------
    system : System
        Whose.
    run : Run or None
        What tells how many steps there are; without it, the sequences do.
    disturbances, noises : array_like
        (T, n) and (T, p), lengths (T,), or a number.

    Raises
    ------
    ShapeError
        If they do not fit.
    """
    w, v = numbers("disturbances", disturbances), numbers("noises", noises)
    steps = len(run) if run is not None else next(
        (len(x) for x in (w, v) if x.ndim), None
    )
    if steps is None:
        raise ShapeError(
            "disturbances and noises are numbers and there is no run; expected a sequence "
            "for one of them, to tell how many steps there are."
        )
    for name, x, width in (("disturbances", w, system.n), ("noises", v, system.p)):
        if x.ndim and x.shape not in ((steps,), (steps, width)):
            raise ShapeError(
                f"{name} has shape {x.shape}; expected ({steps}, {width}), their lengths "
                f"({steps},), or a number."
            )
    return (
        w if w.ndim else np.full(steps, float(w)), v if v.ndim else np.full(steps, float(v))
    )
