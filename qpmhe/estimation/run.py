"""The results of a run over a whole record."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import need, numbers
from ..costs import Cost
from ..errors import InvalidInputError, ShapeError
from ..model.system import System
from ..observers import Observer
from .estimate import Estimate, Status
from .settings import Settings
from .time_index import elapsed_times, read_index, stored_index, unit_name

if TYPE_CHECKING:
    import pandas

    from .estimator import MovingHorizonEstimator

Array = NDArray[np.float64]
Integers = NDArray[np.intp]


_PER_STEP = (
    "filtered", "costs", "candidate_costs", "times", "solve_times", "qps", "solver_iterations",
    "rejected_sensors",
)
_TEXTS = ("engine", "engine_reason")


class RunSource(NamedTuple):
    """What produced a run, by reference.

    Parameters
    ----------
    system, observer, cost, settings : System, Observer, Cost and Settings
        The estimator's, including changes by `MovingHorizonEstimator.set`.
    measurements : (T, p) array
        y, NaN where it is missing.
    inputs : (T, m) array or None
        u, with the parameters last; None for a system without inputs.
    steps : (T,) array or None
        Step lengths; None if all are usual.
    time_unit : str or pandas.Timedelta
        The model's unit of time.
    labels : sequence of str or None
        Names of the states, if the user has given any.
    """

    system: System
    observer: Observer
    cost: Cost
    settings: Settings
    measurements: Array
    inputs: Array | None
    steps: Array | None = None
    time_unit: Any = "s"
    labels: Sequence[str] | None = None


def deviations(covariances: Array) -> Array:
    """Standard deviations (T, n) of covariances (T, n, n)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))


class FixedLag:
    """Collects x(t - lag) from the windows of successive updates, with covariances if wanted."""

    def __init__(self, start: Array, lag: int, covariances: bool) -> None:
        self._lag, self._taken = lag, 0
        self._states: list[Array] = []
        self._covariances: list[Array] | None = [] if covariances else None
        self._window, self._errors = start[None], np.full((1, start.size, start.size), np.nan)

    def add(self, estimate: Estimate, errors: Array | None) -> None:
        """Take a window, and the covariances of its trajectory if they are wanted."""
        self._window = estimate.trajectory.copy()
        self._window[-2] = estimate.filtered
        if errors is not None:
            self._errors = errors
        if self._taken >= self._lag:
            self._states.append(self._window[-2 - self._lag])
            if self._covariances is not None:
                self._covariances.append(self._errors[-2 - self._lag].copy())
        self._taken += 1

    def smoothed(self) -> tuple[Array, Array | None]:
        """The estimates of x(0), ..., x(T), the last ones from the last window; and covariances."""
        rest, found = slice(-1 - min(self._lag, self._taken), None), self._covariances
        states = np.array([*self._states, *self._window[rest]])
        return states, None if found is None else np.array([*found, *self._errors[rest]])


