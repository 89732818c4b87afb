"""A generated estimator, compiled and loaded."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost, RobustCost
from ..errors import CompilationError, OptionError
from ..estimation.conditions import USUAL, Conditions
from ..estimation.estimate import Status
from ..estimation.settings import Settings
from ..model.expressions import CasadiModel
from ..model.system import System
from ..observers import Observer
from .compiler import NotCachedError, cached_library, compiled_library, known_failure
from .directions import Directions
from .fingerprint import source_key
from .layout import TERMS, Layout
from .losses import loss_function
from .needs import Needs
from .settings_record import settings_record
from .source import MAIN, estimator_files
from .templates import template

# What NumPy allows a structure; entries of its arrays can be counted by an int then.
_MOST_BYTES = 2**31 - 1
_UNUSED = "#if defined(__GNUC__)\n#pragma GCC diagnostic ignored \"-Wunused-function\"\n#endif\n"
# Before any header: what declares the clock.
_CLOCK_HEAD = "#define _POSIX_C_SOURCE 199309L\n#include <time.h>\n"


def uncovered(system: System, observer: Observer, cost: Cost, settings: Settings) -> str:
    """Why an estimator has no C form, with the remedy; empty if it has one."""
    if system.symbolic is None:
        return (
            f"the system has no CasADi form ({system.no_symbolic}); change that, make the system "
            "with qpmhe.from_casadi, or take engine='python'."
        )
    for name in ("output_residual", "state_residual"):
        residual = getattr(system, name)
        if residual is not None and residual.periods is None and residual.expression.reason:
            return (
                f"{name}, a function, has no C form ({residual.expression.reason}); take "
                "qpmhe.angles, or engine='python'."
            )
    functions = system.constraints
    if functions is not None and functions.untraced:
        return f"{functions.untraced}; change that, or take engine='python'."
    form = observer.c_form
    if form is None:
        return (
            f"{type(observer).__name__} has no C form: of observers of your own, those have one "
            "that correct by z and v alone, without a covariance, Jacobians or a `filter`; take "
            "one of qpmhe's, such as Luenberger, ExtendedKalman or OutputInjection, or "
            "engine='python'."
        )
    if form.innovation is not None and form.innovation.c_name is None:
        return (
            f"{type(form.innovation).__name__}, the rule for innovations of "
            f"{type(observer).__name__}, has no C form; take qpmhe.Gate or qpmhe.HuberInnovation, "
            "or engine='python'."
        )
    if observer.sensors and form.innovation is None:
        return (
            f"{type(observer).__name__} counts its sensors' failures by a rule of its own, which "
            "has no C form; take engine='python'."
        )
    if observer.initial_memory() is not None:
        return (
            f"{type(observer).__name__} has a memory of its own, which the compiled step does not "
            "have; take engine='python'."
        )
    if form.correction is not None and (why := form.correction(system.n, system.p).reason):
        return (
            f"the correction of {type(observer).__name__} has no C form ({why}); change that, or "
            "take engine='python'."
        )
    if cost.observer_prior is not None and form.prior is None:
        return (
            f"the covariance of {type(observer).__name__} has no C form, and the prior's weight "
            "comes from it; take a constant weight."
        )
    if (
        system.states is not None and settings.project_observer and observer.metric is None
        and form.prior is None and observer.initial_covariance() is not None
    ):
        return (
            f"the covariance of {type(observer).__name__} has no C form, and is the metric in "
            "which it is projected onto X; take engine='python', or leave states out."
        )
    reason = _without_form(cost)
    if reason:
        return reason
    assert cost.c_form is not None
    is_robust = cost.c_form.losses[TERMS.index("disturbance")].kind != "quadratic"
    if is_robust and cost.directions(system.disturbance_matrix) is not None:
        return (
            "a loss of the disturbance has no C form where disturbances have fewer directions than "
            "the state; take Quadratic for it, or engine='python'."
        )
    size = _window_size(system, observer, cost, settings.horizon)
    if size > _MOST_BYTES:
        return (
            f"a horizon of {settings.horizon} with {system.n} states needs {size:.3g} bytes for "
            f"its window, more than the {_MOST_BYTES:.3g} of one structure; take a shorter one."
        )
    if settings.backend not in ("auto", "banded"):
        return (
            f"the compiled step solves its QPs itself, not by {settings.backend!r}; take "
            "backend='auto', or 'banded' for QPs without inequalities."
        )
    return ""


def _without_form(cost: Cost) -> str:
    """Which part of a cost has no C form, with the remedy; empty if all have one."""
    if type(cost) is RobustCost:
        for name in TERMS:
            loss = getattr(cost, f"{name}_loss")
            form = loss.c_form
            reason = "a subclass overrides its cost" if form is None else ""
            if form is not None and form.kind == "own":
                reason = loss_function(form).reason
            if reason:
                return (
                    f"{type(loss).__name__}, the loss of {name}, has no C form ({reason}); take "
                    "Quadratic, Huber, Power or Barron, or engine='python'."
                )
    if cost.c_form is None:
        return f"{type(cost).__name__} has no C form; take a QuadraticCost or a RobustCost."
    return ""


def _window_size(system: System, observer: Observer, cost: Cost, horizon: int) -> int:
    """Bytes of an estimator's memory, in double precision."""
    directions = Directions(system, observer, cost)
    one, two = (
        Layout.of(directions, count).estimator_type().itemsize for count in (1, 2)
    )
    return one + (horizon - 1) * (two - one)


