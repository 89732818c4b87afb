"""Implicit steps of an ODE or a DAE: collocation, solved by Newton's method to rounding.

One substep of length h from x has stages Z_i, the increments at its nodes, and, with algebraic
states, z_i:

    Z_i = h sum_j A_ij f_c(x + Z_j, z_j, u),    0 = g(x + Z_i, z_i, u),    x⁺ = x + sum_i d_i Z_i.

The start is Z = 0 and the algebraic states at x, so that the step is a function of x, u and h
alone. The implicit function theorem gives its derivative, from the Jacobians at the converged
stages: exact, whatever the iteration did.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .algebraic import (
    MOST_HALVINGS,
    MOST_ITERATIONS,
    AlgebraicStates,
    Batched,
    Eliminated,
    algebraic_sizes,
    converged,
    eliminated,
    inverse,
    solved,
)

Array = NDArray[np.float64]


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
        The rate f_c and its derivative by x, over states (K, n) and inputs (K, m); with algebraic
        states the joint function of w = (x, z), see `qpmhe.model.algebraic`.
    method : str
        A name of `COLLOCATIONS`.
    steps : int
        Number of substeps.
    algebraic : AlgebraicStates, optional
        The algebraic states, where there are any.
    """

    def __init__(
        self, rate: Batched, jacobian: Batched, method: str, steps: int,
        algebraic: AlgebraicStates | None = None,
    ) -> None:
        self._rate, self._jacobian, self._steps = rate, jacobian, steps
        self._method, self._algebraic = COLLOCATIONS[method], algebraic

    def value(self, w: Array, u: Array, dt: Array) -> Array:
        """The next states (K, n), from w = (x, z) (K, n + k), inputs (K, m) and lengths (K,)."""
        h, n = dt / self._steps, w.shape[1] - self._k
        for k in range(self._steps):
            w = w if k == 0 else self._completed(w, u)
            w = w[:, :n] + np.einsum("i,kin->kn", self._method.d, self._stages(w, u, h)[..., :n])
        return w

    def linear(self, w: Array, u: Array, dt: Array) -> tuple[Array, Array]:
        """The next states (K, n) and their derivatives by x (K, n, n)."""
        h, method, count, n = dt / self._steps, self._method, len(w), w.shape[1] - self._k
        s, identity = len(method.A), np.eye(n)
        slopes = np.broadcast_to(identity, (count, n, n))
        for k in range(self._steps):
            w = w if k == 0 else self._completed(w, u)
            x, W = w[:, :n], self._stages(w, u, h)
            with np.errstate(all="ignore"):
                J = eliminated(np.zeros_like(W), self._slopes(x, u, W), n).jacobian
            # (I - h A J) dZ/dx = h A J (1, ..., 1).
            right = h[:, None, None, None] * np.einsum("ij,kjab->kiab", method.A, J)
            matrix = _newton_matrix(method.A, h, J)
            dZ = solved(matrix, right.reshape(count, s * n, n), inverse(matrix))
            own = identity + np.einsum("i,kiab->kab", method.d, dZ.reshape(count, s, n, n))
            slopes = own @ slopes
            w = x + np.einsum("i,kin->kn", method.d, W[..., :n])
        return w, slopes

    @property
    def _k(self) -> int:
        return 0 if self._algebraic is None else self._algebraic.guess.size

    def _completed(self, x: Array, u: Array) -> Array:
        return x if self._algebraic is None else self._algebraic.complete(x, u)

    def _at_stages(self, function: Batched, x: Array, u: Array, W: Array) -> Array:
        """The rates (K, s, n + k) at the stages, or their Jacobians (K, s, n + k, n + k)."""
        count, s, size = W.shape
        states = W.copy()
        states[..., : x.shape[1]] += x[:, None]
        found = function(states.reshape(count * s, size), np.repeat(u, s, axis=0))
        return found.reshape(count, s, *found.shape[1:])

    def _slopes(self, x: Array, u: Array, W: Array) -> Array:
        return self._at_stages(self._jacobian, x, u, W)

    def _stages(self, w: Array, u: Array, h: Array) -> Array:
        """The stages (K, s, n + k) of one substep; NaN where the iteration does not converge."""
        x, W = w[:, : w.shape[1] - self._k], np.repeat(w[:, None], len(self._method.A), axis=1)
        known = np.isfinite(w).all(axis=1)
        W[..., : x.shape[1]] = 0.0
        W[~known] = np.nan
        with np.errstate(all="ignore"):
            self._iterate(x, u, h, W, np.flatnonzero(known))
        return W

    def _iterate(self, x: Array, u: Array, h: Array, W: Array, at: NDArray[np.intp]) -> None:
        """Newton's iteration for all these states, in place.

        Steps are whole ones, which converge from far on stiff kinetics where a test of descent
        would refuse them; a step that leads out of the functions' domain is halved.
        """
        if not at.size:
            return
        n, A, last = x.shape[1], self._method.A, np.full(len(at), np.inf)
        side = np.ones((len(x), 1))
        values = self._at_stages(self._rate, x[at], u[at], W[at])
        for iteration in range(MOST_ITERATIONS):
            found = eliminated(values, self._slopes(x[at], u[at], W[at]), n)
            Z, J = W[at, :, :n], found.jacobian
            residual = Z - h[at, None, None] * np.einsum("ij,kjn->kin", A, found.rate)
            step = -_times(inverse(_newton_matrix(A, h[at], J)), residual)
            # What rounding of the states and of their flows amounts to in each equation.
            size = np.abs(x[at]) + np.abs(Z + step).max(axis=1)
            size += h[at, None] * (np.abs(J).max(axis=1) @ size[..., None])[..., 0]
            length = _length(step, size[:, None])
            if W.shape[2] > n:
                step, others = _with_algebraic(found, step, W[at, :, n:], size)
                length = np.maximum(length, others)
            done = converged(length, last)
            if iteration == 0:
                side[at] = found.side[:, :1]
            # Another solution for z is no stage of this step.
            lost = ~np.isfinite(length) | (done & (found.side != side[at]).any(axis=1))
            factor = np.ones(len(at))
            for _ in range(MOST_HALVINGS):
                trial = W[at] + factor[:, None, None] * step
                values = self._at_stages(self._rate, x[at], u[at], trial)
                outside = ~(np.isfinite(values).all(axis=(1, 2)) | done | lost)
                if not outside.any():
                    break
                factor[outside] *= 0.5
            trial[lost | outside] = np.nan
            W[at] = trial
            left = ~(done | lost | outside)
            if not left.any():
                return
            at, values, last = at[left], values[left], length[left]
        W[at] = np.nan


def _with_algebraic(
    found: Eliminated, step: Array, z: Array, size: Array
) -> tuple[Array, Array]:
    """The correction (K, s, n + k) of Z and z, and the largest share (K,) of that of z."""
    move = found.step + (found.slope @ step[..., None])[..., 0]
    sizes = algebraic_sizes(found, np.repeat(size[:, None], z.shape[1], axis=1), np.abs(z + move))
    return np.concatenate((step, move), axis=2), _length(move, sizes)


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
    """The largest share (K,) that a correction (K, s, n) has of sizes that broadcast to it."""
    shares = np.abs(step) / size
    shares[(step == 0.0) & (size == 0.0)] = 0.0  # a state that stays 0
    found: Array = shares.max(axis=(1, 2))
    return found
