"""Systems from CasADi models, evaluated by compiled code or by CasADi's virtual machine."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codegen.compiler import compiled_library, find_compiler
from ..codegen.expressions import CasadiModel, casadi_model, import_casadi
from ..codegen.source import model_files
from ..errors import CompilationError
from ..sets import ConvexSet
from ..system import System

__all__ = ["casadi_system"]

Array = NDArray[np.float64]
# Fixed buffers for states, inputs and the result, and what computes one from the others.
Buffers = tuple[Array, Array, Array, Callable[[], object]]
Maker = Callable[[int, bool], Buffers]


def casadi_system(
    f: Any,
    h: Any,
    *,
    dt: float | None = None,
    method: str = "rk4",
    n: int | None = None,
    p: int | None = None,
    m: int | None = None,
    states: ConvexSet | None = None,
    disturbances: ConvexSet | None = None,
    noises: ConvexSet | None = None,
    compiled: bool | None = None,
) -> System:
    """Make a system from CasADi functions; see `qpmhe.System.from_casadi`.

    Parameters
    ----------
    f, h, dt, method, n, p, m, states, disturbances, noises, compiled
        As there.
    """
    model = casadi_model(f, h, n=n, p=p, m=m, dt=dt, method=method)
    makers = _makers(model, compiled)
    sets = {"states": states, "disturbances": disturbances, "noises": noises}

    def made(timed: bool) -> System:
        functions = {name: _Evaluator(maker, timed) for name, maker in makers.items()}
        return System(
            functions["f"], functions["h"], n=model.n, p=model.p, m=model.m + timed,
            f_jacobian=functions["f_jacobian"], h_jacobian=functions["h_jacobian"], **sets,
        )

    system = made(False)
    system.symbolic, system.dt = model, model.dt
    if model.dt is not None:
        system._timed = lambda: made(True)
    system._recipe = (
        casadi_system,
        {
            "f": model.f, "h": model.h, "dt": dt, "method": method, "compiled": compiled, **sets,
        },
    )
    return system


class _Evaluator:
    """A function of (x, u) over (n,) or (B, n) that works on buffers kept between calls.

    Parameters
    ----------
    maker : callable
        Makes the buffers for B states; told whether u ends with the length of the step.
    timed : bool
        Whether it does.
    """

    def __init__(self, maker: Maker, timed: bool) -> None:
        self._maker, self._timed = maker, timed
        self._local = threading.local()  # two threads must not share buffers

    def __call__(self, x: Array, u: Array | None = None) -> Array:
        count = x.shape[0] if x.ndim > 1 else 0
        try:
            buffers = self._local.buffers[count]
        except (AttributeError, KeyError):
            buffers = self._fresh(count)
        states, inputs, result, evaluate = buffers
        states[...] = x
        if u is not None:
            inputs[...] = u
        evaluate()
        value: Array = result.copy()
        return value

    def _fresh(self, count: int) -> Buffers:
        states, inputs, result, evaluate = self._maker(max(count, 1), self._timed)
        if count == 0:
            states, inputs, result = states[0], inputs[0], result[0]
        kept = self._local.__dict__.setdefault("buffers", {})
        if len(kept) > 64:  # of a caller whose batches have all sorts of lengths
            kept.clear()
        kept[count] = states, inputs, result, evaluate
        buffers: Buffers = kept[count]
        return buffers


def _makers(model: CasadiModel, compiled: bool | None) -> dict[str, Maker]:
    shapes = {
        "f": (model.n,), "h": (model.p,),
        "f_jacobian": (model.n, model.n), "h_jacobian": (model.p, model.n),
    }
    if compiled is not False and (compiled or find_compiler() is not None):
        try:
            library = compiled_library(model_files(model), "model.c")
        except CompilationError:
            if compiled:
                raise
        else:
            return {name: _compiled(model, library, name, shapes[name]) for name in shapes}
    return {name: _interpreted(model, name, shapes[name]) for name in shapes}


def _buffers(
    model: CasadiModel, count: int, shape: tuple[int, ...], timed: bool
) -> tuple[Array, Array, Array]:
    return (
        np.zeros((count, model.n)), np.zeros((count, model.m + timed)),
        np.zeros((count, *shape)),
    )


def _compiled(model: CasadiModel, library: Any, name: str, shape: tuple[int, ...]) -> Maker:
    """Evaluation by the loops of model_api.c."""
    # A handle that keeps the interpreter's lock: the calls are shorter than handing it over.
    own = ctypes.PyDLL(library._name)
    function = own.mhe_jacobians if name.endswith("jacobian") else own.mhe_values
    function.restype = None

    def make(count: int, timed: bool) -> Buffers:
        states, inputs, result = _buffers(model, count, shape, timed)
        # C takes inputs and steps as arrays of their own.
        us = np.zeros((count, model.m)) if timed else inputs
        steps = np.zeros(count) if timed else None
        targets = (result, None) if name.startswith("f") else (None, result)
        arguments = (
            ctypes.c_int64(count), _pointer(states), _pointer(us), _pointer(steps),
            ctypes.c_double(model.dt or 0.0), _pointer(targets[0]), _pointer(targets[1]),
        )
        kept = (us, steps)  # only their addresses are in the arguments

        def evaluate() -> None:
            function(*arguments)

        def evaluate_timed() -> None:
            kept[0][...] = inputs[:, : model.m]
            kept[1][...] = inputs[:, model.m]  # type: ignore[index]
            function(*arguments)

        return states, inputs, result, evaluate_timed if timed else evaluate

    return make


def _pointer(array: Array | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)


def _interpreted(model: CasadiModel, name: str, shape: tuple[int, ...]) -> Maker:
    """Evaluation by CasADi's virtual machine, mapped over the states."""
    ca = import_casadi()
    which = name[0]
    kind = ca.SX if model.f.is_a("SXFunction") and model.h.is_a("SXFunction") else ca.MX
    x, inputs = kind.sym("x", model.n), kind.sym("u", model.m + 1)
    u, dt = inputs[: model.m], inputs[model.m]
    value = model.step()(x, u, dt) if which == "f" else model.h(x, u)
    if name.endswith("jacobian"):
        # Transposed: CasADi stores by columns, NumPy by rows.
        value = ca.densify(ca.jacobian(value, x).T)
    function = ca.Function(name, [x, inputs], [value])

    def make(count: int, timed: bool) -> Buffers:
        states, given, result = _buffers(model, count, shape, timed)
        all_inputs = given if timed else np.full((count, model.m + 1), model.dt or 0.0)
        mapped = function.map(count) if count > 1 else function
        buffer, run = mapped.buffer()
        buffer.set_arg(0, states.data)
        buffer.set_arg(1, all_inputs.data)
        buffer.set_res(0, result.data)
        kept = (buffer, mapped)  # the run refers to them

        def evaluate() -> None:
            if not timed and kept:
                all_inputs[:, : model.m] = given
            run()

        return states, given, result, evaluate

    return make
