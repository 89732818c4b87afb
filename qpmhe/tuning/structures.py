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
# Of a partial correlation: 1 - r is 1.2e-5.
_PARTIAL = 6.0


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
        self.limits, self.correlations = [(-_RANGE, _RANGE)] * len(groups), 0

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


class Correlated:
    r"""Standard deviations and correlations of a covariance D C D, positive definite.

    theta holds the logarithms of D by its start, and arctanh of the partial correlations r_ij of
    components i > j given those before j. C = N N^T with N lower triangular:
    :math:`N_{ij} = r_{ij} \prod_{k<j} (1 - r_{ik}^2)^{1/2}` with :math:`r_{ii} = 1`. So C is a
    correlation matrix at any theta.

    References
    ----------
    Lewandowski, Kurowicka and Joe, Generating random correlation matrices based on vines and
    extended onion method, Journal of Multivariate Analysis 100 (2009).
    """

    def __init__(self, kind: str, start: Array, labels: Sequence[str]) -> None:
        self._deviations, d = np.sqrt(start.diagonal()), len(start)
        self._below = np.tril_indices(d, -1)
        root = cholesky(start / np.outer(self._deviations, self._deviations))
        # What is left of each row of N behind an entry.
        left = np.sqrt(np.cumsum(root[:, ::-1] ** 2, axis=1)[:, ::-1])
        rows, columns = self._below
        partial = np.arcsinh(root[self._below] / left[rows, columns + 1])
        self.names = [f"{kind} {one}" for one in labels] + [
            f"correlation of {kind} {labels[j]} and {labels[i]}"
            for i in range(d) for j in range(i)
        ]
        self.start = np.concatenate((np.zeros(d), partial))
        ends = np.maximum(_PARTIAL, np.abs(partial)).tolist()
        self.limits = [(-_RANGE, _RANGE)] * d + [(-end, end) for end in ends]
        self.correlations = partial.size

    def _parts(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """The standard deviations, r, the products, and N."""
        d = len(self._deviations)
        partial, roots, products = np.eye(d), np.ones((d, d)), np.ones((d, d))
        partial[self._below] = np.tanh(theta[d:])
        roots[self._below] = 1.0 / np.cosh(theta[d:])
        products[:, 1:] = np.cumprod(roots[:, :-1], axis=1)
        return self._deviations * np.exp(theta[:d]), partial, products, partial * products

    def covariance(self, theta: Array) -> Array:
        """The covariance (d, d)."""
        deviations, _, _, root = self._parts(theta)
        scaled = deviations[:, None] * root
        return np.asarray(scaled @ scaled.T)

    def adjoint(self, theta: Array, slope: Array) -> Array:
        """The derivative by theta, from the derivative by the covariance's entries."""
        deviations, partial, products, root = self._parts(theta)
        both = deviations[:, None] * (slope + slope.T) * deviations
        moved = (both * (root @ root.T)).sum(axis=1)
        by_root = both @ root
        # An entry of N before which r_ij stands has the factor (1 - r_ij^2)^1/2.
        behind = np.cumsum((by_root * root)[:, ::-1], axis=1)[:, ::-1] - by_root * root
        by_partial = (1.0 - partial**2) * by_root * products - partial * behind
        return np.concatenate((moved, by_partial[self._below]))

    def values(self, theta: Array) -> Array:
        """The standard deviations, and the correlations below the diagonal."""
        deviations, _, _, root = self._parts(theta)
        return np.concatenate((deviations, (root @ root.T)[self._below]))


class Structure:
    """All that is tuned, as one vector theta: parts of covariances, parameters, and others.

    `start` is theta of `first`, the weights before. The likelihood depends on the first `seen`
    components, of which the first `covariances` are covariances; discount and threshold come last.
    """

    def __init__(
        self, first: Weights, structure: Any, labels: Mapping[str, Sequence[str]]
    ) -> None:
        self.first, chosen = first, _chosen(structure)
        parts: dict[str, Factors | Correlated] = {
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
        #: Components that stand for a correlation, which depends on others of theta too.
        self.correlations = {
            k for _, part, place in self._parts
            for k in range(place.stop - part.correlations, place.stop)
        }
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
        return k < self.covariances and k not in self.correlations

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
) -> Factors | Correlated:
    """The parameters of one covariance."""
    varied = np.flatnonzero(start.diagonal() > 0.0).tolist()
    if structure == "diagonal":
        return Factors(kind, start, {labels[i]: [i] for i in varied})
    if structure == "scalar":
        return Factors(kind, start, {"level": varied})
    if structure == "full":
        positive_definite(f"{kind} covariance to start from", start)
        return Correlated(kind, start, labels)
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
