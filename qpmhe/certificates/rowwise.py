r"""The observer's error component by component: one step of a box, row by row.

For an observer that is not projected, :math:`e^+ = \varphi(x) - \varphi(z) + G w - L v` with
:math:`\varphi = f - L h`. Along the segment from z to x, with the Jacobian M of
:math:`\varphi`, whose rows are :math:`m_i`,

.. math::
    |e_i^+| \le \sup_s |m_i(s)\, e| + \sup_{w \in W} |(G w)_i| + \sup_{v \in V} |(L v)_i| ,

and for e with :math:`|e|_P \le b` and :math:`|e_j| \le \beta_j`, for every split
:math:`m = m' + m''` of a row,

.. math::
    |m\, e| \le |m'|_{P^{-1}}\, b + \sum_j |m''_j|\, \beta_j .

The left-hand side is convex in m: where rows lie in a convex hull, its corners decide. The docs
derive it, in *What is guaranteed*.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from ..model.system import System
from .branch_and_bound import halves_of
from .deadline import Deadline
from .enclosures import Enclosure, SmoothModel
from .faces import Faces
from .inequalities import Matrices
from .regions import Region, inequalities, support
from .sizes import OUTWARD, UNIT, Size, extent_of, sides_of, weighted_lengths
from .tube import Tube

# Pieces of the region; numbers that their rows may take; what of a row's size may stay as error.
_MOST_CELLS, _HELD, _SHARP = 512, 3_000_000, 0.01
# More than the rounding of the sums and products of a step, for each state.
_STEP = 64.0 * UNIT

Rows = list[tuple[Array, Array]]


class RowwiseStep:
    """One step of the bounds on an observer's error, by rows of its Jacobian on a region.

    Parameters
    ----------
    system : System
        The certified system.
    region : Region
        Where its state and the observer's are.
    gain : (n, p) array
        L.
    inverse : (n, n) array
        A matrix that is at least the inverse of P.
    seconds : float or Deadline
        How long the region may be divided for: coarser rows give a larger step. If the time is over
        before f has been compared with its expression everywhere, no rows are known.
    faces : Faces, optional
        Of a system with an X: its directions g have rows as well, behind those of the states.
    """

    def __init__(
        self, system: System, region: Region, gain: Array, inverse: Array,
        seconds: float | Deadline = math.inf, faces: Faces | None = None,
    ) -> None:
        self._region, self._gain, self._inverse = region, gain, inverse
        self.faces = faces
        self._directions = np.zeros((0, system.n)) if faces is None else faces.directions
        self._model: SmoothModel | None = SmoothModel(system, region)
        self._free, n = self._model.free, system.n
        G = system.disturbance_matrix
        self._matrix = np.eye(n) if G is None else G
        self._scales = np.where(
            region.upper > region.lower, region.upper - region.lower, 1.0
        )[: n][self._free]
        #: Rows everywhere in the region, by state; None where they are not known.
        self.rows: Rows | None = None
        if not self._model.reason:
            self.rows = self._everywhere(Deadline.of(seconds))
        #: Whether rows vary in the region, so that fewer occur near a state.
        self.varies = self.rows is not None and any(
            len(middle) > 1 or (error > _SHARP * np.abs(middle).max()).any()
            for middle, error in self.rows
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without the model, whose functions cannot be pickled: with the rows everywhere alone."""
        return vars(self) | {"_model": None}

    def added(self, disturbances: Size, noises: Size) -> Array:
        """What w and v add to each component and direction, always (n + r,) or (T, n + r)."""
        w = self._reach("disturbances", disturbances, self._matrix)
        v = self._reach("noises", noises, self._gain)
        return (w + v) * OUTWARD

    def _reach(self, name: str, given: Size, matrix: Array) -> Array:
        """The largest of each row of a matrix and of each direction's rows."""
        D, size = self._directions, matrix.shape[1]
        found = _reaches(name, given, np.vstack((matrix, D @ matrix)))
        if len(D):
            rounding = (len(matrix) + 4) * UNIT * (np.abs(D) @ np.abs(matrix))
            found[..., len(matrix) :] += rounding @ extent_of(name, given, size)
        return found

    def step(self, tube: Tube, observer: Array | None = None, u: Array | None = None) -> Array:
        """Bounds (n + r,) of what becomes of e without w and v; infinite where they are not known.

        Of its components and along the directions; with the observer's state and input for states
        within this distance alone.
        """
        box = tube.box
        n = len(box)
        found = np.full(n + len(self._directions), np.inf)
        if self.rows is None:
            return found
        found = self._reached(self.rows, tube)
        if observer is None or self._model is None or not self.varies:
            return found
        region, margin = self._region, UNIT * (np.abs(observer) + box)
        lower, upper = region.lower.copy(), region.upper.copy()
        lower[:n] = np.maximum(lower[:n], np.minimum(observer - box - margin, upper[:n]))
        upper[:n] = np.minimum(upper[:n], np.maximum(observer + box + margin, lower[:n]))
        if u is not None and u.size:
            lower[n:] = upper[n:] = u
        rows, _ = self._rows(self._model.enclose(lower[None], upper[None]))
        return found if rows is None else np.minimum(found, self._reached(rows, tube))

    def _reached(self, rows: Rows, tube: Tube) -> Array:
        """The largest |m e| of all rows of each state, and of each direction."""
        free, D, own = self._free, self._directions, tube.box[self._free]
        found = np.append(tube.box, np.abs(D) @ tube.box)  # states that the region fixes stay
        outward = 1.0 + len(tube.box) * _STEP
        by_directions, rest = np.zeros((0, 0)), np.zeros(0, np.intp)
        if len(D):
            assert self.faces is not None
            oblique = self.faces.oblique(tube.box)
            if tube.oblique.size:
                oblique = np.minimum(oblique, tube.oblique)
            kept = np.isin(self.faces.rest, free)
            rest = np.searchsorted(free, self.faces.rest[kept])
            oblique, by_directions = oblique[kept], D[kept][:, free]
        which = np.append(free, np.arange(len(tube.box), len(found)))
        for i, (middle, error) in zip(which, rows, strict=True):
            least = self._split(middle, own, tube.radius)
            if len(rest):
                # All of a row that is not in the block by directions.
                parts = middle[:, rest]
                left = middle - parts @ by_directions
                missed = len(own) * _STEP * (np.abs(middle) + np.abs(parts) @ np.abs(by_directions))
                other = np.abs(parts) @ oblique + self._split(left, own, tube.radius)
                least = np.minimum(least, other + missed @ own)
            found[i] = (least + error @ own).max() * outward
        if len(D):
            fixed = np.setdiff1d(np.arange(len(tube.box)), free)
            found[len(tube.box) :] += np.abs(D[:, fixed]) @ tube.box[fixed]
        return found

    def _split(self, rows: Array, own: Array, radius: float) -> Array:
        """The largest |m e| of rows (k, n): the least of n + 1 splits between ball and box."""
        free, slopes = self._free, np.sqrt(self._inverse.diagonal())
        inverse = self._inverse[np.ix_(free, free)]
        with np.errstate(all="ignore"):
            share = own / (slopes[free] * radius)
        # By the box where it is narrow beside the ball, by the ball elsewhere.
        order = np.argsort(np.nan_to_num(share, nan=np.inf))
        size = np.abs(rows)
        least: Array = size @ own
        for k in range(len(order)):
            kept, rest = order[k:], order[:k]
            ball = weighted_lengths(rows[:, kept], inverse[np.ix_(kept, kept)]) * radius
            least = np.minimum(least, ball + size[:, rest] @ own[rest])
        return least

    def _rows(self, enclosure: Enclosure) -> tuple[Rows | None, Array]:
        """Rows of A - L C whose hull, widened by the errors, holds all; and each cell's errors.

        And behind them those of g (A - L C) for each direction g.
        """
        free, L = self._free, Matrices.exact(self._gain[self._free])
        n = free.size
        corners, error = enclosure.corners()
        J = Matrices(corners, np.broadcast_to(error[:, None], corners.shape))
        M = J[..., :n, :] - L @ J[..., n:, :]
        along = Matrices.exact(self._directions[:, free]) @ M
        # In parts of the region's width: which cells are worth dividing.
        spread = np.max(M.radius[:, 0] @ self._scales / self._scales, axis=1)
        if not np.isfinite(M.middle).all() or not np.isfinite(M.radius).all():
            return None, spread
        rows = []
        middle, radius = (
            np.concatenate((getattr(M, part), getattr(along, part)), axis=-2)
            for part in ("middle", "radius")
        )
        for i in range(middle.shape[-2]):
            both = np.concatenate((middle[..., i, :], radius[..., i, :]), axis=-1)
            both = np.unique(both.reshape(-1, 2 * n), axis=0)
            rows.append((both[:, :n], both[:, n:]))
        return rows, spread

    def _everywhere(self, deadline: Deadline) -> Rows | None:
        """The rows of all cells of the region."""
        model, region = self._model, self._region
        assert model is not None
        n = self._free.size
        most = int(np.clip(_HELD / (64 * n * n), 1, _MOST_CELLS))
        lower, upper = region.lower[None], region.upper[None]
        division = deadline.part(0.5)
        while True:
            enclosure = model.enclose(lower, upper)
            rows, spread = self._rows(enclosure)
            wide = np.flatnonzero(~(spread <= _SHARP))
            wide = wide[np.argsort(-np.nan_to_num(spread[wide], nan=np.inf), kind="stable")]
            wide = wide[: most - len(lower)]
            if not len(wide) or division.passed:
                return rows if model.agrees([(lower, upper)], deadline) else None
            kept = np.setdiff1d(np.arange(len(lower)), wide)
            low, high = halves_of(region, lower[wide], upper[wide], enclosure.excess[wide])
            lower, upper = np.vstack((lower[kept], low)), np.vstack((upper[kept], high))


