"""What a folder of the gallery estimates, and the errors of an estimator on it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import qpmhe
from qpmhe.tuning import TuningRecord, Weights

Array = NDArray[np.float64]
#: From an initial state to what has ``run(y, u)`` and ``reset(start)``: an estimator.
Way = Callable[[Array], Any]


@dataclass(frozen=True, eq=False)
class Record:
    """Measurements with a truth to compare with.

    Parameters
    ----------
    name : str
        Records of one name share the lines of a table.
    measurements, inputs : (T, p) and (T, m) array
        y, NaN where it is missing, and u or None.
    truth : (T, k) array
        What the problem's error compares the estimates with; rows of NaN are not judged.
    starts : sequence of (n,) array
        Initial states; each makes a run.
    tunes : int
        The first samples, which tune the weights; the others judge them. 0: all judge.
    known : (T, n) array, optional
        The true states, as `qpmhe.tune` takes them; NaN columns where a state has none.
    """

    name: str
    measurements: Array
    inputs: Array | None
    truth: Array
    starts: Sequence[Array]
    tunes: int = 0
    known: Array | None = None

    def first(self, values: Array | None) -> Array | None:
        """The rows of the part that tunes."""
        return None if values is None else values[: self.tunes]


@dataclass(frozen=True, eq=False)
class Problem:
    """A system, records of it, and what counts as an error.

    Parameters
    ----------
    name, title : str
        Stem of the files; heading of the table.
    system : qpmhe.System
        The model; filters run without its X, moving horizon estimation with it.
    records : sequence of Record
        What is estimated.
    weights : qpmhe.tuning.Weights
        Covariances by hand, from which tuning starts; horizon, threshold and arrival of the plain
        estimator.
    error : callable
        error(estimates (T, n), truth (T, k)): the size of each sample's error (T,).
    unit : str
        Unit of the error.
    lost : float
        A run whose root mean square error is larger, or not finite, is lost.
    tuning : dict, optional
        Options of `qpmhe.tune`; None: only the weights by hand.
    own : callable, optional
        own(problem, weights): the folder's own estimators, by name.
    constant_gain : callable, optional
        constant_gain(weights): the observer of the table's first line.
    note : str
        A sentence under the table.
    """

    name: str
    title: str
    system: qpmhe.System
    records: Sequence[Record]
    weights: Weights
    error: Callable[[Array, Array], Array]
    unit: str
    lost: float
    tuning: Mapping[str, Any] | None = None
    own: Callable[[Problem, Weights], dict[str, Way]] | None = None
    constant_gain: Callable[[Weights], qpmhe.Observer] | None = None
    note: str = ""

    def estimator(
        self, start: Array, weights: Weights, observer: Any = qpmhe.ExtendedKalman,
        cost: qpmhe.Cost | None = None, **options: Any,
    ) -> qpmhe.MovingHorizonEstimator:
        """An estimator with these weights; ``observer`` makes one from covariances, or is one."""
        made = observer if isinstance(observer, qpmhe.Observer) else weights.observer(observer)
        options = {"horizon": weights.horizon, "initial_state": start, **options}
        return qpmhe.MovingHorizonEstimator(self.system, made, cost or weights.cost(), **options)

    def tuned(self, console: Any) -> Weights:
        """The weights by `qpmhe.tune` on the first part of the records that have one."""
        parts, seen = [], set()
        for record in self.records:
            # The same measurements with other starts tune once.
            if record.tunes and id(record.measurements) not in seen:
                seen.add(id(record.measurements))
                arrays = record.measurements, record.inputs, record.known
                parts.append(TuningRecord(
                    *map(record.first, arrays), initial_state=self._likeliest(record)
                ))
        w = self.weights
        options = {"horizon": w.horizon, "threshold": w.threshold, "arrival": w.arrival,
                   **(self.tuning or {})}
        tuning = qpmhe.tune(
            self.system, parts, prior=w.prior, disturbance=w.disturbance, noise=w.noise,
            progress=console, **options,
        )
        console.print(str(tuning), highlight=False, markup=False, soft_wrap=True)
        return tuning.weights

    def _likeliest(self, record: Record) -> Array:
        """The start whose predictions fit best: a wrong one would pass for disturbance."""
        if len(record.starts) == 1:
            return record.starts[0]
        quality = [self._misfit(record, start) for start in record.starts]
        return record.starts[int(np.argmin(quality))]

    def _misfit(self, record: Record, start: Array) -> float:
        """The mean square of the filter's innovations in the part that tunes."""
        y, u = record.first(record.measurements), record.first(record.inputs)
        with _quiet():
            run = self.estimator(start, self.weights, max_qps=0).run(y, u)
            inputs = np.zeros((len(y), 0)) if u is None else u
            left = y - self.system.h.batch(run.observer_states[:-1], inputs)
            return float(np.nanmean(left * left / self.weights.noise.diagonal()))


