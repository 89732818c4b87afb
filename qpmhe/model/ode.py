"""A system that is the discretisation of an ODE with a fixed step."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers.values import shown

from .._checks import dimension, positive
from ..errors import OptionError
from .accuracy import TOLERANCE, TRIED, Choice, choice
from .derivatives import Jacobian
from .discretize import AUTO, METHODS, Discretization, checked_discretization, discretize
from .functions import BatchedFunction, Trusted
from .model import Origin
from .points import FEW, points
from .system_arguments import SystemOptions, checked_scales, checked_set, timed_options

if TYPE_CHECKING:
    from .augmentation import Augmentation
    from .system import System

Array = NDArray[np.float64]
Function = Callable[..., Any]


def checked_method(
    method: str, steps: int, tolerance: float | None, methods: tuple[str, ...] = METHODS
) -> tuple[Discretization, float]:
    """The arguments of `System.from_ode` of these names, checked."""
    how = checked_discretization(method, steps, (*methods, AUTO))
    if tolerance is not None and method != AUTO:
        raise OptionError(
            f"tolerance is {shown(tolerance)}, but method is {method!r}, whose steps are as "
            "many as steps says; leave it out, or take method='auto'."
        )
    if tolerance is not None:
        tolerance = positive("tolerance", tolerance)
    if steps != 1 and method == AUTO:
        raise OptionError(f"steps is {steps}, but method='auto' chooses steps; leave steps out.")
    return how, TOLERANCE if tolerance is None else tolerance


def check_length(how: Discretization, dt: float | None) -> None:
    """Refuse a discretisation of a step that has no length; the usual one is no request."""
    if dt is None and (how.steps != 1 or how.method == AUTO or how.is_implicit):
        given = f"steps is {how.steps}" if how.steps != 1 else f"method is {how.method!r}"
        raise OptionError(
            f"{given}, but dt is missing, so that f is the step; pass dt and the rate."
        )


def made_from_ode(
    cls: type[System], rate: Function | Trusted, h: Function | Trusted, *, dt: float, n: int,
    p: int, m: int, how: Discretization, rate_jacobian: Function | Trusted | None,
    h_jacobian: Function | Trusted | None, options: SystemOptions, tolerance: float = TOLERANCE,
    jacobians: str = "given", sources: dict[str, Function] | None = None,
) -> System:
    """The system that `System.from_ode` describes; for the last two see `Origin`."""
    n, m = dimension("n", n, 1), dimension("m", m, 0)
    states = checked_set("states", options.get("states"), n)
    probes = points(FEW, n, m, states)
    batched = BatchedFunction("rate", rate, (n,), m, probes)
    given = compared = None
    if rate_jacobian is not None:
        compared = Jacobian(batched, rate_jacobian, m, probes, states)
        given = BatchedFunction("rate_jacobian", rate_jacobian, (n, n), m, probes)
    sizes = options.get("scales")
    scales = None if sizes is None else checked_scales(sizes, n)
    length, over_leading = positive("dt", dt), _over_leading(batched)

    @cache
    def slope() -> Function:
        if given is not None:
            return _over_leading(given)
        differences = Jacobian(batched, None, m, probes, states)
        if scales is not None:  # else steps are shares of 1 and of the states
            differences.use_scales(scales, None, ())
        return partial(_of_inputs, differences.batch, m)

    def stepper(how: Discretization) -> Callable[[Array, Array, Array], Array]:
        tried = discretize(over_leading, slope() if how.is_implicit else None, how)[0]
        return lambda dt, x, u: tried(dt[:, None], x, *([u] if m else []))

    if (how.is_implicit or how.method == AUTO) and given is None and h_jacobian is None:
        jacobians = "finite differences"  # a trace replaces them, however far they are from it
    chosen: Choice | None = None
    if how.method == AUTO:
        chosen = choice(stepper, tuple(TRIED), length, n, m, states, scales, tolerance)
        how = chosen.how
    needs_slope = how.is_implicit or given is not None
    step, step_jacobian = discretize(over_leading, slope() if needs_slope else None, how)

    def timed(system: System) -> System:
        return cls.made(
            Trusted(timed_by_input(step, m)), Trusted(without_last(system.h.batch, m)),
            Origin(is_timed=True, jacobians=jacobians), n=n, p=p, m=m + 1,
            f_jacobian=step_jacobian and Trusted(timed_by_input(step_jacobian, m)),
            h_jacobian=h_jacobian and Trusted(
                without_last(system.evaluation.functions.h_jacobian.batch, m)
            ),
            **timed_options(options),
        )

    def augmented(change: Augmentation, others: SystemOptions) -> System:
        own = system.evaluation.functions
        slopes = change.slopes(0.0, rate_jacobian=own.rate_jacobian, h_jacobian=own.h_jacobian)
        return made_from_ode(
            cls, change.over_leading(batched, 0.0), change.over_leading(system.h), dt=dt,
            n=change.n, p=p, m=change.m, how=how, rate_jacobian=slopes.get("rate_jacobian"),
            h_jacobian=slopes.get("h_jacobian"), options=others,
            jacobians=jacobians if slopes else "given",
        )

    system = cls.made(
        Trusted(partial(step, length)), h,
        Origin(
            dt=length, how=how, rate=batched, rate_jacobian=compared, choice=chosen,
            stepper=stepper,
            jacobians=jacobians, sources=sources,
            make_timed=timed, make_augmented=augmented,
            recipe=(cls.from_ode, {
                "rate": rate, "h": h, "dt": dt, "n": n, "p": p, "m": m, "method": how.method,
                "steps": how.steps, "rate_jacobian": rate_jacobian, "h_jacobian": h_jacobian,
                **options,
            }),
        ),
        n=n, p=p, m=m, f_jacobian=step_jacobian and Trusted(partial(step_jacobian, length)),
        h_jacobian=h_jacobian, **options,
    )
    return system


def _over_leading(function: BatchedFunction) -> Function:
    """A function of (..., n), however the user wrote it."""
    simple = function.shape[0] > 1 and function.takes_input == function.has_inputs

    def evaluate(x: Array, *inputs: Array) -> Any:
        if simple and x.ndim == 1 and function.reads_only:
            value = function.function(x, *inputs)
            return value if type(value) is np.ndarray else np.asarray(value)
        u = inputs[0] if inputs else np.empty((*x.shape[:-1], 0))
        return function.batch(x, u) if x.ndim > 1 else np.asarray(function(x, u))

    return evaluate


def _of_inputs(function: Function, m: int, x: Array, *u: Array) -> Any:
    """A function over (K, n) and (K, m), where there may be no argument for inputs."""
    return function(x, u[0] if m else np.empty((len(x), 0)))


def timed_by_input(step: Function, m: int) -> Function:
    """A step of (dt, x, u) as a function of x and an input that ends with dt."""
    def evaluate(x: Array, u: Array) -> Any:
        return step(u[..., m:], x, u[..., :m]) if m else step(u, x)

    return evaluate


def without_last(function: Function, m: int) -> Function:
    """A function of x and u as one of an input that has one more entry."""
    def evaluate(x: Array, u: Array) -> Any:
        return function(x, u[..., :m]) if x.ndim > 1 else function(x[None], u[None, :m])[0]

    return evaluate
