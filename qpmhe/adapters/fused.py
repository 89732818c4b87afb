"""Steps of a window by one call into a model's machine code each."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..codegen.comparison import ROUNDING, Batch, Interpreter, differs

__all__ = ["Fused", "fused", "fused_fault"]

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


def fused_fault(
    interpreter: Interpreter, library: ctypes.PyDLL, batches: Sequence[Batch]
) -> str:
    """Where the calls differ from CasADi's interpreter and NumPy; empty where they do not.

    Parameters
    ----------
    interpreter : Interpreter
        The model.
    library : ctypes.PyDLL
        Its machine code.
    batches : sequence
        Of `qpmhe.codegen.comparison.points`.
    """
    model, generator = interpreter.model, np.random.default_rng(2)
    n, p, q = model.n, model.p, model.n + model.p
    xs, inputs, steps, found = batches[-1]
    count = len(xs)
    gain, weight = 0.1 * generator.standard_normal((n, p)), np.eye(q)
    weight += 0.1 / q * generator.uniform(-1.0, 1.0, (q, q))
    weight += weight.T
    z, us = np.zeros((count + 1, n)), np.column_stack((inputs, steps))
    ys = found["h"] * generator.uniform(0.5, 2.0, (count, p))
    linear, panel = np.zeros((count, q, 1 + n)), np.zeros((count, n, 2 * n))
    own, following = np.zeros((count, n)), np.zeros((count, n))
    calls = fused(
        library, model.dt or 0.0, count, z, us, ys, linear, panel, own, following, gain, weight,
        weight[:n, :n],
    )
    if calls is None:
        return ""
    noises = ys - found["h"]
    allowed_noises = ROUNDING * (abs(ys) + abs(found["h"])) + found["spread_h"]
    for k in range(count):
        z[k] = xs[k]
        cost = calls.enter(k)
        true = np.zeros((q, 1 + n))
        true[:n, 0], true[n:, 0] = gain @ noises[k], noises[k]
        true[:n, 1:], true[n:, 1:] = -found["f_jacobian"][k], -found["h_jacobian"][k]
        weighted, squared = weight @ true, true.T @ weight @ true
        if not np.isfinite(squared).all() or not np.isfinite(found["f"][k]).all():
            if np.isfinite(cost):
                return "a stage is finite, but not by CasADi's interpreter"
            continue
        error = np.zeros_like(true)
        error[n:, 0], error[:n, 0] = allowed_noises[k], abs(gain) @ allowed_noises[k]
        for rows, name in ((slice(None, n), "f_jacobian"), (slice(n, None), "h_jacobian")):
            size = abs(found[name][k]).max(axis=1, keepdims=True)
            error[rows, 1:] = ROUNDING * (size + (name[0] == "f")) + found[f"spread_{name}"][k]
        most, heavy = abs(true) + error, abs(weight)
        off = (1 + ROUNDING) * heavy @ most - heavy @ abs(true)
        off_squared = (1 + ROUNDING) * most.T @ heavy @ most - abs(true).T @ heavy @ abs(true)
        band, off_band = np.zeros((n, 2 * n)), np.zeros((n, 2 * n))
        for c in range(n):
            column = np.concatenate((squared[1 + c :, 1 + c], weighted[:n, 1 + c]))
            band[c, : column.size] = column
            column = np.concatenate((off_squared[1 + c :, 1 + c], off[:n, 1 + c]))
            off_band[c, : column.size] = column
        ahead = found["f"][k] + true[:n, 0]
        off_ahead = ROUNDING * (abs(xs[k]) + abs(found["f"][k])) + found["spread_f"][k]
        for got, one, allowed in (
            (linear[k], true, error), (panel[k], band, off_band),
            (own[k], squared[1:, 0], off_squared[1:, 0]),
            (following[k], weighted[:n, 0], off[:n, 0]),
            (z[k + 1], ahead, off_ahead + error[:n, 0]),
            (np.array(cost), squared[0, 0], off_squared[0, 0]),
        ):
            if differs(got, np.asarray(one), np.asarray(allowed)):
                return "a stage's Gauss-Newton terms differ from those of CasADi's interpreter"
    z[:count] = xs
    for first, length in ((0, count), (1, count - 1), (2, 3), (count - 1, 1)):
        stages = slice(first, first + length)
        calls.states[:length], calls.states[length] = xs[stages], 0.9 * xs[first]
        cost = calls.judge(first, length)
        ahead = calls.states[1 : length + 1]
        true = np.column_stack((ahead - found["f"][stages], noises[stages]))
        error = np.column_stack((
            ROUNDING * (abs(ahead) + abs(xs[stages]) + abs(found["f"][stages]))
            + found["spread_f"][stages],
            allowed_noises[stages],
        ))
        if differs(calls.residuals[:length], true, error):
            return "a trajectory's residuals differ from those of CasADi's interpreter"
        most = abs(true) + error
        total = float(((true @ weight) * true).sum())
        allowed = float(((most @ abs(weight)) * most).sum() * (1 + ROUNDING)
                        - ((abs(true) @ abs(weight)) * abs(true)).sum())
        if differs(np.array(cost), np.array(total), np.array(allowed)):
            return "a trajectory's cost differs from that of CasADi's interpreter"
    return ""
