"""The search for a matrix inequality that holds on a region, and its verification."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..model.residuals import Angles
from ..model.system import System
from .branch_and_bound import Cover, cover
from .deadline import LEAST_SECONDS, PART_SECONDS, Deadline
from .enclosures import SmoothModel, evaluated
from .evidence import CertificateError, Evidence, NotCertifiedError, OutOfTimeError
from .inequalities import Form, Matrices, definite
from .regions import Region
from .sdp import ConicSolution, Kind, NoiseSizes, Scales, SemidefiniteProgram, expected_seconds

_PAIRS, _SEED = 2000, 20210829
_ROUNDS = 8
_MARGINS = (1e-6, 1e-4, 1e-3, 1e-2)
# Of what a rate that is not given leaves to 1: few cells suffice where there is room.
_ROOM = (0.03, 0.06, 0.12, 0.25)
_DESIGN_MARGIN = 1e-4  # it saves the verification most of its cells, and costs as much
# Where one program takes longer than so many seconds, these rates are tried in turn, with more
# room and fewer Jacobians.
_LONG, _RATES, _WIDE_ROOM = 0.3, (0.9, 0.95, 0.98), (0.2, 0.4, 0.6)
_FEW_POINTS, _MOST_POINTS, _MORE_POINTS = 4, 24, 6  # Jacobians at first, and of a failure
_FEW_CELLS, _MOST_CELLS = 100, 40_000
_TOLERANCE, _LARGEST_RATE = 1e-3, 0.9999  # of the smallest rate; of any
# In how many steps the best rate is sought, in decades of 1 - rate; how often, and how much of
# what a failed rate leaves to 1 the next ones leave out.
_STEPS, _FURTHER = 12, (0.0, 0.03, 0.1, 0.3)
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# How much of the time the choice of a rate may take, and one verification; how many programs
# the former solves; how far off the time that a program is expected to take may be.
_CHOICE, _VERIFICATION = 0.5, 0.6
_PROGRAMS, _MISJUDGED = 20, 4.0
_BETTER = 0.9  # of a measure, where another answer is better by more than the margins explain
_NEARLY = 1.0 + 1e-12  # what rounding makes of a spectral radius


@dataclass(frozen=True, eq=False)
class Found:
    """An inequality and how far it was shown."""

    form: Form  # filled in
    evidence: Evidence
    cells: int  # in which it was proved
    compared: int  # at how many points f had the value of the trace that it is proved for
    notes: tuple[str, ...]


class _BrokenPairError(NotCertifiedError):
    """No matrix helps where f or h jumps."""


class Search:
    """Programs at some states, verification at all of them, and more states where it fails.

    ``kind=None`` takes the form of detectability that the output allows. The sizes are those of
    disturbance and noise; for detectability, of disturbance and output. With ``growth``, as of
    `SemidefiniteProgram`, detectability has the sum of squares, and disturbances act through their
    matrix.

    A state that the region fixes, such as a known parameter, has no error. Jacobians, scales, gain
    and forms are of the states in ``free`` only, and of the disturbances in ``acting`` that move
    none of the fixed states.
    """

    def __init__(
        self, system: System, region: Region, kind: Kind | None, sizes: NoiseSizes,
        gain: Array | None = None, seconds: float | Deadline = PART_SECONDS,
        growth: Callable[[float], float] | None = None,
    ) -> None:
        if kind is None and (system.output_residual or system.state_residual) is not None:
            raise CertificateError(
                "the system has angles, whose differences may wrap: only an observer is "
                "certified, within a region where they do not. Leave the residuals out for "
                "detectability, with outputs and states that do not wrap within the region."
            )
        self._deadline = Deadline.of(seconds)
        self.system, self.region, self.gain, self._sizes = system, region, gain, sizes
        self._growth, self._triangle = growth, kind is None and growth is None
        self.p, G = system.p, system.disturbance_matrix
        self._matrix = np.eye(system.n) if G is None or self._triangle else G
        self.model = SmoothModel(system, region)
        self.points, self.free = self.model.points, self.model.free
        self.n, self.acting = self.free.size, np.arange(system.r)
        self.jacobians = self.model.jacobians(self.points)
        if self.n < system.n:
            self._leave_out()
        if kind is None:
            same = self.model.affine_output or (
                bool(self.model.reason) and not np.ptp(self.jacobians[:, self.n :], axis=0).any()
            )
            kind = "output weight" if same else "output injection"
        self.kind: Kind = kind
        each = expected_seconds(self.n, self.p, kind)
        affordable = _CHOICE * self._deadline.left / (_PROGRAMS * each)
        self._long = each * _MOST_POINTS > _LONG
        most = _FEW_POINTS if self._long else _MOST_POINTS
        self._chosen = _far_apart(self.jacobians, int(np.clip(affordable, 1, most)))
        states = 0.5 * (region.upper - region.lower)[self.free]
        outputs = np.abs(self.jacobians[:, self.n :] * states).sum(axis=2).max(axis=0)
        self.scales = Scales(
            states / states.max(), np.where(outputs > 0.0, outputs / states.max(), 1.0)
        )
        self._program: SemidefiniteProgram | None = None
        self._radius = 0.0  # the largest of A - L C in the program: no smaller rate is feasible
        self._answers: list[ConicSolution] = []
        self.notes: tuple[str, ...] = ()
        self.room = self._angles()

    def _angles(self) -> Array | None:
        """Below what noises must be so that no innovation in the region wraps; None: any may be."""
        angles = self.system.output_residual
        if not isinstance(angles, Angles):
            return None
        if self.model.reason:
            raise CertificateError(
                "the outputs' angles have no enclosure, so that it is not known where they wrap"
            )
        outputs = self.model.values(self.region.lower[None], self.region.upper[None])
        width = (outputs.high - outputs.low)[0, self.system.n + angles.components]
        half = 0.5 * np.asarray(angles.periods)
        largest = np.broadcast_to(np.asarray(self._sizes[1]), (self.p,))[angles.components]
        room = half - width
        if not (room > largest).all():
            k = int(np.argmin(room - largest))
            raise NotCertifiedError(
                f"the angle y[{angles.components[k]}] may wrap: it moves by up to {width[k]:.3g} "
                f"in the region, and by the noise, {largest[k]:.3g}, and half a period is "
                f"{half[k]:.3g}", ("a smaller region",),
            )
        self.notes = tuple(
            f"the noise of the angle y[{j}] is less than {each:.4g}: then no innovation wraps"
            for j, each in zip(angles.components, np.floor(room * 1e4) / 1e4, strict=True)
        )
        found = np.full(self.p, np.inf)
        found[angles.components] = room
        return found

    def _leave_out(self) -> None:
        """Leave the states out that the region fixes; an error if f or the gain moves them."""
        n, free, width = self.system.n, self.free, "a region with some width there"
        if not free.size:
            raise NotCertifiedError(
                "the region is a single state, which has nothing to estimate",
                ("a region with some width",),
            )
        fixed = np.setdiff1d(np.arange(n), free)
        pulled = fixed[self.gain[fixed].any(axis=1)] if self.gain is not None else fixed[:0]
        for who, moved, helps in (
            ("f", self.model.moved, (width,)),
            ("the observer's gain", pulled, (width, "a gain with a row of zeros there")),
        ):
            if moved.size:
                names = ", ".join(f"x[{j}]" for j in moved)
                raise NotCertifiedError(
                    f"the region has no width in {names}, but {who} moves it", helps
                )
        self.gain = None if self.gain is None else self.gain[free]
        G, (w, v) = self._matrix, self._sizes
        acting = np.flatnonzero(~G[fixed].any(axis=0) & G[free].any(axis=0))
        if not self._triangle:
            self.acting = acting
        self._sizes = (np.asarray(w)[acting] if np.shape(w) == (G.shape[1],) else w), v
        self._matrix = G[np.ix_(free, acting)]
        if not acting.size:
            self._matrix, self._sizes = np.eye(self.n), (0.0, v)

    @property
    def program(self) -> SemidefiniteProgram:
        """The program at the states chosen so far."""
        if self._program is None:
            self._program = SemidefiniteProgram(
                self.kind, self.jacobians[self._chosen], self.scales, self._sizes, self._matrix,
                self.gain, self._growth, self._triangle,
            )
            self._radius = 0.0 if self.gain is None else float(
                self.radii(self.gain)[self._chosen].max()
            )
        return self._program

    def radii(self, gain: Array | None = None) -> Array:
        """The spectral radii of A, or of A - L C, at the samples."""
        closed = self.jacobians[:, : self.n]
        if gain is not None:
            closed = closed - gain @ self.jacobians[:, self.n :]
        radii: Array = np.abs(np.linalg.eigvals(closed)).max(axis=1)
        return radii

    def answer(
        self, name: str, rate: float | None, advice: tuple[str, ...],
        why: Callable[[Search, str], NotCertifiedError],
    ) -> Found:
        """An inequality with this rate, or with the best; `why` says why none is feasible.

        When the time is over, it is the best one found so far that holds at the samples.
        """
        try:
            return self._best() if rate is None else self._find(rate, given=True)
        except OutOfTimeError:
            for one in sorted(self._answers, key=lambda each: each.objective):
                found = None if one.form is None else self._verified(one.form, _FEW_CELLS)
                if isinstance(found, Found):
                    return found
            raise
        except NotCertifiedError as error:
            try:
                smallest = self._smallest_rate()
            except OutOfTimeError:
                raise error from None
            if math.isinf(smallest):
                raise why(self, error.finding) from error
            helps = (*error.suggestions, f"a larger {name}", *advice, "a smaller region")
            raise NotCertifiedError(
                f"{error.finding}. Feasible at the states tried: {name} from {smallest:.4g} on",
                tuple(dict.fromkeys(helps)), smallest,
            ) from error

    def _smallest_rate(self) -> float:
        """The smallest rate found feasible at the chosen states, infinite if none below 1 is."""
        low, high, deadline = 0.0, math.inf, self._deadline.part(_CHOICE)
        middle = _LARGEST_RATE
        while high - low > _TOLERANCE * (1.0 - low):
            try:
                margin = _MARGINS[0] * min(1.0, middle * middle)
                form = self._solved(middle, margin, deadline).form
                feasible = form is not None and self._fits(form)
            except OutOfTimeError:
                if math.isinf(high):
                    raise
                break
            if not feasible and math.isinf(high):
                break
            low, high = (low, middle) if feasible else (middle, high)
            middle = 0.5 * (low + high)
        return high

    def _fits(self, form: Form) -> bool:
        """Whether an inequality holds at the chosen states: what is infeasible may seem solved."""
        wider = replace(form, rate=form.rate + _TOLERANCE * (1.0 - form.rate))
        chosen = Matrices.exact(self.jacobians[self._chosen])
        return wider.holds_always() and bool(definite(wider.matrices(chosen)).all())

    def _solved(self, rate: float, margin: float, deadline: Deadline) -> ConicSolution:
        """What the program returns; an error if there is no time for it, or not enough."""
        expected, left = self.program.expected_seconds, deadline.left
        answer, begun = ConicSolution("user_limit"), left > 0.0 and expected <= _MISJUDGED * left
        if self._radius > _NEARLY * rate:  # a solver may take long to find that
            answer, begun = ConicSolution("infeasible"), True
        elif begun:
            answer = self.program.solve(rate, margin, left)
        if answer.status == "user_limit" and (deadline.passed or not begun):
            given = self._deadline.seconds
            time = f"the time for this search ({given:.3g} s) was too short"
            if given <= LEAST_SECONDS:
                time = "no time was left for this search"
            raise OutOfTimeError(
                f"{time}: a semidefinite program for {self.system.n} states takes about "
                f"{expected:.2g} s, and {left:.2g} s were left",
                ("more seconds", "a given rate, which saves the search for one",
                 "a smaller model"),
            )
        self._answers.append(answer)
        return answer

    def _best_rate(self, least: float) -> float:
        """The rate with the smallest measure of what lasting disturbances and noises make.

        By golden sections of the decades of 1 - rate; a rate that is too small has no measure.
        """
        deadline, measures = self._deadline.part(_CHOICE), dict[float, float]()

        def measure(decade: float) -> float:
            rate = round(1.0 - 10.0**decade, 9)
            if rate not in measures:
                margin = self._margins(rate, given=False)[1]
                measures[rate] = self._solved(rate, margin, deadline).objective
            return measures[rate]

        low, high = math.log10(1.0 - _LARGEST_RATE), math.log10(1.0 - least)
        try:
            for _ in range(_STEPS):
                step = _GOLDEN * (high - low)
                if measure(low + step) < measure(high - step):
                    low = high - step
                else:
                    high = low + step
        except OutOfTimeError:
            if not measures:
                raise
        best = min(measures, key=measures.__getitem__)
        return best if math.isfinite(measures[best]) else _LARGEST_RATE

    def _best(self) -> Found:
        """An inequality with the best rate found."""
        least, refused = 0.0, NotCertifiedError("no rate was tried")
        for further, one in zip(_FURTHER, _RATES if self._long else _FURTHER, strict=False):
            rate = one if self._long else self._best_rate(least + further * (1.0 - least))
            try:
                return self._find(rate, given=False)
            except (OutOfTimeError, _BrokenPairError):
                raise
            except NotCertifiedError as error:
                # What failed has left more states in the program, and moves the best rate.
                refused, least = error, rate
                if rate == _LARGEST_RATE:
                    break
        raise refused

    def _margins(self, rate: float, given: bool) -> list[float]:
        """The margins to try in turn."""
        least, room = [each * min(1.0, rate * rate) for each in _MARGINS], 1.0 - rate * rate
        if self._growth is not None:
            least = [max(each, _DESIGN_MARGIN * min(rate * rate, 1e3 * room)) for each in least]
        if self._long:
            return [each * room for each in _WIDE_ROOM]
        if given or self.kind not in ("observer", "synthesis"):
            return least
        return [least[0], *(each * room for each in _ROOM)]

    def _find(self, rate: float, *, given: bool) -> Found:
        """An inequality with this rate, verified as far as can be."""
        margins, best, status = self._margins(rate, given), None, "no round was left"
        # Where a few cells do, as for affine models, no room is needed.
        cells = _MOST_CELLS if given else _FEW_CELLS
        for turn in range(_ROUNDS):
            try:
                answer = self._solved(rate, margins[0], self._deadline)
            except OutOfTimeError:
                if best is None:
                    raise
                break
            if turn == 0:
                answer = self._better(answer, rate)
            if self.kind == "synthesis" and answer.form is not None:
                # A better P for the gain, which was rounded.
                assert answer.form.gain is not None
                answer = self.program.of_gain(answer.form.gain).solve(
                    rate, margins[0], self._deadline.left
                )
            if answer.form is None:
                status = answer.status
                break
            outcome = self._verified(answer.form, cells)
            if isinstance(outcome, Found):
                if outcome.evidence is Evidence.PROVED or self.model.reason:
                    return outcome
                best = outcome
            elif self._added(outcome) and turn % 2 == 0 and not self._long:
                continue
            if not margins[1:]:
                break
            margins, cells = margins[1:], _MOST_CELLS
        if best is not None:
            return best
        raise NotCertifiedError(
            f"the semidefinite program for the rate {rate:.6g} is {status}"
            if status == "infeasible"
            else f"no matrix that passes the verification was found for the rate {rate:.6g} "
            f"(solver status: {status})"
        )

    def _better(self, answer: ConicSolution, rate: float) -> ConicSolution:
        """Of all answers for a rate, one that is far better, though a smaller margin allows more.

        Without much room, a solver may fail, and a program that is easier gives a larger limit.
        """
        known = min(
            (one for one in self._answers if one.form is not None and one.form.rate == rate),
            key=lambda one: one.objective, default=answer,
        )
        return known if known.objective < _BETTER * answer.objective else answer

    def _verified(self, form: Form, most_cells: int) -> Found | Cover:
        """What was shown, or the cover with the states where the inequality fails."""
        if not form.holds_always():
            return Cover(False, 0, self.points[:0], self.jacobians[:0])
        shown = definite(form.matrices(Matrices.exact(self.jacobians)))
        if not shown.all():
            return Cover(False, 0, self.points[~shown], self.jacobians[~shown])
        why = f"f and h cannot be run with intervals ({self.model.reason})"
        if not self.model.reason:
            deadline = self._deadline.part(_VERIFICATION)
            found = cover(self.model, self.region, form, most_cells, deadline)
            if found.proved:
                traced = self.system.tracing is not None
                points = self.model.compared if traced else 0
                return Found(form, Evidence.PROVED, found.cells, points, ())
            if found.violations.shape[0]:
                return found
            end = ", when its time was over" if found.late else ""
            why = (
                f"the proof is of something else: {self.model.reason}" if self.model.reason else
                f"the proof was given up when its time was over: {self.model.late}"
                if self.model.late else
                f"the proof was given up after dividing the region into {found.cells} cells{end}"
                f"{self.model.unknown}"
            )
        self._check_pairs(form)
        note = f"{why}; the inequality holds at {self.points.shape[0]} states of the region"
        return Found(form, Evidence.SAMPLED, 0, 0, (note,))

    def _check_pairs(self, form: Form) -> None:
        """Raise where the inequality does not hold between two of the samples."""
        n, rng = self.system.n, np.random.default_rng(_SEED)
        start, end = self.points[rng.integers(len(self.points), size=(2, _PAIRS))]
        end[:, n:] = start[:, n:]
        df, dh = (
            evaluated(name, function, end, n) - evaluated(name, function, start, n)
            for name, function in (("f", self.system.f), ("h", self.system.h))
        )
        broken = form.excess((end - start)[:, self.free], df[:, self.free], dh) > 0.0
        if broken.any():
            k = int(np.argmax(broken))
            raise _BrokenPairError(
                f"the inequality for the rate {form.rate:.6g} holds at {len(self.points)} states, "
                f"but not between {start[k].tolist()} and {end[k].tolist()}: f or h may jump there",
                ("a model without the jump", "a smaller region"),
            )

    def _added(self, outcome: Cover) -> bool:
        """Take states where the inequality fails into the program; False if there are none."""
        chosen = _far_apart(outcome.jacobians, _MORE_POINTS)
        self._chosen = np.append(self._chosen, len(self.points) + np.arange(len(chosen)))
        self.points = np.vstack((self.points, outcome.violations[chosen]))
        self.jacobians = np.concatenate((self.jacobians, outcome.jacobians[chosen]))
        self._program = None
        return bool(len(chosen))


def embedded(matrix: Array, places: NDArray[np.intp], size: int) -> Array:
    """A weight of what is not left out, as one of everything; what is left out weighs most."""
    full = np.eye(size) * float(np.linalg.eigvalsh(matrix)[-1])
    if places.size:
        full[np.ix_(places, places)] = matrix
    return full


def _far_apart(jacobians: Array, count: int) -> NDArray[np.intp]:
    """Indices of Jacobians that lie far apart from each other."""
    flat = jacobians.reshape(len(jacobians), math.prod(jacobians.shape[1:]))
    size = np.ptp(flat, axis=0) if len(flat) else np.zeros(0)
    flat = flat[:, size > 0.0] / size[size > 0.0]
    chosen = [0][: len(flat)]
    away = np.linalg.norm(flat - flat[chosen], axis=1)
    while len(chosen) < count and away.max(initial=0.0) > 1e-9:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)
