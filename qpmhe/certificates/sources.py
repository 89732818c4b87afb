"""Where a run's costs come from: what must be known before a bound rests on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidInputError
from ..estimate import Status
from ..estimator import MovingHorizonEstimator
from ..run import Run
from .errors import MismatchError

if TYPE_CHECKING:
    from .certificate import Certificate
    from .monitor import Monitor

__all__ = ["checked_costs", "insist_on_same"]

Array = NDArray[np.float64]

_BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE | Status.PROJECTED


def insist_on_same(certificate: Certificate, estimator: MovingHorizonEstimator) -> None:
    """Insist that a certificate is of an estimator's very system, observer and cost.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    estimator : MovingHorizonEstimator
        The estimator.

    Raises
    ------
    MismatchError
        If it is of others, or the estimator takes another candidate.
    """
    mine = (certificate.system, certificate.observer, certificate.cost)
    theirs = (estimator.system, estimator.observer, estimator.cost)
    for name, one, other in zip(("system", "observer", "cost"), mine, theirs, strict=True):
        if one is not other:
            raise MismatchError(
                f"the certificate is of another {name} than the estimator's; certify the "
                "very objects that the estimator is made of."
            )


def checked_costs(
    certificate: Certificate, source: MovingHorizonEstimator | Monitor, run: Run | None,
    horizon: int,
) -> Array:
    """The costs of a run's estimates; NaN where a window is not what the bound is of.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    source : MovingHorizonEstimator or Monitor
        What made the run, or checked it.
    run : Run
        The run.
    horizon : int
        N of the bound.

    Returns
    -------
    (T,) array

    Raises
    ------
    MismatchError
        If the source is of something else, or did not make the run.
    InvalidInputError
        If there is no run, or no source.
    """
    from .monitor import Monitor

    if run is None:
        raise InvalidInputError("a source is given, but no run; pass the run that it made.")
    if isinstance(source, Monitor):
        if source.certificate is not certificate:
            raise MismatchError("the monitor is of another certificate; pass one of this one.")
        same = np.array_equal(source.costs, run.costs, equal_nan=True)
    elif isinstance(source, MovingHorizonEstimator):
        insist_on_same(certificate, source)
        same = source.time == len(run) and np.array_equal(
            source.state, run.states[-1], equal_nan=True
        )
    else:
        raise InvalidInputError(
            f"source is {source!r}; expected the estimator that made the run, or the Monitor that "
            "checked it."
        )
    if source.horizon != horizon:
        raise MismatchError(
            f"horizon is {horizon}, but that of the run's estimator is {source.horizon}; take the "
            "bound for its horizon, and certify again if there is none."
        )
    if not same:
        raise MismatchError(
            "the source is not at the end of this run: it has seen another one, or more or less "
            "of it. Pass the estimator right after its run from the start, or a Monitor of it."
        )
    costs = np.array(run.costs, np.float64)
    # A window without all its measurements, or with another candidate, has another cost.
    broken = (run.flags & _BROKEN.value) != 0
    for t in np.flatnonzero(broken):
        costs[t : t + horizon] = np.nan
    if isinstance(source, Monitor):
        costs[~source.confirmed] = np.nan
    return costs
