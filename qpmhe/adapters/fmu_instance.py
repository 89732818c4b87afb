"""An FMU that runs: its rate, its outputs and their derivatives at any state and input."""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from ctypes import POINTER, c_double, c_uint
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import need
from ..errors import ModelError
from ..model.functions import EvaluationError

Array = NDArray[np.float64]
#: Values by type and reference: what is set before the initialisation.
Values = tuple[tuple[str, int, Any], ...]

_FATAL = 4
_DISCARD = 2
# A model without events settles in its first iteration.
_MOST_ITERATIONS = 100
_NUMBERS = count()
# FMPy changes the working directory while it loads a library.
_LOADING = threading.Lock()
# The last messages of each instance, by its name.
_SAID: dict[str, deque[str]] = {}


class Wiring(NamedTuple):
    """What is read from a file, and set in it: equal wirings share one instance.

    Attributes
    ----------
    digest : str
        Of the file's contents.
    fmi : int
        2 or 3.
    identifier, token : str
        The name of its library, and what identifies the model.
    states, inputs, outputs : tuple of int
        References of the states, and of the chosen inputs and outputs.
    rates : tuple of int
        References of the states' derivatives.
    values : Values
        Parameters, and inputs that do not change.
    start : float
        The time.
    is_alone : bool
        Whether a process may have no second instance.
    """

    digest: str
    fmi: int
    identifier: str
    token: str
    states: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    rates: tuple[int, ...]
    values: Values
    start: float
    is_alone: bool


