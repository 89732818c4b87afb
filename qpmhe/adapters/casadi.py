"""Systems from CasADi models, evaluated by compiled code or by CasADi's virtual machine."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from ..codegen.comparison import Batch, Interpreter, model_fault, points
from ..codegen.compiler import WrongCodeError, compiled_library, find_compiler
from ..codegen.fingerprint import source_key
from ..codegen.model_source import model_files
from ..errors import CompilationError, EngineWarning, OptionError
from ..model.accuracy import TRIED, Choice, choice
from ..model.augmentation import Augmentation
from ..model.discretize import AUTO, Discretization
from ..model.evaluation import (
    NAMES,
    RESIDUALS,
    VALUES,
    Buffers,
    Evaluator,
    machine,
    results_of,
)
from ..model.expressions import CasadiModel, casadi_model, import_casadi, integrated
from ..model.functions import Trusted
from ..model.model import Origin
from ..model.ode import check_length, checked_method
from ..model.sets import ConvexSet
from ..model.system import System
from ..model.system_arguments import SystemOptions, checked_scales, checked_set, timed_options

Array = NDArray[np.float64]


def from_casadi(
    f: Any,
    h: Any,
    *,
    dt: float | None = None,
    method: str = "rk4",
    steps: int = 1,
    tolerance: float | None = None,
    n: int | None = None,
    p: int | None = None,
    m: int | None = None,
    compiled: bool | None = None,
    **options: Unpack[SystemOptions],
) -> System:
    """Make a system from CasADi functions, with exact Jacobians.

    The functions are compiled once, cached on disk, and called on a whole window at once;
    without a C compiler CasADi's virtual machine evaluates them. ``engine="compiled"`` and
    `qpmhe.codegen` need such a system.

    Parameters
    ----------
    f, h : casadi.Function or callable
        (x) or (x, u) to a column: functions of CasADi, or Python functions that take
        symbolic columns and return one column or a list of entries.
    dt : float, optional
        Sampling time. If given, f is the right-hand side of an ODE, in units of x per unit of time,
        discretised with u held over the step.
    method : {"rk4", "euler", "radau", "midpoint", "auto"}
        How the ODE is discretised, see `qpmhe.System.from_ode`.
    steps : int
        Number of substeps in each sample; left out with ``"auto"``.
    tolerance : float, optional
        With ``"auto"``, as for `qpmhe.System.from_ode`.
    n, p, m : int, optional
        Numbers of states, outputs and inputs; n (and m, if there are inputs) are required if f is
        not a casadi.Function.
    compiled : bool, optional
        Whether to compile the functions. The default compiles them if there is a C compiler.
    **options
        Sets and scales, as for `qpmhe.System`.

    Returns
    -------
    System
        It always pickles. With dt, it takes steps of other lengths.

    Raises
    ------
    ModelError, SetError, OptionError
        If a function, size, set or option is invalid; the message names it. Also if ``"auto"``
        finds no step that is accurate enough.
    InvalidInputError
        If n is missing.
    CompilationError
        If ``compiled`` is True and compilation fails.
    """
    if not (compiled is None or isinstance(compiled, bool)):
        raise OptionError(f"compiled is {compiled!r}; expected True, False or None.")
    how, allowed = checked_method(method, steps, tolerance)
    check_length(how, dt)
    model = casadi_model(f, h, n=n, p=p, m=m, dt=dt, how=how)
    chosen: Choice | None = None
    if how.method == AUTO and model.dt is not None:
        chosen = _chosen(model, model.dt, options, allowed)
        how = chosen.how
        model = replace(model, how=how)
    library: ctypes.PyDLL | None = None
    if compiled or (compiled is None and find_compiler() is not None):
        library = _library(
            model, checked_set("states", options.get("states"), model.n), compiled is True
        )

    def augmented(change: Augmentation, others: SystemOptions) -> System:
        join = import_casadi().vertcat
        return from_casadi(
            change.of_one_state(model.f, join, 1.0 if dt is None else 0.0),
            change.of_one_state(model.h, join),
            n=change.n, p=model.p, m=change.m, dt=dt, method=how.method, steps=how.steps,
            compiled=compiled, **others,
        )

    recipe = {
        "f": model.f, "h": model.h, "dt": dt, "method": how.method, "steps": how.steps,
        "compiled": compiled, **options,
    }

    remedy = (
        "It is CasADi's: look within {name} for a custom derivative, or for a rootfinder that "
        "hides its failure: newton and fast_newton return the guess where the residual is NaN."
    )

    def made(timed: bool) -> System:
        maker = (
            machine(model, timed) if library is None
            else partial(_compiled, model, library, timed)
        )
        evaluator = Evaluator(maker)
        one = {name: Trusted(partial(evaluator.one, name)) for name in NAMES}
        origin = Origin(
            kernel=evaluator, jacobians="casadi", integrated=integrated(model), symbolic=model,
            is_timed=timed, remedy=remedy,
        )
        if not timed:
            origin = replace(
                origin, dt=model.dt, how=model.how, choice=chosen, make_augmented=augmented,
                make_timed=None if model.dt is None else lambda _: made(True),
                recipe=(from_casadi, recipe),
            )
        return System.made(
            one["f"], one["h"], origin, n=model.n, p=model.p, m=model.m + timed,
            f_jacobian=one["f_jacobian"], h_jacobian=one["h_jacobian"],
            **(timed_options(options) if timed else options),
        )

    return made(False)


def _chosen(model: CasadiModel, dt: float, options: SystemOptions, tolerance: float) -> Choice:
    """The discretisation of a rate that ``method="auto"`` takes."""
    def stepper(how: Discretization) -> Callable[[Array, Array, Array], Array]:
        tried = Evaluator(machine(replace(model, how=how), True)).one
        return lambda dt, x, u: tried("f", x, np.column_stack((u, dt)))

    scales = options.get("scales")
    return choice(
        stepper, tuple(TRIED), dt, model.n, model.m,
        checked_set("states", options.get("states"), model.n),
        None if scales is None else checked_scales(scales, model.n), tolerance,
    )


def _library(
    model: CasadiModel, states: ConvexSet | None, required: bool
) -> ctypes.PyDLL | None:
    """The model's machine code; None where CasADi is to evaluate it."""
    made: list[tuple[Interpreter, list[Batch]]] = []

    @np.errstate(all="ignore")
    def fault(library: ctypes.CDLL) -> str:
        if not made:
            interpreter = Interpreter(model)
            made.append((interpreter, list(points(interpreter, states, 0))))
        quick, (interpreter, batches) = ctypes.PyDLL(library._name), made[0]
        return model_fault(interpreter, partial(_compiled, model, quick), batches)

    try:
        library = compiled_library(
            partial(model_files, model), "model.c", source_key(model), fault
        )
    except CompilationError as error:
        if required:
            raise
        if isinstance(error, WrongCodeError):
            warnings.warn(
                f"the model is evaluated by CasADi's virtual machine: {error}", EngineWarning,
                stacklevel=4,
            )
        return None
    # A handle that keeps the interpreter's lock: the calls are shorter than handing it over.
    return ctypes.PyDLL(library._name)


