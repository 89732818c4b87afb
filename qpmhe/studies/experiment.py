"""What a cell estimates: records that a model's scenario simulates, or one that was measured."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from .._checks import Array
from ..baselines import Problem
from ..errors import InvalidInputError, ModelError
from ..model.system import System
from ..models import Record, Scenario
from ..models.loading import ModelSource, load
from ..records.arrays import read_record
from ..records.record_model import load_record_model


@dataclass(frozen=True)
class Source:
    """A model, and the record to run it on; None if its scenario simulates one.

    ``reading`` holds the options for reading the record, ``digest`` identifies its content.
    """

    model: ModelSource
    record: str | None = None
    reading: tuple[tuple[str, Any], ...] = field(default=(), repr=False)
    place: Path | None = None
    digest: str = ""

    @classmethod
    def measured(
        cls, model: ModelSource, record: str, reading: Mapping[str, Any], folder: Path | None
    ) -> Source:
        """The source of a record, a path relative to the folder."""
        place = (folder or Path()).joinpath(record).resolve()
        options = ((key, tuple(one) if isinstance(one, list) else one)
                   for key, one in reading.items())
        return cls(model, record, tuple(sorted(options)), place, _digest(record, place))

    @property
    def name(self) -> str:
        """What studies call it."""
        return self.model.name if self.record is None else f"{self.model.name} on {self.record}"

    @property
    def fingerprint(self) -> str:
        """Digest of the model's files and the record: it changes if results may change."""
        if self.record is None:
            return self.model.fingerprint
        return f"{self.model.fingerprint} {self.digest} {self.reading}"


def _digest(name: str, place: Path) -> str:
    found = hashlib.sha256()
    try:
        # A ROS bag is a folder.
        for each in sorted(place.iterdir()) if place.is_dir() else (place,):
            found.update(each.read_bytes())
        return found.hexdigest()[:16]
    except OSError as error:
        raise InvalidInputError(
            f"the record {name!r} cannot be read ({error.strerror or error}); give the name of a "
            "file that qpmhe.records.read reads."
        ) from error


@dataclass(frozen=True, eq=False)
class Experiment:
    """The parts of an estimator, and the records that it runs on.

    ``parts`` are system, observer and cost; ``options`` are the estimator's options that a study
    does not vary. ``record`` returns the record for a seed, a number of steps and a noise level.
    Its steps have the length ``dt``, or those in ``lengths``, in ``time_unit``. From the sample
    ``settled`` on, the initial error counts as decayed.
    """

    parts: tuple[Any, ...]
    options: dict[str, Any]
    horizon: int
    steps: int
    settled: int
    dt: float
    labels: tuple[str, ...]
    title: str
    time_unit: str
    record: Callable[[int, int, float], Record]
    lengths: Array | None = None

    @property
    def system(self) -> System:
        """The model's system."""
        system: System = self.parts[0]
        return system

    @cached_property
    def problem(self) -> Problem:
        """The problem of other estimators and observers; a `WeightError` without a prior."""
        system, observer, cost = self.parts
        return Problem.of(
            system, observer, cost, self.options["initial_state"],
            parameters=self.options.get("parameters", ()),
        )

    def times(self, steps: int) -> Array:
        """Times of the states x(0), ..., x(steps)."""
        spacing = np.full(steps, self.dt) if self.lengths is None else self.lengths[:steps]
        return np.concatenate(([0.0], np.cumsum(spacing)))


@lru_cache(maxsize=16)
def experiment(source: Source) -> Experiment:
    """The same object for the same source within a process."""
    if source.record is not None:
        return _measured(source)
    *parts, scenario = load(source.model)
    return Experiment(
        tuple(parts), {"initial_state": scenario.initial_estimate}, scenario.horizon,
        scenario.steps, _settled(scenario), scenario.dt, scenario.labels, scenario.title,
        scenario.time_unit, partial(_simulated, scenario),
    )


def _settled(scenario: Scenario) -> int:
    return int(np.ceil(scenario.settling_time / scenario.dt - 1e-9))


@lru_cache(maxsize=8)
def _simulated(scenario: Scenario, seed: int, steps: int, level: float) -> Record:
    if level != 1.0:
        scenario = replace(
            scenario, disturbance_covariance=level**2 * scenario.disturbance_covariance,
            noise_covariance=level**2 * scenario.noise_covariance,
        )
    return scenario.simulate(seed, steps)


def _measured(source: Source) -> Experiment:
    assert source.record is not None
    if _digest(source.record, source.place or Path()) != source.digest:
        raise ModelError(
            f"the record {source.record!r} differs from the one that the study was started with; "
            "copy the same file to all machines, and do not change it while the study runs."
        )
    model = load_record_model(source.model)
    y, u, lengths, usual, known = read_record(str(source.place), model, **dict(source.reading))
    mhe, total, n = model.estimator, len(y), model.estimator.system.n
    truth = np.full((total + 1, n), np.nan)
    if known is not None:
        truth[:total] = known
    return Experiment(
        (mhe.system, mhe.observer, mhe.cost),
        {**vars(mhe.settings), "initial_state": mhe.initial_state}, mhe.horizon, total,
        total + 1 if model.scenario is None else _settled(model.scenario),
        usual or 1.0, model.states, source.name,
        "samples" if usual is None else model.time_unit,
        lambda _seed, steps, _level: Record(
            truth[: steps + 1], y[:steps], None if u is None else u[:steps]
        ),
        lengths,
    )
