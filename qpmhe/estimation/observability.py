"""How well each window's data determine its states: Gauss-Newton matrices along a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..terms.information import prior_units

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Observability:
    r"""Singular values of the windows' Gauss-Newton matrices, in deviations of the prior.

    With the disturbances eliminated, the measurements of a window add :math:`|x_0 - \hat
    x_0|_\Lambda^2` to the cost of its first state, and the prior :math:`|x_0 - \bar x|_P^2`. In
    deviations of the prior, :math:`x_0 = L \xi` with :math:`P^{-1} = L L^\top`, the prior's matrix
    is the identity and the data's is :math:`L^\top \Lambda L`. At a singular value of 1, data and
    prior inform equally; at 0, the data give no information.

    Attributes
    ----------
    matrices : (W, n, n) array
        :math:`\Lambda` of the windows that start at samples 0, ..., W - 1, in inverse squared
        units of the states.
    values : (W, n) array
        Singular values of :math:`L^\top \Lambda L`, the smallest first.
    directions : (W, n, n) array
        Their directions :math:`\xi`, as columns.
    """

    matrices: Array
    values: Array
    directions: Array


def observability(
    transitions: Array, information: Array, disturbance: Array, prior: Array, horizon: int
) -> Observability:
    """The `Observability` of all windows of a run, at once.

    Parameters
    ----------
    transitions, information : (T, n, n) array
        Along the run: Jacobians A of f, and C^T R C for the Jacobians C of h and the weights R of
        the noise, with zeros for what is missing.
    disturbance : (n, n) array
        Covariance of what the disturbance adds to the state at each sample.
    prior : (n, n) array
        Covariance of the initial error; the values are in its standard deviations.
    horizon : int
        N <= T.
    """
    matrices = _of_all_windows(transitions, information, disturbance, horizon)
    root, _ = prior_units(prior)
    values, directions = np.linalg.eigh(root.T @ matrices @ root)
    return Observability(matrices, np.maximum(values, 0.0), directions)


def _of_all_windows(
    transitions: Array, information: Array, disturbance: Array, horizon: int
) -> Array:
    r"""`window_information` of all windows of a record, (W, n, n).

    Two stretches of a window become one: with :math:`E` and :math:`G` what one makes of its first
    state and of its disturbances' covariance, and :math:`\Lambda` its information, those of both
    are :math:`E_2 D E_1`, :math:`G_2 + E_2 D G_1 E_2^\top` and :math:`\Lambda_1 + E_1^\top
    \Lambda_2 D E_1` with :math:`D = (I + G_1 \Lambda_2)^{-1}`. So the lengths double.

    References
    ----------
    Anderson, Second-order convergent algorithms for the steady-state Riccati equation,
    International Journal of Control 28 (1978).
    """
    windows, n = len(transitions) - horizon + 1, disturbance.shape[-1]
    one: tuple[Array, ...] = (
        transitions, np.broadcast_to(disturbance, transitions.shape), information)
    eye, whole, length, begin = np.eye(n), None, 1, 0
    while True:
        if horizon & length:  # of these lengths the window consists, the shortest first
            part = tuple(each[begin : begin + windows] for each in one)
            whole = part if whole is None else _joined(whole, part, eye)
            begin += length
        if 2 * length > horizon:
            break
        one = _joined(tuple(each[:-length] for each in one), tuple(each[length:] for each in one),
                      eye)
        length *= 2
    assert whole is not None
    return whole[2]


def _joined(first: tuple[Array, ...], second: tuple[Array, ...], eye: Array) -> tuple[Array, ...]:
    """E, G and the information of two stretches, one behind the other."""
    (e, g, seen), (e2, g2, seen2) = first, second
    n = len(eye)
    both = np.linalg.solve(eye + g @ seen2, np.concatenate((e, g), axis=2))
    later, spread = e2 @ both[:, :, :n], e2 @ both[:, :, n:] @ e2.swapaxes(1, 2) + g2
    found = seen + e.swapaxes(1, 2) @ seen2 @ both[:, :, :n]
    return later, 0.5 * (spread + spread.swapaxes(1, 2)), 0.5 * (found + found.swapaxes(1, 2))


def prior_shares(
    transitions: Array, information: Array, disturbance: Array, prior: Array, longest: int,
    most: int = 100,
) -> Array:
    r"""The prior's share in the newest estimate, for windows of each length.

    With G the derivative of the estimate with respect to the prior's mean, the share of state
    i is :math:`(G \Pi G^\top)_{ii} / \Sigma_{ii}`: what an error of the prior with the
    covariance :math:`\Pi` contributes to the variance of the estimate's error.

    Parameters
    ----------
    transitions, information, disturbance, prior
        As for `observability`; the prior's covariance is that of each window.
    longest : int
        The largest horizon.
    most : int
        Number of windows for the median, spread over the run.

    Returns
    -------
    (longest + 1, n) array
        Medians over the windows; row N is for the horizon N, and row 0 is 1.
    """
    total, n = transitions.shape[:2]
    starts = np.unique(np.linspace(0, total - longest, min(most, total - longest + 1)).astype(int))
    eye = np.eye(n)
    covariance, slope = np.tile(prior, (len(starts), 1, 1)), np.tile(eye, (len(starts), 1, 1))
    shares = np.ones((longest + 1, n))
    for k in range(longest):
        a, c = transitions[starts + k], information[starts + k]
        closed = a @ np.linalg.inv(eye + covariance @ c)
        covariance = closed @ covariance @ a.transpose(0, 2, 1) + disturbance
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        slope = closed @ slope
        from_prior = np.einsum("wij,jk,wik->wi", slope, prior, slope)
        whole = np.diagonal(covariance, axis1=1, axis2=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares[k + 1] = np.median(np.where(whole > 0.0, from_prior / whole, 0.0), axis=0)
    return shares
