"""Solvers called directly, with a workspace that is updated from QP to QP."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Hashable, Mapping
from importlib import import_module
from time import perf_counter
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .backend import Backend
from .layout import QPLayout, QPStructure, QPStyle, Voids
from .options import SolverOptions
from .qp import QP, Array
from .solution import RawSolution
from .solver import Solver
from .translations import TRANSLATIONS

Point = Array | None

# Patterns of limits whose workspace is known without looking at their structure.
_KNOWN = 64


class NativeAnswer(NamedTuple):
    """A solver's answer."""

    x: Array | None
    duals: Array | None
    solved: bool
    sound: bool
    iterations: int | None
    message: str


class _Workspace:
    """A solver that is set up, its arrays, and the multipliers that it found last."""

    def __init__(self, layout: QPLayout) -> None:
        self.layout = layout
        self.handle: Any = None
        self.duals: Array | None = None
        self.shifts = 0


class NativeSolver(Solver):
    """A solver with workspaces, one for each structure and size of QPs; few are kept."""

    #: The module of the solver, its name in the table of translations, and how it wants its QPs.
    package: ClassVar[str]
    translation: ClassVar[str]
    style: QPStyle
    # Workspaces kept: a window of full length needs one, or one for each structure that its sets
    # have; those of a growing window are used once.
    kept: ClassVar[int] = 4
    _warns = False

    def __init__(self, options: SolverOptions) -> None:
        super().__init__(options)
        self._package: Any = import_module(self.package)  # late: solvers are optional
        self._shifts = 0
        self._workspaces: dict[Hashable, _Workspace] = {}
        # Of workspaces that were left out: infeasible QPs come in series.
        self._layouts: dict[Hashable, QPLayout] = {}
        self._known: dict[Hashable, tuple[Hashable, Voids | None]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.options,)

    def structure(self, qp: QP) -> QPStructure:
        """The limits that a layout for this QP has room for."""
        return QPStructure.of(qp)

    def shift(self) -> None:
        """Move what is kept by one stage; see `Solver.shift`."""
        self._shifts += 1

    def forget(self) -> None:
        """Drop the workspaces; see `Solver.forget`."""
        super().forget()
        self._workspaces.clear()

    def prepare(self, size: int) -> None:
        """Import what the first solve imports; see `Solver.prepare`."""
        self._rehearse()

    @property
    def _words(self) -> dict[str, Any]:
        return TRANSLATIONS[self.translation].keywords(self.options)

    def _translated(self, settings: Any) -> Any:
        """Write the options into the solver's settings."""
        for name, value in self._words.items():
            if name != "eps_dual_inf" or hasattr(settings, name):  # PIQP 0.6.1 has no such limit
                setattr(settings, name, value)
        return settings

    @abstractmethod
    def _set_up(self, layout: QPLayout) -> Any:
        """A solver for the arrays of a layout, which are filled."""

    def _update(self, handle: Any, layout: QPLayout) -> None:
        """Hand the arrays, filled anew, to the solver; nothing where it reads them itself."""

    def _limit(self, handle: Any, seconds: float) -> None:
        """Set the time limit of the next solve; nothing for a solver without a clock."""

    @abstractmethod
    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        """Solve, from an increment (K n,) and multipliers (K n + K rows,); None for zero."""

    def _solve(self, qp: QP, start: Array | None) -> RawSolution:
        key, workspace, voids = self._taken(qp)
        layout = workspace.layout
        layout.fill(qp, voids)
        # Whatever raises from here on leaves the workspace out.
        if workspace.handle is None:
            with warnings.catch_warnings(action="ignore"):
                workspace.handle = self._set_up(layout)
        else:
            self._update(workspace.handle, layout)
        if self.time_limit is not None:
            self._limit(workspace.handle, self.time_limit)
        point = None if start is None else np.ravel(start)
        answer = self._run(workspace.handle, layout, point, self._kept_duals(workspace, qp))
        sound = answer.sound and (answer.solved or self._may_stop)
        if sound and _finite(answer.x) and _finite(answer.duals):
            workspace.duals, workspace.shifts = answer.duals, self._shifts
            if len(self._workspaces) == self.kept:
                del self._workspaces[next(iter(self._workspaces))]  # the longest unused
            self._workspaces[key] = workspace
        else:
            self._drop_scale(qp)
            if len(self._layouts) == self.kept:
                del self._layouts[next(iter(self._layouts))]
            self._layouts[key[:2]] = layout
        bounds = rows = None
        if answer.duals is not None:
            bounds, rows = answer.duals[: layout.size], answer.duals[layout.size :]
        return RawSolution(
            answer.x, answer.solved, answer.iterations, bounds, rows, answer.message
        )

    def _taken(self, qp: QP) -> tuple[tuple[Hashable, ...], _Workspace, Voids | None]:
        """The workspace for a QP, taken off the shelf, its key, and the QP's void rows."""
        pattern = (
            qp.sizes, np.isfinite(qp.limits).tobytes(), (qp.all_lower == qp.all_upper).tobytes()
        )
        known = self._known.get(pattern)
        kind = self.structure(qp).key if known is None else known[0]
        # QPs of another scale, such as projections into the sets between those of the
        # estimation, have a workspace of their own: a solver's step sizes, and multipliers,
        # are of no use from one to the other, and do harm.
        key = qp.sizes, kind, qp.key if self._keeps else 0
        workspace = self._workspaces.pop(key, None)
        if workspace is None:
            layout = self._layouts.pop(key[:2], None)
            if layout is None:
                layout = QPLayout(self.style, self.structure(qp), *qp.sizes)
            workspace = _Workspace(layout)
        if known is None:
            if len(self._known) == _KNOWN:
                del self._known[next(iter(self._known))]
            known = self._known[pattern] = kind, workspace.layout.voids(qp)
        return key, workspace, known[1]

    def _kept_duals(self, workspace: _Workspace, qp: QP) -> Array | None:
        """Multipliers of the workspace's last solve, moved with the trajectory."""
        duals = workspace.duals
        if duals is None or not (self._keeps and self.options.warm_start):
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


