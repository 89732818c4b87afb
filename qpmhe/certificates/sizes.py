"""Bounds on disturbances and noises: lengths, sets, or vectors at each sample."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import shown

from .._checks import Array, numbers
from .._linalg import inverse
from ..costs import Cost
from ..errors import OptionError, SetError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System
from .regions import bounds
from .theorem import checked_length

#: What bounds w or v: a length, a set, or vectors (T, n), one for each sample.
Size = ArrayLike | ConvexSet

UNIT = float(np.finfo(np.float64).eps)
#: More than the rounding of a sum, a product and a root, each.
OUTWARD = 1.0 + 16.0 * UNIT
_SIGMAS = 3.0
# Boxes with more corners are bounded by sums over their sides.
_MOST_CORNERS = 4096


@dataclass(frozen=True)
class Sizes:
    """Bounds on disturbances and noises at all times.

    Parameters
    ----------
    disturbance, noise : float or ConvexSet
        The largest |w| and |v|, or sets that hold w and v, such as ``qpmhe.Box``; of another set,
        the box around it is used. An error names one that is negative or not bounded. With a
        ``disturbance_matrix`` G, w (r,) is what G multiplies.
    source : str
        The origin of these sizes, for reports.
    deviations : bool
        Whether one of them is a number of standard deviations, which Gaussian noise exceeds.
    """

    disturbance: float | ConvexSet = 1.0
    noise: float | ConvexSet = 1.0
    source: str = "as stated"
    deviations: bool = False

    def __post_init__(self) -> None:
        for name in ("disturbance", "noise"):
            given = getattr(self, name)
            if isinstance(given, ConvexSet):
                sides_of(name, given)
            else:
                checked_length(name, given)

    @classmethod
    def usual(
        cls, system: System, w_covariance: Array, v_covariance: Array, origin: str
    ) -> Sizes:
        """The system's W and V, and three standard deviations where these are not bounded."""
        found: list[ConvexSet] = []
        sources: list[str] = []
        for letter, stated, covariance in (
            ("W", system.disturbances, w_covariance), ("V", system.noises, v_covariance),
        ):
            if stated is not None and np.isfinite(bounds(stated)).all():
                found.append(stated)
                sources.append(f"the system's {letter}")
            else:
                half = _SIGMAS * np.sqrt(np.diag(covariance))
                found.append(Box(-half, half))
                sources.append(f"three standard deviations of {origin}")
        text = " and ".join(dict.fromkeys(sources))
        deviations = any("deviations" in each for each in sources)
        return cls(found[0], found[1], text, deviations)._checked(system)

    @classmethod
    def of(cls, sizes: Any, system: System, cost: Cost | None = None) -> Sizes:
        """The stated ones, or the usual ones with the cost's weights as inverse covariances."""
        if sizes is not None:
            if not isinstance(sizes, Sizes):
                raise OptionError(
                    f"sizes is {shown(sizes)}; expected Sizes(disturbance=..., noise=...), the "
                    "largest lengths or boxes."
                )
            return sizes._checked(system)
        if cost is None:
            if system.disturbances is None or system.noises is None:
                raise SetError(
                    "it is not known how large disturbances and noises may be: the system has no "
                    "sets of them. Pass sizes=Sizes(disturbance=..., noise=...), or boxes in their "
                    "place."
                )
            return cls(system.disturbances, system.noises, "the system's W and V")
        covariance, factor = inverse(cost.disturbance), cost.disturbance_factor
        if factor is not None:
            covariance = factor @ covariance @ factor.T
        return cls.usual(system, covariance, inverse(cost.noise), "the cost's inverse weights")

    def _checked(self, system: System) -> Sizes:
        """The same, if the sets have the dimensions of a system's w and v."""
        w = "w" if system.disturbance_matrix is None else "w, which its disturbance_matrix takes,"
        for name, letter, size in (("disturbance", w, system.r), ("noise", "v", system.p)):
            given = getattr(self, name)
            if isinstance(given, ConvexSet) and given.dimension != size:
                raise ShapeError(
                    f"{name} ({self.source}) is a set of dimension {given.dimension}; expected "
                    f"{size}, as the system's {letter} has."
                )
        return self

    @property
    def extent(self) -> tuple[float | Array, float | Array]:
        """The largest |w| and |v| or, of sets, half-widths by component."""
        w, v = (
            np.abs(sides_of(name, given)).max(axis=0) if isinstance(given, ConvexSet)
            else float(given)
            for name, given in (("disturbance", self.disturbance), ("noise", self.noise))
        )
        return w, v

    @property
    def largest(self) -> tuple[float, float]:
        """The largest |w| and |v|."""
        w, v = (float(np.linalg.norm(each)) * OUTWARD for each in self.extent)
        return w, v

    @property
    def typical(self) -> tuple[float | Array, float | Array]:
        """Sizes of w and v to choose a certificate for: `extent`, or 1 of each if all are zero.

        Beside others, a search takes no size as smaller than it can tell, in the units of states
        and outputs.
        """
        return self.extent if max(self.largest) > 0.0 else (1.0, 1.0)

    def __str__(self) -> str:
        return f"{_words('w', self.disturbance)}, {_words('v', self.noise)} ({self.source})"


