"""Information that comes from the points of linearisation alone, not from the data."""

from __future__ import annotations

import numpy as np

from ..terms.information import prior_units
from .bank import Array, FilterBank, Filtered

# Points along the run at which the model is examined, at most.
_POINTS = 40
# Below this share of the largest eigenvalue, an exact model has 0, up to rounding. What the whole
# record says there must also be that much less than the prior.
_ZERO, _NOTHING = 1e-10, 0.01
# So many steps for each state show all that the data can show.
_STEPS = 4
# A covariance with this condition number has no inverse of any accuracy, and nothing is compared.
_SINGULAR = 1e13


def apparent_information(
    bank: FilterBank, filtered: Filtered, inputs: Array, noise: Array, prior: Array
) -> tuple[float, Array] | None:
    r"""By which factor the filter's information grows where the data give none, and where.

    Along a trajectory of the model itself, :math:`x(t+1) = f(x(t), u(t))`, what no output shows is
    the null space of :math:`\sum_k \Phi_k^\top C_k^\top R^{-1} C_k \Phi_k`. A filter linearises at
    a new point after each measurement, so that its null spaces do not fit together and the sum
    over the record sees all directions. Let the columns of B(t) be a basis of a null space that
    lasts through the whole record. No measurement informs about these directions, so the
    information :math:`B^\top P^{-1} B` of a right filter is at most the prior's information after
    the model has propagated it from the first sample to t. The factor is the largest ratio of the
    two, over all directions of the null space, at the last sample.

    Returns
    -------
    (float, (n,) array) or None
        The factor and the direction in the prior's deviations; None where the data show all.
    """
    units, inverse_units = prior_units(prior)
    total, n = filtered.states.shape
    length = min(total, _STEPS * n)
    starts = np.unique(np.linspace(0, total - length, _POINTS).astype(int))
    f, _, f_jacobian, h_jacobian = bank.functions()
    deviations = np.sqrt(noise.diagonal())[:, None]
    there = np.isfinite(filtered.innovations)
    x = filtered.corrected[starts]
    moved, seen = np.tile(units, (len(starts), 1, 1)), np.zeros((len(starts), n, n))
    for k in range(length):
        u = inputs[starts + k]
        shown = there[starts + k, :, None] * (h_jacobian(x, u) / deviations @ moved)
        seen += shown.swapaxes(1, 2) @ shown
        moved, x = f_jacobian(x, u) @ moved, f(x, u)
    if not np.isfinite(seen).all():
        return None
    values, vectors = np.linalg.eigh(seen)
    blind = (values < _ZERO * values[:, -1:]) & (values * total < _NOTHING * length)
    width = int(blind.sum(axis=1).min())
    if width == 0:
        return None
    bases = vectors[:, :, :width]
    # A root of the covariance that belongs to the prior's information, moved by the model.
    root = np.eye(width)
    for k in range(1, len(starts)):
        through = units @ bases[k - 1]
        for a in filtered.transitions[starts[k - 1] : starts[k]]:
            through = a @ through
        root = bases[k].T @ inverse_units @ through @ root
    scaled = inverse_units @ filtered.covariances[starts[-1]] @ inverse_units.T
    if not (np.isfinite(scaled).all() and np.linalg.cond(scaled) < _SINGULAR):
        return None
    claimed = bases[-1].T @ np.linalg.solve(scaled, bases[-1])
    growth, directions = np.linalg.eigh(root.T @ claimed @ root)
    return float(growth[-1]), bases[-1] @ root @ directions[:, -1]
