"""A backend in a separate process, so that a crash or hang fails only one QP."""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import Future
from contextlib import suppress
from typing import IO, Any, cast

from .backend import Backend, make_solver
from .errors import BackendError
from .options import SolverOptions
from .qp import QP, Array
from .solution import Solution, SolveStatus
from .solver import ContainedSolver, Solver

# Seconds in which a process has to import and make its solver.
_START = 120.0
# Share of the time limit that a backend with a clock of its own may take beyond it.
_GRACE = 0.25
_PROGRAM = (
    "import sys; sys.path[:] = {path!r}; from qpmhe_solvers.isolated import serve; serve({parent})"
)


class IsolatedSolver(Solver):
    """Solve by a backend in a child process.

    The process is started once, and ends with this solver. If it dies, or exceeds the time limit,
    the QP has FAILED and a new process replaces it. Until that is ready, a QP waits for it, but at
    most for half the time limit.
    """

    _judges = True

    def __init__(self, backend: Backend, options: SolverOptions) -> None:
        super().__init__(options)
        self._backend, self._size = backend, 0
        self._sent = _packed(backend)
        self._child: _Child | None = _Child(self._sent, options, 0)
        fault = self._child.wait(_START)
        if fault:
            self._child.end()
            raise BackendError(f"backend {backend.name!r} cannot be isolated: {fault}")

    def __reduce__(self) -> tuple[type[IsolatedSolver], tuple[Backend, SolverOptions]]:
        return type(self), (self._backend, self.options)

    def _solve(self, qp: QP, start: Array | None) -> Solution:
        began, limit = time.monotonic(), self.time_limit
        child = self._living()
        # Where a process is starting, the solve has half of the time at least.
        fault = child.wait(_START if limit is None else 0.5 * limit)
        if fault:
            if child.fault:
                self._replace()
            return Solution(None, SolveStatus.FAILED, message=fault)
        if limit is not None:
            limit *= 1.0 + (_GRACE if self._backend.time_limit else 0.0)
            limit -= time.monotonic() - began
        try:
            answer = child.ask(("solve", qp, start, self.time_limit), limit)
        except _DeadError as error:
            self._replace()
            return Solution(None, SolveStatus.FAILED, message=f"{self._backend.name}: {error}")
        except BaseException:  # an interrupted dialogue cannot go on
            child.end()
            self._child = None
            raise
        if isinstance(answer, Solution):
            return answer
        message = f"the process sent a {type(answer).__name__}, not a Solution"
        return Solution(None, SolveStatus.FAILED, message=message)

    def forget(self) -> None:
        """Forwarded; see `Solver.forget`."""
        self._send("forget")

    def shift(self) -> None:
        """Forwarded; see `Solver.shift`."""
        self._send("shift")

    def prepare(self, size: int) -> None:
        """Forwarded, and waited for; see `Solver.prepare`."""
        self._size = size
        child = self._living()
        if not child.wait(_START):
            try:
                child.ask(("prepare", size), None)
            except _DeadError:
                self._replace()

    def _send(self, what: str) -> None:
        child = self._child
        # A process that is starting has nothing to forget or to shift.
        if child is not None and child.mine and child.fault == "":
            with suppress(_DeadError):
                child.send((what,))

    def _living(self) -> _Child:
        """The process; a forked copy of this one must not talk to that of its parent."""
        if self._child is None or not self._child.mine:
            self._replace()
        return cast("_Child", self._child)

    def _replace(self) -> None:
        if self._child is not None:
            self._child.end()
        self._child = _Child(self._sent, self.options, self._size)


class _DeadError(Exception):
    """The process is no more; the text says why."""


