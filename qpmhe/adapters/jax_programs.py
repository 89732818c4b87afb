"""JAX programs compiled from a model, for one state and for many."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import need
from ..errors import InvalidInputError, ModelError
from ..model.discretize import EXPLICIT, checked_discretization, discretize
from ..model.functions import check_inputs, takes_input
from ..model.points import Points
from ..model.stand_ins import without_symbols
from .jax_expressions import numpy_function
from .jax_indices import check_indices

Array = NDArray[np.float64]
Function = Callable[..., Any]
Program = Callable[[bytes], list[Array]]

# JAX executes what has fewer than 1000 operations in the calling thread; costs are estimates.
_INLINE = 700.0
# More operations over a batch than these are sooner done in another thread.
_LONG = 16000.0
# Operations for a derivative in one direction, in those for the value, as compiled.
_DIRECTION = 6.0


class Programs:
    """The programs of a model. Arguments are all x, then all u, then all lengths of steps."""

    def __init__(
        self,
        f: Function,
        h: Function,
        n: int,
        p: int,
        m: int,
        method: str,
        timed: bool,
        probes: Points,
    ) -> None:
        self.n, self.p, self.m, self.timed = n, p, m, timed
        self._jax, self._double, self._device = _imported()
        jax, concatenate = self._jax, self._jax.numpy.concatenate
        rate, output = self._checked("f", f, n, probes), self._checked("h", h, p, probes)
        check_inputs(m, f=takes_input("f", f, m), h=takes_input("h", h, m))
        self._functions = {"f": rate, "h": output}
        step = discretize(rate, None, checked_discretization(method, 1, EXPLICIT))[0]
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
            raise ModelError(f"JAX cannot differentiate f and h: {_reason(error)}.") from error
        #: f and h at a state.
        self.value = self._compiled(
            lambda *point: [value(*(block[0] for block in point))], 1, [(n,), (p,)]
        )

    def as_numpy(self, name: str) -> Function:
        """The model's f (the rate, with a step length) or h as a function of x and u of NumPy.

        Raises what JAX or `numpy_function` raises where it is none.
        """
        made: list[Function] = []

        def evaluate(x: Array, u: Array) -> Any:
            if not made:
                arguments = [
                    self._jax.ShapeDtypeStruct((size,), np.float64) for size in (self.n, self.m)
                ]
                with self._double(True):
                    program = self._jax.make_jaxpr(self._functions[name])(*arguments)
                made.append(numpy_function(program))
            with self._double(True):
                return made[0](x, u)

        return without_symbols(evaluate)

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

    def _checked(self, name: str, function: Function, size: int, probes: Points) -> Function:
        """The user's function as one of (x, u) to (size,), tried to see that it is."""
        if not callable(function):
            raise ModelError(f"{name} is {function!r}; expected a function of the state.")
        jax, with_input = self._jax, takes_input(name, function, self.m)

        def evaluate(x: Any, u: Any) -> Any:
            value = jax.numpy.asarray(function(x, u) if with_input else function(x))
            if value.shape != (size,) and not (value.shape == () and size == 1):
                raise ModelError(
                    f"{name} returned shape {value.shape}; expected ({size},). Check n, p, m "
                    "and the order of the arguments, and that it is written for one state."
                )
            if value.dtype != np.float64 and not np.issubdtype(value.dtype, np.integer):
                raise ModelError(
                    f"{name} returned {value.dtype} where x is float64; expected "
                    "float64. Remove conversions, such as a dtype."
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
                    f"JAX cannot trace {name}: {_reason(error)}. Write it for one state with "
                    "jax.numpy, with jnp.where or lax.cond in place of if."
                ) from error
            (device,) = self._device.device_set
            with jax.default_device(device):
                check_indices(jax, name, evaluate, probes)
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
    jax: Any = need("jax", "from_jax", "jax")
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        raise InvalidInputError(
            f"JAX has no CPU device ({_reason(error)}); include cpu in JAX_PLATFORMS."
        ) from error
    # Before JAX 0.8 the switch was among the experiments.
    home = jax if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental")
    return jax, home.enable_x64, jax.sharding.SingleDeviceSharding(device)


def _reason(error: Exception) -> str:
    lines = str(error).splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}".rstrip(".")
