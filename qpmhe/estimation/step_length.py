"""Whether the step by which an ODE is discretised is short enough for the disturbance's size."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import ModelWarning
from ..model.accuracy import MOST_SOLVED, work
from ..model.discretize import Discretization
from ..model.residuals import difference
from ..model.step_table import stepper
from ..model.system import System
from .reach import disturbance_deviations, prior_deviations, prior_points

Array = NDArray[np.float64]

# A step that is off by more than this many standard deviations of w is too long. An Euler step is
# a coarse map by choice, which often is what the data were simulated with.
_TOO_LONG = {"euler": 10.0}
_USUALLY_TOO_LONG = 0.1
# So many of them say that it is the step by which a model fails.
_FAR_TOO_LONG = 100.0
# Numbers of substeps that a warning tries, by method.
_EXPLICIT, _IMPLICIT = (2, 4, 8, 16, 32, 64), (1, 2, 4, 8, 16)
# What other methods are compared with, in at most so many substeps, and at so many points.
_REFERENCE, _MOST_SUBSTEPS, _MOST_POINTS = "radau", 4, 6
# Points of an implicit step, by the operations of a solution: this many over n cubed.
_MOST_SOLVES = 1e7


@dataclass(frozen=True)
class StepError:
    """The largest difference of a step from finer ones, over some points.

    Attributes
    ----------
    deviations : float
        The difference in standard deviations of G w, or where that has none of the prior.
    component : int
        The state in which it is so large.
    point, inputs : (n,) array, (m,) array
        Where it is so large.
    most : float
        The largest difference that does no harm, for this method.
    finer : str
        The other step, in words.
    """

    deviations: float
    component: int
    point: Array
    inputs: Array
    most: float
    finer: str = "that of half the length"

    @property
    def is_harmless(self) -> bool:
        """Whether it is at most that large."""
        return self.deviations <= self.most


class StepComparison:
    """Steps of an ODE compared with others, at the initial state and at points of the prior.

    Parameters
    ----------
    system, cost, covariance, state
        As for `reached`.
    u : (m,) or (k, m) array
        The inputs, or several of them, each of which is tried at all points.
    """

    def __init__(
        self, system: System, cost: Cost, covariance: Array | None, state: Array, u: Array
    ) -> None:
        self._system, prior = system, prior_deviations(cost, covariance)
        points, inputs = prior_points(system, state, prior), np.atleast_2d(u)
        how = system.origin.how
        if how is not None and how.is_implicit:
            most = max(_MOST_POINTS, int(_MOST_SOLVES / system.n**3))
            points = points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.intp)]
        self._points = np.tile(points, (len(inputs), 1))
        self._inputs = np.repeat(inputs, len(points), axis=0)
        units = disturbance_deviations(system, cost)
        self._units = np.where(units > 0.0, units, prior)
        # The initial state with each input, and each input's last point.
        first = np.arange(len(inputs)) * len(points)
        few = np.column_stack((first, first + len(points) - 1)).ravel()
        self._few = few[:_MOST_POINTS]
        self._solved: dict[int, Array] = {}  # the reference there, by its substeps

    def error(self) -> StepError | None:
        """One step against two of half the length, and a solved one; None where none is finite."""
        system = self._system
        assert system.dt is not None
        step, half = (
            np.column_stack((self._inputs, np.full(len(self._inputs), one)))
            for one in (system.dt, 0.5 * system.dt)
        )
        f = system.timed.f.batch
        one, two = f(self._points, step), f(f(self._points, half), half)
        return self._error(one, two, system.origin.how)

    def others(self) -> Iterator[tuple[Discretization, StepError]]:
        """Other discretisations and their errors, for each method up to the first fine one."""
        how = self._system.origin.how
        if how is None:
            return
        own: list[tuple[str, tuple[int, ...]]] = [(_REFERENCE, _IMPLICIT)]
        if not how.is_implicit:
            own.insert(0, (how.method, _EXPLICIT))
        made = stepper(self._system)

        def stepped(one: Discretization) -> Array:
            return made(one)(self._length(len(self._points)), self._points, self._inputs)

        for method, counts in own:
            if method == _REFERENCE != how.method and self._system.n > MOST_SOLVED:
                continue
            for steps in counts:
                other = Discretization(method, steps)
                error = self._error(
                    stepped(other), stepped(other._replace(steps=2 * steps)), other)
                if error is None:
                    continue
                yield other, error
                if error.is_harmless:
                    break

    def remedy(self) -> str:
        """The cheapest discretisation whose error is small enough, as arguments; blank for none."""
        fine = [(work(how), error.deviations, how)
                for how, error in self.others() if error.is_harmless]
        if not fine:
            return ""
        *_, how = min(fine)
        texts = [f"method={how.method!r}"] if how.method != self._system.method else []
        texts += [f"steps={how.steps}"] if how.steps > 1 else []
        return " with ".join(texts)

    def _error(
        self, one: Array, finer: Array, how: Discretization | None
    ) -> StepError | None:
        """Of steps at all points, the largest difference from finer ones or from solved ones."""
        shares = self._shares(one, finer)
        finite = np.isfinite(one), np.isfinite(finer)
        # A model that is not finite either way is outside of its domain, else the step exploded.
        shares[~finite[0] | ~finite[1]] = np.inf
        shares[~finite[0].all(axis=1) & ~finite[1].all(axis=1)] = -1.0
        most = _most(None if how is None else how.method)
        found = [self._worst(shares, np.arange(len(one)), most)]
        if how is not None and how.method != _REFERENCE and not found[0].deviations > most:
            with suppress(Exception):  # outside of the functions' domain
                found += self._against_solved(one[self._few], how, most)
        worst = max(found, key=lambda error: error.deviations)
        return None if worst.deviations < 0.0 else worst

    def _against_solved(self, one: Array, how: Discretization, most: float) -> list[StepError]:
        """Steps at few points against the reference, where that is accurate; often at once."""
        if self._system.n > MOST_SOLVED:
            return []
        steps = min(how.steps, _MOST_SUBSTEPS)
        coarse = self._reference(steps)
        shares = self._shares(one, coarse)
        if (shares <= most).all():
            return []
        fine = self._reference(2 * steps)
        shares, own = self._shares(one, fine), self._shares(coarse, fine)
        exploded = ~np.isfinite(one) & np.isfinite(coarse) & np.isfinite(fine)
        shares[exploded] = np.inf
        # What the reference itself is not sure of says nothing.
        shares[~exploded & ~(own <= 0.5 * shares)] = -1.0
        words = f"that of {Discretization(_REFERENCE, 2 * steps).words}"
        return [replace(self._worst(shares, self._few, most), finer=words)]

    def _reference(self, steps: int) -> Array:
        if steps not in self._solved:
            made, at = stepper(self._system)(Discretization(_REFERENCE, steps)), self._few
            self._solved[steps] = made(self._length(len(at)), self._points[at], self._inputs[at])
        return self._solved[steps]

    def _length(self, count: int) -> Array:
        assert self._system.dt is not None
        return np.full(count, self._system.dt)

    def _shares(self, one: Array, other: Array) -> Array:
        shares: Array = np.abs(difference(self._system.state_residual, one, other)) / self._units
        return shares

    def _worst(self, shares: Array, rows: NDArray[np.intp], most: float) -> StepError:
        k, j = np.unravel_index(int(np.argmax(shares)), shares.shape)
        row = rows[k]
        return StepError(
            float(shares[k, j]), int(j), self._points[row], self._inputs[row], most
        )


class StepCheck:
    """What an estimator says of the step of its discretised ODE where that is too long.

    Parameters
    ----------
    cost, covariance
        As for `reached`.
    """

    def __init__(self, cost: Cost, covariance: Array | None) -> None:
        self._cost, self._covariance = cost, covariance
        self._known = 0.0  # the error of which the user has been warned
        self._range: tuple[Array, Array] | None = None  # of the inputs so far

    def warn(self, system: System, state: Array, u: Array, level: int) -> None:
        """Warn, at a level of the stack, where the step is too long.

        Arguments are those of `StepComparison`. Later errors are worth a warning where they are ten
        times as large as the last one of which there was one.
        """
        found = _comparison(system, self._cost, self._covariance, state, u)
        if found is None or found[1].is_harmless or not found[1].deviations > 10.0 * self._known:
            return
        comparison, error = found
        self._known = error.deviations
        point = np.array2string(error.point, precision=4, separator=", ")
        if error.inputs.any():
            point += f" with u = {np.array2string(error.inputs, precision=4, separator=', ')}"
        differs = (
            f"differs from {error.finer} by {error.deviations:.2g} standard deviations of the "
            f"disturbance in state {error.component} (expected at most {error.most:g})"
            if np.isfinite(error.deviations) else
            f"and {error.finer} are not both finite in state {error.component}"
        )
        warnings.warn(
            f"{_named(system)} is too long: from x = {point} the result {differs}, so estimates "
            f"may be wrong though each step improves its cost: {_remedy(comparison)}. Or make the "
            "covariance of the disturbance as large as the error.",
            ModelWarning,
            stacklevel=level + 1,
        )

    def new_inputs(self, inputs: Array) -> Array:
        """Of the finite inputs (T, m), the outermost ones if they lie beyond those so far, by half.

        An input that creeps or jitters is new a few times, not at each sample.
        """
        inputs = inputs[np.isfinite(inputs).all(axis=1)]
        if not len(inputs):
            return inputs
        least, most = inputs.min(axis=0), inputs.max(axis=0)
        if self._range is not None:
            low, high = self._range
            margin = 0.5 * (high - low)
            if (least >= low - margin).all() and (most <= high + margin).all():
                return inputs[:0]
            least, most = np.minimum(least, low), np.maximum(most, high)
        self._range = least, most
        rows = {0, *np.argmax(inputs, axis=0).tolist(), *np.argmin(inputs, axis=0).tolist()}
        return inputs[sorted(rows)]

    def explosion(self, system: System, states: Iterable[Array], u: Array) -> str:
        """Why a model may fail: a step that is far too long near some states, and the remedy.

        Blank where it is not. Other arguments are those of `StepComparison`.
        """
        for state in states:
            found = _comparison(system, self._cost, self._covariance, state, u)
            if found is not None and found[1].deviations > _FAR_TOO_LONG:
                step = _named(system)
                return (
                    f"{step[0].upper()}{step[1:]} is far too long near such states: "
                    f"{_remedy(found[0])}."
                )
        return ""


def step_error(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array
) -> StepError | None:
    """Compare one step of a discretised ODE with two of half the length, and with an implicit one.

    Arguments are those of `StepComparison`. None without a model in continuous time, and where no
    step is finite.
    """
    comparison = _comparison(system, cost, covariance, state, u)
    return None if comparison is None else comparison[1]


def step_errors(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array
) -> list[tuple[Discretization, StepError]]:
    """The errors of its own discretisation, and of others if that is too long; see `step_error`."""
    found = _comparison(system, cost, covariance, state, u)
    if found is None or system.origin.how is None:
        return []
    errors = [(system.origin.how, found[1])]
    if not found[1].is_harmless:
        with suppress(Exception), np.errstate(all="ignore"):
            errors += found[0].others()
    return errors


def _named(system: System) -> str:
    steps = f"{system.steps} substeps" if system.steps > 1 else "one step"
    return f"{steps} of {system.method} in dt = {system.dt:g}"


def _remedy(comparison: StepComparison) -> str:
    remedy = ""
    with suppress(Exception), np.errstate(all="ignore"):
        remedy = comparison.remedy()
    return (
        f"{remedy} is fine enough" if remedy
        else "take more substeps (steps=), or for stiff rates method='radau'"
    )


def _most(method: str | None) -> float:
    return _TOO_LONG.get(method or "", _USUALLY_TOO_LONG)


def _comparison(
    system: System, cost: Cost, covariance: Array | None, state: Array, u: Array
) -> tuple[StepComparison, StepError] | None:
    """The comparison and the error; None where there is none."""
    if system.dt is None or not system.has_timed:
        return None
    # A model outside of its domain; the steps will report that.
    with suppress(Exception), np.errstate(all="ignore"):
        comparison = StepComparison(system, cost, covariance, state, u)
        error = comparison.error()
        return None if error is None else (comparison, error)
    return None
