"""The region in which a QP's model of J is trusted, and the path of steps in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qpmhe_solvers import QP

from ..terms.forms import WholeForm
from .limits import LARGER_REGION, POOR, SMALLER_REGION, WELL

Array = NDArray[np.float64]


class Metric(NamedTuple):
    """The metric of damping, |d(0)|_D^2 + sum |d(i+1) - A d(i)|_Q^2, of the QP around a trial.

    Attributes
    ----------
    form : WholeForm
        How the following are held.
    slopes, weights : array
        -G, and the weights of (w, v), of which Q is a part, stage by stage.
    spread : callable
        See `Freed`.
    information : (n,) array
        The diagonal D.
    """

    form: WholeForm
    slopes: Array
    weights: Array
    spread: Callable[[int, Array], Array]
    information: Array

    def length(self, step: Array) -> float:
        """The length of a step; NaN or infinite where it is lost in rounding or range."""
        with np.errstate(all="ignore"):
            moved = step[1:] + self.form.times_minus_a(self.slopes, step[:-1])
            square = self.information @ np.square(step[0])
            square += self.form.disturbance_square(self.weights, moved)
            return float(np.sqrt(square))

    def descent(self, gradient: Array) -> Array:
        """The direction of steepest descent in this metric, along free disturbances."""
        force, step = gradient.copy(), np.empty_like(gradient)
        form, slopes = self.form, self.slopes
        for i in range(len(slopes) - 1, -1, -1):
            force[i] -= form.minus_a_transposed(slopes[i], force[i + 1])
        step[0] = -force[0] / self.information
        for i in range(len(slopes)):
            step[i + 1] = -form.times_minus_a(slopes[i], step[i]) - self.spread(i, force[i + 1])
        return step


class Region:
    """The steps that are not longer than a radius, which follows from how J fell before.

    Its length is that of `Metric`, with the largest D of the sequence so far, which makes it the
    scale of More (The Levenberg-Marquardt algorithm, LNM 630, 1978). A step that is longer than
    the radius bends towards steepest descent (Powell's dogleg, in Rabinowitz, Numerical Methods for
    Nonlinear Algebraic Equations, 1970). Without rejected steps, and as long as J falls about as
    predicted, there is no radius.

    Attributes
    ----------
    radius : float
        The radius, infinite where there is none.
    shortened : bool
        Whether the last step that was tried differs from the QP's own.
    predicted : float
        The decrease of J that the QP predicts for the last step tried.
    length : float
        The length of that step, where there is a radius.
    """

    radius: float = math.inf
    shortened: bool = False
    predicted: float = 0.0
    length: float = 0.0
    _largest: Array | None = None

    def scaled(self, metric: Metric) -> Metric:
        """A metric with the largest D so far."""
        if self._largest is None:
            self._largest = metric.information
        self._largest = np.maximum(self._largest, metric.information)
        return metric._replace(information=self._largest)

    def part(self, path: Dogleg) -> Array:
        """The step at the radius, which is tried."""
        step, self.predicted = path.step(self.radius)
        self.shortened, self.length = True, self.radius
        return step

    def reject(self, length: float) -> None:
        """The step that was tried, of this length, has not lowered J."""
        self.radius = SMALLER_REGION * length

    def accept(self, decrease: float) -> None:
        """The step that was tried has lowered J by this much."""
        length = self.length
        share = decrease / self.predicted if self.predicted > 0.0 else math.inf
        larger = LARGER_REGION * length
        if share < POOR:
            self.radius = min(self.radius, length)
        elif share > WELL:
            self.radius = max(self.radius, larger) if self.radius < math.inf else larger
        elif not self.radius < math.inf:
            self.radius = length


class Dogleg:
    """The path to a QP's step by the Cauchy point, the minimum along steepest descent.

    Parameters
    ----------
    metric : Metric
        Of lengths.
    qp : QP
        The QP, without inequalities.
    step : (K + 1, n) array
        Its solution.
    predicted : float
        The decrease of J that it predicts for that.
    """

    def __init__(self, metric: Metric, qp: QP, step: Array, predicted: float) -> None:
        self._end, self._predicted = step, predicted
        #: The length of the QP's step.
        self.length = metric.length(step)
        # In the metric, products with the direction of descent are those with the gradient.
        with np.errstate(all="ignore"):
            descent = metric.descent(qp.gradient)
            self._slope = -np.vdot(qp.gradient, descent)
            curvature = np.vdot(descent, qp.hessian_times(descent))
            self._far = self._slope / curvature if curvature > 0.0 else np.float64(np.nan)
        self._descent, self._curvature = descent, curvature

    def step(self, radius: float) -> tuple[Array, float]:
        """The step of this length, and the decrease of J that is predicted for it.

        NaN where the path has no length, or its numbers are lost in rounding or range.
        """
        with np.errstate(all="ignore"):
            along, share = self._at(np.float64(radius))
            step = share * self._end
            if along > 0.0:
                step += along * self._descent
            slope, end = self._slope, self._predicted
            gained = 2.0 * (along * slope + share * end) - share * share * end
            if along > 0.0:
                gained -= along * (along * self._curvature + 2.0 * share * slope)
            return step, float(gained)

    def _at(self, radius: Any) -> tuple[Any, Any]:
        """How far along the descent, and which share of the QP's step, a step of this length is."""
        slope, far, end = self._slope, self._far, self._predicted
        if not 0.0 < far * slope < math.inf:  # no direction of descent: a part of the QP's step
            return 0.0, radius / self.length
        if far * np.sqrt(slope) >= radius:
            return radius / np.sqrt(slope), 0.0
        # |c + s (d - c)| = radius, c the Cauchy point.
        square, across = far * far * slope, far * end
        gap = max(self.length * self.length - 2.0 * across + square, 0.0)
        half = across - square
        root = np.sqrt(max(half * half + gap * (radius * radius - square), 0.0))
        share = (radius * radius - square) / (half + root) if half + root > 0.0 else 1.0
        share = min(share, 1.0)
        return (1.0 - share) * far, share
