"""A record in, a row of results out for each sample, and a checkpoint now and then."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from .._checks import count
from ..errors import InvalidInputError, OptionError
from ..estimation.estimate import Estimate, Status
from ..estimation.run import Run
from ..estimation.steps import MAX_GAP, Step, Steps
from .checkpoints import Checkpoint, CheckpointError, WriteError, load, plain, save, versions
from .kept_run import KeptRun
from .latency import Latency
from .measurements import ColumnNames, FieldReader, Measurement, RecordReader, spacing
from .output import Output, RowFormat, standard_output_for_rows
from .readers import ReadingOptions
from .record_model import RecordModel, load_record_model
from .tables import RecordError

if TYPE_CHECKING:
    from .bounds import BoundOptions, RowBounds

_EVERY = 100
# After so many samples, more inserted ones than measured ones are reported.
_FEW = 20
# A mistake in the model's code, rather than a state at which it has no value.
_MISTAKE = re.compile(
    r" raised (TypeError|NameError|UnboundLocalError|AttributeError|ImportError|"
    r"ModuleNotFoundError)\b| returned (shape|other than|\w+; expected)"
)


@dataclass
class Summary:
    """What happened in a record.

    Attributes
    ----------
    engine : str
        What ran the steps: ``python``, ``compiled``, or ``compiled, then python`` if the model
        changed meanwhile. A resumed estimation keeps its engine.
    samples, before : int
        Samples of this run, and of the earlier run that it resumed.
    improved, incomplete : int
        How many of the samples improved on the observer, and how many lacked outputs.
    inserted, held, repeated : int
        Samples without measurement that fill gaps; missing inputs that were replaced by the last
        value; lines that were skipped because they repeat a time.
    failed, stale : int
        Steps at which the model failed (``MODEL_FAILED``), and others whose window still has
        such a step (``FAILED_STAGE``).
    failure : str
        Where it failed first, and why; blank if it did not.
    model_is_wrong : bool
        Whether the model's code is wrong, rather than undefined at some states.
    notes : list of str
        What else the user should know.
    run : Run or None
        The samples of this run, inserted ones included, if they were to be kept.
    model : RecordModel or None
        The model that made the estimates.
    """

    engine: str = "python"
    samples: int = 0
    before: int = 0
    improved: int = 0
    incomplete: int = 0
    inserted: int = 0
    held: int = 0
    repeated: int = 0
    failed: int = 0
    stale: int = 0
    failure: str = ""
    model_is_wrong: bool = False
    notes: list[str] = field(default_factory=list)
    run: Run | None = None
    model: RecordModel | None = None


def estimate_record(
    model: str,
    record: str | Path,
    out: str | Path,
    *,
    time: str | None = None,
    outputs: str | None = None,
    inputs: str | None = None,
    dt: float | None = None,
    time_scale: float = 1.0,
    equal_steps: bool = False,
    max_gap: int | None = None,
    latency: Latency | None = None,
    covariances: str = "none",
    step_time: bool = True,
    bound: BoundOptions | bool = False,
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int | None = None,
    checkpoint_seconds: float = 1.0,
    keep_run: bool = False,
    progress: Callable[[int, int | None], None] | None = None,
    report: Callable[[str], None] | None = None,
    **options: Any,
) -> Summary:
    """Estimate the states of a measured record, and write them sample by sample.

    If `qpmhe.System.from_ode` made the model, each step has its length in the record, so a row is
    written when the time of the next sample is known. Otherwise, or with ``equal_steps``, the steps
    must be equal. A gap of k steps is filled by k - 1 samples without measurement, with the inputs
    held.

    Parameters
    ----------
    model : str
        Name in the catalogue, ``package.module:function`` or ``path/file.py:function``.
    record, out : str or Path
        A file that `qpmhe.records.read` reads, ``-`` is CSV on standard input; and a new file in
        .csv, .parquet or .jsonl, ``-`` is standard output.
    time, outputs, inputs : str, optional
        Columns of the time, numbers, or dates and durations (whose differences count in seconds),
        and of y and u, as ``y1=column,y2=column``, or columns in order.
    dt, time_scale : float, optional
        Usual step of a discrete-time model, in its unit of time; the record's unit in the model's.
    equal_steps : bool
        Whether steps must be equal even if the model takes any.
    latency : Latency, optional
        Counts the times from a line in to its line out, on the way.
    max_gap : int, optional
        Largest number of samples without measurement in a row, 500 by default.
    covariances, step_time : {"none", "std", "full"}, bool
        What to write of the covariances; whether to write the seconds of each step.
    bound : BoundOptions or bool
        Whether to write, for each predicted state, the sides of the proved set around the
        observer and the bound on the estimate's error, blank once they no longer hold. The model
        and its scenario supply what the options leave out.
    resume, overwrite : bool
        Whether to resume from the checkpoint beside ``out``, if there is one; whether to replace
        existing files.
    checkpoint_every, checkpoint_seconds : int, float, optional
        Samples from checkpoint to checkpoint, 100 by default, and the least time between two
        writes. A solver forgets its warm start at a checkpoint, so their number affects the last
        bits of the results.
    keep_run : bool
        Whether the summary has all samples as a `qpmhe.Run`, for `qpmhe.diagnose`.
    progress, report : callable, optional
        Called after each sample with the bytes (or rows) read and their total, if it is known;
        called with a text when the model fails for the first time.
    **options
        As for `qpmhe.records.ReadingOptions`, of which ``format`` is that of standard output as
        well; and options of `qpmhe.MovingHorizonEstimator` that replace the model's own.

    Returns
    -------
    Summary
        Counts.

    Raises
    ------
    RecordError, WriteError
        If the record cannot be read or used, or results cannot be written, as on a full disk; the
        rows before stay, and can be resumed.
    CheckpointError
        If the checkpoint does not fit.
    InvalidInputError
        If model, options or files do not fit, or a file exists already.
    """
    reading = ReadingOptions.taken_from(options)
    output = Output(out, reading.format)
    _check_files(str(record), output)
    found = _found(output, resume, overwrite)
    every = found.every if found is not None else _EVERY
    if checkpoint_every is not None:
        every = count("--checkpoint-every", checkpoint_every, 1)
    with contextlib.ExitStack() as stack:
        stack.callback(output.close)
        if output.path is None:  # neither a model nor a solver may print among the rows
            output.use(stack.enter_context(standard_output_for_rows()))
        before = found.identity.get("engine at work") if found is not None else None
        loaded = load_record_model(model, before, **options)
        steps = Steps(
            loaded.estimator.system, usual=loaded.dt if dt is None else dt, scale=time_scale,
            equal=equal_steps, max_gap=MAX_GAP if max_gap is None else max_gap,
        )
        bounds, asked = _bounds(bound, loaded, report)
        rows = RowFormat(loaded.states, covariances, step_time, bounds)
        reader = RecordReader(
            str(record), ColumnNames(loaded.outputs, loaded.inputs, time, outputs, inputs),
            reading,
        )
        stack.callback(reader.close)
        identity = plain(loaded.identity | {
            "dt": dt, "time_scale": time_scale, "equal_steps": equal_steps,
            "states": list(loaded.states), "covariances": covariances, "step_time": step_time,
            "checkpoint_every": every,
        } | asked)
        session = _Session(
            loaded, rows, steps, reader, output, Checkpoint(identity, every), bounds,
            seconds=checkpoint_seconds, report=report, progress=progress, keep=keep_run,
            latency=latency,
        )
        return session.run(found)


def _bounds(
    bound: BoundOptions | bool, model: RecordModel, report: Callable[[str], None] | None
) -> tuple[RowBounds | None, dict[str, Any]]:
    """The bounds of each row, if they are wanted, and what a checkpoint must say of them."""
    if not bound:
        return None, {}
    from .bounds import BoundOptions, RowBounds

    given = BoundOptions() if bound is True else bound
    return RowBounds(model, given, report), {"bound": given.identity()}


def _check_files(record: str, output: Output) -> None:
    for path in filter(None, (output.path, output.target)):
        try:
            read = os.fstat(sys.stdin.fileno()) if record == "-" else os.stat(record)
            is_same = os.path.samestat(path.stat(), read)
        except (OSError, ValueError, AttributeError):  # one of them is no file
            continue
        if is_same:
            raise OptionError(
                f"--out would overwrite the record itself, {record}; name another file."
            )


def _found(output: Output, resume: bool, overwrite: bool) -> Checkpoint | None:
    """The checkpoint to resume at, if that is wanted; no results are lost without asking."""
    if output.checkpoint is None and resume:
        raise OptionError("--resume needs a file: give --out a name in .csv or .parquet.")
    if output.checkpoint is None or overwrite:
        return None
    found = load(output.checkpoint)
    if found is None:
        for path in filter(None, (output.path, output.target)):
            if os.path.isfile(path) and path.stat().st_size:
                raise InvalidInputError(
                    f"{path} exists already, without a checkpoint to resume from; give another "
                    "--out, or replace it with --overwrite."
                )
        return None
    if not found.samples and not output.times_after(0):
        return None
    if resume:
        return found
    if found.finished:
        state, resumed = "a finished estimation", "if the record has grown, estimate the rest"
    else:
        state, resumed = "an estimation that was interrupted", "continue it"
    raise CheckpointError(
        f"{output.name} holds {state}; {resumed} with --resume, start again with --overwrite, or "
        "give another --out."
    )


class _Session:
    """One run over a record.

    Checkpoints are taken after fixed numbers of samples, whether they are written or not: a
    solver forgets its warm start there, and a run that resumes forgets nothing else.
    """

    def __init__(
        self, model: RecordModel, rows: RowFormat, steps: Steps, reader: RecordReader,
        output: Output, checkpoint: Checkpoint, bounds: RowBounds | None, *, seconds: float,
        report: Callable[[str], None] | None, progress: Callable[[int, int | None], None] | None,
        keep: bool, latency: Latency | None,
    ) -> None:
        self._latency, self._header = latency, output.name_columns(rows.header)
        self._model, self._keep = model, keep
        self._kept: KeptRun | None = None
        self._mhe, self._rows, self._steps = model.estimator, rows, steps
        self._reader, self._output, self._bounds = reader, output, bounds
        self._report, self._progress = report, progress
        self._summary = Summary(model.estimator.engine)
        self._inserted = 0  # since the last row
        self._digest = ""  # of all samples so far
        self._newest, self._is_saved = checkpoint, False
        self._seconds, self._saved_at = seconds, monotonic()

    @property
    def _taken(self) -> int:
        return self._summary.before + self._summary.samples

    def run(self, found: Checkpoint | None) -> Summary:
        reader, output = self._reader, self._output
        samples, last = self._begin() if found is None else self._resume(found)
        if self._keep:
            self._kept = KeptRun(self._mhe, self._steps, self._model.time_unit)
        try:
            self._estimate(samples, last)
            if not self._taken:
                raise RecordError(
                    "it has a header but no samples; expected one line per sample.", reader.name
                )
            self._newest, self._is_saved = replace(self._newest, finished=True), False
            self._save()
        except BaseException as error:
            with contextlib.suppress(WriteError):  # the checkpoint before is good, too
                self._save()
            if isinstance(error, (RecordError, WriteError)):
                error.args = (f"{error}{self._remedy(error)}",)
            raise
        output.finish(reader.time_type)
        return self._finished()

    def _begin(self) -> tuple[Iterator[Measurement], None]:
        self._output.begin()
        try:
            self._save()  # no row is in the file without a checkpoint beside it
            self._output.write_line(self._header)
        except WriteError as error:
            raise WriteError(f"{error} Make room, or name another place with --out.") from error
        return self._reader.samples(), None

    def _resume(self, found: Checkpoint) -> tuple[Iterator[Measurement], Measurement | None]:
        """The samples after the checkpoint, and the last one before it."""
        identity, output, reader = self._newest.identity, self._output, self._reader
        differing = [
            f"{key} {found.identity.get(key)!r}, now {value!r}"
            for key, value in identity.items() if found.identity.get(key) != value
        ]
        if differing:
            raise CheckpointError(
                f"the checkpoint {output.checkpoint} was made with {'; '.join(differing)}. Use "
                "the same model and options, or start again with --overwrite."
            )
        last = self._last_sample(found)
        samples = reader.samples(last.u if last is not None and reader.is_stream else None)
        first = self._skip_known(samples, found, last)
        self._check_rows(first, found)
        self._digest = found.samples_digest
        self._summary.before = found.samples
        if found.versions != versions():
            self._summary.notes.append(
                f"the checkpoint was made with {found.versions}, and this run uses {versions()}: "
                "the last bits of the results may differ."
            )
        if last is None:
            self._begin()
        else:
            output.resume(found.offset, found.results_digest)
            self._steps.usual = found.usual_step
            self._newest, self._is_saved = found, True
        return samples if first is None else chain((first,), samples), last

    def _last_sample(self, found: Checkpoint) -> Measurement | None:
        """Restore the estimator; the last sample that it knows."""
        if not found.samples:
            return None
        try:
            self._mhe.load_state_dict(found.state)
            if self._bounds is not None:
                self._bounds.load_state_dict(found.bound)
            time = FieldReader(".").time(found.time)
            inputs = np.array(found.inputs, np.float64).reshape(self._mhe.inputs)
        except (InvalidInputError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"the checkpoint {self._output.checkpoint} does not fit: {error}"
            ) from error
        return Measurement(0, time, np.empty(0), inputs)

    def _skip_known(
        self, samples: Iterator[Measurement], found: Checkpoint, last: Measurement | None
    ) -> Measurement | None:
        """The first sample after the checkpoint; those before must be the same in a file."""
        name, digest = self._reader.name, ""
        first = None
        for sample in samples:
            if last is None or (
                sample.time.kind == last.time.kind and sample.time.value > last.time.value
            ):
                first = sample
                break
            digest = _digest(digest, sample)
        if not self._reader.is_stream and digest != found.samples_digest:
            raise CheckpointError(
                f"the first {found.samples} samples of {name} are not those of the checkpoint (or "
                "other columns are read); give the same record and columns, or start again by "
                "--overwrite."
            )
        return first

    def _check_rows(self, first: Measurement | None, found: Checkpoint) -> None:
        """Raise where a record lacks samples whose rows the checkpoint does not know."""
        is_stream = self._reader.is_stream
        if found.samples and not is_stream:
            return
        times = self._output.times_after(found.offset)
        # The only row of a file that was cut off may have a time that was cut off, too.
        if len(times) < (1 if is_stream else 2):
            return
        due = FieldReader(".").time(times[0])
        if first is None or first.time.kind != due.kind or first.time.value > due.value:
            known = f"those up to {found.time}" if found.samples else "no sample"
            raise CheckpointError(
                f"{self._reader.name} does not contain the sample of time {times[0]}; its row "
                f"and those after it would be lost, since the checkpoint knows {known}. Give "
                "the record from there, or from its beginning; or another --out; or start "
                "again with --overwrite."
            )

    def _estimate(self, samples: Iterator[Measurement], last: Measurement | None) -> None:
        waits = self._steps.any_length
        pending: Measurement | None = None
        for sample in samples:
            if last is not None:
                step = self._step(last, sample)
                if pending is not None:
                    # A time that was cut off gives the step before it a wrong length.
                    pending.complete = sample.complete
                    self._advance(pending, step.length)
                for _ in range(step.inserted):
                    self._update(None, last, step.length)
                self._inserted = step.inserted
                self._summary.inserted += step.inserted
            if sample.u.size:
                self._mhe.check_inputs(sample.u[None])
            if waits:
                pending = sample
            else:
                self._advance(sample, None)
            last = sample
            self._look_at_gaps(sample)
            if self._progress is not None:
                self._progress(self._reader.position, self._reader.total)
        if pending is not None:
            pending.complete = False  # in a longer record its step has another length
            self._advance(pending, None)

    def _look_at_gaps(self, sample: Measurement) -> None:
        """Report once, early, that more samples are inserted than measured."""
        summary = self._summary
        if self._report is None or summary.samples != _FEW or summary.inserted <= _FEW:
            return
        step = 1.0 + summary.inserted / _FEW
        self._report(
            f"{self._reader.place(sample)}: {summary.inserted} samples were inserted into gaps "
            f"between the first {_FEW}: the record's step is about {step:.3g} of the usual steps. "
            "If the record's unit of time is not the model's, as with seconds and minutes, stop, "
            "and give --time-scale."
        )

    def _step(self, before: Measurement, after: Measurement) -> Step:
        try:
            return self._steps.between(*spacing(before.time, after.time))
        except ValueError as error:
            raise self._reader.error(f"{error}.", after.line) from error

    def _update(self, y: Any, sample: Measurement, length: float | None) -> Any:
        estimate = self._mhe.update(y, sample.u if sample.u.size else None, dt=length)
        if self._kept is not None:
            self._kept.add(y, sample, length, estimate)
        if self._bounds is not None:
            self._bounds.check(estimate, sample.u, length, sample.time.text)
        if Status.MODEL_FAILED in estimate.status:
            self._count_failure(estimate, sample)
        else:
            self._summary.stale += Status.FAILED_STAGE in estimate.status
        return estimate

    def _count_failure(self, estimate: Estimate, sample: Measurement) -> None:
        summary, is_mistake = self._summary, bool(_MISTAKE.search(estimate.message))
        summary.model_is_wrong |= is_mistake
        summary.failed += 1
        if summary.failed > 1:
            return
        remedy = "Bound the states, or make the model defined on all of them."
        if is_mistake:
            remedy = "Correct the model."
        elif fault := self._mhe.step_fault(estimate):
            remedy = fault
        elif estimate.message.startswith("the observer"):
            remedy = "Check the observer's covariances or gain, and the units."
        elif self._mhe.system.states is not None:
            remedy = "Make the model defined on all states within their bounds, or narrow these."
        summary.failure = f"{self._reader.place(sample)}: {estimate.message} {remedy}"
        if self._report is not None:
            self._report(
                f"the model failed at {summary.failure} The run continues; the status marks such "
                "rows."
            )

    def _advance(self, sample: Measurement, length: float | None) -> None:
        """Estimate a sample, and write its row."""
        estimate = self._update(sample.y, sample, length)
        self._output.write(
            self._rows.row(sample.time.text, estimate, self._mhe, self._inserted)
        )
        if self._latency is not None:
            self._latency.add(perf_counter() - sample.arrived)
        summary = self._summary
        summary.samples += 1
        summary.improved += estimate.improved
        summary.incomplete += Status.MISSING in estimate.status
        self._digest = _digest(self._digest, sample)
        if self._taken % self._newest.every == 0:
            self._mhe.forget_warm_start()  # in any case: a run that resumes has none here
            state = self._mhe.state_dict()
            if sample.complete:
                self._newest = replace(
                    self._newest, samples=self._taken, offset=self._output.offset,
                    time=sample.time.text, inputs=sample.u.tolist(), state=state,
                    bound={} if self._bounds is None else self._bounds.state_dict(),
                    usual_step=self._steps.usual, samples_digest=self._digest,
                    results_digest=self._output.digest, finished=False, versions=versions(),
                )
                self._is_saved = False
                if monotonic() - self._saved_at >= self._seconds:
                    self._save()

    def _save(self) -> None:
        """Write the newest checkpoint, after the rows that belong to it."""
        if self._is_saved or self._output.checkpoint is None:
            return
        self._output.sync()
        save(self._output.checkpoint, self._newest)
        self._is_saved, self._saved_at = True, monotonic()

    def _remedy(self, error: RecordError | WriteError) -> str:
        if self._output.checkpoint is None or not self._taken:
            return ""
        there = f" The {self._taken} samples before are in {self._output.name}; "
        if isinstance(error, WriteError):
            return f"{there}make room, and continue with --resume."
        return f"{there}correct the record, and continue with --resume."

    def _finished(self) -> Summary:
        reader, summary = self._reader, self._summary
        if self._mhe.engine != summary.engine:
            summary.engine += f", then {self._mhe.engine}"
        summary.held, summary.repeated = reader.held, reader.repeated
        summary.model = self._model
        summary.run = None if self._kept is None else self._kept.run()
        if summary.failed:
            stale = (
                f", which affects the windows of {summary.stale} more (FAILED_STAGE)"
                if summary.stale else ""
            )
            summary.failure = (
                f"the model failed at {summary.failed} of {summary.samples + summary.inserted} "
                f"samples (MODEL_FAILED){stale}, first at {summary.failure}"
            )
        if summary.inserted > summary.samples:
            summary.notes.append(
                f"{summary.inserted} samples were inserted into gaps, more than were measured; "
                "give --time-scale if the record's unit of time is not the model's."
            )
        summary.notes += reader.notes
        if self._steps.note:
            summary.notes.append(self._steps.note)
        if reader.cut is not None:
            summary.notes.append(
                f"the last line of {reader.name}, {reader.cut}, has no end of line and may be cut "
                "off: its numbers were used as they are. If more follows, --resume reads it again."
            )
        if self._bounds is not None:
            summary.notes.append(self._bounds.note)
        if reader.blank:
            summary.notes.append(
                f"{reader.blank} rows without any value of {reader.name} were skipped."
            )
        return summary


def _digest(before: str, sample: Measurement) -> str:
    """Digest of all samples, from the digest of the samples before."""
    content = f"{before} {sample.time.text} ".encode() + sample.y.tobytes() + sample.u.tobytes()
    return hashlib.sha256(content).hexdigest()
