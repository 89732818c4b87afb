r"""The matrix inequalities of detectability and observers, as functions of the Jacobian.

Differences of f and h between two states of a convex set are :math:`A\, \delta x` and
:math:`C\, \delta x` with one pair (A, C), an average of the joint Jacobians between them. A
condition that describes a convex set of pairs holds for it once it holds at every single state.
`Form` is such a condition: a matrix affine in (A, C) that is positive definite. How inequalities
for trajectories follow is in the docs, in *What is guaranteed* and *A design by a Lyapunov
function*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from .evidence import CertificateError

_UNIT = float(np.finfo(np.float64).eps)  # twice the unit roundoff: a margin in every bound
_TINY = 1e-290  # covers what underflows
_ROUNDING = 1e-6  # more than rounding makes of differences of f and h


def norms(values: Array, weight: Array) -> Array:
    """|s|_W of each row, or its maximum for vectors of these lengths."""
    if values.ndim == 1:
        top = float(np.linalg.eigvalsh(weight)[-1])
        return math.sqrt(max(0.0, top)) * values
    squares: Array = np.einsum("ti,ij,tj->t", values, weight, values)
    return np.sqrt(np.maximum(squares, 0.0))


def _empty() -> Array:
    return np.empty((0, 0))


def _assemble(rows: list[list[Matrices]]) -> Matrices:
    """Blocks as one matrix."""
    cells = np.broadcast_shapes(*(each.middle.shape[:-2] for row in rows for each in row))
    return Matrices(*(
        np.block([
            [np.broadcast_to(getattr(each, part), cells + each.middle.shape[-2:]) for each in row]
            for row in rows
        ]) for part in ("middle", "radius")
    ))


@dataclass(frozen=True, eq=False)
class Form:
    r"""A quadratic Lyapunov function of differences, with its unknowns filled in.

    For two states x_1, x_2 with their disturbances, of detectability,

    .. math::
        |x_1^+ - x_2^+|_P^2 \le \rho^2 |x_1 - x_2|_P^2 + |w_1 - w_2|_Q^2 + |h(x_1) - h(x_2)|_R^2,

    and for the error e = x - z of an observer with the constant gain L,
    :math:`|e^+|_P^2 \le \rho^2 |e|_P^2 + |w|_Q^2 + |v|_R^2`. Either follows from

    .. math::
        \begin{pmatrix} X & P A_L \\ \cdot & \rho^2 P + C^\top R C \end{pmatrix} \succ 0, \qquad
        \begin{pmatrix} P - X & P B \\ \cdot & D \end{pmatrix} \succ 0,

    for detectability with :math:`A_L = A`, B = G and D = Q, for an observer with
    :math:`A_L = A - L C`, B = (G, -L), D = diag(Q, R) and without :math:`C^\top R C`. Where X is
    P, by the triangle inequality alone,
    :math:`|x_1^+ - x_2^+|_P \le \rho |x_1 - x_2|_P + |w_1 - w_2|_P + |h(x_1) - h(x_2)|_R`.

    Where C varies, :math:`-C^\top R C` is concave in C. As :math:`\delta h = C \delta x`, the
    terms with :math:`\delta h - C \delta x` change nothing in

    .. math::
        |A \delta x - K (\delta h - C \delta x)|_S^2 \le \rho^2 |\delta x|_P^2
        + |\delta h|_R^2 - 2 (\delta h - C \delta x)^\top (M \delta x + N \delta h),

    which for all :math:`\delta x, \delta h`, with Y = P K and :math:`S = P X^{-1} P`, is affine:

    .. math::
        \begin{pmatrix} X & P A + Y C & -Y \\
        \cdot & \rho^2 P + C^\top M + M^\top C & C^\top N - M^\top \\
        \cdot & \cdot & R - N - N^\top \end{pmatrix} \succ 0 .
    """

    P: Array
    rate: float
    R: Array = field(default_factory=_empty)  # of the output or an observer's noise
    gain: Array | None = None  # of an observer
    injection: tuple[Array, Array, Array] | None = None  # Y, M and N
    X: Array = field(default_factory=_empty)  # X, B and Q are empty where X is P
    B: Array = field(default_factory=_empty)
    Q: Array = field(default_factory=_empty)

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix of the first inequality, which must be positive definite."""
        n, P = len(self.P), Matrices.exact(self.P)
        A, C = jacobian[:, :n], jacobian[:, n:]
        X = Matrices.exact(self.X) if self.X.size else P
        square = self.rate * self.rate * self.P
        low = Matrices(square, 4.0 * _UNIT * np.abs(square) + _TINY)
        if self.gain is not None:
            side = P @ (A - Matrices.exact(self.gain) @ C)
            return _assemble([[X, side], [side.T, low]])
        R = Matrices.exact(self.R)
        if self.injection is None:
            return _assemble([[X, P @ A], [A.T @ P, low + C.T @ (R @ C)]])
        Y, M, N = map(Matrices.exact, self.injection)
        side, crossed, mixed = P @ A + Y @ C, C.T @ M, C.T @ N - M.T
        return _assemble([
            [X, side, -Y], [side.T, low + crossed + crossed.T, mixed], [-Y.T, mixed.T, R - N - N.T],
        ])

    def holds_always(self) -> bool:
        """Whether P and the second inequality's matrix are shown to be positive definite."""
        P = Matrices.exact(self.P[None])
        if not self.X.size:
            return bool(definite(P).all())
        D, r = np.zeros((1, *2 * self.B.shape[1:])), len(self.Q)
        D[:, :r, :r] = self.Q
        if self.gain is not None:
            D[:, r:, r:] = self.R
        rest, side = P - Matrices.exact(self.X[None]), P @ Matrices.exact(self.B[None])
        both = _assemble([[rest, side], [side.T, Matrices.exact(D)]])
        return bool(definite(P).all() and definite(both).all())

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """By how much differences violate the first inequality; positive beyond rounding."""
        S = self.P @ np.linalg.solve(self.X, self.P) if self.X.size else self.P
        right = self.rate * norms(dx, self.P)
        if self.gain is not None:
            df = df - dh @ self.gain.T
        else:
            right = np.hypot(right, norms(dh, self.R))
        return norms(df, 0.5 * (S + S.T)) * (1.0 - _ROUNDING) - right


