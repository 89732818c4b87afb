"""Nonlinear constraints g(x, u, w, v) <= 0, evaluated and differentiated along a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .constraint import BoundConstraint, Constraint
from .expressions import import_casadi
from .points import Points
from .sets import ConvexSet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviations of d that a state moves by in a window, as a rule at most.
_WANDERED = 30.0
# Points at which constraints are compared with another system's.
_POINTS = 5
# Rows with a scale beyond 2 to the power of this are multiplied, so that slopes can be squared; and
# the largest power of two with an inverse.
_EXPONENT, _MOST = 300, 1000


class ConstraintFunctions:
    """All nonlinear constraints of a system, as rows one below the other.

    Attributes
    ----------
    size : int
        Number T of rows of all constraints.
    soft : (T,) bool array
        Which rows are soft.
    linear, quadratic : (T,) array
        Their penalties; 0 for hard rows.
    on_state : (T,) bool array
        Which rows are functions of x alone, and hold at the newest state as well.
    parts : set of str
        Which of x, w and v they are functions of.
    """

    def __init__(
        self, constraints: Sequence[Constraint], sizes: dict[str, int],
        bounds: dict[str, ConvexSet | None],
    ) -> None:
        self._n, self._r, self._p, self._m = (sizes[name] for name in ("x", "w", "v", "u"))
        # Maps d = x+ - f(x) to w; None for the identity.
        self._through: Array | None = None
        self._bound = [
            BoundConstraint(k, one, sizes, bounds) for k, one in enumerate(constraints)
        ]
        ends = np.cumsum([0, *(one.size for one in constraints)]).tolist()
        self._places = [slice(a, b) for a, b in pairwise(ends)]
        self.size: int = ends[-1]
        counts = [one.size for one in constraints]
        chosen = [one.penalty or (np.zeros(one.size), np.zeros(one.size)) for one in constraints]
        self.linear: Array = np.concatenate([one[0] for one in chosen])
        self.quadratic: Array = np.concatenate([one[1] for one in chosen])
        self._given = self.linear, self.quadratic
        #: What rows are multiplied by, a power of two, where their scale is out of range.
        self._factor: Array = np.ones(self.size)
        self.soft: Mask = np.repeat([one.penalty is not None for one in constraints], counts)
        self.on_state: Mask = np.repeat([one.on_state for one in self._bound], counts)
        self.parts = {name for one in self._bound for name in one.parts}
        #: The unit (T,) in which a miss of a row is measured; see `use_scales`.
        self.scale: Array = np.ones(self.size)
        self.is_scaled = False

    def copy(self) -> ConstraintFunctions:
        """The same, whose functions may come to be called in other ways."""
        other = copy(self)
        other._bound = [one.copy() for one in self._bound]
        return other

    def as_written(self) -> ConstraintFunctions:
        """The same, with all functions called as they are written."""
        other = copy(self)
        other._bound = [one.as_written() for one in self._bound]
        return other

    @property
    def are_algebraic(self) -> bool:
        """Whether all of them are sets of algebraic states."""
        return all(one.algebraic is not None for one in self._bound)

    @property
    def is_traced(self) -> bool:
        """Whether some are evaluated by expressions that may become wrong."""
        return any(one.trace is not None for one in self._bound)

    @property
    def traced_functions(self) -> tuple[Callable[..., Any], ...]:
        """Those of them, as the user wrote them, that are evaluated by expressions."""
        return tuple(one.written for one in self._bound if one.trace is not None)

    def fault(self, where: Points) -> str:
        """Which one differs from its expression at these states and inputs, and how.

        Blank if none does. Compared without disturbance and noise.
        """
        for one in self._bound:
            text = one.fault([(one.joined(self._start(x)), u) for x, u in where])
            if text:
                return f"{one.function.name} has changed since it was traced: {text}"
        return ""

    @property
    def untraced(self) -> str:
        """Which one has no expression, and why; blank where all have one."""
        return next(
            (f"{one.function.name} has no C form ({one.untraced})" for one in self._bound
             if one.trace is None and one.algebraic is None), ""
        )

    def expression(self) -> Any:
        """All of them as a casadi.Function of (x, w, v), one below the other, u, and z.

        z is empty where there are no sets of z.
        """
        ca = import_casadi()
        n, r, p = self._n, self._r, self._p
        sets = [one.algebraic for one in self._bound if one.algebraic is not None]
        k = sets[0].matrix.shape[1] if sets else 0
        sizes = {"s": n + r + p, "u": self._m, "z": k}
        (s, u, z), values = (ca.SX.sym(name, size) for name, size in sizes.items()), []
        parts = {"x": s[:n], "w": s[n : n + r], "v": s[n + r :]}
        for one in self._bound:
            if one.algebraic is not None:
                values.append(one.algebraic.expression(z))
                continue
            assert one.trace is not None
            values.append(one.trace.function(ca.vertcat(*(parts[k] for k in one.parts)), u))
        return ca.Function("constraints", [s, u, z], [ca.densify(ca.vertcat(*values))])

    def numbers(self) -> dict[str, NDArray[Any]]:
        """What else the step in C knows of them."""
        counts, through = [one.size for one in self._bound], self._through
        return {
            # C has no arrays of length 0; the sizes say where it stands for the identity.
            "through": np.ones(1) if through is None else through.ravel(),
            "scale": self.scale, "factor": self._factor, "deviations": self._deviations,
            "group": np.repeat(np.arange(len(counts)), counts),
            "on_state": self.on_state.astype(np.intp),
            "touched": self._touched.astype(np.intp).ravel(),
        }

    @property
    def of_directions(self) -> int:
        """Components of w where it is not d = x+ - f(x) itself, else 0."""
        return 0 if self._through is None else self._r

    @cached_property
    def _touched(self) -> Mask:
        """Which rows depend on each component of v."""
        return np.vstack([one.touched(self._p) for one in self._bound])

    def _along(
        self, trajectory: Array, inputs: Array, residuals: Array
    ) -> Iterator[tuple[BoundConstraint, slice, slice, Array, Array]]:
        """Each constraint, its stages and its rows, and its arguments s and u at these stages."""
        d, v, u = residuals[:, : self._n], residuals[:, self._n :], inputs[:, : self._m]
        w = d if self._through is None else d @ self._through.T
        parts = {"x": trajectory[:-1], "w": w, "v": v}
        for one, place in zip(self._bound, self._places, strict=True):
            if one.on_state:  # u is any at the newest state: it is not read
                yield one, slice(None), place, trajectory, np.vstack((u, np.zeros((1, self._m))))
            else:
                yield one, slice(-1), place, one.joined(parts), u

    def _start(self, state: Array) -> dict[str, Array]:
        return {"x": state, "w": np.zeros(self._r), "v": np.zeros(self._p)}

    def _slopes(self, minus_jacobian: Array) -> tuple[dict[str, Array], Array]:
        """Derivatives of x, w and v of each stage by its state, and of w by the next one."""
        n = self._n
        by_state, through = minus_jacobian[:, :n], np.eye(n)
        if self._through is not None:
            by_state, through = self._through @ by_state, self._through
        return {"x": np.eye(n), "w": by_state, "v": minus_jacobian[:, n:]}, through

    def check(self, x: Array, u: Array) -> None:
        """Check that all are finite at a state and input, with no disturbance and no noise."""
        for one in self._bound:
            s = one.joined(self._start(x))
            one.function.check(s, u)
            one.jacobian.check(s, u)

    def use_scales(
        self, start: Array, x: Array, d: Array, v: Array, through: Array | None
    ) -> None:
        """Take the rows' scale around a start, by deviations x (n,) and covariances of d and v.

        A state's typical magnitude is its start's or what disturbances move it by, if these are
        smaller than its deviation.

        ``through`` (r, n) maps d = x+ - f(x) to w; None for the identity.
        """
        self._through = through
        w = np.sqrt((d if through is None else through @ d @ through.T).diagonal())
        v = np.sqrt(v.diagonal())
        usual = np.maximum(np.abs(start), _WANDERED * np.sqrt(d.diagonal()))
        usual = np.where(usual > 0.0, np.minimum(x, usual), x)
        found, u = [], np.zeros(self._m)
        self._deviations, self.is_scaled = np.concatenate((x, w, v)), True
        for one in self._bound:
            deviations = one.joined({"x": x, "w": w, "v": v})
            one.use_scales(deviations)
            s = one.joined(self._start(start))
            one.jacobian.check(s, u)
            typical = one.joined({"x": usual, "w": w, "v": v})
            found.append(one.scale(s, deviations, typical, u))
        scale = np.concatenate(found)
        exponents = np.where(np.abs(np.frexp(scale)[1]) < _EXPONENT, 0, np.frexp(scale)[1])
        self._factor = factor = np.ldexp(1.0, -exponents.clip(-_MOST, _MOST))
        self.scale = scale * factor
        linear, quadratic = self._given
        with np.errstate(over="ignore"):
            quadratic = quadratic / factor / factor
        most = np.finfo(np.float64).max
        self.linear, self.quadratic = linear / factor, np.minimum(quadratic, most)

    def counting(self, count: int, observed: Mask | None) -> Mask:
        """Which rows hold at each stage (K + 1, T): none on missing outputs.

        Parameters
        ----------
        count : int
            Number K of stages; the newest state is one more point.
        observed : (K, p) bool array or None
            Which components of y are there; None for all.
        """
        counts = np.ones((count + 1, self.size), np.bool_)
        counts[-1] = self.on_state
        if observed is not None:
            counts[:-1] &= ~((~observed).astype(np.intp) @ self._touched.T.astype(np.intp) > 0)
        return counts

    def values(self, trajectory: Array, inputs: Array, residuals: Array) -> Array:
        """Values along a trajectory (K + 1, n), (K + 1, T); never raises.

        Infinity stands where a function raises or is not finite, and 0 at the newest state for
        rows that do not hold there.
        """
        found = np.zeros((len(trajectory), self.size))
        for one, stages, place, s, u in self._along(trajectory, inputs, residuals):
            found[stages, place] = one.values(s, u)
        found *= self._factor
        return found

    def linearised(
        self, trajectory: Array, inputs: Array, residuals: Array, minus_jacobian: Array
    ) -> tuple[Array, Array]:
        """Derivatives with respect to each state and the next one, (K + 1, T, n) and (K, T, n).

        ``minus_jacobian`` (K, n + p, n) is the derivative of the residuals (w, v) with respect
        to x. Rows that cannot be differentiated are not finite.
        """
        count, n = len(residuals), self._n
        own, following = np.zeros((count + 1, self.size, n)), np.zeros((count, self.size, n))
        slopes, through = self._slopes(minus_jacobian)
        for one, _, place, s, u in self._along(trajectory, inputs, residuals):
            slope = one.derivatives(s, u) * self._factor[place, None]
            if one.on_state:
                own[:, place] = slope
                continue
            for name, columns in one.parts.items():
                own[:-1, place] += slope[:, :, columns] @ slopes[name]
            if "w" in one.parts:
                following[:, place] = slope[:, :, one.parts["w"]] @ through
        return own, following

    def curvature(
        self, trajectory: Array, inputs: Array, residuals: Array, minus_jacobian: Array,
        forces: Array,
    ) -> tuple[Array, Array, Array]:
        """What the curvature of ``forces g`` adds to a Hessian in the increments of the states.

        ``forces`` (K + 1, T) are multipliers >= 0 of the rows. The blocks are those of each state
        (K + 1, n, n), those below them, (K, n, n), and those of each next state, (K, n, n).
        """
        count, n = len(residuals), self._n
        own, below, following = (np.zeros((count + k, n, n)) for k in (1, 0, 0))
        slopes, through = self._slopes(minus_jacobian)
        for one, stages, place, s, u in self._along(trajectory, inputs, residuals):
            bent = one.curvature(s, u, (forces * self._factor)[stages, place])
            if one.on_state:
                own += bent
                continue
            moved = np.zeros((count, bent.shape[1], n))  # s by the state
            for name, columns in one.parts.items():
                moved[:, columns] = slopes[name]
            half = bent @ moved
            own[:-1] += moved.transpose(0, 2, 1) @ half
            if "w" in one.parts:
                columns = one.parts["w"]
                below += through.T @ half[:, columns]
                following += through.T @ bent[:, columns, columns] @ through
        return own, below, following

    def described(self) -> Array:
        """Penalties and values at some points, one row each, to compare with another's."""
        found = [self.soft.astype(np.float64), *self._given]
        for k in range(_POINTS):
            values = [one.probed(k) for one in self._bound]
            found.append(np.concatenate(values))
        return np.array(found)

    def failure(self, trajectory: Array, inputs: Array, residuals: Array) -> str:
        """What a constraint raised along a trajectory, as a message; blank if nothing."""
        for one, _, _, s, u in self._along(trajectory, inputs, residuals):
            if text := one.failure(s, u):
                return text
        return ""
