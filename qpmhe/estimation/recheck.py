"""Validation of a window from a snapshot: its stages, computed again, must agree."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..terms.linearization import StageTerms
from .snapshot import check_root, mismatch, near
from .window import Window

Array = NDArray[np.float64]


def check_stages(window: Window, loaded: Window, terms: bool) -> None:
    """Compute the stages of a loaded window again, and raise if the loaded ones differ.

    The first window, loaded from the same state, then holds the computed ones; ``terms`` says
    whether both are to have the terms of QPs.
    """
    count, first = window.end, window.time - window.end
    with np.errstate(all="ignore"):
        _check_roots(loaded)
        for k in range(count):
            window._set_weight(k, first + k)
            what = _difference(window, k, first + k, loaded, terms)
            metric = window.metric
            if what and metric is not None and metric.settled:
                # A stage that was computed before the metric settled.
                final, metric.state = metric.state, (metric.initial, True)
                what = _difference(window, k, first + k, loaded, terms)
                metric.state = final
            if what:
                raise mismatch(what)
            # After a failed stage, `restart` may have set it; elsewhere it has been compared.
            window._z[k + 1] = loaded._z[k + 1]
            if window._covariances is not None and loaded._covariances is not None:
                window._covariances[k + 1] = loaded._covariances[k + 1]
            if window._roots is not None and loaded._roots is not None:
                window._roots[k + 1] = loaded._roots[k + 1]
                window._vague[k + 1] = loaded._vague[k + 1]
            if window._rejections is not None and loaded._rejections is not None:
                window._rejections[k + 1] = loaded._rejections[k + 1]


def _check_roots(loaded: Window) -> None:
    """Raise if a root is not that of its covariance."""
    if loaded._roots is None or loaded._covariances is None:
        return
    for k in np.flatnonzero(loaded._vague[: loaded.end + 1]):
        check_root(loaded._roots[k], loaded._covariances[k])


def _difference(window: Window, k: int, time: int, loaded: Window, terms: bool) -> str:
    """Compute stage k; what differs from the loaded one, or blank."""
    window._compute_stage(k, time)
    succeeded = math.isfinite(loaded._stage_costs[k])
    if succeeded != math.isfinite(window._stage_costs[k]):
        return "model"
    if not succeeded:  # without a correction
        return "model" if loaded.terms.residuals[k, : window._n].any() else ""
    for what, found, expected, size in _comparisons(window, k, loaded, terms):
        if not near(found, expected, size):
            return what
    return ""


def _comparisons(
    window: Window, k: int, loaded: Window, terms: bool
) -> Iterator[tuple[str, Array, Array, Array | float]]:
    """What must agree, the loaded and the computed numbers, and the size of their terms."""
    n, mine, saved, weight = window._n, window.terms, loaded.terms, window._weights[k]
    flags = [np.append(one._observed[k], one._special[k]) * 1.0 for one in (loaded, window)]
    yield "weight of the stages' cost", flags[0], flags[1], 0.0
    yield "weight of the stages' cost", loaded._weights[k], weight, np.abs(weight).max()
    correction, v = mine.residuals[k, :n], mine.residuals[k, n:]
    yield "model (h)", saved.residuals[k, n:], v, np.abs(window._y[k]) + np.abs(v)
    reached = np.maximum(np.abs(loaded._z[: window.end + 1]).max(axis=0), np.abs(correction))
    yield "observer", saved.residuals[k, :n], correction, reached
    yield "model (f)", loaded._z[k + 1], window._z[k + 1], reached
    if window._covariances is not None and loaded._covariances is not None:
        expected = window._covariances[k + 1]
        spread = np.sqrt(np.abs(expected.diagonal()))
        yield "observer", loaded._covariances[k + 1], expected, np.outer(spread, spread)
    if window._rejections is not None and loaded._rejections is not None:
        yield "observer", loaded._rejections[k + 1] * 1.0, window._rejections[k + 1] * 1.0, 0.0
    r, weight = saved.residuals[k], loaded._weights[k]
    cost = window._evaluate_costs(r[None], weight)[0]
    size = np.abs(r).dot(np.abs(weight)).dot(np.abs(r)) if window._quadratic else cost
    yield "cost", loaded._stage_costs[k], cost, size
    if not (terms and (window.has_terms or window._quadratic)):
        return
    jacobian, weight = mine.linear[k, :, 1:], window._majorising_weights[k]
    size = np.nan_to_num(np.abs(jacobian)).max(axis=1, keepdims=True)
    yield "model (its Jacobians)", saved.linear[k, :, 1:], jacobian, size
    yield "cost", loaded._majorising_weights[k], weight, np.abs(weight).max()
    exact, bound = StageTerms(1, n, r.size - n), StageTerms(1, n, r.size - n)
    exact.linear[0], weight = saved.linear[k], loaded._majorising_weights[k]
    bound.linear[0] = np.abs(exact.linear[0])
    exact.set_all(1, weight)
    bound.set_all(1, np.abs(weight))
    sizes = bound.arrays()
    for name, expected in exact.arrays().items():
        yield "weight of the stages' cost", saved.arrays()[name][k], expected[0], sizes[name][0]
