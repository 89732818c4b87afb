"""Implicit steps of an ODE or a DAE: collocation, solved by Newton's method to rounding.

One substep of length h from x has stages Z_i, the increments at its nodes, and, with algebraic
states, z_i:

    Z_i = h sum_j A_ij f_c(x + Z_j, z_j, u),    0 = g(x + Z_i, z_i, u),    x⁺ = x + sum_i d_i Z_i.

The start is Z = 0 and the algebraic states at x, so that the step is a function of x, u and h
alone. A simplified iteration with one Jacobian comes first; where its corrections do not shrink
fast, Newton's method starts again, with whole and then with damped steps; and where these fail,
too, it follows the stages as h grows. C does the same in the same order. The implicit function
theorem gives the derivative, from the Jacobians at the converged stages: exact, whatever the
iteration did. Where C computes it, its equations also make the last correction of the stages, by
less than 1e-12 of the states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .algebraic import (
    FOLLOWED,
    MOST_HALVINGS,
    MOST_ITERATIONS,
    ROUNDING,
    AlgebraicStates,
    Batched,
    Eliminated,
    algebraic_sizes,
    converged,
    eliminated,
    inverse,
    reciprocals,
    share,
    shorter,
    sides,
    solved,
    straight,
)

Array = NDArray[np.float64]


#: One Jacobian serves so many iterations, while corrections fall to this share of those before.
MOST_KEPT, CONTRACTION = 20, 0.25
#: Whole Newton steps: where more of them wander, rounding decides where they end. Few for each part
#: of the way, as stages are followed.
MOST_WHOLE, MOST_FOLLOWING = 30, 8
#: Newton's method fails where relative errors of the equations spread by more than this factor into
#: the stages: rounding alone then decides where a correction leads.
LARGEST_SPREAD = 1e13
#: Where they no longer fall, corrections of this many roundings have converged.
FEW_ROUNDINGS = 25.0


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

    @property
    def real(self) -> float:
        """The real eigenvalue of the inverse of A."""
        values = np.linalg.eigvals(np.linalg.inv(self.A))
        return float(values[np.argmin(np.abs(values.imag))].real)


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

    def substeps(self, w: Array, u: Array, dt: Array) -> Iterator[tuple[Array, Array, Array]]:
        """State (K, n), stages (K, s, n + k) and length (K,) of each substep, from w = (x, z)."""
        h, n = dt / self._steps, w.shape[1] - self._k
        for k in range(self._steps):
            w = w if k == 0 else self.completed(w, u)
            x, W = w[:, :n], self._stages(w, u, h)
            yield x, W, h
            w = self._end(x, W)

    def value(self, w: Array, u: Array, dt: Array) -> Array:
        """The next states (K, n), from w = (x, z) (K, n + k), inputs (K, m) and lengths (K,)."""
        for x, W, _ in self.substeps(w, u, dt):
            following = self._end(x, W)
        return following

    def linear(self, w: Array, u: Array, dt: Array) -> tuple[Array, Array]:
        """The next states (K, n) and their derivatives by x (K, n, n)."""
        method, count, n = self._method, len(w), w.shape[1] - self._k
        s, identity = len(method.A), np.eye(n)
        slopes = np.broadcast_to(identity, (count, n, n))
        for x, W, h in self.substeps(w, u, dt):
            with np.errstate(all="ignore"):
                slopes_there = self._slopes(x, u, W)
                J = eliminated(np.zeros_like(W), slopes_there, self._states(x, W), n).jacobian
            # (I - h A J) dZ/dx = h A J (1, ..., 1).
            right = h[:, None, None, None] * np.einsum("ij,kjab->kiab", method.A, J)
            matrix = newton_matrix(method.A, h, J)
            sizes = np.tile(_equations(np.abs(x) + np.abs(W[..., :n]).max(axis=1), h, J), s)
            dZ = solved(matrix, right.reshape(count, s * n, n), inverse(matrix, sizes))
            own = identity + np.einsum("i,kiab->kab", method.d, dZ.reshape(count, s, n, n))
            slopes, following = own @ slopes, self._end(x, W)
        return following, slopes

    def _end(self, x: Array, W: Array) -> Array:
        found: Array = x + np.einsum("i,kin->kn", self._method.d, W[..., : x.shape[1]])
        return found

    @property
    def _k(self) -> int:
        return 0 if self._algebraic is None else self._algebraic.guess.size

    def completed(self, x: Array, u: Array) -> Array:
        """The states w = (x, z), where there are algebraic states, else x."""
        return x if self._algebraic is None else self._algebraic.complete(x, u)

    def _at_stages(self, function: Batched, x: Array, u: Array, W: Array) -> Array:
        """The rates (K, s, n + k) at the stages, or their Jacobians (K, s, n + k, n + k)."""
        count, s, size = W.shape
        states = self._states(x, W).reshape(count * s, size)
        found = function(states, np.repeat(u, s, axis=0))
        return found.reshape(count, s, *found.shape[1:])

    @staticmethod
    def _states(x: Array, W: Array) -> Array:
        """The states w (K, s, n + k) at the stages."""
        states = W.copy()
        states[..., : x.shape[1]] += x[:, None]
        return states

    def _slopes(self, x: Array, u: Array, W: Array) -> Array:
        return self._at_stages(self._jacobian, x, u, W)

    def _stages(self, w: Array, u: Array, h: Array) -> Array:
        """The stages (K, s, n + k) of one substep; NaN where the iteration does not converge."""
        x, W = w[:, : w.shape[1] - self._k], np.repeat(w[:, None], len(self._method.A), axis=1)
        known = np.isfinite(w).all(axis=1)
        W[..., : x.shape[1]] = 0.0
        W[~known] = np.nan
        start = W.copy()
        with np.errstate(all="ignore"):
            self._keep(w, u, h, W, np.flatnonzero(known))
            for damped, most in (False, MOST_WHOLE), (True, MOST_ITERATIONS):
                left = np.flatnonzero(known & ~np.isfinite(W).all(axis=(1, 2)))
                W[left] = start[left]
                self._iterate(x, u, h, W, left, damped, most)
            left = np.flatnonzero(known & ~np.isfinite(W).all(axis=(1, 2)))
            W[left] = start[left]
            for part in range(1, FOLLOWED + 1):
                self._iterate(x, u, part * h / FOLLOWED, W, left, False, MOST_FOLLOWING)
                left = left[np.isfinite(W[left]).all(axis=(1, 2))]
        return W

    def _keep(self, w: Array, u: Array, h: Array, W: Array, at: NDArray[np.intp]) -> None:
        """The simplified iteration for all these states, in place; NaN where it fails.

        Its Jacobian is that at x, with rank-one corrections by what the rate did along each step
        (Broyden's method in scaled unknowns; Kelley, Iterative Methods for Linear and Nonlinear
        Equations, section 7.3).
        """
        if not at.size:
            return
        A, n, width, count = self._method.A, w.shape[1] - self._k, w.shape[1], len(self._method.A)
        w, u, h, many = w[at], u[at], h[at], (len(at), count)
        J = self._jacobian(w, u)
        first = eliminated(self._rate(w, u), J, w, n)
        jacobians = np.broadcast_to(first.jacobian[:, None], (*many, n, n))
        sizes = _equations(np.abs(w[:, :n]) + h[:, None] * np.abs(first.rate), h, jacobians)
        inverses = inverse(newton_matrix(A, h, jacobians), np.tile(sizes, count))
        frozen = np.repeat(J[:, None], count, axis=1), np.repeat(w[:, None], count, axis=1)
        now = np.repeat(w[:, None], count, axis=1)
        now[..., :n] = 0.0
        found = eliminated(np.zeros_like(now), *frozen, n)._replace(
            rate=np.broadcast_to(first.rate[:, None], (*many, n))
        )
        made: list[Array] = []
        last, result = np.full(len(at), np.inf), np.full(now.shape, np.nan)
        left = np.ones(len(at), np.bool_)
        for k in range(MOST_KEPT):
            if k:
                values = self._at_stages(self._rate, w[:, :n], u, now)
                found = eliminated(values, *frozen, n)
            moves = self._correction(found, partial(_times, inverses), h, now)
            if k == 0:
                scale = np.abs(w) + np.abs(moves).max(axis=1)
                least, spread = self._rounding(first, h, scale, sizes)
                most = _reach(scale[:, :n], h, jacobians)
                left &= (spread <= LARGEST_SPREAD * most).all(axis=1)
                rounding = np.where(least > 0.0, scale / least, 1.0)
                per = np.where(scale > 0.0, 1.0 / scale, 1.0)
            parts = (moves * per[:, None]).reshape(len(at), -1)
            for before, after in pairwise(made):
                parts = parts + (_dot(before, parts) / _dot(before, before))[:, None] * after
            if made:
                factor = 1.0 - _dot(made[-1], parts) / _dot(made[-1], made[-1])
                parts = parts / factor[:, None]
            made.append(parts)
            shares = parts.reshape(now.shape)
            length = np.sqrt(_dot(parts, parts))
            lost = ~np.isfinite(length)
            lost |= ((scale[:, None] == 0.0) & (shares != 0.0)).any(axis=(1, 2))
            now = now + shares * scale[:, None]
            falls = length / last
            done = (length <= ROUNDING) | ((length * falls <= ROUNDING) & np.isfinite(last))
            slow = ~done & (falls > CONTRACTION)
            most = np.abs(shares * rounding[:, None]).max(axis=(1, 2))
            done |= slow & ((length <= FEW_ROUNDINGS * ROUNDING) | (most <= ROUNDING))
            done &= left & ~lost
            result[done] = now[done]
            left &= ~(done | lost | slow)
            if not left.any():
                break
            last = length
        if width > n:  # another solution for z is no stage of this step
            states = self._states(w[:, :n], result)
            there = sides(self._slopes(w[:, :n], u, result), states, n)
            result[(there != first.side[:, None]).any(axis=1)] = np.nan
        W[at] = result

    def _rounding(
        self, first: Eliminated, h: Array, scale: Array, sizes: Array
    ) -> tuple[Array, Array]:
        """What rounding is a share of (K, n + k), and what of it the inverse leaves in x (K, n)."""
        n = first.rate.shape[-1]
        flows, real = h[:, None, None] * first.jacobian, self._method.real
        equations = real * scale[:, :n] + (np.abs(flows) @ scale[:, :n, None])[..., 0]
        inverses = np.abs(inverse(real * np.eye(n) - flows, sizes))
        spread = (inverses @ equations[..., None])[..., 0]
        equations = np.minimum(equations, spread)
        behind = [algebraic_sizes(first, equations, scale[:, n:])] if self._k else []
        return np.concatenate((equations, *behind), axis=1), spread

    def _iterate(
        self, x: Array, u: Array, h: Array, W: Array, at: NDArray[np.intp], damped: bool, most: int
    ) -> None:
        """Newton's iteration for all these states, in place.

        Whole steps converge from far on stiff kinetics; one that leads out of the functions' domain
        is halved. Where they do not converge, as between both sides of a rate that saturates,
        damped ones start again: as short as those of `AlgebraicStates`, by the same test.
        """
        if not at.size:
            return
        n, last = x.shape[1], np.full(len(at), np.inf)
        side = np.ones((len(x), 1))
        values = self._at_stages(self._rate, x[at], u[at], W[at])
        for iteration in range(most):
            J, w = self._slopes(x[at], u[at], W[at]), self._states(x[at], W[at])
            found = eliminated(values, J, w, n)
            moved = np.maximum(np.abs(W[at, :, :n]), h[at, None, None] * np.abs(found.rate))
            matrix = newton_matrix(self._method.A, h[at], found.jacobian)
            rows = _equations(np.abs(x[at]) + moved.max(axis=1), h[at], found.jacobian)
            rows = np.tile(rows, len(self._method.A))
            inverses, solve = inverse(matrix, rows), partial(_solved, matrix, rows)
            moves = self._correction(found, solve, h[at], W[at])
            step, k = moves[..., :n], W.shape[2] - n
            # What rounding of the states and of their flows amounts to in each equation, or what
            # the inverse leaves of it in the stages, if that is less.
            size = np.abs(x[at]) + np.abs(W[at, :, :n] + step).max(axis=1)
            reach = _reach(size, h[at], found.jacobian)
            size = _equations(size, h[at], found.jacobian)
            sizes = np.repeat(size[:, None], len(self._method.A), axis=1)
            spread = _times(np.abs(inverses), sizes)
            sizes = np.minimum(sizes, spread)
            length = share(step, sizes)
            length[(spread > LARGEST_SPREAD * reach[:, None]).any(axis=(1, 2))] = np.nan
            if k:
                behind = algebraic_sizes(found, sizes, np.abs(W[at, :, n:] + moves[..., n:]))
                length = np.maximum(length, share(moves[..., n:], behind))
            done = converged(length, last)
            if iteration == 0:
                side[at] = found.side[:, :1]
            # Another solution for z is no stage of this step.
            lost = np.isnan(length) | (done & (found.side != side[at]).any(axis=1))
            scale = np.abs(W[at]) + np.abs(moves)
            scale[..., :n] = np.abs(x[at])[:, None] + scale[..., :n]
            before, factor = share(moves, scale), np.ones(len(at))
            for _ in range(MOST_HALVINGS):
                trial = W[at] + factor[:, None, None] * moves
                values = self._at_stages(self._rate, x[at], u[at], trial)
                good, less = np.isfinite(values).all(axis=(1, 2)), 0.5 * factor
                if damped:
                    again = self._correction(eliminated(values, J, w, n), solve, h[at], trial)
                    curved = share(again - (1.0 - factor[:, None, None]) * moves, scale)
                    good = straight(curved, factor, before, length)
                    less = shorter(curved, factor, before)
                outside = ~(good | done | lost)
                if not outside.any():
                    break
                factor = np.where(outside, less, factor)
            trial[lost | outside] = np.nan
            W[at] = trial
            left = ~(done | lost | outside)
            if not left.any():
                return
            at, values, last = at[left], values[left], length[left]
        W[at] = np.nan

    def _correction(
        self, found: Eliminated, solve: Callable[[Array], Array], h: Array, W: Array
    ) -> Array:
        """Newton's correction (K, s, n + k) of the stages, by what solves its equations."""
        n = found.rate.shape[-1]
        flows = np.einsum("ij,kjn->kin", self._method.A, found.rate)
        step = -solve(W[..., :n] - h[:, None, None] * flows)
        if W.shape[2] == n:
            return step
        move = found.step + (found.slope @ step[..., None])[..., 0]
        return np.concatenate((step, move), axis=2)


