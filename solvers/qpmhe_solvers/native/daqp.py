"""DAQP with a workspace: a dual active-set method, dense."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Layout, Style
from .workspace import Answer, NativeSolver

__all__ = ["DaqpSolver"]

Array = NDArray[np.float64]
Index = NDArray[np.intc]

# Bits of a constraint's sense.
_ACTIVE, _LOWER, _EQUALITY = 1, 2, 5
# A start this near to a limit, relative to it, counts as at the limit.
_AT = 1e-6
_WORDS = {
    1: "solved", 2: "solved, soft constraints used", -1: "infeasible", -2: "cycling",
    -3: "unbounded", -4: "iteration limit", -5: "not convex", -6: "overdetermined start",
    -7: "time limit",
}
_AT_CAP = -4
_STOPPED = (_AT_CAP, -7)


class DaqpSolver(NativeSolver):
    """Solve by DAQP.

    It starts with the limits that the start lies on, or those that were active last, as
    active; where it stops at a cap or time limit, there is no iterate.
    """

    package = "daqp"
    style = Style("dense", equalities="among")

    def _set_up(self, layout: Layout) -> Any:
        options, handle = self.options, self._package.Model()
        settings = {
            "primal_tol": options.absolute_tolerance, "dual_tol": options.absolute_tolerance
        }
        if options.max_iterations is not None:
            # Its loop ends before the iteration of that number.
            settings["iter_limit"] = int(options.max_iterations) + 1
        handle.settings = handle.settings | settings
        flag, _ = handle.setup(
            layout.hessian, layout.gradient, layout.matrix, layout.all_upper, layout.all_lower,
            self._sense(layout, None, None),
        )
        if flag < 0:
            raise RuntimeError(f"daqp: {_WORDS.get(flag, flag)}")
        return handle

    def _update(self, handle: Any, layout: Layout) -> None:
        """Nothing: what is new is handed over with the active set."""

    def _limit(self, handle: Any, seconds: float) -> None:
        handle.settings = handle.settings | {"time_limit": seconds}

    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        began, limit = perf_counter(), self.time_limit
        sense = self._sense(layout, start, duals)
        answer = self._from(handle, layout, sense)
        if not answer.sound and (start is not None or duals is not None):
            # A start whose active rows depend on each other: it divides by zero, or gives up.
            if limit is not None:
                remaining = limit - (perf_counter() - began)
                if remaining <= 0.0:
                    return answer
                self._limit(handle, remaining)
            answer = self._from(handle, layout, self._sense(layout, None, None))
        return answer

    def _from(self, handle: Any, layout: Layout, sense: Index) -> Answer:
        """Solve from an active set."""
        # Without rows it must be given none: it would look at the first one.
        rows = {"A": layout.matrix} if layout.matrix.size else {}
        if sense.size:
            rows |= {"bupper": layout.all_upper, "blower": layout.all_lower, "sense": sense}
        flag = handle.update(H=layout.hessian, f=layout.gradient, **rows)
        if flag < 0:
            return Answer(None, None, False, False, None, _WORDS.get(flag, str(flag)))
        x, _, flag, info = handle.solve()
        count, words = int(info["iterations"]), _WORDS.get(flag, str(flag))
        if flag == _AT_CAP:
            count -= 1  # the one that it did not begin
        if flag != 1:
            return Answer(None, None, False, flag in _STOPPED, count, words)
        bounds = layout.size if layout.boxed else 0
        duals = layout.duals(info["lam"][bounds:], None, info["lam"][:bounds])
        return Answer(x, duals, True, bool(np.isfinite(x).all()), count, words)

    def _sense(self, layout: Layout, start: Array | None, duals: Array | None) -> Index:
        """What each limit of the box, then each row, is to begin as."""
        sense = np.zeros(layout.all_upper.size, np.intc)
        bounds = layout.size if layout.boxed else 0
        sense[bounds : bounds + np.count_nonzero(layout.structure.equal)] = _EQUALITY
        if start is not None:
            value = np.concatenate((start[:bounds], layout.matrix @ start))
            near = _AT * (1.0 + np.abs(value))
            above, below = value >= layout.all_upper - near, value <= layout.all_lower + near
        elif duals is not None:
            known = np.concatenate((duals[:bounds], duals[layout.constraints]))
            above, below = known > 0.0, known < 0.0
        else:
            return sense
        sense |= (above | below) * np.intc(_ACTIVE)
        sense |= (below & ~above) * np.intc(_LOWER)
        return sense
