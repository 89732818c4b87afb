"""Gauss-Newton terms of the stages: what each adds to the QP's Hessian and gradient."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_index

__all__ = ["Span", "Stage", "StageTerms"]

Array = NDArray[np.float64]


class Stage:
    """Views of one stage of `StageTerms`, made once: making them takes as long as using them.

    Attributes
    ----------
    linear, transposed : array
        :math:`[r, -G]` (n + p, 1 + n), and its transpose.
    disturbance, noise : array
        The parts w (n,) and v (p,) of r.
    minus_f, minus_h : array
        The parts -A (n, n) and -C (p, n) of -G.
    panel, current, next : array
        The stage's terms.
    """

    __slots__ = (
        "current",
        "disturbance",
        "linear",
        "minus_f",
        "minus_h",
        "next",
        "noise",
        "panel",
        "transposed",
    )

    def __init__(self, terms: StageTerms, k: int) -> None:
        self.linear = linear = terms.linear[k]
        self.transposed = linear.T
        n = linear.shape[1] - 1
        self.disturbance, self.noise = linear[:n, 0], linear[n:, 0]
        self.minus_f, self.minus_h = linear[:n, 1:], linear[n:, 1:]
        self.panel, self.current, self.next = terms.panel[k], terms.current[k], terms.next[k]


class Span:
    """Views of some successive stages of `StageTerms`, as a QP takes them in.

    Attributes
    ----------
    minus_jacobian : (count, n + p, n) array
        The :math:`-G_i`.
    panel : (count, n, 2n) array
        The panels.
    current_first, current_rest : array
        ``current`` of the first stage, and of all behind it.
    next_rest, next_last : array
        ``next`` of all stages but the last, and of the last.
    """

    __slots__ = (
        "current_first",
        "current_rest",
        "minus_jacobian",
        "next_last",
        "next_rest",
        "panel",
    )

    def __init__(self, terms: StageTerms, first: int, count: int) -> None:
        last = first + count
        self.minus_jacobian = terms.linear[first:last, :, 1:]
        self.panel = terms.panel[first:last]
        self.current_first = terms.current[first]
        self.current_rest = terms.current[first + 1 : last]
        self.next_rest = terms.next[first : last - 1]
        self.next_last = terms.next[last - 1]


class StageTerms:
    r"""Terms of a run of stages in the increments d of the trajectory.

    The joint residual of stage i is :math:`r_i = (w_i, v_i)`, with
    :math:`w_i = x_{i+1} - f(x_i)` and :math:`v_i = y_i - h(x_i)`. Linearised,
    :math:`r_i + E d_{i+1} - G_i d_i` with :math:`G_i = [A_i; C_i]` and :math:`E = [I; 0]`:
    the map ``linear[i]`` :math:`= [r_i, -G_i]` is all that is known of a stage. Half the
    weighted square :math:`\tfrac12 |r_i|_{W_i}^2` adds

    - ``panel[i]``: the band of :math:`G_i^\top W_i G_i` and of the coupling block
      :math:`-Q_i A_i` below it, without :math:`Q_{i-1}` of the stage before;
    - ``current[i]``: :math:`-G_i^\top W_i r_i`, the gradient with respect to :math:`d_i`;
    - ``next[i]``: :math:`Q_i w_i`, the gradient with respect to :math:`d_{i+1}`.

    Attributes
    ----------
    linear : (stages, n + p, 1 + n) array
        :math:`[r_i, -G_i]`.
    residuals : (stages, n + p) array
        The :math:`r_i` in it, a view.
    panel, current, next : array
        (stages, n, 2n), (stages, n), (stages, n).
    """

    __slots__ = (
        "_first",
        "_flat",
        "_index",
        "_own",
        "_square",
        "_weighted",
        "_zeros",
        "current",
        "linear",
        "next",
        "panel",
        "residuals",
    )

    def __init__(self, stages: int, n: int, p: int) -> None:
        q = n + p
        self.linear: Array = np.zeros((stages, q, 1 + n))
        self.residuals: Array = self.linear[:, :, 0]
        self.panel: Array = np.zeros((stages, n, 2 * n))
        self.current: Array = np.zeros((stages, n))
        self.next: Array = np.zeros((stages, n))
        # Of one stage, with M = [r, -G]: M^T W M, behind it W M, and a number that stays 0.
        self._flat = np.zeros((1 + n) ** 2 + q * (1 + n) + 1)
        self._square = self._flat[: (1 + n) ** 2].reshape(1 + n, 1 + n)
        self._weighted = self._flat[(1 + n) ** 2 : -1].reshape(q, 1 + n)
        self._zeros = np.zeros(self._flat.size)
        # -G^T W r, and W r of the disturbances, W M's first column.
        self._own, self._first = self._square[1:, 0], self._weighted[:n, 0]
        self._index = _places(n, p)

    @property
    def jacobian(self) -> Array:
        """The Jacobians G_i (stages, n + p, n), a copy."""
        return -self.linear[:, :, 1:]

    def set_stage(self, stage: Stage, weight: Array) -> float:
        """Compute the terms of a stage from its linear map, which is in place already."""
        flat, weighted = self._flat, self._weighted
        weight.dot(stage.linear, weighted)
        stage.transposed.dot(weighted, self._square)
        flat.take(self._index, None, stage.panel, "clip")
        stage.current[...] = self._own
        stage.next[...] = self._first
        # 0 times what is not finite is NaN, and no square overflows on the way.
        return float(flat[0] + flat.dot(self._zeros))

    def set_all(self, count: int, weight: Array) -> None:
        """Compute the terms of the first stages, their linear maps in view."""
        linear = self.linear[:count]
        weighted = np.matmul(weight, linear)
        square = np.matmul(linear.transpose(0, 2, 1), weighted)
        flat = np.concatenate(
            (square.reshape(count, -1), weighted.reshape(count, -1), np.zeros((count, 1))), axis=1
        )
        flat.take(self._index, axis=1, out=self.panel[:count], mode="clip")
        self.current[:count] = square[:, 1:, 0]
        self.next[:count] = weighted[:, : self.current.shape[1], 0]

    def copy_scaled(self, terms: StageTerms, first: int, factors: Array) -> None:
        """Take over the stages of other terms from ``first`` on, each times its factor."""
        count = factors.size
        stages = slice(first, first + count)
        self.linear[:count] = terms.linear[stages]
        np.multiply(terms.panel[stages], factors[:, None, None], out=self.panel[:count])
        np.multiply(terms.current[stages], factors[:, None], out=self.current[:count])
        np.multiply(terms.next[stages], factors[:, None], out=self.next[:count])

    def arrays(self) -> tuple[Array, ...]:
        """The arrays, each with one entry a stage."""
        return self.linear, self.panel, self.current, self.next


def _places(n: int, p: int) -> NDArray[np.intp]:
    """Where the panel of a stage stands in [M^T W M, W M, 0], flat."""
    wide = 1 + n
    square = np.arange(wide * wide).reshape(wide, wide)
    weighted = wide * wide + np.arange((n + p) * wide).reshape(n + p, wide)
    zero = np.array([wide * wide + weighted.size])
    # The block that couples to the next stage is -Q A, the upper part of -W G.
    blocks = np.concatenate((square[1:, 1:].ravel(), weighted[:n, 1:].ravel(), zero))
    return blocks[band_index(n)]
