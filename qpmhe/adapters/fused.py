"""Steps of a window by one call into a model's machine code each."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

__all__ = ["Fused", "fused"]

Array = NDArray[np.float64]

# Beyond so many residuals a stage, LAPACK's matrix products are faster than plain loops.
_MOST_RESIDUALS = 40


@dataclass(frozen=True)
class Fused:
    """Calls that work in place on the arrays of one window, for its usual stages.

    Parameters
    ----------
    enter : callable
        ``enter(k)`` computes stage k, of a constant gain, with its Gauss-Newton terms and the
        state after it, and returns its cost; NaN where any of these is not finite.
    judge : callable
        ``judge(first, count)`` computes residuals and cost of a trajectory in `states`, over
        the stages from ``first`` on.
    states : (N + 1, n) array
        Where `judge` reads.
    residuals : (N, n + p) array
        Where it writes.
    kept : tuple of array
        All arrays of which the calls hold no more than the address.
    """

    enter: Callable[[int], float]
    judge: Callable[[int, int], float]
    states: Array
    residuals: Array
    kept: tuple[Array, ...]


def fused(
    library: ctypes.PyDLL,
    dt: float,
    horizon: int,
    z: Array,
    u: Array,
    y: Array,
    linear: Array,
    panel: Array,
    own: Array,
    following: Array,
    gain: Array,
    stage_weight: Array,
    prior_weight: Array,
) -> Fused | None:
    """Bind the calls to a window's arrays, of one entry a stage; None for large models.

    Parameters
    ----------
    library : ctypes.PyDLL
        What was made of ``model_api.c``.
    dt : float
        Length of the steps.
    horizon : int
        N, the most stages of a trajectory.
    z, u, y, linear, panel, own, following : array
        States, inputs (with a place for a step's length behind), measurements, and the
        arrays of `StageTerms`.
    gain : (n, p) array
        The observer's.
    stage_weight, prior_weight : array
        (n + p, n + p) and (n, n).
    """
    q, n = stage_weight.shape[0], prior_weight.shape[0]
    if q > _MOST_RESIDUALS:
        return None
    states, residuals = np.zeros((horizon + 1, n)), np.zeros((horizon, q))
    gain, stage_weight, prior_weight = (
        np.ascontiguousarray(one) for one in (gain, stage_weight, prior_weight)
    )
    kept = (
        z, u, y, gain, stage_weight, prior_weight, linear, panel, own, following, states, residuals
    )
    at = [ctypes.c_void_p(one.ctypes.data) for one in kept]
    usual = ctypes.c_double(dt)
    for function in (library.mhe_enter_stage, library.mhe_judge):
        function.restype = ctypes.c_double
    enter = partial(library.mhe_enter_stage, *at[:3], usual, at[3], at[4], *at[6:10])
    judge = partial(library.mhe_judge, *at[:3], usual, at[4], at[5], *at[10:])
    return Fused(enter, judge, states, residuals, kept)