@dataclass(frozen=True, eq=False)
class Matrices:
    r"""Sets of matrices :math:`\{M : |M - \text{middle}| \le \text{radius}\}`, entrywise."""

    middle: Array  # (..., r, c)
    radius: Array  # the same shape, or one that broadcasts to it

    @classmethod
    def exact(cls, matrix: Array) -> Matrices:
        """One matrix of floating point numbers."""
        return cls(matrix, np.zeros_like(matrix))

    @property
    def T(self) -> Matrices:  # noqa: N802 - as NumPy calls it
        """The transposes."""
        return Matrices(np.swapaxes(self.middle, -1, -2), np.swapaxes(self.radius, -1, -2))

    def __getitem__(self, index: Any) -> Matrices:
        return Matrices(self.middle[index], self.radius[index])

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


def definite(matrices: Matrices) -> NDArray[np.bool_]:
    r"""Whether every symmetric matrix of each set is positive definite.

    The matrices are scaled to diagonals near one. A member less the middle A, plus the sums of the
    radius' rows on the diagonal, is diagonally dominant; so A less these sums must be definite.
    Cholesky's factorisation, where it ends, is of a matrix that differs from it by at most
    :math:`\gamma_{n+1} \operatorname{tr} A`, up to a factor near one (Rump, BIT 46, 2006; Higham,
    Accuracy and Stability of Numerical Algorithms, 2nd edition, theorem 10.3).
    """
    middle = 0.5 * (matrices.middle + np.swapaxes(matrices.middle, -1, -2))
    radius = np.broadcast_to(matrices.radius, middle.shape)
    n, diagonal = middle.shape[-1], np.diagonal(middle, axis1=-2, axis2=-1)
    with np.errstate(all="ignore"):
        # Powers of two scale without rounding.
        scale = np.exp2(-np.round(0.5 * np.log2(diagonal)))
        factor = scale[:, :, None] * scale[:, None, :]
        A, spread = factor * middle, factor * radius
        rows = np.maximum(spread, np.swapaxes(spread, -1, -2)).sum(axis=-1)
        trace = np.diagonal(A, axis1=-2, axis2=-1).sum(axis=-1)
        A[:, range(n), range(n)] -= (rows + 4.0 * (n + 4) * _UNIT * trace[:, None]) * (1.0 + 1e-12)
        proved: NDArray[np.bool_] = np.all(np.isfinite(A), axis=(-2, -1))
        for k in range(n):
            pivot = A[:, k, k]
            proved &= pivot > 0.0
            column = A[:, k + 1 :, k] / np.sqrt(np.where(proved, pivot, np.nan))[:, None]
            A[:, k + 1 :, k + 1 :] -= column[:, :, None] * column[:, None, :]
    return proved