def _memory(count: int, kind: np.dtype[Any], what: str) -> NDArray[Any]:
    """Zeros, or an error that says how many bytes are missing."""
    try:
        return np.zeros(count, kind)
    except (MemoryError, ValueError) as error:  # the latter of more than can be addressed
        raise OptionError(
            f"{what} needs {count * kind.itemsize:.3g} bytes, which this machine does not have; "
            "take a shorter horizon, or fewer members at once."
        ) from error


def generated(
    system: System, observer: Observer, cost: Cost, settings: Settings, name: str = "mhe",
    real: str = "double", usual: Conditions = USUAL,
) -> tuple[dict[str, str], Needs]:
    """Header and source of an estimator, by the names of their files, and what a step takes."""
    layout, record = planned(system, observer, cost, settings, real, usual=usual)
    files = estimator_files(symbolic_model(system, observer, cost), layout, record, name)
    return files, Needs.of(layout, record)


def symbolic_model(system: System, observer: Observer, cost: Cost) -> CasadiModel:
    """The model of a system that has a C form, with all that is generated from CasADi."""
    model: CasadiModel = system.symbolic
    form, own = cost.c_form, observer.c_form
    functions: dict[str, Any] = {
        name: residual.expression.function
        for name in ("output_residual", "state_residual")
        if (residual := getattr(system, name)) is not None and residual.periods is None
    }
    if form is not None and any(one.kind == "own" for one in form.losses):
        functions["losses"] = tuple(
            loss_function(one).function if one.kind == "own" else None for one in form.losses
        )
    if own is not None and own.correction is not None:
        functions["correction"] = own.correction(system.n, system.p).function
    if system.constraints is not None:
        functions["constraints"] = system.constraints.expression()
    return replace(model, **functions) if functions else model


def planned(
    system: System, observer: Observer, cost: Cost, settings: Settings, real: str = "double",
    native: bool = False, usual: Conditions = USUAL,
) -> tuple[Layout, NDArray[Any]]:
    """Layout and settings of an estimator's C code; raises if it has no C form."""
    system, cost = usual.applied(system, cost)
    reason = uncovered(system, observer, cost, settings)
    if reason:
        raise OptionError(f"no C code for this estimator: {reason}")
    assert system.symbolic is not None
    directions = Directions(system, observer, cost)
    layout = Layout.of(
        directions, settings.horizon, real, native,
        settings.time_budget is not None, settings.infeasible == "restore", settings.restart,
    )
    return layout, settings_record(
        layout, directions, system, directions.cost, settings, usual
    )


def lapack_functions() -> Any:
    """Addresses of SciPy's LAPACK and BLAS functions, in the order of ``mhe_lapack`` in C."""
    from scipy.linalg import cython_blas, cython_lapack

    python = ctypes.pythonapi
    name, pointer = python.PyCapsule_GetName, python.PyCapsule_GetPointer
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    capsules = [
        module.__pyx_capi__[function]
        for module, function in (
            (cython_lapack, "dpotrf"), (cython_blas, "dtrsm"), (cython_blas, "dsyrk"),
            (cython_blas, "dgemm"),
        )
    ]
    return (ctypes.c_void_p * len(capsules))(*(pointer(one, name(one)) for one in capsules))


