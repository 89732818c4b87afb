"""Discretisation of an ordinary differential equation by one step of given length."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from .._checks import choice

Array = NDArray[Any]
Function = Callable[..., Any]
Method = Literal["euler", "rk4"]
METHODS: tuple[str, ...] = get_args(Method)


def discretize(
    rate: Function, jacobian: Function | None, method: str
) -> tuple[Function, Function | None]:
    r"""Turn :math:`\dot x = f_c(x, u)` into :math:`x^+ = f(x, u)` with u held over the step."""
    choice("method", method, METHODS)
    if method == "euler":
        return _euler(rate), jacobian and _euler_jacobian(jacobian)
    return _rk4(rate), jacobian and _rk4_jacobian(rate, jacobian)


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
