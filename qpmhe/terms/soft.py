"""The soft sets' and soft constraints' term of J, and its model: QPs with slack variables."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP, Solution, SolveStatus

from .._linalg import inverse
from ..costs import Cost
from ..model.system import System
from .active_rows import Inequalities, StageRows, minimised
from .base import (
    QuadraticModel,
    SoftRows,
    Term,
    TermForm,
    Trial,
    WindowData,
    WindowView,
)
from .rows import Rows, function_rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Their name in C, where they are rows of QPs and not terms in the first state.
SOFT = "soft"

#: A second-order correction is lengthened by this share of itself, to end inside the set.
BEYOND = 0.1

# Curvature that a slack has at least, as a share of its linear penalty per scale of its row. It
# holds the slack near its present value, so that it vanishes where the sequence converges.
_CURVATURE = 1e-2


class _Part(NamedTuple):
    """The soft rows of one set: of ``states``, ``disturbances``, ``noises`` or ``constraints``."""

    rows: Rows
    place: slice  # among all soft rows
    penalties: tuple[Array, Array]


class Penalties:
    """All soft rows of an estimator: of X, W, V and of the nonlinear constraints.

    At each of the K + 1 states of a window there are R rows; those on w, v and on whole samples
    do not count at the newest state.
    """

    name: ClassVar[str] = "soft sets or soft constraints"

    def __init__(self, system: System, cost: Cost, prior_covariance: Array) -> None:
        self.parts: list[_Part] = []
        self.size, self._n, self._discounted = 0, system.n, cost.discount < 1.0
        self._system = system
        for name, covariance in (
            ("states", prior_covariance), ("disturbances", inverse(cost.disturbance)),
            ("noises", inverse(cost.noise)),
        ):
            soft = system.soft.get(name)
            if soft is None:
                continue
            through = cost.space.to_disturbances if cost.space and name == "disturbances" else None
            if through is not None:
                covariance = through @ covariance @ through.T
            rows = Rows(name, soft.convex, covariance)
            linear, quadratic = soft.linear[rows.numbers], soft.quadratic[rows.numbers]
            if through is not None:
                none = np.zeros((system.n, 0))
                rows = rows.mapped(through, none, np.zeros(len(rows.matrix), np.bool_))
            self._add(rows, linear, quadratic)
        functions = self.functions = system.constraints
        if functions is not None and functions.soft.any():
            rows = function_rows(functions.soft, functions.scale)
            self._add(rows, functions.linear[rows.numbers], functions.quadratic[rows.numbers])
        self._windows: dict[int, WindowPenalties] = {}

    @cached_property
    def softened(self) -> Softened:
        """The QPs with slack variables; there is one, which each use overwrites."""
        return Softened(self, self._n)

    def _add(self, rows: Rows, linear: Array, quadratic: Array) -> None:
        place = slice(self.size, self.size + len(rows.matrix))
        self.parts.append(_Part(rows, place, (linear, quadratic)))
        self.size = place.stop

    @staticmethod
    def belongs(system: System, cost: Cost) -> bool:
        """Whether the system has soft sets or soft constraints."""
        del cost
        functions = system.constraints
        return bool(system.soft) or (functions is not None and bool(functions.soft.any()))

    @classmethod
    def of(cls, system: System, cost: Cost, prior: Array, basis: Array) -> Penalties | None:
        """The soft rows of a system; None where its soft sets have no sides."""
        del basis
        found = cls(system, cost, prior)
        return found if found.size else None

    def rows_of(self, name: str) -> Rows | None:
        """The soft rows of a set; None where it has no sides, or is hard."""
        return next((part.rows for part in self.parts if part.rows.name == name), None)

    @property
    def c_form(self) -> TermForm:
        """The penalties of all rows of a stage: of W, V, X and g, infinite for hard ones."""
        penalties = []
        for name in ("disturbances", "noises", "states"):
            one, soft = self._system.set_of(name), self._system.soft.get(name)
            if soft is not None:
                penalties.append((soft.linear, soft.quadratic))
            elif one is not None:
                count = one.dimension + len(one.matrix)
                penalties.append((np.full(count, np.inf), np.zeros(count)))
        functions = self.functions
        if functions is not None:
            hard = np.where(functions.soft, 0.0, np.inf)
            penalties.append((functions.linear + hard, functions.quadratic))
        linear, quadratic = (np.concatenate(one) for one in zip(*penalties, strict=True))
        return TermForm(SOFT, {"linear": linear, "quadratic": quadratic})

    def of_window(self, window: WindowData, view: WindowView) -> Penalty:
        """The soft rows of a window."""
        return Penalty(self, self._rows_of(window, len(view.candidate) - 1))

    def _rows_of(self, window: WindowData, count: int) -> WindowPenalties:
        """Sides and penalties of a window; rows on missing outputs do not count.

        The newest state has the sets of the last stage.
        """
        observed = window.observed if window.has_special_weights else None
        own = window.conditions if window.has_own_bounds else None
        usual = observed is None and own is None
        if usual and count in self._windows:
            return self._windows[count]
        lower, upper = np.full((2, count + 1, self.size), np.inf)
        np.negative(lower, out=lower)
        linear, quadratic = np.zeros((2, count + 1, self.size))
        for rows, place, penalties in self.parts:
            if own is not None and rows.name != "constraints":
                sets = [getattr(one, rows.name) for one in own]
                rows = rows.with_sides([*sets, sets[-1]])
            counts = np.ones((count + 1, len(rows.matrix)), np.bool_)
            if rows.name == "constraints" and self.functions is not None:
                counts = self.functions.counting(count, observed)[:, rows.components]
            elif rows.name != "states":
                counts[-1] = False
                if rows.name == "noises" and observed is not None:
                    counts[:-1] = ~rows.touching(~observed)
            lower[:, place] = np.where(counts, rows.lower, -np.inf)
            upper[:, place] = np.where(counts, rows.upper, np.inf)
            linear[:, place], quadratic[:, place] = penalties
        if self._discounted:
            factors = np.append(window.discounts[1:], 1.0)[:, None]
            linear, quadratic = factors * linear, factors * quadratic
        made = WindowPenalties(lower, upper, linear, quadratic)
        if usual:
            self._windows[count] = made
        return made

    def values(self, trajectory: Array, residuals: Array, functions: Array | None) -> Array:
        """The rows' values along a trajectory, (K + 1, R); 0 where they do not count."""
        values, n = np.zeros((len(trajectory), self.size)), self._n
        for rows, place, _ in self.parts:
            if rows.name == "states":
                values[:, place] = rows.values(trajectory)
            elif rows.name == "disturbances":
                values[:-1, place] = rows.values(residuals[:, :n])
            elif rows.name == "noises":
                values[:-1, place] = rows.values(residuals[:, n:])
            elif functions is not None:
                values[:, place] = rows.values(functions)
        return values

    def linearised(
        self, minus_jacobian: Array, functions: tuple[Array, Array] | None
    ) -> tuple[Array, Array]:
        """Derivatives of the rows with respect to each state and the next, both (K + 1, R, n)."""
        count, n = len(minus_jacobian), self._n
        own, following = np.zeros((2, count + 1, self.size, n))
        for rows, place, _ in self.parts:
            if rows.name == "states":
                own[:, place] = rows.matrix
            elif rows.name == "disturbances":
                own[:-1, place] = rows.matrix @ minus_jacobian[:, :n]
                following[:-1, place] = rows.matrix
            elif rows.name == "noises":
                own[:-1, place] = rows.matrix @ minus_jacobian[:, n:]
            elif functions is not None:
                own[:, place] = functions[0][:, rows.components]
                following[:-1, place] = functions[1][:, rows.components]
        return own, following

    @property
    def scale(self) -> Array:
        """The unit (R,) of each row."""
        return np.concatenate([part.rows.scale for part in self.parts])