def eigenvalue_bounds(P: Array) -> tuple[float, float]:
    r"""Numbers :math:`0 < a \le b` with :math:`a I \prec P \prec b I`, verified."""
    eye, diagonal = np.eye(len(P)), np.abs(P.diagonal())
    # In units that differ much, small eigenvalues are rounding beside the large ones: the least is
    # the inverse of the largest one of the inverse, in units of its own.
    scale = np.exp2(-np.round(0.5 * np.log2(np.where(diagonal > 0.0, diagonal, 1.0))))
    balanced, values = np.outer(scale, scale) * P, np.linalg.eigvalsh(P)
    if np.linalg.eigvalsh(balanced)[0] > 0.0:
        inverse = np.outer(scale, scale) * np.linalg.inv(balanced)
        values[0] = 1.0 / np.linalg.eigvalsh(0.5 * (inverse + inverse.T))[-1]
    for slack in (1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3, 0.1, 0.5):
        low, high = (1.0 - slack) * float(values[0]), (1.0 + slack) * float(values[-1])
        sides = np.stack((P, -P)), np.stack((-low * eye, high * eye))
        if low > 0.0 and definite(Matrices.exact(sides[0]) + Matrices.exact(sides[1])).all():
            return low, high
    raise CertificateError(
        f"P has the eigenvalues {values.tolist()}; it could not be shown positive definite."
    )


def norm_bound(matrices: Matrices) -> Array:
    """Upper bounds on the spectral norms of the matrices in each set; infinite where unknown."""
    radius = np.broadcast_to(matrices.radius, matrices.middle.shape)
    with np.errstate(all="ignore"):
        spread = np.sqrt(np.square(radius).sum(axis=(-2, -1))) * (1.0 + 1e-13)
        usable = np.isfinite(matrices.middle).all(axis=(-2, -1)) & np.isfinite(spread)
        chosen = Matrices.exact(np.where(usable[:, None, None], matrices.middle, 0.0))
        frobenius = np.sqrt(np.square(chosen.middle).sum(axis=(-2, -1))) * (1.0 + 1e-13) + _TINY
        guess = np.linalg.norm(chosen.middle, 2, axis=(-2, -1)) * (1.0 + 1e-10) + 1e-150
        eye = np.eye(chosen.middle.shape[-1])
        square = Matrices.exact((guess * guess * (1.0 - 1e-15))[:, None, None] * eye)
        found = np.where(definite(square - chosen.T @ chosen), guess, frobenius) + spread
    return np.where(usable, found * (1.0 + 1e-15), np.inf)


def congruence(P: Array, matrix: Array) -> Array:
    r"""A weight :math:`W \succeq M^\top P M`, larger by no more than rounding in any unit.

    So that :math:`|M s|_P \le |s|_W` for all s.
    """
    factor = Matrices.exact(matrix)
    product = factor.T @ Matrices.exact(P) @ factor
    W: Array = 0.5 * (product.middle + product.middle.T)
    # As 2 |s_i s_j| <= a s_i^2 + s_j^2 / a, with a of the components' own sizes.
    size = np.sqrt(np.maximum(W.diagonal(), _TINY))
    radius = np.maximum(product.radius, product.radius.T) * np.divide.outer(size, size)
    return W + 2.0 * np.diag(radius.sum(axis=1))


def euclidean_constants(
    P: Array, V: Array, rate: float, W: Array | None = None
) -> tuple[float, float, float]:
    r"""c_p, c_w and c_v of the sums in def:RGES and def:eIOSS, rounded up.

    They follow from :math:`|e^+|_P \le \rho |e|_P + |w|_W + |v|_V` by induction. W is P if left
    out.
    """
    low, high = eigenvalue_bounds(P)
    up = 1.0 + 8.0 * _UNIT
    c_p = math.sqrt(high / low) * up
    entry = c_p if W is None else math.sqrt(_most(W) / low) * up
    return c_p, entry / rate * up, max(math.sqrt(_most(V) / low) / rate * up, 1e-300)


def _most(weight: Array) -> float:
    """An upper bound on the largest eigenvalue of a weight, which may be singular."""
    size = 2.0 * float(np.linalg.norm(weight))
    # Shifted, the weight has the lower bound that is verified beside the upper one.
    top = eigenvalue_bounds(weight + size * np.eye(len(weight)))[1] - size if size > 0.0 else 0.0
    return max(top, 0.0) + 1e-15 * size
