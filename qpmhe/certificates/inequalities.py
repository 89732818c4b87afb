r"""The matrix inequalities of detectability and observers, as functions of the Jacobian.

For two states x_1, x_2 of a convex set, differences of f and of h are integrals of the
Jacobians along the segment between them, so that

.. math::
    \begin{pmatrix} f(x_1) - f(x_2) \\ h(x_1) - h(x_2) \end{pmatrix}
    = \begin{pmatrix} A \\ C \end{pmatrix} (x_1 - x_2), \qquad
    \begin{pmatrix} A \\ C \end{pmatrix}
    = \int_0^1 J(x_2 + s (x_1 - x_2))\, ds

with one pair (A, C) in the closed convex hull of the joint Jacobians J over the set. A
condition of the pair that describes a convex set of pairs holds on this hull once it holds
at the Jacobian of every single state. Each form below is such a condition: a matrix affine
in (A, C) that is positive definite.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from .evidence import CertificateError

_UNIT = float(np.finfo(np.float64).eps)  # twice the unit roundoff: a margin in every bound
_TINY = 1e-290  # covers what underflows
_ROUNDING = 1e-6  # more than rounding makes of differences of f and h


class Form(Protocol):
    """A matrix inequality with its unknowns filled in."""

    @property
    def P(self) -> Array:  # noqa: N802 - the paper's symbol
        """The norm's matrix, (n, n)."""

    @property
    def rate(self) -> float:
        """The contraction per step."""

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrices that must be positive definite."""

    def constants(self) -> tuple[Matrices, ...]:
        """Matrices that must be, too, whatever the Jacobian: each a stack of one."""

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """By how much differences violate the conclusion; positive beyond rounding."""


def norms(values: Array, weight: Array) -> Array:
    """|s|_W of each row, or what it is at most for vectors of these lengths."""
    if values.ndim == 1:
        top = float(np.linalg.eigvalsh(weight)[-1])
        return math.sqrt(max(0.0, top)) * values
    squares: Array = np.einsum("ti,ij,tj->t", values, weight, values)
    return np.sqrt(np.maximum(squares, 0.0))


def _square(P: Array, rate: float) -> Matrices:
    """rate^2 P, with more than the error of two products."""
    middle = rate * rate * P
    return Matrices(middle, 4.0 * _UNIT * np.abs(middle) + _TINY)


def _assemble(rows: list[list[Matrices]]) -> Matrices:
    """Blocks as one matrix."""
    cells = np.broadcast_shapes(*(each.middle.shape[:-2] for row in rows for each in row))
    middle, radius = (
        np.block([
            [np.broadcast_to(part(each), cells + each.middle.shape[-2:]) for each in row]
            for row in rows
        ])
        for part in (operator.attrgetter("middle"), operator.attrgetter("radius"))
    )
    return Matrices(middle, radius)


def _parts(jacobian: Matrices, n: int) -> tuple[Matrices, Matrices]:
    return (
        Matrices(jacobian.middle[:, :n], jacobian.radius[:, :n]),
        Matrices(jacobian.middle[:, n:], jacobian.radius[:, n:]),
    )


@dataclass(frozen=True, eq=False)
class OutputWeight:
    r"""Detectability where h is affine, C constant.

    .. math::
        A^\top P A \preceq \eta^2 P + C^\top R C \quad\Leftrightarrow\quad
        \begin{pmatrix} P & P A \\ \cdot & \eta^2 P + C^\top R C \end{pmatrix} \succeq 0

    is affine in A. It gives :math:`|A \delta x|_P^2 \le \eta^2 |\delta x|_P^2 +
    |C \delta x|_R^2`, hence, by :math:`\sqrt{a^2 + b^2} \le a + b` and the triangle inequality,

    .. math::
        |x_1^+ - x_2^+|_P \le \eta |\delta x|_P + |\delta w|_P + |\delta h|_R .

    Where C varies, :math:`-C^\top R C` is concave in C: the inequality at every single state
    says nothing of averages of their Jacobians, and `OutputInjection` must be used.
    """

    P: Array
    R: Array
    rate: float

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix above; see `Form.matrices`."""
        A, C = _parts(jacobian, self.P.shape[0])
        P = Matrices.exact(self.P)
        lower = _square(self.P, self.rate) + C.T @ (Matrices.exact(self.R) @ C)
        return _assemble([[P, P @ A], [(P @ A).T, lower]])

    def constants(self) -> tuple[Matrices, ...]:
        """P; see `Form.constants`."""
        return (Matrices.exact(self.P[None]),)

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """The first inequality's left-hand side less its right-hand one; see `Form.excess`."""
        left = norms(df, self.P) * (1.0 - _ROUNDING)
        return left - np.hypot(self.rate * norms(dx, self.P), norms(dh, self.R))


