"""Sample in, row out, and a checkpoint now and then."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..estimate import Estimate, Status
from ..estimator import MovingHorizonEstimator
from .checkpoint import Checkpoint
from .errors import RecordError, WriteError
from .failures import Failures
from .keeper import Keeper, versions
from .results import Results
from .resuming import known_sample, remaining
from .samples import Record, Sample
from .sink import Sink
from .steps import OnlyGapsError, Step, Steps
from .summary import Summary
from .times import spacing

__all__ = ["Session"]


class Session:
    """One run over a record.

    Checkpoints are taken at fixed numbers of samples, whatever happens in between: a solver
    forgets its warm start there, and a run that goes on from one forgets nothing else.

    Parameters
    ----------
    estimator : MovingHorizonEstimator
        Before its first measurement.
    results, steps, record, sink, failures
        The parts.
    identity : dict
        What a checkpoint must have been made with.
    every : int
        Samples from checkpoint to checkpoint.
    seconds : float
        Least time from one that is written to the disk to the next.
    tell : callable, optional
        Called with what should be known at once.
    """

    def __init__(
        self,
        estimator: MovingHorizonEstimator,
        results: Results,
        steps: Steps,
        record: Record,
        sink: Sink,
        failures: Failures,
        *,
        identity: dict[str, Any],
        every: int,
        seconds: float,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self._mhe, self._results, self._steps = estimator, results, steps
        self._record, self._sink, self._failures = record, sink, failures
        self._keeper = Keeper(sink, identity, every, seconds)
        self._tell = tell
        self._summary = Summary()
        self._taken = 0  # samples, with those of former runs
        self._inserted = 0  # since the last row

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
        record, sink, keeper = self._record, self._sink, self._keeper
        before: Sample | None = None
        if found is None:
            samples = record.samples()
            sink.begin(self._results.header, keeper.begin if sink.checkpoint else None)
        else:
            before = self._restore(found)
            samples = remaining(found, before, record, sink, keeper)
            sink.go_on(self._results.header, found.offset, found.written)
        try:
            self._take_all(samples, before, progress)
            self._insist_on_samples()
            keeper.finish()
        except (RecordError, WriteError) as error:
            with contextlib.suppress(WriteError):  # the one before is good, too
                keeper.keep()
            error.args = (f"{error}{self._how_to_go_on(error)}",)
            raise
        except BaseException:
            with contextlib.suppress(WriteError):
                keeper.keep()
            raise
        sink.finish(record.time_type)
        return self._finished()

    def _how_to_go_on(self, error: RecordError | WriteError) -> str:
        """What to add to an error that stopped the run."""
        if self._sink.checkpoint is None or not self._taken:
            return ""
        there = f" The {self._taken} samples before are in {self._sink.name}; "
        if isinstance(error, WriteError):
            return f"{there}when there is room again, --resume goes on."
        if isinstance(error.__cause__, OnlyGapsError):
            return f"{there}start again by --overwrite."
        return f"{there}with the record mended, --resume goes on."

    def _insist_on_samples(self) -> None:
        if not self._taken:
            raise RecordError(
                "it has a header and no samples; expected a line for each.", self._record.name
            )
        try:
            self._steps.finish()
        except OnlyGapsError as error:
            raise self._record.fail(f"{error}.", None) from error

    def _finished(self) -> Summary:
        record, summary, failures = self._record, self._summary, self._failures
        summary.held, summary.repeated = record.held, record.repeated
        summary.failed, summary.stale = failures.failed, failures.stale
        summary.failure = failures.told(summary.samples + summary.inserted)
        summary.model_is_wrong = failures.is_mistake
        if record.cut is not None:
            summary.notes.append(
                f"the last line of {record.name}, {record.cut}, has no end of line and may be cut "
                "off: its numbers were taken as they stand. If more comes, --resume reads it again."
            )
        if record.blank:
            summary.notes.append(
                f"{record.blank} rows without any value at the end of {record.name} were passed "
                "over."
            )
        return summary

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
        magnitude = abs(after.time) if isinstance(after.time, float) else 0.0
        try:
            return self._steps.between(spacing(before.time, after.time), magnitude)
        except ValueError as error:
            raise self._record.fail(f"{error}.", after.line) from error

    def _update(
        self, y: NDArray[np.float64] | None, sample: Sample, length: float | None
    ) -> Estimate:
        estimate = self._mhe.update(y, sample.u if sample.u.size else None, dt=length)
        failures = self._failures
        if failures.note(estimate, sample.u, length):
            failures.where = self._record.place(sample)
            if self._tell is not None:
                self._tell(
                    f"the model failed at {failures.reason} The run goes on; the status marks "
                    "such rows."
                )
        return estimate

    def _advance(self, sample: Sample, length: float | None) -> None:
        """Take a sample in, and write its row."""
        estimate = self._update(sample.y, sample, length)
        self._sink.write(self._results.row(sample.text, estimate, self._mhe, self._inserted))
        summary = self._summary
        self._taken += 1
        summary.samples += 1
        summary.improved += estimate.improved
        summary.incomplete += Status.MISSING in estimate.status
        self._keeper.remember(sample)
        if self._taken % self._keeper.every == 0:
            self._check(sample)

    def _check(self, sample: Sample) -> None:
        """Take a checkpoint where what was taken in is sure to be right."""
        self._keeper.close_segment()
        # Also where nothing is kept: the solver forgets its warm start at the same samples.
        state = self._mhe.state_dict()
        if self._sink.checkpoint is not None and sample.whole and self._steps.settled:
            self._keeper.take(sample, self._taken, self._steps.usual, state)

    def _restore(self, found: Checkpoint) -> Sample | None:
        """Take a checkpoint over; the last sample that it knows."""
        before = known_sample(found, self._sink, self._keeper, self._mhe)
        self._keeper.go_on(found)
        self._taken = self._summary.before = found.samples
        if before is not None:
            self._steps.restore(found.usual)
        if found.versions != versions():
            self._summary.notes.append(
                f"the checkpoint is of {found.versions}, this is {versions()}: the last bits of "
                "the results may differ."
            )
        return before
