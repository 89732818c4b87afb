"""Scaling of QPs to numbers without units, and back."""

from __future__ import annotations

import math
from itertools import count

import numpy as np
from numpy.typing import NDArray

from .qp import QP, Places

Mask = NDArray[np.bool_]

# Scales kept at a time: for QPs of other sizes, and for projections between estimations.
_KEPT = 4
# A scale is held while the peaks of the scaled numbers stay between these. Steps have more room
# below, since those of a sequence of QPs shrink as the sequence converges.
_PEAKS = 2.0**-8, 2.0**8
_STEP_PEAKS = 2.0**-10, 2.0**3
# Spread of the Hessian's diagonal over the stages at which the least known stage, rather than the
# best, is what the accuracy is for; and below which share double precision has none.
_SPREAD, _LEAST = 2.0**10, 2.0**-34
# A limit that is farther away than this many units of the unknown, or of the step if that is
# longer, is not handed to a solver: interior points lose their accuracy beside such limits.
_FARTHEST = 2.0**24
# Largest exponent: products of two factors do not overflow.
_MOST = 500


class Scale:
    r"""Powers of two that take QPs of one size to numbers of order one, exactly.

    .. math::
        d_k = t S d'_k, \quad H' = c\, S H S, \quad g' = c\, S g / t, \quad F' = R F S, \quad
        a' = R a / t

    with a diagonal S, the same at all stages, that brings the diagonal of H' to about 1 or less,
    for each component, or to more where a stage would be lost beside the others; a diagonal R
    that does so for the largest entry of each row; and one number t, for the unit of the cost,
    that does so for the gradient or the step, as `Peaks` puts them together. The cost's unit is
    :math:`t^2 / c`, with c = 1 or 1/2, as its square root need not be a power of two.

    ``step``, (K, n), is the unit of d, t S; ``units`` and ``duals``, (K n + K rows,), are those of
    the constraints, t S and t / R, and of their multipliers, t / (c S) and t R / c, bounds first;
    ``cost`` is the value of the objective, t squared over c.
    """

    __slots__ = (
        "_factors", "_farthest", "_unknown", "cost", "duals", "key", "sizes", "step", "units",
    )

    def __init__(
        self, exponents: NDArray[np.int64], odd: int, sizes: tuple[int, int, int], key: int
    ) -> None:
        stages, n, rows = self.sizes = sizes
        self.key = key
        self._unknown: list[int] = []
        S, R, (t,) = np.split(np.ldexp(1.0, exponents), (n, n + rows))
        c = 0.5**odd
        factors = QP(*sizes)
        factors.band = c * S[:, None] * S[(np.arange(n)[:, None] + np.arange(2 * n)) % n]
        factors.gradient = c * S / t
        factors.row_own = factors.row_next = R[:, None] * S
        factors.lower = factors.upper = 1.0 / (S * t)
        factors.row_lower = factors.row_upper = R / t
        self._factors = factors.numbers
        self.cost = float(t * t / c)
        # In units of S where the step is shorter: else the limits would go as a sequence converges.
        self._farthest = _FARTHEST * max(1.0, 1.0 / float(t))
        self.units, self.duals = 1.0 / factors.all_lower, factors.all_lower * self.cost
        self.step = self.units[: stages * n].reshape(stages, n)

    def apply(self, qp: QP, scaled: QP) -> None:
        """Write the scaled numbers of a QP."""
        np.multiply(qp.numbers, self._factors, out=scaled.numbers)
        scaled.key = self.key

    def drop_far(self, scaled: QP) -> Mask | None:
        """Make far limits of a scaled QP infinite; a mask of them, None if none is far."""
        most, none = self._farthest, np.inf
        far: Mask = np.concatenate((scaled.all_lower < -most, scaled.all_upper > most))
        far &= np.isfinite(scaled.limits)
        if not far.any():
            return None
        lower, upper = np.split(far, 2)
        scaled.all_lower[lower], scaled.all_upper[upper] = -none, none
        return far

    def leave_out(self, peaks: list[float]) -> None:
        """Note the parts whose unit is not known, because all their numbers are zero."""
        self._unknown = [at for at, peak in enumerate(peaks) if not peak > 0.0]

    def fits(self, peaks: list[float]) -> bool:
        """Whether scaled numbers with these peaks are of order one."""
        if any(peaks[at] > 0.0 for at in self._unknown):
            return False
        *others, last = peaks
        least, most = _STEP_PEAKS
        if last > 0.0 and not least <= last <= most:
            return False
        least, most = _PEAKS
        return all(peak == 0.0 or least <= peak <= most for peak in others)


