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
from ..model.discretize import Discretization
from ..model.evaluation import Evaluator, machine
from ..model.residuals import difference
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


@dataclass(frozen=True)
class StepError:
    """The largest difference between one step and two half steps, over some points.

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
    """

    deviations: float
    component: int
    point: Array
    inputs: Array
    most: float

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
        self._points = np.tile(points, (len(inputs), 1))
        self._inputs = np.repeat(inputs, len(points), axis=0)
        units = disturbance_deviations(system, cost)
        self._units = np.where(units > 0.0, units, prior)
        #: What is too large an error, in standard deviations.
        self.most = _most(system.method)

    def error(self) -> StepError | None:
        """One step against two of half the length; None where no step is finite."""
        system = self._system
        assert system.dt is not None
        step, half = (
            np.column_stack((self._inputs, np.full(len(self._inputs), one)))
            for one in (system.dt, 0.5 * system.dt)
        )
        f = system.timed.f.batch
        return self._largest(f(self._points, step), f(f(self._points, half), half))

    def others(self) -> Iterator[tuple[Discretization, StepError]]:
        """Other discretisations and their errors, for each method up to the first fine one.

        None without an expression.
        """
        model = self._system.symbolic
        if model is None or model.how is None:
            return
        own: list[tuple[str, tuple[int, ...]]] = [("radau", _IMPLICIT)]
        if not model.how.is_implicit:
            own.insert(0, (model.how.method, _EXPLICIT))

        def stepped(how: Discretization) -> Array:
            evaluator = Evaluator(machine(replace(model, how=how), False))
            return evaluator.one("f", self._points, self._inputs)

        for method, counts in own:
            for steps in counts:
                one, other = (stepped(Discretization(method, k)) for k in (steps, 2 * steps))
                error = self._largest(one, other)
                if error is None:
                    continue
                error = replace(error, most=_most(method))
                yield Discretization(method, steps), error
                if error.is_harmless:
                    break

    def remedies(self) -> list[str]:
        """Discretisations whose error is small enough, as arguments."""
        found = []
        for how, error in self.others():
            if error.is_harmless:
                texts = [f"method={how.method!r}"] if how.method != self._system.method else []
                texts += [f"steps={how.steps}"] if how.steps > 1 else []
                found.append(" with ".join(texts))
        return [one for one in found if one]

    def _largest(self, one: Array, other: Array) -> StepError | None:
        shares = np.abs(difference(self._system.state_residual, one, other)) / self._units
        finite = np.isfinite(one), np.isfinite(other)
        # A model that is not finite either way is outside of its domain, else the step exploded.
        shares[~finite[0] | ~finite[1]] = np.inf
        shares[~finite[0].all(axis=1) & ~finite[1].all(axis=1)] = -1.0
        k, j = np.unravel_index(int(np.argmax(shares)), shares.shape)
        if shares[k, j] < 0.0:
            return None
        return StepError(
            float(shares[k, j]), int(j), self._points[k], self._inputs[k], self.most
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
            f"differs from that of half the length by {error.deviations:.2g} standard deviations "
            f"of the disturbance in state {error.component} (expected at most {error.most:g})"
            if np.isfinite(error.deviations) else
            f"and that of half the length are not both finite in state {error.component}"
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
    """Compare one step of a discretised ODE with two of half the length.

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
    remedies: list[str] = []
    with suppress(Exception), np.errstate(all="ignore"):
        remedies = comparison.remedies()
    return (
        f"{' or '.join(remedies)} is fine enough" if remedies
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
