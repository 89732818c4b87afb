"""From a record to its estimates: what is opened and checked before the first sample."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .._checks import count
from .checkpoint import Checkpoint
from .columns import Wanted
from .errors import CheckpointError
from .failures import Failures
from .model import load_model
from .ownership import insist_on_two_files, may_write
from .results import Results
from .samples import Record
from .session import Session
from .sink import Sink
from .standard_output import standard_output_for_rows
from .steps import Steps
from .summary import Summary

__all__ = ["Summary", "estimate_record"]

_EVERY = 100


def estimate_record(
    model: str,
    record: str | Path,
    out: str | Path,
    *,
    time: str | None = None,
    outputs: str | None = None,
    inputs: str | None = None,
    separator: str | None = None,
    decimal: str = "auto",
    encoding: str = "utf-8",
    missing: Sequence[str] = (),
    dt: float | None = None,
    time_scale: float = 1.0,
    equal_steps: bool = False,
    max_gap: int | None = None,
    skip_repeated: bool = False,
    covariances: str = "none",
    step_time: bool = True,
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int | None = None,
    checkpoint_seconds: float = 1.0,
    progress: Callable[[int, int | None], None] | None = None,
    tell: Callable[[str], None] | None = None,
    **options: Any,
) -> Summary:
    """Estimate the states of a measured record, and write them down sample by sample.

    Where the model was made by `qpmhe.System.from_ode`, each step has the length that the
    record says, so a sample is taken in when the time of the next one is known. Otherwise, or
    with ``equal_steps``, the times must be those of equal steps. A gap of k steps is filled
    by k - 1 samples without measurement, with the inputs held.

    Parameters
    ----------
    model : str
        Name of the catalogue, ``package.module:function`` or ``path/file.py:function``; see
        `qpmhe.records.model.load_model`.
    record : str or Path
        CSV (or gzip of it) or Parquet file with a header; ``-`` is standard input.
    out : str or Path
        File in .csv or .parquet, which must not be there yet; ``-`` is standard output.
    time : str, optional
        Column of the time, numbers or ISO dates (which count in seconds).
    outputs, inputs : str, optional
        Columns of y and u, as ``y1=column,y2=column``, or columns in order.
    separator, decimal, encoding : str, optional
        How a CSV file is written, where it cannot be told from the file.
    missing : sequence of str
        Words (or numbers) that stand for a missing value, besides the usual ones.
    dt : float, optional
        Usual step of a discrete-time model, in its unit of time.
    time_scale : float
        The record's unit of time in the model's.
    equal_steps : bool
        Insist on equal steps also where the model takes any.
    max_gap : int, optional
        Most samples without measurement in a row. If left out, 1000, and a record that
        consists of gaps of one size is refused: its unit of time is another.
    skip_repeated : bool
        Pass over lines whose time is that of the line before.
    covariances : {"none", "std", "full"}
        What to write of the covariances.
    step_time : bool
        Whether to write the seconds of each step.
    resume : bool
        Go on where the checkpoint beside ``out`` stands, if there is one.
    overwrite : bool
        Replace what is there, whatever it is.
    checkpoint_every : int, optional
        Samples from checkpoint to checkpoint, 100 if left out. A solver forgets its warm
        start there, so the number belongs to the last bits of the results.
    checkpoint_seconds : float
        Least time from one that is written to the disk to the next.
    progress : callable, optional
        Called after each sample with bytes (or rows) read and their total, if it is known.
    tell : callable, optional
        Called with a text when the model fails for the first time; the run goes on.
    **options
        Options of `qpmhe.MovingHorizonEstimator` that replace the model's own.

    Returns
    -------
    Summary
        Counts.

    Raises
    ------
    RecordError
        If the record cannot be read or read on; the rows before stay, and can be resumed.
    CheckpointError
        If the checkpoint does not fit.
    WriteError
        If results cannot be written, as on a full disk; the rows before stay.
    InvalidInputError
        If model, options or files do not fit, or a file is there already; nothing has been
        written then.
    """
    sink = Sink(out)
    insist_on_two_files(record, sink)
    found = may_write(sink, resume, overwrite)
    every = _every(checkpoint_every, found)
    with contextlib.ExitStack() as stack:
        if sink.path is None:
            # Neither a model nor a solver may print among the rows.
            sink.use(stack.enter_context(standard_output_for_rows()))
        made = load_model(model, **options)
        results = Results(made.states, covariances, step_time)
        steps = Steps(
            made.estimator.system, usual=made.dt if dt is None else dt, scale=time_scale,
            equal=equal_steps, most=max_gap,
        )
        wanted = Wanted(made.outputs, made.inputs, time, outputs, inputs)
        source = Record(
            record, wanted, separator=separator, decimal=decimal, encoding=encoding,
            missing=(missing,) if isinstance(missing, str) else missing,
            skip_repeated=skip_repeated,
        )
        stack.callback(source.close)
        stack.callback(sink.close)
        timing = {
            "dt": dt, "time_scale": time_scale, "equal_steps": equal_steps,
            "max_gap": steps.most,
        }
        session = Session(
            made.estimator, results, steps, source, sink,
            Failures(made.estimator.system, made.estimator.horizon, made.file),
            identity=made.identity | timing, every=every, seconds=checkpoint_seconds, tell=tell,
        )
        return session.run(found, progress)


def _every(given: int | None, found: Checkpoint | None) -> int:
    every = _EVERY if given is None else count("--checkpoint-every", given, 1)
    if found is None:
        return every
    if given is not None and every != found.every:
        raise CheckpointError(
            f"the checkpoint was made with --checkpoint-every {found.every}, not {every}; leave "
            "the option out."
        )
    return found.every
