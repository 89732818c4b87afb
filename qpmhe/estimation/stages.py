"""Views of the stages and windows of a record, made once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..memory.record import MemoryRecord
from ..terms.base import read_only
from ..terms.linearization import Span, Stage, StageTerms

Array = NDArray[np.float64]

View = TypeVar("View")


class StageView:
    """Views of stage k's entries in all arrays.

    Attributes
    ----------
    z, z_next : (n,) array
        States of the observer before and after the stage.
    arguments : tuple
        Arguments of f and h of the usual model, read-only: z, and u if the system has inputs.
    error : (p,) array
        The fitting error y - h(z), read-only.
    y, u : array
        The measurement (p,), and the input (m,).
    weight : (n + p, n + p) array
        Weight of the joint residual, or its entries.
    terms : Stage
        Linearised residual and terms of the QP.
    """

    __slots__ = ("arguments", "error", "terms", "u", "weight", "y", "z", "z_next")

    def __init__(self, record: MemoryRecord, terms: StageTerms, k: int) -> None:
        self.z, self.z_next = record.z[k], record.z[k + 1]
        self.y, self.u = record.y[k], record.u[k, :-1]
        self.arguments: tuple[Array, ...] = tuple(
            read_only(one) for one in ((self.z, self.u) if self.u.size else (self.z,))
        )
        self.weight = record.weight[k]
        self.terms = Stage(terms, k)
        self.error = read_only(self.terms.noise)


class WindowArrays:
    """Views of a whole window.

    Attributes
    ----------
    candidate : (K + 1, n) array
        The observer's trajectory.
    prior : (n,) array
        z(t-N), its first state.
    residuals, measurements, inputs : array
        (K, n + p), (K, p) and (K, m).
    costs : (K,) array
        The stages' costs.
    span : Span
        The stages' terms.
    """

    __slots__ = ("candidate", "costs", "inputs", "measurements", "prior", "residuals", "span")

    def __init__(self, record: MemoryRecord, terms: StageTerms, first: int, last: int) -> None:
        self.candidate, self.prior = record.z[first : last + 1], record.z[first]
        self.residuals = terms.residuals[first:last]
        self.measurements, self.inputs = record.y[first:last], record.u[first:last, :-1]
        self.costs = record.cost[first:last]
        self.span = Span(terms, first, last - first)


class Views(Sequence[View]):
    """Views made on demand; only the last one is kept."""

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