class Run:
    """Results of T consecutive updates, as arrays.

    Parameters
    ----------
    states : (T + 1, n) array
        Estimates of x(0), ..., x(T), of which x(t) does not use y(t); row 0 is the start.
    filtered : (T, n) array
        Estimates of x(0), ..., x(T-1), of which x(t) uses y(t).
    costs, candidate_costs : (T,) array
        True cost J of estimate and candidate.
    times, solve_times : (T,) array
        Seconds for each update, and for the QP solver in it. A compiled run reports means over some
        hundred samples, and NaN for the solver.
    qps : (T,) array
        QPs solved.
    solver_iterations : (T,) array
        The solver's own iterations, -1 where it reports none.
    flags : (T,) array
        Values of the statuses.
    observer_states : (T + 1, n) array
        The observer's own states z(0), ..., z(T).
    covariances : (T, n, n) array, optional
        Covariances of the estimates of x(1), ..., x(T), if requested; NaN where the model
        could not be linearised.
    smoothed : (T + 1, n) array, optional
        Estimates of x(0), ..., x(T), of which x(t) uses y up to t plus the lag, or up to the end of
        the run; if requested.
    smoothed_covariances : (T + 1, n, n) array, optional
        Their covariances, if both were requested.
    rejected_sensors : (T, s) bool array, optional
        Whether the gate of the observer rejected each of its s sensors; s is 0 without a gate.
    engine : str
        The engine that ran the steps: ``python``, ``compiled``, or ``compiled, then python`` if the
        model changed after it was compiled.
    engine_reason : str
        Why `MovingHorizonEstimator.run` took this engine, where it had a choice; otherwise blank.
    elapsed, time_unit, labels : optional
        What these attributes are where there is no source that knows them.

    Attributes
    ----------
    statuses : list of Status
        Outcome and events of each step.
    source : RunSource or None
        What produced the run, for `qpmhe.diagnose`; None for a run that was assembled from single
        estimates, or unpickled.
    index : pandas.DatetimeIndex, pandas.TimedeltaIndex or None
        Times of x(0), ..., x(T), where the measurements had an index of times.
    elapsed : (T + 1,) array or None
        Times of x(0), ..., x(T) in `time_unit`: durations of the index, or since its first date;
        without index the sum of the steps; None where the model's steps have no length.
    time_unit : str
        The model's unit of time; ``s`` unless `MovingHorizonEstimator.run` got another one.
    labels : list of str or None
        Names of the states, with units, where the user or the model says them.
    """

    source: RunSource | None = None
    index: pandas.Index | None = None
    # What a run that was pickled before there was this does not have.
    engine_reason: str = ""
    _elapsed: Array | None = None
    _time_unit: str = "s"
    _labels: Sequence[str] | None = None

    #: Draws a run for a notebook; whoever can draw sets it.
    page: ClassVar[Callable[[Run], str] | None] = None

    def __init__(
        self,
        *,
        states: Array,
        filtered: Array,
        costs: Array,
        candidate_costs: Array,
        times: Array,
        solve_times: Array,
        qps: Integers,
        solver_iterations: Integers,
        flags: NDArray[np.integer[Any]],
        observer_states: Array,
        covariances: Array | None = None,
        smoothed: Array | None = None,
        smoothed_covariances: Array | None = None,
        rejected_sensors: NDArray[np.bool_] | None = None,
        engine: str = "python",
        elapsed: Array | None = None,
        time_unit: str = "s",
        labels: Sequence[str] | None = None,
        engine_reason: str = "",
    ) -> None:
        self.states, self.filtered = states, filtered
        self.costs, self.candidate_costs = costs, candidate_costs
        self.times, self.solve_times = times, solve_times
        self.qps, self.solver_iterations = qps, solver_iterations
        self.flags, self.covariances, self.engine = flags, covariances, engine
        self.observer_states, self.engine_reason = observer_states, engine_reason
        self.smoothed, self.smoothed_covariances = smoothed, smoothed_covariances
        if rejected_sensors is None:
            rejected_sensors = np.zeros((flags.size, 0), np.bool_)
        self.rejected_sensors = rejected_sensors
        self._elapsed, self._time_unit, self._labels = elapsed, time_unit, labels

    @classmethod
    def of(
        cls, start: Array, estimates: Sequence[Estimate], covariances: Array | None = None, *,
        observer_start: Array | None = None,
    ) -> Run:
        """Collect the estimates of single updates.

        Parameters
        ----------
        start : (n,) array
            The estimate before the first update.
        estimates : sequence of Estimate
            One for each update.
        covariances : (T, n, n) array, optional
            Covariances of their states.
        observer_start : (n,) array, optional
            The observer's state before the first update; the estimate if left out, as at time 0.
        """
        start = numbers("start", start)
        n = start.size
        first = start if observer_start is None else observer_start
        return cls(
            states=np.array([start, *(e.state for e in estimates)]),
            filtered=np.array([e.filtered for e in estimates]).reshape(-1, n),
            costs=np.array([e.cost for e in estimates]),
            candidate_costs=np.array([e.candidate_cost for e in estimates]),
            times=np.array([e.step_time for e in estimates]),
            solve_times=np.array([e.solve_time for e in estimates]),
            qps=np.array([e.qps for e in estimates], dtype=np.intp),
            solver_iterations=np.array(
                [-1 if e.solver_iterations is None else e.solver_iterations for e in estimates],
                dtype=np.intp,
            ),
            flags=np.array([e.status.value for e in estimates], dtype=np.intp),
            observer_states=np.array([first, *(e.observer_state for e in estimates)]),
            covariances=covariances,
            rejected_sensors=np.array([e.rejected for e in estimates]) if estimates else None,
            engine=", then ".join(dict.fromkeys(one.engine for one in estimates)) or "python",
        )

    @classmethod
    def by_updates(
        cls, mhe: MovingHorizonEstimator, measurements: Array, inputs: Array | None,
        steps: Array | None, covariances: bool, lag: int | None,
    ) -> Run:
        """Update an estimator with each sample of a record, and collect the estimates.

        Parameters
        ----------
        mhe : MovingHorizonEstimator
            The estimator.
        measurements, inputs, steps : array
            As for `RunSource`; inputs without the estimator's parameters.
        covariances : bool
            Whether to compute the covariance of each estimate.
        lag : int or None
            The samples by which states are smoothed, if they are.
        """
        start, observer_start = mhe.state.copy(), mhe.observer_state
        late = None if lag is None else FixedLag(start, lag, covariances)
        estimates, collected = [], []
        for t, y in enumerate(measurements):
            estimates.append(mhe.update(
                y, None if inputs is None else inputs[t], dt=None if steps is None else steps[t]
            ))
            errors = mhe.known_covariances() if covariances else None
            if errors is not None:
                collected.append(errors[-1].copy())
            if late is not None:
                late.add(estimates[-1], errors)
        blocks = np.array(collected).reshape(-1, start.size, start.size) if covariances else None
        run = cls.of(start, estimates, blocks, observer_start=observer_start)
        if late is not None:
            run.smoothed, run.smoothed_covariances = late.smoothed()
        return run

    @cached_property
    def statuses(self) -> list[Status]:
        """Outcome and events of each step."""
        known = {value: Status(value) for value in np.unique(self.flags).tolist()}
        return [known[value] for value in self.flags.tolist()]

    @property
    def elapsed(self) -> Array | None:
        """Times of x(0), ..., x(T) in `time_unit`; None where the steps have no length."""
        if self.source is None and self._elapsed is not None:
            return self._elapsed
        if self.index is not None:
            unit = self._time_unit if self.source is None else self.source.time_unit
            return elapsed_times(self.index, unit)
        if self.source is None:
            return None
        if self.source.steps is not None:
            return np.concatenate(([0.0], np.cumsum(self.source.steps)))
        dt = self.source.system.dt
        return None if dt is None else dt * np.arange(len(self) + 1.0)

    @property
    def time_unit(self) -> str:
        """The model's unit of time."""
        return self._time_unit if self.source is None else unit_name(self.source.time_unit)

    @property
    def labels(self) -> list[str] | None:
        """Names of the states, with units, where the user or the model says them."""
        given = self._labels if self.source is None else self.source.labels
        if given is not None or self.source is None:
            return None if given is None else list(given)
        signals = self.source.system.signals
        if signals is None or len(signals.states) != self.states.shape[1]:
            return None
        return [f"{one.name} ({one.unit})" if one.unit else one.name for one in signals.states]

    def keep_times(self, index: pandas.Index, time_unit: Any) -> None:
        """Take the times of x(0), ..., x(T), where there is no source that knows the unit.

        Parameters
        ----------
        index : pandas.Index
            The times.
        time_unit : str or pandas.Timedelta
            The model's unit of time.
        """
        self.index, self._time_unit = index, unit_name(time_unit)
        self._elapsed = elapsed_times(index, time_unit)

    def _clock(self) -> dict[str, Any]:
        """What its source knows of times and names, to be kept without it."""
        return {"elapsed": self.elapsed, "time_unit": self.time_unit, "labels": self.labels}

    def __getstate__(self) -> dict[str, Any]:
        # The functions of a system often cannot be pickled.
        kept = {name: value for name, value in vars(self).items() if name != "source"}
        return kept | {f"_{name}": value for name, value in self._clock().items()}

    def __len__(self) -> int:
        return self.flags.size

    @property
    def has_costs(self) -> bool:
        """Whether any cost is known: the estimators of `qpmhe.baselines` have none."""
        return bool(np.isfinite(self.costs).any())

    def facts(self) -> dict[str, str]:
        """A summary in words: steps, outcomes, costs and times."""
        kept = int(((self.flags & Status.CANDIDATE.value) != 0).sum())
        improved = int(((self.flags & Status.IMPROVED.value) != 0).sum())
        found = {
            "steps": f"{len(self)}", "states": f"{self.states.shape[1]}", "engine": self.engine,
        }
        if self.engine_reason:
            found["engine"] += f" ({self.engine_reason})"
        if self.has_costs or not len(self):
            found |= {"improved": f"{improved}", "candidate kept": f"{kept}"}
        if self.has_costs:
            found["mean J"] = f"{self.costs.mean():.6g}"
            found["mean J of the candidate"] = f"{self.candidate_costs.mean():.6g}"
        if len(self) and (elapsed := self.elapsed) is not None:
            first, last = elapsed[[0, -2]]
            found["samples from"] = f"{first:.6g} to {last:.6g} {self.time_unit}"
        if len(self):
            found["median step"] = f"{1e6 * np.median(self.times):.3g} us"
        return found

    def __repr__(self) -> str:
        return f"Run({', '.join(f'{name}: {fact}' for name, fact in self.facts().items())})"

    def _repr_html_(self) -> str | None:
        return None if Run.page is None else Run.page(self)

    def to_frame(self) -> pandas.DataFrame:
        """The run as a pandas table, with a row for each of the states x(0), ..., x(T).

        Returns
        -------
        pandas.DataFrame
            Indexed by the time of the state: t = 0, ..., T, or `index`. ``elapsed`` is there if it
            is known, in the unit ``frame.attrs["time_unit"]``. ``x1``, ``x2``, ... is the estimate
            of x(t) from the measurements before t, ``std1``, ... its standard deviations, if
            covariances were requested; ``filtered1``, ... is the estimate of x(t) that has used
            y(t); ``smoothed1``, ... and ``smoothed_std1``, ... are those of `smoothed`. ``J``,
            ``J_candidate``, ``status``, ``qps``, ``solver_iterations``, ``seconds`` and
            ``solver_seconds`` are of the update with y(t). The last row has no update yet.

        Raises
        ------
        InvalidInputError
            If pandas is not installed.
        """
        pandas = need("pandas", "Run.to_frame")
        with_gap = partial(np.pad, pad_width=((0, 1), (0, 0)), constant_values=np.nan)
        blocks = {"x": self.states, "filtered": with_gap(self.filtered)}
        if self.covariances is not None:
            found = with_gap(deviations(self.covariances))
            blocks["std"] = found[np.arange(len(self) + 1) - 1]
        if self.smoothed is not None:
            blocks["smoothed"] = self.smoothed
        if self.smoothed_covariances is not None:
            blocks["smoothed_std"] = deviations(self.smoothed_covariances)
        elapsed = self.elapsed
        columns: dict[str, Any] = {} if elapsed is None else {"elapsed": elapsed}
        columns |= {
            f"{name}{i + 1}": values[:, i]
            for name, values in blocks.items() for i in range(values.shape[1])
        }
        steps = {
            "J": self.costs, "J_candidate": self.candidate_costs,
            "status": [str(one).removeprefix("Status.") for one in self.statuses],
            "qps": pandas.array(self.qps, dtype="Int64"),
            "solver_iterations": pandas.array(self.solver_iterations, dtype="Int64"),
            "seconds": self.times, "solver_seconds": self.solve_times,
        }
        every = pandas.RangeIndex(len(self) + 1, name="t")
        table = pandas.DataFrame(columns, index=every).join(
            pandas.DataFrame(steps, index=every[:-1])
        )
        if self.index is not None:
            table = table.set_axis(self.index)
        if elapsed is not None:
            table.attrs["time_unit"] = self.time_unit
        return table

    def save(self, path: str | PathLike[str]) -> None:
        """Write all arrays to a NumPy archive, which `qpmhe.load_run` reads; without pickle.

        Parameters
        ----------
        path : str or Path
            The file, usually ``.npz``; an existing file is replaced.
        """
        arrays: dict[str, Any] = {
            name: value for name, value in vars(self).items()
            if isinstance(value, np.ndarray) and not name.startswith("_")
        }
        arrays |= {name: np.array(one) for name, one in self._clock().items() if one is not None}
        arrays |= {name: np.array(getattr(self, name)) for name in _TEXTS}
        arrays |= stored_index(self.index)
        with open(path, "wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Run:
        """Read what `save` wrote, without its ``source``; the index only where pandas is installed.

        Parameters
        ----------
        path : str or Path
            The file.

        Raises
        ------
        InvalidInputError
            If the file cannot be read, or holds no run.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            index = read_index(arrays)
            texts = {
                name: str(arrays[name]) for name in (*_TEXTS, "time_unit") if name in arrays
            }
            if "labels" in arrays:
                texts["labels"] = arrays["labels"].tolist()
            run = cls(**arrays | texts)
            lengths = {len(arrays[name]) for name in _PER_STEP}
            stages = {len(one) for one in (run.states, run.elapsed, index) if one is not None}
            if lengths != {len(run)} or stages != {len(run) + 1}:
                raise ShapeError("its arrays are not of the same steps")
        except (
            OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile
        ) as error:
            what = f"{type(error).__name__}: {error}"
            if "allow_pickle" in what:  # what NumPy says of any file that is none of its own
                what = "it is no .npz file of numbers"
            raise InvalidInputError(
                f"{path} cannot be read as a run ({what}); expected a "
                "file that Run.save wrote."
            ) from error
        run.index = index
        return run

    def share(self, flag: Status) -> float:
        """The share of steps whose status has this flag."""
        has = (self.flags & flag.value) == flag.value
        return float(has.sum()) / max(1, len(self))

    def reasons(self) -> dict[str, int]:
        """Counts of each combination of flags, most frequent first."""
        counts = Counter(str(status).removeprefix("Status.") for status in self.statuses)
        return dict(counts.most_common())
