"""Lipschitz constants of the output function on a region (ass:lipschitz)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..system import System
from .enclosures import SmoothModel
from .evidence import Evidence
from .regions import Region
from .verification import Matrices, norm_bound

__all__ = ["LipschitzConstant", "output_lipschitz"]

Array = NDArray[np.float64]

_CHUNK = 256
_MOST_CELLS = 20_000
_TOLERANCE = 1e-3
_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class LipschitzConstant:
    """L_h, with what it rests on.

    Parameters
    ----------
    value : float
        The constant, in units of the output per unit of the state.
    evidence : Evidence
        PROVED for an upper bound, SAMPLED for the largest value seen.
    attained : float
        The largest norm of the Jacobian that was seen, a lower bound.
    at : (n + m,) array
        Where.
    note : str
        How the bound was found.
    """

    value: float
    evidence: Evidence
    attained: float
    at: Array
    note: str


def output_lipschitz(
    system: System, region: Region, model: SmoothModel | None = None
) -> LipschitzConstant:
    r"""The smallest :math:`L_h` with :math:`|h(x_1) - h(x_2)| \le L_h |x_1 - x_2|`.

    On a convex set it is the supremum of the Jacobian's spectral norm. For an affine h this
    is one number; otherwise cells are divided until the bound exceeds the largest norm seen
    by a thousandth at most.

    Parameters
    ----------
    system : System
        The system.
    region : Region
        Where.
    model : SmoothModel, optional
        The system's functions, if they were made before.
    """
    model = model or SmoothModel(system, region)
    points = region.sample(_SAMPLES, np.random.default_rng(20210829))
    x, u = points[:, : system.n], points[:, system.n :]
    norms = np.linalg.norm(system.h_jacobian.batch(x, u), 2, axis=(-2, -1))
    worst = int(norms.argmax())
    attained, at = float(norms[worst]), points[worst]
    if model.reason:
        return LipschitzConstant(
            attained, Evidence.SAMPLED, attained, at,
            f"largest of {norms.size} gradients; h cannot be run with intervals ({model.reason})",
        )
    goal = attained * (1.0 + _TOLERANCE)
    lower, upper = region.lower[None], region.upper[None]
    bound, cells = 0.0, 0
    while lower.shape[0]:
        low, high = lower[-_CHUNK:], upper[-_CHUNK:]
        lower, upper = lower[:-_CHUNK], upper[:-_CHUNK]
        cells += low.shape[0]
        enclosure = model.enclose(low, high)
        corners, error = enclosure.corners()
        count = corners.shape[1]
        C = corners[:, :, system.n :].reshape(-1, system.p, system.n)
        spread = np.repeat(error[:, system.n :], count, axis=0)
        bounds = norm_bound(Matrices(C, spread)).reshape(-1, count).max(axis=1)
        open_ = bounds > goal
        if cells > _MOST_CELLS and np.isfinite(bounds).all():
            open_[:] = False
        elif cells > 2 * _MOST_CELLS:
            return LipschitzConstant(
                attained, Evidence.SAMPLED, attained, at,
                f"largest of {norms.size} gradients; no bound was found with {cells} cells",
            )
        bound = max(bound, float(bounds[~open_].max(initial=0.0)))
        if not open_.any():
            continue
        low, high = low[open_], high[open_]
        width = np.where(region.upper > region.lower, region.upper - region.lower, np.inf)
        slopes = np.abs(enclosure.slopes[open_][:, :, system.n :]).sum(axis=(2, 3))
        known = np.isfinite(slopes).all(axis=1) & (slopes.max(axis=1) > 0.0)
        which = np.where(known[:, None], slopes, (high - low) / width).argmax(axis=1)
        rows = np.arange(low.shape[0])
        middle = 0.5 * (low[rows, which] + high[rows, which])
        first, second = high.copy(), low.copy()
        first[rows, which] = second[rows, which] = middle
        halves = np.vstack((low, second)), np.vstack((first, high))
        stay = ~region.outside(*halves)
        lower, upper = np.vstack((lower, halves[0][stay])), np.vstack((upper, halves[1][stay]))
    how = "h is affine" if model.affine_output else f"bounded on {cells} cells"
    return LipschitzConstant(bound, Evidence.PROVED, attained, at, how)
