"""Nodes of a graph, evaluated on many cells at once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
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
        self._graph = graph
        nodes = graph.ancestors(roots)
        self._order: list[int] = []
        waiting, users = {}, defaultdict(list)
        ready: dict[tuple[str, Any, int], list[int]] = defaultdict(list)
        leaves = []
        for node in nodes:
            operation, arguments, parameter = graph.nodes[node]
            waiting[node] = len(set(arguments))
            for one in set(arguments):
                users[one].append(node)
            if operation in ("variable", "constant", "unknown"):
                leaves.append(node)
        groups: list[tuple[tuple[str, Any, int], list[int]]] = []
        done = leaves
        while True:
            self._order += done
            for one in done:
                for user in users[one]:
                    waiting[user] -= 1
                    if not waiting[user]:
                        operation, arguments, parameter = graph.nodes[user]
                        ready[operation, parameter, len(arguments)].append(user)
            if not ready:
                break
            key = max(ready, key=lambda one: len(ready[one]))
            done = ready.pop(key)
            groups.append((key, done))
        self._place = place = {node: k for k, node in enumerate(self._order)}
        self._roots = np.array([place[root] for root in roots], np.intp)
        self._leaves = len(leaves)
        self._columns = [
            (k, graph.nodes[node][2]) for k, node in enumerate(leaves)
            if graph.nodes[node][0] == "variable"
        ]
        self._constants = np.array([
            graph.nodes[node][2] if graph.nodes[node][0] == "constant" else np.nan
            for node in leaves
        ])
        self._groups = []
        for (operation, parameter, count), members in groups:
            rows = [
                np.array([place[graph.nodes[node][1][j]] for node in members], np.intp)
                for j in range(count)
            ]
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
        parts = [
            self._held(
                lower[k : k + size], upper[k : k + size],
                [(row, values[k : k + size]) for row, values in rows],
            )[self._roots]
            for k in range(0, len(lower), size)
        ]
        return Interval(
            np.concatenate([one.low for one in parts], axis=1),
            np.concatenate([one.high for one in parts], axis=1),
        )

    def _held(
        self, lower: Array, upper: Array, forced: Sequence[tuple[int, Array]] = ()
    ) -> Interval:
        """All nodes, in order."""
        low, high = np.empty((2, len(self._order), len(lower)))
        low[: self._leaves] = high[: self._leaves] = self._constants[:, None]
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
        """What is not defined on all of a cell (N,), in words; blank if all is."""
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