class Instance:
    """One instance of an FMU for model exchange, in continuous-time mode.

    It is a function of state and input: both are set before anything is read, and what was
    evaluated before has no influence. So estimators and copies of a system share one. Each has a
    copy of the library of its own, and with it the library's static variables. Threads take turns.

    An error of the FMU at some state makes it start again. An integrator's step is never completed:
    the states at which an estimator evaluates are trials.
    """

    def __init__(self, path: Path, wiring: Wiring) -> None:
        self.wiring = wiring
        self.name = f"{wiring.identifier}_{next(_NUMBERS)}"
        self._lock = threading.RLock()
        self._folder = tempfile.mkdtemp(prefix="qpmhe-fmu-")
        self._model: Any = None
        self._is_running, self._lost = False, ""
        self._finalizer = weakref.finalize(
            self, _closed, None, self.name, self._folder, os.getpid()
        )
        fmpy = need("fmpy", "from_fmu", "fmu")
        _SAID[self.name] = deque(maxlen=3)
        module = need(f"fmpy.fmi{wiring.fmi}", "from_fmu", "fmu")
        with _LOADING:
            here = os.getcwd()
            try:
                fmpy.extract(str(path), self._folder)
                self._model = getattr(module, f"FMU{wiring.fmi}Model")(
                    guid=wiring.token, modelIdentifier=wiring.identifier,
                    unzipDirectory=self._folder, instanceName=self.name,
                )
            except Exception as error:
                raise ModelError(
                    f"{path.name}: its library cannot be loaded here ({error}). Libraries that it "
                    "needs must be installed, and it must have all functions of FMI "
                    f"{wiring.fmi}; fmpy.validation.validate_fmu checks the rest."
                ) from error
            finally:
                os.chdir(here)
        self._finalizer.detach()
        self._finalizer = weakref.finalize(
            self, _closed, self._model, self.name, self._folder, os.getpid()
        )
        self._allocate()
        try:
            self._run()
        except EvaluationError as error:
            raise ModelError(f"{path.name}: {error}.") from error

    def _allocate(self) -> None:
        wiring, prefix = self.wiring, f"fmi{self.wiring.fmi}"
        n, m, p = len(wiring.states), len(wiring.inputs), len(wiring.outputs)
        self._x, self._u, self._rate, self._y = map(np.zeros, (n, m, n, p))
        self._seed, self._slope = np.ones(1), np.zeros(n + p)
        self._at = b""

        def of(name: str) -> Any:
            return getattr(self._model, prefix + name)

        inputs, outputs = _references(wiring.inputs), _references(wiring.outputs)
        get, put, rates = (of(name) for name in (
            ("GetReal", "SetReal", "GetDerivatives") if wiring.fmi == 2
            else ("GetFloat64", "SetFloat64", "GetContinuousStateDerivatives")
        ))
        def extra(size: int) -> tuple[int, ...]:  # FMI 3 wants the number of values, too
            return () if wiring.fmi == 2 else (size,)

        pointers = {
            name: getattr(self, name).ctypes.data_as(POINTER(c_double))
            for name in ("_x", "_u", "_rate", "_y", "_seed", "_slope")
        }
        self._calls = {
            "x": (of("SetContinuousStates"), (pointers["_x"], n)),
            "u": (put, (inputs, m, pointers["_u"], *extra(m))),
            "rate": (rates, (pointers["_rate"], n)),
            "y": (get, (outputs, p, pointers["_y"], *extra(p))),
        }
        self._states = [_references((one,)) for one in wiring.states]
        self._directional, self._extra = of("GetDirectionalDerivative"), extra
        self._pointers = pointers

    def _run(self) -> None:
        """Instantiate, initialise, and enter the continuous-time mode."""
        model, wiring = self._model, self.wiring
        fmi3 = wiring.fmi == 3
        try:
            model.instantiate(**(
                {"logMessage": _logger3(self.name)} if fmi3 else {"callbacks": _callbacks2()}
            ))
        except Exception as error:
            raise EvaluationError(f"it cannot be instantiated ({error}){self._said()}") from error
        self._is_running, self._at = True, b""
        self._checked("its initialisation", self._initialised, model, wiring, fmi3)
        self._checked(
            "its initial states", model.getContinuousStates, self._pointers["_x"], self._x.size
        )
        self.initial_state = self._x.copy()
        self._checked(
            "the states' nominal values", model.getNominalsOfContinuousStates,
            self._pointers["_x"], self._x.size,
        )
        self.nominal = np.where(np.isfinite(self._x) & (self._x != 0.0), np.abs(self._x), 1.0)

    def _initialised(self, model: Any, wiring: Wiring, fmi3: bool) -> None:
        for kind, reference, value in wiring.values:
            getattr(model, f"set{kind}")([reference], [value])
        if fmi3:
            model.enterInitializationMode(startTime=wiring.start)
        else:
            model.setupExperiment(startTime=wiring.start)
            model.enterInitializationMode()
        model.exitInitializationMode()
        for _ in range(_MOST_ITERATIONS):
            more, ends, *_, has_next, when = (
                model.updateDiscreteStates() if fmi3 else model.newDiscreteStates()
            )
            if ends:
                raise EvaluationError("it ends the simulation at its start")
            if has_next:
                raise EvaluationError(
                    f"it announces an event at time {when:g}, but a System has no events: export "
                    "the model without sampled and scheduled parts, and make them inputs"
                )
            if not more:
                break
        else:
            raise EvaluationError(f"its events do not end within {_MOST_ITERATIONS} iterations")
        model.enterContinuousTimeMode()

    def _checked(self, task: str, function: Any, *arguments: Any) -> None:
        """Call a function of the FMU; what fails is stopped, and starts again when needed."""
        try:
            function(*arguments)
        except EvaluationError:
            self._stop()
            raise
        except Exception as error:
            status, said = getattr(error, "status", _DISCARD), self._said()
            if status != _DISCARD:
                self._stop(status == _FATAL)
            if status == _FATAL:
                self._lost = f"it reported a fatal error in {task}{said}"
            raise EvaluationError(f"the FMU fails in {task} ({error}){said}") from error

    def _stop(self, is_fatal: bool = False) -> None:
        if not is_fatal and self._is_running:
            with suppress(Exception):
                getattr(self._model, f"fmi{self.wiring.fmi}FreeInstance")(self._model.component)
        self._is_running, self._model.component = False, None

    def _said(self) -> str:
        said = _SAID[self.name]
        text = "; it says: " + " / ".join(said) if said else ""
        said.clear()
        return text

    def _set(self, x: Array, u: Array) -> None:
        if self._lost:
            raise EvaluationError(f"{self._lost}; make the system again in a new process")
        if not self._is_running:
            self._run()
        key = x.tobytes() + u.tobytes()
        if key != self._at:
            self._at = b""
            self._x[:], self._u[:] = x, u
            self._call("x", "setting the states")
            if self._u.size:
                self._call("u", "setting the inputs")
            self._at = key

    def _call(self, name: str, task: str) -> None:
        function, arguments = self._calls[name]
        self._checked(task, function, self._model.component, *arguments)

    def rate(self, x: Array, u: Array) -> Array:
        """The states' derivatives (n,) at a state (n,) and an input (m,)."""
        with self._lock:
            self._set(x, u)
            self._call("rate", "the derivatives")
            return self._rate.copy()

    def outputs(self, x: Array, u: Array) -> Array:
        """The outputs (p,), likewise."""
        with self._lock:
            self._set(x, u)
            self._call("y", "the outputs")
            return self._y.copy()

    def slope(self, unknowns: Sequence[int], x: Array, u: Array) -> Array:
        """Derivatives of variables (k,) with respect to the states: an array (k, n)."""
        size = len(unknowns)
        found = np.empty((size, len(self._states)))
        if not size:
            return found
        with self._lock:
            self._set(x, u)
            references, seed, slope = _references(unknowns), self._pointers["_seed"], self._slope
            known = (1, seed, *self._extra(1), self._pointers["_slope"], *self._extra(size))
            for j, state in enumerate(self._states):
                self._checked(
                    "the directional derivatives", self._directional, self._model.component,
                    references, size, state, *known,
                )
                found[:, j] = slope[:size]
        return found

    def at_times(self, times: Array, x: Array, u: Array) -> Mapping[float, Array]:
        """Rates and outputs (n + p,) at a state and input, at other times than the start's."""
        found = {}
        with self._lock:
            try:
                for time in times.tolist():
                    self._set(x, u)
                    self._checked("setting the time", self._model.setTime, time)
                    found[time] = np.concatenate((self.rate(x, u), self.outputs(x, u)))
            finally:
                if self._is_running:
                    self._model.setTime(self.wiring.start)
        return found


