"""Algebraic states of a model: the solution z(x, u) of 0 = g(x, z, u) that a guess leads to.

A joint function maps w = (x, z) and u to the rate of x and, below it, to g. The linearised
equations are solved for z:

    dz = -(dg/dz)^-1 (g + dg/dx dx),

which leaves a rate of x alone, and its derivative by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# Of states (K, n) and inputs (K, m): values (K, n), or their Jacobians (K, n, n).
Batched = Callable[[Array, Array], Array]

#: Iterations of Newton's method, and halvings of one of its steps.
MOST_ITERATIONS, MOST_HALVINGS = 50, 12
#: Corrections below this share of the unknowns' sizes may end the iteration.
SMALL = 1e-7
#: Corrections below this share are rounding.
ROUNDING = 4e-16
#: How far the equations may be from linear along a step, as a share of it.
CURVED = 0.5
#: Parts of a way along which a solution is followed.
FOLLOWED = 16
#: Factors that shorten a step along which they are less linear: the least and the largest.
LESS = 0.1, 0.5
# By how many powers of 2 equations without a size come below the others, and the largest power.
_NO_SIZE, _LARGEST_EXPONENT = 100.0, 900.0


class Eliminated(NamedTuple):
    """A joint function, linearised at some w, as one of x alone, and what it says of z.

    Attributes
    ----------
    rate : (..., n) array
        The rate at the z that solves the linearised equations.
    jacobian : (..., n, n) array
        Its derivative by x, with z following.
    step : (..., k) array
        Newton's correction of z.
    slope : (..., k, n) array
        The derivative of z by x.
    side : (...) array
        The sign of det(dg/dz), which changes where solutions meet.
    of_states, of_algebraic : (..., k, n) and (..., k, k) array
        How far relative errors of x, and of z, in the equations spread into z.
    """

    rate: Array
    jacobian: Array
    step: Array
    slope: Array
    side: Array
    of_states: Array
    of_algebraic: Array


class AlgebraicStates:
    """z(x, u), by Newton's method from one guess, at many states.

    Steps are so short that the equations are nearly linear along them, as the simplified
    correction at their end shows (Deuflhard, Newton Methods for Nonlinear Problems, section 3.3):
    they stay near the path that leads from the guess to the solution. They never lead to the other
    side of a singular dg/dz, where another solution may be. z is a function of x and u
    alone: NaN where the iteration does not converge.

    Parameters
    ----------
    joint, jacobian : callable
        The joint function and its derivative by w, over w (K, n + k) and inputs (K, m).
    guess : (k,) array
        Where the iteration starts.
    """

    def __init__(self, joint: Batched, jacobian: Batched, guess: Array) -> None:
        self._joint, self._jacobian, self.guess = joint, jacobian, guess

    def complete(self, x: Array, u: Array) -> Array:
        """The states w = (x, z(x, u)) (K, n + k)."""
        w, solved = self.iterated(x, u)
        w[~solved, x.shape[1]:] = np.nan
        return w

    def chained(self, slope: Array, w: Array, u: Array) -> Array:
        """Derivatives by x (K, p, n), of those by w (K, p, n + k) at w = (x, z(x, u))."""
        n = w.shape[1] - self.guess.size
        with np.errstate(all="ignore"):
            of_z = eliminated(np.zeros_like(w), self._jacobian(w, u), w, n).slope
        found: Array = slope[..., :n] + slope[..., n:] @ of_z
        return found

    def iterated(self, x: Array, u: Array) -> tuple[Array, Mask]:
        """The last iterates w (K, n + k), and which of them solve the equations."""
        w = np.concatenate((x, np.broadcast_to(self.guess, (len(x), self.guess.size))), axis=1)
        solved = np.zeros(len(x), np.bool_)
        with np.errstate(all="ignore"):
            self._iterate(w, u, x.shape[1], solved)
        return w, solved

    def followed(self, w: Array, x: Array, u: Array) -> Array:
        """The solution w (n + k,) as x moves to others (K, n) in parts; NaN beyond folds."""
        n = x.shape[1]
        at, solved = np.repeat(w[None], len(x), axis=0), np.ones(len(x), np.bool_)
        with np.errstate(all="ignore"):
            for share in np.linspace(0.0, 1.0, FOLLOWED + 1)[1:]:
                at[:, :n] = w[:n] + share * (x - w[:n])
                found = np.zeros(len(x), np.bool_)
                self._iterate(at, u, n, found)
                solved &= found
        at[~solved, n:] = np.nan
        return at

    def _iterate(self, w: Array, u: Array, n: int, solved: Mask) -> None:
        """Newton's iteration in place."""
        at, last = np.arange(len(w)), np.full(len(w), np.inf)
        values, J = self._joint(w, u), self._jacobian(w, u)
        for _ in range(MOST_ITERATIONS):
            start = w[at]
            found = eliminated(values, J, start, n)
            x, z, step = start[:, :n], start[:, n:], found.step
            length = share(step, algebraic_sizes(found, np.abs(x), np.abs(z + step)))
            scale = np.abs(z) + np.abs(step)
            before = share(step, scale)
            done = converged(length, last)
            lost, factor = np.isnan(length), np.ones(len(at))
            trial = start.copy()
            for _ in range(MOST_HALVINGS):
                trial[:, n:] = z + factor[:, None] * step
                values, slopes = self._joint(trial, u[at]), self._jacobian(trial, u[at])
                again = eliminated(values, J, start, n).step
                curved = share(again - (1.0 - factor[:, None]) * step, scale)
                # Beyond a fold, how far off the equations are says nothing.
                curved[sides(slopes, trial, n) != found.side] = np.nan
                good = straight(curved, factor, before, length)
                outside = ~(good | done | lost)
                if not outside.any():
                    break
                factor = np.where(outside, shorter(curved, factor, before), factor)
            left = ~(lost | outside)
            w[at[left]] = trial[left]
            solved[at] = done & left
            left &= ~done
            if not left.any():
                return
            at, values, J, last = at[left], values[left], slopes[left], length[left]


