"""Rows of results: their columns, and the file or stream that they go to."""

from __future__ import annotations

import contextlib
import csv
import ctypes
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np

from .._checks import need
from ..errors import InvalidInputError, OptionError
from ..estimation.estimate import Estimate
from ..estimation.estimator import MovingHorizonEstimator
from .checkpoints import CheckpointError, WriteError
from .measurements import FieldReader
from .readers import is_json

if TYPE_CHECKING:
    from .bounds import RowBounds

_COVARIANCES = ("none", "std", "full")
_PIECE = 1 << 20
_JSON_NUMBER = re.compile(r"-?(0|[1-9]\d*)(\.\d+)?([eE][+-]?\d+)?")
_NO_JSON = frozenset(("", "inf", "-inf", "nan"))
_STANDARD_OUTPUT = 1  # the number of its file descriptor


class RowFormat:
    """What is written for each sample."""

    def __init__(
        self, states: tuple[str, ...], covariances: str, step_time: bool,
        bounds: RowBounds | None = None,
    ) -> None:
        if covariances not in _COVARIANCES:
            raise OptionError(
                f"--covariances is {covariances!r}; expected {', '.join(_COVARIANCES)}."
            )
        self._covariances, self._step_time, self._bounds = covariances, step_time, bounds
        self._upper = np.triu_indices(len(states))
        kinds = ("filtered", "predicted")
        self.header = ["time", *(f"{kind}_{name}" for kind in kinds for name in states)]
        if covariances == "std":
            self.header += [f"std_{kind}_{name}" for kind in kinds for name in states]
        elif covariances == "full":
            self.header += [
                f"cov_{kind}_{states[i]}_{states[j]}"
                for kind in kinds for i, j in zip(*self._upper, strict=True)
            ]
        if bounds is not None:
            self.header += bounds.header(states)
        self.header += ["cost", "candidate_cost", "status", "qps", "inserted"]
        if step_time:
            self.header.append("step_time")

    def row(
        self, time: str, estimate: Estimate, estimator: MovingHorizonEstimator, inserted: int
    ) -> list[str]:
        """The fields of a sample: numbers with all their digits, blank where there is none."""
        numbers = [*estimate.filtered.tolist(), *estimate.state.tolist()]
        if self._covariances != "none":
            numbers += self._uncertainties(estimator)
        if self._bounds is not None:
            numbers += self._bounds.numbers
        numbers += [estimate.cost, estimate.candidate_cost]
        fields = [time, *("" if value != value else repr(value) for value in numbers)]
        status = str(estimate.status).removeprefix("Status.")
        fields += [status, str(estimate.qps), str(inserted)]
        if self._step_time:
            fields.append(f"{estimate.step_time:.3g}")
        return fields

    def _uncertainties(self, estimator: MovingHorizonEstimator) -> list[float]:
        try:
            both = estimator.covariances()[-2:]
        except InvalidInputError:  # bad luck: the run continues
            both = np.full((2, estimator.system.n, estimator.system.n), np.nan)
        if self._covariances == "full":
            return both[:, *self._upper].ravel().tolist()
        with np.errstate(invalid="ignore"):
            deviations = np.sqrt(np.diagonal(both, axis1=1, axis2=2))
        return deviations.ravel().tolist()


class _Echo:
    def write(self, text: str) -> str:
        return text


class _CsvLines:
    """Rows as lines of a CSV file, whose first line has the names."""

    has_header = True

    def __init__(self) -> None:
        self._writer: Any = csv.writer(cast(Any, _Echo()), lineterminator="\n")

    def header(self, names: Sequence[str]) -> str:
        return self.line(names)

    def line(self, fields: Sequence[str]) -> str:
        return str(self._writer.writerow(fields))

    def time(self, line: str) -> str:
        return next(csv.reader([line]))[0]


class _JsonLines:
    """Rows as JSON objects; blank fields, and those that JSON has no number for, are null."""

    has_header = False

    def header(self, names: Sequence[str]) -> str:
        self._names = [json.dumps(name) for name in names]
        return ""

    def line(self, fields: Sequence[str]) -> str:
        values = map(self._value, fields)
        pairs = (f"{name}: {value}" for name, value in zip(self._names, values, strict=True))
        return f"{{{', '.join(pairs)}}}\n"

    def time(self, line: str) -> str:
        return str(json.loads(line, parse_float=str, parse_int=str)["time"])

    @staticmethod
    def _value(text: str) -> str:
        if text in _NO_JSON:
            return "null"
        return text if _JSON_NUMBER.fullmatch(text) else json.dumps(text)


