"""What is tuned: numbers without unit that stand for covariances and other settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import finite, shown

from .._checks import Array, choice, numbers, positive_definite, positive_semidefinite
from .._linalg import cholesky
from ..errors import InvalidInputError, OptionError

KINDS = ("prior", "disturbance", "noise")
_STRUCTURES = ("diagonal", "full", "scalar")
# A standard deviation may change by this factor either way, and a model's parameter from a
# twentieth of its start to twenty times as much.
_RANGE = 1e4
_SHARE = 20.0


@dataclass(frozen=True)
class Setting:
    """The covariances and other values at which an estimator is judged."""

    prior: Array
    disturbance: Array
    noise: Array
    discount: float = 1.0
    threshold: float | None = None
    parameters: dict[str, float] = field(default_factory=dict)


class Factors:
    """Factors of the standard deviations of a covariance, one for each group of components.

    The covariance is D S D with S the one to start from, and D the diagonal of exp(E theta), where
    E says which component belongs to which group.
    """

    def __init__(self, kind: str, start: Array, groups: Mapping[str, Sequence[int]]) -> None:
        self._start, self._deviations = start, np.sqrt(start.diagonal())
        self._groups = np.zeros((len(start), len(groups)))
        for k, members in enumerate(groups.values()):
            self._groups[list(members), k] = 1.0
        self.names = [f"{kind} {name}" for name in groups]
        self._first = [next(iter(members)) for members in groups.values()]
        self.size = len(groups)
        self.start: Array = np.zeros(self.size)
        self.limits = [(-np.log(_RANGE), np.log(_RANGE))] * self.size

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
        return np.asarray(self._deviations[self._first] * np.exp(theta))


class CholeskyFactor:
    """The factor L of a covariance L L': D M with D positive, M unit lower triangular."""

    def __init__(self, kind: str, start: Array, labels: Sequence[str]) -> None:
        self._factor = cholesky(start)
        self._pivots = self._factor.diagonal().copy()
        d = len(start)
        self._below = np.tril_indices(d, -1)
        self.names = [f"{kind} {one}" for one in labels] + [
            f"{kind} {labels[i]} with {labels[j]}" for i in range(d) for j in range(i)
        ]
        self.size = len(self.names)
        self.start = np.concatenate(
            (np.zeros(d), (self._factor / self._pivots[:, None])[self._below])
        )
        self.limits = [(-np.log(_RANGE), np.log(_RANGE))] * d + [(-_SHARE, _SHARE)] * (
            self.size - d
        )

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
        by_factor = (slope + slope.T) @ (pivots[:, None] * unit)
        by_unit = pivots[:, None] * by_factor
        return np.concatenate(((by_unit * unit).sum(axis=1), by_unit[self._below]))

    def values(self, theta: Array) -> Array:
        """The diagonal of L, and the entries of M below the diagonal."""
        d = len(self._pivots)
        return np.concatenate((self._pivots * np.exp(theta[:d]), theta[d:]))


