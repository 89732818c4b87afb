"""Matrix inequalities, shown with all rounding accounted for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import CertificateError

__all__ = ["Matrices", "definite", "eigenvalue_bounds", "norm_bound", "rounded_up"]

Array = NDArray[np.float64]

_UNIT = float(np.finfo(np.float64).eps)  # twice the unit roundoff: a margin in every bound
_TINY = 1e-290  # covers what underflows


@dataclass(frozen=True, eq=False)
class Matrices:
    r"""Sets of matrices :math:`\{M : |M - \text{middle}| \le \text{radius}\}`, entrywise.

    Parameters
    ----------
    middle, radius : (..., r, c) array
        Of equal shape, or such that they broadcast.
    """

    middle: Array
    radius: Array

    @classmethod
    def exact(cls, matrix: Array) -> Matrices:
        """One matrix of floating point numbers.

        Parameters
        ----------
        matrix : (..., r, c) array
            The matrix.
        """
        return cls(matrix, np.zeros_like(matrix))

    @property
    def T(self) -> Matrices:  # noqa: N802 - as NumPy calls it
        """The transposes."""
        return Matrices(np.swapaxes(self.middle, -1, -2), np.swapaxes(self.radius, -1, -2))

    def __neg__(self) -> Matrices:
        return Matrices(-self.middle, self.radius)

    def __add__(self, other: Matrices) -> Matrices:
        middle = self.middle + other.middle
        return Matrices(
            middle, (self.radius + other.radius + _UNIT * np.abs(middle)) * (1.0 + 4.0 * _UNIT)
        )

    def __sub__(self, other: Matrices) -> Matrices:
        return self + (-other)

    def __matmul__(self, other: Matrices) -> Matrices:
        inner = self.middle.shape[-1]
        left, right = np.abs(self.middle), np.abs(other.middle)
        # |fl(AB) - AB| <= k u |A||B|/(1 - k u), in any order of summation (Higham, 3.5).
        radius = (
            self.radius @ (right + other.radius)
            + left @ (other.radius + (inner + 2) * _UNIT * right)
        )
        return Matrices(
            self.middle @ other.middle, radius * (1.0 + 4.0 * (inner + 4) * _UNIT) + _TINY
        )

    def times(self, factor: float) -> Matrices:
        """All of them times a floating point number.

        Parameters
        ----------
        factor : float
            The number.
        """
        middle = factor * self.middle
        return Matrices(
            middle,
            (abs(factor) * self.radius + _UNIT * np.abs(middle)) * (1.0 + 4.0 * _UNIT) + _TINY,
        )


def definite(matrices: Matrices) -> tuple[NDArray[np.bool_], Array]:
    r"""Whether every symmetric matrix of a set is positive definite.

    With S from an eigenvalue decomposition of the middle M, :math:`G = S^\top M S` is near
    the identity. G is enclosed with a bound on all rounding, and where Gershgorin's discs
    lie right of zero, G is positive definite for every member. Then so is M: S cannot be
    singular, or G would be, and congruence keeps the inertia.

    Parameters
    ----------
    matrices : Matrices
        Of shape (B, k, k).

    Returns
    -------
    proved : (B,) bool array
        Whether it was shown.
    least : (B,) array
        The smallest eigenvalue of the middle with its diagonal scaled to one, rounded;
        -inf where there is none.

    References
    ----------
    Rump, Verification of positive definiteness, BIT 46 (2006), for a neighbouring method.
    """
    middle = 0.5 * (matrices.middle + np.swapaxes(matrices.middle, -1, -2))
    diagonal = np.diagonal(middle, axis1=-2, axis2=-1)
    least = np.full(middle.shape[0], -np.inf)
    proved = np.zeros(middle.shape[0], dtype=np.bool_)
    usable = np.isfinite(middle).all(axis=(-2, -1)) & (diagonal > 0.0).all(axis=-1)
    if not usable.any():
        return proved, least
    scale = 1.0 / np.sqrt(diagonal[usable])
    scaled = scale[:, :, None] * middle[usable] * scale[:, None, :]
    values, vectors = np.linalg.eigh(scaled)
    least[usable] = values[:, 0]
    S = Matrices.exact(
        scale[:, :, None] * vectors / np.sqrt(np.maximum(values, 1e-300))[:, None, :]
    )
    radius = np.broadcast_to(matrices.radius, matrices.middle.shape)[usable]
    with np.errstate(all="ignore"):
        G = S.T @ Matrices(matrices.middle[usable], radius) @ S
        size = np.abs(G.middle) + G.radius
        own = np.diagonal(G.middle, axis1=-2, axis2=-1) - np.diagonal(
            G.radius, axis1=-2, axis2=-1
        )
        others = size.sum(axis=-1) - np.diagonal(size, axis1=-2, axis2=-1)
        room = own - others - (own.shape[-1] + 4) * _UNIT * (np.abs(own) + size.sum(axis=-1))
        proved[usable] = (room > 0.0).all(axis=-1) & (values[:, 0] > 0.0)
    return proved, least


def eigenvalue_bounds(P: Array) -> tuple[float, float]:
    r"""Numbers :math:`0 < a \le b` with :math:`a I \prec P \prec b I`, verified.

    Parameters
    ----------
    P : (n, n) array
        Symmetric.

    Raises
    ------
    CertificateError
        If P is not positive definite, as far as double precision can tell.
    """
    values = np.linalg.eigvalsh(P)
    eye = np.eye(P.shape[0])
    for slack in (1e-13, 1e-11, 1e-9, 1e-7):
        room = slack * float(np.abs(values).max())
        low, high = float(values[0]) - room, float(values[-1]) + room
        if low <= 0.0:
            break
        pair = Matrices.exact(np.stack((P, -P))) + Matrices.exact(
            np.stack((-low * eye, high * eye))
        )
        if definite(pair)[0].all():
            return low, high
    raise CertificateError(
        f"P has the eigenvalues {values.tolist()}; it could not be shown positive definite."
    )


def norm_bound(matrices: Matrices) -> Array:
    """Upper bounds on the spectral norms of the matrices in each set.

    Parameters
    ----------
    matrices : Matrices
        Of shape (B, r, c).

    Returns
    -------
    (B,) array
        The bounds, verified; infinite where there are none.
    """
    middle = matrices.middle
    spread = np.sqrt(
        np.square(np.broadcast_to(matrices.radius, middle.shape)).sum(axis=(-2, -1))
    ) * (1.0 + 1e-13)
    bounds = np.full(middle.shape[0], np.inf)
    usable = np.isfinite(middle).all(axis=(-2, -1)) & np.isfinite(spread)
    if not usable.any():
        return bounds
    chosen = Matrices.exact(middle[usable])
    found = np.linalg.norm(middle[usable], 2, axis=(-2, -1))
    frobenius = np.sqrt(np.square(middle[usable]).sum(axis=(-2, -1))) * (1.0 + 1e-13) + _TINY
    guess = found * (1.0 + 1e-10) + 1e-150
    eye = np.eye(middle.shape[-1])
    square = Matrices.exact((guess * guess * (1.0 - 1e-15))[:, None, None] * eye)
    shown, _ = definite(square - chosen.T @ chosen)
    bounds[usable] = (np.where(shown, guess, frobenius) + spread[usable]) * (1.0 + 1e-15)
    return bounds


def rounded_up(value: float, operations: int = 8) -> float:
    """A number no less than one that was computed by some correctly rounded operations.

    Parameters
    ----------
    value : float
        The computed number, of positive terms.
    operations : int
        How many operations.
    """
    return math.nextafter(value * (1.0 + operations * _UNIT), math.inf)