class WindowPenalties(NamedTuple):
    """The soft rows of one window: sides and penalties (K + 1, R), discount included."""

    lower: Array
    upper: Array
    linear: Array
    quadratic: Array

    def misses(self, values: Array) -> Array:
        """By how much values (K + 1, R) of the rows miss their sides."""
        return np.asarray(np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0))

    def cost(self, misses: Array) -> float:
        """The penalty of these misses; infinity where one is not finite."""
        cost = float((misses * (self.linear + self.quadratic * misses)).sum())
        return math.inf if math.isnan(cost) else cost


class Penalty(Term):
    """What the soft rows of one window add to J.

    Attributes
    ----------
    window : WindowPenalties
        Their sides and penalties.
    """

    def __init__(self, penalties: Penalties, window: WindowPenalties) -> None:
        self._penalties, self.window = penalties, window

    def _values(self, trial: Trial) -> Array:
        return self._penalties.values(trial.trajectory, trial.residuals, trial.values)

    def cost(self, trial: Trial) -> float:
        """See `Term.cost`; sets the penalty of the trial."""
        trial.penalty = penalty = self.window.cost(self.window.misses(self._values(trial)))
        return penalty

    def add_model(self, model: QuadraticModel, trial: Trial) -> None:
        """Nothing, as most soft rows are not violated: `Softened` takes them around the trial."""
        slopes = self._penalties.linearised(model.span.minus_jacobian, model.slopes)
        self._penalties.softened.around(self.window, self._values(trial), slopes)

    def magnitude(self, trial: Trial) -> float:
        """0, as nothing cancels."""
        return 0.0

    def soft_rows(self, trial: Trial) -> Iterator[SoftRows]:
        """See `Term.soft_rows`."""
        values, window = self._values(trial), self.window
        for rows, place, _ in self._penalties.parts:
            count = len(values) - (rows.name in ("disturbances", "noises"))
            yield SoftRows(rows, *(one[:count, place] for one in (values, *window)))


