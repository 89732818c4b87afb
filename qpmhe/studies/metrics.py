"""The metrics of a run: errors, costs, outcomes and times."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import Array
from ..estimation.estimate import Status
from ..estimation.run import Run
from ..model.residuals import Residual, difference

_FAILURES = (
    Status.SOLVER_FAILED | Status.NO_DECREASE | Status.CAP_REACHED | Status.MODEL_FAILED
    | Status.FAILED_STAGE | Status.CANDIDATE_OUTSIDE | Status.TIME_UP
)


def accuracy(
    estimates: Array, states: Array, settled: int, residual: Residual | None = None
) -> dict[str, Any]:
    r"""Root mean square errors of the estimates of x(0), ..., x(T), arrays of (T + 1, n).

    ``rmse_states`` lists the error :math:`\epsilon_j` of each state in its unit over all t,
    ``rmse_settled_states`` over t >= settled. ``rmse`` and ``rmse_settled`` sum them up without a
    unit,

    .. math::
        \sqrt{\frac1n \sum_{j=1}^n \frac{\epsilon_j^2}{s_j^2}}, \qquad
        s_j^2 = \frac1{T+1} \sum_{t=0}^T (x_j(t) - \hat x_j(0))^2

    with the scales of `scales`: 1 is the error of keeping the initial estimate for ever. NaN
    where no time counts as settled. Differences are those of the system's state residual. Where the
    true state is unknown (NaN), there is no error.
    """
    known = np.isfinite(states)
    with np.errstate(all="ignore"):
        sizes = scales(states, estimates[0], residual)
        squares = difference(residual, estimates, states) ** 2
        relative = squares / sizes**2
        return {
            "rmse": _root(relative, known),
            "rmse_settled": _root(relative[settled:], known[settled:]),
            "rmse_states": [*map(_root, squares.T, known.T)],
            "rmse_settled_states": [*map(_root, squares[settled:].T, known[settled:].T)],
        }


def scales(states: Array, initial_estimate: Array, residual: Residual | None = None) -> Array:
    """Scales (n,): each state's root mean square distance from its initial estimate.

    A state that never leaves its initial estimate has its own size as scale, and one that is
    always zero has its unit.
    """
    known = np.isfinite(states)
    squares = difference(residual, states, initial_estimate) ** 2
    with np.errstate(invalid="ignore"):
        distance = np.sqrt(squares.sum(axis=0, where=known) / known.sum(axis=0))
    size = np.abs(states).max(axis=0, initial=0.0, where=known)
    found: Array = np.where(distance > 0.0, distance, np.where(size > 0.0, size, 1.0))
    return found


def _root(squares: Array, known: NDArray[np.bool_]) -> float:
    return float(np.sqrt(squares[known].mean())) if known.any() else float("nan")


def consistency(
    estimates: Array, states: Array, covariances: Array, residual: Residual | None = None
) -> float:
    r"""The mean normalised estimation error squared (NEES), n on average if consistent.

    .. math::
        \frac1T \sum_{t=1}^{T} (\hat x(t) - x(t))^\top P(t)^{-1} (\hat x(t) - x(t))

    Times at which P(t), (T, n, n) in all, is not finite or singular are left out.
    """
    values = []
    errors = difference(residual, estimates[1:], states[1:])
    for error, covariance in zip(errors, covariances, strict=True):
        try:
            values.append(float(error @ np.linalg.solve(covariance, error)))
        except np.linalg.LinAlgError:
            continue
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def cost_ratio(costs: Array, reference: Array | None) -> float:
    r"""The mean of J(t) / J*(t), with J* of the converged solution of the same problem P_t.

    Below 1 where the reference is a local minimum and the run found a better one. Times where
    either is not finite, or J* is zero, are left out.
    """
    if reference is None:
        return float("nan")
    usable = np.isfinite(costs) & np.isfinite(reference) & (reference > 0.0)
    if not usable.any():
        return float("nan")
    return float(np.mean(costs[usable] / reference[usable]))


def outcomes(run: Run) -> dict[str, Any]:
    """How the steps ended, what they cost, and how many QPs and iterations they used.

    ``cost`` is the mean of the true cost J where it is finite. Shares of steps: ``improved``;
    ``kept``, where the candidate is the estimate and nothing failed; ``fallback``, where the
    candidate is the estimate because something failed or no iterate lowered the cost; ``cap_hits``,
    where a QP ended at its cap or unconfirmed. Also ``reasons``, the number of steps of each flag
    of `qpmhe.Status`, and the means ``qps_mean`` and ``solver_iterations_mean`` per step, NaN where
    the solver does not report them.
    """
    flags, total = run.flags, max(1, len(run))
    improved = (flags & Status.IMPROVED.value) != 0
    failed = ~improved & ((flags & _FAILURES.value) != 0)
    counts = {str(flag.name): int(((flags & flag.value) != 0).sum()) for flag in Status}
    known = run.solver_iterations[run.solver_iterations >= 0]
    costs = run.costs[np.isfinite(run.costs)]
    return {
        "cost": float(costs.mean()) if costs.size else float("nan"),
        "improved": float(improved.sum() / total),
        "kept": float((~improved & ~failed).sum() / total),
        "fallback": float(failed.sum() / total),
        "cap_hits": counts[str(Status.SOLVER_STOPPED.name)] / total,
        "reasons": {name: number for name, number in counts.items() if number},
        "qps_mean": float(run.qps.mean()),
        "solver_iterations_mean": float(known.mean()) if known.size else float("nan"),
    }


def timing(times: Array) -> dict[str, Any]:
    """Quantiles of the seconds per step, and the seconds themselves."""
    median, p95, p99 = np.percentile(times, (50.0, 95.0, 99.0)).tolist()
    return {
        "time_median": median,
        "time_p95": p95,
        "time_p99": p99,
        "time_max": float(times.max()),
        "times": times.astype(np.float32),
    }