class Peaks:
    """What shows how well the numbers of QPs of one size are scaled, the signs left out."""

    def __init__(self, stages: int, n: int, rows: int) -> None:
        self._n, size, places = n, stages * n, Places.of(stages, n, rows)
        diagonal = np.arange(places.gradient).reshape(stages, n, 2 * n)[:, :, 0].T
        own, following = np.arange(places.own, places.one).reshape(2, stages, rows, n)
        gradient = np.arange(places.gradient, places.own).reshape(stages, n).T
        limits = np.arange(places.lower, places.end)
        # Gradients, then steps, then violations at zero, which are lower - 0 and 0 - upper, then
        # the diagonal with the other sign, whose largest entries are its smallest. The last
        # stage's G is never read.
        groups = [
            *diagonal,
            *(np.append(own[:, row], following[:-1, row]) for row in range(rows)),
            gradient, gradient, limits, *diagonal,
        ]
        self._entries = np.concatenate(groups, axis=None)
        seen = self._seen = np.empty(self._entries.size)
        magnitudes = seen.size - limits.size - size
        self._magnitudes, self._diagonal = seen[:magnitudes], seen[:size]
        self._steps = seen[magnitudes - size : magnitudes]
        self._negated = seen[magnitudes + limits.size // 2 :]
        self._positive = np.empty(size, np.bool_)
        self._starts = np.cumsum([0] + [group.size for group in groups[:-1]])

    def of(self, qp: QP) -> list[float]:
        """The peaks of the diagonal for each component, of each row, and of the step."""
        # Any mode but the default one writes into ``out`` without a buffer between.
        qp.numbers.take(self._entries, out=self._seen, mode="clip")
        diagonal, steps, positive = self._diagonal, self._steps, self._positive
        np.absolute(self._magnitudes, out=self._magnitudes)
        np.greater(diagonal, 0.0, out=positive)
        np.divide(steps, diagonal, out=steps, where=positive)
        np.negative(self._negated, out=self._negated)
        found: list[float] = np.maximum.reduceat(self._seen, self._starts).tolist()
        negated = found[-self._n :]
        slope, step, missed = found[-self._n - 3 : -self._n]
        del found[-self._n - 2 :]
        found[-1] = max(min(slope, step), missed)
        for at, low in enumerate(negated):
            most = found[at]
            if -low * _SPREAD < most:
                found[at] = min(most, _SPREAD * max(-low, _LEAST * most))
        return found


class Scaling:
    """The scales of one solver, and ``qp``, the last scaled QP."""

    def __init__(self, held: bool) -> None:
        self._held = held
        self._scales: list[Scale] = []  # the last used is the last one
        self._keys = count(1)
        self._hold((1, 1, 0))

    def __reduce__(self) -> tuple[type[Scaling], tuple[bool]]:
        return Scaling, (self._held,)

    def forget(self) -> None:
        """Drop the scales: the next one is that of the next QP alone."""
        self._scales.clear()

    def drop(self, key: int) -> None:
        """Drop the scale of this key."""
        self._scales = [scale for scale in self._scales if scale.key != key]

    def _hold(self, sizes: tuple[int, int, int]) -> None:
        """Make room for QPs of these sizes."""
        self.qp, self._peaks = QP(*sizes), Peaks(*sizes)

    def scale(self, qp: QP) -> Scale:
        """Scale a QP, whose numbers are finite but for limits, into `Scaling.qp`."""
        if self.qp.sizes != qp.sizes:
            self._hold(qp.sizes)
        scaled, scales = self.qp, self._scales
        scaled.bounded = qp.bounded
        if not self._held:
            scales.clear()
        for at in range(len(scales) - 1, -1, -1):
            scale = scales[at]
            if scale.sizes == qp.sizes:
                scale.apply(qp, scaled)
                if scale.fits(self._peaks.of(scaled)):
                    if at < len(scales) - 1:
                        scales.append(scales.pop(at))
                    return scale
        scale = self._ideal(qp, scaled)
        scale.apply(qp, scaled)
        if len(scales) == _KEPT:
            del scales[0]
        scales.append(scale)
        return scale

    def _ideal(self, qp: QP, scaled: QP) -> Scale:
        """The best scale for one QP."""
        n, key = qp.n, next(self._keys)
        exponents = np.zeros(n + qp.rows + 1, np.int64)
        peaks = self._peaks.of(qp)[:n]
        # A unit of the cost changes all the diagonal's exponents, units of unknowns the even part.
        odd = next((math.frexp(peak)[1] % 2 for peak in peaks if peak > 0.0), 0)
        exponents[:n] = np.clip(-((np.frexp(peaks)[1] - odd) // 2), -_MOST, _MOST)
        Scale(exponents, odd, qp.sizes, key).apply(qp, scaled)
        if qp.rows:
            found = np.frexp(self._peaks.of(scaled)[n:-1])[1]
            exponents[n:-1] = np.clip(-found, -_MOST, _MOST)
            R = np.ldexp(1.0, exponents[n:-1])
            scaled.row_lower *= R
            scaled.row_upper *= R
        peaks = self._peaks.of(scaled)
        exponents[-1] = np.clip(math.frexp(peaks[-1])[1], -_MOST, _MOST)
        scale = Scale(exponents, odd, qp.sizes, key)
        scale.leave_out(peaks)
        return scale
