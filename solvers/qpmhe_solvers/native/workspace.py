"""What all native backends share: which workspace is whose, and what it may keep."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Hashable
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gathered import GatheredQP
from ..options import SolverOptions
from ..qp import QP
from ..solution import RawSolution
from ..solver import Solver
from .layout import Layout, Structure, Style, Voids

__all__ = ["Answer", "NativeSolver"]

Array = NDArray[np.float64]

# Workspaces kept by one solver: a window of full length needs one, or one for each structure
# that its sets have; those of a growing window are used once.
_KEPT = 4
# Patterns of limits whose workspace is known without looking at their structure.
_KNOWN = 64


class Answer(NamedTuple):
    """What a solver said."""

    x: Array | None
    duals: Array | None
    solved: bool
    sound: bool
    iterations: int | None
    message: str


class _Workspace:
    """A solver that is set up, its arrays, and the multipliers that it found last."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.handle: Any = None
        self.duals: Array | None = None
        self.shifts = 0


class NativeSolver(Solver):
    """A solver with workspaces, one for each structure and size of QPs; few are kept."""

    #: The module of the solver, and how it wants its QPs.
    package: ClassVar[str]
    style: ClassVar[Style]
    _warns = False

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._package: Any = import_module(self.package)  # late: solvers are optional
        self._shifts = 0
        self._workspaces: dict[Hashable, _Workspace] = {}
        self._known: dict[Hashable, tuple[Hashable, Voids | None]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.options,)

    def shift(self) -> None:
        """Move what is kept by one stage; see `Solver.shift`."""
        self._shifts += 1

    def forget(self) -> None:
        """Drop the workspaces; see `Solver.forget`."""
        self._workspaces.clear()

    def prepare(self, size: int) -> None:
        """Import what the first solve imports; see `Solver.prepare`."""
        self._rehearse()

    @abstractmethod
    def _set_up(self, layout: Layout) -> Any:
        """A solver for the arrays of a layout, which are filled."""

    @abstractmethod
    def _update(self, handle: Any, layout: Layout) -> None:
        """Hand the arrays, filled anew, to the solver."""

    def _limit(self, handle: Any, seconds: float) -> None:
        """Set the time limit of the next solve; nothing for a solver without a clock."""

    @abstractmethod
    def _run(
        self, handle: Any, layout: Layout, start: Array | None, duals: Array | None
    ) -> Answer:
        """Solve, from an increment (K n,) and multipliers (K n + K rows,); None for zero."""

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        gathered = GatheredQP.of(qp)
        key, workspace, voids = self._taken(gathered)
        layout = workspace.layout
        layout.fill(gathered, voids)
        # Whatever raises from here on leaves the workspace out.
        if workspace.handle is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                workspace.handle = self._set_up(layout)
        else:
            self._update(workspace.handle, layout)
        if self.time_limit is not None:
            self._limit(workspace.handle, self.time_limit)
        point = None if start is None else np.ravel(start)
        answer = self._run(workspace.handle, layout, point, self._kept_duals(workspace, gathered))
        if answer.sound and _finite(answer.x) and _finite(answer.duals):
            workspace.duals, workspace.shifts = answer.duals, self._shifts
            if len(self._workspaces) == _KEPT:
                del self._workspaces[next(iter(self._workspaces))]  # the longest unused
            self._workspaces[key] = workspace
        bounds = rows = None
        if answer.duals is not None:
            bounds, rows = answer.duals[: layout.size], answer.duals[layout.size :]
        return RawSolution(
            answer.x, answer.solved, answer.iterations, bounds, rows, answer.message
        )

    def _taken(self, qp: GatheredQP) -> tuple[Hashable, _Workspace, Voids | None]:
        """The workspace for a QP, taken off the shelf, its key, and the QP's void rows."""
        pattern = (
            qp.sizes, np.isfinite(qp.limits).tobytes(), (qp.all_lower == qp.all_upper).tobytes()
        )
        known = self._known.get(pattern)
        kind = Structure.of(qp).key if known is None else known[0]
        # QPs of another scale, such as projections into the sets between those of the
        # estimation, have a workspace of their own: a solver's step sizes, and multipliers,
        # are of no use from one to the other, and do harm.
        key = qp.sizes, kind, qp.key
        workspace = self._workspaces.pop(key, None)
        if workspace is None:
            workspace = _Workspace(Layout(self.style, Structure.of(qp), *qp.sizes))
        if known is None:
            if len(self._known) == _KNOWN:
                del self._known[next(iter(self._known))]
            known = self._known[pattern] = kind, workspace.layout.voids(qp)
        return key, workspace, known[1]

    def _kept_duals(self, workspace: _Workspace, qp: GatheredQP) -> Array | None:
        """Multipliers of the workspace's last solve, moved with the trajectory."""
        duals = workspace.duals
        if duals is None or not self.options.warm_start:
            return None
        moved = self._shifts - workspace.shifts
        if moved == 0:
            return duals
        stages, n, rows = qp.sizes
        if moved >= stages:
            return None
        shifted = np.zeros_like(duals)  # nothing is known of new stages
        for part, width in ((slice(stages * n), n), (slice(stages * n, None), rows)):
            old, new = duals[part], shifted[part]
            new[: new.size - moved * width] = old[moved * width :]
        return shifted


def _finite(values: Array | None) -> bool:
    return values is None or bool(np.isfinite(values).all())
