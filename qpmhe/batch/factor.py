"""Block-tridiagonal systems of many members, solved together by Cholesky factorisation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .terms import Terms

__all__ = ["BlockCholesky"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Bytes of one stage's panels that are worked on together: what stays in a cache.
_CACHE = 2**21

# Fewer members than this at a time, and calls cost more than numbers.
_LEAST = 256

# Rows of a block whose update leaves out what is above the diagonal.
_ROWS = 6


class BlockCholesky:
    r"""Solve :math:`H_k e_k = g_k` for members k, where H is that of the unconstrained QP.

    H is block-tridiagonal: :math:`H_{ii} = D_i + Q`, the prior's weight in place of Q at
    the first stage, nothing but Q at the last; :math:`H_{i+1,i} = E_i`. With
    :math:`H = L L^\top`, stage by stage,

    .. math::
        L_{ii} L_{ii}^\top = H_{ii} - X_{i-1} X_{i-1}^\top, \quad
        X_i = E_i L_{ii}^{-\top}, \quad y_i = L_{ii}^{-1} (g_i - X_{i-1} y_{i-1}).

    A panel holds, per stage, the rows of :math:`L_{ii}`, then :math:`y_i^\top` as one row
    more, then those of :math:`X_i`: one loop over its columns does all three. Members are
    the last axis of every array, so that each operation is one on long vectors.

    Parameters
    ----------
    prior, disturbance : (n, n) array
        Weights of the initial error and of the disturbances.
    horizon : int
        The longest window.
    members : int
        How many members there are at most.
    """

    def __init__(self, prior: Array, disturbance: Array, horizon: int, members: int) -> None:
        n = prior.shape[0]
        self._n, self._prior, self._disturbance = n, prior[:, :, None], disturbance[:, :, None]
        rows = 2 * n + 1
        width = max(_LEAST, _CACHE // (8 * rows * n))
        self._parts = max(1, round(members / width))
        self._width = width = -(-members // self._parts)
        self._panels = np.zeros((horizon + 1, rows, n, width))
        self._inverse = np.zeros((horizon + 1, n, width))
        self._update = np.empty((n, n, width))
        self._column = np.empty((rows, width))
        self._steps = np.zeros((horizon + 1) * n * members)

    def solve(
        self,
        terms: Terms,
        slots: Sequence[int],
        discounts: Array | None,
        prior_gradient: Array | None,
    ) -> tuple[Array, Array, Mask]:
        """Solve the systems of all members that the terms hold.

        Parameters
        ----------
        terms : Terms
            D, E and the gradients of the stages.
        slots : sequence of int
            Where in the terms the window's stages are, oldest first.
        discounts : (N_t + 1,) array or None
            Factors of the prior, in front, and of the stages; None for ones.
        prior_gradient : (n, K) array or None
            Gradient of the prior's term at the first state; None for zero.

        Returns
        -------
        steps : (N_t + 1, n, K) array
            e; it lives in a workspace until the next solve.
        promised : (K,) array
            g^T e.
        sound : (K,) bool array
            Whether H was positive definite and all is finite.
        """
        stages, members = len(slots) + 1, terms.members
        steps = self._steps[: stages * self._n * members].reshape(stages, self._n, members)
        promised, sound = np.empty(members), np.empty(members, np.bool_)
        for first in range(0, members, self._width):
            part = slice(first, min(first + self._width, members))
            width = part.stop - first
            panels, inverse = self._panels[:stages, ..., :width], self._inverse[:stages, :, :width]
            gradient = None if prior_gradient is None else prior_gradient[:, part]
            self._forwards(terms, slots, part, discounts, gradient, panels, inverse)
            mine = steps[..., part]
            self._backwards(panels, inverse, mine)
            y = panels[:, self._n]
            np.einsum("ijk,ijk->k", y, y, out=promised[part])
            # Pivots that are not positive or not finite: their inverse roots are not either.
            squares = np.einsum("ijk,ijk->k", mine, mine) + np.add.reduce(inverse, axis=(0, 1))
            sound[part] = (inverse.min(axis=(0, 1)) > 0.0) & np.isfinite(squares)
        return steps, promised, sound

    def _forwards(
        self,
        terms: Terms,
        slots: Sequence[int],
        part: slice,
        discounts: Array | None,
        prior_gradient: Array | None,
        panels: Array,
        inverse: Array,
    ) -> None:
        n, count = self._n, len(slots)
        for i in range(count + 1):
            panel = panels[i]
            square, gradient, below = panel[:n], panel[n], panel[n + 1 :]
            weight = self._disturbance if i else self._prior
            if discounts is not None:
                weight = weight * discounts[i]
            if i == count:
                square[...], gradient[...], panel = weight, 0.0, panel[: n + 1]
            elif discounts is None:
                np.add(terms.square[slots[i], ..., part], weight, out=square)
                gradient[...] = terms.own[slots[i], :, part]
                below[...] = terms.below[slots[i], ..., part]
            else:
                factor = discounts[i + 1]
                np.multiply(terms.square[slots[i], ..., part], factor, out=square)
                square += weight
                np.multiply(terms.own[slots[i], :, part], factor, out=gradient)
                np.multiply(terms.below[slots[i], ..., part], factor, out=below)
            if i:
                following = terms.following[slots[i - 1], :, part]
                gradient += following if discounts is None else discounts[i] * following
                self._eliminate(panels[i - 1], square, gradient)
            elif prior_gradient is not None:
                gradient += prior_gradient
            self._factorise(panel, inverse[i])

    def _eliminate(self, before: Array, square: Array, gradient: Array) -> None:
        """Subtract what the stage before leaves of this one."""
        n, width = self._n, square.shape[2]
        coupling = before[n + 1 :]
        for first in range(0, n, _ROWS):
            rows = slice(first, min(first + _ROWS, n))
            work = self._update[rows, : rows.stop, :width]
            np.einsum("ilk,jlk->ijk", coupling[rows], coupling[: rows.stop], out=work)
            square[rows, : rows.stop] -= work
        work = self._update[0, :, :width]
        np.einsum("lk,jlk->jk", before[n], coupling, out=work)
        gradient -= work

    def _factorise(self, panel: Array, inverse: Array) -> None:
        """Turn the panel's rows into those of L, y and X; ``inverse`` is that of L's diagonal."""
        width = panel.shape[2]
        for j in range(self._n):
            column = panel[j:, j]
            if j:
                work = self._column[j : panel.shape[0], :width]
                np.einsum("rlk,lk->rk", panel[j:, :j], panel[j, :j], out=work)
                column -= work
            pivot = inverse[j]
            np.sqrt(column[0], out=pivot)
            np.reciprocal(pivot, out=pivot)
            column[1:] *= pivot

    def _backwards(self, panels: Array, inverse: Array, steps: Array) -> None:
        n, last, width = self._n, steps.shape[0] - 1, steps.shape[2]
        for i in range(last, -1, -1):
            panel, step = panels[i], steps[i]
            if i < last:
                work = self._column[:n, :width]
                np.einsum("rjk,rk->jk", panel[n + 1 :], steps[i + 1], out=work)
                np.subtract(panel[n], work, out=step)
            else:
                step[...] = panel[n]
            for j in range(n - 1, -1, -1):
                if j < n - 1:
                    work = self._column[0, :width]
                    np.einsum("rk,rk->k", panel[j + 1 : n, j], step[j + 1 :], out=work)
                    step[j] -= work
                step[j] *= inverse[i, j]
