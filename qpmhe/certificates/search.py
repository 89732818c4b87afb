"""The search for a matrix inequality that holds on a region, and its verification."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._checks import Array, positive, vector
from ..model.residuals import Angles
from ..model.system import System
from .branch_and_bound import Cover, cover
from .deadline import LEAST_SECONDS, PART_SECONDS, Deadline
from .enclosures import Enclosure, SmoothModel, evaluated, joint_jacobians
from .evidence import CertificateError, Evidence, NotCertifiedError, OutOfTimeError
from .inequalities import Form, Matrices, definite
from .regions import Region
from .sdp import (
    Answer,
    DetectabilityProgram,
    GainProgram,
    Kind,
    NoiseSizes,
    ObserverProgram,
    Program,
    Scales,
    expected_seconds,
)
from .theorem import checked_rate

_SAMPLES = 400
_ROUNDS = 8
_MARGINS = (1e-6, 1e-4, 1e-3, 1e-2)
# Of what a rate that is not given leaves to 1: few cells suffice where there is room.
_ROOM = (0.03, 0.06, 0.12, 0.25)
# Where one program takes longer than so many seconds, these rates are tried in turn, with more
# room and fewer Jacobians.
_LONG, _RATES, _WIDE_ROOM = 0.3, (0.9, 0.95, 0.98), (0.2, 0.4, 0.6)
_FEW_POINTS = 4
_FEW_CELLS = 100
_TOLERANCE = 1e-3  # of the smallest rate
_LARGEST_RATE = 0.9999
# Above the smallest feasible rate, at which constants may grow without bound, and how often
# to go three times as far.
_ABOVE, _ATTEMPTS = 0.01, 4
# Between the smallest rate, where constants grow without bound, and 1, where they last.
_SHARES = (0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
_REFINEMENTS = 3  # of the best of them, each by two more programs
_SEED = 20210829
_ROUNDING = 1e-12  # of a state that f keeps
_PAIRS = 2000
# How much of the time the choice of a rate may take, and one verification; how many programs
# the former solves; how far off the time that a program is expected to take may be.
_CHOICE, _VERIFICATION = 0.5, 0.6
_PROGRAMS, _MISJUDGED = 20, 4.0
_MOST_POINTS = 24  # Jacobians that a program starts with


@dataclass(frozen=True, eq=False)
class Found:
    """An inequality and how far it was shown."""

    form: Form  # filled in
    evidence: Evidence
    margin: float  # margin and cells are those of `Cover`
    cells: int
    notes: tuple[str, ...]


class _BrokenPairError(NotCertifiedError):
    """No matrix helps where f or h jumps."""


class FreeModel:
    """A model's Jacobians by some of its states, where f keeps the others at their values."""

    def __init__(self, model: SmoothModel, free: NDArray[np.intp]) -> None:
        self._model, self._free = model, free
        self.n, self.p = model.n, model.p
        self.reason, self.affine_output = model.reason, model.affine_output
        self._rows = np.append(free, model.n + np.arange(model.p))

    @property
    def unknown(self) -> str:
        """As `SmoothModel.unknown`."""
        return self._model.unknown

    def enclose(self, lower: Array, upper: Array) -> Enclosure:
        """As `SmoothModel.enclose`; nothing is known where f is not shown to keep the others."""
        found, kept = self._model.enclose(lower, upper), np.ones(self.n, np.bool_)
        kept[self._free] = False
        moves = (
            np.abs(found.centre) + np.abs(found.slopes).sum(axis=1) + found.error
        )[:, : self.n][:, kept][:, :, self._free].any(axis=(1, 2))
        rows, columns = self._rows[:, None], self._free
        return Enclosure(
            found.centre[:, rows, columns], found.slopes[:, :, rows, columns],
            np.where(moves[:, None, None], np.nan, found.error[:, rows, columns]), found.excess,
            found.jacobian[:, rows, columns],
        )