class Structure:
    """All that is tuned, as one vector theta, with names.

    Attributes
    ----------
    names : list of str
        Of the components of theta.
    start : (d,) array
        Where the search begins.
    covariances : int
        How many of them, the first ones, are of covariances; then come the model's parameters,
        the discount and the threshold.
    """

    def __init__(
        self, start: Setting, structure: Any, labels: Mapping[str, Sequence[str]]
    ) -> None:
        self._start = start
        self._parts: dict[str, Factors | CholeskyFactor] = {}
        chosen = _chosen(structure)
        for kind in KINDS:
            if kind in chosen:
                self._parts[kind] = _part(kind, getattr(start, kind), chosen[kind], labels[kind])
        self.names = [name for part in self._parts.values() for name in part.names]
        self.start = np.concatenate([part.start for part in self._parts.values()] or [np.zeros(0)])
        self.limits = [limit for part in self._parts.values() for limit in part.limits]
        self.covariances = len(self.names)
        self.parameters = list(start.parameters)
        self.names += self.parameters
        self.limits += [(1.0 / _SHARE - 1.0, _SHARE - 1.0)] * len(self.parameters)
        self._others = [name for name in ("discount", "threshold") if chosen.get(name)]
        if "threshold" in self._others and start.threshold is None:
            raise OptionError(
                "structure tunes the threshold, and there is none; give threshold=3.0, in standard "
                "deviations of the noise, to start from."
            )
        self.names += self._others
        # exp(theta) times the share that is forgotten at each step, 1 - discount.
        self._forgotten = max(1.0 - start.discount, 1e-3)
        limits = {"discount": (-np.log(100.0), np.log(0.5 / self._forgotten)),
                  "threshold": (-np.log(20.0), np.log(20.0))}
        self.limits += [limits[name] for name in self._others]
        extra = len(self.parameters) + len(self._others)
        self.start = np.concatenate((self.start, np.zeros(extra)))
        #: How many components the observer's likelihood depends on: all but the others.
        self.seen = self.covariances + len(self.parameters)
        if not self.names:
            raise OptionError("structure names nothing to tune; expected 'diagonal', for example.")

    def setting(self, theta: Array) -> Setting:
        """Covariances and other values at theta."""
        found: dict[str, Any] = {kind: getattr(self._start, kind) for kind in KINDS}
        for kind, part, place in self._places():
            found[kind] = part.covariance(theta[place])
        last = dict(zip(self.names[self.seen :], theta[self.seen :].tolist(), strict=True))
        discount, threshold = self._start.discount, self._start.threshold
        if "discount" in last:
            discount = 1.0 - self._forgotten * float(np.exp(last["discount"]))
        if "threshold" in last and threshold is not None:
            threshold *= float(np.exp(last["threshold"]))
        moved = theta[self.covariances : self.seen].tolist()
        starts = self._start.parameters
        parameters = {
            name: starts[name] + abs(starts[name]) * by
            for name, by in zip(self.parameters, moved, strict=True)
        }
        return Setting(**found, discount=discount, threshold=threshold, parameters=parameters)

    def adjoint(self, theta: Array, slopes: Mapping[str, Array], parameters: Array) -> Array:
        """The derivative by theta, from those by the covariances and by the model's parameters."""
        found = np.zeros(len(theta))
        for kind, part, place in self._places():
            found[place] = part.adjoint(theta[place], slopes[kind])
        sizes = np.abs([self._start.parameters[name] for name in self.parameters])
        found[self.covariances : self.seen] = parameters * sizes
        return found

    def values(self, theta: Array) -> dict[str, float]:
        """What each component stands for, in its own unit: a standard deviation, for example."""
        numbers_of = [part.values(theta[place]) for _, part, place in self._places()]
        setting = self.setting(theta)
        others = {"discount": setting.discount, "threshold": setting.threshold}
        flat = np.concatenate(numbers_of).tolist() if numbers_of else []
        flat += [setting.parameters[name] for name in self.parameters]
        flat += [others[name] for name in self._others]
        return dict(zip(self.names, flat, strict=True))

    def is_log(self, k: int) -> bool:
        """Whether component k is a logarithm of what it stands for."""
        return self.limits[k][1] >= np.log(_RANGE) and k < self.covariances

    def _places(self) -> list[tuple[str, Factors | CholeskyFactor, slice]]:
        found, at = [], 0
        for kind, part in self._parts.items():
            found.append((kind, part, slice(at, at + part.size)))
            at += part.size
        return found


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
    discount: float, threshold: float | None, parameters: Mapping[str, float] | None,
) -> Setting:
    """The covariances and other values to start from, checked."""
    first, _ = positive_semidefinite("prior covariance", prior, sizes["prior"])
    second, _ = positive_semidefinite("disturbance covariance", disturbance, sizes["disturbance"])
    third = positive_definite("noise covariance", noise, sizes["noise"])
    given = {}
    for name, value in (parameters or {}).items():
        start = float(numbers(f"parameters[{name!r}]", value))
        if start == 0.0:
            raise InvalidInputError(
                f"parameters[{name!r}] starts at 0, which has no size; start at a typical value."
            )
        given[str(name)] = start
    known = finite(threshold)
    if threshold is not None and (known is None or known <= 0.0):
        raise OptionError(
            f"threshold is {shown(threshold)}; expected a number > 0, in standard deviations of "
            "the noise, or None for a quadratic loss."
        )
    share = finite(discount)
    if share is None or not 0.5 < share <= 1.0:
        raise OptionError(f"discount is {shown(discount)}; expected a number above 0.5, at most 1.")
    return Setting(first, second, third, share, known, given)
