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

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .verification import Matrices

__all__ = ["ErrorContraction", "Form", "OutputInjection", "OutputWeight"]

Array = NDArray[np.float64]


class Form(Protocol):
    """A matrix inequality with its unknowns filled in."""

    @property
    def P(self) -> Array:  # noqa: N802 - the paper's symbol
        """The norm's matrix, (n, n)."""

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrices that must be positive definite.

        Parameters
        ----------
        jacobian : Matrices
            J, of shape (B, n + p, n).
        """


def _square(P: Array, rate: float) -> Matrices:
    exact = Matrices.exact(np.array([[rate]]))
    factor = exact @ exact
    return Matrices(
        factor.middle * P,
        (factor.radius + 1e-15 * factor.middle) * np.abs(P) * (1.0 + 1e-15) + 1e-290,
    )


def _assemble(blocks: list[list[Matrices | None]], sizes: list[int], cells: int) -> Matrices:
    """Blocks on and above the diagonal as one symmetric matrix; None is zero."""
    k = sum(sizes)
    middle, radius = np.zeros((2, cells, k, k))
    at = np.cumsum([0, *sizes])
    for i, row in enumerate(blocks):
        for j, block in enumerate(row, start=i):
            if block is None:
                continue
            rows, columns = slice(at[i], at[i + 1]), slice(at[j], at[j + 1])
            middle[:, rows, columns], radius[:, rows, columns] = block.middle, block.radius
            if j > i:
                middle[:, columns, rows] = np.swapaxes(block.middle, -1, -2)
                radius[:, columns, rows] = np.swapaxes(block.radius, -1, -2)
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

    Parameters
    ----------
    P, R : (n, n) and (p, p) array
        As above.
    rate : float
        eta.
    """

    P: Array
    R: Array
    rate: float

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix above; see `Form.matrices`."""
        n = self.P.shape[0]
        A, C = _parts(jacobian, n)
        P = Matrices.exact(self.P)
        lower = _square(self.P, self.rate) + C.T @ (Matrices.exact(self.R) @ C)
        return _assemble([[P, P @ A], [lower]], [n, n], A.middle.shape[0])


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

    Parameters
    ----------
    P, R : (n, n) and (p, p) array
        As above.
    Y, M, N : (n, p), (p, n) and (p, p) array
        As above.
    rate : float
        eta.
    """

    P: Array
    R: Array
    Y: Array
    M: Array
    N: Array
    rate: float

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix above; see `Form.matrices`."""
        n, p = self.Y.shape
        A, C = _parts(jacobian, n)
        P, Y, M, N = (Matrices.exact(one) for one in (self.P, self.Y, self.M, self.N))
        crossed = C.T @ M
        blocks: list[list[Matrices | None]] = [
            [P, P @ A + Y @ C, -Y],
            [_square(self.P, self.rate) + crossed + crossed.T, C.T @ N - M.T],
            [Matrices.exact(self.R) - N - N.T],
        ]
        return _assemble(blocks, [n, n, p], A.middle.shape[0])


@dataclass(frozen=True, eq=False)
class ErrorContraction:
    r"""The error of an observer with the constant gain L.

    With e = x - z, of the system (eq:system) and the observer (eq:observer),

    .. math::
        e^+ = (A - L C)\, e + w - L v, \qquad
        \begin{pmatrix} P & P (A - L C) \\ \cdot & \rho^2 P \end{pmatrix} \succeq 0

    is affine in (A, C) jointly, for linear and for nonlinear h, and gives
    :math:`|e^+|_P \le \rho |e|_P + |w|_P + |L v|_P`.

    Parameters
    ----------
    P, gain : (n, n) and (n, p) array
        P and L.
    rate : float
        rho.
    """

    P: Array
    gain: Array
    rate: float

    def matrices(self, jacobian: Matrices) -> Matrices:
        """The matrix above; see `Form.matrices`."""
        n = self.P.shape[0]
        A, C = _parts(jacobian, n)
        P = Matrices.exact(self.P)
        closed = P @ (A - Matrices.exact(self.gain) @ C)
        return _assemble([[P, closed], [_square(self.P, self.rate)]], [n, n], A.middle.shape[0])
