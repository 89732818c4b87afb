"""Values of a certified model at fixed points: whether a model is still the certified one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._checks import Array
from ..model.system import System
from .regions import Region

_POINTS, _SEED = 8, 20210829
#: Values of two models that differ by this share of the largest one are rounding.
SAME_MODEL = 1e-9


@dataclass(frozen=True, eq=False)
class ModelValues:
    """f and h at some points of a region, as they were when something was certified there.

    Parameters
    ----------
    points : (K, n + m) array
        States and inputs: the region's middle, and others that are the same for a region.
    f, h : (K, n) and (K, p) array
        The values there.
    """

    points: Array
    f: Array
    h: Array

    @classmethod
    def of(cls, system: System, region: Region) -> ModelValues:
        """The values of a system that is finite in the region."""
        drawn = region.sample(_POINTS - 1, np.random.default_rng(_SEED))
        points = np.vstack((drawn[0], drawn[1 - _POINTS :]))
        values = [_values(system, point) for point in points]
        return cls(points, *(np.array(each) for each in zip(*values, strict=True)))

    @cached_property
    def _rounding(self) -> tuple[Array, Array]:
        """Differences of each component of f and h that are rounding."""
        states = np.abs(self.points[:, : self.f.shape[1]])
        largest = np.maximum(np.abs(self.f), states), np.abs(self.h)
        return SAME_MODEL * largest[0].max(axis=0), SAME_MODEL * largest[1].max(axis=0)

    def difference(self, system: System, among: Sequence[int] | None = None) -> str:
        """Where a system has other values, in words; empty if all are the same.

        Differences count beyond rounding of each component's largest value. ``among`` are the
        points to try, all if left out.
        """
        n, p = self.f.shape[1], self.h.shape[1]
        sizes, own = (system.n, system.p, system.m), (n, p, self.points.shape[1] - n)
        if sizes != own:
            return f"(n, p, m) is {sizes}, and was {own} when it was certified"
        for k in range(len(self.points)) if among is None else among:
            point = self.points[k]
            try:
                found = _values(system, point)
            except Exception as error:  # a user's function may raise anything
                where = point[:n].tolist()
                return f"f or h raises {type(error).__name__} at x = {where}, and did not before"
            for name, now, then, most in zip(
                "fh", found, (self.f[k], self.h[k]), self._rounding, strict=True
            ):
                # Written so that a value that is not finite is another one.
                if not (np.abs(now - then) <= most).all():
                    return (
                        f"{name} is {now.tolist()} at x = {point[:n].tolist()}, and was "
                        f"{then.tolist()} when it was certified"
                    )
        return ""


def _values(system: System, point: Array) -> tuple[Array, Array]:
    """The values of f and h at one point."""
    x, u = point[: system.n], point[system.n :]
    with np.errstate(all="ignore"):
        f, h = np.array(system.f(x, u), np.float64), np.array(system.h(x, u), np.float64)
    return f.reshape(system.n), h.reshape(system.p)
