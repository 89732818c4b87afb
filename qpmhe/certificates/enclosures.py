"""Where a model's values and Jacobians lie: at many states at once, and cell by cell."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._checks import Array
from ..codegen.graph import model_graph
from ..errors import ModelError
from ..model.system import System
from .intervals import Interval, Jet, OutsideDomainError, variables
from .regions import Region

_REMEDY = "Take a smaller region, or make the model defined on all of it."


def evaluated(name: str, function: Any, x: Array, u: Array) -> Array:
    """A function's values; the state is named where it raises."""
    with np.errstate(all="ignore"):
        try:
            return np.array(function.batch(x, u), np.float64)
        except Exception as error:  # a user's function may raise anything
            raise ModelError(_raised(name, function, x, u, error)) from error


def _raised(name: str, function: Any, x: Array, u: Array, first: Exception) -> str:
    for k in range(len(x)):
        try:
            np.array(function.batch(x[k : k + 1], u[k : k + 1]), np.float64)
        except Exception as error:
            return (
                f"{name} raises {type(error).__name__} at {place(x[k], u[k])}, within the region: "
                f"{error}. {_REMEDY}"
            )
    return (
        f"{name} raises {type(first).__name__} at several states of the region at once, though "
        f"not at any of them alone: {first}. Write it for one state at a time."
    )


def place(x: Array, u: Array) -> str:
    """A state and its input in words."""
    return f"x = {x.tolist()}" + (f", u = {u.tolist()}" if u.size else "")


def check_values(system: System, points: Array, *, output_only: bool = False) -> None:
    """Raise a ModelError where f or h raises or is not finite."""
    x, u = points[:, : system.n], points[:, system.n :]
    for name, function in (("f", system.f), ("h", system.h))[output_only:]:
        values = evaluated(name, function, x, u)
        broken = ~np.isfinite(values).all(axis=1)
        if broken.any():
            k = int(np.argmax(broken))
            raise ModelError(
                f"{name} is not finite at {place(x[k], u[k])}, within the region: it returned "
                f"{values[k].tolist()}. {_REMEDY}"
            )


def joint_jacobians(system: System, points: Array) -> Array:
    """The joint Jacobians at some states."""
    check_values(system, points)  # a step in the imaginary direction may not see NaN
    x, u = points[:, : system.n], points[:, system.n :]
    joint = np.concatenate(
        (
            evaluated("the Jacobian of f", system.f_jacobian, x, u),
            evaluated("the Jacobian of h", system.h_jacobian, x, u),
        ),
        axis=1,
    )
    broken = ~np.isfinite(joint).all(axis=(1, 2))
    if broken.any():
        raise ModelError(
            f"the Jacobians of f and h are not finite at {points[broken][0].tolist()}, within the "
            "region; expected functions with derivatives there. Take a smaller region."
        )
    return np.asarray(joint, np.float64)


# Beyond, corners would be many: what the other coordinates do is covered by the error.
MOST_ACTIVE = 6


@dataclass(frozen=True, eq=False)
class Enclosure:
    r"""The joint Jacobian :math:`J = [\partial f; \partial h]` over cells, or that of h alone.

    On a cell with middle c, by the mean value theorem for J,

    .. math::
        J(s) \in J(c) + \sum_j (s_j - c_j) H_j + [-E, E]

    where H_j is the middle of an interval enclosure of the second derivatives over the cell
    and E covers its radius and all rounding. The affine part has its extremes at corners of
    the cell. E vanishes like the square of the cell's size, and is rounding alone where J is
    affine.
    """

    centre: Array  # (B, q, n), q = n + p or p: J(c); NaN where it could not be enclosed
    slopes: Array  # (B, N, q, n): H_j times the half-width of the cell
    error: Array  # (B, q, n): E, rounded up; NaN where it could not be enclosed
    excess: Array  # (B, N): what the width of each coordinate contributes to E

    def corners(self) -> tuple[Array, Array]:
        """Matrices whose convex hull, widened by an error, holds J on each cell."""
        # Cells of which nothing is known must not hide how the others vary.
        known = np.isfinite(self.error).all(axis=(1, 2))
        weight = np.abs(self.slopes[known]).max(axis=(0, 2, 3), initial=0.0)
        order = np.argsort(weight)[::-1]
        active = order[:MOST_ACTIVE][weight[order[:MOST_ACTIVE]] > 0.0]
        error = self.error
        rest = np.setdiff1d(np.arange(weight.size), active)
        if np.any(weight[rest] > 0.0):
            error = (error + np.abs(self.slopes[:, rest]).sum(axis=1)) * (1.0 + 1e-12)
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=active.size)))
        signs = signs.reshape(2**active.size, active.size)
        moved = self.centre[:, None] + np.einsum("kj,bjqn->bkqn", signs, self.slopes[:, active])
        rounding = 1e-15 * (active.size + 2) * (
            np.abs(self.centre) + np.abs(self.slopes[:, active]).sum(axis=1)
        )
        return moved, error + rounding


