"""A system that is the discretisation of a differential-algebraic equation with a fixed step."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import dimension, numbers, positive, vector
from ..errors import InvalidInputError, ModelError, QpmheError, ShapeError
from .accuracy import TOLERANCE, TRIED, Choice, choice
from .algebraic import AlgebraicStates, of_rows
from .algebraic_set import AlgebraicSet
from .constraint import checked_constraints
from .derivatives import Jacobian
from .discretize import AUTO, Discretization, of_any_shape
from .functions import BatchedFunction, Trusted, check_default
from .implicit_steps import COLLOCATIONS, ImplicitStep
from .index import check_index, unsolved
from .model import Origin
from .ode import timed_by_input, without_last
from .points import FEW, Magnitude, Points, points
from .sets import ConvexSet, SoftSet, behind_free
from .system_arguments import SystemOptions, checked_scales, checked_set, timed_options

if TYPE_CHECKING:
    from .augmentation import Augmentation
    from .system import System

Array = NDArray[np.float64]
Function = Callable[..., Any]
_NOTHING: Array = np.zeros(0)


class Equations(NamedTuple):
    """The functions of a DAE, of w = (x, z) and u.

    Attributes
    ----------
    joint, output : BatchedFunction
        The rate with the algebraic residuals below it, and h.
    slope : callable
        The derivative of ``joint`` by w, over (K, n + k) and (K, m).
    guess : (k,) array
        Where the algebraic states are looked for.
    """

    joint: BatchedFunction
    output: BatchedFunction
    slope: Function
    guess: Array

    @property
    def solver(self) -> AlgebraicStates:
        """What solves the algebraic equations."""
        return AlgebraicStates(self.joint.batch, self.slope, self.guess)

    def points(
        self, magnitudes: Sequence[Magnitude], m: int, states: ConvexSet | None,
        scales: Array | float = 1.0,
    ) -> Points:
        """Points w and u at which the functions are tried: see `qpmhe.model.points`."""
        return inner_points(magnitudes, self.joint.shape[0], m, states, self.guess, scales)

    def at_guess(self, where: Points) -> Points:
        """States and inputs with the guess in the place of z."""
        return [(np.concatenate((x, self.guess)), u) for x, u in where]

    def algebraic_states(self, x: ArrayLike, u: ArrayLike | None, n: int, m: int) -> Array:
        """See `qpmhe.System.algebraic_states`."""
        states = numbers("x", x)
        if u is None and m:
            raise InvalidInputError(f"u is missing: the system has {m} inputs.")
        inputs = np.empty((*states.shape[:-1], 0)) if u is None else numbers("u", u)
        for name, one, size in (("x", states, n), ("u", inputs, m)):
            if one.shape[-1:] != (size,):
                raise ShapeError(f"{name} has shape {one.shape}; expected (..., {size}).")
        lead = np.broadcast_shapes(states.shape[:-1], inputs.shape[:-1])
        count = math.prod(lead)
        flat = (
            np.broadcast_to(one, (*lead, size)).reshape(count, size)
            for one, size in ((states, n), (inputs, m))
        )
        found: Array = self.solver.complete(*flat)[:, n:]
        return found.reshape(*lead, self.guess.size)

    def check(self, x: Array, u: Array) -> None:
        """Raise a `ModelError` where no z solves the equations at a state (n,) and input (m,)."""
        try:
            w, found = self.solver.iterated(x[None], u[None])
        except QpmheError:
            raise
        except Exception as error:
            raise ModelError(
                f"the equations raised {type(error).__name__}: {error} at the initial state "
                f"{x.tolist()}; they must be defined there."
            ) from error
        if not found.all():
            raise ModelError(unsolved(self.joint, self.slope, self.guess, x, w[0], u))


def made_from_dae(
    cls: type[System], rate: Function | Trusted, algebraic: Function | Trusted,
    h: Function | Trusted, *, dt: float, n: int, k: int, p: int, m: int, how: Discretization,
    guess: ArrayLike, options: SystemOptions,
    algebraic_set: ConvexSet | SoftSet | None = None, tolerance: float = TOLERANCE,
) -> System:
    """The system that `System.from_dae` describes."""
    n, k, m = dimension("n", n, 1), dimension("k", k, 1), dimension("m", m, 0)
    p, length = dimension("p", p, 1), positive("dt", dt)
    start = np.array(vector("algebraic_guess", guess, k))
    states = checked_set("states", options.get("states"), n)
    probes = inner_points(FEW, n + k, m, states, start)
    given = {"rate": (rate, n), "algebraic": (algebraic, k), "h": (h, p)}
    functions = {
        name: BatchedFunction(name, _of_joint_state(name, one, n, m), (size,), m, probes)
        for name, (one, size) in given.items()
    }
    if m and not any(one.takes_input for one in functions.values()):
        raise ModelError(
            f"m is {m}, but neither rate nor algebraic nor h takes an input; write "
            "rate(x, z, u), algebraic(x, z, u) or h(x, z, u), or leave m out."
        )
    joint = BatchedFunction(
        "rate", _stacked(functions["rate"], functions["algebraic"]), (n + k,), m, []
    )
    differences = Jacobian(joint, None, m, probes)
    sizes = options.get("scales")
    scales = None if sizes is None else checked_scales(sizes, n)
    differences.use_scales(np.concatenate((
        np.ones(n) if scales is None else scales,
        np.where(start == 0.0, 1.0, np.abs(start)),
    )), None, ())
    equations = Equations(joint, functions["h"], differences.batch, start)
    check_index(differences.batch, n, start, probes)
    solver, slope_of_h = equations.solver, Jacobian(functions["h"], None, m, probes)

    def implicit(how: Discretization) -> ImplicitStep:
        return ImplicitStep(joint.batch, differences.batch, how.method, how.steps, solver)

    def stepper(how: Discretization) -> Callable[[Array, Array, Array], Array]:
        tried = implicit(how)
        return lambda dt, x, u: tried.value(solver.complete(x, u), u, dt)

    chosen: Choice | None = None
    if how.method == AUTO:
        tries = tuple(one for one in TRIED if one in COLLOCATIONS)
        chosen = choice(stepper, tries, length, n, m, states, scales, tolerance)
        how = chosen.how
    step, slope = of_any_shape(implicit(how), solver.complete)

    def output(x: Array, u: Array = _NOTHING) -> Array:
        return of_rows(lambda w, u: functions["h"].batch(w, u), solver, x, u, (p,))

    def output_slope(x: Array, u: Array = _NOTHING) -> Array:
        def chained(w: Array, u: Array) -> Array:
            return solver.chained(slope_of_h.batch(w, u), w, u)

        return of_rows(chained, solver, x, u, (p, n))

    def timed(_: System) -> System:
        return cls.made(
            Trusted(timed_by_input(step, m)), Trusted(without_last(output, m)),
            Origin(is_timed=True, jacobians="finite differences", equations=equations),
            n=n, p=p, m=m + 1, f_jacobian=Trusted(timed_by_input(slope, m)),
            h_jacobian=Trusted(without_last(output_slope, m)), **timed_options(options),
        )

    def augmented(change: Augmentation, others: SystemOptions) -> System:
        inner = change.beside(n + k)

        def moved(function: BatchedFunction) -> Trusted:
            evaluate = inner.over_leading(function).function

            def of_joint_state(w: Array, u: Array = _NOTHING) -> Array:
                x, s, z = w[..., :n], w[..., n : change.n], w[..., change.n :]
                found: Array = evaluate(np.concatenate((x, z, s), axis=-1), u)
                if function.name != "rate":
                    return found
                return np.concatenate((found, change.memory(0.0) * s), axis=-1)

            return Trusted(of_joint_state)

        return cls.from_dae(
            *(moved(functions[name]) for name in given), dt=dt, method=how.method,
            steps=how.steps, n=change.n, k=k, p=p, m=change.m, algebraic_guess=start,
            algebraic_set=algebraic_set, **others,
        )

    checked_set("algebraic_set", algebraic_set, k, ", the number of algebraic states")
    bounded, own = None, options
    if algebraic_set is not None:
        bounded = AlgebraicSet(algebraic_set, solver, m)
        others = checked_constraints(options.get("constraints"))
        own = {**options, "constraints": [*others, bounded.constraint]}
    made = cls.made(
        Trusted(partial(step, length)), Trusted(output),
        Origin(
            dt=length, how=how, rate=joint, equations=equations, choice=chosen, stepper=stepper,
            jacobians="finite differences", make_timed=timed, make_augmented=augmented,
            recipe=(cls.from_dae, {
                "rate": rate, "algebraic": algebraic, "h": h, "dt": dt, "n": n, "k": k, "p": p,
                "m": m, "method": how.method, "steps": how.steps, "algebraic_guess": start,
                "algebraic_set": algebraic_set, **options,
            }),
        ),
        n=n, p=p, m=m, f_jacobian=Trusted(partial(slope, length)),
        h_jacobian=Trusted(output_slope), **own,
    )
    if bounded is not None:
        bounded.system = made
    return made


def made_from_implicit(
    cls: type[System], residual: Function, h: Function, *, dt: float, n: int, k: int, p: int,
    m: int, how: Discretization, guess: ArrayLike | None, rate_guess: ArrayLike | None,
    options: SystemOptions, algebraic_set: ConvexSet | SoftSet | None = None,
    tolerance: float = TOLERANCE,
) -> System:
    """The system that `System.from_implicit` describes: one whose rates are algebraic states."""
    n, k = dimension("n", n, 1), dimension("k", k, 0)
    rates = np.zeros(n) if rate_guess is None else vector("rate_guess", rate_guess, n)
    if k and guess is None:
        raise InvalidInputError(
            f"algebraic_guess is missing: k is {k}; expected ({k},), where z is looked for."
        )
    start = np.zeros(0) if guess is None else vector("algebraic_guess", guess, k)
    checked_set("algebraic_set", algebraic_set, k, ", the number of algebraic states")
    names = ("xdot", "x", *(("z",) if k else ()))
    # Of (x, (x', z), u), as `made_from_dae` takes them.
    of_residual = _of_parts("residual", residual, names, m, n, lambda x, v: (v[..., :n], x))
    of_output = _of_parts("h", h, names[1:], m, n, lambda x, _: (x,))
    made = made_from_dae(
        cls, lambda _, v: v[..., :n], of_residual, of_output, dt=dt, n=n, k=n + k, p=p, m=m,
        how=how, guess=np.concatenate((rates, start)), options=options,
        algebraic_set=None if algebraic_set is None else behind_free(n, algebraic_set),
        tolerance=tolerance,
    )
    return made.with_origin(recipe=(cls.from_implicit, {
        "residual": residual, "h": h, "dt": dt, "n": n, "k": k, "p": p, "m": m,
        "method": made.method, "steps": made.steps, "algebraic_guess": start if k else None,
        "rate_guess": rates, "algebraic_set": algebraic_set, **options,
    }))


def _of_parts(
    name: str, function: Function, names: tuple[str, ...], m: int, n: int, first: Function
) -> Function:
    """A user's function of some arguments, the last of them z if there is any, as one of x, v, u.

    ``first`` makes the arguments before z of x and v.
    """
    takes_input = _takes_input(name, function, m, names)
    with_algebraic = names[-1] == "z"

    def arguments(x: Array, v: Array) -> tuple[Array, ...]:
        return (*first(x, v), v[..., n:]) if with_algebraic else first(x, v)

    if takes_input:
        return lambda x, v, u: function(*arguments(x, v), u)
    return lambda x, v: function(*arguments(x, v))


def inner_points(
    magnitudes: Sequence[Magnitude], width: int, m: int, states: ConvexSet | None, guess: Array,
    scales: Array | float = 1.0,
) -> Points:
    """Points of x and u, with z at the guess first, and then around it."""
    generator, found = np.random.default_rng(20211128), []
    for i, (one, (x, u)) in enumerate(
        zip(magnitudes, points(magnitudes, width - guess.size, m, states, scales), strict=True)
    ):
        z = guess * generator.uniform(0.8, 1.2, guess.size)
        z += (guess == 0.0) * one.size * generator.uniform(one.least, 1.0, guess.size)
        found.append((np.concatenate((x, z if i else guess)), u))
    return found


def _of_joint_state(
    name: str, function: Function | Trusted, n: int, m: int
) -> Function | Trusted:
    """A user's function of x, z and perhaps u as one of w = (x, z) and perhaps u."""
    if isinstance(function, Trusted):
        return function
    if _takes_input(name, function, m):
        return lambda w, u: function(w[..., :n], w[..., n:], u)
    return lambda w: function(w[..., :n], w[..., n:])


