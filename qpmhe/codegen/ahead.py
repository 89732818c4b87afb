"""Compilation ahead of use, and the engine that ``engine="auto"`` selects, with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from ..costs import Cost
from ..errors import InvalidInputError, QpmheError
from ..estimation.engines import python_only, reason_for_python
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.start import with_scaled_constraints
from ..model.system import System
from ..observers import Observer
from .compiler import NotCachedError, required_compiler


@dataclass(frozen=True)
class Compiled:
    """What `qpmhe.compile` made or found.

    Attributes
    ----------
    path : Path
        The library in the cache.
    seconds : float
        How long it took to find, or to generate, compile and check it.
    is_new : bool
        Whether it was compiled now; False if it was in the cache.
    engine : str
        ``compiled``, which ``engine="auto"`` uses from now on.
    """

    path: Path
    seconds: float
    is_new: bool
    engine: str = "compiled"


def compile(
    system: System | MovingHorizonEstimator, observer: Observer | None = None,
    cost: Cost | None = None, **options: Any,
) -> Compiled:
    """Compile the step of an estimator, so that ``engine="auto"`` uses it from now on.

    One library serves all weights, gains, bounds, initial states and most options. Another model,
    horizon, kind of sets or of cost, or a time budget needs another. An estimator that exists
    keeps its engine, but `qpmhe.MovingHorizonEstimator.run` may change it before the first sample
    of a long record.

    Parameters
    ----------
    system, observer, cost, **options
        The arguments of `qpmhe.MovingHorizonEstimator`; or an estimator alone. Its ``engine``
        does not matter.

    Returns
    -------
    Compiled
        Where the library is, and how long it took.

    Raises
    ------
    OptionError
        If something has no C form; the message names it.
    CompilationError
        If there is no C compiler, if it fails, or if the cache cannot be written.
    InvalidInputError
        If an argument does not fit.

    Examples
    --------
    >>> import qpmhe
    >>> from qpmhe.models.batch_reactor import casadi_output, casadi_rate
    >>> _, observer, cost, scenario = qpmhe.models.batch_reactor()
    >>> system = qpmhe.from_casadi(casadi_rate, casadi_output, dt=0.1, method="euler", n=2)
    >>> found = qpmhe.compile(system, observer, cost, horizon=10, initial_state=[3.0, 0.0])
    >>> found.engine
    'compiled'
    """
    if not isinstance(system, MovingHorizonEstimator):
        chosen: dict[str, Any] = options | {"observer": observer, "cost": cost, "engine": "python"}
        estimator = MovingHorizonEstimator(system, **chosen)  # it validates all arguments
    elif observer is None and cost is None and not options:
        estimator = system
    else:
        raise InvalidInputError(
            "the estimator has an observer, a cost and options already; leave them out, or give "
            "its system instead."
        )
    from .rehearsal import checked_library  # late: most programs do without

    parts = system_of(estimator), estimator.observer, estimator.cost
    only_cached, wanted = (
        replace(estimator.settings, engine=engine) for engine in ("auto", "compiled")
    )
    began, is_new = perf_counter(), False
    try:
        library = checked_library(*parts, only_cached)
    except NotCachedError:
        checked_library(*parts, wanted)
        library, is_new = checked_library(*parts, only_cached), True
    return Compiled(library.path, perf_counter() - began, is_new)


def system_of(estimator: MovingHorizonEstimator) -> System:
    """The system of an estimator, its constraints in the units that they have there."""
    system, functions = estimator.system, estimator.scaled_constraints
    if functions is None or functions.untraced or functions.fault(system.usual_points()):
        observer, cost = estimator.observer, estimator.cost
        return with_scaled_constraints(system, observer, cost, estimator.initial_state)
    return system.with_constraints(functions)


def engine_choice(estimator: MovingHorizonEstimator) -> tuple[str, str]:
    """The engine that an estimator with these arguments runs now, and why."""
    from .library import uncovered
    from .rehearsal import checked_library

    settings, observer, cost = estimator.settings, estimator.observer, estimator.cost
    system = system_of(estimator)
    if settings.engine == "python":
        return "python", "it asks for engine='python'."
    if settings.needs_python:
        return "python", "it names a QP solver, which only the Python step uses."
    if settings.engine == "auto" and python_only():
        return "python", "the environment variable QPMHE_ENGINE asks for it."
    if settings.engine == "auto" and (reason := reason_for_python(estimator._engine)):
        return "python", f"{reason}."
    try:
        reason = uncovered(system, observer, cost, settings)
        if reason:
            return "python", reason
        required_compiler()
        found = checked_library(system, observer, cost, replace(settings, engine="auto"))
    except NotCachedError as error:
        if settings.engine == "compiled":
            return "compiled", "it asks for engine='compiled', and waits for the compiler."
        return "python", str(error)
    except QpmheError as error:
        return "python", str(error)
    return "compiled", f"its library is in the cache: {found.path.name}."
