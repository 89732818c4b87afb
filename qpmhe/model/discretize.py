"""Discretisation of an ordinary differential equation by steps of given length."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import choice, dimension
from .implicit_steps import COLLOCATIONS, Collocation, ImplicitStep

Array = NDArray[Any]
Function = Callable[..., Any]
#: Explicit methods, which need no Jacobian of the rate, and implicit ones.
EXPLICIT = ("euler", "rk4")
METHODS = (*EXPLICIT, *COLLOCATIONS)
#: Method and substeps are chosen when a system is made: see `qpmhe.model.accuracy`.
AUTO = "auto"


class Discretization(NamedTuple):
    """By how many substeps of which method an ODE becomes a map."""

    method: str
    steps: int = 1

    @property
    def is_implicit(self) -> bool:
        """Whether a step solves equations."""
        return self.method in COLLOCATIONS

    @property
    def collocation(self) -> Collocation:
        """The coefficients, of an implicit method."""
        return COLLOCATIONS[self.method]

    @property
    def words(self) -> str:
        """Both, as text."""
        return f"{self.method} with {self.steps} substep{'s' * (self.steps != 1)}"


def checked_discretization(
    method: str, steps: int, methods: tuple[str, ...] = METHODS
) -> Discretization:
    """The arguments ``method`` and ``steps``, checked."""
    choice("method", method, methods)
    return Discretization(method, dimension("steps", steps, 1))


def discretize(
    rate: Function, jacobian: Function | None, how: Discretization
) -> tuple[Function, Function | None]:
    r"""Turn :math:`\dot x = f_c(x, u)` into :math:`x^+ = f(x, u)` with u held over the step.

    Implicit methods need the Jacobian of the rate.
    """
    if how.is_implicit:
        assert jacobian is not None
        return _implicit(rate, jacobian, how)
    if how.method == "euler":
        step, slope = _euler(rate), jacobian and _euler_jacobian(jacobian)
    else:
        step, slope = _rk4(rate), jacobian and _rk4_jacobian(rate, jacobian)
    if how.steps == 1:
        return step, slope
    return _repeated(step, how.steps), slope and _repeated_jacobian(step, slope, how.steps)


def _repeated(step: Function, steps: int) -> Function:
    def repeated(dt: Any, x: Array, *u: Array) -> Array:
        for _ in range(steps):
            x = step(dt / steps, x, *u)
        return x

    return repeated


def _repeated_jacobian(step: Function, slope: Function, steps: int) -> Function:
    def repeated(dt: Any, x: Array, *u: Array) -> Array:
        value: Array = slope(dt / steps, x, *u)
        for _ in range(steps - 1):
            x = step(dt / steps, x, *u)
            value = slope(dt / steps, x, *u) @ value
        return value

    return repeated


def _implicit(
    rate: Function, jacobian: Function, how: Discretization
) -> tuple[Function, Function]:
    """The step and its Jacobian, over (..., n), by Newton's method."""

    def of_many(function: Function) -> Function:
        return lambda x, u: function(x, *((u,) if u.shape[-1] else ()))

    return of_any_shape(ImplicitStep(of_many(rate), of_many(jacobian), how.method, how.steps))


def of_any_shape(
    solved: ImplicitStep, complete: Function | None = None
) -> tuple[Function, Function]:
    """The step and its Jacobian over (..., n).

    ``complete`` puts algebraic states below those of (K, n), where there are any.
    """

    def rows(dt: Any, x: Array, u: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        states = x.reshape(-1, x.shape[-1])
        inputs = u[0].reshape(len(states), -1) if u else np.empty((len(states), 0))
        if complete is not None:
            states = complete(states, inputs)
        return states, inputs, np.broadcast_to(np.ravel(dt), len(states))

    def step(dt: Any, x: Array, *u: Array) -> Array:
        return solved.value(*rows(dt, x, u)).reshape(x.shape)

    def slope(dt: Any, x: Array, *u: Array) -> Array:
        found: Array = solved.linear(*rows(dt, x, u))[1].reshape(*x.shape, x.shape[-1])
        return found

    return step, slope


@lru_cache(maxsize=64)
def _identity(n: int) -> Array:
    return np.eye(n)


def _of_matrices(dt: Any) -> Any:
    """A step length that multiplies (..., n) made to multiply (..., n, n)."""
    return dt[..., None] if isinstance(dt, np.ndarray) else dt


def _euler(rate: Function) -> Function:
    def step(dt: Any, x: Array, *u: Array) -> Array:
        value: Array = x + dt * rate(x, *u)
        return value

    return step


def _euler_jacobian(rate_jacobian: Function) -> Function:
    def step_jacobian(dt: Any, x: Array, *u: Array) -> Array:
        value: Array = _of_matrices(dt) * rate_jacobian(x, *u)
        value += _identity(x.shape[-1])
        return value

    return step_jacobian


def _rk4(rate: Function) -> Function:
    def step(dt: Any, x: Array, *u: Array) -> Array:
        k1 = rate(x, *u)
        k2 = rate(x + 0.5 * dt * k1, *u)
        k3 = rate(x + 0.5 * dt * k2, *u)
        k4 = rate(x + dt * k3, *u)
        value: Array = x + (dt / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
        return value

    return step


def _rk4_jacobian(rate: Function, rate_jacobian: Function) -> Function:
    def step_jacobian(dt: Any, x: Array, *u: Array) -> Array:
        eye, h = _identity(x.shape[-1]), _of_matrices(dt)
        k1 = rate(x, *u)
        j1 = rate_jacobian(x, *u)
        x2 = x + 0.5 * dt * k1
        k2 = rate(x2, *u)
        j2 = rate_jacobian(x2, *u) @ (eye + 0.5 * h * j1)
        x3 = x + 0.5 * dt * k2
        k3 = rate(x3, *u)
        j3 = rate_jacobian(x3, *u) @ (eye + 0.5 * h * j2)
        j4 = rate_jacobian(x + dt * k3, *u) @ (eye + h * j3)
        value: Array = eye + (h / 6.0) * (j1 + 2.0 * (j2 + j3) + j4)
        return value

    return step_jacobian