def _compiled(
    model: CasadiModel, library: ctypes.PyDLL, timed: bool, count: int, names: tuple[str, ...]
) -> Buffers:
    """Evaluation by the loops of model_api.c."""
    along = names == RESIDUALS
    states, inputs = np.zeros((count + along, model.n)), np.zeros((count, model.m + timed))
    results = results_of(model, count, names)
    # C takes inputs and steps as arrays of their own.
    us = np.zeros((count, model.m)) if timed else inputs
    steps = np.zeros(count) if timed else None
    slopes = any(name.endswith("jacobian") for name in names)
    order: tuple[str, ...]
    if along:
        function, order = library.mhe_residuals, ("y", *RESIDUALS)
    elif slopes:
        function, order = library.mhe_jacobians, NAMES
    else:
        function, order = library.mhe_values, VALUES
    function.restype = None
    targets = [results.get(name) for name in order]
    run = partial(
        function, ctypes.c_int64(count), _pointer(states), _pointer(us), _pointer(steps),
        ctypes.c_double(model.dt or 0.0), *(_pointer(target) for target in targets),
    )
    if steps is None:
        # With the arrays, of which `run` has only the addresses.
        return states, inputs, {**results, "_inputs": us}, run

    def run_timed() -> None:
        us[...] = inputs[:, : model.m]
        steps[...] = inputs[:, model.m]
        run()

    return states, inputs, results, run_timed


def _pointer(array: Array | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)