class ClarabelSolver(NativeSolver):
    """Solve by Clarabel.

    It does not warm-start: every solve is a cold start.
    """

    package, translation = "clarabel", "clarabel"
    style = QPStyle(
        "csc", triangle="upper", bounds="rows", equalities="among", sides=1, infinite=False
    )

    def _set_up(self, layout: QPLayout) -> Any:
        settings = self._package.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False  # its data could not be updated
        settings.max_threads = 1
        self._translated(settings)
        equal = int(layout.structure.equal.sum())
        cones = [
            kind(count)
            for kind, count in (
                (self._package.ZeroConeT, equal),
                (self._package.NonnegativeConeT, layout.constraints.size - equal),
            )
            if count
        ]
        return self._package.DefaultSolver(
            layout.hessian, layout.gradient, layout.matrix, layout.upper, cones, settings
        )

    def _update(self, handle: Any, layout: QPLayout) -> None:
        handle.update(
            P=layout.hessian.data, q=layout.gradient, A=layout.matrix.data, b=layout.upper
        )

    def _limit(self, handle: Any, seconds: float) -> None:
        settings = handle.get_settings()
        settings.time_limit = seconds
        handle.update(settings=settings)

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        solution = handle.solve()
        status = str(solution.status)
        solved = status == "Solved"
        return NativeAnswer(
            np.array(solution.x), layout.duals(np.array(solution.z), None, None), solved,
            solved or status in ("MaxIterations", "MaxTime"), int(solution.iterations), status,
        )


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

    It warm-starts the active set with the limits that the start lies on, or with the last active
    ones; if it stops at a cap or time limit, it returns no iterate.
    """

    package, translation = "daqp", "daqp"
    style = QPStyle("dense", equalities="among")

    def _set_up(self, layout: QPLayout) -> Any:
        handle = self._package.Model()
        handle.settings = handle.settings | self._words
        flag, _ = handle.setup(
            layout.hessian, layout.gradient, layout.matrix, layout.all_upper, layout.all_lower,
            self._sense(layout, None, None),
        )
        if flag < 0:
            raise RuntimeError(f"daqp: {_WORDS.get(flag, flag)}")
        return handle

    def _limit(self, handle: Any, seconds: float) -> None:
        handle.settings = handle.settings | {"time_limit": seconds}

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
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

    def _from(self, handle: Any, layout: QPLayout, sense: Index) -> NativeAnswer:
        """Solve from an active set."""
        # Without rows it must be given none: it would look at the first one.
        rows = {"A": layout.matrix} if layout.matrix.size else {}
        if sense.size:
            rows |= {"bupper": layout.all_upper, "blower": layout.all_lower, "sense": sense}
        flag = handle.update(H=layout.hessian, f=layout.gradient, **rows)
        if flag < 0:
            return NativeAnswer(None, None, False, False, None, _WORDS.get(flag, str(flag)))
        x, _, flag, info = handle.solve()
        count, words = int(info["iterations"]), _WORDS.get(flag, str(flag))
        if flag == _AT_CAP:
            count -= 1  # the one that it did not begin
        if flag != 1:
            return NativeAnswer(None, None, False, flag in _STOPPED, count, words)
        bounds = layout.size if layout.boxed else 0
        duals = layout.duals(info["lam"][bounds:], None, info["lam"][:bounds])
        return NativeAnswer(x, duals, True, bool(np.isfinite(x).all()), count, words)

    def _sense(self, layout: QPLayout, start: Array | None, duals: Array | None) -> Index:
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


# OSQP looks whether it is done at every so many iterations; at a low cap it should each time.
_CHECKED = 25
_RHO = 0.1


class OsqpSolver(NativeSolver):
    """Solve by OSQP."""

    package, translation = "osqp", "osqp"
    style = QPStyle("csc", triangle="upper", bounds="rows", equalities="among")

    def _set_up(self, layout: QPLayout) -> Any:
        handle, cap = self._package.OSQP(), self.options.max_iterations
        often = {} if cap is None or cap >= _CHECKED else {"check_termination": 1}
        handle.setup(
            layout.hessian, layout.gradient, layout.matrix, layout.lower, layout.upper,
            verbose=False, rho=_RHO, **often, **self._words,
        )
        return handle

    def _update(self, handle: Any, layout: QPLayout) -> None:
        if not self.options.warm_start:
            handle.update_settings(rho=_RHO)  # adapted by the solves before
        handle.update(
            q=layout.gradient, l=layout.lower, u=layout.upper,
            Px=layout.hessian.data, Ax=layout.matrix.data,
        )

    def _limit(self, handle: Any, seconds: float) -> None:
        handle.update_settings(time_limit=seconds)

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        handle.warm_start(
            x=np.zeros(layout.size) if start is None else start,
            y=np.zeros(layout.constraints.size) if duals is None else duals[layout.constraints],
        )
        result = handle.solve(raise_error=False)
        status = result.info.status
        # Anything else comes without an iterate, or with a certificate in its place.
        stopped = status.startswith(("solved", "maximum", "run time"))
        # Without a solution x is 2143289344 everywhere, the bits of a NaN read as an integer.
        x, y = (None, None) if "infeasible" in status else (result.x, result.y)
        return NativeAnswer(
            x, None if y is None else layout.duals(y, None, None), status == "solved", stopped,
            int(result.info.iter), status,
        )


class PiqpSolver(NativeSolver):
    """Solve by PIQP's sparse solver, which factorises stage by stage.

    Its multistage factorisation needs the unknowns in the order of the stages, as they are. PIQP
    does not warm-start: every solve is a cold start.
    """

    package, translation = "piqp", "piqp"
    style = QPStyle("csc", triangle="upper", infinite=False)

    def _made(self) -> Any:
        handle = self._package.SparseSolver()
        handle.settings.kkt_solver = self._package.KKTSolver.sparse_multistage
        return handle

    def _set_up(self, layout: QPLayout) -> Any:
        handle, options = self._made(), self.options
        settings = self._translated(handle.settings)
        settings.eps_duality_gap_abs = options.absolute_tolerance
        settings.eps_duality_gap_rel = options.relative_tolerance
        handle.setup(layout.hessian, layout.gradient, *self._others(layout))
        return handle

    def _update(self, handle: Any, layout: QPLayout) -> None:
        handle.update(layout.hessian, layout.gradient, *self._others(layout))

    def _others(self, layout: QPLayout) -> tuple[Any, ...]:
        """A, b, G, lower and upper limits, lower and upper bounds."""
        box = (layout.box_lower, layout.box_upper) if layout.boxed else (None, None)
        return (
            layout.equality_matrix, layout.level, layout.matrix, layout.lower, layout.upper, *box
        )

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        status = handle.solve()
        result, kinds = handle.result, self._package.Status
        box = result.z_bu - result.z_bl if layout.boxed else None
        return NativeAnswer(
            result.x, layout.duals(result.z_u - result.z_l, result.y, box),
            status == kinds.PIQP_SOLVED,
            status in (kinds.PIQP_SOLVED, kinds.PIQP_MAX_ITER_REACHED),
            int(result.info.iter), status.name,
        )


class PiqpDenseSolver(PiqpSolver):
    """Solve by PIQP with dense matrices."""

    style = QPStyle("dense", infinite=False)

    def _made(self) -> Any:
        return self._package.DenseSolver()


class ProxqpSolver(NativeSolver):
    """Solve by ProxQP's dense solver.

    Every solve starts at the minimiser under the equality rows: warm starts with the last
    multipliers took no fewer iterations, and longer.
    """

    package, translation = "proxsuite", "proxqp"
    style = QPStyle("dense")

    def _made(self, layout: QPLayout) -> Any:
        return self._package.proxqp.dense.QP(
            layout.size, layout.equalities.size, layout.constraints.size, layout.boxed
        )

    def _set_up(self, layout: QPLayout) -> Any:
        handle, options = self._made(layout), self.options
        settings = self._translated(handle.settings)
        settings.eps_duality_gap_abs = options.absolute_tolerance
        settings.eps_duality_gap_rel = options.relative_tolerance
        settings.check_duality_gap = True
        settings.eps_dual_inf = 0.0  # H is positive definite: there is always a minimiser
        handle.init(**self._parts(layout))
        return handle

    def _update(self, handle: Any, layout: QPLayout) -> None:
        handle.update(**self._parts(layout), update_preconditioner=True)

    def _parts(self, layout: QPLayout) -> dict[str, Any]:
        parts = {
            "H": layout.hessian, "g": layout.gradient, "A": layout.equality_matrix,
            "b": layout.level, "C": layout.matrix, "l": layout.lower, "u": layout.upper,
        }
        if layout.boxed:
            parts |= {"l_box": layout.box_lower, "u_box": layout.box_upper}
        return parts

    def _run(self, handle: Any, layout: QPLayout, start: Point, duals: Point) -> NativeAnswer:
        handle.solve()
        results, count = handle.results, layout.constraints.size
        status, z = results.info.status.name, results.z
        solved = status == "PROXQP_SOLVED"
        return NativeAnswer(
            results.x,
            layout.duals(z[:count], results.y, z[count:] if layout.boxed else None),
            solved, solved or status == "PROXQP_MAX_ITER_REACHED",
            int(results.info.iter_ext), status,
        )


class ProxqpSparseSolver(ProxqpSolver):
    """Solve by ProxQP with sparse matrices.

    Every solve starts at the minimiser under the equality rows, as with the dense solver.
    """

    style = QPStyle("csc", bounds="rows")

    def _made(self, layout: QPLayout) -> Any:
        return self._package.proxqp.sparse.QP(
            layout.size, layout.equalities.size, layout.constraints.size
        )


def _native(
    kind: type[NativeSolver], name: str, *, iterate_at_cap: bool = True, starts: bool = False,
) -> Backend:
    how = TRANSLATIONS[kind.translation]
    return Backend(
        name, kind, how.method, how.package, how.package, kind.style.matrices, iteration_cap=True,
        iterate_at_cap=iterate_at_cap, warm_start=starts, time_limit=how.time_limit is not None,
        keeps_duals=starts, reports_infeasibility=True, keeps_workspace=True,
    )


#: The backends of this module, by name.
NATIVE: Mapping[str, Backend] = {
    backend.name: backend
    for backend in (
        _native(ClarabelSolver, "clarabel"),
        _native(DaqpSolver, "daqp", iterate_at_cap=False, starts=True),
        _native(OsqpSolver, "osqp", starts=True),
        _native(PiqpSolver, "piqp"),
        _native(PiqpDenseSolver, "piqp_dense"),
        _native(ProxqpSolver, "proxqp"),
        _native(ProxqpSparseSolver, "proxqp_sparse"),
    )
}