def _takes_input(
    name: str, function: Function, m: int, names: tuple[str, ...] = ("x", "z")
) -> bool:
    """Whether a function of such arguments is one of u, too, by its parameters."""
    if not callable(function):
        raise ModelError(f"{name} is {shown(function)}; expected a function.")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # compiled functions have no signature: pass all arguments
        return m > 0
    positional = [q for q in parameters if q.kind in (q.POSITIONAL_ONLY, q.POSITIONAL_OR_KEYWORD)]
    rest, least = any(q.kind is q.VAR_POSITIONAL for q in parameters), len(names)
    required = sum(q.default is q.empty for q in positional)
    by_name = any(q.kind is q.KEYWORD_ONLY and q.default is q.empty for q in parameters)
    if by_name or required > least + (m > 0) or (len(positional) < least and not rest):
        expected = f"{name}({', '.join(names)})"
        if m:
            expected += f" or {name}({', '.join((*names, 'u'))})"
        raise ModelError(
            f"{name}{inspect.signature(function)} cannot be called as {expected}; write it so."
            + ("" if m else " Pass m if there are inputs.")
        )
    if m > 0 and len(positional) > least:
        check_default(name, positional[least])
    return m > 0 and (len(positional) > least or rest)


def _stacked(*functions: BatchedFunction) -> Trusted:
    """The values of several functions below each other, over leading dimensions."""
    def evaluate(w: Array, u: Array = _NOTHING) -> Array:
        if w.ndim == 1:
            return np.concatenate([np.asarray(one(w, u)).reshape(one.shape) for one in functions])
        return np.concatenate([one.batch(w, u) for one in functions], axis=-1)

    return Trusted(evaluate)