def _reaches(name: str, given: Size, rows: Array) -> Array:
    """The largest |g s| of each row g, (n,), for what `Sizes` takes; (T, n) of vectors (T, r)."""
    size, up = np.abs(rows), 1.0 + (2 * rows.shape[1] + 8) * UNIT
    if isinstance(given, ConvexSet):
        sides = sides_of(name, given)
        found: Array = np.maximum(*(
            np.maximum(sign * rows * sides[0], sign * rows * sides[1]).sum(axis=1)
            for sign in (1.0, -1.0)
        ))
        # Differences of large terms are rounded as these are.
        found += (rows.shape[1] + 4) * UNIT * (size @ np.abs(sides).max(axis=0))
        if given.matrix.size:
            (A, a), largest = inequalities(given), np.abs(sides).max()
            for i, row in enumerate(rows):
                ends = [support(A, a, e)[1:] for e in (row, -row)]
                found[i] = min(found[i], max(
                    (side + residual * largest) * up + UNIT * abs(side) for side, residual in ends
                ))
    else:
        values = np.asarray(given, np.float64)
        found = np.abs(values @ rows.T) if values.ndim else np.linalg.norm(rows, axis=1) * values
        if values.ndim:
            found += (rows.shape[1] + 4) * UNIT * (np.abs(values) @ size.T)
    outward: Array = found * up
    return outward
