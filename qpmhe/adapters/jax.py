"""Systems from functions of one state in jax.numpy, compiled, with exact Jacobians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from .._checks import dimension, need, positive
from ..model.augmentation import Augmentation
from ..model.discretize import EXPLICIT, Discretization
from ..model.functions import Trusted, takes_input
from ..model.model import Origin
from ..model.ode import check_length, checked_method, made_from_ode
from ..model.points import FEW, points
from ..model.system import System
from ..model.system_arguments import SystemOptions, checked_set, timed_options
from .jax_programs import Programs

Array = NDArray[np.float64]
Function = Callable[..., Any]

# Batches are filled up to a power of two, this one at least: few programs serve all lengths.
_SMALLEST_BATCH = 16
_DOUBLE = 8  # bytes
# Steps that JAX computes.
_STEPS = tuple(Discretization(method) for method in EXPLICIT)
_NOTHING: Array = np.empty(0)


def from_jax(
    f: Function,
    h: Function,
    *,
    n: int,
    p: int,
    m: int = 0,
    dt: float | None = None,
    method: str = "rk4",
    steps: int = 1,
    tolerance: float | None = None,
    **options: Unpack[SystemOptions],
) -> System:
    r"""Make a system from functions of one state in ``jax.numpy``, with exact Jacobians.

    .. math::
        x(t+1) = f(x(t), u(t)) + w(t), \qquad y(t) = h(x(t), u(t)) + v(t),

    or, with a step dt, :math:`\dot x = f(x, u)` discretised, u held over the step.

    Parameters
    ----------
    f : callable
        f(x) or f(x, u) of one state: maps x (n,) and u (m,) to (n,), an array or a list of
        components. With dt, f is the rate, in units of x per unit of time.
    h : callable
        h(x) or h(x, u), likewise, to (p,), or to a scalar if p is 1.
    n, p : int
        Number of states and of outputs, at least 1.
    m : int
        Number of known inputs; 0 for none.
    dt : float, optional
        Sampling time, in the time unit of the rate; left out, f is the discrete-time map.
    method : {"rk4", "euler", "radau", "midpoint", "auto"}
        With dt: how the ODE is discretised, see `qpmhe.System.from_ode`.
    steps : int
        With dt: number of substeps in each sample; left out with ``"auto"``.
    tolerance : float, optional
        With ``"auto"``, as for `qpmhe.System.from_ode`.
    **options
        Sets and scales, as for `qpmhe.System`.

    Returns
    -------
    System
        With values and exact Jacobians by JAX. It pickles if f and h do, and is compiled again
        where it is loaded. With dt, it takes steps of other lengths.

    Raises
    ------
    InvalidInputError
        If JAX is not installed, or has no CPU device.
    ModelError
        If JAX cannot trace a function, or the function returns the wrong shape or less than double
        precision, or indexes out of range at one of a few points in the set X.
    OptionError
        If a size or dt is out of range, the method unknown, or given without dt where it needs one.
    SetError
        If a set has the wrong dimension.

    Notes
    -----
    Everything is compiled for the CPU in double precision, regardless of JAX's defaults: double
    precision is enabled in the calling thread during each call, and the process's configuration
    stays unchanged. Single-precision constants stay rounded: create the constants of f and h with
    NumPy, not as ``jax.numpy`` arrays.

    A call into a compiled program costs several microseconds, however little it computes. So one
    call computes f and h, or both Jacobians, or all of them for a stage that enters the window, and
    the last results are cached. Returned arrays are read-only views.

    Programs for batches are compiled when a batch of their size, 16 times a power of two, first
    occurs; copies of the last state pad the batch. Each takes some tenths of a second. An estimator
    compiles the programs for its windows when it is made.

    JAX runs programs of a thousand or more floating-point operations in another thread, which can
    cost more than the computation; a loop counts as one iteration. So the states of a batch and the
    stages of RK4 are evaluated one by one if that stays below this limit. For larger models,
    ``jax.config.update("jax_cpu_enable_async_dispatch", False)``, before JAX computes anything in a
    process, avoids the thread switch.

    JAX computes a single explicit step. Implicit steps, and several substeps, take the rate and its
    Jacobian from JAX, and are computed in NumPy or, where the functions are known as expressions,
    in CasADi or C.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> import qpmhe
    >>> def rate(x, u):
    ...     return jnp.array([x[1], u[0] - jnp.sin(x[0])])
    >>> system = qpmhe.from_jax(rate, lambda x: x[0], n=2, p=1, m=1, dt=0.1)
    >>> system.derivatives
    {'f': 'jax', 'h': 'jax'}
    """
    n, p, m = dimension("n", n, 1), dimension("p", p, 1), dimension("m", m, 0)
    length = None if dt is None else positive("dt", dt)
    how, allowed = checked_method(method, steps, tolerance)
    check_length(how, length)
    probes = points(FEW, n, m, checked_set("states", options.get("states"), n))
    arguments = {"f": f, "h": h, "n": n, "p": p, "m": m, "dt": dt}
    if length is not None and how not in _STEPS:
        programs = Programs(f, h, n, p, m, _STEPS[0].method, False, probes)
        rate, output, slope, slope_of_h = _Model(programs, None).parts
        made = made_from_ode(
            System, rate, output, dt=length, n=n, p=p, m=m, how=how, rate_jacobian=slope,
            h_jacobian=slope_of_h, options=options, tolerance=allowed, jacobians="jax",
            sources={name: programs.as_numpy(name) for name in ("f", "h")},
        )
        taken = {"method": made.method, "steps": made.steps}
        return made.with_origin(
            make_augmented=partial(_augmented, f, h, p, m, dt, taken),
            recipe=(from_jax, arguments | taken | options),
        )
    programs = Programs(f, h, n, p, m, method, length is not None, probes)

    def timed(_: System) -> System:
        own = Origin(is_timed=True)
        return _assembled(_Model(programs, None), m + 1, own, timed_options(options))

    origin = Origin(
        dt=length, how=None if length is None else how,
        sources={name: programs.as_numpy(name) for name in ("f", "h")},
        make_timed=None if length is None else timed,
        make_augmented=partial(_augmented, f, h, p, m, dt, {"method": method}),
        recipe=(from_jax, {**arguments, "method": method, **options}),
    )
    return _assembled(_Model(programs, length), m, origin, options)


def _assembled(model: _Model, m: int, origin: Origin, options: SystemOptions) -> System:
    f, h, f_jacobian, h_jacobian = model.parts
    remedy = "It is JAX's: look for stop_gradient or a custom derivative within {name}."
    return System.made(
        f, h, replace(origin, kernel=model, jacobians="jax", remedy=remedy), n=model.n, p=model.p,
        m=m, f_jacobian=f_jacobian, h_jacobian=h_jacobian, **options,
    )


def _augmented(
    f: Function, h: Function, p: int, m: int, dt: float | None, how: dict[str, Any],
    change: Augmentation, options: SystemOptions,
) -> System:
    jnp: Any = need("jax.numpy", "from_jax", "jax")

    def join(*parts: Any) -> Any:
        return jnp.hstack(parts)

    def of_both(name: str, function: Function) -> Function:
        both = takes_input(name, function, m)
        return lambda x, v: jnp.asarray(function(x, v) if both else function(x))

    return from_jax(
        change.of_one_state(of_both("f", f), join, 1.0 if dt is None else 0.0),
        change.of_one_state(of_both("h", h), join),
        n=change.n, p=p, m=change.m, dt=dt, **how, **options,
    )


class _Model:
    """f, h, A and C of NumPy arrays, the parts 0 to 3."""

    def __init__(self, programs: Programs, length: float | None) -> None:
        self.n, self.p = programs.n, programs.p
        self._programs = programs
        self._length = b"" if length is None else np.float64(length).tobytes()
        self._splits = programs.timed and length is None
        # Of each kind the last argument with its result, in one object: threads may share it.
        self._last: list[tuple[bytes, list[Array]]] = [(b"", [])] * 4
        #: f, h, A and C as functions of a system.
        self.parts = tuple(Trusted(partial(self.evaluate, part)) for part in range(4))

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

    def prepare(self, horizon: int) -> None:
        """Compile the programs for all batches of windows up to this length."""
        for kind in (0, 1):
            room = _SMALLEST_BATCH
            self._programs.of_batch(kind, room)
            while room < horizon:
                room *= 2
                self._programs.of_batch(kind, room)

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


