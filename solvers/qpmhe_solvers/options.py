"""Options of any QP solver, under common names."""

from __future__ import annotations

from dataclasses import dataclass

from .errors import OptionError, report_unknown_options
from .values import finite, integer, shown

# What every solver's own integer takes.
_MOST_ITERATIONS = 2**31 - 1


@report_unknown_options
@dataclass(frozen=True)
class SolverOptions:
    """Limits and accuracy of one QP solve.

    Parameters
    ----------
    max_iterations : int or None
        Cap on the solver's own iterations, at least 1. None leaves the solver's default.
        A backend without a cap (see its capabilities) solves fully.
    absolute_tolerance : float
        Tolerance on the primal and dual residuals, > 0. It is dimensionless: every QP is scaled by
        powers of two before the solve, so that the Hessian's diagonal, the rows and the step are of
        order one (see Notes).
    relative_tolerance : float
        Tolerance relative to the size of the residuals' terms, >= 0. Backends with only one
        tolerance use the absolute one.
    time_limit : float or None
        Seconds for one solve, > 0. Backends without a clock ignore it.
    warm_start : bool
        Whether the start given to ``Solver.solve`` is passed to backends that use one.

    Raises
    ------
    OptionError
        If a value is outside its range.

    Notes
    -----
    A claim of success is also verified in the scaled numbers, so that the verdict (SOLVED or
    INACCURATE) does not depend on the units of states, rows and cost. Iterate, multipliers and
    residuals of a `Solution` are in the caller's units. There is one factor for each component of
    the state and one for each row, equal at all stages, and one for the cost. `banded` solves QPs
    without equality rows as they are, since a Cholesky factor depends on no unit.
    """

    max_iterations: int | None = None
    absolute_tolerance: float = 1e-7
    relative_tolerance: float = 0.0
    time_limit: float | None = None
    warm_start: bool = True

    def __post_init__(self) -> None:
        cap = integer(self.max_iterations)
        if self.max_iterations is not None and (cap is None or not 1 <= cap <= _MOST_ITERATIONS):
            raise OptionError(
                f"max_iterations is {shown(self.max_iterations)}; expected an integer >= 1 or "
                f"None{f', at most {_MOST_ITERATIONS}' if cap and cap > 1 else ''}. "
                "To skip the QPs, set the estimator's max_qps=0."
            )
        _positive("absolute_tolerance", self.absolute_tolerance, zero=False)
        _positive("relative_tolerance", self.relative_tolerance, zero=True)
        if self.time_limit is not None:
            _positive("time_limit", self.time_limit, zero=False)
        if not isinstance(self.warm_start, bool):
            raise OptionError(f"warm_start is {shown(self.warm_start)}; expected True or False.")


def _positive(name: str, value: object, *, zero: bool) -> None:
    number = finite(value)
    if number is None or number < 0.0 or (number == 0.0 and not zero):
        bound = ">= 0" if zero else "> 0"
        raise OptionError(f"{name} is {shown(value)}; expected a finite number {bound}.")
