"""States over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, flag, label_list, numbers, positive
from ..errors import InvalidInputError, ShapeError
from ..estimation.run import deviations
from .checks import check_estimate, check_run, curve, named_curves, sample_times
from .style import (
    MEASURED,
    PROVED,
    REAL,
    STYLES,
    date_axis,
    legend_columns,
    line_styles,
    panels,
    run_times,
    time_words,
)

if TYPE_CHECKING:
    from ..estimation.estimate import Estimate
    from ..estimation.run import Run
    from ..model.residuals import Residual


# Samples times points of a line's width.
_WIDE = 600.0


def trajectories(
    times: Array, truth: Array | None, estimates: Mapping[str, Array], labels: Sequence[str],
    time_label: str, axes: Any = None, *, residual: Residual | None = None,
    covariances: Array | None = None, sigmas: float = 2.0,
) -> list[Any]:
    """True states and estimates over time, one panel a state, as in the paper's figure.

    Parameters
    ----------
    times : (T + 1,) array
        Times of the states.
    truth : (T + 1, n) array or None
        The real states, where they are known.
    estimates : mapping of label to (T + 1, n) array
        At most six estimates, drawn in this order; "observer" and "candidate" have the same colours
        in all figures.
    labels : sequence of str
        Axis labels of the states, with units.
    time_label : str
        Label of the time axis, with its unit.
    axes : sequence of n matplotlib Axes, optional
        Where to draw; a figure is made if left out: ``axes[0].figure`` of the axes returned.
    residual : optional
        The system's ``state_residual``: estimates of angles are drawn in the same turn as the
        truth.
    covariances : (T + 1, n, n) array, optional
        Those of the first of the estimates, of which a band is drawn; (T, n, n) are those of all
        times but the first.
    sigmas : float
        Half the width of the band, in standard deviations.

    Raises
    ------
    OptionError
        If sigmas is not above zero.
    ShapeError
        If labels, curves, covariances and axes do not fit the same states, or curves do not fit
        the times.
    InvalidInputError
        If something is not an array, labels are not strings, axes are not Axes, or there are too
        many estimates.
    """
    names, when = label_list(labels), sample_times(times)
    length, n = when.size, len(names)
    curves = named_curves(estimates, length, n, len(STYLES))
    real = None if truth is None else curve("truth", truth, length, n)
    half = None if covariances is None else (
        positive("sigmas", sigmas) * deviations(_checked_covariances(covariances, length, n)))
    if real is not None and residual is not None:
        curves = {label: residual.aligned(values, real) for label, values in curves.items()}
    drawn = panels(n, axes)
    for j, panel in enumerate(drawn):
        if real is not None:
            panel.plot(when, real[:, j], **REAL)
        for style, (label, values) in zip(line_styles(curves), curves.items(), strict=True):
            panel.plot(when, values[:, j], linewidth=1.3, label=label, **style)
        if half is not None and len(half):
            _add_band(panel.lines[-len(curves)], when, half[:, j], sigmas)
        panel.set_ylabel(names[j])
        panel.margins(x=0.01)
    drawn[-1].set_xlabel(time_label)
    _legend(drawn, axes)
    return drawn


def states(
    run: Run, *, smoothed: bool = False, dt: float | None = None,
    labels: Sequence[str] | None = None, time_label: str | None = None,
    truth: Array | None = None, sigmas: float = 2.0,
    band: tuple[ArrayLike, ArrayLike] | None = None, guarded: Array | None = None,
    axes: Any = None, residual: Residual | None = None,
) -> list[Any]:
    """The estimates of a run, with bands of their covariances and of the proved set.

    Measurements are dots on the states that they measure: those of an output that is equal to one
    state, and to no other, at all estimates of the run.

    Parameters
    ----------
    run : Run
        From `MovingHorizonEstimator.run`, with ``covariances=True`` for the bands.
    smoothed : bool
        Whether to draw the run's smoothed estimates, with bands of their covariances, instead of
        those from the measurements before.
    dt : float, optional
        Time between samples, in the unit of ``time_label``; the system's if left out.
    time_label : str, optional
        Label of the time axis; the run's unit of time where the time between samples is known,
        else samples.
    labels, truth, axes, residual
        As for `trajectories`. Labels that are left out are the run's: those given to
        `MovingHorizonEstimator.run`, or the model's (see `qpmhe.System.signals`).
    sigmas : float
        Half the width of a band, in standard deviations.
    band : (lower, upper), optional
        Sides (T + 1, n) of a box that contains the true state, as ``lower`` and ``upper`` of a
        `qpmhe.certificates.Band`; nothing is drawn where they are NaN.
    guarded : (T + 1, n) array, optional
        The guarded estimates, ``reading.state`` of a `qpmhe.certificates.Monitor`, as a line of
        their own: they are in the band, where the estimates need not be.

    Raises
    ------
    InvalidInputError
        If run is not a `Run`, or has no smoothed estimates to be drawn, labels are not strings,
        axes not Axes, or sides of the band swapped.
    ShapeError
        If labels, truth, axes, band or guarded do not fit the run's states and times.
    OptionError
        If a number is not above zero.
    """
    check_run(run)
    count, n = run.states.shape
    times, when = run_times(run, dt, time_label)
    smoothed, sigmas = flag("smoothed", smoothed), positive("sigmas", sigmas)
    drawn_states, covariances = run.states, run.covariances
    if smoothed:
        if run.smoothed is None:
            raise InvalidInputError(
                "the run has no smoothed estimates; call MovingHorizonEstimator.run with "
                "smoothed=, a lag in samples."
            )
        drawn_states, covariances = run.smoothed, run.smoothed_covariances
    lines = {"estimate" + ", smoothed" * smoothed: drawn_states}
    if guarded is not None:
        lines["guarded"] = guarded
    names = run_labels(run) if labels is None else label_list(labels, n)
    drawn = trajectories(times, truth, lines, names, when, axes, residual=residual,
                         covariances=covariances, sigmas=sigmas)
    date_axis(run, dt, drawn[-1])
    middle = [panel.lines[-len(lines)] for panel in drawn]
    measured = add_measurements(run, times, middle, drawn_states)
    if band is not None:
        lower, upper = (
            curve(f"band[{side}]", values, count, n) for side, values in enumerate(_pair(band))
        )
        _check_sides(lower, upper)
        for j, panel in enumerate(drawn):
            panel.fill_between(
                times, lower[:, j], upper[:, j], color=PROVED, linewidth=0.0, zorder=0.5,
                label="holds the true state (proved)",
            )
    if band is not None or measured:
        _legend(drawn, axes)
    return drawn


def _checked_covariances(values: ArrayLike, length: int, n: int) -> Array:
    found = numbers("covariances", values, finite=False)
    if found.shape not in ((length, n, n), (length - 1, n, n)):
        raise ShapeError(
            f"covariances have shape {found.shape}; expected ({length}, {n}, {n}), one for each "
            f"time, or ({length - 1}, {n}, {n}), none for the first time."
        )
    return found


def _add_band(line: Any, times: Array, half: Array, sigmas: float) -> None:
    """Fill to both sides of the last points of a line."""
    # A line of the usual width hides the band where samples stand close.
    line.set_linewidth(max(0.5, min(1.3, _WIDE / len(half))))
    middle = line.get_ydata()[-len(half) :]
    line.axes.fill_between(
        times[-len(half) :], middle - half, middle + half, color=line.get_color(), alpha=0.35,
        linewidth=0.0, label=f"± {sigmas:g} standard deviations",
    )


def add_measurements(run: Run, times: Array, lines: Sequence[Any], drawn_states: Array) -> bool:
    """Dots of the measurements under the lines of the first states; whether there are any."""
    if run.source is None or not len(run):
        return False
    system, y, x = run.source.system, run.source.measurements, drawn_states[:-1]
    u = np.zeros((len(run), 0)) if run.source.inputs is None else run.source.inputs
    try:
        outputs = system.h.batch(x, u)
        errors = y - outputs
        if system.output_residual is not None:
            system.output_residual.wrap(errors, y)
    except Exception:  # a user's function
        return False
    same = (outputs[:, :, None] == x[:, None, :]).all(axis=0)
    found = False
    for i in np.flatnonzero(same.sum(axis=1) == 1):
        j = int(same[i].argmax())
        if j < len(lines) and np.isfinite(y[:, i]).any():
            # An angle is drawn in the turn of its estimate.
            values = y[:, i] if system.output_residual is None else (
                lines[j].get_ydata()[:-1] + errors[:, i])
            lines[j].axes.plot(times[:-1], values, zorder=0.9, **MEASURED)
            found = True
    return found


def _pair(band: Any) -> tuple[ArrayLike, ArrayLike]:
    """The two sides of a band."""
    if not isinstance(band, (tuple, list)) or len(band) != 2:
        raise InvalidInputError(
            f"band is of type {type(band).__name__}; expected (lower, upper), such as "
            "(band.lower, band.upper) of certificate.observer_bound.along(run, ...)."
        )
    return band[0], band[1]


def _check_sides(lower: Array, upper: Array) -> None:
    """Refuse a band whose lower side is above its upper one; a NaN is its end."""
    crossed = np.argwhere(lower > upper)
    if crossed.size:
        k, j = crossed[0]
        raise InvalidInputError(
            f"band[0] is {lower[k, j]:.6g} and band[1] {upper[k, j]:.6g} for state {j + 1} at "
            f"time {k}; expected (lower, upper), with no lower side above the upper one."
        )


def window(
    estimate: Estimate, *, covariances: Array | None = None, sigmas: float = 2.0,
    dt: float | None = None, labels: Sequence[str] | None = None,
    time_label: str | None = None, axes: Any = None,
) -> list[Any]:
    """The window of one estimate: the observer's candidate, and the estimated trajectory.

    Parameters
    ----------
    estimate : Estimate
        From `MovingHorizonEstimator.update`.
    covariances : (N_t + 1, n, n) array, optional
        Those of the trajectory, from `MovingHorizonEstimator.covariances`, for its band.
    sigmas : float
        Half the width of the band, in standard deviations.
    dt, labels, time_label, axes
        As for `states`; an estimate does not know the time between samples.

    Raises
    ------
    InvalidInputError, ShapeError, OptionError
        As for `states`, with an `Estimate` in place of the run.
    """
    check_estimate(estimate)
    count, n = estimate.trajectory.shape
    step, last = 1.0 if dt is None else positive("dt", dt), estimate.time + 1
    times = step * np.arange(last + 1 - count, last + 1, dtype=np.float64)
    lines = {
        f"estimate, J = {estimate.cost:.3g}": estimate.trajectory,
        f"candidate, J = {estimate.candidate_cost:.3g}": estimate.candidate,
    }
    when = time_label or time_words(dt)
    drawn = trajectories(times, None, lines, _names(labels, n), when, axes,
                         covariances=covariances, sigmas=sigmas)
    for panel in drawn:
        for line in panel.lines[-2:]:
            line.set(marker="o", markersize=3.0)
    return drawn


def run_labels(run: Run) -> list[str]:
    """The names of a run's states with units, where it has them; else x1, x2, ..."""
    return run.labels or _names(None, run.states.shape[1])


def _names(labels: Sequence[str] | None, n: int) -> list[str]:
    return [f"x{j + 1}" for j in range(n)] if labels is None else label_list(labels, n)


def _legend(drawn: list[Any], axes: Any) -> None:
    """One legend: above all panels of a new figure, or within the first of given panels."""
    shown: dict[str, Any] = {}
    for panel in drawn:
        for handle, name in zip(*panel.get_legend_handles_labels(), strict=True):
            shown.setdefault(name, handle)
    if axes is not None:
        drawn[0].legend(shown.values(), shown.keys(), frameon=False)
        return
    figure = drawn[0].figure
    for old in list(figure.legends):
        old.remove()
    figure.legend(
        shown.values(), shown.keys(), loc="outside upper center", frameon=False,
        ncols=legend_columns([*shown], figure.get_figwidth(), 5),
    )
