"""Model functions on all members at once, and member by member where that fails."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.derivatives import Jacobian
from ..model.functions import BatchedFunction
from ..model.system import System

__all__ = ["Calls", "MemberFunction"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class MemberFunction:
    """One function of the model, evaluated for every member.

    A batch in which the function raises tells nothing of its members: they are then called
    one by one, and those that raise become NaN, which is what a failed member looks like.

    Parameters
    ----------
    function : BatchedFunction or Jacobian
        f, h or the Jacobian of one of them.
    shape : tuple of int
        Shape of its value at one state.
    strict : bool
        Whether a value that is no real number at one state is a failure, too, as it is
        where the single estimator subtracts and does not assign.
    """

    def __init__(
        self, function: BatchedFunction | Jacobian, shape: tuple[int, ...], strict: bool = False
    ) -> None:
        self._function, self._shape = function, shape
        self._casting = "same_kind" if strict else "unsafe"
        #: Whether members are called one by one.
        self.apart = False

    def at(self, x: Array, u: Array) -> Array:
        """Values (K, ...) at one state of each member.

        Parameters
        ----------
        x, u : (K, n) and (K, m) array
            States and inputs.
        """
        value = self._together(x, u)
        if value is None:
            value = np.full((x.shape[0], *self._shape), np.nan)
            for k in range(x.shape[0]):
                try:
                    one = np.asarray(self._function(x[k], u[k]))
                    np.copyto(value[k], one, casting=self._casting)  # type: ignore[arg-type]
                except Exception:  # this member is outside of the model's domain
                    continue
        return value

    def along(self, x: Array, u: Array) -> Array:
        """Values (N, K, ...) along a trajectory of each member.

        Parameters
        ----------
        x, u : (N, K, n) and (N, K, m) array
            States and inputs.
        """
        stages, members = x.shape[:2]
        lead, size = (stages, members), stages * members
        value = self._together(x.reshape(size, x.shape[2]), u.reshape(size, u.shape[2]))
        if value is None:
            value = np.full((*lead, *self._shape), np.nan)
            for k in range(members):
                states, inputs = np.ascontiguousarray(x[:, k]), np.ascontiguousarray(u[:, k])
                try:
                    one = np.asarray(self._function.batch(states, inputs))
                    np.copyto(value[:, k], one, casting="same_kind")
                except Exception:  # this member is outside of the model's domain
                    continue
        return value.reshape(*lead, *self._shape)

    def _together(self, x: Array, u: Array) -> Array | None:
        """The values of one call on all; None where it cannot be trusted."""
        if self.apart:
            return None
        try:
            value = np.asarray(self._function.batch(x, u))
        except Exception:  # some member is outside of the model's domain, or none can be told
            return None
        fits = value.shape == (x.shape[0], *self._shape) and value.dtype.kind in "fiub"
        return value if fits else None

    def agrees(self, x: Array, u: Array, values: Array, members: Index) -> bool:
        """Whether values of one call on all are those of these members' own states.

        Where they are not, states are called one by one from now on.

        Parameters
        ----------
        x, u, values : array
            What `at` was given, and gave.
        members : (k,) int array
            Whom to call once more.
        """
        if self.apart or getattr(self._function, "mode", "") == "looped":
            return True
        finite = values[np.isfinite(values)]
        rounding = 1e-9 * (1.0 + float(np.abs(finite).max(initial=0.0)))
        for k in members:
            try:
                one = np.asarray(self._function(x[k], u[k]), np.float64)
            except Exception:
                one = np.full(self._shape, np.nan)
            there = np.isfinite(values[k]).all()
            if there != np.isfinite(one).all() or (
                there and not (np.abs(one - values[k]) <= rounding).all()
            ):
                self.apart = True
                return False
        return True


class Calls:
    """f, h and their Jacobians for every member.

    Parameters
    ----------
    system : System
        The model.
    """

    def __init__(self, system: System) -> None:
        n, p = system.n, system.p
        self.f = MemberFunction(system.f, (n,))
        self.h = MemberFunction(system.h, (p,), strict=True)
        self.f_jacobian = MemberFunction(system.f_jacobian, (n, n))
        self.h_jacobian = MemberFunction(system.h_jacobian, (p, n))

    def apart(self) -> list[bool]:
        """Whose functions are called member by member."""
        return [one.apart for one in self._all()]

    def set_apart(self, apart: list[bool]) -> None:
        """Call them as `apart` said."""
        for one, value in zip(self._all(), apart, strict=True):
            one.apart = value

    def _all(self) -> tuple[MemberFunction, ...]:
        return self.f, self.h, self.f_jacobian, self.h_jacobian
