"""Gauss-Newton terms of the stages: what each adds to the QP's Hessian and gradient."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_index

__all__ = ["StageTerms"]

Array = NDArray[np.float64]


class StageTerms:
    r"""Terms of a run of stages in the increments d of the trajectory.

    The joint residual of stage i is :math:`r_i = (w_i, v_i)`, with
    :math:`w_i = x_{i+1} - f(x_i)` and :math:`v_i = y_i - h(x_i)`. Linearised,
    :math:`r_i + E d_{i+1} - G_i d_i` with :math:`G_i = [A_i; C_i]` and :math:`E = [I; 0]`.
    Half its weighted square :math:`\tfrac12 |r_i|_{W_i}^2` adds

    - ``panel[i]``: the band of :math:`G_i^\top W_i G_i` and of the coupling block
      :math:`-Q_i A_i` below it, without :math:`Q_{i-1}` of the stage before;
    - ``own[i]``: :math:`-G_i^\top W_i r_i`, the gradient with respect to :math:`d_i`;
    - ``following[i]``: :math:`Q_i w_i`, the gradient with respect to :math:`d_{i+1}`.

    Parameters
    ----------
    stages : int
        How many stages there is room for.
    n, p : int
        Numbers of states and outputs.
    """

    __slots__ = (
        "_flat", "_index", "_minus", "_n", "_one", "_square", "_weighted",
        "following", "jacobian", "own", "panel",
    )

    def __init__(self, stages: int, n: int, p: int) -> None:
        self._n = n
        self.jacobian: Array = np.zeros((stages, n + p, n))
        self.panel: Array = np.zeros((stages, n, 2 * n))
        self.own: Array = np.zeros((stages, n))
        self.following: Array = np.zeros((stages, n))
        self._index = band_index(n)
        # Of one stage: -G, the numbers that `band_index` points to, and their parts, -W G
        # behind G^T W G; the block below the diagonal is the upper part of the former.
        self._minus = np.empty((n + p, n))
        self._flat = np.zeros(n * n + (n + p) * n + 1)  # the last one stays 0
        self._square = self._flat[: n * n].reshape(n, n)
        self._weighted = self._flat[n * n : -1].reshape(n + p, n)
        self._one = np.where(self._index == 2 * n * n, self._flat.size - 1, self._index)

    def set_stage(self, k: int, weight: Array, residual: Array, weighted_residual: Array) -> None:
        """Compute the terms of stage k from its Jacobian, which is in place already."""
        minus, weighted = self._minus, self._weighted
        np.negative(self.jacobian[k], out=minus)
        np.dot(weight, minus, out=weighted)
        np.dot(minus.T, weighted, out=self._square)
        self._flat.take(self._one, out=self.panel[k], mode="clip")
        np.dot(residual, weighted, out=self.own[k])
        self.following[k] = weighted_residual[: self._n]

    def set_all(self, weight: Array, residuals: Array, weighted_residuals: Array) -> None:
        """Compute the terms of the first len(residuals) stages, their Jacobians in place.

        The weight is one for all stages, (q, q), or one for each, (stages, q, q).
        """
        n, count = self._n, residuals.shape[0]
        jacobian = self.jacobian[:count]
        weighted = np.matmul(weight, jacobian)
        flat = np.zeros((count, 2 * n * n + 1))
        flat[:, : n * n] = np.matmul(jacobian.transpose(0, 2, 1), weighted).reshape(count, -1)
        np.negative(weighted[:, :n].reshape(count, -1), out=flat[:, n * n : -1])
        panel = self.panel[:count].reshape(count, -1)
        flat.take(self._index.ravel(), axis=1, out=panel, mode="clip")
        np.negative(np.matmul(residuals[:, None, :], weighted)[:, 0], out=self.own[:count])
        self.following[:count] = weighted_residuals[:, :n]

    def copy_scaled(self, terms: StageTerms, first: int, factors: Array) -> None:
        """Take over the stages of other terms from ``first`` on, each times its factor."""
        count = factors.size
        stages = slice(first, first + count)
        self.jacobian[:count] = terms.jacobian[stages]
        np.multiply(terms.panel[stages], factors[:, None, None], out=self.panel[:count])
        np.multiply(terms.own[stages], factors[:, None], out=self.own[:count])
        np.multiply(terms.following[stages], factors[:, None], out=self.following[:count])

    def arrays(self) -> tuple[Array, ...]:
        """The arrays, each with one entry a stage."""
        return self.jacobian, self.panel, self.own, self.following

    def keep_last(self, end: int, keep: int) -> None:
        """Move the stages end-keep, ..., end-1 to the front."""
        for array in self.arrays():
            array[:keep] = array[end - keep : end]
