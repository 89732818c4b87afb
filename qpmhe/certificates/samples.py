"""Jacobians at some states of a region: what programs start from, and what samples can tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..system import System
from .enclosures import SmoothModel
from .evaluation import evaluated, insist_on_values
from .inequalities import Form
from .sdp import Scales
from .regions import Region
from .verification import Matrices, definite

__all__ = [
    "MOST_POINTS",
    "between_samples",
    "far_apart",
    "insist_on_derivatives",
    "joint_jacobians",
    "typical_scales",
]

Array = NDArray[np.float64]

_WRONG = 1e-3  # more than a derivative computed in some other way may be off
_WORK = 5e4  # entries of second derivatives that come with an enclosure of the first
MOST_POINTS = 24  # Jacobians that a program starts with


def joint_jacobians(system: System, points: Array) -> Array:
    """The joint Jacobians at some states.

    Parameters
    ----------
    system : System
        The system.
    points : (K, n + m) array
        States and inputs.

    Raises
    ------
    ModelError
        If one is not finite, or f or h is not, or raises.
    """
    insist_on_values(system, points)  # a step in the imaginary direction may not see NaN
    x, u = points[:, : system.n], points[:, system.n :]
    joint = np.concatenate(
        (
            evaluated("the Jacobian of f", system.f_jacobian, x, u),
            evaluated("the Jacobian of h", system.h_jacobian, x, u),
        ),
        axis=1,
    )
    broken = ~np.isfinite(joint).all(axis=(1, 2))
    if broken.any():
        raise ModelError(
            f"the Jacobians of f and h are not finite at {points[broken][0].tolist()}, within the "
            "region; expected functions with derivatives there. Take a smaller region."
        )
    return np.asarray(joint, np.float64)


def insist_on_derivatives(
    model: SmoothModel, system: System, points: Array, jacobians: Array
) -> None:
    """Insist that given Jacobians are the derivatives of f and h, where they lie far apart.

    Parameters
    ----------
    model : SmoothModel
        The functions, enclosed.
    system : System
        The system.
    points, jacobians : (K, n + m) and (K, n + p, n) array
        Where, and what its Jacobians are there.

    Raises
    ------
    ModelError
        If one is not; it names the state.
    """
    n = system.n
    if "given" not in system.derivatives.values():
        return
    few = int(np.clip(_WORK / (jacobians[0].size * points.shape[1]), 1, MOST_POINTS))
    chosen = far_apart(jacobians, few)
    points, jacobians = points[chosen], jacobians[chosen]
    enclosure = model.enclose(points, points)
    for name, rows in (("f", slice(None, n)), ("h", slice(n, None))):
        if system.derivatives[name] != "given":
            continue
        true, given = enclosure.centre[:, rows], jacobians[:, rows]
        size = np.abs(true).max(axis=(1, 2)) + np.abs(given).max(axis=(1, 2))
        apart = np.abs(given - true).max(axis=(1, 2)) - enclosure.error[:, rows].max(axis=(1, 2))
        wrong = apart > _WRONG * (size + 1.0)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ModelError(
                f"{name}_jacobian is {given[k].tolist()} at {points[k].tolist()}, but the "
                f"derivative of {name} there is {np.round(true[k], 9).tolist()}. Correct it, or "
                "leave it out."
            )


def far_apart(jacobians: Array, count: int = MOST_POINTS) -> NDArray[np.intp]:
    """Indices of Jacobians that lie far apart from each other.

    Parameters
    ----------
    jacobians : (K, n + p, n) array
        The Jacobians.
    count : int
        How many at most.
    """
    flat = jacobians.reshape(jacobians.shape[0], -1)
    size = np.ptp(flat, axis=0)
    flat = flat[:, size > 0.0] / size[size > 0.0]
    chosen = [0]
    if flat.shape[1]:
        away = np.linalg.norm(flat - flat[0], axis=1)
        while len(chosen) < count and away.max() > 1e-9:
            chosen.append(int(away.argmax()))
            away = np.minimum(away, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)


def typical_scales(region: Region, jacobians: Array, n: int) -> Scales:
    """Sizes of states and outputs on a region.

    Parameters
    ----------
    region : Region
        The region.
    jacobians : (K, n + p, n) array
        Joint Jacobians in it.
    n : int
        The number of states.
    """
    half = 0.5 * (region.upper - region.lower)[:n]
    states = np.where(half > 0.0, half, 1.0)
    states = np.maximum(states / states.max(), 1e-6)
    outputs = np.abs(jacobians[:, n:] * states).sum(axis=2).max(axis=0)
    return Scales(states, np.where(outputs > 0.0, outputs, 1.0))


def between_samples(form: Form, points: Array, jacobians: Array) -> str:
    """Whether the margin covers what the Jacobian is seen to do between the samples.

    Parameters
    ----------
    form : Form
        An inequality that holds at the samples.
    points, jacobians : (K, n + m) and (K, n + p, n) array
        The samples.
    """
    width = np.ptp(points, axis=0)
    width = np.where(width > 0.0, width, 1.0)
    spacing, steepest = 0.0, np.zeros(jacobians.shape[1:])
    for i in range(points.shape[0]):
        away = np.linalg.norm((points - points[i]) / width, axis=1)
        away[i] = np.inf
        near = int(away.argmin())
        spacing = max(spacing, float(away[near]))
        if away[near] > 0.0:
            steepest = np.maximum(steepest, np.abs(jacobians[near] - jacobians[i]) / away[near])
    radius = np.broadcast_to(steepest * spacing, jacobians.shape)
    covered = definite(form.matrices(Matrices(jacobians, radius)))[0].all()
    verdict = "covers" if covered else "does not cover"
    return (
        f"its margin {verdict} what lies between them, if the Jacobian's Lipschitz constant is "
        f"the largest one seen (entries then differ by up to {radius.max():.3g})"
    )

