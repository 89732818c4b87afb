"""The contract of a QP solver, and the containment of its failures."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInputError
from .options import SolverOptions
from .qp import ARRAYS, QP, Array
from .sample_qps import sample
from .scaling import Scale, Scaling
from .solution import Errors, RawSolution, Residuals, Solution, SolveStatus
from .sparse_qp import SparseQP

# A claim of success is believed while the recomputed residuals stay below this many times the
# tolerance, since solvers measure in scaled norms of their own, but not beyond the loosest.
_SLACK = 1e3
_LOOSEST = 1e-3
_NUMBERS = count(1)
# Classes of which one has solved its two small QPs, and which of a class's solvers it runs.
_REHEARSED: set[tuple[type, str]] = set()


class Solver(ABC):
    """One QP solver with its options; subclasses only implement `_solve`.

    Parameters
    ----------
    options : SolverOptions
        Limits and accuracy of every solve.

    Attributes
    ----------
    time_limit : float or None
        Seconds for the next solve, > 0, initially the options' ``time_limit``. A caller with a
        deadline sets it to the remaining time before each solve. Backends with a time limit read it
        there.
    """

    time_limit: float | None = None
    _scaling: Scaling | None = None
    # Whether Python code may warn during a solve: to keep that inside takes as long as a small QP.
    _warns: ClassVar[bool] = True
    # Whether it is one of this package's, which are tested to read only: all others are lent a
    # copy, since who scales the caller's QP in place would be judged by what is left of it.
    _builtin: bool = False
    # Whether it may keep anything of a QP beyond its solve.
    _keeps: ClassVar[bool] = True
    # Whether `_solve` takes QPs in the caller's units and returns a judged Solution: for solvers
    # of this package that hand QPs on, or solve them exactly.
    _judges: ClassVar[bool] = False
    # Whether `_solve` takes a `SparseQP`, too: for solvers of this package alone.
    _takes_sparse: ClassVar[bool] = False
    # Whether another exact method may take its place: where no backend was named.
    _chooses: bool = False
    # What the last solve wrote into of what it was lent.
    _wrote: tuple[str, ...] = ()
    # The `ContainedSolver` that used it last.
    _user: int = 0

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        cls._builtin = cls.__module__.startswith(f"{__package__}.")
        if "_solve" in cls.__dict__:
            cls._judges = cls._judges and cls._builtin
            cls._takes_sparse = cls._takes_sparse and cls._builtin

    def __init__(self, options: SolverOptions) -> None:
        self.options = options
        self.time_limit = options.time_limit

    def __repr__(self) -> str:
        return f"{type(self).__name__}({getattr(self, 'options', '')})"

    @abstractmethod
    def _solve(self, qp: QP, start: Array | None) -> RawSolution | Solution:
        """Solve qp. It may raise, and it may lie: `solve` contains all of it."""

    def shift(self) -> None:
        """Report that the trajectory moved by one stage since the last solve.

        Data kept for stage k + 1 now belong to stage k; the last stage is new. A solver that keeps
        no data between solves ignores this.
        """

    def forget(self) -> None:
        """Drop all data kept between solves: the next solve is a cold start.

        Kept data may change the last digits of a solution; call this to reproduce a solve exactly.
        A subclass that keeps data drops them here, and calls ``super().forget()``.
        """
        if self._scaling is not None:
            self._scaling.forget()

    def prepare(self, size: int) -> None:
        """Do in advance what would delay the first QPs, such as imports.

        Parameters
        ----------
        size : int
            Unknowns K n of the largest expected QP.
        """

    def _rehearse(self, name: str = "") -> None:
        """Solve two small QPs, once in a process: what the first solves import is then there."""
        if (type(self), name) in _REHEARSED:
            return
        _REHEARSED.add((type(self), name))
        self.solve(sample(3, 2))
        self.solve(sample(3, 2, 2, bounds="part", sides="mixed"))
        self.forget()

    def solve(self, qp: QP, start: Array | None = None) -> Solution:
        """Solve a QP, contain every exception of the solver, and verify its answer.

        Parameters
        ----------
        qp : QP
            The problem. It is read, never written.
        start : (K, n) array, optional
            A point near the solution; zero is the trajectory that the QP is built around.

        Returns
        -------
        Solution
            The iterate, if it is finite and of the right shape, with its recomputed
            residuals; otherwise FAILED with the reason in its message.

        Raises
        ------
        InvalidInputError
            If ``qp`` is not a `QP`.
        KeyboardInterrupt
            If the user interrupts. No other exception passes: a solver that raises SystemExit has
            also failed.
        """
        if type(qp) is not QP:
            qp = self._readable(qp)
        try:
            if self._judges:
                return self._solve(qp, start)  # type: ignore[return-value]  # judged already
            if not self._warns:
                with np.errstate(all="ignore"):
                    return self._checked(qp, start)
            with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
                return self._checked(qp, start)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # the wall; a panic of compiled code is no Exception
            return _failure(error)

    def _readable(self, qp: object) -> QP:
        """A QP as `_solve` takes it; refuses what is none."""
        if isinstance(qp, SparseQP):
            return qp if self._takes_sparse else qp.full()
        return _expect_qp(qp)

    def _checked(self, qp: QP, start: Array | None) -> Solution:
        """Look at the data, solve, and judge."""
        fault = qp.fault()
        if fault:
            return Solution(None, SolveStatus.FAILED, message=fault)
        scale, scaled = self._scale(qp)
        usable = self._usable(start, qp, scale)
        far = scale.drop_far(scaled)
        solution = self._answer(qp, scale, scaled, usable)
        if far is not None and solution.d is not None and _crosses(qp, solution.d, far):
            scale.apply(qp, scaled)
            first, solution = solution, self._answer(qp, scale, scaled, usable)
            if first.iterations is not None and solution.iterations is not None:
                solution.iterations += first.iterations
        if solution.status is not SolveStatus.SOLVED and not self._may_stop:
            self._drop_scale(scaled)
        return solution

    @property
    def _may_stop(self) -> bool:
        """Whether a cap or a time limit asks for answers that are not solved."""
        return self.options.max_iterations is not None or self.time_limit is not None

    def _drop_scale(self, scaled: QP) -> None:
        """Let the next QP have a scale of its own.

        That of an infeasible QP is as large as its misses: a good one would be solved to the
        tolerance in these units only.
        """
        if self._scaling is not None:
            self._scaling.drop(scaled.key)

    def _answer(self, qp: QP, scale: Scale, scaled: QP, usable: Array | None) -> Solution:
        """Solve the scaled QP, and judge."""
        if self._builtin:
            return self._judged(scaled, scale, self._solve(scaled, usable))
        solution = self._judged(scaled, scale, self._solve_lent(scaled, usable))
        if self._wrote and solution.status is not SolveStatus.SOLVED:
            note = f"it wrote into {', '.join(self._wrote)} of the QP, which is read-only"
            solution.message = f"{solution.message}; {note}" if solution.message else note
        return solution

    def _scale(self, qp: QP) -> tuple[Scale, QP]:
        """The scale of a QP, and the scaled QP, which holds until the next one."""
        scaling = self._scaling
        if scaling is None:
            scaling = self._scaling = Scaling(self._keeps)
        return scaling.scale(qp), scaling.qp

    def _solve_lent(self, qp: QP, start: Array | None) -> object:
        """Solve with copies, and see what was written into them."""
        self._wrote = ()
        lent = qp.copy()
        try:
            return self._solve(lent, None if start is None else start.copy())
        finally:
            self._wrote = tuple(
                name for name in ARRAYS
                if not np.array_equal(getattr(lent, name), getattr(qp, name))
            )

    def _usable(self, start: Array | None, qp: QP, scale: Scale) -> Array | None:
        if start is None or not self.options.warm_start or np.shape(start) != (qp.stages, qp.n):
            return None
        scaled: Array = start / scale.step
        return scaled if np.isfinite(scaled).all() else None

    def _judged(self, qp: QP, scale: Scale, raw: object) -> Solution:
        """Judge the answer to a scaled QP, and give it in the user's units."""
        if isinstance(raw, Solution):  # of a class that is derived from one of this package
            raw = RawSolution(
                raw.d, raw.status is SolveStatus.SOLVED, raw.iterations, raw.bound_duals,
                raw.row_duals, raw.message,
            )
        if not isinstance(raw, RawSolution):
            message = f"the backend returned {type(raw).__name__}, not a RawSolution"
            return Solution(None, SolveStatus.FAILED, message=message)
        count = _as_count(raw.iterations)
        d, message = _as_iterate(raw.d, raw.message, qp)
        if d is None:
            return Solution(None, SolveStatus.FAILED, count, message=message)
        duals = None
        if qp.bounded or qp.rows:
            bound_duals = _as_multipliers(raw.bound_duals, qp.size)
            row_duals = _as_multipliers(raw.row_duals, qp.stages * qp.rows)
            if bound_duals is not None and row_duals is not None:
                duals = np.concatenate((bound_duals, row_duals)) if qp.rows else bound_duals
            if bound_duals is not None:
                bound_duals = bound_duals * scale.duals[: qp.size]
            if row_duals is not None and qp.rows:
                row_duals *= scale.duals[qp.size :]
        else:  # there is nothing to weigh
            bound_duals, row_duals = np.zeros(qp.size), np.zeros(0)
            duals = row_duals
        errors = Errors(qp, d, duals)
        if not (isinstance(raw.claimed, (bool, np.bool_)) and raw.claimed):
            status = SolveStatus.STOPPED
        elif self._confirmed(qp, d, errors.largest()):
            status = SolveStatus.SOLVED
        else:
            status = SolveStatus.INACCURATE
        d *= scale.step
        if not _finite(d):
            message = "the solver returned an iterate that is not finite in the user's units"
            return Solution(None, SolveStatus.FAILED, count, message=message)
        return Solution(
            d, status, count, partial(errors.unscaled, scale), bound_duals, row_duals, message
        )

    def _confirmed(self, qp: QP, d: Array, found: tuple[float, float, float]) -> bool:
        """Whether the residuals bear a claim out; a claim without multipliers cannot be checked."""
        primal, dual, gap = found
        tolerance = self.options.absolute_tolerance + self.options.relative_tolerance
        limit = max(tolerance, min(_SLACK * tolerance, _LOOSEST))
        # Mostly the residuals are below the limit as it is, whatever the size of the QP's terms.
        return (
            (primal <= limit or primal <= limit * (1.0 + float(np.abs(d).max())))
            and (dual <= limit or dual <= limit * (1.0 + float(np.abs(qp.gradient).max())))
            and (gap <= limit or gap <= limit * (1.0 + abs(float(np.vdot(d, qp.gradient)))))
        )