def _references(given: Sequence[int]) -> Any:
    return (c_uint * len(given))(*given)


def _closed(model: Any, name: str, folder: str, process: int) -> None:
    """Free an instance, in the process that made it."""
    if os.getpid() != process:
        return
    with suppress(Exception):
        if model is not None and model.component is not None:
            model.terminate()
            model.freeInstance()
    _SAID.pop(name, None)
    shutil.rmtree(folder, ignore_errors=True)


def _note(name: bytes | None, message: bytes | None) -> None:
    said = _SAID.get((name or b"").decode(errors="replace"))
    if said is not None and message:
        said.append(message.decode(errors="replace").strip())


def _logger3(name: str) -> Any:
    return lambda *given: _note(name.encode(), given[-1])


def _logged2(_: Any, name: bytes, *given: Any) -> None:
    _note(name, given[-1])


_CALLBACKS: list[Any] = []


def _callbacks2() -> Any:
    """The callbacks of FMI 2, made once and kept: libraries hold pointers to them.

    Without FMPy's proxy, which would complete the messages, but has one logger in a process.
    """
    if not _CALLBACKS:
        fmi2 = need("fmpy.fmi2", "from_fmu", "fmu")
        own = fmi2.fmi2CallbackFunctions()
        own.logger = fmi2.fmi2CallbackLoggerTYPE(_logged2)
        own.allocateMemory = fmi2.defaultCallbacks.allocateMemory
        own.freeMemory = fmi2.defaultCallbacks.freeMemory
        _CALLBACKS.append(own)
    return _CALLBACKS[0]
