"""States behind those of a model: unknown parameters, errors of inputs, noise with memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from ..errors import InvalidInputError, SetError, ShapeError
from .derivatives import Jacobian
from .functions import BatchedFunction, Trusted
from .residuals import extended
from .sets import Box, ConvexSet, SoftSet
from .system import System
from .system_arguments import SystemOptions

Array = NDArray[Any]
Index = NDArray[np.intp]
Function = Callable[..., Any]


class Augmentation:
    r"""A change of a model of state x and inputs v into one of state z = (x, s) and inputs u.

    .. math::
        v = \begin{pmatrix} u \\ c \end{pmatrix} + S s, \qquad y = h(x, v) + T s

    where each column of S picks the input, or of T the output, to which an entry of s is added.
    Every adapter applies it to functions in its own language before they are differentiated and
    compiled.

    Parameters
    ----------
    n, m : int
        Numbers of states x and of inputs u.
    constants : (l,) array
        c.
    moved : (k,) array of int
        The place in v of each entry of s.
    outputs : (q, k) array, optional
        T; none if left out.
    memory : (k,) array, optional
        With T: each entry of s times its factor is its next value, or its rate. If left out, s is
        constant.
    """

    def __init__(
        self, n: int, m: int, constants: Array, moved: Index, outputs: Array | None = None,
        memory: Array | None = None,
    ) -> None:
        self._n, self.m, self._constants, self._moved = n, m, constants, moved
        self._outputs, self._memory = outputs, memory
        #: Number of states z.
        self.n = n + (moved.size if memory is None else memory.size)

    def beside(self, n: int) -> Augmentation:
        """The same change of a model of n states."""
        return Augmentation(
            n, self.m, self._constants, self._moved, self._outputs, self._memory
        )

    def memory(self, factor: float) -> Array:
        """The factors (k,) of the entries of s; this one for each where s is constant."""
        return np.full(self.n - self._n, factor) if self._memory is None else self._memory

    def slopes(self, factor: float, **given: Jacobian | None) -> dict[str, Trusted]:
        """Jacobians by z, by name, from those by x that are exact; none where s acts on inputs."""
        if self._outputs is None:
            return {}
        n, nothing = self._n, np.zeros(0)
        nothings = np.zeros((n, self.n - n))
        below = np.hstack((np.zeros((self.n - n, n)), np.diag(self.memory(factor))))

        def extended(function: Jacobian, beside: Array | None) -> Trusted:
            def evaluate(z: Array, u: Array = nothing) -> Array:
                slope = function.batch(z[:, :n], u) if z.ndim > 1 else function(z[:n], u)
                lead, right = z.shape[:-1], nothings if beside is None else beside
                right = np.broadcast_to(right, (*lead, *right.shape))
                wide = np.concatenate((slope, right), axis=-1)
                if beside is not None:
                    return wide
                rows = np.broadcast_to(below, (*lead, *below.shape))
                return np.concatenate((wide, rows), axis=-2)

            return Trusted(evaluate)

        return {
            name: extended(one, self._outputs if name == "h_jacobian" else None)
            for name, one in given.items()
            if one is not None and one.method != "finite differences"
        }

    def inputs(self, u: Any, s: Any) -> list[Any]:
        """The entries of v, of anything that has entries and can be added."""
        entries = [*(u[j] for j in range(self.m)), *self._constants.tolist()]
        for j, place in enumerate(self._moved.tolist()):
            entries[place] = entries[place] + s[j]
        return entries

    def of_one_state(
        self, function: Function, join: Function, factor: float | None = None
    ) -> Function:
        """A function of (x, v) as one of (z, u), in a language of columns of one state.

        ``join`` makes one column of several columns and single entries. With a ``factor``, the
        function is f, and the next s, or its rate, stands behind the value: s times its memory, or
        times this factor where s is constant. Without a factor, the function is h.
        """
        n, outputs = self._n, self._outputs
        memory = self.memory(factor or 0.0).tolist()

        def evaluate(z: Any, u: Any = ()) -> Any:
            s = [z[n + j] for j in range(len(memory))]
            moved = self._moved.size + self._constants.size
            value = function(z[:n], join(*self.inputs(u, s)) if moved else u)
            if factor is not None:
                return join(value, *(one * s[j] for j, one in enumerate(memory)))
            if outputs is None:
                return value
            value = join(value)
            entries = [value[i] for i in range(len(outputs))]
            for i, j in np.argwhere(outputs).tolist():
                entries[i] = entries[i] + s[j]
            return join(*entries)

        return evaluate

    def over_leading(self, function: BatchedFunction, factor: float | None = None) -> Trusted:
        """The same of a NumPy function, over leading dimensions."""
        n, m, constants, moved = self._n, self.m, self._constants, self._moved
        size, inputs = function.shape[0], self.m + self._constants.size
        added = self._outputs.T if self._outputs is not None and function.name == "h" else None
        memory = self.memory(factor or 0.0)
        nothing: Array = np.zeros(0)

        def evaluate(z: Array, u: Array = nothing) -> Array:
            v = np.empty((*z.shape[:-1], inputs), np.result_type(z, u))
            v[..., :m], v[..., m:] = u, constants
            if moved.size:
                v[..., moved] += z[..., n:]
            x = z[..., :n]
            if z.ndim == 1:
                value = np.asarray(function(x, v)).reshape(size)
            else:
                value = function.batch(x, v)
            if added is not None:
                value = value + z[..., n:] @ added
            return value if factor is None else np.concatenate((value, memory * z[..., n:]), -1)

        return Trusted(evaluate)


# Options of a system that an augmented one has, or that `System.extensions` names.
_KNOWN = {
    "states", "disturbances", "noises", "scales", "output_residual", "state_residual",
    "disturbance_matrix", "constraints",
}


def augmented(system: System, change: Augmentation, **options: Unpack[SystemOptions]) -> System:
    """The augmented system, made by the adapter that made the system, with exact derivatives.

    A set of algebraic states is the only one of its extensions that it has, too.
    """
    unknown = [
        name for name in SystemOptions.__annotations__
        if name not in _KNOWN and getattr(system, name) is not None
    ]
    constraints, extensions = system.constraints, system.extensions
    if constraints is not None and constraints.are_algebraic:
        extensions = extensions[:-1]
    check_inherits(*extensions, *unknown)
    if system.origin.make_augmented is not None:
        found = system.origin.make_augmented(change, options)
    else:
        own = system.evaluation.functions
        given = change.slopes(1.0, f_jacobian=own.f_jacobian, h_jacobian=own.h_jacobian)
        found = System(
            change.over_leading(system.f, 1.0), change.over_leading(system.h),
            n=change.n, p=system.p, m=change.m, **given, **options,
        )
    return found.with_origin(held=system.held)


def check_inherits(*lost: str) -> None:
    """Raise an error that names what an augmented model does not have, if there is any."""
    if lost:
        raise InvalidInputError(
            f"the system has {' and '.join(lost)}, which "
            "an augmented model does not inherit; leave them out, or write the augmented model as "
            "a System with its own functions."
        )


def chosen(name: str, given: ArrayLike | None, size: int, kind: str) -> Index:
    """Indices from indices or a boolean mask; all of them for None."""
    if given is None:
        return np.arange(size)
    refused = InvalidInputError(
        f"{name} is {shown(given)}; expected indices of {kind}s or a boolean mask."
    )
    try:
        found = np.atleast_1d(np.asarray(given))
    except ValueError as error:  # rows of different lengths
        raise refused from error
    if found.dtype == np.bool_:
        if found.shape != (size,):
            raise ShapeError(
                f"{name} is a mask of shape {found.shape}; expected ({size},), one entry for each "
                f"{kind}."
            )
        return np.flatnonzero(found)
    if found.size == 0:
        return np.empty(0, np.intp)
    if found.ndim != 1 or found.dtype.kind not in "iu":
        raise refused
    outside = (found < 0) | (found >= size)
    if outside.any():
        raise InvalidInputError(
            f"{name} names {kind} {int(found[outside][0])}; expected indices from 0 to {size - 1}."
        )
    if np.unique(found).size < found.size:
        raise InvalidInputError(
            f"{name} is {found.tolist()}, which names one "
            f"{kind} twice; expected distinct indices."
        )
    return found.astype(np.intp)


def product(
    first: ConvexSet | SoftSet | None, n: int, second: ConvexSet | SoftSet | None, k: int
) -> ConvexSet | None:
    """All (x, s) with x (n,) in the first set and s (k,) in the second; None is everything."""
    first, second = _hard(first), _hard(second)
    if first is None and second is None:
        return None
    if k == 0:
        return first
    one, two = _or_everything(first, n), _or_everything(second, k)
    lower, upper = np.append(one.lower, two.lower), np.append(one.upper, two.upper)
    rows = one.matrix.shape[0] + two.matrix.shape[0]
    if rows == 0:
        return Box(lower, upper)
    matrix = np.zeros((rows, n + k))
    matrix[: one.matrix.shape[0], :n] = one.matrix
    matrix[one.matrix.shape[0] :, n:] = two.matrix
    return ConvexSet(
        lower, upper, matrix,
        np.append(one.row_lower, two.row_lower), np.append(one.row_upper, two.row_upper),
    )


def inherited(
    system: System, k: int, bounds: ConvexSet | None = None, still: ConvexSet | None = None
) -> SystemOptions:
    """The options of a system with k states behind it, all but ``scales``.

    The k states stay in the set ``bounds``, their disturbances in ``still``; None is everything.
    """
    n = system.n
    return {
        "states": product(system.states, n, bounds, k),
        "disturbances": product(system.disturbances, system.r, still, k),
        "noises": system.noises, "disturbance_matrix": _extended_matrix(system, k),
        "output_residual": system.output_residual,
        "state_residual": extended(system.state_residual, n, n + k),
    }


def _extended_matrix(system: System, k: int) -> Array | None:
    """The system's ``disturbance_matrix`` with k states behind that have a disturbance each."""
    matrix = system.disturbance_matrix
    if matrix is None:
        return None
    n, r = matrix.shape
    joint = np.zeros((n + k, r + k))
    joint[:n, :r], joint[n:, r:] = matrix, np.eye(k)
    return joint


def _hard(one: ConvexSet | SoftSet | None) -> ConvexSet | None:
    if isinstance(one, SoftSet):
        raise SetError(
            f"the set {one!r} is soft; an augmented model takes only hard sets: leave it out, or "
            "write the augmented model as a System with its own functions."
        )
    return one


def _or_everything(one: ConvexSet | None, dimension: int) -> ConvexSet:
    if one is not None:
        return one
    free = np.full(dimension, np.inf)
    return Box(-free, free)
