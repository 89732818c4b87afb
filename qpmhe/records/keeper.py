"""When checkpoints are taken and written, and the digests in them."""

from __future__ import annotations

import hashlib
import platform
from dataclasses import replace
from time import monotonic
from typing import Any

import numpy as np

from .. import __version__
from .checkpoint import Checkpoint, save
from .samples import Sample
from .sink import Sink

__all__ = ["Keeper", "versions"]


class Keeper:
    """The newest checkpoint of a run, in memory and on the disk.

    Parameters
    ----------
    sink : Sink
        Where the results go.
    identity : dict
        What a checkpoint must have been made with.
    every : int
        Samples from checkpoint to checkpoint.
    seconds : float
        Least time from one that is written to the disk to the next.

    Attributes
    ----------
    digest : str
        Of all samples up to the last checkpoint.
    """

    def __init__(
        self, sink: Sink, identity: dict[str, Any], every: int, seconds: float
    ) -> None:
        self.identity, self.every, self.digest = identity, every, ""
        self._sink, self._seconds = sink, seconds
        self._segment = bytearray()  # of the samples since the last checkpoint
        self._newest: Checkpoint | None = None
        self._written_at = monotonic()
        self._is_written = True

    def begin(self, header: bytes) -> None:
        """Write the checkpoint of no samples.

        Parameters
        ----------
        header : bytes
            The line that the results begin with.

        Raises
        ------
        WriteError
            If it cannot be written.
        """
        self._newest = Checkpoint(
            self.identity, self.every, 0, len(header), "", [], None, "",
            hashlib.sha256(header).hexdigest(), False, versions(), {},
        )
        self._is_written = False
        self.keep()

    def go_on(self, found: Checkpoint) -> None:
        """Take over a checkpoint that was written before.

        Parameters
        ----------
        found : Checkpoint
            The checkpoint.
        """
        self._newest = found

    def remember(self, sample: Sample) -> None:
        """Add a sample to the digest."""
        self._segment += sample.text.encode() + b"\n" + sample.y.tobytes() + sample.u.tobytes()

    def close_segment(self) -> None:
        """Bring the digest up to date; it depends on where this is done."""
        self.digest = hashlib.sha256(self.digest.encode() + self._segment).hexdigest()
        self._segment.clear()

    def take(
        self, sample: Sample, samples: int, usual: float | None, state: dict[str, Any]
    ) -> None:
        """Take a checkpoint, and write it if the last one is old enough.

        Parameters
        ----------
        sample : Sample
            The last one that was taken in.
        samples : int
            How many there were.
        usual : float or None
            The usual step.
        state : dict
            The estimator's.
        """
        self._newest = Checkpoint(
            self.identity, self.every, samples, self._sink.offset, sample.text,
            sample.u.tolist(), usual, self.digest, self._sink.digest, False, versions(), state,
        )
        self._is_written = False
        if monotonic() - self._written_at >= self._seconds:
            self.keep()

    def keep(self) -> None:
        """Write the newest checkpoint, if that is not done.

        Raises
        ------
        WriteError
            If it, or the results before it, cannot be written.
        """
        if self._newest is None or self._is_written:
            return
        assert self._sink.checkpoint is not None
        self._sink.sync()
        save(self._sink.checkpoint, self._newest)
        self._is_written, self._written_at = True, monotonic()

    def finish(self) -> None:
        """Write down that the record has come to its end."""
        if self._newest is not None:
            self._newest, self._is_written = replace(self._newest, finished=True), False
            self.keep()


def versions() -> dict[str, str]:
    """Of what computes the results."""
    return {"qpmhe": __version__, "numpy": np.__version__, "machine": platform.machine()}
