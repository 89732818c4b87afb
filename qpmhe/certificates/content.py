"""What a certificate is about, as digests: expressions, gain and sets."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from .._checks import Array
from ..model.residuals import Angles
from ..model.sets import ConvexSet
from ..model.system import System
from .graph import Graph
from .reading import expression_of, read
from .regions import Region

#: In words, by the name of a part.
_WORDS = {
    "f": "f", "h": "h", "X": "the set X", "disturbance_matrix": "disturbance_matrix",
    "output_residual": "output_residual", "state_residual": "state_residual", "gain": "the gain",
    "region": "the region", "dimensions": "(n, p, m)",
}
#: What stands for a function that has no expression: no digest equals it.
_NONE = ""


@dataclass(frozen=True)
class Content:
    """What was certified, by name: a digest of each function, matrix and set.

    Parameters
    ----------
    parts : mapping of str to str
        SHA-256 digests. Those of f and h are of their expressions, node by node, constants bit by
        bit; blank where a function has no expression.
    """

    parts: Mapping[str, str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", MappingProxyType(dict(self.parts)))

    def __reduce__(self) -> tuple[Any, ...]:
        return Content, (dict(self.parts),)

    @classmethod
    def of(cls, system: System, region: Region, gain: Array | None = None) -> Content:
        """The content of a certificate of this system, on this region, of this gain."""
        own = {} if gain is None else {"gain": digest((gain,))}
        return cls(dict(cls.of_system(system).parts) | own).on(region)

    def on(self, region: Region, **sizes: float | ConvexSet) -> Content:
        """The same with another region, and with sizes or sets by name."""
        inputs = region.lower[region.n :], region.upper[region.n :]
        own = {"region": digest((*_of_set(region.states), *inputs))}
        for name, size in sizes.items():
            own[name] = digest(_of_set(size) if isinstance(size, ConvexSet) else (size,))
        return Content(dict(self.parts) | own)

    @classmethod
    def of_system(cls, system: System) -> Content:
        """What belongs to the system alone."""
        G, X = system.disturbance_matrix, system.states
        parts = {
            "dimensions": digest((system.n, system.p, system.m)),
            "f": _of_function(system, "f"), "h": _of_function(system, "h"),
            "X": digest(("none",) if X is None else _of_set(X)),
            "disturbance_matrix": digest(("none",) if G is None else (G,)),
        }
        for name in ("output_residual", "state_residual"):
            parts[name] = digest(_of_residual(getattr(system, name)))
        return cls(parts)

    @property
    def opaque(self) -> tuple[str, ...]:
        """Functions without an expression, of which there is no digest."""
        return tuple(name for name, each in self.parts.items() if each == _NONE)

    @property
    def digest(self) -> str:
        """One digest of all."""
        return digest([text for pair in sorted(self.parts.items()) for text in pair])

    def difference(self, other: Content, by_values: bool = False) -> str:
        """Which of the other's parts are not the same, in words; blank if all are.

        Functions without an expression differ from all others, unless they are compared
        ``by_values`` elsewhere.
        """
        named = [
            _WORDS.get(name, name) for name, each in self.parts.items()
            if name in other.parts
            and (each != other.parts[name] or (each == _NONE and not by_values))
        ]
        if not named:
            return ""
        why, opaque = "", sorted({*self.opaque, *other.opaque})
        if opaque:
            why = f" (there is no expression of {' and '.join(opaque)} to compare)"
        return f"{', '.join(named)} {'differs' if len(named) == 1 else 'differ'}{why}"


def digest(values: Any) -> str:
    """SHA-256 of texts, numbers and arrays, one after another."""
    found = hashlib.sha256()
    for value in values:
        array = np.asarray(value)
        if array.dtype.kind in "US":
            text = str(value)
        else:  # as a bound has them, with -0.0 as 0.0
            floats = np.asarray(value, np.float64) + 0.0
            text = f"{floats.shape}:" + ",".join(each.hex() for each in floats.ravel().tolist())
        found.update(f"{len(text)}:{text};".encode())
    return found.hexdigest()


def _of_set(given: ConvexSet) -> tuple[Array, ...]:
    return given.lower, given.upper, given.matrix, given.row_lower, given.row_upper


def _of_residual(residual: Any) -> Iterator[Any]:
    if residual is None:
        yield "none"
    elif isinstance(residual, Angles):
        yield from ("angles", residual.components, residual.periods)
    else:
        yield from ("function", f"{id(residual)}")


def _of_function(system: System, name: str) -> str:
    """The digest of a function's expression; blank where it has none, or one not known."""
    function = expression_of(system, name).function
    if function is None:
        return _NONE
    graph = Graph(system.n + system.m)
    roots = read(graph, function)
    each: dict[int, str] = {}
    for node in graph.ancestors(roots):
        operation, arguments, parameter = graph.nodes[node]
        if operation == "unknown":
            return _NONE
        number = isinstance(parameter, (int, float)) and not isinstance(parameter, bool)
        text = float(parameter).hex() if number else repr(parameter)
        each[node] = hashlib.sha256(
            " ".join((operation, text, *(each[one] for one in arguments))).encode()
        ).hexdigest()
    return digest([each[root] for root in roots])
