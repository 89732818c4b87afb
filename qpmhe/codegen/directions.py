"""Sets and weights of disturbances w, converted for the C step to d = x(t+1) - f(x(t))."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost, lifted
from ..estimation.constraints import Constraints
from ..model.sets import ConvexSet
from ..model.system import System
from ..observers import Observer
from ..terms.base import TermForm
from ..terms.prior import PriorCost
from ..terms.rows import Rows
from ..terms.soft import SOFT, Penalties
from ..terms.sum import CostSum

Array = NDArray[np.float64]

#: Sides of a set.
SIDES = ("lower", "upper", "row_lower", "row_upper")


class Directions:
    """Conversion between w (r,) and d (n,), which are equal unless w has fewer directions.

    Parameters
    ----------
    system, observer, cost : System, Observer and Cost
        As the user gave them.

    Attributes
    ----------
    system, observer : System and Observer
        As given.
    cost : Cost
        The cost of d.
    """

    def __init__(self, system: System, observer: Observer, cost: Cost) -> None:
        self.cost = lifted(cost, system.disturbance_matrix, observer.initial_covariance())
        self.system, self.observer = system, observer

    @cached_property
    def constraints(self) -> Constraints:
        """The rows on states, d and noises, and the noise-free directions."""
        return self.constraints_of(self.system, self.cost)

    def constraints_of(self, system: System, cost: Cost) -> Constraints:
        """The same for a system with other sets, and a cost of d with other weights."""
        return Constraints(system, cost, PriorCost(system, self.observer, cost))

    def terms_of(self, system: System, cost: Cost) -> tuple[TermForm, ...]:
        """The terms of J that not every estimator has."""
        prior = PriorCost(system, self.observer, cost)
        constraints, rows = Constraints(system, cost, prior), self.rows_of(system, cost)
        forms = CostSum(system, cost, prior, lambda: constraints.basis).c_forms
        return forms if cost.space is None else tuple(
            one._replace(data=self._on_d(one.data, rows)) if one.name == SOFT else one
            for one in forms
        )

    def _on_d(self, penalties: Mapping[str, Array], rows: Rows | None) -> dict[str, Array]:
        """Penalties of all rows of a stage, with those on d in place of those of W."""
        given, found = self.system.set_of("disturbances"), dict(penalties)
        if rows is None:
            return found
        first = 0 if given is None else given.dimension + len(given.matrix)
        for name, usual in (("linear", np.inf), ("quadratic", 0.0)):
            own = np.append(penalties[name][:first], usual)  # the last of noise-free directions
            bounds = np.full(self.system.n, usual)
            found[name] = np.concatenate((bounds, own[rows.numbers], penalties[name][first:]))
        return found

    @property
    def quiet(self) -> int:
        """Noise-free directions of the cost, at least 1 where d has any; 0 where it has none."""
        space = self.cost.space
        if space is None or self.constraints.directions is None:
            return 0
        return max(int(space.noise_free.shape[1]), 1)

    @property
    def free(self) -> int | None:
        """Directions in which trials have disturbances; None where these are all."""
        count = int(self.constraints.basis.shape[1])
        return None if count == self.system.n else count

    def elimination(self, system: System, cost: Cost) -> dict[str, Array]:
        """A basis F of the free directions, F^+ and c, with d = F e + c for all d of trials."""
        constraints, shift = self.constraints_of(system, cost), np.zeros(system.n)
        space, basis = cost.space, constraints.basis
        inverse = basis.T
        if space is None:
            shift[constraints.noise_free] = constraints.constant
        else:
            # In scaled numbers, the basis is orthonormal.
            inverse = (basis / space.scale[:, None]).T / space.scale
            if constraints.directions is not None:
                shift = constraints.directions.offset
        if not basis.size:
            basis = inverse = np.zeros((1, 1))  # C has no arrays of length 0
        return {"free": basis, "free_inverse": inverse, "shift": shift}

    def projections(self, system: System, cost: Cost) -> dict[str, Array]:
        """Projections of d along the noise-free directions, and those of the cost as rows."""
        space, directions = cost.space, self.constraints_of(system, cost).directions
        assert space is not None
        assert directions is not None
        rows = np.zeros((self.quiet, system.n))
        rows[: space.noise_free.shape[1]] = space.noise_free.T
        return {
            "keep": directions.projection, "candidate_keep": directions.candidate_projection,
            "directions": rows,
        }

    @property
    def rows(self) -> Rows | None:
        """The rows on d in place of the set W; None where W itself is on d."""
        return None if self.cost.space is None else self.rows_of(self.system, self.cost)

    def rows_of(self, system: System, cost: Cost) -> Rows | None:
        """The same for a system with other sets, and a cost of d with other weights."""
        hard, soft, space = self.constraints_of(system, cost).disturbances, None, cost.space
        if space is not None and "disturbances" in system.soft:
            prior = PriorCost(system, self.observer, cost).covariance
            soft = Penalties(system, cost, prior).rows_of("disturbances")
        if soft is None or space is None:
            return hard
        found = soft.mapped(None, space.noise_free, np.zeros(len(soft.matrix), np.bool_))
        found.fixed &= found.numbers < 0  # a soft row without width may be missed
        return found

    def weight_of_d(self, weight: Array) -> Array:
        """The weight (n, n) of d, from that of w."""
        n = self.system.n
        return self.cost.joint_weight(None, weight)[:n, :n]

    def weight_of_w(self, weight: Array) -> Array:
        """The weight (r, r) of w, from that of d."""
        space = self.cost.space
        return weight if space is None else space.directions.T @ weight @ space.directions

    def write_sides(self, name: str, sides: Any, one: ConvexSet) -> None:
        """Write the sides of a set into ``mhe_w_set``, ``mhe_v_set`` or ``mhe_x_set``."""
        rows = self.rows if name == "disturbances" else None
        if rows is not None:
            rows = rows.with_sides([one])
            sides["lower"], sides["upper"] = -np.inf, np.inf
            for side, values in (("row_lower", rows.lower[0]), ("row_upper", rows.upper[0])):
                sides[side][: values.size] = values
            return
        for side in SIDES:
            values = getattr(one, side)
            sides[side][: values.size] = values

    def read_sides(self, name: str, sides: Any, built: ConvexSet) -> dict[str, Array]:
        """The sides of a set; ``built`` has the same rows, and those that C leaves out."""
        rows = self.rows if name == "disturbances" else None
        if rows is None or rows.kept is None:
            return {side: sides[side][: getattr(built, side).size].copy() for side in SIDES}
        found = {}
        for side in ("lower", "upper"):
            bounds, general = getattr(built, side).copy(), getattr(built, f"row_{side}")
            joined = np.append(bounds[rows.components], general)
            joined[rows.kept] = sides[f"row_{side}"][: np.count_nonzero(rows.kept)]
            bounds[rows.components] = joined[: rows.components.size]
            found[side], found[f"row_{side}"] = bounds, joined[rows.components.size :]
        return found
