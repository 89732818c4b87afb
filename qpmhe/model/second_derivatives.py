"""Second derivatives of f and h: exact from expressions, else by differences of Jacobians."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .evaluation import fixed_call
from .expressions import CasadiModel, import_casadi
from .implicit_curvature import ImplicitCurvature

if TYPE_CHECKING:
    from .model import Model

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
# Steps as shares of magnitudes: of exact Jacobians, and of those that are differences already.
_OF_EXACT, _OF_DIFFERENCES = _EPS ** (1 / 3), _EPS ** (1 / 4)
# Functions for so many numbers of states are kept.
_MOST_KEPT = 64


class Curvature(NamedTuple):
    """Derivatives of F = (f, h) along states, with ``forces`` p that weigh its n + p values.

    Attributes
    ----------
    own : (K, n, n) array
        The second derivative of p F by x.
    mixed : (K, n, m) array
        The derivative of p F by x and u.
    by_input : (K, n + p, m) array
        The derivative of F by u.
    """

    own: Array
    mixed: Array
    by_input: Array


class SecondDerivatives:
    """The second derivatives of a model's f and h.

    They are exact where the model is an expression (see `System.symbolic`). Elsewhere they are
    differences of the Jacobians; steps of an input are shares of its largest value among those
    given, or of 1 where it is zero throughout.

    Parameters
    ----------
    model : Model
        The model; steps of other lengths are one more input of `at`.
    """

    def __init__(self, model: Model) -> None:
        self._model, self._system = model, model.system
        #: Typical magnitudes of the states, (n,).
        self.scales: Array = np.ones(self._system.n) if model.scales is None else model.scales
        self._exact: _Expressions | None = None
        self._implicit: ImplicitCurvature | None = None
        symbolic = model.symbolic
        if symbolic is not None:
            parts = symbolic.equations if symbolic.is_implicit else symbolic
            with suppress(Exception):  # an operation whose derivative CasADi does not know
                self._exact = exact = _Expressions(parts)
                if symbolic.is_implicit:
                    self._implicit = ImplicitCurvature(symbolic, exact.at)

    @property
    def exact(self) -> bool:
        """Whether they are exact."""
        return self._exact is not None

    def at(self, states: Array, inputs: Array, forces: Array) -> Curvature:
        """The derivatives along states (K, n).

        Parameters
        ----------
        states, forces : array
            x (K, n), and p (K, n + p).
        inputs : (K, m) or (K, m + 1) array
            u, with the lengths of the steps in a last column if they are not all usual.
        """
        if self._exact is None:
            return self._differences(states, inputs, forces)
        if self._implicit is None:
            return self._exact.at(states, inputs, forces)
        m, usual = self._system.m, np.full(len(states), self._system.dt or 0.0)
        dt = inputs[:, m] if inputs.shape[1] > m else usual
        return Curvature(*self._implicit.at(states, inputs[:, :m], dt, forces))

    def _differences(self, states: Array, inputs: Array, forces: Array) -> Curvature:
        system, n, m = self._system, self._system.n, self._system.m
        model = self._model.timed if inputs.shape[1] > m else self._model

        def values(x: Array, u: Array) -> Array:
            f, h = np.asarray(model.step(x, u)), np.asarray(model.output(x, u))
            return np.concatenate((f, h), axis=-1)

        def slopes(x: Array, u: Array) -> Array:
            joint = np.concatenate([np.asarray(one) for one in model.linear(x, u)], axis=1)
            return np.asarray(np.einsum("kq,kqn->kn", forces, joint))

        methods = model.methods
        share = _OF_DIFFERENCES if "finite differences" in methods else _OF_EXACT
        sizes = np.maximum(np.abs(states), self.scales)
        largest = np.abs(inputs[:, :m]).max(axis=0, initial=0.0)
        magnitudes = np.broadcast_to(np.where(largest > 0.0, largest, 1.0), (len(states), m))
        at = slopes(states, inputs)
        own, mixed = np.empty((*states.shape, n)), np.empty((*states.shape, m))
        by_input = np.empty((*forces.shape, m))
        bounds = (-np.inf, np.inf) if system.states is None else (
            system.states.lower, system.states.upper
        )
        for j in range(n):
            step = share * sizes[:, j : j + 1]
            move = step * np.eye(n)[j]
            # Second differences leave no bound of X: a model need not be defined beyond.
            below = ((states - move) < bounds[0]).any(axis=1, keepdims=True)
            above = ((states + move) > bounds[1]).any(axis=1, keepdims=True)
            side = np.where(above, -1.0, np.where(below, 1.0, 0.0))
            inwards = side != 0.0
            near = slopes(states + np.where(inwards, side, 1.0) * move, inputs)
            far = slopes(states + np.where(inwards, 2.0 * side, -1.0) * move, inputs)
            rise = np.where(inwards, side * (4.0 * near - far - 3.0 * at), near - far)
            own[:, :, j] = rise / (2.0 * step)
        for j in range(m):
            move = np.zeros_like(inputs)
            move[:, j] = share * magnitudes[:, j]
            ahead, behind, double = inputs + move, inputs - move, 2.0 * move[:, j : j + 1]
            mixed[:, :, j] = (slopes(states, ahead) - slopes(states, behind)) / double
            by_input[:, :, j] = (values(states, ahead) - values(states, behind)) / double
        return Curvature(0.5 * (own + own.transpose(0, 2, 1)), mixed, by_input)


class _Expressions:
    """The derivatives of a model whose f and h are expressions, by CasADi's virtual machine."""

    def __init__(self, model: CasadiModel) -> None:
        self._model, self._function = model, _function(model)
        self._calls: dict[int, tuple[tuple[Array, ...], Curvature, Any]] = {}

    def at(self, states: Array, inputs: Array, forces: Array) -> Curvature:
        """See `SecondDerivatives.at`."""
        count, m = len(states), self._model.m
        if count not in self._calls:
            if len(self._calls) >= _MOST_KEPT:
                self._calls.clear()
            self._calls[count] = self._call(count)
        (x, u, p), found, call = self._calls[count]
        x[...], p[...] = states, forces
        u[:, : inputs.shape[1]] = inputs
        if inputs.shape[1] == m:
            u[:, m] = self._model.dt or 0.0
        if not call():
            return Curvature(*(np.full_like(array, np.nan) for array in found))
        return Curvature(*(array.copy() for array in found))

    def _call(self, count: int) -> tuple[tuple[Array, ...], Curvature, Any]:
        n, p, m = self._model.n, self._model.p, self._model.m
        arguments = tuple(np.zeros((count, size)) for size in (n, m + 1, n + p))
        found = Curvature(*(
            np.zeros((count, *shape)) for shape in ((n, n), (n, m), (n + p, m))
        ))
        function = self._function.map(count) if count > 1 else self._function
        return arguments, found, fixed_call(function, arguments, found)


def _function(model: CasadiModel) -> Any:
    """A function of x, (u, dt) and p to the parts of `Curvature`, each stored by rows."""
    ca = import_casadi()
    kind = ca.SX if model.f.is_a("SXFunction") and model.h.is_a("SXFunction") else ca.MX
    x, u, dt = kind.sym("x", model.n), kind.sym("u", model.m), kind.sym("dt")
    forces = kind.sym("p", model.n + model.p)
    values = ca.vertcat(model.step()(x, u, dt), model.h(x, u))
    slope = ca.gradient(ca.dot(forces, values), x)
    found = [ca.jacobian(slope, x), ca.jacobian(slope, u), ca.jacobian(values, u)]
    # Transposed: CasADi stores by columns, NumPy by rows.
    made = ca.Function("curvature", [x, u, dt, forces], [ca.densify(one.T) for one in found])
    given = kind.sym("u", model.m + 1)
    results = made.call([x, given[: model.m], given[model.m], forces])
    return ca.Function("curvature", [x, given, forces], results)