class SmoothModel:
    """f and h of a system, to be enclosed over cells of states and inputs.

    ``reason`` says why f and h cannot be run with intervals, ``output_reason`` why h alone
    cannot; empty if they can. ``affine_output``: the Jacobian of h is constant on the region.
    """

    def __init__(self, system: System, region: Region) -> None:
        self._system, self._region = system, region
        self._graph = self._output_graph = None
        # A trace has been compared at points only, which proves nothing of the function.
        if system.tracing is None and system.symbolic is not None:
            self._graph = model_graph(system.symbolic)
            self._output_graph = model_graph(system.symbolic, output_only=True)
        self.n, self.p = system.n, system.p
        self.affine_output = False
        middle = 0.5 * (region.lower + region.upper)[None]
        self.output_reason = self._refused(middle, output_only=True)
        self.reason = self.output_reason or self._refused(middle, output_only=False)
        if self.output_reason:
            return
        try:
            outputs = self._jets(region.lower[None], region.upper[None], output_only=True)
        except Exception:  # whatever a user's function makes of unusual numbers
            return
        self.affine_output = all(
            isinstance(jet, float) or not (jet.hessian.low.any() or jet.hessian.high.any())
            for jet in outputs
        )

    def _refused(self, point: Array, *, output_only: bool) -> str:
        """Why the functions cannot be run with intervals; empty if they can."""
        try:
            self._jets(point, point, output_only=output_only)
        except Exception as error:  # whatever a user's function makes of unusual numbers
            return f"{type(error).__name__}: {error}"
        return ""

    def _jets(self, lower: Array, upper: Array, *, output_only: bool) -> list[Any]:
        """Values of f and h, or h, over cells: a list of jets, or floats where constant."""
        made = variables(lower, upper)
        graph = self._output_graph if output_only else self._graph
        with np.errstate(all="ignore"):
            if graph is not None:
                values = graph(list(made))
            else:
                x, u = made[: self.n], made[self.n :]
                functions = ((self._system.f, self.n), (self._system.h, self.p))
                values = [
                    entry
                    for function, size in functions[output_only:]
                    for entry in np.asarray(function(x, u), dtype=object).reshape(size)
                ]
        entries = [value if isinstance(value, Jet) else float(value) for value in values]
        if any(isinstance(value, float) and not math.isfinite(value) for value in entries):
            raise OutsideDomainError("a value that is not finite on the set")
        return entries

    def enclose(self, lower: Array, upper: Array, *, output_only: bool = False) -> Enclosure:
        """The joint Jacobian over cells."""
        with np.errstate(all="ignore"):
            found = self._enclosed(lower, upper, output_only)
        unknown = np.isnan(found.error).any(axis=(1, 2))
        if unknown.any():
            middles = 0.5 * lower[unknown] + 0.5 * upper[unknown]
            middles = middles[self._region.contains(middles[:, : self.n])]
            check_values(self._system, middles, output_only=output_only)
        return found

    def _enclosed(self, lower: Array, upper: Array, output_only: bool) -> Enclosure:
        centre = 0.5 * lower + 0.5 * upper
        half = np.nextafter(np.maximum(upper - centre, centre - lower), np.inf)
        half = np.where(upper == lower, 0.0, half)
        centre = np.where(upper == lower, lower, centre)
        at_centre = Interval(*self._derivatives(centre, centre, output_only)[0])
        second = Interval(*self._derivatives(lower, upper, output_only)[1])
        # Cells first, then coordinates; rows and columns of the Jacobian last.
        slopes = second.middle.transpose(3, 2, 0, 1) * half[:, :, None, None]
        spread = second.radius.transpose(3, 2, 0, 1) * half[:, :, None, None]
        jacobian, rounding = (
            part.transpose(2, 0, 1) for part in (at_centre.middle, at_centre.radius)
        )
        error = (spread.sum(axis=1) + rounding + 1e-15 * np.abs(slopes).sum(axis=1)) * (
            1.0 + 1e-14 * (half.shape[1] + 4)
        )
        unknown = ~(
            np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(error).all(axis=(1, 2))
            & np.isfinite(slopes).all(axis=(1, 2, 3))
        )
        # NaN alone: infinities would make invalid operations later on.
        slopes[unknown], error[unknown] = np.nan, np.nan
        jacobian = np.where(np.isfinite(jacobian).all(axis=(1, 2), keepdims=True), jacobian, np.nan)
        return Enclosure(jacobian, slopes, error, spread.sum(axis=(2, 3)))

    def _derivatives(self, lower: Array, upper: Array, output_only: bool) -> tuple[Array, Array]:
        """Ends of gradients (2, q, n, B) and of their derivatives (2, q, n, N, B).

        NaN where undefined.
        """
        cells, N = lower.shape
        q, n = self.p if output_only else self.n + self.p, self.n
        gradient, hessian = np.zeros((2, q, n, cells)), np.zeros((2, q, n, N, cells))
        try:
            jets = self._jets(lower, upper, output_only=output_only)
        except Exception:  # outside the domain, or whatever a user's function makes of it
            if cells == 1:
                return np.full_like(gradient, np.nan), np.full_like(hessian, np.nan)
            half = cells // 2
            first = self._derivatives(lower[:half], upper[:half], output_only)
            second = self._derivatives(lower[half:], upper[half:], output_only)
            return (
                np.concatenate((first[0], second[0]), axis=-1),
                np.concatenate((first[1], second[1]), axis=-1),
            )
        for row, jet in enumerate(jets):
            if isinstance(jet, Jet):
                gradient[0, row], gradient[1, row] = jet.gradient.low[:n], jet.gradient.high[:n]
                hessian[0, row], hessian[1, row] = jet.hessian.low[:n], jet.hessian.high[:n]
                # What is not finite has no derivative, whatever its parts had.
                lost = ~(np.isfinite(jet.value.low) & np.isfinite(jet.value.high))
                gradient[:, row, :, lost] = hessian[:, row, :, :, lost] = np.nan
        return gradient, hessian