def sides_of(name: str, given: ConvexSet) -> Array:
    """Sides (2, n) of the box around a set, which must be bounded."""
    sides = np.stack(bounds(given))
    if not np.isfinite(sides).all():
        raise SetError(
            f"{name} is an unbounded set; expected bounds on each component, such as "
            "qpmhe.Box(lower, upper) has."
        )
    return sides


def lengths_of(name: str, given: Size, weight: Array) -> Array:
    """The largest |s|_W of a length or of the box around a set, or |s|_W of vectors (..., n)."""
    n = len(weight)
    if isinstance(given, ConvexSet):
        sides = sides_of(name, given)
        if sides.shape[1] != n:
            raise ShapeError(f"{name} is a set of dimension {sides.shape[1]}; expected {n}.")
        ends = [sorted(set(pair)) for pair in sides.T.tolist()]
        if math.prod(map(len, ends)) > _MOST_CORNERS:
            return weighted_lengths(np.abs(sides).max(axis=0), np.abs(weight))
        corners = np.array(list(itertools.product(*ends)))
        return np.array(weighted_lengths(corners, weight).max())
    values = numbers(name, given)
    if values.ndim == 0:
        # The largest |s|_W of |s| = 1, rounded up.
        top = float(np.linalg.eigvalsh(weight)[-1])
        slack = 16.0 * n * n * UNIT * float(np.linalg.norm(weight))
        root = math.sqrt(max(top, 0.0) + slack) * OUTWARD
        return np.array(checked_length(name, values.item()) * root)
    if values.ndim > 2 or values.shape[-1] != n:
        raise ShapeError(
            f"{name} has shape {values.shape}; expected a length, a set such as qpmhe.Box, a "
            f"vector ({n},) or vectors (T, {n})."
        )
    return weighted_lengths(values, weight)


def stated_size(option: str, given: ArrayLike, size: int) -> float | Box:
    """A length, or a box of components, of what an option has."""
    values = numbers(option, given)
    if values.ndim == 1 and values.size == 1:
        values = values[0]
    if values.shape not in ((), (size,)) or not (values >= 0.0).all():
        raise OptionError(
            f"{option} is {values.tolist()}; expected one number >= 0 that bounds the "
            f"length, or {size}, one for each component."
        )
    return float(values) if values.ndim == 0 else Box(-values, values)


def extent_of(name: str, given: Size, n: int) -> Array:
    """The largest size of each component, (n,), of what `lengths_of` takes."""
    if isinstance(given, ConvexSet):
        return np.asarray(np.abs(sides_of(name, given)).max(axis=0))
    values = np.abs(numbers(name, given))
    if values.ndim == 0:
        return np.full(n, values)
    found: Array = values.reshape(-1, n).max(axis=0, initial=0.0)
    return found


def weighted_lengths(vectors: Array, weight: Array) -> Array:
    """|s|_W of vectors (..., n), rounded up."""
    sizes = np.abs(vectors)
    squares = np.einsum("...i,ij,...j->...", vectors, weight, vectors)
    slack = np.einsum("...i,ij,...j->...", sizes, np.abs(weight), sizes)
    squares = np.maximum(squares, 0.0) + (2 * len(weight) + 4) * UNIT * slack
    found: Array = np.sqrt(squares) * OUTWARD
    return found


def _words(letter: str, given: float | ConvexSet) -> str:
    """Bounds of one signal in words."""
    if not isinstance(given, ConvexSet):
        return f"|{letter}| <= {given:.4g}"
    return intervals(letter, *sides_of(letter, given))


def intervals(letter: str, lower: Array, upper: Array) -> str:
    """Bounds of each component in words."""
    names = [letter] if len(lower) == 1 and letter in "wv" else [
        f"{letter}{j + 1}" for j in range(len(lower))
    ]
    return ", ".join(
        f"|{name}| <= {high:.4g}" if low == -high and letter in "wv"
        else f"{name} in [{low:.4g}, {high:.4g}]"
        for name, low, high in zip(names, lower, upper, strict=True)
    )
