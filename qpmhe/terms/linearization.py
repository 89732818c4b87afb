"""Gauss-Newton terms of the stages: what each stage adds to the QP's Hessian and gradient."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.qp import band_index

from ..model.model import Model
from .entries import StageProducts
from .sparse_stages import SparseStages

Array = NDArray[np.float64]


class Stage:
    """Views of one stage of `StageTerms`, made once since making them takes as long as using them.

    Attributes
    ----------
    residual, slopes : array
        r (n + p,) and -G (n + p, n), or its entries.
    linear, transposed : array
        :math:`[r, -G]` (n + p, 1 + n), and its transpose; not of entries.
    disturbance, noise : array
        The parts w (n,) and v (p,) of r.
    minus_a, minus_c : array
        The parts -A (n, n) and -C (p, n) of -G, or their entries.
    panel, gradient, next_gradient : array
        The stage's terms.
    """

    __slots__ = (
        "disturbance", "gradient", "linear", "minus_a", "minus_c", "next_gradient", "noise",
        "panel", "residual", "slopes", "transposed",
    )

    def __init__(self, terms: StageTerms, k: int) -> None:
        self.linear = linear = terms.linear[k]
        self.transposed, n, of_a = linear.T, terms.n, terms.of_a
        self.residual, self.slopes = terms.residuals[k], terms.slopes[k]
        self.disturbance, self.noise = self.residual[:n], self.residual[n:]
        self.minus_a, self.minus_c = self.slopes[:of_a], self.slopes[of_a:]
        self.panel, self.gradient = terms.panel[k], terms.gradient[k]
        self.next_gradient = terms.next_gradient[k]


class Span:
    """Views of successive stages of `StageTerms`, cut into the parts that a QP adds up.

    Attributes
    ----------
    minus_jacobian : (count, n + p, n) array
        The :math:`-G_i`, or their entries.
    panel : (count, n, 2n) array
        The panels.
    gradient_first, gradient_rest : array
        ``gradient`` of the first stage, and of all after it.
    next_gradient_rest, next_gradient_last : array
        ``next_gradient`` of all stages but the last, and of the last.
    """

    __slots__ = (
        "gradient_first", "gradient_rest", "minus_jacobian", "next_gradient_last",
        "next_gradient_rest", "panel",
    )

    def __init__(self, terms: StageTerms, first: int, count: int) -> None:
        last = first + count
        self.minus_jacobian = terms.slopes[first:last]
        self.panel = terms.panel[first:last]
        self.gradient_first = terms.gradient[first]
        self.gradient_rest = terms.gradient[first + 1 : last]
        self.next_gradient_rest = terms.next_gradient[first : last - 1]
        self.next_gradient_last = terms.next_gradient[last - 1]


class StageTerms:
    r"""What each stage adds to a QP in the increments d of the trajectory.

    The joint residual of stage i is :math:`r_i = (w_i, v_i)`, with
    :math:`w_i = x_{i+1} - f(x_i)` and :math:`v_i = y_i - h(x_i)`. Linearised,
    :math:`r_i + E d_{i+1} - G_i d_i` with :math:`G_i = [A_i; C_i]` and :math:`E = [I; 0]`:
    ``linear[i]`` :math:`= [r_i, -G_i]` and the weight :math:`W_i`, with its block :math:`Q_i`
    for w, define the stage. Half the weighted square :math:`\tfrac12 |r_i|_{W_i}^2` adds

    - ``panel[i]``: the band of :math:`G_i^\top W_i G_i` and of the coupling block
      :math:`-Q_i A_i` below it, without :math:`Q_{i-1}` of the stage before;
    - ``gradient[i]``: :math:`-G_i^\top W_i r_i`, with respect to :math:`d_i`;
    - ``next_gradient[i]``: :math:`Q_i w_i`, with respect to :math:`d_{i+1}`.

    Its arrays are those given, in the order of the attributes, or its own.

    Attributes
    ----------
    linear : (stages, n + p, 1 + n) array
        :math:`[r_i, -G_i]`.
    residuals : (stages, n + p) array
        The :math:`r_i` in it, a view.
    slopes : (stages, n + p, n) array
        The :math:`-G_i`, likewise.
    of_a : int
        How many rows of these, or entries, are those of -A.
    panel, gradient, next_gradient : array
        (stages, n, 2n), (stages, n), (stages, n).
    """

    __slots__ = (
        "_flat", "_gradient_column", "_next_column", "_panel_index", "_sparse", "_square",
        "_weighted", "_zeros", "gradient", "linear", "n", "next_gradient", "of_a", "panel",
        "residuals", "slopes",
    )

    def __init__(self, stages: int, n: int, p: int, *arrays: Array) -> None:
        q, wide = n + p, 1 + n
        if not arrays:
            shapes = (stages, q, wide), (stages, n, 2 * n), (stages, n), (stages, n)
            arrays = tuple(np.zeros(shape) for shape in shapes)
        self.linear, self.panel, self.gradient, self.next_gradient = arrays
        self.residuals: Array = self.linear[:, :, 0]
        self.slopes: Array = self.linear[:, :, 1:]
        self.n = self.of_a = n
        # Workspace for one stage, with M = [r, -G]: M^T W M, then W M, then a number that stays 0.
        self._flat = np.zeros(wide**2 + q * wide + 1)
        self._square = self._flat[: wide**2].reshape(wide, wide)
        self._weighted = self._flat[wide**2 : -1].reshape(q, wide)
        self._zeros = np.zeros(self._flat.size)
        # First columns: that of M^T W M is -G^T W r below its corner, that of W M begins with Q w.
        self._gradient_column, self._next_column = self._square[1:, 0], self._weighted[:n, 0]
        self._panel_index = _panel_index(n, p)
        self._sparse = SparseStages.of(n)

    def linearise(self, model: Model, states: Array, inputs: Array, first: int = 0) -> Array:
        """Set the slopes of successive stages to those of a model; return them, a view."""
        slopes = self.slopes[first : first + states.shape[0]]
        a, c = model.linear(states, inputs)
        np.negative(a, slopes[:, : self.n])
        np.negative(c, slopes[:, self.n :])
        return slopes

    def set_stage(self, stage: Stage, weight: Array) -> float:
        """Compute a stage's terms from its ``linear``; return its cost, NaN if they overflow."""
        if self._sparse is not None:
            cost = self._sparse.set_stage(
                stage.linear, weight, stage.panel, stage.gradient, stage.next_gradient
            )
            if cost is not None:
                return cost
        flat, weighted = self._flat, self._weighted
        weight.dot(stage.linear, weighted)
        stage.transposed.dot(weighted, self._square)
        flat.take(self._panel_index, None, stage.panel, "clip")
        stage.gradient[...] = self._gradient_column
        stage.next_gradient[...] = self._next_column
        # 0 times anything that is not finite is NaN, so one product checks all entries.
        return float(flat[0] + flat.dot(self._zeros))

    def set_all(self, count: int, weight: Array, first: int = 0) -> Array:
        """Compute terms of successive stages as `set_stage` does; return their costs."""
        span = slice(first, first + count)
        linear = self.linear[span]
        weighted = np.matmul(weight, linear)
        square = np.matmul(linear.transpose(0, 2, 1), weighted)
        flat = np.concatenate(
            (square.reshape(count, -1), weighted.reshape(count, -1), np.zeros((count, 1))), axis=1
        )
        flat.take(self._panel_index, axis=1, out=self.panel[span], mode="clip")
        self.gradient[span] = square[:, 1:, 0]
        self.next_gradient[span] = weighted[:, : self.gradient.shape[1], 0]
        costs: Array = flat[:, 0] + flat.dot(self._zeros)
        return costs