class ContainedSolver:
    """A solver whose methods raise only KeyboardInterrupt, whatever its class.

    `Solver.solve` contains what `Solver._solve` does. This contains the rest: a user's class may
    override `solve` itself, and its `shift`, `forget` and `prepare` may raise.

    Several of these may share one solver. It starts cold whenever its user changes, so that no data
    of one trajectory warm-start another.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self._number = next(_NUMBERS)
        is_contained = solver._builtin or type(solver).solve is Solver.solve
        self._is_trusted = is_contained and "solve" not in vars(solver)
        self._shifts = type(solver).shift is not Solver.shift or "shift" in vars(solver)

    def solve(
        self, qp: QP, start: Array | None = None, time_limit: float | None = None
    ) -> Solution:
        """Solve a QP; see `Solver.solve`."""
        solver = self.solver
        try:
            if solver._user != self._number:
                self._take_over(solver)
            if time_limit is not None:
                solver.time_limit = time_limit
            if self._is_trusted:
                return solver.solve(qp, start)
            lent = None if start is None else start.copy()
            qp = qp.full() if isinstance(qp, SparseQP) else qp
            with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
                return _as_solution(solver.solve(qp.copy(), lent), qp)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a panic of compiled code is no Exception
            return _failure(error)

    def _take_over(self, solver: Solver) -> None:
        if solver._user:
            self._start_afresh()
            solver.time_limit = solver.options.time_limit
        solver._user = self._number

    @property
    def takes_sparse(self) -> bool:
        """Whether it solves a `SparseQP` as such."""
        return self._is_trusted and self.solver._takes_sparse

    @property
    def chooses(self) -> bool:
        """Whether another exact method may take its place, as no backend was named."""
        return self._is_trusted and self.solver._chooses

    def shift(self) -> None:
        """Report that the trajectory moved by one stage; see `Solver.shift`."""
        # Else it keeps nothing, or nothing of this trajectory.
        if self._shifts and self.solver._user in (0, self._number):
            _quietly(self.solver.shift)

    def forget(self) -> None:
        """Drop all data kept between solves; see `Solver.forget`."""
        if self.solver._user in (0, self._number):
            self._start_afresh()

    def _start_afresh(self) -> None:
        _quietly(self.solver.forget)
        Solver.forget(self.solver)  # which a user's class need not call

    def prepare(self, size: int) -> None:
        """Do in advance what would delay the first QPs; see `Solver.prepare`."""
        _quietly(self.solver.prepare, size)


def _quietly(method: Callable[..., None], *arguments: int) -> None:
    """Call a method whose failure changes nothing that anybody relies on."""
    try:
        method(*arguments)
    except KeyboardInterrupt:
        raise
    except BaseException:  # what a user's solver keeps is its own affair
        pass


def _as_solution(found: object, qp: QP) -> Solution:
    """What an overridden `solve` returned, if it is what it should be."""
    if not isinstance(found, Solution):
        message = f"the backend's solve returned {type(found).__name__}, not a Solution"
        return Solution(None, SolveStatus.FAILED, message=message)
    count = _as_count(found.iterations)
    status: object = found.status
    if not isinstance(status, SolveStatus):
        message = f"the status of the backend's Solution is {type(status).__name__}"
        return Solution(None, SolveStatus.FAILED, count, message=f"{message}, not a SolveStatus")
    d, message = _as_iterate(found.d, found.message, qp)
    if d is None or status is SolveStatus.FAILED:
        return Solution(None, SolveStatus.FAILED, count, message=message)
    residuals = found.residuals if isinstance(found.residuals, Residuals) else None
    return Solution(
        d, status, count, residuals, _as_multipliers(found.bound_duals, qp.size),
        _as_multipliers(found.row_duals, qp.stages * qp.rows), message,
    )


def _crosses(qp: QP, d: Array, far: NDArray[np.bool_]) -> bool:
    """Whether an iterate misses one of the far limits."""
    value = np.concatenate((d, qp.rows_times(d)), axis=None)
    return bool((np.append(qp.all_lower > value, qp.all_upper < value) & far).any())


def _expect_qp(qp: object) -> QP:
    """Refuse what is no QP."""
    if not isinstance(qp, QP):
        raise InvalidInputError(
            f"qp is {qp!r}; expected a qpmhe.solvers.QP: create one from its "
            "sizes and fill its arrays, or load one with qpmhe.solvers.load."
        )
    return qp


def _failure(error: BaseException) -> Solution:
    """The solution of a solver that raised."""
    try:
        message = f"{type(error).__name__}: {error}"
    except Exception:  # its own words raise, too
        message = type(error).__name__
    return Solution(None, SolveStatus.FAILED, message=message)


def _as_iterate(given: object, words: object, qp: QP) -> tuple[Array | None, str]:
    """An iterate (K, n) as a copy, and the message that goes with it; None if it is none."""
    message = words if isinstance(words, str) else f"its message is a {type(words).__name__}"
    if given is None:
        return None, message or "the solver returned no iterate"
    array = np.asarray(given)
    if array.dtype.kind == "c":
        return None, "the solver returned complex numbers"
    d = np.array(array, dtype=np.float64)  # a copy: solvers reuse their buffers
    if d.size != qp.size:
        return None, f"the solver returned {d.size} numbers for {qp.size} unknowns"
    if not _finite(d):
        return None, "the solver returned an iterate that is not finite"
    return d.reshape(qp.stages, qp.n), message


def _as_count(value: object) -> int | None:
    """A count of iterations; None where it is none."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0:
        return int(value)
    return None


def _as_multipliers(values: object, size: int) -> Array | None:
    """Multipliers that can be used; None stands for all that cannot."""
    if values is None:
        return None
    try:
        given = np.asarray(values)
        if given.dtype.kind == "c":
            return None
        multipliers = np.array(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return None
    return multipliers if multipliers.size == size and _finite(multipliers) else None


def _finite(values: Array) -> bool:
    flat = values.reshape(-1)
    # Squares may overflow where the numbers do not: then each one is looked at.
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())
