"""What to say of an implicit step whose equations Newton's method does not solve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .algebraic import equation_sizes
from .model import Origin

Array = NDArray[np.float64]

# Newton's method of SciPy stops after so many evaluations; what is left then names the equation.
_EVALUATIONS = 100
# Where no equation is farther off than this share of its terms, there are stages.
_SOLVED = 1e-6


def unsolved_step(origin: Origin, x: Array, u: Array) -> str:
    """Why the step of a discretised model is not finite at a state (n,) and input (m,).

    Blank where no step by Newton's method is to blame. What the user's functions raise goes on.
    """
    how, rate, dt = origin.how, origin.rate, origin.dt
    if how is None or rate is None or dt is None or not how.is_implicit:
        return ""
    n, equations, method = x.size, origin.equations, how.collocation
    w = x if equations is None else equations.solver.complete(x[None], u[None])[0]
    first = rate(w, u)
    where = f"at the initial state {x.tolist()}"
    if not np.isfinite(first).all():
        return (
            f"the rate is {first[:n].tolist()} {where}; expected finite numbers. Change the "
            "initial state or bound the states."
        )
    stages, h = len(method.A), dt / how.steps
    sizes = np.abs(w) + np.finfo(np.float64).tiny
    sizes[:n] += h * np.abs(first[:n])
    units = sizes.copy()  # of the equations
    if equations is not None:
        slope = equations.slope(w[None], u[None])
        units[n:] = equation_sizes(slope, w[None], n)[0] + np.finfo(np.float64).tiny
    inputs = np.repeat(u[None], stages, axis=0)

    def residual(shares: Array) -> Array:
        """Of Z - h A f(x + Z) and of the algebraic equations, as shares of the states' sizes."""
        W = shares.reshape(stages, -1) * sizes
        at = W.copy()
        at[:, :n] += x
        values = rate.batch(at, inputs)
        found = values.copy()
        found[:, :n] = W[:, :n] - h * method.A @ values[:, :n]
        return np.nan_to_num(found / units, nan=1e100, posinf=1e100, neginf=-1e100).ravel()

    from scipy.optimize import least_squares

    start = np.zeros((stages, w.size))
    start[:, n:] = w[n:] / sizes[n:]
    left = np.abs(least_squares(residual, start.ravel(), max_nfev=_EVALUATIONS).fun)
    worst = int(left.reshape(stages, -1).max(axis=0).argmax())
    name = f"the rate of x[{worst}]" if worst < n else f"algebraic equation {worst - n}"
    blame = (
        f"{name} is the farthest from being satisfied" if left.max() > _SOLVED
        else "another method finds some, so the start is too far from them"
    )
    remedies = "take a shorter step (steps=) or another initial state"
    if equations is not None:
        remedies += "; z may have no value within the step (a fold), which no step passes"
    return (
        f"Newton's method finds no stages of {how.words} in dt = {dt:g} {where}: {blame}. "
        f"To help, {remedies}."
    )
