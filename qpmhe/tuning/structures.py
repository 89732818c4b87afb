"""What is tuned: numbers without unit that stand for covariances and other settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import finite, shown

from .._checks import Array, choice, numbers, positive_definite, positive_semidefinite
from .._linalg import cholesky
from ..errors import InvalidInputError, OptionError
from .weights import KINDS, Weights

_STRUCTURES = ("diagonal", "full", "scalar")
# A standard deviation may change by this factor either way, and a model's parameter from a
# twentieth of its start to twenty times as much.
_RANGE, _SHARE = float(np.log(1e4)), 20.0


class Factors:
    """Factors of the standard deviations of a covariance, one for each group of components.

    The covariance is D S D with S the one to start from, and D the diagonal of exp(E theta), where
    E assigns components to groups.
    """

    def __init__(self, kind: str, start: Array, groups: Mapping[str, Sequence[int]]) -> None:
        self._start, self._groups = start, np.zeros((len(start), len(groups)))
        for k, members in enumerate(groups.values()):
            self._groups[list(members), k] = 1.0
        first = [next(iter(members)) for members in groups.values()]
        self._deviations = np.sqrt(start.diagonal())[first]
        self.names = [f"{kind} {name}" for name in groups]
        self.start: Array = np.zeros(len(groups))
        self.limits = [(-_RANGE, _RANGE)] * len(groups)

    def covariance(self, theta: Array) -> Array:
        """The covariance (d, d)."""
        scale = np.exp(self._groups @ theta)
        return np.asarray(self._start * np.outer(scale, scale))

    def adjoint(self, theta: Array, slope: Array) -> Array:
        """The derivative by theta, from the derivative by the covariance's entries."""
        moved = self.covariance(theta) * (slope + slope.T)
        return np.asarray(self._groups.T @ moved.sum(axis=1))

    def values(self, theta: Array) -> Array:
        """The standard deviation of each group's first component."""
        return np.asarray(self._deviations * np.exp(theta))


class CholeskyFactor:
    """The factor L of a covariance L L': D M with D positive, M unit lower triangular."""

    def __init__(self, kind: str, start: Array, labels: Sequence[str]) -> None:
        factor, d = cholesky(start), len(start)
        self._pivots, self._below = factor.diagonal().copy(), np.tril_indices(d, -1)
        below = (factor / self._pivots[:, None])[self._below]
        self.names = [f"{kind} {one}" for one in labels] + [
            f"{kind} {labels[i]} with {labels[j]}" for i in range(d) for j in range(i)
        ]
        self.start = np.concatenate((np.zeros(d), below))
        self.limits = [(-_RANGE, _RANGE)] * d + [(-_SHARE, _SHARE)] * below.size

    def _parts(self, theta: Array) -> tuple[Array, Array]:
        d = len(self._pivots)
        unit = np.eye(d)
        unit[self._below] = theta[d:]
        return self._pivots * np.exp(theta[:d]), unit

    def covariance(self, theta: Array) -> Array:
        """The covariance (d, d)."""
        pivots, unit = self._parts(theta)
        factor = pivots[:, None] * unit
        return np.asarray(factor @ factor.T)

    def adjoint(self, theta: Array, slope: Array) -> Array:
        """The derivative by theta, from the derivative by the covariance's entries."""
        pivots, unit = self._parts(theta)
        by_unit = pivots[:, None] * ((slope + slope.T) @ (pivots[:, None] * unit))
        return np.concatenate(((by_unit * unit).sum(axis=1), by_unit[self._below]))

    def values(self, theta: Array) -> Array:
        """The diagonal of L, and the entries of M below the diagonal."""
        pivots, unit = self._parts(theta)
        return np.concatenate((pivots, unit[self._below]))


