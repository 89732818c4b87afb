"""Where a model's values and Jacobians lie: at many states at once, and cell by cell."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..errors import ModelError
from ..model.system import System
from .deadline import Deadline
from .graph import Graph, Slopes
from .intervals import Interval
from .programs import Program
from .reading import SOLVES, expression_of, read
from .regions import Region

_REMEDY = "Take a smaller region, or make the model defined on all of it."
_SAMPLES, _SEED = 400, 20210829
# Computed values may be so many times as far from the expression's as rounding errors, bounded
# one by one, explain: sums may be made in another order, functions come from another library.
_ROUNDING = 64.0
# Conditions that change on one cell, of which each combination is enclosed by itself.
_MOST_KINKS = 3
# How many points are compared in all cells at least, of each kind; pairs of points in a cell,
# between which a change of a condition is looked for, in halvings.
_LEAST, _PAIRS, _HALVINGS = 256, 2, 48
# Between two looks at the clock, points of so many cells are compared.
_TOGETHER = 64
_TRACEABLE = "Write it with NumPy's functions of x and u, numpy.where in place of branches"


def evaluated(name: str, function: Any, points: Array, n: int) -> Array:
    """A function's values; a `ModelError` names the state where it raises or is not finite."""

    def at(where: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.array(function.batch(where[:, :n], where[:, n:]), np.float64)

    try:
        values = at(points)
    except Exception:  # a user's function may raise anything
        each = []
        for point in points:
            try:
                each.append(at(point[None])[0])
            except Exception as error:
                raise ModelError(
                    f"{name} raises {type(error).__name__} at {place(point, n)}, within the "
                    f"region: {error}. {_REMEDY}"
                ) from error
        values = np.array(each)
    broken = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if broken.any():
        k = int(np.argmax(broken))
        raise ModelError(
            f"{name} is not finite at {place(points[k], n)}, within the region: it returned "
            f"{values[k].tolist()}. {_REMEDY}"
        )
    return values


def place(point: Array, n: int) -> str:
    """A state and its input in words."""
    return f"x = {point[:n].tolist()}" + (f", u = {point[n:].tolist()}" if point[n:].size else "")


# Beyond, corners would be many: what the other coordinates do is covered by the error.
MOST_ACTIVE = 6


@dataclass(frozen=True, eq=False)
class Enclosure:
    r"""The joint Jacobian :math:`J = [\partial f; \partial h]` over cells, or that of h.

    On a cell with middle c, by the mean value theorem for J,

    .. math::
        J(s) \in J(c) + \sum_j (s_j - c_j) H_j + [-E, E]

    where H_j is the middle of an interval enclosure of the second derivatives over the cell
    and E covers its radius and all rounding. The affine part has its extremes at corners of
    the cell. E vanishes like the square of the cell's size, and is rounding alone where J is
    affine.
    """

    centre: Array  # (B, q, n), q = n + p or p: J(c); NaN where it could not be enclosed
    slopes: Array  # (B, N, q, n): H_j times the half-width of the cell
    error: Array  # (B, q, n): E, rounded up; NaN where it could not be enclosed
    excess: Array  # (B, N): what the width of each coordinate contributes to E
    jacobian: Array  # (B, q, n): J at the cell's middle; NaN where it has none
    sides: tuple[Enclosure, ...] = ()  # where J is in one of these, which say more

    def corners(self) -> tuple[Array, Array]:
        """Matrices whose convex hull, widened by an error, holds J on each cell."""
        parts = self.sides or (self,)
        # Cells of which nothing is known must not hide how the others vary.
        known = np.isfinite(self.error).all(axis=(1, 2))
        weight = np.max([
            np.abs(part.slopes[known]).max(axis=(0, 2, 3), initial=0.0) for part in parts
        ], axis=0)
        order = np.argsort(weight)[::-1]
        active = order[:MOST_ACTIVE][weight[order[:MOST_ACTIVE]] > 0.0]
        rest = np.setdiff1d(np.arange(weight.size), active)
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=active.size)))
        signs = signs.reshape(2**active.size, active.size)
        moved, errors = [], []
        for part in parts:
            error = part.error
            if np.any(weight[rest] > 0.0):
                error = (error + np.abs(part.slopes[:, rest]).sum(axis=1)) * (1.0 + 1e-12)
            moved.append(part.centre[:, None] + np.einsum(
                "kj,bjqn->bkqn", signs, part.slopes[:, active]
            ))
            rounding = 1e-15 * (active.size + 2) * (
                np.abs(part.centre) + np.abs(part.slopes[:, active]).sum(axis=1)
            )
            errors.append(error + rounding)
        return np.concatenate(moved, axis=1), np.max(errors, axis=0)


