"""From a checkpoint back to the place in the record where it was taken."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from ..errors import InvalidInputError
from ..estimator import MovingHorizonEstimator
from .checkpoint import Checkpoint
from .errors import CheckpointError
from .keeper import Keeper
from .numbers import Reader
from .samples import Record, Sample
from .sink import Sink
from .times import alike

__all__ = ["known_sample", "remaining"]


def known_sample(
    found: Checkpoint, sink: Sink, keeper: Keeper, estimator: MovingHorizonEstimator
) -> Sample | None:
    """Bring the estimator back; the last sample that it knows, None before the first.

    Parameters
    ----------
    found : Checkpoint
        Where to go on.
    sink, keeper, estimator
        Of the run.

    Raises
    ------
    CheckpointError
        If the checkpoint is of another model or other options.
    """
    differing = [
        f"{key} {found.identity.get(key)!r}, now {value!r}"
        for key, value in keeper.identity.items()
        if found.identity.get(key) != value
    ]
    if differing:
        raise CheckpointError(
            f"the checkpoint {sink.checkpoint} was made with {'; '.join(differing)}. Go "
            "on with the same model and options, or start again by --overwrite."
        )
    if not found.samples:
        return None
    try:
        estimator.load_state_dict(found.state)
        time, text = Reader(".").time(found.time)
        inputs = np.array(found.inputs, np.float64).reshape(estimator.system.m)
    except (InvalidInputError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"the checkpoint {sink.checkpoint} does not fit: {error}"
        ) from error
    return Sample(0, time, text, np.empty(0), inputs)


def remaining(
    found: Checkpoint, last: Sample | None, record: Record, sink: Sink, keeper: Keeper
) -> Iterator[Sample]:
    """The samples behind the last one that the checkpoint knows.

    Parameters
    ----------
    found : Checkpoint
        Where to go on.
    last : Sample or None
        What `known_sample` gave.
    record, sink, keeper
        Of the run.

    Raises
    ------
    CheckpointError
        If the record is not the one that the checkpoint was made of, or lacks samples whose
        rows are behind the checkpoint, and would be lost.
    """
    held = last.u if last is not None and record.is_stream else None
    samples = record.samples(held)
    if not record.is_stream:
        _pass_over(samples, found, record, keeper)
        # The last row of a record that was cut off may have a time that was, too.
        return samples if last is not None else _with_rows(samples, None, found, record, sink, 2)
    keeper.digest = found.digest
    if last is not None:
        samples = (
            sample for sample in samples
            if not alike(sample.time, last.time)
            or sample.time > last.time  # type: ignore[operator]
        )
    return _with_rows(samples, last, found, record, sink, 1)


def _pass_over(
    samples: Iterator[Sample], found: Checkpoint, record: Record, keeper: Keeper
) -> None:
    """Read over the samples that the checkpoint knows, and compare them with it."""
    for number in range(1, found.samples + 1):
        sample = next(samples, None)
        if sample is None:
            raise CheckpointError(
                f"{record.name} has {number - 1} samples, and the checkpoint was made "
                f"after {found.samples}; give the record that it was made of."
            )
        keeper.remember(sample)
        if number % keeper.every == 0:
            keeper.close_segment()
    if keeper.digest != found.digest:
        raise CheckpointError(
            f"the first {found.samples} samples of {record.name} are not those that the "
            "checkpoint was made of (or other columns are read); give the same record and "
            "columns, or start again by --overwrite."
        )
    record.held = record.repeated = 0


def _with_rows(
    samples: Iterator[Sample], last: Sample | None, found: Checkpoint, record: Record,
    sink: Sink, least: int,
) -> Iterator[Sample]:
    """The same samples, if those are among them whose rows are about to be cut off."""
    first, texts = next(samples, None), sink.times_behind(found.offset)
    if first is not None and last is not None and not alike(first.time, last.time):
        raise CheckpointError(
            f"the times of {record.name} are not of the kind of those before, such as "
            f"{last.text}; give the same record, or start again by --overwrite."
        )
    if len(texts) >= least:
        due = Reader(".").time(texts[0])[0]
        if first is None or not alike(first.time, due) or first.time > due:  # type: ignore[operator]
            known = "no sample" if last is None else f"those up to {last.text}"
            raise CheckpointError(
                f"{record.name} does not have the sample of time {texts[0]} again; its row and "
                f"those behind it would be lost, since the checkpoint knows {known}. Give the "
                "record from there, or from its beginning; or another --out; or start again "
                "by --overwrite."
            )
    return samples if first is None else chain((first,), samples)