class Structure:
    """All that is tuned, as one vector theta: parts of covariances, parameters, and others.

    `start` is theta of `first`, the weights before. The likelihood depends on the first `seen`
    components, of which the first `covariances` are covariances; discount and threshold come last.
    """

    def __init__(
        self, first: Weights, structure: Any, labels: Mapping[str, Sequence[str]]
    ) -> None:
        self.first, chosen = first, _chosen(structure)
        parts: dict[str, Factors | CholeskyFactor] = {
            kind: _part(kind, getattr(first, kind), chosen[kind], labels[kind])
            for kind in KINDS if kind in chosen
        }
        self.parameters = list(first.parameters)
        self._others = [name for name in ("discount", "threshold") if chosen.get(name)]
        if "threshold" in self._others and first.threshold is None:
            raise OptionError(
                "structure tunes the threshold, and there is none; give threshold=3.0, in standard "
                "deviations of the noise, to start from."
            )
        covariances = [name for part in parts.values() for name in part.names]
        self.names = [*covariances, *self.parameters, *self._others]
        if not self.names:
            raise OptionError("structure names nothing to tune; expected 'diagonal', for example.")
        self.covariances = len(covariances)
        self.seen = self.covariances + len(self.parameters)
        ends = np.cumsum([len(part.names) for part in parts.values()]).tolist()
        self._parts = [
            (kind, part, slice(end - len(part.names), end))
            for (kind, part), end in zip(parts.items(), ends, strict=True)
        ]
        # exp(theta) times the share that is forgotten at each step, 1 - discount.
        self._forgotten = max(1.0 - first.discount, 1e-3)
        limits = {"discount": (-np.log(100.0), np.log(0.5 / self._forgotten)),
                  "threshold": (-np.log(20.0), np.log(20.0))}
        self.limits = [limit for part in parts.values() for limit in part.limits]
        self.limits += [(1.0 / _SHARE - 1.0, _SHARE - 1.0)] * len(self.parameters)
        self.limits += [limits[name] for name in self._others]
        self.start = np.zeros(len(self.names))
        for _, part, place in self._parts:
            self.start[place] = part.start

    def weights(self, theta: Array) -> Weights:
        """The weights at theta."""
        first = self.first
        found: dict[str, Any] = {
            kind: part.covariance(theta[place]) for kind, part, place in self._parts
        }
        for name, at in zip(self._others, theta[self.seen :].tolist(), strict=True):
            change = float(np.exp(at))
            found[name] = (
                1.0 - self._forgotten * change if name == "discount"
                else (first.threshold or 1.0) * change
            )
        moved = theta[self.covariances : self.seen].tolist()
        found["parameters"] = {
            name: first.parameters[name] + abs(first.parameters[name]) * by
            for name, by in zip(self.parameters, moved, strict=True)
        }
        return replace(first, **found)

    def adjoint(self, theta: Array, slopes: Mapping[str, Array], parameters: Array) -> Array:
        """The derivative by theta, from those by the covariances and by the model's parameters."""
        found = np.zeros(len(theta))
        for kind, part, place in self._parts:
            found[place] = part.adjoint(theta[place], slopes[kind])
        sizes = np.abs([self.first.parameters[name] for name in self.parameters])
        found[self.covariances : self.seen] = parameters * sizes
        return found

    def values(self, theta: Array) -> dict[str, float]:
        """What each component stands for, in its own unit: a standard deviation, for example."""
        weights = self.weights(theta)
        flat = [each for _, part, place in self._parts for each in part.values(theta[place])]
        flat += [weights.parameters[name] for name in self.parameters]
        flat += [getattr(weights, name) for name in self._others]
        return dict(zip(self.names, map(float, flat), strict=True))

    def is_log(self, k: int) -> bool:
        """Whether component k is a logarithm of what it stands for."""
        return k < self.covariances and self.limits[k][1] >= _RANGE

    def bounded(self, theta: Array) -> Array:
        """Theta within the limits."""
        low, high = np.array(self.limits).T
        return np.asarray(np.clip(theta, low, high))


def _chosen(structure: Any) -> dict[str, Any]:
    if isinstance(structure, str):
        return dict.fromkeys(("disturbance", "noise"), choice("structure", structure, _STRUCTURES))
    known = (*KINDS, "discount", "threshold")
    if not isinstance(structure, Mapping) or set(structure) - set(known):
        raise OptionError(
            f"structure is {shown(structure)}; expected one of {', '.join(_STRUCTURES)}, or a dict "
            f"with keys among {', '.join(known)}."
        )
    return {str(name): one for name, one in structure.items() if one is not None}


def _part(
    kind: str, start: Array, structure: Any, labels: Sequence[str]
) -> Factors | CholeskyFactor:
    """The parameters of one covariance."""
    varied = np.flatnonzero(start.diagonal() > 0.0).tolist()
    if structure == "diagonal":
        return Factors(kind, start, {labels[i]: [i] for i in varied})
    if structure == "scalar":
        return Factors(kind, start, {"level": varied})
    if structure == "full":
        positive_definite(f"{kind} covariance to start from", start)
        return CholeskyFactor(kind, start, labels)
    if not isinstance(structure, Mapping) or not structure:
        raise OptionError(
            f"structure of the {kind} is {shown(structure)}; expected one of "
            f"{', '.join(_STRUCTURES)}, or groups of components, such as {{'positions': [0, 1]}}."
        )
    groups: dict[str, list[int]] = {}
    seen: set[int] = set()
    for name, members in structure.items():
        found = np.atleast_1d(numbers(f"group {name!r} of the {kind}", members))
        index = found.astype(np.intp).tolist()
        if not index or set(index) - set(varied) or seen & set(index) or (found != index).any():
            raise OptionError(
                f"group {name!r} of the {kind} is {shown(members)}; expected some of the "
                f"components {varied}, which have a variance, each in one group only."
            )
        seen |= set(index)
        groups[str(name)] = index
    return Factors(kind, start, groups)


def checked_start(
    sizes: Mapping[str, int], prior: ArrayLike, disturbance: ArrayLike, noise: ArrayLike,
    discount: float, threshold: float | None, parameters: Mapping[str, float], **others: Any,
) -> Weights:
    """The weights to start from, checked."""
    first, _ = positive_semidefinite("prior covariance", prior, sizes["prior"])
    second, _ = positive_semidefinite("disturbance covariance", disturbance, sizes["disturbance"])
    third = positive_definite("noise covariance", noise, sizes["noise"])
    given = {
        str(name): float(numbers(f"parameters[{name!r}]", value))
        for name, value in parameters.items()
    }
    for name, value in given.items():
        if value == 0.0:
            raise InvalidInputError(
                f"parameters[{name!r}] starts at 0, which has no size; start at a typical value."
            )
    known, share = finite(threshold), finite(discount)
    if threshold is not None and (known is None or known <= 0.0):
        raise OptionError(
            f"threshold is {shown(threshold)}; expected a number > 0, in standard deviations of "
            "the noise, or None for a quadratic loss."
        )
    if share is None or not 0.5 < share <= 1.0:
        raise OptionError(f"discount is {shown(discount)}; expected a number above 0.5, at most 1.")
    return Weights(
        first, second, third, discount=share, threshold=known, parameters=given, **others
    )