def _engine_files(model: CasadiModel, layout: Layout, record: NDArray[Any]) -> dict[str, str]:
    """Source of an estimator, with a clock where it keeps a time budget."""
    made = estimator_files(model, layout, record)
    # A part may hold functions that others of its estimators call; `write` leaves them out.
    made[MAIN] = f"{_UNUSED}{made[MAIN]}"
    if layout.clock:
        made[MAIN] = f"{_CLOCK_HEAD}{made[MAIN]}\n{template('clock.c')}"
    return made


class RunLog:
    """Arrays for what `mhe_run` writes, and the structure that points to them."""

    def __init__(self, shape: tuple[int, ...], n: int, sensors: int) -> None:
        self.states, self.filtered, self.observer_states = (
            np.empty((*shape, n)) for _ in range(3)
        )
        self.costs, self.candidate_costs = np.empty(shape), np.empty(shape)
        self.flags, self.qps, self.iterations = (np.empty(shape, np.int32) for _ in range(3))
        self.rejected = np.zeros((*shape, sensors), np.uint8)

    def pointers(self, first: int) -> Any:
        """The C structure of pointers to the entries from an index on."""
        arrays = (
            self.states, self.filtered, self.costs, self.candidate_costs,
            self.flags, self.qps, self.iterations, self.observer_states, self.rejected,
        )
        addresses = [array.ctypes.data + first * array.strides[0] for array in arrays]
        return (ctypes.c_void_p * len(addresses))(*addresses)

    def watched(self, horizon: int, dropped: NDArray[np.int32]) -> tuple[int, int]:
        """As `ObserverWatch.counts`, but the largest; ``dropped`` is the count at the start."""
        flags, most = self.flags, dropped
        if (flags & Status.ROWS_DROPPED.value).any():
            for t in range(flags.shape[-1]):
                kept = (flags[..., t] & Status.ROWS_DROPPED.value) == 0
                dropped = np.where(kept, 0, dropped + 1)
                most = np.maximum(most, dropped)
        far = (flags & Status.OBSERVER_FAR.value).any()
        return horizon * int(far), int(most.max())