@dataclass(frozen=True, eq=False)
class OutputInjection:
    r"""Detectability where h is nonlinear, by output injection and multipliers.

    As :math:`\delta h = C \delta x`, neither of the terms with :math:`\delta h - C \delta x`
    changes anything in

    .. math::
        |A \delta x - K (\delta h - C \delta x)|_P^2 \le \eta^2 |\delta x|_P^2
        + |\delta h|_R^2 - 2 (\delta h - C \delta x)^\top (M \delta x + N \delta h),

    but asked of all :math:`\delta x, \delta h`, with Y = P K, it is the inequality

    .. math::
        \begin{pmatrix} P & P A + Y C & -Y \\
        \cdot & \eta^2 P + C^\top M + M^\top C & C^\top N - M^\top \\
        \cdot & \cdot & R - N - N^\top \end{pmatrix} \succeq 0,

    which is affine in (A, C) jointly, and from which the conclusion of `OutputWeight`
    follows. It takes one K, M and N for the whole set.
    """

    P: Array
    R: Array
    Y: Array
    M: Array
    N: Array
    rate: float

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix above; see `Form.matrices`."""
        A, C = _parts(jacobian, self.P.shape[0])
        P, Y, M, N = (Matrices.exact(one) for one in (self.P, self.Y, self.M, self.N))
        side, crossed, mixed = P @ A + Y @ C, C.T @ M, C.T @ N - M.T
        lower = _square(self.P, self.rate) + crossed + crossed.T
        noise = Matrices.exact(self.R) - N - N.T
        return _assemble([[P, side, -Y], [side.T, lower, mixed], [-Y.T, mixed.T, noise]])

    constants = OutputWeight.constants
    excess = OutputWeight.excess


@dataclass(frozen=True, eq=False)
class ErrorContraction:
    r"""The error of an observer with the constant gain L.

    With e = x - z, of the system (eq:system) and the observer (eq:observer),

    .. math::
        e^+ = (A - L C)\, e + G w - L v, \qquad
        \begin{pmatrix} S & S (A - L C) \\ \cdot & \rho^2 P \end{pmatrix} \succeq 0,
        \quad S \succeq P,

    is affine in (A, C) jointly, for linear and for nonlinear h. It is
    :math:`|(A - L C) e|_S \le \rho |e|_P`, and gives, as :math:`|\cdot|_P \le |\cdot|_S`,

    .. math:: |e^+|_P \le \rho |e|_P + |G w|_P + |L v|_P .

    With S above P, there is room for a sum of squares, whose limit is smaller where disturbance
    and error do not point in one direction: with :math:`B = (G, -L)`,

    .. math::
        \begin{pmatrix} S - P & -P B \\ \cdot & \operatorname{diag}(Q, R) - B^\top P B
        \end{pmatrix} \succ 0 \quad \Rightarrow \quad
        |e^+|_P^2 \le \rho^2 |e|_P^2 + |w|_Q^2 + |v|_R^2,

    as the matrix is of the form :math:`|a|_S^2 + |d|_{Q, R}^2 - |a + B d|_P^2`, at
    :math:`a = (A - L C) e`, d = (w, v).
    """

    P: Array
    gain: Array
    rate: float
    S: Array | None = None  # P where left out, and then there are no Q and R
    G: Array | None = None
    Q: Array | None = None
    R: Array | None = None

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The first matrix above; see `Form.matrices`."""
        A, C = _parts(jacobian, self.P.shape[0])
        S = Matrices.exact(self.P if self.S is None else self.S)
        closed = S @ (A - Matrices.exact(self.gain) @ C)
        return _assemble([[S, closed], [closed.T, _square(self.P, self.rate)]])

    def constants(self) -> tuple[Matrices, ...]:
        """P and the second matrix above; see `Form.constants`."""
        only = (Matrices.exact(self.P[None]),)
        if self.S is None or self.G is None or self.Q is None or self.R is None:
            return only
        P, S = Matrices.exact(self.P[None]), Matrices.exact(self.S[None])
        B = Matrices.exact(np.hstack((self.G, -self.gain))[None])
        r = self.Q.shape[0]
        D = np.zeros((1, r + self.R.shape[0], r + self.R.shape[0]))
        D[:, :r, :r], D[:, r:, r:] = self.Q, self.R
        side = -(P @ B)
        return *only, _assemble([[S - P, side], [side.T, Matrices.exact(D) - B.T @ P @ B]])

    def excess(self, dx: Array, df: Array, dh: Array) -> Array:
        """What the error grows to less what it may; see `Form.excess`."""
        left = norms(df - dh @ self.gain.T, self.P) * (1.0 - _ROUNDING)
        return left - self.rate * norms(dx, self.P)


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


