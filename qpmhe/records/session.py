"""Sample in, row out, and a checkpoint now and then."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import InvalidInputError
from ..estimate import Estimate, Status
from ..estimator import MovingHorizonEstimator
from .checkpoint import Checkpoint, save
from .errors import CheckpointError, RecordError
from .numbers import Reader, spacing
from .results import Results
from .samples import Record, Sample
from .sink import Sink
from .steps import Step, Steps
from .summary import Summary

__all__ = ["Session"]


class Session:
    """One run over a record.

    Checkpoints are taken at fixed numbers of samples, whatever happens in between: a solver
    forgets its warm start there, and a run that goes on from one forgets nothing else.

    Parameters
    ----------
    estimator : MovingHorizonEstimator
        Before its first measurement.
    results, steps, record, sink
        The parts.
    identity : dict
        What a checkpoint must have been made with.
    every : int
        Samples from checkpoint to checkpoint.
    seconds : float
        Least time from one that is written to the disk to the next.
    """

    def __init__(
        self,
        estimator: MovingHorizonEstimator,
        results: Results,
        steps: Steps,
        record: Record,
        sink: Sink,
        *,
        identity: dict[str, Any],
        every: int,
        seconds: float,
    ) -> None:
        self._mhe, self._results, self._steps = estimator, results, steps
        self._record, self._sink = record, sink
        self._identity, self._every, self._seconds = identity, every, seconds
        self._summary = Summary()
        self._taken = 0  # samples, with those of former runs
        self._inserted = 0  # since the last row
        self._segment = bytearray()  # of the samples since the last checkpoint
        self._digest = ""
        self._newest: Checkpoint | None = None
        self._written_at = monotonic()
        self._is_written = True

    def run(
        self, found: Checkpoint | None, progress: Callable[[int, int | None], None] | None
    ) -> Summary:
        """Take all samples in.

        Parameters
        ----------
        found : Checkpoint or None
            Where to go on.
        progress : callable or None
            Called after each sample with what was read and its total.
        """
        record, sink = self._record, self._sink
        before = None if found is None else self._restore(found)
        samples = record.samples(before.u if before is not None and record.is_stream else None)
        if found is not None and before is not None:
            if record.is_stream:
                self._digest = found.digest
                samples = self._behind(samples, before, found)
            else:
                self._skip_known(samples, found)
        if found is None and sink.checkpoint is not None:
            sink.checkpoint.unlink(missing_ok=True)
        sink.begin(self._results.header, None if found is None else found.offset)
        try:
            self._take_all(samples, before, progress)
        except RecordError as error:
            self._keep()
            if sink.path is not None and self._taken:
                error.args = (
                    f"{error} The {self._taken} samples before are in {sink.name}; with the "
                    "record mended, --resume goes on.",
                )
            raise
        except BaseException:
            self._keep()
            raise
        if not self._taken:
            raise RecordError(
                "it has a header and no samples; expected a line for each.", record.name
            )
        if self._newest is not None:
            self._newest, self._is_written = replace(self._newest, finished=True), False
            self._keep()
        sink.finish()
        self._summary.held, self._summary.repeated = record.held, record.repeated
        return self._summary

    def _take_all(
        self, samples: Iterator[Sample], before: Sample | None,
        progress: Callable[[int, int | None], None] | None,
    ) -> None:
        waits = self._steps.measured
        pending: Sample | None = None
        for sample in samples:
            step = Step(None, 0)
            if pending is not None:
                step = self._step(pending, sample)
                # A time that was cut off gives the step before it a wrong length, too.
                self._advance(replace(pending, whole=sample.whole), step.length)
                before, pending = pending, None
            elif before is not None:
                step = self._step(before, sample)
            if before is not None:
                for _ in range(step.inserted):
                    self._update(None, before, step.length)
                self._inserted = step.inserted
                self._summary.inserted += step.inserted
            if waits:
                pending = sample
            else:
                self._advance(sample, None)
                before = sample
            if progress is not None:
                progress(self._record.position, self._record.total)
        if pending is not None:
            # The length of its step is not known yet: a longer record will do it again.
            self._advance(replace(pending, whole=False), None)

    def _step(self, before: Sample, after: Sample) -> Step:
        magnitude = after.time if isinstance(after.time, float) else 0.0
        try:
            return self._steps.between(spacing(before.time, after.time), abs(magnitude))
        except ValueError as error:
            raise self._record.fail(f"{error}.", after.line) from None

    def _update(
        self, y: NDArray[np.float64] | None, sample: Sample, length: float | None
    ) -> Estimate:
        return self._mhe.update(y, sample.u if sample.u.size else None, dt=length)

    def _advance(self, sample: Sample, length: float | None) -> None:
        """Take a sample in, and write its row."""
        estimate = self._update(sample.y, sample, length)
        self._sink.write(self._results.row(sample.text, estimate, self._mhe, self._inserted))
        summary = self._summary
        self._taken += 1
        summary.samples += 1
        summary.improved += estimate.improved
        summary.incomplete += Status.MISSING in estimate.status
        self._remember(sample)
        if self._taken % self._every == 0:
            self._check(sample)

    def _remember(self, sample: Sample) -> None:
        self._segment += sample.text.encode() + b"\n" + sample.y.tobytes() + sample.u.tobytes()

    def _close_segment(self) -> None:
        self._digest = hashlib.sha256(self._digest.encode() + self._segment).hexdigest()
        self._segment.clear()

    def _check(self, sample: Sample) -> None:
        """Take a checkpoint, and write it if the last one is old enough."""
        self._close_segment()
        # Also where nothing is kept: the solver forgets its warm start at the same samples.
        state = self._mhe.state_dict()
        if self._sink.checkpoint is None or not sample.whole:
            return
        self._newest = Checkpoint(
            self._identity, self._every, self._taken, self._sink.offset, sample.text,
            sample.u.tolist(), self._steps.usual, self._digest, False, _versions(), state,
        )
        self._is_written = False
        if monotonic() - self._written_at >= self._seconds:
            self._keep()

    def _keep(self) -> None:
        """Write the newest checkpoint, if that is not done."""
        if self._newest is None or self._is_written:
            return
        assert self._sink.checkpoint is not None
        self._sink.sync()
        save(self._sink.checkpoint, self._newest)
        self._is_written, self._written_at = True, monotonic()

    def _restore(self, found: Checkpoint) -> Sample:
        """Take a checkpoint over; the last sample that it knows."""
        differing = [
            f"{key} {found.identity.get(key)!r}, now {value!r}"
            for key, value in self._identity.items()
            if found.identity.get(key) != value
        ]
        if differing:
            raise CheckpointError(
                f"the checkpoint {self._sink.checkpoint} was made with {'; '.join(differing)}. Go "
                "on with the same model and options, or start again by --overwrite."
            )
        try:
            self._mhe.load_state_dict(found.state)
            time, text = Reader(".").time(found.time)
            inputs = np.array(found.inputs, np.float64).reshape(self._mhe.system.m)
        except (InvalidInputError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"the checkpoint {self._sink.checkpoint} does not fit: {error}"
            ) from error
        self._taken = self._summary.before = found.samples
        self._steps.usual, self._newest = found.usual, found
        if found.versions != _versions():
            self._summary.notes.append(
                f"the checkpoint is of {found.versions}, this is {_versions()}: the last bits of "
                "the results may differ."
            )
        return Sample(0, time, text, np.empty(0), inputs)

    def _skip_known(self, samples: Iterator[Sample], found: Checkpoint) -> None:
        """Read over the samples that the checkpoint knows, and compare them with it."""
        for number in range(1, found.samples + 1):
            sample = next(samples, None)
            if sample is None:
                raise CheckpointError(
                    f"{self._record.name} has {number - 1} samples, and the checkpoint was made "
                    f"after {found.samples}; give the record that it was made of."
                )
            self._remember(sample)
            if number % self._every == 0:
                self._close_segment()
        if self._digest != found.digest:
            raise CheckpointError(
                f"the first {found.samples} samples of {self._record.name} are not those that the "
                "checkpoint was made of (or other columns are read); give the same record and "
                "columns, or start again by --overwrite."
            )
        self._record.held = self._record.repeated = 0

    def _behind(
        self, samples: Iterator[Sample], last: Sample, found: Checkpoint
    ) -> Iterator[Sample]:
        """The samples of a stream behind the last one that the checkpoint knows."""
        new = (
            sample for sample in samples
            if type(sample.time) is not type(last.time)
            or sample.time > last.time  # type: ignore[operator]  # of one kind
        )
        first, text = next(new, None), self._sink.time_behind(found.offset)
        if text is not None:
            # Its row is about to be cut off: it must come again.
            due = Reader(".").time(text)[0]
            if first is None or type(first.time) is not type(due) or first.time > due:  # type: ignore[operator]
                raise CheckpointError(
                    f"{self._record.name} does not have the sample of time {text} again; the "
                    f"checkpoint is of the one before, at {last.text}. Give the record from "
                    "there, or from its beginning."
                )
        return new if first is None else chain((first,), new)


def _versions() -> dict[str, str]:
    return {"qpmhe": __version__, "numpy": np.__version__, "machine": platform.machine()}
