"""Record QPs while a backend solves them."""

from __future__ import annotations

import os
import re
import threading
import warnings
from copy import deepcopy
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Literal, get_args

import numpy as np

from .errors import InvalidInputError, OptionError
from .files import dump
from .options import SolverOptions
from .qp import QP, Array
from .registry import backend as registered_backend
from .registry import backends, create, register, unregister
from .solution import Solution, SolveStatus
from .solver import ContainedSolver, Solver

Which = Literal["suspicious", "failed", "all"]


class RecordingWarning(UserWarning):
    """Some QPs were not recorded; solving them was not affected."""


class Recording:
    """A backend that solves with another one, and saves QPs with `dump`.

    Inside ``with``, use ``recording.backend`` as the name of a backend::

        with qpmhe.solvers.Recording("folder", "osqp") as recording:
            mhe = qpmhe.MovingHorizonEstimator(..., backend=recording.backend)
            mhe.run(measurements)

    QPs and solutions pass through unchanged: the results are the backend's. A failure to record
    never reaches the caller; it ends the recording, and a warning reports it when the block ends.
    Files are written at once, so that those before a crash are safe. Only if the solver has a time
    limit, they are written at the end of the block, so that they delay no step.

    Parameters
    ----------
    folder : str or path
        Folder for the files, created if needed. Their names, ``qp-000012-failed.npz``, hold a
        running number over all solved QPs, which continues after existing files, and the verdict.
    backend : str
        The backend that solves.
    only : {"suspicious", "failed", "all"}
        Which QPs are kept. ``failed`` keeps those without an iterate. ``suspicious`` also keeps
        those with a claim of success that the residuals do not confirm, those that a solver gave up
        without a limit, and those whose inequalities were ignored by a backend that handles them.
    limit : int
        Most files to write, at least 1.
    isolated : bool
        As in `create`: a QP that kills the solver's process is then kept as a failed one.

    Attributes
    ----------
    files : list of Path
        The files, in the order of their QPs.
    seen, wanted : int
        Numbers of QPs that were solved, and that qualified to be kept.

    Raises
    ------
    BackendError
        If the backend is unknown.
    OptionError
        If ``only`` or ``limit`` is invalid.
    InvalidInputError
        If the folder cannot be created or written to.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        backend: str = "auto",
        *,
        only: Which = "suspicious",
        limit: int = 100,
        isolated: bool = False,
    ) -> None:
        self._backend = registered_backend(backend)
        if only not in get_args(Which):
            known = ", ".join(repr(choice) for choice in get_args(Which))
            raise OptionError(f"only is {only!r}; expected one of {known}.")
        if isinstance(limit, bool) or not isinstance(limit, (int, np.integer)) or limit < 1:
            raise OptionError(f"limit is {limit!r}; expected an integer >= 1.")
        self._only, self._limit, self._isolated = only, int(limit), isolated
        self._folder = _writable(Path(folder))
        self._offset = _last_number(self._folder)
        self.files: list[Path] = []
        self.seen, self.wanted = 0, 0
        self._fault = ""
        self._held: list[tuple[int, QP, Array | None, Solution, SolverOptions]] = []
        self._name = ""
        self._lock = threading.Lock()

    @property
    def backend(self) -> str:
        """The backend's name within the block.

        Raises
        ------
        InvalidInputError
            Outside of the block.
        """
        if not self._name:
            raise InvalidInputError(
                "the recording has not started; use its backend within `with Recording(...) as "
                "recording:`."
            )
        return self._name

    def __enter__(self) -> Recording:
        with self._lock:
            if self._name:
                raise InvalidInputError("the recording has already started; create another one.")
            taken, name = {one.name for one in backends()}, f"recorded:{self._backend.name}"
            names = chain([name], (f"{name}:{number}" for number in count(2)))
            self._name = next(name for name in names if name not in taken)
            register(replace(self._backend, name=self._name, factory=self._make))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._lock:
            unregister(self._name)
            self._name = ""
            held, self._held = self._held, []
            for one in held:
                self._write(*one)
            fault, self._fault = self._fault, ""
        if fault:
            warnings.warn(
                f"recording QPs stopped after {len(self.files)} files in {self._folder}: {fault}",
                RecordingWarning, stacklevel=2,
            )

    def __repr__(self) -> str:
        return (
            f"Recording({len(self.files)} files in {str(self._folder)!r}; "
            f"{self.wanted} of {self.seen} QPs were {self._only})"
        )

    def _make(self, options: SolverOptions) -> Solver:
        return _Recorder(create(self._backend.name, options, isolated=self._isolated), self)

    def _take(
        self, qp: QP, start: Array | None, solution: Solution, options: SolverOptions
    ) -> None:
        """Keep a QP if it is one of those to be kept; never raises an `Exception`."""
        try:
            with self._lock:
                if not self._name:
                    return
                self.seen += 1
                if not self._keeps(solution, options):
                    return
                self.wanted += 1
                if self._fault or len(self.files) + len(self._held) >= self._limit:
                    return
                one = self._offset + self.seen, qp, start, solution, options
                if options.time_limit is None:
                    self._write(*one)
                else:  # copied: arrays of problem and iterate are used again
                    self._held.append(deepcopy(one))
        except Exception as error:  # nothing that goes wrong here is the caller's business
            self._fault = f"{type(error).__name__}: {error}"

    def _keeps(self, solution: Solution, options: SolverOptions) -> bool:
        unlimited = options.max_iterations is None and options.time_limit is None
        suspicious = {
            SolveStatus.STOPPED: unlimited, SolveStatus.INACCURATE: True,
            SolveStatus.UNCONSTRAINED: self._backend.inequalities,
        }.get(solution.status, False)
        failed = solution.status is SolveStatus.FAILED
        return failed or self._only == "all" or (self._only == "suspicious" and suspicious)

    def _write(
        self, number: int, qp: QP, start: Array | None, solution: Solution, options: SolverOptions
    ) -> None:
        if self._fault:
            return
        path = self._folder / f"qp-{number:06d}-{solution.status.name.lower()}.npz"
        try:
            dump(
                qp, path, solution=solution, backend=self._backend.name, options=options,
                start=start,
            )
            self.files.append(path)
        except Exception as error:
            self._fault = str(error)


class _Recorder(Solver):
    """Hands QPs on to another solver, and shows them to a recording."""

    _judges = True

    def __init__(self, solver: Solver, recording: Recording) -> None:
        super().__init__(solver.options)
        self._inner, self._recording = ContainedSolver(solver), recording

    def _solve(self, qp: QP, start: Array | None) -> Solution:
        solution = self._inner.solve(qp, start, self.time_limit)
        self._recording._take(qp, start, solution, self.options)
        return solution

    def prepare(self, size: int) -> None:
        self._inner.prepare(size)

    def forget(self) -> None:
        self._inner.forget()

    def shift(self) -> None:
        self._inner.shift()


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"cannot make the folder {folder}: {error.strerror}; give another one."
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidInputError(f"the folder {folder} cannot be written to; give another one.")
    return folder


def _last_number(folder: Path) -> int:
    found = [re.match(r"qp-(\d+)-", path.name) for path in folder.glob("qp-*.npz")]
    return max((int(match[1]) for match in found if match), default=0)
