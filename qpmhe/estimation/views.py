"""Views of a sliding window's arrays: making them takes as long as using them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .linearization import Span, Stage

if TYPE_CHECKING:
    from .stages import Stages

__all__ = ["Frame", "Place", "Views", "read_only"]

Array = NDArray[np.float64]
View = TypeVar("View")


def read_only(array: Array) -> Array:
    """A view that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view


class Place:
    """Views of one stage's entries in all arrays.

    Attributes
    ----------
    z, following : (n,) array
        State of the observer, and the one after it.
    arguments : tuple
        What the functions of the usual model take, read-only: z, and the inputs if there are any.
    error : (p,) array
        The fitting error, read-only.
    y, u : array
        The measurement (p,), and the input (m,).
    weight : (n + p, n + p) array
        The stage's.
    terms : Stage
        Its linear map and terms.
    """

    __slots__ = ("arguments", "error", "following", "terms", "u", "weight", "y", "z")

    def __init__(self, stages: Stages, k: int) -> None:
        self.z, self.following = stages._z[k], stages._z[k + 1]
        self.y, self.u = stages._y[k], stages._u[k, :-1]
        self.arguments: tuple[Array, ...] = tuple(
            read_only(one) for one in ((self.z, self.u) if self.u.size else (self.z,))
        )
        self.weight = stages._weight[k]
        self.terms = Stage(stages.terms, k)
        self.error = read_only(self.terms.noise)


class Frame:
    """Views of a whole window.

    Attributes
    ----------
    candidate : (K + 1, n) array
        The observer's trajectory.
    prior : (n,) array
        Its first state.
    residuals, measurements, inputs : array
        (K, n + p), (K, p) and (K, m).
    costs : (K,) array
        The stages' costs.
    span : Span
        The stages' terms.
    """

    __slots__ = ("candidate", "costs", "inputs", "measurements", "prior", "residuals", "span")

    def __init__(self, stages: Stages, first: int, last: int) -> None:
        self.candidate, self.prior = stages._z[first : last + 1], stages._z[first]
        self.residuals = stages.terms.residuals[first:last]
        self.measurements, self.inputs = stages._y[first:last], stages._u[first:last, :-1]
        self.costs = stages._stage_cost[first:last]
        self.span = Span(stages.terms, first, last - first)


class Views(Sequence[View]):
    """Views that are made when they are wanted, of which only the last is kept."""

    def __init__(self, count: int, make: Callable[[int], View]) -> None:
        self._count, self._make = count, make
        self._k = -1
        self._view: View | None = None

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if k >= self._count:
            raise IndexError(k)
        if k != self._k:
            self._k, self._view = k, self._make(k)
        return self._view