@dataclass(frozen=True, eq=False)
class Result:
    """What one estimator did on the records of one name.

    Parameters
    ----------
    weights, record, estimator : str
        Which weights, which records, and the line's name.
    errors, whole : (S,) array
        Root mean square errors of each run, of the samples that judge and of all.
    seconds, engine : float and str
        Median time of a step, and what ran it.
    lost, outside : float
        Shares of the lost runs, and of the estimates outside the system's X.
    estimates : list of (T, n) array
        Of each run.
    """

    weights: str
    record: str
    estimator: str
    errors: Array
    whole: Array
    seconds: float
    engine: str
    lost: float
    outside: float
    estimates: list[Array] = field(repr=False)

    @property
    def which(self) -> int:
        """Which run has the median error."""
        return int(np.argsort(self.errors)[(len(self.errors) - 1) // 2])

    @property
    def middle(self) -> Array:
        """The estimates of this run."""
        return self.estimates[self.which]


def judge(
    problem: Problem, weights: str, name: str, way: Way, records: Sequence[Record], compiled: bool
) -> Result:
    """Run one estimator on records of one name, from all their starts."""
    errors, whole, times, found = [], [], [], []
    with _quiet():
        mhe = way(records[0].starts[0])
        if compiled and isinstance(mhe, qpmhe.MovingHorizonEstimator):
            with suppress(qpmhe.QpmheError):  # some have no form in C
                qpmhe.compile(mhe)
            mhe = way(records[0].starts[0])
        for record in records:
            for start in record.starts:
                mhe.reset(start)
                run = mhe.run(record.measurements, record.inputs)
                estimates = run.filtered
                size = problem.error(estimates, record.truth)
                errors.append(rms(size[record.tunes :]))
                whole.append(rms(size))
                times.append(np.median(run.times))
                found.append(estimates)
    judged = np.array(errors)
    return Result(
        weights, records[0].name, name, judged, np.array(whole), float(np.median(times)),
        getattr(mhe, "engine", "python"), float(np.mean(~(judged <= problem.lost))),
        outside(problem.system, np.concatenate(found)), found,
    )


def outside(system: qpmhe.System, estimates: Array) -> float:
    """The share of estimates outside of X, by more than rounding; NaN without an X."""
    if system.states is None:
        return np.nan
    rounding = 1e-9 * np.abs(estimates).max(axis=1, keepdims=True)
    return float(np.mean([
        system.states.violation(x, rounding=slack) > 0.0
        for x, slack in zip(estimates, rounding, strict=True) if not np.isnan(x).any()
    ]))


def rms(size: Array) -> float:
    """Root mean square of the samples that have a truth; infinite where an estimate has none."""
    there = size[~np.isnan(size)]
    return float(np.sqrt(np.mean(there * there))) if there.size else np.inf



@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings of runaway filters: wrong starts are the point."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", qpmhe.ObserverWarning)
        yield
