"""What bounds disturbances and noises: lengths, sets, or vectors at each sample."""

from __future__ import annotations

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

#: What bounds w or v: a length, a set, or lengths (T,) or vectors (T, n) at each sample.
Size = ArrayLike | ConvexSet

UNIT = float(np.finfo(np.float64).eps)
#: More than the rounding of a sum, a product and a root, each.
OUTWARD = 1.0 + 16.0 * UNIT
_SIGMAS = 3.0
# Of the larger size, what the other one counts at least where a matrix is sought.
_LEAST = 1e-3
#: Boxes with more corners are bounded by sums over their sides.
MOST_CORNERS = 4096


@dataclass(frozen=True)
class Sizes:
    """What bounds disturbances and noises at all times.

    Parameters
    ----------
    disturbance, noise : float or ConvexSet
        The largest |w| and |v|, or sets that hold w and v, such as ``qpmhe.Box``; of another set,
        the box around it is used. An error names one that is negative or not bounded.
    source : str
        Where this comes from, for reports.
    """

    disturbance: float | ConvexSet = 1.0
    noise: float | ConvexSet = 1.0
    source: str = "as stated"

    def __post_init__(self) -> None:
        for name in ("disturbance", "noise"):
            given = getattr(self, name)
            if not isinstance(given, ConvexSet):
                checked_length(name, given)
            read_size(name, given)

    @classmethod
    def usual(
        cls, system: System, w_covariance: Array, v_covariance: Array, origin: str
    ) -> Sizes:
        """The system's W and V, and three standard deviations where these are not bounded."""
        found: list[ConvexSet] = []
        sources: list[str] = []
        spread = system.state_covariance(w_covariance)
        for letter, stated, covariance in (
            ("W", system.disturbances, spread), ("V", system.noises, v_covariance),
        ):
            of_states = letter == "V" or system.disturbance_matrix is None
            if stated is not None and of_states and np.isfinite(bounds(stated)).all():
                found.append(stated)
                sources.append(f"the system's {letter}")
            else:
                half = _SIGMAS * np.sqrt(np.diag(covariance))
                found.append(Box(-half, half))
                sources.append(f"three standard deviations of {origin}")
        return cls(found[0], found[1], " and ".join(dict.fromkeys(sources)))

    @classmethod
    def of(cls, sizes: Any, system: System, cost: Cost) -> Sizes:
        """Those that are stated, or the usual ones with the weights as inverse covariances."""
        if sizes is not None:
            return cls.stated(sizes)
        covariance, factor = inverse(cost.disturbance), cost.disturbance_factor
        if factor is not None:
            covariance = factor @ covariance @ factor.T
        return cls.usual(system, covariance, inverse(cost.noise), "the cost's inverse weights")

    @classmethod
    def stated(cls, sizes: Any) -> Sizes:
        """Those that the user states, or an `OptionError`."""
        if not isinstance(sizes, Sizes):
            raise OptionError(
                f"sizes is {shown(sizes)}; expected Sizes(disturbance=..., noise=...), the largest "
                "lengths or boxes."
            )
        return sizes

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
        w, v = (
            each if isinstance(each, float) else float(np.linalg.norm(each)) * OUTWARD
            for each in self.extent
        )
        return w, v

    def typical(self, system: System) -> tuple[float | Array, float | Array]:
        """Sizes of w and v to choose a certificate for: of each component, or lengths.

        Where there is nothing of one kind, a thousandth of the other keeps the choice bounded.
        """
        lengths = self.largest if max(self.largest) > 0.0 else (1.0, 1.0)
        least = _LEAST * max(lengths)
        w, v = (
            np.maximum(each, least) if np.size(each) == size and np.ndim(each)
            else max(length, least)
            for each, length, size in zip(
                self.extent, lengths, (system.r, system.p), strict=True
            )
        )
        return w, v

    def __str__(self) -> str:
        return f"{_words('w', self.disturbance)}, {_words('v', self.noise)} ({self.source})"

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows."""
        return {"source": self.source} | {
            name: sides_of(name, given).tolist() if isinstance(given, ConvexSet) else float(given)
            for name, given in (("disturbance", self.disturbance), ("noise", self.noise))
        }


def read_size(name: str, value: Any) -> Array | ConvexSet:
    """A bounded set, or numbers."""
    if isinstance(value, ConvexSet):
        sides_of(name, value)
        return value
    found = numbers(name, value)
    if found.ndim == 0:
        checked_length(name, found)
    return found


def sides_of(name: str, given: ConvexSet) -> Array:
    """Sides (2, n) of the box around a set, which must be bounded."""
    sides = np.stack(bounds(given))
    if not np.isfinite(sides).all():
        raise SetError(
            f"{name} is an unbounded set; expected bounds on each component, such as "
            "qpmhe.Box(lower, upper) has."
        )
    return sides


def corners_of(name: str, given: ConvexSet, size: int) -> Array:
    """The corners (K, n) of the box around a set; none of them where there are too many."""
    lower, upper = sides_of(name, given)
    if lower.size != size:
        raise ShapeError(f"{name} is a set of dimension {lower.size}; expected {size}.")
    wide = np.flatnonzero(upper > lower)
    if 2**wide.size > MOST_CORNERS:
        return np.empty((0, size))
    found = np.tile(lower, (2**wide.size, 1))
    for k, j in enumerate(wide):
        found[(np.arange(len(found)) >> k) % 2 == 1, j] = upper[j]
    return found


def lengths_of(name: str, given: Array | ConvexSet, size: int, weight: Array) -> Array:
    """The largest |s|_W, always () or at each sample (T,); a set counts as the box around it."""
    if isinstance(given, ConvexSet):
        corners = corners_of(name, given, size)
        if len(corners):
            return np.array(weighted_lengths(corners, weight).max())
        largest = np.abs(sides_of(name, given)).max(axis=0)
        return np.array(weighted_lengths(largest, np.abs(weight)))
    if given.ndim > 2 or (given.ndim == 2 and given.shape[1] != size):
        raise ShapeError(
            f"{name} has shape {given.shape}; expected vectors (T, {size}), lengths (T,), a "
            "length, or a set such as qpmhe.Box."
        )
    if given.ndim == 2:
        return weighted_lengths(given, weight)
    if (given < 0.0).any():
        raise OptionError(f"{name} is {shown(given)}; expected Euclidean lengths, all >= 0.")
    return given * root_of(weight)


def initial_length(error: Size, weight: Array) -> float:
    """|e|_W from an initial error: a vector (n,), a bound on its length, or a set that holds it."""
    given, n = read_size("initial_error", error), len(weight)
    if isinstance(given, ConvexSet):
        return float(lengths_of("initial_error", given, n, weight))
    if given.shape not in ((), (n,)):
        raise ShapeError(
            f"initial_error has shape {given.shape}; expected ({n},), a length, or a qpmhe.Box."
        )
    if given.shape == (n,):
        return float(weighted_lengths(given, weight))
    return float(given) * root_of(weight)


def weighted_lengths(vectors: Array, weight: Array) -> Array:
    """|s|_W of vectors (..., n), rounded up."""
    sizes = np.abs(vectors)
    squares = np.einsum("...i,ij,...j->...", vectors, weight, vectors)
    slack = np.einsum("...i,ij,...j->...", sizes, np.abs(weight), sizes)
    squares = np.maximum(squares, 0.0) + (2 * len(weight) + 4) * UNIT * slack
    found: Array = np.sqrt(squares) * OUTWARD
    return found


def root_of(weight: Array) -> float:
    """The largest |s|_W of |s| = 1, rounded up."""
    n = len(weight)
    top = float(np.linalg.eigvalsh(weight)[-1])
    slack = 16.0 * n * n * UNIT * float(np.linalg.norm(weight))
    return math.sqrt(max(top, 0.0) + slack) * OUTWARD


def _words(letter: str, given: float | ConvexSet) -> str:
    """Bounds of one signal in words."""
    if not isinstance(given, ConvexSet):
        return f"|{letter}| <= {given:.4g}"
    lower, upper = sides_of(letter, given)
    several = lower.size > 1
    return ", ".join(
        f"|{letter}{j + 1 if several else ''}| <= {high:.4g}" if low == -high
        else f"{letter}{j + 1 if several else ''} in [{low:.4g}, {high:.4g}]"
        for j, (low, high) in enumerate(zip(lower, upper, strict=True))
    )
