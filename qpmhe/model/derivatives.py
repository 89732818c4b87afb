"""Jacobians of model functions: given, or by the complex step, or by finite differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import copy
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .functions import BatchedFunction, Probes, Trusted

__all__ = ["Jacobian"]

Array = NDArray[Any]

_COMPLEX_STEP = 1e-30  # no subtraction, hence no cancellation: any tiny step is exact
_DIFFERENCE_STEP = float(np.finfo(np.float64).eps) ** (1 / 3)


class Jacobian:
    """The Jacobian with respect to x of a `BatchedFunction` with vector values.

    Attributes
    ----------
    method : str
        ``given``, ``complex step`` or ``finite differences``.
    """

    def __init__(
        self,
        function: BatchedFunction,
        given: Callable[..., Any] | Trusted | None,
        inputs: int,
        probes: Probes,
    ) -> None:
        self._function, self._inputs = function, inputs
        self.method = "finite differences"
        self.batch: Callable[[Array, Array], Array] = self._differences
        self._given: BatchedFunction | None = None
        n = probes[0][0].size
        if given is not None:
            name = f"{function.name}_jacobian"
            self._given = BatchedFunction(name, given, (*function.shape, n), inputs, probes)
            self._compare(self._given, probes)
            self.method, self.batch = "given", self._given.batch
        elif self._complex_step_works(probes):
            self.method, self.batch = "complex step", self._complex

    def __call__(self, x: Array, u: Array) -> Array:
        """The Jacobian (d, n) at one state."""
        if self._given is not None:
            return self._given(x, u)
        value: Array = self.batch(x[None], u[None])[0]
        return value

    @property
    def direct(self) -> Callable[..., Any]:
        """A function of one state, and of the input where there are any."""
        if self._given is not None:
            return self._given.direct
        return self if self._inputs else partial(self, u=np.zeros(0))

    def _complex(self, x: Array, u: Array) -> Array:
        n = x.shape[-1]
        moved = x[..., None, :] + (1j * _COMPLEX_STEP) * np.eye(n)
        u_all = np.broadcast_to(u[..., None, :], (*moved.shape[:-1], u.shape[-1]))
        values = np.asarray(self._function.batch(moved, u_all))
        return np.swapaxes(values.imag, -1, -2) / _COMPLEX_STEP

    def _differences(self, x: Array, u: Array) -> Array:
        n = x.shape[-1]
        step = _DIFFERENCE_STEP * np.maximum(1.0, np.abs(x))
        moves = step[..., None, :] * np.eye(n)
        u_all = np.broadcast_to(u[..., None, :], (*moves.shape[:-1], u.shape[-1]))
        # A copy: a function may return one and the same array every time.
        ahead = np.array(self._function.batch(x[..., None, :] + moves, u_all))
        behind = np.asarray(self._function.batch(x[..., None, :] - moves, u_all))
        return np.swapaxes((ahead - behind) / (2 * step[..., :, None]), -1, -2)

    def _one_sided(self, x: Array, u: Array, value: Array) -> tuple[Array, Array]:
        """The smaller and the larger of forward and backward differences."""
        step = _DIFFERENCE_STEP * np.maximum(1.0, np.abs(x))
        moves = step[:, None] * np.eye(x.size)
        with np.errstate(all="ignore"):
            ahead, behind = (
                np.array([self._function(x + sign * move, u) for move in moves]).T
                for sign in (1.0, -1.0)
            )
        sides = (ahead - value[:, None]) / step, (value[:, None] - behind) / step
        return np.minimum(*sides), np.maximum(*sides)

    def _at_probes(self, probes: Probes) -> list[tuple[Array, Array, Array, Array]]:
        """The probes with the function's value and its finite differences there."""
        usable = []
        for x, u in probes:
            try:
                with np.errstate(all="ignore"):
                    value = np.asarray(self._function(x, u))
                    slope = self._differences(x[None], u[None])[0]
            except Exception:  # outside the function's domain
                continue
            if np.isfinite(slope).all():
                usable.append((x, u, value, slope))
        return usable

    def _complex_step_works(self, probes: Probes) -> bool:
        usable = self._at_probes(probes)
        for x, u, value, expected in usable:
            try:
                # A function that throws the imaginary part away warns, which raises here.
                with np.errstate(all="ignore"), warnings.catch_warnings():
                    warnings.simplefilter("error")
                    found = self._complex(x[None], u[None])[0]
            except Exception:  # comparisons, math.sin and the like do not take complex numbers
                return False
            if not _close(found, expected, value).all():
                return False
        return bool(usable)

    def check(self, x: Array, u: Array) -> None:
        """Try the method again at a state that will be used."""
        if self._given is not None:
            self._compare(self._given, [(x, u)])
        elif self.method == "complex step" and not self._complex_step_works([(x, u)]):
            self.use("finite differences")

    def copy(self, function: BatchedFunction) -> Jacobian:
        """The same Jacobian, of a copy of its function; its method can change independently."""
        other = copy(self)
        other._function = function
        if self._given is None:
            other.use(self.method)
        else:
            other._given = self._given.copy()
            other.batch = other._given.batch
        return other

    def use(self, method: str) -> None:
        """Compute by this method from now on, unless the user gave the Jacobian."""
        if self._given is None:
            self.method = method
            self.batch = self._complex if method == "complex step" else self._differences

    def _compare(self, given: BatchedFunction, probes: Probes) -> None:
        for x, u, value, expected in self._at_probes(probes):
            try:
                with np.errstate(all="ignore"):
                    found = np.asarray(given(x, u), dtype=np.float64)
            except Exception:  # outside its domain
                continue
            wrong = ~_close(found, expected, value)
            if wrong.any():  # at a kink, any slope between those of the two sides will do
                low, high = self._one_sided(x, u, value)
                slack = 1e-4 * np.abs(found) + 1e-6
                wrong &= ~((low - slack <= found) & (found <= high + slack))
            if np.isfinite(found).all() and wrong.any():
                i, j = np.argwhere(wrong)[0]
                raise ModelError(
                    f"{given.name}[{i}, {j}] is {found[i, j]:.6g} at x = {x.tolist()}, but the "
                    f"derivative of the function there is {expected[i, j]:.6g}. Correct it, or "
                    "leave it out to have it computed."
                )


def _close(found: Array, expected: Array, value: Array) -> Array:
    """Entry by entry, up to the accuracy of differences of functions with these values."""
    row = np.abs(expected).max(axis=1, keepdims=True)
    floor = 1e-6 * (1.0 + row) + 1e-9 * np.abs(value).reshape(-1, 1)
    close: Array = np.abs(found - expected) <= 1e-4 * np.abs(expected) + floor
    return close