class Search:
    """Programs at some states, verification at all of them, and more states where it fails.

    ``kind=None`` takes the form of detectability that the output allows. The sizes are those of
    disturbance and noise; for detectability, two numbers that say how much they matter.

    A state that the region fixes, such as a known parameter, has no error. It is left out where
    f keeps it at its value, whatever the others do, and the gain does not move it. Jacobians,
    scales, gain and forms are of the states in ``free`` only, and of the disturbances in ``acting``
    that move none of the fixed states.
    """

    def __init__(
        self, system: System, region: Region, kind: Kind | None, sizes: NoiseSizes,
        gain: Array | None = None, seconds: float | Deadline = PART_SECONDS,
    ) -> None:
        self._deadline = Deadline.of(seconds)
        self.system, self.region, self.gain, self._sizes = system, region, gain, sizes
        if kind is None:
            if system.output_residual is not None or system.state_residual is not None:
                raise CertificateError(
                    "the system has angles, whose differences may wrap: only an observer is "
                    "certified, within a region where they do not. Leave the residuals out for "
                    "detectability, with outputs and states that do not wrap within the region."
                )
            first, second = vector("weights", np.asarray(sizes), 2).tolist()
            self._weights = positive("weights[0]", first), positive("weights[1]", second)
        self.points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
        jacobians, n = joint_jacobians(system, self.points), system.n
        fixed = (region.lower == region.upper)[:n]
        self.free = np.flatnonzero(~fixed)
        self.model: SmoothModel | FreeModel = SmoothModel(system, region)
        self._matrix, self.acting = system.disturbance_matrix, np.arange(system.r)
        if fixed.any():
            self._leave_out(fixed, jacobians)
        rows = np.append(self.free, n + np.arange(system.p))
        self.jacobians = jacobians[:, rows[:, None], self.free]
        self.n = self.free.size
        if kind is None:
            outputs = self.jacobians[:, self.n :]
            same = self.model.affine_output or (
                bool(self.model.reason) and np.ptp(outputs, axis=0).max() == 0.0
            )
            kind = "output weight" if same else "output injection"
        self.kind: Kind = kind
        each = expected_seconds(self.n, system.p, kind)
        affordable = _CHOICE * self._deadline.left / (_PROGRAMS * each)
        self._long = each * _MOST_POINTS > _LONG
        most = _FEW_POINTS if self._long else _MOST_POINTS
        self._chosen = _far_apart(self.jacobians, int(np.clip(affordable, 1, most)))
        if not self.model.reason and "given" in (
            system.f_jacobian.method, system.h_jacobian.method
        ):
            # What is given may be wrong, and would make the program another one.
            chosen = self.points[self._chosen]
            true = self.model.enclose(chosen, chosen).centre
            self.jacobians[self._chosen] = np.where(
                np.isfinite(true), true, self.jacobians[self._chosen]
            )
        self.scales = _typical_scales(region, self.jacobians, self.free)
        self._program: Program | None = None
        self._few = False  # whether few cells must do
        self.notes = self._angles()

    def _angles(self) -> tuple[str, ...]:
        """How large noises of angles may be, so that innovations in the region do not wrap."""
        angles, m = self.system.output_residual, self.region.lower[None]
        if not isinstance(angles, Angles):
            return ()
        if not isinstance(self.model, SmoothModel) or self.model.reason:
            raise CertificateError(
                "the outputs' angles have no enclosure, so that it is not known where they wrap"
            )
        outputs = self.model.values(m, self.region.upper[None])
        first = self.model.n + angles.components
        width = (outputs.high - outputs.low)[0, first]
        half = 0.5 * np.asarray(angles.periods)
        room = half - width
        largest = np.broadcast_to(np.asarray(self._sizes[1]), (self.system.p,))[angles.components]
        if not (room > largest).all():
            k = int(np.argmin(room - largest))
            raise NotCertifiedError(
                f"the angle y[{angles.components[k]}] may wrap: it moves by up to {width[k]:.3g} "
                f"in the region, and by the noise, {largest[k]:.3g}, and half a period is "
                f"{half[k]:.3g}", ("a smaller region",),
            )
        return tuple(
            f"the noise of the angle y[{j}] is less than {each:.4g}: then no innovation wraps"
            for j, each in zip(angles.components, np.floor(room * 1e4) / 1e4, strict=True)
        )

    def _leave_out(self, fixed: NDArray[np.bool_], jacobians: Array) -> None:
        """Leave the states out that the region fixes; an error if it cannot be done."""
        states, n = self.points[:, : self.system.n], self.system.n
        ahead = evaluated("f", self.system.f, states, self.points[:, n:])
        kept = np.abs(ahead - states) <= _ROUNDING * np.abs(states)
        moved = fixed & ~(kept.all(axis=0) & ~jacobians[:, :n][:, :, ~fixed].any(axis=(0, 2)))
        corrected = fixed & (False if self.gain is None else self.gain.any(axis=1))
        for who, which in (("f", moved), ("the observer's gain", corrected)):
            if which.any():
                names = ", ".join(f"x[{j}]" for j in np.flatnonzero(which))
                raise NotCertifiedError(
                    f"the region has no width in {names}, but {who} moves it",
                    ("a region with some width there", "a gain with a row of zeros there")
                    if who != "f" else ("a region with some width there",),
                )
        if not self.free.size:
            raise NotCertifiedError(
                "the region is a single state, which has nothing to estimate",
                ("a region with some width",),
            )
        G = np.eye(n) if self._matrix is None else self._matrix
        self.acting = np.flatnonzero(~G[fixed].any(axis=0) & G[~fixed].any(axis=0))
        self._matrix = G[np.ix_(self.free, self.acting)]
        if self.gain is not None:
            self.gain = self.gain[self.free]
        w, v = self._sizes
        if np.shape(w) == (self.system.r,):
            self._sizes = np.asarray(w)[self.acting], v
        if not self.acting.size:
            self._matrix, self._sizes = None, (0.0, v)
        if isinstance(self.model, SmoothModel):
            self.model = FreeModel(self.model, self.free)

    def embedded(self, matrix: Array, places: NDArray[np.intp], size: int) -> Array:
        """A weight of what is not left out, as one of everything; what is left out weighs most."""
        if places.size == size:
            return matrix
        full = np.eye(size) * float(np.linalg.eigvalsh(matrix)[-1])
        if places.size:
            full[np.ix_(places, places)] = matrix
        return full

    @property
    def program(self) -> Program:
        """The program at the states chosen so far."""
        if self._program is None:
            at, matrix = (self.jacobians[self._chosen], self.scales), self._matrix
            if self.gain is not None:
                self._program = ObserverProgram(*at, self._sizes, self.gain, matrix)
            elif self.kind == "synthesis":
                self._program = GainProgram(*at, self._sizes, matrix)
            else:
                self._program = DetectabilityProgram(self.kind, *at, self._weights)
        return self._program

    def _smallest_rate(self) -> float:
        """The smallest feasible rate at the chosen states, infinite if none below 1 is.

        Where the time is over before, the smallest one that was tried and is.
        """
        deadline = self._deadline.part(_CHOICE)
        low, high = 0.0, _LARGEST_RATE
        if self._feasible(high, deadline).form is None:
            return np.inf
        while high - low > _TOLERANCE * (1.0 - low):
            middle = 0.5 * (low + high)
            try:
                answer = self._feasible(middle, deadline)
            except OutOfTimeError:
                break
            if answer.form is None:
                low = middle
            else:
                high = middle
        return high

    def answer(
        self, name: str, rate: float | None, advice: tuple[str, ...],
        why: Callable[[Search, str], NotCertifiedError],
    ) -> Found:
        """An inequality with this rate, or with the best; `why` says why none is feasible."""
        if rate is not None:
            checked_rate(name, rate)
        try:
            return self._find_best() if rate is None else self._find(rate)
        except OutOfTimeError:
            raise
        except NotCertifiedError as error:
            try:
                smallest = self._smallest_rate()
            except OutOfTimeError:
                raise error from None
            if not np.isfinite(smallest):
                raise why(self, error.finding) from error
            helps = (*error.suggestions, f"a larger {name}", *advice, "a smaller region")
            raise NotCertifiedError(
                f"{error.finding}. Feasible at the states tried: {name} from {smallest:.4g} on",
                tuple(dict.fromkeys(helps)), smallest,
            ) from error

    def _feasible(self, rate: float, deadline: Deadline) -> Answer:
        return self._solved(rate, _MARGINS[0] * min(1.0, rate * rate), deadline)

    def _solved(self, rate: float, margin: float, deadline: Deadline) -> Answer:
        """What the program returns; an error if there is no time for it, or not enough."""
        if deadline.passed:
            raise self._out_of_time("it was over while matrices were sought and verified")
        if self.program.expected_seconds > _MISJUDGED * deadline.left:
            raise self._out_of_time(
                f"a semidefinite program for {self.system.n} states takes about "
                f"{self.program.expected_seconds:.2g} s, and {deadline.left:.2g} s were left"
            )
        answer = self.program.solve(rate, margin, deadline.left)
        if answer.status == "user_limit" and deadline.passed:
            raise self._out_of_time(
                f"a semidefinite program for {self.system.n} states was not solved in time"
            )
        return answer

    def _out_of_time(self, what: str) -> OutOfTimeError:
        given = self._deadline.seconds
        time = (
            f"the time for this search ({given:.3g} s) was too short" if given > LEAST_SECONDS else
            "no time was left for this search"
        )
        return OutOfTimeError(
            f"{time}: {what}",
            ("more seconds", "a given rate, which spares the search for one", "a smaller model"),
        )

    def _best_rate(self, smallest: float) -> float:
        """The rate with the smallest measure of what lasting disturbances and noises make."""
        deadline, room = self._deadline.part(_CHOICE), 1.0 - smallest
        measures: dict[float, float] = {}

        def measure(share: float) -> float:
            if share not in measures:
                rate = smallest + share * room
                margin = self._margins(rate, given=False)[1]
                measures[share] = self._solved(rate, margin, deadline).objective
            return measures[share]

        with contextlib.suppress(OutOfTimeError):
            best = min(_SHARES, key=measure)
            around = (0.0, *_SHARES, 1.0)
            low, high = (around[around.index(best) + step] for step in (-1, 1))
            for _ in range(_REFINEMENTS):
                sides = 0.5 * (low + best), 0.5 * (best + high)
                nearest = min((best, *sides), key=measure)
                if nearest == sides[0]:
                    high = best
                elif nearest == sides[1]:
                    low = best
                else:
                    low, high = sides
                best = nearest
        known = {share: value for share, value in measures.items() if np.isfinite(value)}
        return smallest + min(known, key=known.__getitem__, default=0.0) * room

    def _find_best(self) -> Found:
        """An inequality with the best rate found."""
        share, refused = _ABOVE, NotCertifiedError("no rate was tried")
        if self._long:
            for rate in _RATES:
                try:
                    return self._find(rate, given=False)
                except (OutOfTimeError, _BrokenPairError):
                    raise
                except NotCertifiedError as error:
                    refused = error
            raise refused
        for _ in range(_ATTEMPTS):
            smallest = self._smallest_rate()
            if not np.isfinite(smallest):
                raise NotCertifiedError(
                    "no rate below 1 was found for which the semidefinite program is feasible"
                )
            rate = max(smallest + share * (1.0 - smallest), self._best_rate(smallest))
            try:
                return self._find(rate, given=False)
            except (OutOfTimeError, _BrokenPairError):
                raise
            except NotCertifiedError as error:
                # What failed has left more states in the program, and moves the smallest rate.
                refused, share = error, 3.0 * share
        raise refused

    def _margins(self, rate: float, given: bool) -> list[float]:
        """The margins to try in turn."""
        least = [each * min(1.0, rate * rate) for each in _MARGINS]
        if self._long:
            return [each * (1.0 - rate * rate) for each in _WIDE_ROOM]
        if given or self.kind not in ("observer", "synthesis"):
            return least
        return [least[0], *(each * (1.0 - rate * rate) for each in _ROOM)]

    def _find(self, rate: float, *, given: bool = True) -> Found:
        """An inequality with this rate, verified as far as can be."""
        level, margins = 0, self._margins(rate, given)
        best: Found | None = None
        status = "no round was left"
        for turn in range(1, _ROUNDS + 1):
            try:
                answer = self._solved(rate, margins[level], self._deadline)
                if isinstance(self.program, GainProgram):
                    answer = self.program.improved(
                        answer, margins[level], self._deadline.left
                    )
            except OutOfTimeError:
                if best is None:
                    raise
                break
            if answer.form is None:
                status = answer.status
                break
            # Where a few cells do, as for affine models, no room is needed.
            self._few = not given and level == 0
            outcome = self._verified(answer.form)
            if isinstance(outcome, Found):
                if outcome.evidence is Evidence.PROVED or self.model.reason:
                    return outcome
                best = outcome
            elif self._added(outcome) and turn % 2 and not self._long:
                continue
            if level + 1 == len(margins):
                break
            level += 1
        if best is not None:
            return best
        raise NotCertifiedError(
            f"the semidefinite program for the rate {rate:.6g} is {status}"
            if status == "infeasible"
            else f"no matrix that passes the verification was found for the rate {rate:.6g} "
            f"(solver status: {status})"
        )

    def _verified(self, form: Form) -> Found | Cover:
        """What was shown, or the cover with the states where the inequality fails."""
        if not all(definite(each)[0].all() for each in form.constants()):
            return Cover(False, 0, 0.0, np.empty((0, 0)), np.empty((0, 0, 0)))
        if self.model.reason:
            return self._sampled(
                form, f"f and h cannot be run with intervals ({self.model.reason})"
            )
        limit = {"most_cells": _FEW_CELLS} if self._few else {}
        found = cover(
            self.model, self.region, form, seconds=self._deadline.part(_VERIFICATION), **limit
        )
        if found.proved:
            return Found(form, Evidence.PROVED, found.margin, found.cells, ())
        if found.violations.shape[0]:
            return found
        end = ", when its time was over" if found.late else ""
        return self._sampled(
            form, f"the proof was given up after dividing the region into {found.cells} cells{end}"
            f"{self.model.unknown}",
        )

    def _sampled(self, form: Form, why: str) -> Found | Cover:
        shown, least = definite(form.matrices(Matrices.exact(self.jacobians)))
        if not shown.all():
            broken = ~shown
            return Cover(False, 0, float(least.min()), self.points[broken], self.jacobians[broken])
        self._check_pairs(form)
        note = f"{why}; the inequality holds at {self.points.shape[0]} states of the region"
        return Found(form, Evidence.SAMPLED, float(least.min()), 0, (note,))

    def _check_pairs(self, form: Form) -> None:
        """Raise where the inequality does not hold between two of the samples."""
        n, rng = self.system.n, np.random.default_rng(_SEED)
        start, end = self.points[rng.integers(len(self.points), size=(2, _PAIRS))]
        fixed = np.setdiff1d(np.arange(start.shape[1]), self.free)
        end[:, fixed] = start[:, fixed]
        df, dh = (
            evaluated(name, function, end[:, :n], end[:, n:])
            - evaluated(name, function, start[:, :n], start[:, n:])
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
        if not outcome.violations.shape[0]:
            return False
        chosen = _far_apart(outcome.jacobians, 6)
        count = self.jacobians.shape[0]
        self.points = np.vstack((self.points, outcome.violations[chosen]))
        self.jacobians = np.concatenate((self.jacobians, outcome.jacobians[chosen]))
        self._chosen = np.append(self._chosen, np.arange(count, count + len(chosen)))
        self._program = None
        return True


def _far_apart(jacobians: Array, count: int = _MOST_POINTS) -> NDArray[np.intp]:
    """Indices of Jacobians that lie far apart from each other."""
    flat = jacobians.reshape(jacobians.shape[0], -1)
    size = np.ptp(flat, axis=0)
    flat = flat[:, size > 0.0] / size[size > 0.0]
    chosen = [0]
    if flat.shape[1]:
        away = np.linalg.norm(flat - flat[0], axis=1)
        while len(chosen) < count and away.max() > 1e-9:
            chosen.append(int(away.argmax()))
            away = np.minimum(away, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)


def _typical_scales(region: Region, jacobians: Array, free: NDArray[np.intp]) -> Scales:
    """Sizes of outputs on a region, and of the states that are not fixed."""
    states = 0.5 * (region.upper - region.lower)[free]
    states = np.maximum(states / states.max(), 1e-6)
    outputs = np.abs(jacobians[:, free.size :] * states).sum(axis=2).max(axis=0)
    return Scales(states, np.where(outputs > 0.0, outputs, 1.0))

