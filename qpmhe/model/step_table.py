"""How accurate and how fast the steps of a system are, and others beside them, as text."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from timeit import timeit
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .accuracy import MOST_SOLVED, TOLERANCE, Stepper, table, work
from .discretize import Discretization
from .evaluation import Evaluator, machine
from .points import USUAL, points

if TYPE_CHECKING:
    from .system import System

Array = NDArray[np.float64]
# Of so many calls the fastest counts; of fewer, if the faster of two takes more seconds.
_TRIALS, _SLOW = 5, 3e-2


def step_table(system: System) -> str:
    """The discretisation of a system with a rate, its error, and those of others, with times.

    Errors are shares of the states, at states within X of the magnitudes that the scales say.
    """
    how, choice, dt = system.origin.how, system.origin.choice, system.dt
    assert how is not None
    assert dt is not None
    step = stepper(system.evaluated_by(system.model()))
    errors: dict[Discretization, float] = {}
    if choice is None:
        with suppress(Exception):  # of the user's functions
            errors = table(
                step, how, dt, system.n, system.m, system.states,
                system.scales if system.has_scales else None, _methods(system),
            )
        lines = [
            f"step: {how.words} in dt = {dt:g}. Each estimator compares it with steps of half the "
            "length,\n  and with radau's, relative to its disturbance; `qpmhe doctor` shows the "
            "errors."
        ]
        lines.append(
            "  Errors as shares of the states, work in substeps of rk4 in C, and times in Python:"
            if errors else
            f"  At states of magnitudes near 1, within X, no steps agree to {TOLERANCE:g} of them, "
            "so that no\n  error is known: give scales or bounded states."
        )
    else:
        errors, lines = choice.errors, [f"step: {choice.words}"]
    for one, error in errors.items():
        text = f"{error:.1e}" if error < 1.0 else "above 1"
        lines.append(
            f"  {one.method:<8} {one.steps:>3}   error {text:<8} work {work(one):<5g}"
            f"{_time(step(one), system)}".rstrip()
        )
    return "\n".join(lines)


def _methods(system: System) -> tuple[str, ...]:
    """Methods that a user might take in the place of the system's own."""
    implicit = ("radau",) if system.n <= MOST_SOLVED else ()
    return implicit if system.origin.equations is not None else ("rk4", *implicit)


def stepper(system: System) -> Stepper:
    """Steps by any discretisation, of lengths (K,), states (K, n) and inputs (K, m).

    They are those of the expression that the system evaluates, if there is one.
    """
    model, given = system.symbolic, system.origin.stepper

    def made(how: Discretization) -> Callable[[Array, Array, Array], Array]:
        if model is not None and model.how is not None:
            one = Evaluator(machine(replace(model, how=how), True)).one
            return lambda dt, x, u: one("f", x, np.column_stack((u, dt)))
        if given is not None:
            return given(how)
        other = system.discretized(*how)
        if other is None:
            raise ValueError(how)
        f = other.timed.f.batch
        return lambda dt, x, u: f(x, np.column_stack((u, dt)))

    return made


def _time(step: Callable[[Array, Array, Array], Array], system: System) -> str:
    """How long a step takes; blank where it fails."""
    scales = 1.0 if system.scales is None else system.scales
    (x, u), *_ = points(USUAL[:1], system.n, system.m, system.states, scales)
    length = np.array([system.dt])
    with suppress(Exception), np.errstate(all="ignore"):
        step(length, x[None], u[None])  # which makes its functions
        best = np.inf
        for k in range(_TRIALS):
            best = min(best, timeit(lambda: step(length, x[None], u[None]), number=1))
            if k and best > _SLOW:  # the first one may have been interrupted
                break
        return f"time {1e6 * best:.1f} us"
    return ""
