"""The arguments of a system, and how they are checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import SINGULAR, numbers, vector
from ..errors import ModelError, OptionError, SetError, ShapeError
from .constraint import Constraint
from .derivatives import Jacobian
from .functions import BatchedFunction, check_inputs
from .model import Expression, Functions
from .points import FEW, points
from .residuals import Residual
from .sets import ConvexSet, SoftSet, equilibrated

if TYPE_CHECKING:
    from .system import System

Array = NDArray[np.float64]
Function = Callable[..., Any]


class SystemOptions(TypedDict, total=False):
    """The options of `System` that every function that makes a system hands on to it."""

    states: ConvexSet | SoftSet | None
    disturbances: ConvexSet | SoftSet | None
    noises: ConvexSet | SoftSet | None
    scales: ArrayLike | None
    output_residual: Residual | Function | None
    state_residual: Residual | Function | None
    disturbance_matrix: ArrayLike | None
    constraints: Sequence[Constraint] | None


def timed_options(options: SystemOptions) -> SystemOptions:
    """The options of a timed system: its constraints are those of the usual one."""
    return {**options, "constraints": None}


def checked_set(
    name: str, value: ConvexSet | SoftSet | None, dimension: int, meaning: str = ""
) -> ConvexSet | None:
    """The set if it is a hard one, else None, after a check of its type and dimension.

    The dimension may have a meaning.
    """
    if value is None:
        return None
    if not isinstance(value, (ConvexSet, SoftSet)):
        raise SetError(
            f"{name} is {shown(value)}; expected a qpmhe.Box, a qpmhe.Polytope or None."
        )
    if value.dimension != dimension:
        raise SetError(f"{name} has dimension {value.dimension}; expected {dimension}{meaning}.")
    return value if isinstance(value, ConvexSet) else None


def checked_matrix(given: ArrayLike | None, n: int) -> Array | None:
    """G, if it has full column rank; None for the identity."""
    if given is None:
        return None
    matrix = numbers("disturbance_matrix", given)
    if matrix.ndim != 2 or matrix.shape[0] != n or not 1 <= matrix.shape[1] <= n:
        raise ShapeError(
            f"disturbance_matrix has shape {matrix.shape}; expected (n, r) = ({n}, r) with r from "
            f"1 to {n}: one column for each disturbance. Leave it out if every state has its own "
            "disturbance."
        )
    # In numbers of order one, so that no unit makes a column look small.
    rows, columns = equilibrated(matrix)
    values = np.linalg.svd(rows[:, None] * matrix * columns, compute_uv=False)
    if values[-1] <= SINGULAR * values[0]:
        raise ModelError(
            f"disturbance_matrix is {matrix.tolist()}, whose columns are linearly dependent; "
            f"expected rank {matrix.shape[1]}. Merge the disturbances that act alike."
        )
    return None if np.array_equal(matrix, np.eye(n)) else matrix


def checked_scales(given: ArrayLike, n: int) -> Array:
    """Typical magnitudes of the states, if they are above zero."""
    scales = vector("scales", given, n)
    if not (scales > 0.0).all():
        raise OptionError(
            f"scales is {scales.tolist()}; expected a number > 0 for each state, its "
            "typical magnitude in its unit. Leave scales out if they are unknown."
        )
    return scales


def check_soft_angles(soft: SoftSet | None, residual: Residual | None, n: int) -> None:
    """Check that a soft X of n states bounds none that is an angle."""
    if soft is None or residual is None:
        return
    angles = np.zeros(n, np.bool_)
    angles[residual.components] = True
    bounded = np.isin(soft.convex.bounded_components, residual.components)
    if bounded.any() or soft.convex.touched(angles).any():
        raise SetError(
            f"the soft set of states, {soft.convex!r}, bounds an angle (components "
            f"{residual.components.tolist()}), which is known only up to whole turns; leave it "
            "out, or write a qpmhe.Constraint of its sine and cosine."
        )


def tried_functions(system: System, given: Mapping[str, Any]) -> Functions:
    """The functions as they were given, tried at some points."""
    m, origin, probes = system.m, system.origin, points(FEW, system.n, system.m, system.states)
    f = BatchedFunction("f", given["f"], (system.n,), m, probes)
    h = BatchedFunction("h", given["h"], (system.p,), m, probes)
    first = ("f", f) if origin.rate is None else ("rate", origin.rate)
    check_inputs(m, **{first[0]: first[1].takes_input, "h": h.takes_input})
    a, c = (
        Jacobian(
            function, given.get(f"{function.name}_jacobian"), m, probes, system.states, residual,
            "integrator" if function.name in origin.integrated else origin.jacobians,
            origin.remedy.format(name=function.name),
        )
        for function, residual in ((f, system.state_residual), (h, system.output_residual))
    )
    if origin.kernel is not None:
        return Expression(f, h, a, c, origin.kernel)
    return Functions(f, h, a, c, origin.rate_jacobian)