def of_rows(
    function: Batched, solver: AlgebraicStates, x: Array, u: Array, shape: tuple[int, ...]
) -> Array:
    """A function of w at x (..., n); NaN, without a call, where z has no solution."""
    states = x.reshape(-1, x.shape[-1])
    inputs = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1])).reshape(len(states), u.shape[-1])
    w = solver.complete(states, inputs)
    found, good = np.full((len(w), *shape), np.nan), np.isfinite(w).all(axis=1)
    if good.any():
        found[good] = function(w[good], inputs[good])
    return found.reshape(*x.shape[:-1], *shape)


def converged(length: Array, last: Array) -> Mask:
    """Whether Newton's method is at its end, behind corrections of these shares (K,).

    Rounding stops it, or it converges so fast that the next correction would be rounding.
    """
    fast = np.isfinite(last) & (length * (length / last) ** 2 <= ROUNDING)
    found: Mask = (length <= ROUNDING) | ((length <= SMALL) & ((length > 0.5 * last) | fast))
    return found


def eliminated(values: Array, J: Array, w: Array, n: int) -> Eliminated:
    """The linearised rate of x alone, of joint values (..., n + k) and Jacobians at some w."""
    lead, k = J.shape[:-2], J.shape[-1] - n
    if k == 0:
        nothing = np.zeros((*lead, 0, n))
        side = np.ones(lead)
        return Eliminated(values, J, nothing[..., 0], nothing, side, nothing, nothing[..., :0])
    own = J[..., n:, n:].reshape(-1, k, k)
    right = np.concatenate((J[..., n:, :n], values[..., n:, None]), axis=-1)
    inverses = inverse(own, equation_sizes(J, w, n).reshape(-1, k))
    found = -solved(own, right.reshape(-1, k, n + 1), inverses).reshape(*lead, k, n + 1)
    slope, step, by_algebraic = found[..., :n], found[..., n], J[..., :n, n:]
    spread = np.abs(inverses).reshape(*lead, k, k)
    return Eliminated(
        values[..., :n] + (by_algebraic @ step[..., None])[..., 0],
        J[..., :n, :n] + by_algebraic @ slope, step, slope,
        sides(J, w, n),
        spread @ np.abs(J[..., n:, :n]), spread @ np.abs(J[..., n:, n:]),
    )