class SmoothModel:
    """f and h of a system as one expression graph, to be enclosed over cells of states and inputs.

    It encloses f and h as expressions in real arithmetic, with their constants in double precision.
    Functions in NumPy are traced (`qpmhe.model.tracing`). At samples of the region, their values
    must lie where the expressions' values do; `agrees` compares them in each cell of a proof.

    States and inputs that the region fixes, such as known parameters, are numbers in the graph:
    Jacobians are of the other states, those in ``free``. ``moved`` are the states that the region
    fixes but f is not shown to keep. ``reason`` says why f and h have no enclosure; empty if they
    have. ``affine_output``: the Jacobian of h is constant on the region.
    """

    def __init__(self, system: System, region: Region) -> None:
        self._system, self._region, self.n = system, region, system.n
        wide = region.lower < region.upper
        self.free = np.flatnonzero(wide[: self.n])
        self.points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
        self._unknown: tuple[Array, Array] | None = None
        self.compared, self.late = len(self.points), ""
        functions, missing = _functions(system)
        given = (*functions, *(each.serialize() for each in functions.values()))
        fixed = tuple((int(k), float(region.lower[k])) for k in np.flatnonzero(~wide))
        self._own = own = _expressions(_Source(system.n, system.m, fixed, given, functions))
        self._programs = own.programs
        self.reason = next(filter(None, map(self._refused, functions)), missing)
        self.affine_output = not self.reason and own.affine_output and not (
            own.programs["h"].obstacle(region.lower, region.upper)
        )
        held = np.flatnonzero(~wide[: self.n])
        if self.reason and held.size:
            ahead = evaluated("f", system.f, self.points, self.n)[:, held]
            kept = (ahead == region.lower[held]).all(axis=0)
        else:
            kept = np.array([own.following(int(i)) == region.lower[i] for i in held], np.bool_)
        self.moved = held[~kept]

    def _refused(self, name: str) -> str:
        """Why a function that has an expression has no enclosure; blank if it has one."""
        obstacle = self._programs[name].obstacle(self.points[0], self.points[0])
        return f"{name} has {obstacle}" if obstacle else self._differs(name, self.points)

    def jacobians(self, points: Array) -> Array:
        """The joint Jacobians at some points: of the expressions, or of the functions."""
        parts = []
        for name in ("f", "h"):
            evaluated(name, getattr(self._system, name), points, self.n)  # steps may not see NaN
            jacobian = getattr(self._system, f"{name}_jacobian")
            parts.append(evaluated(f"the Jacobian of {name}", jacobian, points, self.n))
        joint = np.concatenate((parts[0][:, self.free], parts[1]), axis=1)[..., self.free]
        if self.reason:
            return joint
        true = self.enclose(points, points).centre
        return np.where(np.isfinite(true), true, joint)

    @property
    def unknown(self) -> str:
        """The last cell that could not be enclosed, and why, as the rest of a sentence."""
        if self._unknown is None:
            return ""
        obstacle = self.obstacle(*self._unknown)
        return obstacle and f"; between {self._unknown[0].tolist()} and " + (
            f"{self._unknown[1].tolist()} {obstacle}"
        )

    def obstacle(self, lower: Array, upper: Array) -> str:
        """What has no enclosure on a cell (N,), in words; blank if everything has one."""
        parts: dict[str, Program | _Plan] = {
            f"{name} has": one for name, one in self._programs.items()
        }
        if not self.reason:
            parts["a derivative has"] = self._own.plan
        for words, part in parts.items():
            found = part.obstacle(lower, upper)
            if found:
                return f"{words} {found}"
        return ""

    def agrees(self, cells: Sequence[tuple[Array, Array]], deadline: Deadline) -> bool:
        """Whether f and h have their expressions' values in each cell.

        In cells (B, N) each, at random points, at random corners and, where a condition changes,
        on both sides of the change. Of a region that is no box, cells reach beyond it; where few of
        these points are within, others of the region are added. ``reason`` says where they differ,
        and ``late`` how far it came if the time is over before.
        """
        lower, upper = (np.concatenate([each[k] for each in cells]) for k in range(2))
        own, compared, self.late = len(lower), 0, ""
        lower, upper = (np.tile(each, (-(-_LEAST // own), 1)) for each in (lower, upper))
        rng, parts = np.random.default_rng(_SEED), range(0, len(lower), _TOGETHER)
        for k in parts:
            if deadline.passed:
                self.late = (
                    f"f and h were compared with their expressions in {min(k, own)} of {own} cells"
                )
                return False
            low, high = lower[k : k + _TOGETHER], upper[k : k + _TOGETHER]
            inner, share = rng.uniform(low, high), rng.integers(2, size=low.shape)
            corner = np.where(share == 1, high, low)
            points = np.vstack((inner, corner, *self._own.plan.around_kinks(low, high, rng)))
            points = points[self._region.contains(points[:, : self.n])]
            compared += len(points)
            if k == parts[-1] and compared < _LEAST:
                points = np.vstack((points, self._region.sample(_LEAST, rng)))
            self.compared += len(points)
            if len(points):
                self.reason = self._differs("h", points) or self._differs("f", points)
            if self.reason:
                return False
        return True

    def _differs(self, name: str, points: Array) -> str:
        """Where a function differs from its expression by more than rounding; blank if nowhere."""
        function, n = getattr(self._system, name), self.n

        def values_at(point: Array) -> Any:
            try:
                with np.errstate(all="ignore"):
                    return np.asarray(function(point[:n].copy(), point[n:].copy()), np.float64)
            except Exception:  # whatever a user's function does: others report it
                return np.full(function.shape, np.nan)

        # In a thread of its own: a function may know those of others by name.
        with np.errstate(all="ignore"), ThreadPoolExecutor(1) as pool:
            values = np.array(pool.submit(lambda: [values_at(point) for point in points]).result())
            found = self._programs[name](points, points)
            middle, room = found.middle.T, _ROUNDING * found.radius.T
            same = (np.abs(values - middle) <= room) | ~(np.isfinite(values) & np.isfinite(middle))
        # Not known of the expression may be what the function has a value for.
        same &= np.isfinite(values) >= np.isfinite(middle)
        if same.all():
            return ""
        k = int(np.argmin(same.all(axis=1)))
        return (
            f"{name} is {values[k].tolist()} at {place(points[k], n)}, but its expression is "
            f"{middle[k].tolist()}: it depends on more than its arguments"
        )

    def values(self, lower: Array, upper: Array) -> Interval:
        """Enclosures (B, n + p) of f and h over cells (B, N); NaN where there are none."""
        found = self._own.values(lower, upper)
        return Interval(found.low.T, found.high.T)

    def enclose(self, lower: Array, upper: Array) -> Enclosure:
        """The joint Jacobian over cells."""
        with np.errstate(all="ignore"):
            found = self._enclosed(lower, upper)
        unknown = np.isnan(found.error).any(axis=(1, 2))
        if unknown.any():
            self._unknown = lower[unknown][-1], upper[unknown][-1]
            middles = 0.5 * lower[unknown] + 0.5 * upper[unknown]
            middles = middles[self._region.contains(middles[:, : self.n])]
            for name in self._programs if len(middles) else ():
                evaluated(name, getattr(self._system, name), middles, self.n)
        return found

    def _enclosed(self, lower: Array, upper: Array) -> Enclosure:
        plan = self._own.plan
        found, open_ends = plan.enclosed(lower, upper)
        count = open_ends.sum(axis=1)
        kinked = (count > 0) & (count <= _MOST_KINKS) & np.isfinite(found.error).all(axis=(1, 2))
        if not kinked.any():
            return found
        # At almost every point of a segment, what depends on a condition has the derivatives of
        # the side that the condition is on there: those of both sides are enclosed one by one.
        order, given = np.cumsum(open_ends, axis=1) - 1, open_ends & kinked[:, None]
        sides = tuple(
            plan.enclosed(lower, upper, np.where(given, (k >> np.maximum(order, 0)) & 1, np.nan))[0]
            for k in range(2 ** int(count[kinked].max()))
        )
        # Cells are divided by what the sides of a kink leave open, not by the kink.
        return replace(found, sides=sides, excess=np.max([side.excess for side in sides], axis=0))


def _functions(system: System) -> tuple[dict[str, Any], str]:
    """CasADi's functions h and f, as far as there are some, and why there is not the next one."""
    found: dict[str, Any] = {}
    for name in ("h", "f"):
        expression = expression_of(system, name)
        if expression.function is None:
            helps = "" if expression.reason.endswith(SOLVES) else f". {_TRACEABLE}"
            return found, f"{name} is not traced: {expression.reason}{helps}"
        found[name] = expression.function
    return found, ""


@dataclass(frozen=True)
class _Source:
    """What the programs of a model are made of; ``given`` are its functions as text."""

    n: int
    m: int
    fixed: tuple[tuple[int, float], ...]  # coordinates that a region fixes
    given: tuple[str, ...]
    functions: dict[str, Any] = field(compare=False)


class _Expressions:
    """The programs of f and h: the same for each region that fixes the same coordinates."""

    def __init__(self, source: _Source) -> None:
        graph = self._graph = Graph(source.n + source.m)
        for k, value in source.fixed:
            graph.variables[k] = graph.constant(value)
        fixed = dict(source.fixed)
        self._free = [i for i in range(source.n) if i not in fixed]
        self._roots = {name: read(graph, each) for name, each in source.functions.items()}
        self.programs = {name: Program(graph, roots) for name, roots in self._roots.items()}
        self._slopes = Slopes(graph)

    def following(self, i: int) -> float | None:
        """The next value of a state, if that is a number."""
        return self._graph.value(self._roots["f"][i])

    @cached_property
    def affine_output(self) -> bool:
        """Whether no second derivative of h, nor a condition in a first one, is left."""
        slopes, graph = self._slopes, self._graph
        return not any(
            slopes.of(slope) or graph.comparisons([slope])
            for root in self._roots["h"] for slope in slopes.of(root).values()
        )

    @cached_property
    def values(self) -> Program:
        """F and h together."""
        return Program(self._graph, self._roots["f"] + self._roots["h"])

    @cached_property
    def plan(self) -> _Plan:
        """The joint Jacobian."""
        rows = [*(self._roots["f"][i] for i in self._free), *self._roots["h"]]
        return _Plan(self._graph, self._slopes, rows, self._free)


@lru_cache(maxsize=2)
def _expressions(source: _Source) -> _Expressions:
    """Made once for the parts of a certificate, which ask one after another."""
    return _Expressions(source)


class _Plan:
    """The programs for the Jacobian of some nodes by some variables, over cells."""

    def __init__(self, graph: Graph, slopes: Slopes, roots: list[int], by: list[int]) -> None:
        self._q, self._n = len(roots), len(by)
        column = {variable: k for k, variable in enumerate(by)}
        each = [
            (row, i, node) for row, root in enumerate(roots)
            for i, node in slopes.of(root).items() if i in column
        ]
        first = [(row, column[i], node) for row, i, node in each]
        # Each second derivative in all places that it has.
        second = [
            (row, column[this], other, node) for row, i, slope in each
            for j, node in slopes.of(slope).items() if i <= j
            for this, other in sorted({(i, j), (j, i)}) if this in column
        ]
        self._first, self._second = (
            np.array([one[:-1] for one in table], np.intp).reshape(-1, count).T
            for table, count in ((first, 2), (second, 3))
        )
        nodes = [one[-1] for one in first]
        self._conditions = decisions = graph.comparisons(nodes)
        above = [set(graph.ancestors([node])) for node in nodes]
        self._depends = np.array([
            [one in each for one in decisions] for each in above
        ], np.bool_).reshape(len(nodes), len(decisions))
        self._point, self._decided = (
            Program(graph, each) for each in (roots + nodes + decisions, decisions)
        )
        self._cell = Program(graph, roots + nodes + [one[-1] for one in second] + decisions)

    def obstacle(self, lower: Array, upper: Array) -> str:
        """What is not defined on all of a cell (N,), in words; blank if all is."""
        return self._point.obstacle(lower, upper)

    def around_kinks(
        self, lower: Array, upper: Array, rng: np.random.Generator
    ) -> list[Array]:
        """Points (K, N) on both sides of where a condition changes in a cell, close to it."""
        if not self._conditions:
            return []
        part = rng.random((2, _PAIRS, *lower.shape))
        start, end = (lower + (upper - lower) * part).reshape(2, -1, lower.shape[1])

        def truth(points: Array) -> NDArray[np.bool_]:
            return np.asarray(self._decided(points, points).low == 1.0)

        # One condition of each pair, in turn: the others may change on the way as well.
        changes = truth(start) != truth(end)
        which, pair = changes.argmax(axis=0), np.flatnonzero(changes.any(axis=0))
        start, end, which = start[pair], end[pair], which[pair]
        rows, first = np.arange(len(pair)), truth(start)
        for _ in range(_HALVINGS):
            middle = 0.5 * start + 0.5 * end
            before = (truth(middle) == first)[which, rows]
            start = np.where(before[:, None], middle, start)
            end = np.where(before[:, None], end, middle)
        return [start, end]

    def enclosed(
        self, lower: Array, upper: Array, truths: Array | None = None
    ) -> tuple[Enclosure, NDArray[np.bool_]]:
        """The Jacobian over cells, and which conditions (B, C) are not the same on all of a cell.

        Those for which truths (B, C) are given are taken to be so.
        """
        cells, N, q, n = *lower.shape, self._q, self._n
        forced = {} if truths is None else dict(zip(self._conditions, truths.T, strict=True))
        centre, half = halved(lower, upper)
        point, cell = self._point(centre, centre, forced), self._cell(lower, upper, forced)
        (rows, columns), (row, this, other) = self._first, self._second
        ends = np.cumsum([q, rows.size, row.size])
        over, bends, decided = (
            cell[a:b] for a, b in zip(ends, (*ends[1:], None), strict=True)
        )
        slope, at_kink = point[q : ends[1]], point[ends[1] :]

        def dense(values: Array) -> Array:
            matrix = np.zeros((cells, q, n))
            matrix[:, rows, columns] = values.T
            return matrix

        open_ends: NDArray[np.bool_] = (decided.low != decided.high).T
        jacobian, rounding = dense(slope.middle), dense(slope.radius)
        slopes, spread = np.zeros((2, cells, N, q, n))
        slopes[:, other, row, this] = bends.middle.T * half[:, other]
        spread[:, other, row, this] = bends.radius.T * half[:, other]
        # Where a condition may change, what depends on it may jump.
        at, entry = np.nonzero(open_ends @ self._depends.T)
        spread[at, columns[entry], rows[entry], columns[entry]] = np.nan
        error = (spread.sum(axis=1) + rounding + 1e-15 * np.abs(slopes).sum(axis=1)) * (
            1.0 + 1e-14 * (N + 4)
        )
        # Without second derivatives, as at kinks, an entry is where its values over the cell are.
        middle, radius = dense(over.middle), dense(over.radius)
        kinked = ~np.isfinite(error) & np.isfinite(radius)
        at, row, i = np.nonzero(kinked)
        culprits = ~np.isfinite(spread[at, :, row, i] + slopes[at, :, row, i])
        share = culprits / np.maximum(culprits.sum(axis=1, keepdims=True), 1)
        slopes[at, :, row, i] = 0.0
        spread[at, :, row, i] = share * radius[at, row, i][:, None]
        error[kinked] = radius[kinked]
        enclosed = np.where(kinked, middle, jacobian)
        # What is not finite has no derivative, whatever its parts have.
        unknown = ~cell[:q].known.all(axis=0) | ~np.isfinite(enclosed + error).all(axis=(1, 2))
        # NaN alone: infinities would make invalid operations later on.
        slopes[unknown], error[unknown] = np.nan, np.nan
        jacobian[(at_kink.low != at_kink.high).any(axis=0)] = np.nan
        jacobian[~np.isfinite(jacobian).all(axis=(1, 2))] = np.nan
        enclosed[unknown] = jacobian[unknown]
        return Enclosure(
            enclosed, slopes, error, spread.sum(axis=(2, 3)), jacobian
        ), open_ends


def halved(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Centres and half-widths of cells, which cover them; zero where there is no width."""
    centre = np.where(lower == upper, lower, 0.5 * lower + 0.5 * upper)
    half = np.nextafter(np.maximum(upper - centre, centre - lower), np.inf)
    return centre, np.where(lower == upper, 0.0, half)
