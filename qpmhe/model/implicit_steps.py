"""Implicit steps of an ODE: collocation, solved by Newton's method to rounding.

One substep of length h from x has stages Z_i, the increments at its nodes:

    Z_i = h sum_j A_ij f_c(x + Z_j, u),        x⁺ = x + sum_i d_i Z_i.

The start is Z = 0, so that the step is a function of x, u and h alone. The implicit function
theorem gives its derivative, from the Jacobians at the converged stages: exact, whatever the
iteration did.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# Of states (K, n) and inputs (K, m): rates (K, n), or their Jacobians (K, n, n).
Batched = Callable[[Array, Array], Array]

#: Iterations of Newton's method, and halvings of one of its steps.
MOST_ITERATIONS, MOST_HALVINGS = 50, 12
#: Corrections below this share of the stages' sizes may end the iteration.
SMALL = 1e-7
#: Corrections below this share are rounding.
ROUNDING = 4e-16


class Collocation(NamedTuple):
    """The coefficients of an implicit Runge-Kutta method.

    Attributes
    ----------
    A : (s, s) array
        Weights of the stages' rates in the stages.
    d : (s,) array
        Weights of the stages in the step.
    order : int
        Order of the error over a fixed time.
    """

    A: Array
    d: Array
    order: int


_ROOT = float(np.sqrt(6.0))
#: By name. Hairer and Wanner, Solving Ordinary Differential Equations II, sections IV.5 and IV.8.
COLLOCATIONS = {
    "midpoint": Collocation(np.array([[0.5]]), np.array([2.0]), 2),
    "radau": Collocation(
        np.array([
            [(88.0 - 7.0 * _ROOT) / 360.0, (296.0 - 169.0 * _ROOT) / 1800.0,
             (-2.0 + 3.0 * _ROOT) / 225.0],
            [(296.0 + 169.0 * _ROOT) / 1800.0, (88.0 + 7.0 * _ROOT) / 360.0,
             (-2.0 - 3.0 * _ROOT) / 225.0],
            [(16.0 - _ROOT) / 36.0, (16.0 + _ROOT) / 36.0, 1.0 / 9.0],
        ]),
        np.array([0.0, 0.0, 1.0]), 5,
    ),
}


class ImplicitStep:
    """x⁺ = f(x, u) by some substeps of an implicit method, and its Jacobian, at many states.

    Where Newton's method does not converge, the values are NaN: the model fails there.

    Parameters
    ----------
    rate, jacobian : callable
        The rate f_c and its derivative by x, over states (K, n) and inputs (K, m).
    method : str
        A name of `COLLOCATIONS`.
    steps : int
        Number of substeps.
    """

    def __init__(self, rate: Batched, jacobian: Batched, method: str, steps: int) -> None:
        self._rate, self._jacobian, self._steps = rate, jacobian, steps
        self._method = COLLOCATIONS[method]

    def value(self, x: Array, u: Array, dt: Array) -> Array:
        """The next states (K, n), from states (K, n), inputs (K, m) and lengths (K,)."""
        h = dt / self._steps
        for _ in range(self._steps):
            x = x + np.einsum("i,kin->kn", self._method.d, self._stages(x, u, h))
        return x

    def linear(self, x: Array, u: Array, dt: Array) -> tuple[Array, Array]:
        """The next states (K, n) and their derivatives by x (K, n, n)."""
        (count, n), h, method = x.shape, dt / self._steps, self._method
        s, identity = len(method.A), np.eye(x.shape[1])
        slopes = np.broadcast_to(identity, (count, n, n))
        for _ in range(self._steps):
            Z = self._stages(x, u, h)
            J = self._slopes(x, u, Z)
            # (I - h A J) dZ/dx = h A J (1, ..., 1).
            right = h[:, None, None, None] * np.einsum("ij,kjab->kiab", method.A, J)
            dZ = _solved(_newton_matrix(method.A, h, J), right.reshape(count, s * n, n))
            own = identity + np.einsum("i,kiab->kab", method.d, dZ.reshape(count, s, n, n))
            slopes = own @ slopes
            x = x + np.einsum("i,kin->kn", method.d, Z)
        return x, slopes

    def _slopes(self, x: Array, u: Array, Z: Array) -> Array:
        """The Jacobians (K, s, n, n) at the stages."""
        count, s, n = Z.shape
        states = (x[:, None] + Z).reshape(count * s, n)
        return self._jacobian(states, np.repeat(u, s, axis=0)).reshape(count, s, n, n)

    def _residual(self, x: Array, u: Array, h: Array, Z: Array) -> Array:
        """Z - h A f_c(x + Z), (K, s, n)."""
        count, s, n = Z.shape
        states = (x[:, None] + Z).reshape(count * s, n)
        rates = self._rate(states, np.repeat(u, s, axis=0)).reshape(count, s, n)
        found: Array = Z - h[:, None, None] * np.einsum("ij,kjn->kin", self._method.A, rates)
        return found

    def _stages(self, x: Array, u: Array, h: Array) -> Array:
        """The stages (K, s, n) of one substep; NaN where the iteration does not converge."""
        count, n = x.shape
        s = len(self._method.A)
        Z = np.zeros((count, s, n))
        with np.errstate(all="ignore"):
            self._iterate(x, u, h, Z, np.arange(count))
        return Z

    def _iterate(self, x: Array, u: Array, h: Array, Z: Array, at: NDArray[np.intp]) -> None:
        """Newton's iteration from Z = 0 for all these states, in place.

        Steps are whole ones, which converge from far on stiff kinetics where a test of descent
        would refuse them; a step that leads out of the rate's domain is halved.
        """
        last = np.full(len(at), np.inf)
        residual = self._residual(x[at], u[at], h[at], Z[at])
        for _ in range(MOST_ITERATIONS):
            J = self._slopes(x[at], u[at], Z[at])
            step = -_times(_inverse(_newton_matrix(self._method.A, h[at], J)), residual)
            # What rounding of the states and of their flows amounts to in each equation.
            size = np.abs(x[at]) + np.abs(Z[at] + step).max(axis=1)
            size += h[at, None] * (np.abs(J).max(axis=1) @ size[..., None])[..., 0]
            length = _length(step, size)
            done = (length <= ROUNDING) | ((length <= SMALL) & (length > 0.5 * last))
            lost, factor = ~np.isfinite(length), np.ones(len(at))
            for _ in range(MOST_HALVINGS):
                trial = Z[at] + factor[:, None, None] * step
                residual = self._residual(x[at], u[at], h[at], trial)
                outside = ~(np.isfinite(residual).all(axis=(1, 2)) | done | lost)
                if not outside.any():
                    break
                factor[outside] *= 0.5
            trial[lost | outside] = np.nan
            Z[at] = trial
            left = ~(done | lost | outside)
            if not left.any():
                return
            at, residual, last = at[left], residual[left], length[left]
        Z[at] = np.nan


def _inverse(matrix: Array) -> Array:
    """The inverses (K, sn, sn); NaN of those that are singular or not finite."""
    found = np.full_like(matrix, np.nan)
    good = np.isfinite(matrix).all(axis=(1, 2))
    try:
        found[good] = np.linalg.inv(matrix[good])
    except np.linalg.LinAlgError:
        for k in np.flatnonzero(good):
            try:
                found[k] = np.linalg.inv(matrix[k])
            except np.linalg.LinAlgError:
                continue
    return found


def _solved(matrix: Array, right: Array) -> Array:
    """The solutions (K, sn, n); an inverse alone loses digits where the matrix is stiff."""
    inverse = _inverse(matrix)
    found: Array = inverse @ right
    found += inverse @ (right - matrix @ found)
    return found


def _newton_matrix(A: Array, h: Array, J: Array) -> Array:
    """I - h A_ij J_j, (K, sn, sn), of Jacobians (K, s, n, n)."""
    count, s, n = J.shape[:3]
    blocks = -h[:, None, None, None, None] * A[:, :, None, None] * J[:, None]
    found: Array = blocks.transpose(0, 1, 3, 2, 4).reshape(count, s * n, s * n)
    found += np.eye(s * n)
    return found


def _times(matrix: Array, stages: Array) -> Array:
    found: Array = (matrix @ stages.reshape(len(stages), -1, 1)).reshape(stages.shape)
    return found


def _length(step: Array, size: Array) -> Array:
    """The largest share (K,) that a correction (K, s, n) has of the sizes (K, n)."""
    shares = np.abs(step) / size[:, None]
    shares[(step == 0.0) & (size[:, None] == 0.0)] = 0.0  # a state that stays 0
    found: Array = shares.max(axis=(1, 2))
    return found