def algebraic_sizes(found: Eliminated, states: Array, algebraic: Array) -> Array:
    """What rounding is a share of in each z, from the sizes (..., n) of x and (..., k) of z."""
    sizes: Array = algebraic + (
        found.of_states @ states[..., None] + found.of_algebraic @ algebraic[..., None]
    )[..., 0]
    return sizes


def equation_sizes(J: Array, w: Array, n: int) -> Array:
    """How large the terms (..., k) of the algebraic equations are, by their Jacobians at w."""
    sizes: Array = (np.abs(J[..., n:, :]) @ np.abs(w)[..., None])[..., 0]
    return sizes


def sides(J: Array, w: Array, n: int) -> Array:
    """The sign (...) of det(dg/dz), by Jacobians (..., n + k, n + k) at w."""
    rows = reciprocals(equation_sizes(J, w, n))
    found: Array = np.linalg.slogdet(rows[..., None] * J[..., n:, n:])[0]
    return found


def reciprocals(sizes: Array) -> Array:
    """Powers of 2 (..., d) that bring sizes of equations near 1, so that no unit picks a pivot.

    An equation without a size contains only unknowns without one, and is solved for these: its
    factor is the largest by far.
    """
    there = np.isfinite(sizes) & (sizes > 0.0)
    exponents = np.log2(sizes, where=there, out=np.full(sizes.shape, np.inf))
    least = np.min(exponents, axis=-1, keepdims=True, initial=_LARGEST_EXPONENT)
    exponents = np.clip(
        np.where(there, exponents, least - _NO_SIZE), -_LARGEST_EXPONENT, _LARGEST_EXPONENT
    )
    found: Array = np.exp2(-np.round(exponents))
    return found


def inverse(matrix: Array, sizes: Array) -> Array:
    """The inverses (K, d, d) of equations of these sizes (K, d), or NaN where there is none."""
    rows = reciprocals(sizes)
    found: Array = _inverse(matrix * rows[..., None]) * rows[:, None]
    return found


def _inverse(matrix: Array) -> Array:
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


def solved(matrix: Array, right: Array, inverses: Array) -> Array:
    """The solutions (K, d, c); an inverse alone loses digits where the matrix is stiff."""
    found: Array = inverses @ right
    found += inverses @ (right - matrix @ found)
    return found


def straight(curved: Array, factor: Array, before: Array, length: Array) -> Mask:
    """Whether the equations are nearly linear along steps of these factors (K,).

    ``curved`` says how far the correction after the step is from the one that linear equations
    would give; like ``before``, the length of the whole step, it is a share of the variables'
    sizes. Where ``length`` says that the step is one of the last, any finite ``curved`` will do.
    """
    found: Mask = (curved <= CURVED * factor * before) | ((length <= SMALL) & np.isfinite(curved))
    return found


def shorter(curved: Array, factor: Array, before: Array) -> Array:
    """The factors (K,) at which equations of second order would be nearly linear, within bounds."""
    predicted = CURVED * factor * before / curved
    known = np.isfinite(curved) & (predicted < LESS[1])
    found: Array = factor * np.where(known, np.maximum(predicted, LESS[0]), LESS[1])
    return found


def share(step: Array, size: Array) -> Array:
    """The largest share (K,) that a correction (K, ...) has of sizes that broadcast to it.

    Infinity where one leads to 0.
    """
    shares = np.abs(step) / size
    shares[(step == 0.0) & (size == 0.0)] = 0.0  # a state that stays 0
    found: Array = shares.reshape(len(shares), -1).max(axis=1)
    return found
