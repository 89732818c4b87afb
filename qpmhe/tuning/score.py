"""How good an estimator is on records: its prediction error, or its error where truth is known."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np

from .._checks import Array
from ..baselines import Problem, follow
from ..baselines.base import deviations
from ..codegen import compile as compile_ahead
from ..errors import EngineWarning, ObserverWarning, QpmheError
from ..estimation.engines import python_only
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.estimator_memory import reweighted
from ..model.system import System
from ..observers import Observer
from .data import Data
from .weights import Weights

# Beyond this many robust deviations an error counts with its size only.
_OUTLYING = 3.0
# Of a part of the records, this share lets the initial error decay. Runs whose errors are kept.
_SETTLING, _KEPT = 6, 6


class Score:
    r"""Errors of the estimator along records, in units of their size at the start.

    The estimate of x(t+1) that was made with y(t) is predicted k - 1 steps on, and compared with
    y(t+k); or with the true x(t+1), where the records have one. With e the error of a component
    and s its root mean square at the start weights (1.48 times the median of :math:`|e|` with a
    robust loss), a sample's score is the mean of :math:`e^2 / s^2` over the components, in which
    errors beyond 3 s count linearly, if the loss is robust.
    """

    def __init__(
        self, data: list[Data], make: Callable[[dict[str, float]], System],
        kind: Callable[[Problem], Observer], start: Weights, *, ahead: int, truth: bool,
        begins: bool, labels: Sequence[str], options: dict[str, Any],
    ) -> None:
        self._data, self._make, self.kind = data, make, kind
        self._compiled = False
        # The first estimator of each record and horizon: those of other weights are not checked
        # again.
        self._checked: dict[tuple[int, int], MovingHorizonEstimator] = {}
        self._known: dict[tuple[Any, ...], list[Array]] = {}  # the last errors, by weights
        #: A compiled step of the model: of states and of inputs with the step's length behind them.
        self.follow: Callable[[Array, Array], Array] | None = None
        #: Seconds that a step took, the median of the last run.
        self.seconds = np.nan
        #: Steps ahead, whether the truth is compared with, and the names of what is compared.
        self.ahead, self.truth, self.labels = ahead, truth, labels
        self._robust, self._options, self._start = start.threshold is not None, options, start
        # While the initial error lasts, the score depends on all weights against the prior: where
        # that is given, Q and R would make up for it. So the first block does not tune, if there
        # are others.
        self._begins = begins
        later = [~one.held & (begins | (one.block > one.block[0])) for one in data]
        self._used = [
            mask if mask.any() else ~one.held for mask, one in zip(later, data, strict=True)
        ]

    def of(self, kind: Callable[[Problem], Observer], qps: int) -> Score:
        """The score of another estimator, in the same units: those of this one."""
        _, other = self.scale, copy(self)
        other.kind, other._options = kind, {**self._options, "max_qps": qps}
        other._checked, other._known = {}, {}
        if self._compiled:
            other.compile()
        return other

    def shortened(self, count: int) -> Score | None:
        """The one of so many samples, those of the first records; None of less than four times."""
        if sum(int((~one.held).sum()) for one in self._data) < 4 * count:
            return None
        _, short, left = self.scale, copy(self), count
        short._data, short._used, short._checked, short._known = [], [], {}, {}
        for one in self._data:
            if left > 0:
                end = int(np.searchsorted(np.cumsum(~one.held), min(left, len(one)))) + 1
                part = one.first(end)
                settled = np.arange(len(part)) >= min(left, len(part)) // _SETTLING
                short._data.append(part)
                short._used.append(~part.held & (self._begins | settled))
                left -= int((~part.held).sum())
        return short

    def typical(self, weights: Weights) -> tuple[Array, Array]:
        """The mean state, by the truth or else by the estimates, and the mean of all inputs."""
        system = self._make(weights.parameters)
        states = np.concatenate([
            self._estimates(system, weights, one) if one.truth is None or np.isnan(one.truth).any()
            else one.truth for one in self._data
        ])
        usable = states[np.isfinite(states).all(axis=1)]
        mean = deviations(system, usable, np.full(len(usable), 1.0 / len(usable)))[0]
        inputs = [one.inputs(system, weights.parameters) for one in self._data]
        return mean, np.concatenate(inputs).mean(axis=0)

    @cached_property
    def scale(self) -> Array:
        """The size of each component's error at the start weights, the unit of all others."""
        errors = np.concatenate(self.errors(self._start))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of components without any
            if self._robust:
                scale = 1.4826 * np.nanmedian(np.abs(errors), axis=0)
            else:
                scale = np.sqrt(np.nanmean(errors * errors, axis=0))
        return np.where(scale > 0.0, scale, 1.0)

    def samples(self, weights: Weights) -> list[Array]:
        """The score of each sample of each record (T,), NaN where there is nothing to compare."""
        return self.scaled(self.errors(weights))

    def scaled(self, each: list[Array]) -> list[Array]:
        """The scores of samples with these errors."""
        found = []
        for errors in each:
            scaled = np.abs(errors / self.scale)
            terms = scaled * scaled
            if self._robust:
                terms = np.where(scaled <= _OUTLYING, terms, _OUTLYING * (2 * scaled - _OUTLYING))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of samples without any
                found.append(np.nanmean(terms, axis=1))
        return found

    def compile(self) -> None:
        """Compile the step, for `qpmhe.MovingHorizonEstimator` to find, where it has a C form."""
        if self._options.get("engine", "auto") != "auto" or python_only():
            return
        self._compiled = True
        system = self._make(self._start.parameters)
        with suppress(QpmheError):
            compile_ahead(self._estimator(system, self._start, self._data[0]))

    def errors(self, weights: Weights) -> list[Array]:
        """Errors of each record (T, n) or (T, p), NaN where there is nothing to compare."""
        key = weights.key
        if key not in self._known:
            system = self._make(weights.parameters)
            found = [self._of_record(system, weights, one) for one in self._data]
            if len(self._known) == _KEPT:
                self._known.pop(next(iter(self._known)))
            self._known[key] = found
        return self._known[key]

    def total(self, weights: Weights) -> float:
        """The mean score of the samples that tune; infinite where the model fails."""
        try:
            found = self.samples(weights)
        except (QpmheError, np.linalg.LinAlgError, FloatingPointError):
            return np.inf
        used = np.concatenate([each[mask] for each, mask in zip(found, self._used, strict=True)])
        value = float(np.nanmean(used)) if np.isfinite(used).any() else np.inf
        return value if np.isfinite(value) else np.inf

    def _of_record(self, system: System, weights: Weights, one: Data) -> Array:
        states = self._estimates(system, weights, one)
        if self.truth and one.truth is not None:
            errors = np.full((len(one), system.n), np.nan)
            count = min(len(one), len(one.truth) - 1)
            errors[:count] = states[:count] - one.truth[1 : count + 1]
            if system.state_residual is not None:
                system.state_residual.wrap(errors, states)
            return errors
        errors = np.full((len(one), system.p), np.nan)
        k, count = self.ahead, len(one) - self.ahead
        if count <= 0:
            return errors
        reached, model = states[:count], system.model()
        u = one.inputs(system, weights.parameters)
        lengths = np.full(len(one), system.dt or 0.0) if one.dt is None else one.dt
        timed = np.column_stack((u, lengths))
        if one.dt is not None:
            model, u = model.timed, timed
        with np.errstate(all="ignore"):
            for j in range(1, k):
                reached = (
                    model.step(reached, u[j : count + j]) if self.follow is None
                    else self.follow(reached, timed[j : count + j])
                )
            measured = one.y[k:]
            errors[:count] = measured - model.output(reached, u[k:])
        if system.output_residual is not None:
            system.output_residual.wrap(errors[:count], measured)
        return errors

    def _estimator(self, system: System, weights: Weights, one: Data) -> MovingHorizonEstimator:
        options, problem = dict(self._options), self.problem(system, weights, one)
        if problem.parameters.size:
            options["parameters"] = problem.parameters
        observer, cost = self.kind(problem), weights.cost()
        place = id(one), weights.horizon
        known = self._checked.get(place)
        if known is not None and known.system is system and "parameters" not in options:
            return reweighted(known, observer, cost)
        made = MovingHorizonEstimator(
            system, observer, cost, horizon=weights.horizon, initial_state=one.start, **options,
        )
        self._checked[place] = made
        return made

    def problem(
        self, system: System, weights: Weights, one: Data | None = None
    ) -> Problem:
        """What the observer is made for, on the first record or another one."""
        one = one or self._data[0]
        behind = list(weights.parameters.values())[: system.m - one.u.shape[1]]
        return weights.problem(system, one.start, parameters=np.array(behind))

    def _estimates(self, system: System, weights: Weights, one: Data) -> Array:
        """The estimates of x(1), ..., x(T), each made with the y before."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ObserverWarning)
            warnings.simplefilter("ignore", EngineWarning)
            mhe = self._estimator(system, weights, one)
            u = one.u if one.u.shape[1] else None
            # One engine for all weights, so that their scores differ by no rounding.
            run = (
                mhe.run(one.y, u, may_compile=False) if one.dt is None
                else follow(mhe, one.start, one.y, u, one.dt)
            )
        self.seconds = float(np.median(run.times))
        return run.states[1:]
