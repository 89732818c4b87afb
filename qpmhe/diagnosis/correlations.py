"""Correlations of a filter's innovations, over time and with the inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from .bank import Array

#: An innovation beyond so many deviations is an outlier.
OUTLIER = 4.0
_LAGS = 20
# Innovations are also judged over so few samples.
_SOON = 5
# Pairs that have a correlation, and the share of its mean square by which a signal varies.
_PAIRS, _CONSTANT = 3, 1e-12


@dataclass(frozen=True, eq=False)
class Correlations:
    """Correlations of the normalised innovations.

    Attributes
    ----------
    own : (L + 1, p) array
        Autocorrelation of each sensor's innovations at lags 0, ..., L.
    inputs : (L + 1, p, 2 m) array
        Correlation with the inputs and with their changes, at these lags before.
    limit : float
        Limit that contains 95 % of the correlations of white innovations.
    """

    own: Array
    inputs: Array
    limit: float

    @classmethod
    def of(cls, normalised: Array, signals: Array) -> Correlations:
        """Those of normalised innovations (T, p), with inputs (T, m).

        Outliers count as the limit that they exceed.
        """
        total, p = normalised.shape
        lags = min(_LAGS, total // 4)
        bounded = np.clip(normalised, -OUTLIER, OUTLIER)
        both = np.hstack((signals, np.diff(signals, axis=0, prepend=signals[:1])))
        own, inputs = np.ones((lags + 1, p)), np.zeros((lags + 1, p, both.shape[1]))
        # A controller may use y(t) for u(t): only earlier inputs are evidence.
        for lag in range(1, lags + 1):
            found = _between(bounded[lag:], np.hstack((bounded, both))[:-lag])
            own[lag], inputs[lag] = found[:, :p].diagonal(), found[:, p:]
        seen = int(np.isfinite(normalised).any(axis=1).sum())
        return cls(own, inputs, 1.96 / np.sqrt(max(seen, 1)))


def coloured(
    normalised: Array, signals: Array, least: float, sure: float
) -> list[tuple[int, int, float]]:
    """Sensors whose innovations are not white, with the lag and size of their correlation.

    This exceeds ``least``, and is due to chance with a probability below ``sure``.
    """
    own, there = Correlations.of(normalised, signals).own[1:], np.isfinite(normalised)
    total, p = there.shape
    lags = np.arange(1, len(own) + 1)
    # Only pairs of which both were measured are evidence.
    pairs = np.array([(there[lag:] & there[:-lag]).sum(axis=0) for lag in lags])
    weights = total * (total + 2) / (total - lags) ** 2
    sums = np.cumsum(weights[:, None] * pairs * own**2, axis=0)
    found = []
    for j in range(p):
        k = int(np.argmax(np.abs(own[:, j])))
        ends = {min(_SOON, len(own)), len(own)}
        chance = min(float(chdtrc(some, sums[some - 1, j])) for some in ends)
        if chance < sure and abs(own[k, j]) > least:
            found.append((j, k + 1, float(own[k, j])))
    return found


def _between(one: Array, other: Array) -> Array:
    """Correlations of columns (p, q) where both are there; 0 where they are fewer than three."""
    products = []
    for x in (one, other):
        there = np.isfinite(x)
        x = np.where(there, x - x.mean(axis=0, where=there), 0.0)
        products.append((there.astype(np.float64), x, x**2))
    (there, x, squares), (there2, z, squares2) = products
    counts = there.T @ there2
    fewest = np.maximum(counts, 1.0)
    sums, sums2 = x.T @ there2, there.T @ z
    sizes = []
    for total, part in ((squares.T @ there2, sums), (there.T @ squares2, sums2)):
        size = total - part**2 / fewest
        sizes.append(np.where(size > _CONSTANT * total, size, 0.0))
    size = np.sqrt(sizes[0] * sizes[1])
    known = (counts >= _PAIRS) & (size > 0.0)
    shared = x.T @ z - sums * sums2 / fewest
    return np.asarray(np.divide(shared, size, out=np.zeros_like(size), where=known))
