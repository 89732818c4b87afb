"""Nodes of a graph, evaluated on many cells at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from .._checks import Array
from .graph import Graph
from .intervals import BRANCHES, OPERATIONS, Interval

# Numbers that are held at once, of both ends of intervals.
_HELD = 1_000_000
# Why a node may be undefined on a cell.
_UNDEFINED = {
    "pow": "a division by a value that may be zero", "sqrt": "a square root of a value that may "
    "be negative", "log": "a logarithm of a value that may not be positive",
    "log1p": "a logarithm of a value that may not be positive",
    "raised": "a power of a value that may not be positive",
    "jump": "a choice (numpy.where, if_else) that may jump where its condition changes",
    "truth": "a comparison as a number, which jumps",
    "angle": "an angle (arctan2) that may jump, or be of a point at the origin",
    **{name: f"a jump of {name}" for name in ("floor", "ceil", "sign", "trunc")},
}


class Program:
    """Some nodes of a graph, evaluated on many cells at once: equal operations together."""

    def __init__(self, graph: Graph, roots: Sequence[int]) -> None:
        self._graph, depth = graph, dict[int, int]()
        for node in graph.ancestors(roots):
            depth[node] = 1 + max((depth[one] for one in graph.nodes[node][1]), default=0)

        def kind(node: int) -> tuple[Any, ...]:
            operation, arguments, parameter = graph.nodes[node]
            return (depth[node], operation, repr(parameter), len(arguments)) if arguments else (1,)

        self._order = sorted(depth, key=kind)
        self._place = place = {node: k for k, node in enumerate(self._order)}
        self._roots = np.array([place[root] for root in roots], np.intp)
        groups = [list(members) for _, members in groupby(self._order, kind)]
        leaves = groups[0] if groups else []
        self._columns = [
            (k, graph.nodes[node][2]) for k, node in enumerate(leaves)
            if graph.nodes[node][0] == "variable"
        ]
        self._constants = np.array([
            graph.nodes[node][2] if graph.nodes[node][0] == "constant" else np.nan
            for node in leaves
        ])
        self._groups = []
        for members in groups[1:]:
            operation, _, parameter = graph.nodes[members[0]]
            rows = np.array([[place[one] for one in graph.nodes[node][1]] for node in members]).T
            self._groups.append((
                OPERATIONS[operation], rows, () if parameter is None else (parameter,),
                place[members[0]], place[members[0]] + len(members),
            ))

    def __call__(
        self, lower: Array, upper: Array, forced: dict[int, Array] | None = None
    ) -> Interval:
        """The nodes (roots, B) over cells (B, N), with the values (B,) of some unless NaN."""
        size = max(1, _HELD // max(1, len(self._order)))
        rows = [
            (self._place[node], values) for node, values in (forced or {}).items()
            if node in self._place
        ]
        low, high = np.empty((2, len(self._roots), len(lower)))
        for start in range(0, len(lower), size):
            part = slice(start, start + size)
            found = self._held(
                lower[part], upper[part], [(row, values[part]) for row, values in rows]
            )[self._roots]
            low[:, part], high[:, part] = found.low, found.high
        return Interval(low, high)

    def _held(
        self, lower: Array, upper: Array, forced: Sequence[tuple[int, Array]] = ()
    ) -> Interval:
        """All nodes, in order."""
        low, high = np.empty((2, len(self._order), len(lower)))
        low[: self._constants.size] = high[: self._constants.size] = self._constants[:, None]
        for row, column in self._columns:
            low[row], high[row] = lower[:, column], upper[:, column]
        with np.errstate(all="ignore"):
            for function, arguments, parameters, start, end in self._groups:
                found = function(*(Interval(low[a], high[a]) for a in arguments), *parameters)
                low[start:end], high[start:end] = found.low, found.high
                for row, values in forced:
                    if start <= row < end:
                        given = np.isfinite(values)
                        low[row, given] = high[row, given] = values[given]
        return Interval(low, high)

    def obstacle(self, lower: Array, upper: Array) -> str:
        """What is not defined on all of a cell (N,), in words; blank if everything is."""
        values = self._held(lower[None], upper[None])
        place = self._place
        for k in self._roots:
            node = self._order[k]
            while not values.known[place[node], 0]:
                operation, arguments, parameter = self._graph.nodes[node]
                if operation in BRANCHES:
                    truth = values.low[place[arguments[0]], 0], values.high[place[arguments[0]], 0]
                    if truth in ((0.0, 0.0), (1.0, 1.0)):
                        arguments = (arguments[1 if truth[0] else 2],)
                unknown = [one for one in arguments if not values.known[place[one], 0]]
                if not unknown:
                    if operation == "unknown":
                        return f"{parameter}, of which no enclosure is known"
                    if operation == "constant":
                        return f"the value {parameter}"
                    return _UNDEFINED.get(operation, f"{operation} of a value out of its range")
                node = unknown[0]
        return ""
