"""A QP in the form of qpsolvers: laid out once for a pattern of limits, then only filled."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .gathered import GatheredQP
from .native.layout import Layout, Structure, Style
from .qp import QP

__all__ = ["QpsolversMatrices", "pattern_of_limits"]

Array = NDArray[np.float64]


def pattern_of_limits(qp: QP) -> Hashable:
    """What `QpsolversMatrices` depends on: the sizes, and which limits are finite or equal."""
    gathered = GatheredQP.of(qp)
    equal = gathered.all_lower == gathered.all_upper
    return gathered.sizes, np.isfinite(gathered.limits).tobytes(), equal.tobytes()


class QpsolversMatrices:
    r"""The arrays of a QP in the form of qpsolvers, for one pattern of limits.

    .. math::
        \min_x \tfrac12 x^\top P x + q^\top x \quad \text{s.t.} \quad
        G x \le h, \quad A x = b, \quad l \le x \le u

    G takes the constraints with a finite upper side, then those with a finite lower side, negated:
    the bounds, unless these go to l and u, and the general rows. A takes the general rows whose
    sides are equal.

    Attributes
    ----------
    arguments : tuple
        P, q, G, h, A, b, l, u, made once; None for what there is not.
    """

    def __init__(
        self, qp: QP, *, dense: bool, box: bool, needs_row: bool, keep_empty: bool,
        objective: float = 1.0,
    ) -> None:
        gathered = GatheredQP.of(qp)
        equal = gathered.all_lower == gathered.all_upper
        equal[: qp.size] = False
        lower, upper = (
            np.isfinite(side) & ~equal for side in (gathered.all_lower, gathered.all_upper)
        )
        style = Style(
            "dense" if dense else "csc", bounds="box" if box else "rows", sides=1,
            needs_row=needs_row, objective=objective,
        )
        self._layout = layout = Layout(style, Structure(lower, upper, equal), *gathered.sizes)
        rows = keep_empty or layout.upper.size > 0
        level = keep_empty or layout.level.size > 0
        self.arguments = (
            layout.hessian, layout.gradient,
            layout.matrix if rows else None, layout.upper if rows else None,
            layout.equality_matrix if level else None, layout.level if level else None,
            layout.box_lower if layout.boxed else None, layout.box_upper if layout.boxed else None,
        )

    def fill(self, qp: QP) -> None:
        """Write the numbers of a QP into the arguments."""
        self._layout.fill(GatheredQP.of(qp), None)

    def multipliers(self, answer: Any) -> tuple[Array | None, Array | None]:
        """Multipliers of the QP's bounds and rows; None twice where some are missing."""
        layout, parts = self._layout, []
        for values, size in (
            (answer.z, layout.upper.size), (answer.y, layout.level.size),
            (answer.z_box, layout.size if layout.boxed else 0),
        ):
            numbers = np.empty(0)
            if size and values is not None:
                numbers = np.asarray(values, np.float64).ravel()
            if numbers.size < size:
                return None, None
            parts.append(numbers[:size])
        duals = layout.duals(*parts)
        return duals[: layout.size], duals[layout.size :]