class Output:
    """Rows to a file or standard output, each written whole and at once.

    A Parquet file cannot be continued: its rows are gathered in a CSV file beside it, named
    with ``.part.csv`` at the end (`path`), which `finish` converts to `target`. For
    standard output both and `checkpoint` are None. `offset` counts the bytes of the results.
    """

    def __init__(self, out: str | Path, kind: str = "auto") -> None:
        self.path: Path | None = None
        self.target: Path | None = None
        self.checkpoint: Path | None = None
        self.offset = 0
        self._stream: BinaryIO | None = None
        self._hash = hashlib.sha256()
        self._lines = _JsonLines() if is_json(str(out), kind) else _CsvLines()
        if str(out) == "-":
            if sys.stdout is None:
                raise OptionError("standard output is closed; name a file with --out.")
            return
        self.path = self.target = path = Path(out)
        if path.suffix not in (".csv", ".parquet", ".jsonl"):
            raise OptionError(
                f"--out is {str(out)!r}; expected a name in .csv, .parquet or .jsonl, or - for "
                "standard output."
            )
        if path.suffix == ".parquet":
            need("pyarrow", "a Parquet file")
            self.path = path.with_name(f"{path.name}.part.csv")
        if os.path.exists(path) and not os.path.isfile(path):
            raise OptionError(f"--out is {str(out)!r}, which is no file; give another name.")
        self.checkpoint = path.with_name(f"{path.name}.checkpoint")

    @property
    def name(self) -> str:
        """How messages name the place of the rows."""
        return "standard output" if self.path is None else str(self.path)

    @property
    def digest(self) -> str:
        """Digest of all bytes so far."""
        return self._hash.hexdigest()

    def use(self, stream: BinaryIO) -> None:
        """Write to this stream, which leads to standard output."""
        self._stream = stream

    def name_columns(self, names: Sequence[str]) -> str:
        """Say what each field of a row is; the line to write at the beginning, if there is one."""
        return self._lines.header(names)

    def begin(self) -> None:
        """Open a new file, and remove its old checkpoint."""
        if self.path is None or self.checkpoint is None:
            return
        try:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                self.checkpoint.unlink()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.path.open("wb", buffering=0)
        except OSError as error:
            raise self._failed(error, " Name another place with --out.") from error

    def resume(self, offset: int, digest: str) -> None:
        """Open a file to continue after `offset` bytes, whose `digest` is known."""
        assert self.path is not None
        again = "start again with --overwrite."
        try:
            stream = cast(BinaryIO, self.path.open("r+b", buffering=0))
            self._stream = stream
            if self.path.stat().st_size < offset:
                raise CheckpointError(f"{self.path} is shorter than its checkpoint says; {again}")
            while (left := offset - stream.tell()) > 0:
                self._hash.update(stream.read(min(left, _PIECE)))
            if self.digest != digest:
                raise CheckpointError(
                    f"{self.path} was changed after its checkpoint was written; undo the change, "
                    f"or {again}"
                )
            stream.truncate()
            self.offset = offset
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{self.path} is missing, but its checkpoint {self.checkpoint} exists; {again}"
            ) from error
        except OSError as error:
            raise self._failed(error) from error

    def times_after(self, offset: int) -> list[str]:
        """Times of the first two rows after `offset` bytes of the file, as far as they exist."""
        assert self.path is not None
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                if offset == 0 and self._lines.has_header:
                    file.readline()
                lines = [file.readline().decode() for _ in range(2)]
        except OSError:  # opening it to write reports the error
            return []
        return [self._lines.time(line) for line in lines if line.endswith("\n")]

    def write(self, fields: Sequence[str]) -> None:
        """Write a row at once; if that fails, the file still ends with a whole row."""
        self.write_line(self._lines.line(fields))

    def write_line(self, text: str) -> None:
        """Write a line likewise."""
        stream = self._stream
        assert stream is not None
        line = text.encode()
        try:
            done = 0
            while done < len(line):
                done += stream.write(line[done:])
            if self.path is None:
                stream.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            if self.path is not None:
                with contextlib.suppress(OSError):
                    stream.truncate(self.offset)
            raise self._failed(error) from error
        self.offset += len(line)
        self._hash.update(line)

    def sync(self) -> None:
        """Wait until all rows are on the disk."""
        assert self._stream is not None
        try:
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Close the file."""
        if self.path is not None and self._stream is not None:
            self._stream.close()
        self._stream = None

    def finish(self, time_type: Any = None) -> None:
        """Convert to Parquet if the target is one, and remove the CSV file and the checkpoint."""
        self.close()
        if self.target is None or self.path is None or self.path == self.target:
            return
        arrow = need("pyarrow", "a Parquet file")
        temporary = self.target.with_name(f"{self.target.name}.tmp")
        try:
            try:
                _to_parquet(self.path, temporary, time_type)
            except arrow.ArrowNotImplementedError:  # CSV cannot be converted to this type
                _to_parquet(self.path, temporary, None)
            os.replace(temporary, self.target)
        except (OSError, arrow.ArrowException) as error:
            temporary.unlink(missing_ok=True)
            raise WriteError(
                f"cannot write {self.target}: {getattr(error, 'strerror', None) or error}. All "
                f"rows are in {self.path}; make room, and --resume converts them."
            ) from error
        for path in filter(None, (self.path, self.checkpoint)):
            path.unlink(missing_ok=True)

    def _failed(self, error: OSError, remedy: str = "") -> WriteError:
        return WriteError(f"cannot write {self.name}: {error.strerror or error}.{remedy}")


def _to_parquet(source: Path, target: Path, time_type: Any) -> None:
    """Convert a CSV file of results; the type of its times is inferred if it is None."""
    arrow, arrow_csv, parquet = (
        need(module, "a Parquet file") for module in ("pyarrow", "pyarrow.csv", "pyarrow.parquet")
    )
    with source.open(encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        types = dict.fromkeys(next(lines), arrow.float64())
        are_durations = FieldReader().time(next(lines)[0]).kind == "duration"
    if are_durations:
        wanted, time_type = time_type or arrow.duration("ns"), arrow.string()
    elif time_type is None:
        only_time = arrow_csv.ConvertOptions(include_columns=["time"])
        time_type = arrow_csv.read_csv(source, convert_options=only_time).schema.types[0]
    types |= {
        "time": time_type, "status": arrow.string(), "qps": arrow.int32(),
        "inserted": arrow.int32(),
    }

    def converted(batch: Any) -> Any:
        if not are_durations:
            return batch
        times = [FieldReader().time(text).value for text in batch["time"].to_pylist()]
        columns = arrow.array(times, arrow.duration("ns")).cast(wanted)
        return batch.set_column(0, "time", columns)

    options = arrow_csv.ConvertOptions(column_types=types)
    with arrow_csv.open_csv(source, convert_options=options) as reader:
        batches = map(converted, reader)
        first = next(batches)
        with parquet.ParquetWriter(target, first.schema) as writer:
            for batch in chain([first], batches):
                writer.write_batch(batch)


@contextlib.contextmanager
def standard_output_for_rows() -> Iterator[BinaryIO]:
    """Give a stream to standard output; meanwhile all other output goes to standard error.

    The C code of solvers prints on file descriptor 1, past ``sys.stdout``. So the rows go to a
    duplicate of the descriptor, and 1 itself is pointed at standard error, in the whole process.
    Where ``sys.stdout`` is no file descriptor 1, as in a notebook, only it is replaced.
    """
    text = sys.stdout
    assert text is not None
    with contextlib.ExitStack() as stack:
        rows = text.buffer
        if _is_descriptor(text):
            rows = stack.enter_context(_duplicate(text))
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        yield rows


def _is_descriptor(text: Any) -> bool:
    try:
        return bool(text.fileno() == _STANDARD_OUTPUT)
    except (AttributeError, OSError, ValueError):  # of a notebook, a test, or closed
        return False


@contextlib.contextmanager
def _duplicate(text: object) -> Iterator[BinaryIO]:
    """Standard output under another number, while 1 is standard error, or nothing."""
    _flush(text)
    kept = os.dup(_STANDARD_OUTPUT)
    rows = os.fdopen(kept, "wb")
    try:
        if sys.__stderr__ is None:  # closed: another file may have its number by now
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, _STANDARD_OUTPUT)
            os.close(nowhere)
        else:
            os.dup2(sys.__stderr__.fileno(), _STANDARD_OUTPUT)
        yield rows
    finally:
        _flush(text)  # what C or Python still holds belongs to standard error, too
        os.dup2(kept, _STANDARD_OUTPUT)
        with contextlib.suppress(OSError):  # whoever read the rows has gone, which was raised
            rows.close()


def _flush(text: Any) -> None:
    with contextlib.suppress(OSError, ValueError):
        text.flush()
    # The C library has a buffer of its own; where it is not found, that goes out at the end.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).fflush(None)