class SparseStageTerms(StageTerms):
    r"""The same of entries: ``linear[i]`` is r (n + p,) and then the entries of -G."""

    __slots__ = ("_products",)

    def __init__(self, stages: int, products: StageProducts, *arrays: Array) -> None:
        n, q, entries = products.n, products.slopes.starts.size - 1, products.slopes.size
        if not arrays:
            shapes = (q + entries,), (products.pattern.places.size,), (n,), (n,)
            arrays = tuple(np.zeros((stages, *shape)) for shape in shapes)
        self.linear, self.panel, self.gradient, self.next_gradient = arrays
        self.residuals, self.slopes = self.linear[:, :q], self.linear[:, q:]
        self.n, self.of_a = n, int(products.slopes.starts[n])
        self._products = products

    def linearise(self, model: Model, states: Array, inputs: Array, first: int = 0) -> Array:
        """See `StageTerms.linearise`."""
        slopes = self.slopes[first : first + len(states)]
        np.negative(model.entries(states, inputs), slopes)
        return slopes

    def set_stage(self, stage: Stage, weight: Array) -> float:
        """See `StageTerms.set_stage`."""
        return float(self._products.compute(
            stage.residual, stage.slopes, weight, stage.panel, stage.gradient, stage.next_gradient
        ))

    def set_all(self, count: int, weight: Array, first: int = 0) -> Array:
        """See `StageTerms.set_all`."""
        span = slice(first, first + count)
        return self._products.compute(
            self.residuals[span], self.slopes[span], weight, self.panel[span],
            self.gradient[span], self.next_gradient[span],
        )


def _panel_index(n: int, p: int) -> NDArray[np.intp]:
    """Indices of a stage's panel in the flat workspace [M^T W M, W M, 0]."""
    wide = 1 + n
    square = np.arange(wide * wide).reshape(wide, wide)
    weighted = wide * wide + np.arange((n + p) * wide).reshape(n + p, wide)
    zero = np.array([wide * wide + weighted.size])
    # The block that couples to the next stage is -Q A, the upper part of -W G.
    blocks = np.concatenate((square[1:, 1:].ravel(), weighted[:n, 1:].ravel(), zero))
    return blocks[band_index(n)]