def definite(matrices: Matrices) -> tuple[NDArray[np.bool_], Array]:
    r"""Whether every symmetric matrix of a set is positive definite.

    With S from an eigenvalue decomposition of the middle M, :math:`G = S^\top M S` is near
    the identity. G is enclosed with a bound on all rounding, and where Gershgorin's discs
    lie right of zero, G is positive definite for every member. Then so is M: S cannot be
    singular, or G would be, and congruence keeps the inertia.

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
        own = np.diagonal(G.middle, axis1=-2, axis2=-1) - np.diagonal(G.radius, axis1=-2, axis2=-1)
        others = size.sum(axis=-1) - np.diagonal(size, axis1=-2, axis2=-1)
        room = own - others - (own.shape[-1] + 4) * _UNIT * (np.abs(own) + size.sum(axis=-1))
        proved[usable] = (room > 0.0).all(axis=-1) & (values[:, 0] > 0.0)
    return proved, least


def quickly_definite(matrices: Matrices) -> NDArray[np.bool_]:
    r"""As `definite`, for many large matrices: quicker, and of no use for single small numbers.

    With unit diagonals, the members lie within the largest row sum of the radii of the middle,
    in the spectral norm. Cholesky's factorisation of the middle A less c I, where it ends, is of
    a matrix that differs by at most :math:`\gamma_{n+1} \operatorname{tr} A` up to a factor near
    one; c is more than both.

    References
    ----------
    Rump, Verification of positive definiteness, BIT 46 (2006). Higham, Accuracy and Stability
    of Numerical Algorithms, 2nd edition, theorem 10.3.
    """
    middle = 0.5 * (matrices.middle + np.swapaxes(matrices.middle, -1, -2))
    radius = np.broadcast_to(matrices.radius, middle.shape)
    n, diagonal = middle.shape[-1], np.diagonal(middle, axis1=-2, axis2=-1)
    with np.errstate(all="ignore"):
        # Powers of two scale without rounding.
        scale = np.exp2(-np.round(0.5 * np.log2(diagonal)))
        factor = scale[:, :, None] * scale[:, None, :]
        A, spread = factor * middle, factor * radius
        widest = np.maximum(spread, np.swapaxes(spread, -1, -2)).sum(axis=-1).max(axis=-1)
        trace = np.diagonal(A, axis1=-2, axis2=-1).sum(axis=-1)
        shift = (widest + 4.0 * (n + 4) * _UNIT * trace) * (1.0 + 1e-12)
        A[:, range(n), range(n)] -= shift[:, None]
        proved: NDArray[np.bool_] = np.all(np.isfinite(A), axis=(-2, -1))
        for k in range(n):
            pivot = A[:, k, k]
            proved &= pivot > 0.0
            column = A[:, k + 1 :, k] / np.sqrt(np.where(proved, pivot, np.nan))[:, None]
            A[:, k + 1 :, k + 1 :] -= column[:, :, None] * column[:, None, :]
    return proved


def eigenvalue_bounds(P: Array) -> tuple[float, float]:
    r"""Numbers :math:`0 < a \le b` with :math:`a I \prec P \prec b I`, verified."""
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
    """Upper bounds on the spectral norms of the matrices in each set."""
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
    """A number no less than one that was computed by some correctly rounded operations."""
    return math.nextafter(value * (1.0 + operations * _UNIT), math.inf)


def euclidean_constants(P: Array, V: Array, rate: float) -> tuple[float, float, float]:
    r"""Constants of the sums in def:RGES and def:eIOSS.

    From :math:`|e^+|_P \le \rho |e|_P + |w|_P + |v|_V`, by induction, and as the sums of the
    definitions discount by one power of the rate more,

    .. math::
        c_p = \sqrt{\bar\lambda(P) / \underline\lambda(P)}, \quad c_w = c_p / \rho, \quad
        c_v = \sqrt{\bar\lambda(V) / \underline\lambda(P)} / \rho .
    """
    low, high = eigenvalue_bounds(P)
    size = 2.0 * float(np.linalg.norm(V))
    # Of V, the upper bound alone is needed; shifted, it has the lower one that is verified.
    output = eigenvalue_bounds(V + size * np.eye(V.shape[0]))[1] - size if size > 0.0 else 0.0
    output = max(output, 0.0) + 1e-15 * size
    c_p = rounded_up(math.sqrt(high / low))
    return c_p, rounded_up(c_p / rate), max(rounded_up(math.sqrt(output / low) / rate), 1e-300)
