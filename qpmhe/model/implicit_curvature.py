"""Second derivatives of implicit steps: exact at the converged stages, by adjoints.

In the terms of `qpmhe.model.implicit_steps`, the Lagrangian of p x⁺ in one substep is

    p (x + sum_i d_i Z_i) - sum_i l_i (Z_i - h sum_j A_ij f_j) + sum_j m_j g_j,

with f_j and g_j at w_j = (x + Z_j, z_j) and u. At multipliers l and m that make it stationary in
all Z and z, its second derivative along the solutions w_j(x, u) is that of p x⁺. Only f and g
contribute, weighed by q_j = h sum_i A_ij l_i and m_j. An output of z is the same without stages.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .algebraic import AlgebraicStates, equation_sizes, inverse, solved
from .evaluation import Evaluator, VirtualMachine
from .expressions import CasadiModel
from .implicit_steps import ImplicitStep, newton_matrix

Array = NDArray[np.float64]
# Of w (K, n + k), u (K, m) and forces (K, n + k + p): the parts of `Curvature` for (f, g, h).
Joint = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


class _Linear(NamedTuple):
    """Derivatives at some w (K, n + k): z follows s = (x, u)."""

    rate: Array  # of f by s
    algebraic: Array  # of z by s
    of_rate: Array  # of f by z alone
    of_residuals: Array  # of g by z alone
    inverses: Array  # of that
    of_output: Array  # of h by z alone
    output_by_input: Array  # of h by u alone


class ImplicitCurvature:
    """The second derivatives of p F, F = (f, h), of a model whose steps solve equations.

    Parameters
    ----------
    model : CasadiModel
        The model.
    joint : callable
        The same for its rate, residuals and output at w, which are expressions.
    """

    def __init__(self, model: CasadiModel, joint: Joint) -> None:
        assert model.how is not None
        one = Evaluator(VirtualMachine(model.equations, False)).one
        functions = partial(one, "f"), partial(one, "f_jacobian")
        self._n, self._m, self._method = model.n, model.m, model.how.collocation
        self._joint, self._slope, self._slope_of_h = joint, functions[1], partial(one, "h_jacobian")
        algebraic = AlgebraicStates(*functions, np.array(model.guess)) if model.guess else None
        self._step = ImplicitStep(*functions, *model.how, algebraic)

    def at(self, x: Array, u: Array, dt: Array, forces: Array) -> tuple[Array, Array, Array]:
        """The parts of `Curvature` at x (K, n), u (K, m), dt (K,) and forces (K, n + p)."""
        n, m = self._n, self._m
        with np.errstate(all="ignore"):
            w = self._step.completed(x, u)
            total, of_output = self._output(w, u, forces[:, n:])
            # Of s at a substep by s at the first.
            substeps, slope = [], np.broadcast_to(np.eye(n + m), (len(x), n + m, n + m))
            for at, W, h in self._step.substeps(w, u, dt):
                own, bend = self._substep(at, W, u, h)
                substeps.append((own, bend, slope))
                slope = np.concatenate((own @ slope, slope[:, n:]), axis=1)
            p = forces[:, :n]
            for own, bend, before in reversed(substeps):
                total = total + before.swapaxes(1, 2) @ bend(p) @ before
                p = (p[:, None] @ own[..., :n])[:, 0]
        by_input = np.concatenate((slope[:, :n, n:], of_output), axis=1)
        return total[:, :n, :n], total[:, :n, n:], by_input

    def _output(self, w: Array, u: Array, forces: Array) -> tuple[Array, Array]:
        """What the output adds to the second derivative, and its derivative by u."""
        n, m = self._n, self._m
        at = self._linear(w, u)
        weights = self._multipliers(at, (forces[:, None] @ at.of_output)[:, 0])
        nothing = np.zeros((len(w), n))
        states = np.broadcast_to(np.eye(n, n + m), (len(w), n, n + m))
        bent = self._bent(w, u, np.concatenate((nothing, weights, forces), axis=1), states, at)
        return bent, at.output_by_input + at.of_output @ at.algebraic[..., n:]

    def _substep(
        self, x: Array, W: Array, u: Array, h: Array
    ) -> tuple[Array, Callable[[Array], Array]]:
        """The derivative of a substep by s, and a function of p to the second one of p x⁺."""
        (A, d, _), (count, s, width), n, m = self._method, W.shape, self._n, self._m
        w = W.copy()
        w[..., :n] += x[:, None]
        w, inputs = w.reshape(count * s, width), np.repeat(u, s, axis=0)
        at = self._linear(w, inputs)
        rates = at.rate.reshape(count, s, n, n + m)
        matrix = newton_matrix(A, h, rates[..., :n])
        right = h[:, None, None, None] * np.einsum("ij,kjab->kiab", A, rates)
        sizes = np.abs(x) + np.abs(W[..., :n]).max(axis=1)
        flows = np.abs(rates[..., :n]).max(axis=1) @ sizes[..., None]
        sizes = sizes + h[:, None] * flows[..., 0]
        inverses = inverse(matrix, np.tile(sizes, s))
        moved = solved(matrix, right.reshape(count, s * n, n + m), inverses)
        moved = moved.reshape(count, s, n, n + m)
        states = np.eye(n, n + m) + moved

        def bend(p: Array) -> Array:
            loads = (d[:, None] * p[:, None]).reshape(count, s * n, 1)
            adjoint = solved(matrix.swapaxes(1, 2), loads, inverses.swapaxes(1, 2))
            q = h[:, None, None] * np.einsum("ij,kin->kjn", A, adjoint.reshape(count, s, n))
            q = q.reshape(count * s, n)
            weights = self._multipliers(at, (q[:, None] @ at.of_rate)[:, 0])
            nothing = np.zeros((count * s, at.output_by_input.shape[1]))
            bent = self._bent(
                w, inputs, np.concatenate((q, weights, nothing), axis=1),
                states.reshape(count * s, n, n + m), at,
            )
            found: Array = bent.reshape(count, s, n + m, n + m).sum(axis=1)
            return found

        return np.eye(n, n + m) + np.einsum("i,kiab->kab", d, moved), bend

    def _linear(self, w: Array, u: Array) -> _Linear:
        n, width = self._n, w.shape[1]
        J = self._slope(w, u)
        slope_of_h = self._slope_of_h(w, u)
        *_, by_input = self._joint(w, u, np.zeros((len(w), width + slope_of_h.shape[1])))
        of_z, residuals = J[:, :n, n:], J[:, n:, n:]
        right = np.concatenate((J[:, n:, :n], by_input[:, n:width]), axis=2)
        inverses = inverse(residuals, equation_sizes(J, w, n))
        algebraic = -solved(residuals, right, inverses)
        rate = np.concatenate((J[:, :n, :n], by_input[:, :n]), axis=2) + of_z @ algebraic
        return _Linear(
            rate, algebraic, of_z, residuals, inverses, slope_of_h[..., n:], by_input[:, width:]
        )

    @staticmethod
    def _multipliers(at: _Linear, of_z: Array) -> Array:
        """The multipliers of g, from what weighed values change by with z."""
        matrix = at.of_residuals.swapaxes(1, 2)
        return -solved(matrix, of_z[..., None], at.inverses.swapaxes(1, 2))[..., 0]

    def _bent(self, w: Array, u: Array, forces: Array, states: Array, at: _Linear) -> Array:
        """The second derivative by s of weighed f, g and h, with x moving as ``states``; 0 by u."""
        n, m, width = self._n, self._m, w.shape[1]
        inputs = np.broadcast_to(np.eye(n + m)[n:], (len(w), m, n + m))
        algebraic = at.algebraic @ np.concatenate((states, inputs), axis=1)
        moved = np.concatenate((states, algebraic, inputs), axis=1)
        own, mixed, _ = self._joint(w, u, forces)
        hessian = np.zeros((len(w), width + m, width + m))
        hessian[:, :width, :width], hessian[:, :width, width:] = own, mixed
        hessian[:, width:, :width] = mixed.swapaxes(1, 2)
        found: Array = moved.swapaxes(1, 2) @ hessian @ moved
        return found
