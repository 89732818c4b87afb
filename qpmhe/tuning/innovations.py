"""Whether the innovations of a tuned filter are as its covariances say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri

from .._checks import Array
from ..diagnosis.bank import FilterBank, Hypothesis
from ..diagnosis.findings import listed, number, percent
from ..model.system import System
from .data import Data
from .weights import Weights

# Lags whose correlations are looked at; the chance below which a sensor's are no accident, and the
# correlation from which on they matter.
_LAGS, _SURE, _MATTERS = 10, 1e-4, 0.1
# Deviations beyond which an innovation is outlying, the share of them that matters (of normal ones
# 1 in 16,000 is that far off), and how many there are at least.
_OUTLYING, _SHARE, _FEW = 4.0, 2e-3, 3
# One filter alone takes NumPy as long as so many of those that run together.
_ALONE = 10
# Of deviations of a filter that outliers have made too large, the threshold that is proposed.
_THRESHOLD = 1.5


@dataclass(frozen=True, eq=False)
class Innovations:
    """The innovations of the extended Kalman filter with the likeliest weights, over all records.

    Attributes
    ----------
    nis : float
        The mean normalised innovation squared of a measurement; 1 is expected.
    nis_limits : (float, float)
        Limits that contain 99 % of such means.
    correlations : (L, p) array
        Of each output's innovations over 1, ..., L samples.
    chances : (p,) array
        How likely such correlations are of white innovations (Ljung and Box).
    outlying : (p,) array
        Shares beyond 4 standard deviations.
    """

    nis: float
    nis_limits: tuple[float, float]
    correlations: Array
    chances: Array
    outlying: Array
    labels: tuple[str, ...]

    @property
    def coloured(self) -> list[int]:
        """The outputs whose innovations are correlated in time, and so that it matters."""
        sizes = np.abs(self.correlations).max(axis=0)
        return np.flatnonzero((self.chances < _SURE) & (sizes > _MATTERS)).tolist()

    @property
    def text(self) -> str:
        """The table's last line."""
        low, high = self.nis_limits
        lag, j = np.unravel_index(
            int(np.argmax(np.abs(self.correlations))), self.correlations.shape)
        return (
            f"Innovations of the likeliest filter: their mean NIS is {self.nis:.3g} ({low:.2f} to "
            f"{high:.2f} expected); their largest correlation is {self.correlations[lag, j]:.2g}, "
            f"of {self.labels[j]} over {lag + 1} sample{'s' * bool(lag)}."
        )

    def notes(self, threshold: float | None) -> list[str]:
        """What they say of the intervals and of outliers."""
        found = []
        low, high = self.nis_limits
        names = [self.labels[j] for j in self.coloured]
        if names:
            found.append(
                f"the intervals are too narrow: the innovations of {listed(names)} are not white, "
                "so the model's error or a sensor's noise is correlated in time; qpmhe.diagnose "
                "looks for the cause."
            )
        elif threshold is None and not low < self.nis < high:
            found.append(
                f"the intervals are too narrow: the mean NIS of {number(self.nis)} is not the one "
                "of a right model."
            )
        far = np.flatnonzero(self.outlying > _SHARE).tolist()
        if far and threshold is None:
            shares = listed([f"{percent(self.outlying[j])} of {self.labels[j]}" for j in far])
            found.append(
                f"there are outliers, {shares} beyond {_OUTLYING:g} standard deviations, which "
                f"make the noise's covariance too large; tune with threshold={_THRESHOLD:g}."
            )
        return found


def innovations_of(
    system: System, weights: Weights, data: Sequence[Data], labels: Sequence[str]
) -> Innovations | None:
    """The innovations of the filter with these weights; None where it fails."""
    entering = system.state_covariance(weights.disturbance)
    errors: list[Array] = []
    squares, count, p = 0.0, 0, system.p
    for one in data:
        hypothesis = Hypothesis(
            one.y, one.inputs(system, weights.parameters), weights.noise, entering, one.start,
            weights.prior,
        )
        with np.errstate(all="ignore"):
            found = FilterBank(system, one.dt, filters=_ALONE * len(data)).run([hypothesis])
        if not np.isfinite(found.logs).all():
            return None
        there = np.isfinite(found.innovations)
        plain = np.where(there, found.innovations, 0.0)
        squares += float(np.einsum("ti,tij,tj->", plain, found.weights, plain))
        count += int(there.sum())
        errors.append(found.normalised)
    lags = min(_LAGS, max(map(len, errors)) - 2)
    if lags < 1 or not count:
        return None
    sums, pairs, power = np.zeros((lags, p)), np.zeros((lags, p)), np.zeros(p)
    seen, far = np.zeros(p), np.zeros(p)
    for each in errors:
        there = np.isfinite(each).astype(np.float64)
        bounded = np.clip(np.where(there > 0.0, each, 0.0), -_OUTLYING, _OUTLYING)
        seen, power = seen + there.sum(axis=0), power + (bounded**2).sum(axis=0)
        far += (np.abs(each) > _OUTLYING).sum(axis=0)
        for lag in range(1, min(lags, len(each) - 1) + 1):
            sums[lag - 1] += (bounded[lag:] * bounded[:-lag]).sum(axis=0)
            pairs[lag - 1] += (there[lag:] * there[:-lag]).sum(axis=0)
    variance = np.maximum(power / np.maximum(seen, 1), 1e-300)
    correlations = sums / np.maximum(pairs, 1) / variance
    chances = np.asarray(chdtrc(lags, (pairs * correlations**2).sum(axis=0)))
    low, high = (float(chdtri(count, share)) / count for share in (0.995, 0.005))
    few = far < _FEW
    return Innovations(
        squares / count, (low, high), correlations, chances,
        np.where(few, 0.0, far / np.maximum(seen, 1)), tuple(labels),
    )