class Softened:
    """QPs with a slack variable for each soft row, made from QPs without these rows.

    The unknowns of stage k are d_k and the misses s_k >= 0 of the R rows; each soft row gives two
    rows, one for each side: ``lower <= row + s`` and ``row - s <= upper``.
    """

    def __init__(self, penalties: Penalties, n: int) -> None:
        self._n, self._penalties, self._size = n, penalties, penalties.size
        self._scale = penalties.scale
        self._qp: QP | None = None
        self._last: Array | None = None  # forces in the sequence's last QP
        #: The same in other unknowns, see `along`.
        self.stacked: Softened | None = None
        #: Values of the rows at d = 0, (K + 1, R), and their derivatives, as in `Penalties`.
        self.values: Array
        self._own: Array
        self._following: Array
        self._window: WindowPenalties
        self._shift: Array  # by which `bend` has shifted the values

    def around(
        self, window: WindowPenalties, values: Array, derivatives: tuple[Array, Array]
    ) -> None:
        """Take the soft rows around a trajectory."""
        self._window, self.values = window, values
        self._own, self._following = derivatives
        self._shift = np.zeros(values.shape)

    def at(self, step: Array) -> Array:
        """The linearised rows (K + 1, R) at a step (K + 1, n)."""
        value: Array = self.values + np.matmul(self._own, step[:, :, None])[:, :, 0]
        value[:-1] += np.matmul(self._following[:-1], step[1:, :, None])[:, :, 0]
        return value

    def misses(self, step: Array) -> Array:
        """The misses of the linearised rows; rows that cannot be linearised have none."""
        return np.nan_to_num(self._window.misses(self.at(step)), nan=0.0, posinf=0.0)

    def penalty(self, step: Array) -> float:
        """The penalty of the linearised rows at a step."""
        return self._window.cost(self.misses(step))

    def along(self, step: Array, directions: Array) -> Softened:
        """The same for QPs in z, with d = step + directions z: all rows belong to one stage.

        ``directions`` is (K + 1, n, N).
        """
        stacked, size = self.stacked, directions.shape[-1]
        if stacked is None or stacked._n != size or stacked._size != self.values.size:
            self.stacked = stacked = copy(self)
            stacked._n, stacked._size = size, self.values.size
            stacked._qp = stacked._last = None
            stacked._scale = np.tile(self._scale, len(step))
        own = self._own @ directions
        own[:-1] += self._following[:-1] @ directions[1:]
        stacked._own = own.reshape(1, -1, size)
        stacked._following = np.zeros_like(stacked._own)
        stacked.values = self.at(step).reshape(1, -1)
        stacked._window = WindowPenalties(*(one.reshape(1, -1) for one in self._window))
        return stacked

    def bend(self, values: Array, step: Array, curvature: Array) -> None:
        """Shift the rows by what their linearisation misses at a step that leads to these values.

        They are tightened by a share of that, too, as hard rows are: a step that ends outside by
        the third order costs its linear penalty, which may be more than the step gains.
        ``curvature`` (K, n + p) is what linearised residuals miss, without earlier shifts and less
        whole turns of angles.
        """
        shift, n = values - self.at(step), self._n
        for rows, place, _ in self._penalties.parts:
            if rows.name in ("disturbances", "noises"):
                part = curvature[:, :n] if rows.name == "disturbances" else curvature[:, n:]
                shift[:-1, place] = rows.values(part) - self._shift[:-1, place]
        self.values, self._shift = self.values + shift, self._shift + shift
        window = self._window
        margin = np.nan_to_num(BEYOND * np.abs(shift), nan=0.0, posinf=0.0)
        margin = np.where(window.upper - window.lower > 4.0 * margin, margin, 0.0)
        self._window = window._replace(lower=window.lower + margin, upper=window.upper - margin)

    def lifted(self, base: QP) -> QP:
        """The QP with slack variables, its objective half of J as the base's is."""
        n, rows, size, window = self._n, base.rows, self._size, self._window
        qp = self._qp
        if qp is None or qp.stages != base.stages or qp.rows != rows + 2 * size:
            qp = self._qp = self._new(base)
        panel = np.append(base.band.reshape(base.stages, -1), np.zeros((base.stages, 1)), axis=1)
        panel.take(self._index, axis=1, out=qp.band, mode="clip")
        half = 0.5 * window.linear
        own, following, lower, upper = self._usable()
        curvature = np.maximum(window.quadratic, half * self._least(base, own, following))
        qp.band[:, n:, 0] = curvature
        present = np.nan_to_num(window.misses(self.values), nan=0.0, posinf=0.0)
        qp.gradient[:, :n] = base.gradient
        # What the curvature exceeds the quadratic penalty by acts on the slack's change alone.
        needed = np.isfinite(lower) | np.isfinite(upper)
        qp.gradient[:, n:] = np.where(needed, half - (curvature - window.quadratic) * present, 0.0)
        if base.bounded:
            qp.lower[:, :n], qp.upper[:, :n] = base.lower, base.upper
        else:
            qp.lower[:, :n], qp.upper[:, :n] = -np.inf, np.inf
        qp.row_own[:, :rows, :n], qp.row_next[:, :rows, :n] = base.row_own, base.row_next
        qp.row_lower[:, :rows], qp.row_upper[:, :rows] = base.row_lower, base.row_upper
        for first in (rows, rows + size):
            place = slice(first, first + size)
            qp.row_own[:, place, :n], qp.row_next[:, place, :n] = own, following
        qp.row_lower[:, rows : rows + size], qp.row_upper[:, rows + size :] = lower, upper
        return qp

    def _least(self, base: QP, own: Array, following: Array) -> Array:
        """The least curvature of a slack, as a share of its linear penalty.

        Beside a vague prior, the scale of a row on states is far longer than any step: the
        Hessian's diagonal says how far the row would give way.
        """
        inverse_diagonal = 1.0 / base.band[:, :, 0]
        pliancy = np.matmul(own**2, inverse_diagonal[:, :, None])[:, :, 0]
        pliancy[:-1] += np.matmul(following[:-1] ** 2, inverse_diagonal[1:, :, None])[:, :, 0]
        deviation, scale = np.sqrt(pliancy), self._scale
        shorter = (deviation > 0.0) & (deviation < scale)
        return np.asarray(_CURVATURE / np.where(shorter, deviation, scale))

    def _usable(self) -> tuple[Array, Array, Array, Array]:
        """Derivatives by the state and the next, and sides, of rows that can be linearised."""
        window, values = self._window, self.values
        usable = np.isfinite(self._own).all(axis=2) & np.isfinite(self._following).all(axis=2)
        usable &= np.isfinite(values)
        return (
            np.where(usable[:, :, None], self._own, 0.0),
            np.where(usable[:, :, None], self._following, 0.0),
            np.where(usable, window.lower - values, -np.inf),
            np.where(usable, window.upper - values, np.inf),
        )

    def _new(self, base: QP) -> QP:
        n, rows, size = self._n, base.rows, self._size
        wide = n + size
        qp = QP(base.stages, wide, rows + 2 * size)
        qp.lower[:, n:] = 0.0
        slacks = np.arange(size)
        qp.row_own[:, rows + slacks, n + slacks] = 1.0
        qp.row_own[:, rows + size + slacks, n + slacks] = -1.0
        # Entry [c, o] of a panel is H[c + o, c]: the next stage's rows are `size` further on.
        zero = 2 * n * n
        index = np.full((wide, 2 * wide), zero)
        for c in range(n):
            index[c, : n - c] = c * 2 * n + np.arange(n - c)
            index[c, wide - c : wide - c + n] = c * 2 * n + n - c + np.arange(n)
        self._index = index
        return qp

    def forces(self, base: QP, solution: Solution) -> Array | None:
        """Multipliers (K + 1, T) of soft nonlinear constraints in a solution of the lifted QP."""
        functions, duals = self._penalties.functions, solution.row_duals
        if functions is None or duals is None:
            return None
        upper = duals.reshape(base.stages, -1)[:, base.rows + self._size :]
        upper = upper.reshape(-1, self._penalties.size)
        forces = np.zeros((len(upper), functions.size))
        for rows, place, _ in self._penalties.parts:
            if rows.name == "constraints":
                forces[:, rows.components] = np.maximum(upper[:, place], 0.0)
        return forces

    def start(self) -> None:
        """Start a new sequence of QPs, whose first one has unknown forces."""
        self._last = None
        if self.stacked is not None:
            self.stacked._last = None

    def directly(self, base: QP, deadline: float = math.inf) -> Solution | None:
        """The solution with the soft rows and without slack variables; None where it is not found.

        The search begins with the rows that were active in the last QP of the sequence.
        """
        shape = 2, base.stages, self._size + base.rows + (self._n if base.bounded else 0)
        last = self._last
        found = self._exact(
            base, None, np.zeros(shape) if last is None or last.shape != shape else last, deadline
        )
        if found is None:
            return None
        d, self._last, steps = found
        return Solution(d, SolveStatus.SOLVED, steps, row_duals=self._duals(base, self._last))

    def lowered(self, base: QP, solution: Solution, deadline: float = math.inf) -> Solution:
        """A solution of the lifted QP without its slack variables; exact where that succeeds.

        It has the multipliers of all of that QP's rows.

        What a solver misses a soft row by costs its linear penalty times as much, which may be
        more than J itself. So its solution only says which rows are active, or violated.
        """
        status, duals = solution.status, solution.row_duals
        d = None if solution.d is None else solution.d[:, : self._n].copy()
        if d is not None and status in (SolveStatus.SOLVED, SolveStatus.INACCURATE):
            forces = self._forces_of(base, solution)
            exact = None if forces is None else self._exact(base, d, forces, deadline)
            if exact is not None:
                d, self._last, _ = exact
                status, duals = SolveStatus.SOLVED, self._duals(base, self._last)
        return Solution(
            d, status, solution.iterations, row_duals=duals, message=solution.message
        )

    def _exact(
        self, base: QP, d: Array | None, forces: Array, deadline: float
    ) -> tuple[Array, Array, int] | None:
        """The minimiser, its forces, and the search's steps; None where the search fails.

        The forces (2, K + 1, rows) are those of upper and of lower sides, of the soft rows, of the
        hard ones and of the bounds of each stage; they and d say which rows are active at first.
        """
        found = None
        with suppress(MemoryError, np.linalg.LinAlgError):  # the solver's answer stays
            inequalities, which, uppers = self._sides(base, forces.shape[2])
            found = minimised(
                base, inequalities, None if d is None else d.ravel(),
                np.append(forces[0].ravel()[which[:uppers]], forces[1].ravel()[which[uppers:]]),
                deadline,
            )
        if found is None:
            return None
        step, held, steps = found
        forces = np.zeros(forces.shape)
        forces[0].reshape(-1)[which[:uppers]] = held[:uppers]
        forces[1].reshape(-1)[which[uppers:]] = held[uppers:]
        return step.reshape(base.stages, self._n), forces, steps

    def _forces_of(self, base: QP, solution: Solution) -> Array | None:
        """The forces in a solution of the lifted QP, as `_exact` takes them."""
        if solution.bound_duals is None or solution.row_duals is None:
            return None
        hard, size = base.rows, self._size
        rows = solution.row_duals.reshape(base.stages, -1)
        held = [rows[:, :hard]]
        if base.bounded:
            held.append(solution.bound_duals.reshape(base.stages, -1)[:, : self._n])
        upper, lower = rows[:, hard + size :], -rows[:, hard : hard + size]
        return np.maximum([np.hstack((upper, *held)), -np.hstack((-lower, *held))], 0.0)

    def _duals(self, base: QP, forces: Array) -> Array:
        """Multipliers of the lifted QP's rows, from the forces of `_exact`."""
        size, (upper, lower) = self._size, forces
        hard = (upper - lower)[:, size : size + base.rows]
        return np.hstack((hard, -lower[:, :size], upper[:, :size])).ravel()

    def _sides(self, base: QP, places: int) -> tuple[Inequalities, NDArray[np.intp], int]:
        """All inequalities as ``rows d <= sides``, where some side is finite.

        With the place of each among all, soft and hard ones of each stage; and how many are upper
        sides, which come first.
        """
        n, window = self._n, self._window
        count = places - self._size  # of hard inequalities at each stage
        bounds = count - base.rows
        eye = np.broadcast_to(np.eye(n)[:bounds], (base.stages, bounds, n))
        parts = (
            self._usable(), (base.row_own, base.row_next, base.row_lower, base.row_upper),
            (eye, 0.0 * eye, base.lower[:, :bounds], base.upper[:, :bounds]),
        )
        own, following, lower, upper = (
            np.concatenate(one, axis=1) for one in zip(*parts, strict=True)
        )
        free = np.zeros((base.stages, count))
        most, curvature = (np.hstack(one).ravel() for one in (
            (0.5 * window.linear, free + np.inf), (window.quadratic, free),
        ))
        uppers, lowers = (np.flatnonzero(np.isfinite(one)) for one in (upper, lower))
        which = np.append(uppers, lowers)
        signs = np.where(np.arange(which.size) < uppers.size, 1.0, -1.0)
        return Inequalities(
            StageRows(own, following, which, signs),
            np.append(upper.ravel()[uppers], -lower.ravel()[lowers]), most[which], curvature[which],
        ), which, len(uppers)
