"""Systems from functions of one state in jax.numpy, compiled, with exact Jacobians."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import count, positive
from ..derivatives import Jacobian
from ..discretize import discretize
from ..errors import InvalidInputError, ModelError
from ..functions import BatchedFunction, Probes
from ..sets import ConvexSet
from ..system import System, probe_points

__all__ = ["jax_system"]

Array = NDArray[np.float64]
Function = Callable[..., Any]
Program = Callable[[bytes], list[Array]]

# Batches are filled up to a power of two, this one at least: few programs serve all lengths.
_SMALLEST_BATCH = 16
# JAX executes what has fewer than 1000 operations in the calling thread; costs are estimates.
_INLINE = 700.0
# More operations over a batch than these are sooner done in another thread.
_LONG = 16000.0
# Operations for a derivative in one direction, in those for the value, as compiled.
_DIRECTION = 6.0
_DOUBLE = 8  # bytes
_NOTHING: Array = np.empty(0)


def jax_system(
    f: Function,
    h: Function,
    *,
    n: int,
    p: int,
    m: int = 0,
    dt: float | None = None,
    method: str = "rk4",
    states: ConvexSet | None = None,
    disturbances: ConvexSet | None = None,
    noises: ConvexSet | None = None,
) -> System:
    r"""Make a `System` of functions that are written for one state with ``jax.numpy``.

    .. math::
        x(t+1) = f(x(t), u(t)) + w(t), \qquad y(t) = h(x(t), u(t)) + v(t),

    or, with a step dt, :math:`\dot x = f(x, u)` discretised, u held over the step.

    Parameters
    ----------
    f : callable
        f(x) or f(x, u) of one state: x of shape (n,) and u of (m,) to (n,), an array or a
        list of its components. With dt, the rate, in units of x per unit of time.
    h : callable
        h(x) or h(x, u), likewise, to (p,). A scalar will do where p is 1.
    n, p : int
        Number of states and of outputs, at least 1.
    m : int
        Number of known inputs; 0 for none.
    dt : float, optional
        Sampling time, in the time unit of the rate; left out, f is the discrete-time map.
    method : {"rk4", "euler"}
        With dt: Runge-Kutta of order 4, or one explicit Euler step.
    states, disturbances, noises : Box or Polytope, optional
        The sets X, W and V; the whole space if left out.

    Returns
    -------
    System
        With values and exact Jacobians by JAX. It pickles where f and h do, and is compiled
        anew where it is loaded. With dt, it takes steps of other lengths.

    Raises
    ------
    InvalidInputError
        If JAX is not installed, or has no CPU device.
    ModelError
        If JAX cannot trace a function, or it returns the wrong shape, or less than double
        precision.
    OptionError
        If a size or dt is out of range, or the method unknown.
    SetError
        If a set has the wrong dimension.

    Notes
    -----
    Everything is compiled for the CPU and in double precision, whatever JAX's defaults are:
    double precision is switched on in a context of the calling thread, for the time of a
    call, and the process's configuration is never touched. What was in single precision
    before stays so: constants that f and h hold as ``jax.numpy`` arrays were rounded when
    they were made, so make them with NumPy.

    A call into a compiled program costs several microseconds, however little it computes.
    So one call gives f and h, or both Jacobians, or all of them for a stage that enters the
    window, and the last results are kept for who asks for the other half of them. Arrays
    come back as read-only views.

    Programs for batches are compiled when a batch of their size first occurs, 16 and its
    doubles; the last state fills the batch up. That takes some tenths of a second, in the
    first update with more than 16, 32, ... stages. Where this is too late, call
    ``system.f.batch`` and ``system.f_jacobian.batch`` with so many states before.

    JAX hands programs of a thousand floating-point operations and more to a thread of its
    own, which can cost more than they do; a loop counts as one turn of it. So the states of
    a batch and the stages of RK4 are taken one by one where that keeps below. With larger
    models, ``jax.config.update("jax_cpu_enable_async_dispatch", False)``, before JAX
    computes anything in a process, saves the way to that thread and back.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from qpmhe.adapters.jax import jax_system
    >>> def rate(x, u):
    ...     return jnp.array([x[1], u[0] - jnp.sin(x[0])])
    >>> system = jax_system(rate, lambda x: x[0], n=2, p=1, m=1, dt=0.1)
    >>> system.derivatives
    {'f': 'jax', 'h': 'jax'}
    """
    n, p, m = count("n", n, 1), count("p", p, 1), count("m", m, 0)
    length = None if dt is None else positive("dt", dt)
    programs = _Programs(f, h, n, p, m, method, timed=length is not None)
    sets = {"states": states, "disturbances": disturbances, "noises": noises}
    system = _assembled(_Model(programs, length), m, sets)
    if length is not None:
        system.dt = length
        system._timed = partial(_assembled, _Model(programs, None), m + 1, sets)
    system._recipe = (
        jax_system,
        {"f": f, "h": h, "n": n, "p": p, "m": m, "dt": dt, "method": method, **sets},
    )
    return system


class _ExactJacobian(Jacobian):
    """A Jacobian by JAX: compared with differences when the system is made, and not again.

    Estimation often starts where a model has a kink; there it is the derivative to one side,
    and differences give the mean of both.
    """

    def __init__(
        self, function: BatchedFunction, given: Function, inputs: int, probes: Probes
    ) -> None:
        try:
            super().__init__(function, given, inputs, probes)
        except ModelError as error:
            raise ModelError(
                f"{error} Here it is JAX's: look for single precision, stop_gradient or a "
                f"derivative of its own within {function.name}."
            ) from error
        self.method = "jax"

    def check(self, x: Array, u: Array) -> None:
        """Do nothing."""


def _assembled(model: _Model, m: int, sets: dict[str, Any]) -> System:
    f, h, f_jacobian, h_jacobian = (partial(model.evaluate, part) for part in range(4))
    system = System(f, h, n=model.n, p=model.p, m=m, **sets)
    probes = probe_points(system.states, system.n, m)
    system.f_jacobian = _ExactJacobian(system.f, f_jacobian, m, probes)
    system.h_jacobian = _ExactJacobian(system.h, h_jacobian, m, probes)
    system.joint = model
    return system


class _Model:
    """f, h, A and C of NumPy arrays, the parts 0 to 3.

    Parameters
    ----------
    programs : _Programs
        What computes them.
    length : float or None
        Length of the step. None takes it from behind the inputs, if the programs want one.
    """

    def __init__(self, programs: _Programs, length: float | None) -> None:
        self.n, self.p = programs.n, programs.p
        self._programs = programs
        self._length = b"" if length is None else np.float64(length).tobytes()
        self._splits = programs.timed and length is None
        # Of each kind the last argument with its result, in one object: threads may share it.
        self._last: list[tuple[bytes, list[Array]]] = [(b"", [])] * 4

    def evaluate(self, part: int, x: Array, u: Array = _NOTHING) -> Array:
        """The part at x (n,) and u (m,), or over x (B, n) and u (B, m)."""
        x, u = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        key = x.tobytes() + u.tobytes()
        kind = (part >> 1) + 2 * (x.ndim > 1)
        last, parts = self._last[kind]
        if key != last or not key:
            if x.ndim > 1:
                parts = self._over_batch(part >> 1, x, u)
            elif part > 1:
                slopes = self._programs.stage(key + self._length)[1]
                parts = [slopes[: self.n], slopes[self.n :]]
            else:
                parts = self._programs.value(key + self._length)
            self._last[kind] = key, parts
        return parts[part & 1]

    def stage(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """The values f (n,) and h (p,) and their joint Jacobian (n + p, n) at one state."""
        values, slopes = self._programs.stage(x.tobytes() + u.tobytes() + self._length)
        return values[: self.n], values[self.n :], slopes

    def residuals(self, trajectory: Array, y: Array, u: Array) -> Array:
        """The residuals w and v (K, n + p) along a trajectory (K + 1, n)."""
        ahead, outputs = self._over_batch(0, trajectory[:-1], u)
        found = np.empty((y.shape[0], self.n + self.p))
        np.subtract(trajectory[1:], ahead, out=found[:, : self.n])
        np.subtract(y, outputs, out=found[:, self.n :])
        return found

    def _over_batch(self, slopes: int, x: Array, u: Array) -> list[Array]:
        programs, size = self._programs, x.shape[0]
        room = max(_SMALLEST_BATCH, 1 << (size - 1).bit_length())
        if self._splits:
            lengths = _filled(u[:, -1], 1, room - size)
            u = u[:, :-1]
        else:
            lengths = self._length * room
        argument = _filled(x, programs.n, room - size) + _filled(u, programs.m, room - size)
        return [part[:size] for part in programs.of_batch(slopes, room)(argument + lengths)]


def _filled(rows: Array, width: int, more: int) -> bytes:
    """Rows with the last one repeated: models surely are defined there."""
    if not width:
        return b""
    row, block = _DOUBLE * width, rows.tobytes()
    return block + (block[-row:] or bytes(row)) * more


class _Programs:
    """The programs of a model. Arguments are all x, then all u, then all lengths of steps.

    Parameters
    ----------
    f, h : callable
        The user's functions of one state; f is the rate if ``timed``.
    n, p, m : int
        Numbers of states, outputs and inputs.
    method : str
        How the rate is discretised.
    timed : bool
        Whether the length of the step is an argument.
    """

    def __init__(
        self, f: Function, h: Function, n: int, p: int, m: int, method: str, timed: bool
    ) -> None:
        self.n, self.p, self.m, self.timed = n, p, m, timed
        self._jax, self._double, self._device = _imported()
        jax, concatenate = self._jax, self._jax.numpy.concatenate
        rate, output = self._checked("f", f, n), self._checked("h", h, p)
        step = discretize(rate, None, method)[0]
        if method == "rk4":
            step = partial(_runge_kutta, jax, rate)

        def value(x: Any, u: Any, dt: Any) -> Any:
            following = step(dt[0], x, u) if timed else rate(x, u)
            return concatenate([following, output(x, u)])

        def twice(x: Any, u: Any, dt: Any) -> Any:
            found = value(x, u, dt)
            return found, found

        def stage(x: Any, u: Any, dt: Any) -> Any:
            slope, found = jax.jacfwd(twice, has_aux=True)(x, u, dt)
            return found, slope

        def stage_by_columns(x: Any, u: Any, dt: Any) -> Any:
            found, columns = jax.lax.map(
                lambda column: jax.jvp(lambda z: value(z, u, dt), (x,), (column,)), np.eye(n)
            )
            return found[0], columns.T

        self._value, self._slope = value, jax.jacfwd(value)
        self._batches: dict[tuple[int, int], Program] = {}
        try:
            cost = self._operations(value)
            self._costs = cost, 2 * n * cost
            if 2 * n * cost >= _INLINE > _DIRECTION * cost:
                stage = stage_by_columns
            #: (f, h) as one and (A, C) as one, at a state.
            self.stage = self._compiled(
                lambda *point: stage(*(block[0] for block in point)), 1, [(n + p,), (n + p, n)]
            )
        except Exception as error:  # whatever JAX has against the user's functions
            raise ModelError(f"JAX cannot differentiate f and h: {_told(error)}.") from error
        #: f and h at a state.
        self.value = self._compiled(
            lambda *point: [value(*(block[0] for block in point))], 1, [(n,), (p,)]
        )

    def of_batch(self, slopes: int, room: int) -> Program:
        """The program of f and h over so many states, or that of A and C."""
        program = self._batches.get((slopes, room))
        if program is None:
            jax, n, function = self._jax, self.n, self._slope if slopes else self._value
            cost = self._costs[slopes]
            loops = cost < _INLINE and room * cost < _LONG

            def split(*blocks: Any) -> Any:
                if loops:
                    found = jax.lax.map(lambda one: function(*one), blocks)
                else:
                    found = jax.vmap(function)(*blocks)
                return found[:, :n], found[:, n:]

            behind = (n,) if slopes else ()
            shapes = [(room, n, *behind), (room, self.p, *behind)]
            program = self._batches[slopes, room] = self._compiled(split, room, shapes)
        return program

    def _operations(self, function: Function) -> float:
        """JAX's count of a function's floating-point operations at a state, loops once."""
        sizes = self.n, self.m, int(self.timed)
        arguments = [self._jax.ShapeDtypeStruct((size,), np.float64) for size in sizes]
        with self._double(True):
            costs = self._jax.jit(function).lower(*arguments).cost_analysis()
        return float(costs["flops"]) if costs and "flops" in costs else math.inf

    def _checked(self, name: str, function: Function, size: int) -> Function:
        """The user's function as one of (x, u) to (size,), traced once to see that it is."""
        jax, call = self._jax, BatchedFunction(name, function, (size,), self.m, [])

        def evaluate(x: Any, u: Any) -> Any:
            value = jax.numpy.asarray(call(x, u))
            if value.shape != (size,) and not (value.shape == () and size == 1):
                raise ModelError(
                    f"{name} returned shape {value.shape}; expected ({size},). Check n, p, m "
                    "and the order of the arguments, and that it is written for one state."
                )
            if value.dtype != np.float64 and not np.issubdtype(value.dtype, np.integer):
                raise ModelError(
                    f"{name} returned {value.dtype} where x is float64; expected float64. "
                    "Leave out what converts, such as a dtype."
                )
            return value.astype(np.float64).reshape(size)

        with self._double(True):
            x, u = (jax.ShapeDtypeStruct((k,), np.float64) for k in (self.n, self.m))
            try:
                jax.eval_shape(evaluate, x, u)
            except ModelError:
                raise
            except Exception as error:  # whatever JAX has against the user's function
                raise ModelError(
                    f"JAX cannot trace {name}: {_told(error)}. Write it for one state with "
                    "jax.numpy, with jnp.where or lax.cond in place of if."
                ) from error
        return evaluate

    def _compiled(
        self, function: Function, room: int, shapes: list[tuple[int, ...]]
    ) -> Program:
        jnp, double = self._jax.numpy, self._double
        widths = self.n, self.m, int(self.timed)
        ends = np.cumsum([room * width for width in widths]).tolist()

        def flat(argument: Any) -> Any:
            blocks = zip(jnp.split(argument, ends[:-1]), widths, strict=True)
            found = function(*(block.reshape(room, width) for block, width in blocks))
            return jnp.concatenate([part.ravel() for part in found])

        argument = self._jax.ShapeDtypeStruct((ends[-1],), np.float64, sharding=self._device)
        with double(True):
            compiled = self._jax.jit(flat).lower(argument).compile()
        stops = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        pieces = list(zip([0, *stops[:-1]], stops, shapes, strict=True))

        def run(argument: bytes) -> list[Array]:
            with double(True):
                found = np.asarray(compiled(np.frombuffer(argument)))
            return [found[start:stop].reshape(shape) for start, stop, shape in pieces]

        return run


def _runge_kutta(jax: Any, rate: Function, dt: Any, x: Any, u: Any) -> Any:
    """One step of the classical method, as a loop over its stages."""

    def stage(sums: Any, share: Any) -> Any:
        slope, following = sums
        slope = rate(x + dt * share[0] * slope, u)
        return (slope, following + dt * share[1] * slope), None

    shares = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])
    return jax.lax.scan(stage, (jax.numpy.zeros_like(x), x), shares)[0][1]


def _imported() -> tuple[Any, Function, Any]:
    """JAX, its switch to double precision, and its CPU."""
    try:
        jax: Any = importlib.import_module("jax")
    except ImportError as error:
        raise InvalidInputError(
            "JAX compiles the functions, and is not installed; pip install 'qpmhe[jax]'."
        ) from error
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        raise InvalidInputError(
            f"JAX has no CPU device ({_told(error)}); include cpu in JAX_PLATFORMS."
        ) from error
    # Before JAX 0.8 the switch was among the experiments.
    home = jax if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental")
    return jax, home.enable_x64, jax.sharding.SingleDeviceSharding(device)


def _told(error: Exception) -> str:
    lines = str(error).splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}".rstrip(".")