class EstimatorLibrary:
    """Functions and structures of one compiled estimator.

    ``settings``, the ``mhe_settings`` in use, must outlive all estimators that point to it.
    ``update``, ``undo``, ``set``, ``update_members``, ``amend``, ``reset``, ``run`` and
    ``recompute`` are the C functions of these names; `update` is ``mhe_update_undoable``, which
    `undo` reverses. ``path`` is the file. With ``settings.engine="auto"`` it must be in the cache:
    `NotCachedError` is raised if it is not. ``check`` reports what is wrong with a library that was
    not checked before; `checked_library` passes the usual one. ``patience`` is that of
    `compiled_library`.
    """

    def __init__(
        self, system: System, observer: Observer, cost: Cost, settings: Settings,
        check: Callable[[EstimatorLibrary, System, Observer, Cost, Settings], str],
        patience: float | None = None,
    ) -> None:
        self.layout, self.settings = layout, record = planned(
            system, observer, cost, settings, native=True
        )
        self.observer, self._options = observer, settings
        #: How the user's disturbances are those of C.
        self.directions = Directions(system, observer, cost)
        self.estimator_type, self.estimate_type = layout.estimator_type(), layout.estimate_type()
        self.sample_type = layout.sample_type()
        model = symbolic_model(system, observer, cost)

        @np.errstate(all="ignore")
        def fault(library: ctypes.CDLL) -> str:
            self._bind(library)
            return check(self, system, observer, cost, settings)

        key = source_key(model, layout)
        if settings.engine == "auto":
            if key is None:
                raise NotCachedError(
                    "CasADi cannot serialize the model, by which the cache would know its library."
                )
            found = cached_library(MAIN, key, fault)
            if found is None:
                failure = known_failure(MAIN, key)
                raise NotCachedError(
                    "its library is not in the cache; qpmhe.compile makes it."
                    + (f" Compiling failed: {failure}" if failure else "")
                )
        else:
            found = compiled_library(
                lambda: _engine_files(model, layout, record), MAIN, key, fault, patience
            )
        self.path = Path(found._name)
        self._bind(found)

    def varied(
        self, system: System, observer: Observer, cost: Cost, settings: Settings
    ) -> EstimatorLibrary | None:
        """The same functions with other settings; None where these need other code."""
        try:
            layout, record = planned(system, observer, cost, settings, native=True)
        except OptionError:
            return None
        if layout != self.layout:
            return None
        other = copy(self)
        other._options, other.settings = settings, record
        other.directions = Directions(system, observer, cost)
        other._set_clock(record)
        return other

    def settings_for(self, system: System, cost: Cost, usual: Conditions) -> NDArray[Any]:
        """``mhe_settings`` with the sets and weights of these, which are the usual conditions."""
        record = settings_record(self.layout, self.directions, system, cost, self._options, usual)
        self._set_clock(record)
        return record

    def _set_clock(self, record: NDArray[Any]) -> None:
        if self.layout.clock:
            record["clock"] = self._clock

    def _bind(self, library: ctypes.CDLL) -> None:
        # Single steps are shorter than handing the interpreter's lock over; runs are not.
        quick = ctypes.PyDLL(library._name)
        self.workspace_size = self._check_sizes(quick)
        if self.layout.lapack:
            quick.mhe_set_lapack(lapack_functions())
        pointer, integer = ctypes.c_void_p, ctypes.c_int64
        self.update = quick.mhe_update_undoable
        self.amend, self.reset, self.run = quick.mhe_amend, quick.mhe_reset, library.mhe_run
        self.recompute, self.undo, self.set = quick.mhe_recompute, quick.mhe_undo, quick.mhe_set
        self.update_members = library.mhe_update_members
        for function in (
            self.update, self.undo, self.set, self.reset, self.run, self.update_members,
            self.recompute,
        ):
            function.restype = None
        self.amend.argtypes = [pointer, pointer, integer, pointer, pointer]
        self.reset.argtypes = [pointer, pointer, pointer]
        self.recompute.argtypes = [pointer]
        self.undo.argtypes = [pointer, pointer]
        self.set.argtypes = [
            pointer, pointer, pointer, ctypes.c_int32, pointer, ctypes.c_int32, pointer
        ]
        if self.layout.clock:
            self._clock = ctypes.cast(library.mhe_seconds, pointer).value
        self._set_clock(self.settings)
        self.update_members.argtypes = [pointer, integer, pointer, pointer, pointer, pointer]
        self.run.argtypes = [pointer, integer, pointer, integer, pointer, pointer, pointer]

    def _check_sizes(self, library: ctypes.PyDLL) -> int:
        """Refuse structures that C and NumPy lay out differently; the workspace's size."""
        sizes = np.zeros(5, np.int64)
        library.mhe_sizes.restype = None
        library.mhe_sizes(ctypes.c_void_p(sizes.ctypes.data))
        mine = [
            self.estimator_type.itemsize, self.estimate_type.itemsize,
            self.settings.dtype.itemsize, self.sample_type.itemsize,
        ]
        found = [int(sizes[0]), *map(int, sizes[2:])]
        if mine != found:
            raise CompilationError(
                f"the compiler lays structures out in {found} bytes; expected {mine}. "
                "Take engine='python' here."
            )
        return int(sizes[1])

    def workspace(self) -> NDArray[np.uint8]:
        """Scratch for the estimators of one thread."""
        return _memory(self.workspace_size, np.dtype(np.uint8), "the compiled step's scratch")

    def estimators(
        self, states: NDArray[np.float64], settings: NDArray[Any] | None = None
    ) -> NDArray[Any]:
        """Memory of one estimator for each row of initial states, reset."""
        settings = self.settings if settings is None else settings
        memory = _memory(
            len(states), self.estimator_type, f"the memory of {len(states)} estimators"
        )
        base, size = memory.ctypes.data, self.estimator_type.itemsize
        for i, state in enumerate(np.ascontiguousarray(states)):
            self.reset(base + i * size, settings.ctypes.data, state.ctypes.data)
        return memory

    def log(self, shape: tuple[int, ...]) -> RunLog:
        """Arrays into which `run` writes so many samples."""
        return RunLog(shape, self.layout.nx, self.layout.sensors)
