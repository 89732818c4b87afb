"""Inputs that are measured with noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidInputError
from .augmentation import Augmentation, augmented, check_inherits, chosen, inherited
from .functions import Trusted
from .model import Origin
from .system import System, checked_system
from .system_arguments import SystemOptions

Array = NDArray[Any]


def noisy_inputs(system: System, inputs: ArrayLike | None = None) -> System:
    r"""Extend the state of a system by the errors of its measured inputs.

    The inputs u are measured, but :math:`u + e` acts on the system, with a white error e: its
    values at different times are independent.

    .. math::
        x(t+1) = f(x(t), u(t) + e(t)) + w(t), \qquad e(t+1) = w_e(t), \qquad
        y(t) = h(x(t), u(t) + e(t)) + v(t)

    The state is (x, e) and the disturbance (w, w_e); nothing is approximated. With the covariance
    :math:`Q_u` of the errors, extend the covariances of prior and disturbance to
    ``scipy.linalg.block_diag(P, Qu)`` and ``block_diag(Q, Qu)``, the gain of an observer by rows of
    zeros, and the initial state by zeros. On a linear system :math:`x^+ = A x + B u + w` this is
    the process noise covariance :math:`Q + B Q_u B^\top`.

    This is a convenience outside the paper. Its theorem covers the returned system only if that
    meets the assumptions, and its bounds then include the error of e; no constants of the original
    system carry over.

    Parameters
    ----------
    system : System
        The model, with inputs.
    inputs : array_like, optional
        Indices of the inputs that have errors, or a boolean mask (m,). All if left out.

    Returns
    -------
    System
        The same inputs, and one more state behind x for each chosen input, in order. It takes steps
        of other lengths and pickles if the given system does. It has no C form.

    Raises
    ------
    ModelError
        If ``system`` is not a `System`.
    InvalidInputError, ShapeError
        If the system has no inputs, or ``inputs`` does not name any.

    Examples
    --------
    >>> import numpy as np, qpmhe
    >>> plant = qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1)
    >>> qpmhe.noisy_inputs(plant).f(np.array([2.0, 0.5]), np.ones(1))
    array([3.3, 0. ])
    """
    n, m = checked_system(system).n, system.m
    if m == 0:
        raise InvalidInputError("system has no inputs; expected at least one.")
    noisy = chosen("inputs", inputs, m, "input")
    if noisy.size == 0:
        raise InvalidInputError("inputs is empty; expected at least one input, or leave it out.")
    check_inherits(*system.extensions)
    options = inherited(system, noisy.size)
    held = augmented(system, Augmentation(n, m, np.zeros(0), noisy), **options)
    recipe = noisy_inputs, {"system": system, "inputs": noisy}
    return _without_memory(held, slice(n, n + noisy.size), options).with_origin(recipe=recipe)


def _without_memory(held: System, errors: slice, options: SystemOptions) -> System:
    """The system with e+ = 0, from the one with e+ = e."""
    nothing: Array = np.zeros(0)

    def zeroed(function: Any) -> Callable[..., Array]:
        def evaluate(z: Array, u: Array = nothing) -> Array:
            many = z.ndim > 1
            value = np.array(function.batch(z, u) if many else function(z, u))
            value[(slice(None), errors) if many else errors] = 0.0
            return value

        return evaluate

    def output(function: Any) -> Callable[..., Array]:
        def evaluate(z: Array, u: Array = nothing) -> Array:
            return function.batch(z, u) if z.ndim > 1 else np.asarray(function(z, u))

        return evaluate

    # What is computed by small steps is better computed of the new functions, in their scales.
    own = held.evaluation.functions
    exact = [one.method != "finite differences" for one in (own.f_jacobian, own.h_jacobian)]

    def timed(_: System) -> System:
        return _without_memory(held.timed, errors, options)

    def again(change: Augmentation, others: SystemOptions) -> System:
        return _without_memory(augmented(held, change, **others), errors, others)

    return System.made(
        Trusted(zeroed(held.f)), Trusted(output(held.h)),
        Origin(
            dt=held.dt, how=held.origin.how, held=held.held, make_augmented=again,
            make_timed=timed if held.has_timed else None, is_timed=held.origin.is_timed,
        ),
        n=held.n, p=held.p, m=held.m,
        f_jacobian=Trusted(zeroed(own.f_jacobian)) if exact[0] else None,
        h_jacobian=Trusted(output(own.h_jacobian)) if exact[1] else None, **options,
    )
