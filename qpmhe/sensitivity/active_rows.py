"""The active rows of an estimate: inequalities, noise-free directions, soft rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError
from ..estimation.problem import Formulation, Problem
from ..model.constraints import ConstraintFunctions
from ..terms.base import Trial
from ..terms.rows import Rows
from .optimality import OptimalityMatrix

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Blocks = tuple[Array, Array]

# A row is at its side within this share of its scale: a sequence of QPs ends not much nearer.
_AT_SIDE = 1e-5
# A row that would move by less than this share of its scale, were it released, is weakly active.
_WEAK = 1e-4
# Of differences of the derivatives of nonlinear constraints, which may be differences already.
_STEP = 1e-4
# Each round may release rows with a multiplier of the wrong sign.
_ROUNDS = 10


class ActiveRow(NamedTuple):
    """An active inequality of an estimate.

    Attributes
    ----------
    set, row, side, time
        As in `DroppedRow`.
    multiplier : float
        Decrease of J per unit by which the side moves outwards.
    """

    set: str
    row: int
    side: str
    time: int
    multiplier: float

    def __str__(self) -> str:
        return f"{self.side} bound of {self.set}, row {self.row}, at time {self.time}"


class _Side(NamedTuple):
    """One side of the rows of a set, at all stages (K or K + 1, r): ``direction value <= ..``."""

    rows: Rows
    direction: float
    gaps: Array
    most: Array
    quadratic: Array


class HeldRows:
    """Rows as equations ``c = 0``, and soft rows beyond their sides as parts of the cost.

    All rows are oriented so that c <= 0 inside: multipliers are then positive. Arrays of the rows
    that hold the estimate are in the order of their stages.

    Attributes
    ----------
    multipliers, gaps : (R,) array
        Of the rows that hold the estimate: their multipliers, and c.
    penalty_forces, penalty_bent : (K, n + p) and (K, n + p, n + p) array
        First and second derivatives of the penalties of violated soft rows by the residuals.
    penalty_on_states, penalty_bent_states : (K + 1, n) and (K + 1, n, n) array
        The same by the states.
    """

    def __init__(
        self, problem: Problem, formulation: Formulation, trial: Trial, jacobian: Array
    ) -> None:
        count, q, n = jacobian.shape
        self._count, self._q, self._n, self._jacobian = count, q, n, jacobian
        self._along = trial.trajectory, problem.inputs, trial.residuals, -jacobian
        self._functions = functions = formulation.functions
        slopes = None
        if functions is not None:
            slopes = np.where(functions.on_state[:, None], functions.linearised(*self._along)[0], 0)
        sides = _sides(problem, trial)
        parts = [_candidates(one, n, q, functions, slopes) for one in sides]
        found = [one for one in parts if len(one["stage"])]
        none = _nothing(n, q)
        joined = {name: np.concatenate([none[name], *(one[name] for one in found)])
                  for name in none}
        order = np.argsort(joined["stage"], kind="stable")
        self._all = {name: array[order] for name, array in joined.items()}
        every = self._all
        # Violated soft rows.
        self._forced = np.isfinite(every["most"]) & (every["gap"] > _AT_SIDE * every["scale"])
        self._held = ~self._forced
        self._weak: Mask = np.zeros(order.size, np.bool_)
        self._values = np.zeros(order.size)
        self._take()

    def _take(self) -> None:
        """Set what follows from which rows hold the estimate, and which are violated."""
        every, held, forced = self._all, self._held, self._forced
        count, n, q = self._count, self._n, self._q
        self.stage = every["stage"][held]
        self._on_state, self._on_residual = every["on_state"][held], every["on_residual"][held]
        self.gaps = every["gap"][held]
        self._inner = np.minimum(self.stage, count - 1)
        self.on_next = self._on_residual[:, :n]
        self.on_own = self._on_state - np.einsum(
            "rq,rqn->rn", self._on_residual, self._jacobian[self._inner]
        )
        self.multipliers = self._values[held]
        self.penalty_forces = np.zeros((count, q))
        self.penalty_bent = np.zeros((count, q, q))
        self.penalty_on_states = np.zeros((count + 1, n))
        self.penalty_bent_states = np.zeros((count + 1, n, n))
        stage = every["stage"][forced]
        inner, bend = np.minimum(stage, count - 1), 2.0 * every["quadratic"][forced]
        force = every["most"][forced] + bend * every["gap"][forced]
        for name, at, slope, bent in (
            ("on_residual", inner, self.penalty_forces, self.penalty_bent),
            ("on_state", stage, self.penalty_on_states, self.penalty_bent_states),
        ):
            rows = every[name][forced]
            np.add.at(slope, at, force[:, None] * rows)
            np.add.at(bent, at, bend[:, None, None] * rows[:, :, None] * rows[:, None, :])

    def settle(self, blocks: Callable[[], Blocks], gradient: Callable[[Array], Array]) -> None:
        """Compute the multipliers, and release the rows that are not active.

        ``blocks`` gives a positive definite Hessian, ``gradient`` that of J with multipliers.
        """
        every = self._all
        for _ in range(_ROUNDS):
            if not self._held.any():
                return
            own, below = blocks()
            typical = np.diagonal(own, axis1=1, axis2=2)
            matrix = OptimalityMatrix(own, below, self.stage, self.on_own, self.on_next, typical)
            side = -gradient(np.zeros(self.stage.size))[None], -self.gaps[None]
            self._values[self._held] = values = matrix.solve(*side)[1][0]
            # How far each row would move without its multiplier: H's diagonal will do.
            following = np.minimum(self.stage + 1, self._count)
            reach = (self.on_own**2 / typical[self.stage]).sum(axis=1)
            reach += (self.on_next**2 / typical[following]).sum(axis=1)
            most, scale = every["most"][self._held], every["scale"][self._held]
            free = ~every["fixed"][self._held]
            near = np.minimum(np.abs(values), np.abs(values - most)) * reach <= _WEAK * scale
            self._weak[np.flatnonzero(self._held)[near & free]] = True
            released, forced = free & (values < 0.0), free & (values > most)
            places = np.flatnonzero(self._held)
            self._values[places[released]] = 0.0
            self._held[places[released | forced]] = False
            self._forced[places[forced]] = True
            self._take()
            if not (released.any() or forced.any()):
                return

    def curvature(self, scales: Array) -> Array | float:
        """What nonlinear constraints add to the Hessian's diagonal blocks, (K + 1, n, n).

        By differences of their derivatives, with steps in these magnitudes of the states (n,).
        """
        functions, every = self._functions, self._all
        bent = (every["set"] == "constraints") & (self._held | self._forced)
        if functions is None or not bent.any():
            return 0.0
        gaps = 2.0 * every["quadratic"] * every["gap"]
        values = np.where(self._forced, every["most"] + gaps, self._values)[bent]
        forces = np.zeros((self._count + 1, functions.size))
        np.add.at(forces, (every["stage"][bent], every["function"][bent]), values)
        trajectory, *others = self._along
        found = np.empty((self._count + 1, self._n, self._n))
        for j in range(self._n):
            move = _STEP * np.maximum(np.abs(trajectory[:, j]), scales[j])
            ends = []
            for direction in (1.0, -1.0):
                moved = trajectory.copy()
                moved[:, j] += direction * move
                slopes = functions.linearised(moved, *others)[0]
                ends.append(np.where(forces[:, :, None] != 0.0, slopes, 0.0))
            change = np.einsum("kt,kti->ki", forces, ends[0] - ends[1])
            found[:, :, j] = change / (2.0 * move[:, None])
        return np.asarray(0.5 * (found + found.transpose(0, 2, 1)))

    def on_residuals(self, multipliers: Array) -> Array:
        """What multipliers (..., R) add to the derivative by the residuals, (..., K, n + p)."""
        found = np.zeros((*multipliers.shape[:-1], self._count, self._q))
        if self.stage.size:
            parts = np.moveaxis(multipliers[..., None] * self._on_residual, -2, 0)
            np.add.at(np.moveaxis(found, -2, 0), self._inner, parts)  # a view
        return found

    def on_states(self, multipliers: Array) -> Array:
        """What multipliers (R,) add to the derivative by the states themselves, (K + 1, n)."""
        found = np.zeros((self._count + 1, self._n))
        np.add.at(found, self.stage, multipliers[:, None] * self._on_state)
        return found

    def of_residuals(self, change: Array) -> Array:
        """The change (..., R) of c with one of the residuals (..., K, n + p) alone."""
        value: Array = (change[..., self._inner, :] * self._on_residual).sum(axis=-1)
        return value

    def named(self, first: int) -> tuple[tuple[ActiveRow, ...], tuple[ActiveRow, ...]]:
        """The active inequalities, and the weakly active ones."""
        every, inequalities = self._all, ~self._all["fixed"]

        def listed(chosen: NDArray[np.bool_]) -> tuple[ActiveRow, ...]:
            return tuple(
                ActiveRow(
                    str(every["set"][j]), int(every["number"][j]),
                    "upper" if every["direction"][j] > 0.0 else "lower",
                    first + int(every["stage"][j]), float(self._values[j]),
                )
                for j in np.flatnonzero(chosen & inequalities)
            )

        return listed(self._held), listed(self._weak)


def _sides(problem: Problem, trial: Trial) -> Iterator[_Side]:
    """Both sides of all rows of a problem along a trial, hard and soft."""
    constraints, n = problem.constraints, trial.trajectory.shape[1]
    points = {
        "states": trial.trajectory, "disturbances": trial.residuals[:, :n],
        "noises": trial.residuals[:, n:], "constraints": trial.values,
    }
    hard = (
        constraints.states, constraints.disturbances, constraints.noises, constraints.constraints
    )
    for rows in hard:
        if rows is None or (at := points[rows.name]) is None:
            continue
        values = rows.values(at)
        none = np.zeros(values.shape)
        yield _Side(rows, 1.0, values - rows.upper, none + np.inf, none)
        yield _Side(rows, -1.0, rows.lower - values, none + np.inf, none)
    for term in problem.terms:
        for soft in term.soft_rows(trial):
            prices = soft.linear, soft.quadratic
            yield _Side(soft.rows, 1.0, soft.values - soft.upper, *prices)
            yield _Side(soft.rows, -1.0, soft.lower - soft.values, *prices)


def _candidates(
    side: _Side, n: int, q: int, functions: ConstraintFunctions | None, slopes: Array | None
) -> dict[str, Array]:
    """The rows that are at a side or beyond it."""
    rows, direction = side.rows, side.direction
    scale = np.broadcast_to(rows.scale, side.gaps.shape)
    hard = side.most == np.inf
    fixed = hard & np.broadcast_to(rows.lower == rows.upper, side.gaps.shape)
    # An equation is one row, not two.
    chosen = np.where(fixed, direction > 0.0, side.gaps >= -_AT_SIDE * scale)
    chosen &= np.isfinite(side.gaps)
    k, r = np.nonzero(chosen)
    matrix = direction * rows.matrix[r]
    on_state, on_residual = np.zeros((k.size, n)), np.zeros((k.size, q))
    function = np.zeros(k.size, np.intp)
    if functions is not None and slopes is not None and rows.name == "constraints":
        function = rows.components[r]
        other = ~functions.on_state[function]
        if other.any():
            raise InvalidInputError(
                f"row {int(function[other][0])} of the nonlinear constraints is active and "
                "depends on more than the state, so its second derivatives are unknown; write "
                "it as a function of x alone (qpmhe.Constraint), or as a set of disturbances "
                "or noises."
            )
        on_state[...] = np.einsum("rt,rtn->rn", matrix, slopes[k])
    elif rows.name == "states":
        on_state[...] = matrix
    elif rows.name == "disturbances":
        on_residual[:, :n] = matrix
    else:
        on_residual[:, n:] = matrix
    return {
        "stage": k, "on_state": on_state, "on_residual": on_residual, "gap": side.gaps[k, r],
        "scale": scale[k, r], "most": side.most[k, r],
        "quadratic": side.quadratic[k, r], "fixed": fixed[k, r],
        "set": np.full(k.size, rows.name, dtype="U12"), "number": rows.numbers[r],
        "direction": np.full(k.size, direction), "function": function,
    }


def _nothing(n: int, q: int) -> dict[str, Array]:
    """No rows."""
    empty = np.zeros(0)
    return {
        "stage": np.zeros(0, np.intp), "on_state": np.zeros((0, n)),
        "on_residual": np.zeros((0, q)), "gap": empty, "scale": empty, "most": empty,
        "quadratic": empty, "fixed": np.zeros(0, np.bool_), "set": np.zeros(0, "U12"),
        "number": np.zeros(0, np.intp), "direction": empty, "function": np.zeros(0, np.intp),
    }
