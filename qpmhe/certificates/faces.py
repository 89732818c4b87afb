r"""What a projection of the observer onto X, in P, makes of the bounds on its error.

With the rows A of the faces that are active at :math:`z^+`, and :math:`\bar e = x^+ - \bar z` the
prediction's error,

.. math::
    e^+ = \bar e + P^{-1} A^\top \lambda, \qquad \lambda \ge 0, \qquad A e^+ \le 0 .

So :math:`g^\top e^+ = g^\top \bar e` for each g with :math:`A P^{-1} g = 0`; and where the faces
bound one component alone, :math:`e_k^+` is between :math:`\bar e_k` and 0. The docs derive it, in
*What is guaranteed*.
"""

from __future__ import annotations

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from .invariance import supports
from .regions import Region, row_bounds
from .sizes import OUTWARD, UNIT

# Less than what rounding makes of the length beyond which predictions are projected by themselves.
_INWARD = 1.0 - 1e-9


class Faces:
    """The faces of X that may be active, and directions in which errors are not moved.

    Parameters
    ----------
    X : ConvexSet
        The set onto which the observer is projected.
    region : Region
        Where the state and the observer are.
    metric, slopes : (n, n) and (n,) array
        P, and the roots of its inverse's diagonal, rounded up.
    radius : float
        The limit of |x - z|_P. The bounds that are within this reach of the region are those that
        may be active; where another face may be, only the ball counts.
    """

    def __init__(
        self, X: ConvexSet, region: Region, metric: Array, slopes: Array, radius: float
    ) -> None:
        n, self._slopes = region.n, slopes
        lower, upper = region.lower[:n], region.upper[:n]
        # How far z is from x at least where a bound of its component is active.
        self._room = _less(np.minimum(lower - X.lower, X.upper - upper))
        low, high = row_bounds(X.matrix, lower, upper)
        rows = _less(np.minimum(low - X.row_lower, X.row_upper - high))
        #: Below which |x - z|_P no row is active, nor a prediction so far from X that it is
        #: projected by itself.
        self._most = float(np.min(rows / supports(metric, X.matrix), initial=np.inf))
        widths = X.upper - X.lower
        if np.isfinite(widths).all():
            square = float(widths @ np.abs(metric) @ widths)
            self._most = min(self._most, _INWARD * float(np.sqrt(square)))
        self._least = radius
        #: The components whose bounds may be active, and the others.
        self.block = np.flatnonzero(self._active(radius))
        self.rest = np.setdiff1d(np.arange(n), self.block)
        #: Directions (r, n), one for each of the others: its unit vector, less what moves with the
        #: block. They are P q with q = 0 in the block.
        q = np.zeros((self.rest.size, n))
        own = np.ix_(self.rest, self.rest)
        q[:, self.rest] = np.linalg.inv(metric[own])
        self.directions: Array = q @ metric
        # What rounding leaves of A P^-1 g: of the errors' move, which is at most the ball.
        missed = (n + 4) * UNIT * (np.abs(q) @ np.abs(metric))
        self._rounding = missed @ slopes * OUTWARD
        # What a direction has of the block, and a little of the others.
        self._others: Array = np.abs(self.directions - np.eye(n)[self.rest])

    @property
    def reached(self) -> bool:
        """Whether any face may be active in the limit."""
        return self.may_act(self._least)

    def may_act(self, radius: float) -> bool:
        """Whether any face may be active where |x - z|_P is at most a radius."""
        return bool(self._active(radius).any()) or not radius < self._most

    def _active(self, radius: float) -> Array:
        """The components of which a bound may be active, where |x - z|_P is at most a radius."""
        return np.asarray(self._slopes * radius * OUTWARD >= self._room)

    def oblique(self, box: Array) -> Array:
        """Bounds on |g e| of all directions that follow from a box."""
        found: Array = np.abs(self.directions) @ box * OUTWARD
        return found

    def projected(self, reached: Array, radius: float) -> tuple[Array, Array]:
        """Bounds on all |e_i| and |g e| behind a projection, from those before, (n + r,).

        Of errors with |e|_P at most a radius.
        """
        n = self._slopes.size
        box: Array = self._slopes * radius * OUTWARD
        active = self._active(radius)
        if not radius < self._most or active[self.rest].any():
            return box, self.oblique(box)
        if not active.any():
            return np.minimum(box, reached[:n]), reached[n:]
        oblique = (reached[n:] + self._rounding * radius) * OUTWARD
        one, most = self.block.size == 1, box.copy()
        if one:
            box[self.block] = np.minimum(box[self.block], reached[self.block])
        moved = (oblique + self._others @ box) * OUTWARD
        if one:
            # The error lies on the segment that begins before the projection; at its other end the
            # component of the block is 0.
            most[self.block] = 0.0
            ends = np.maximum(reached[self.rest], (oblique + self._others @ most) * OUTWARD)
            moved = np.minimum(moved, ends)
        box[self.rest] = np.minimum(box[self.rest], moved)
        return box, oblique


def _less(room: Array) -> Array:
    """Differences, rounded down; infinite ones stay."""
    found: Array = np.where(np.isinf(room), room, np.nextafter(room, -np.inf))
    return found