def newton_matrix(A: Array, h: Array, J: Array) -> Array:
    """I - h A_ij J_j, (K, sn, sn), of Jacobians (K, s, n, n)."""
    count, s, n = J.shape[:3]
    blocks = -h[:, None, None, None, None] * A[:, :, None, None] * J[:, None]
    found: Array = blocks.transpose(0, 1, 3, 2, 4).reshape(count, s * n, s * n)
    found += np.eye(s * n)
    return found


def _flows(sizes: Array, h: Array, J: Array) -> tuple[Array, Array]:
    """What states of these sizes (K, n) add to each other, and to themselves, as shares."""
    slopes = h[:, None, None] * np.abs(J).max(axis=1)
    return (slopes @ sizes[..., None])[..., 0], np.diagonal(slopes, axis1=1, axis2=2)


def _equations(sizes: Array, h: Array, J: Array) -> Array:
    """How large the terms of the states' equations are; at rest they cancel."""
    return sizes + _flows(sizes, h, J)[0]


def _reach(sizes: Array, h: Array, J: Array) -> Array:
    """How large states get by single terms: also one that is 0, at rest, has a size."""
    flows, own = _flows(sizes, h, J)
    reach: Array = sizes + flows / (1.0 + own)
    return reach


def _solved(matrix: Array, sizes: Array, stages: Array) -> Array:
    """By elimination, whose residual is small however ill-conditioned the equations are."""
    rows = reciprocals(sizes)
    right = rows * stages.reshape(len(stages), -1)
    try:
        found = np.linalg.solve(matrix * rows[..., None], right[..., None])
    except np.linalg.LinAlgError:  # one of them is singular
        return _times(inverse(matrix, sizes), stages)
    return np.asarray(found.reshape(stages.shape))


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.einsum("ki,ki->k", one, other))


def _times(matrix: Array, stages: Array) -> Array:
    found: Array = (matrix @ stages.reshape(len(stages), -1, 1)).reshape(stages.shape)
    return found
