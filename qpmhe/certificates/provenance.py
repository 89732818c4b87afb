"""What a result was certified for, so that it is not taken for anything else."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..system import System
from .containment import beyond
from .errors import MismatchError
from .evaluation import evaluated
from .evidence import Evidence, weakest
from .regions import Region

if TYPE_CHECKING:
    from .properties import Detectability, ObserverStability

__all__ = ["Fingerprint", "Subject", "fitting", "founded", "sealed"]

Array = NDArray[np.float64]
Result = TypeVar("Result", "Detectability", "ObserverStability")

_POINTS, _SEED = 24, 20210829
_MOST_CORNERS = 8
# Another compiler or library may round otherwise; derivatives by differences are worse.
_VALUES, _SLOPES = 1e-9, 1e-5


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """What a system does at some points of a region.

    Parameters
    ----------
    sizes : (int, int, int)
        n, p and m.
    points : (K, n + m) array
        States and inputs.
    values, jacobians : (K, n + p) and (K, n + p, n) array
        f and h, and their Jacobians there.
    """

    sizes: tuple[int, int, int]
    points: Array
    values: Array
    jacobians: Array

    @classmethod
    def of(cls, system: System, region: Region) -> Fingerprint:
        """That of a system on a region.

        Parameters
        ----------
        system, region
            Which, and where.

        Raises
        ------
        ModelError
            If a function raises there.
        """
        drawn = region.sample(_POINTS, np.random.default_rng(_SEED))
        points = np.vstack((drawn[: 1 + _MOST_CORNERS], drawn[1 + _MOST_CORNERS :][-_POINTS:]))
        return cls((system.n, system.p, system.m), points, *_behaviour(system, points))

    def difference(self, system: System) -> str:
        """What a system does otherwise, in words; empty if nothing.

        Parameters
        ----------
        system : System
            The system.
        """
        sizes = system.n, system.p, system.m
        if sizes != self.sizes:
            return f"(n, p, m) is {sizes} instead of {self.sizes}"
        try:
            values, jacobians = _behaviour(system, self.points)
        except Exception as error:  # a user's function may raise anything
            return f"it fails where the other one does not ({type(error).__name__}: {error})"
        for name, mine, theirs, share in (
            ("f, h", self.values, values, _VALUES),
            ("the Jacobian of f, h", self.jacobians, jacobians, _SLOPES),
        ):
            rows = mine.reshape(len(mine), -1), theirs.reshape(len(theirs), -1)
            room = share * (1.0 + np.maximum(np.abs(rows[0]), np.abs(rows[1])))
            same = (np.abs(rows[0] - rows[1]) <= room) | (np.isnan(rows[0]) & np.isnan(rows[1]))
            if not same.all():
                k = int(np.argmin(same.all(axis=1)))
                return (
                    f"{name} at {np.round(self.points[k], 6).tolist()} is {theirs[k].tolist()} "
                    f"instead of {mine[k].tolist()}"
                )
        return ""


def _behaviour(system: System, points: Array) -> tuple[Array, Array]:
    x, u = points[:, : system.n], points[:, system.n :]
    values = [evaluated(name, one, x, u) for name, one in (("f", system.f), ("h", system.h))]
    slopes = [
        evaluated(f"the Jacobian of {name}", one, x, u)
        for name, one in (("f", system.f_jacobian), ("h", system.h_jacobian))
    ]
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


@dataclass(frozen=True, eq=False)
class Subject:
    """What a result is about.

    Parameters
    ----------
    fingerprint : Fingerprint
        What the system does.
    digest : str
        Of the numbers that were certified.
    evidence : Evidence
        What they rested on.
    system : System or None
        The system itself; None once it was copied or pickled.
    """

    fingerprint: Fingerprint
    digest: str
    evidence: Evidence
    system: System | None

    def __getstate__(self) -> dict[str, Any]:
        """Without the system, whose functions often cannot be pickled."""
        return vars(self) | {"system": None}


def sealed(result: Result, system: System, evidence: Evidence) -> Result:
    """A result with what it is about, and with its evidence.

    Parameters
    ----------
    result : Detectability or ObserverStability
        What was certified.
    system : System
        Of which system.
    evidence : Evidence
        What it rests on.
    """
    assert result.region is not None
    fingerprint = Fingerprint.of(system, result.region)
    subject = Subject(fingerprint, _digest(result), evidence, system)
    return replace(result, subject=subject, evidence=evidence)


def founded(result: Detectability | ObserverStability) -> Evidence:
    """The evidence that a result may claim: numbers stated by hand are assumed.

    Parameters
    ----------
    result : Detectability or ObserverStability
        The result.
    """
    subject = result.subject
    if subject is None or subject.digest != _digest(result):
        return Evidence.ASSUMED
    return weakest((result.evidence, subject.evidence))


def _digest(result: Detectability | ObserverStability) -> str:
    found = hashlib.sha256()
    for each in fields(result):
        if each.name in ("subject", "evidence", "notes"):
            continue
        value = getattr(result, each.name)
        if isinstance(value, Region):
            states = value.states
            parts: tuple[Any, ...] = (
                value.lower, value.upper, states.matrix, states.row_lower, states.row_upper
            )
        else:
            parts = (value,)
        for part in parts:
            told = repr(part.tolist()) if isinstance(part, np.ndarray) else repr(part)
            found.update(f"{each.name}={told};".encode())
    return found.hexdigest()


def fitting(
    part: Result, system: System, region: Region, gain: Array | None, *, thorough: bool = True
) -> Result:
    """A part of a certificate, if it is about this system, region and gain.

    Parameters
    ----------
    part : Detectability or ObserverStability
        The part.
    system, region
        What the certificate is of.
    gain : (n, p) array or None
        The observer's constant gain, if it has one.
    thorough : bool
        Whether to look at what the system does, even if it is the same object.

    Returns
    -------
    Detectability or ObserverStability
        The same; for another system that only behaves alike at the points compared, with
        no more than sampled evidence.

    Raises
    ------
    MismatchError
        If it is about something else.
    """
    what = "detectability" if hasattr(part, "eta") else "stability"
    if part.region is not None:
        told = beyond(region, part.region)
        if told:
            raise MismatchError(
                f"the {what} that was passed does not hold on the whole region: {told}. Certify it "
                "on this region, with these inputs, or pass a region within its own."
            )
    own = getattr(part, "gain", None)
    if own is not None and (gain is None or not np.array_equal(own, gain)):
        theirs = "not constant" if gain is None else str(gain.tolist())
        raise MismatchError(
            f"the {what} that was passed is of the gain {own.tolist()}; that of the observer is "
            f"{theirs}. Certify this observer."
        )
    if part.subject is None or (part.subject.system is system and not thorough):
        return part
    told = part.subject.fingerprint.difference(system)
    if told:
        raise MismatchError(
            f"the {what} that was passed is of another system: {told}. Certify this system."
        )
    if part.subject.system is system:
        return part
    note = (
        "certified of another System object; this one does the same at "
        f"{len(part.subject.fingerprint.points)} states"
    )
    return replace(
        part, evidence=weakest((part.evidence, Evidence.SAMPLED)), notes=(*part.notes, note)
    )