class _Child:
    """A process with a solver, and the pipes to it."""

    def __init__(self, sent: bytes, options: SolverOptions, size: int) -> None:
        self._owner = os.getpid()
        self._process = process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(path=sys.path, parent=self._owner)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )
        self._out = cast("IO[bytes]", process.stdin)
        self._back = cast("IO[bytes]", process.stdout)
        self.end = weakref.finalize(self, _end, process, self._owner)
        self._late = False
        # Answered by a thread: while a process starts, steps go on without it.
        self._started: Future[str] = Future()
        threading.Thread(
            target=_begin, args=(process, (sent, options, size), self._started), daemon=True
        ).start()

    @property
    def mine(self) -> bool:
        """Whether it was started by this process."""
        return self._owner == os.getpid()

    @property
    def fault(self) -> str | None:
        """Why it could not make the solver, empty once it has; None while it starts."""
        return self._started.result() if self._started.done() else None

    def wait(self, seconds: float) -> str:
        """Wait until the solver is made; what hinders it, if anything does."""
        try:
            return self._started.result(seconds)
        except TimeoutError:
            return f"the process of the backend was not ready after {seconds:g} s"

    def send(self, message: object) -> None:
        """Send a message."""
        try:
            _write(self._out, message)
        except OSError as error:
            raise _DeadError(self._death()) from error

    def ask(self, message: object, seconds: float | None) -> object:
        """Send a message and wait for the answer, at most so long."""
        timer = None
        if seconds is not None:
            timer = threading.Timer(max(seconds, 0.0), self._stop)
            timer.daemon = True
            timer.start()
        try:
            self.send(message)
            return pickle.load(self._back)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            raise _DeadError(self._death()) from error
        finally:
            if timer is not None:
                timer.cancel()

    def _stop(self) -> None:
        self._late = True
        self._process.kill()

    def _death(self) -> str:
        if self._late:
            return "out of time: its process was killed at the time limit"
        return _death(self._process)


def _death(process: subprocess.Popen[bytes]) -> str:
    """How a process ended."""
    try:
        code = process.wait(5.0)
    except subprocess.TimeoutExpired:
        return "its process does not answer"
    if code >= 0:
        return f"its process ended with exit code {code}"
    try:
        return f"its process died: {signal.Signals(-code).name}"
    except ValueError:
        return f"its process died of signal {-code}"


def _begin(process: subprocess.Popen[bytes], message: object, started: Future[str]) -> None:
    """Have the solver made, and pass the answer on; the process may end meanwhile."""
    try:
        _write(cast("IO[bytes]", process.stdin), message)
        started.set_result(str(pickle.load(cast("IO[bytes]", process.stdout))))
    except (OSError, EOFError, ValueError, pickle.UnpicklingError):
        started.set_result(_death(process))


def _end(process: subprocess.Popen[bytes], owner: int) -> None:
    """End a process, unless this is a forked copy of who started it."""
    if os.getpid() != owner:
        return
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        with suppress(OSError):  # what could not be sent any more
            cast("IO[bytes]", pipe).close()


def _packed(backend: Backend) -> bytes:
    """The backend as bytes, by value where it belongs to the main script."""
    try:
        for name in ("cloudpickle", "joblib.externals.cloudpickle"):
            try:
                pickler: Any = importlib.import_module(name)
            except ImportError:
                continue
            return cast("bytes", pickler.dumps(backend))
        sent = pickle.dumps(backend)
    except Exception as error:
        raise BackendError(
            f"backend {backend.name!r} cannot be isolated: its factory cannot be sent to another "
            f"process ({type(error).__name__}: {error}); make it a class or a function of an "
            "importable module."
        ) from error
    if b"__main__" in sent:
        raise BackendError(
            f"backend {backend.name!r} cannot be isolated: its factory is in the main script, "
            "which another process cannot import; move it into a module, or install cloudpickle."
        )
    return sent


def _write(pipe: IO[bytes], message: object) -> None:
    pipe.write(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))
    pipe.flush()


def serve(parent: int) -> None:
    """Main loop of the child process: make a solver, then answer until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for who waits for the answer
    # What backends print must not get between the answers.
    back, commands = os.fdopen(os.dup(1), "wb"), os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    with suppress(EOFError, OSError):
        solver = _made(commands, back)
        while solver is not None:
            what, *given = cast("tuple[Any, ...]", pickle.load(commands))
            answer = getattr(solver, what)(*given)
            if what in ("solve", "prepare"):
                try:
                    _write(back, answer)
                except (TypeError, AttributeError, pickle.PicklingError) as error:
                    message = f"what `solve` returned cannot be sent: {error}"
                    _write(back, Solution(None, SolveStatus.FAILED, message=message))


def _made(commands: IO[bytes], back: IO[bytes]) -> ContainedSolver | None:
    sent, options, size = cast("tuple[bytes, SolverOptions, int]", pickle.load(commands))
    try:
        importlib.import_module("scipy.linalg.blas")  # which the first QP would wait for
        solver = ContainedSolver(make_solver(pickle.loads(sent), options))
        if size:
            solver.prepare(size)
    except BaseException as error:  # a module may even try to leave the process
        _write(back, f"{type(error).__name__}: {error}")
        return None
    _write(back, "")
    return solver


def _end_with(parent: int) -> None:
    """End this process soon after its parent, even within a solve."""
    while os.name != "posix" or os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
