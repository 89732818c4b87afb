"""Luenberger gains that are certified to contract on a region."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..errors import OptionError
from ..observers import Luenberger
from ..sets import Box, ConvexSet
from ..system import System
from .deadline import DEFAULT_SECONDS, Deadline
from .errors import JumpError, NotCertifiedError, OutOfTimeError
from .observer import certify_observer, stability
from .sdp import started
from .regions import Region, bounded_region
from .properties import ObserverStability
from .search import Search, checked_rate, checked_weights

__all__ = ["Synthesis", "synthesise_gain"]

Criterion = Literal["trade", "rate"]

_SEARCH = 0.7  # of the time; the rest is for smaller constants of the gain that was found


@dataclass(frozen=True, eq=False)
class Synthesis:
    """An observer made for a region.

    Parameters
    ----------
    observer : Luenberger
        The observer.
    stability : ObserverStability
        Its verified constants.
    """

    observer: Luenberger
    stability: ObserverStability


def synthesise_gain(
    system: System,
    region: ConvexSet | Region | None = None,
    *,
    criterion: Criterion = "trade",
    rho: float | None = None,
    inputs: Box | None = None,
    weights: tuple[float, float] = (1.0, 1.0),
    seconds: float | Deadline = DEFAULT_SECONDS,
) -> Synthesis:
    r"""Find a constant gain L whose observer contracts on a region, and verify it.

    With Y = P L, the inequality of `qpmhe.certificates.inequalities.ErrorContraction` and the bound
    :math:`L^\top P L \preceq r I` on the amplification of noise are both linear:

    .. math::
        \begin{pmatrix} P & P A - Y C \\ \cdot & \rho^2 P \end{pmatrix} \succ 0, \qquad
        \begin{pmatrix} P & Y \\ \cdot & r I \end{pmatrix} \succeq 0,
        \qquad I \preceq P \preceq \kappa I .

    Minimised is :math:`d^2 \kappa + v^2 r`, that is the squares of :math:`\rho\, C_w` and
    :math:`\rho\, C_v`, weighted. The rounded gain is then verified like any other.

    Parameters
    ----------
    system : System
        The system.
    region : Box, Polytope or Region, optional
        A bounded set of states; that of the system if left out.
    criterion : {"trade", "rate"}
        How to choose rho where it is not given: ``trade`` takes the one for which lasting
        disturbances and noise are bounded best, :math:`\sqrt{d^2 \kappa + v^2 r} / (1 - \rho)`;
        ``rate`` the smallest that is feasible, plus a hundredth of its distance from 1.
    rho : float, optional
        The rate.
    inputs : Box, optional
        Bounds on the inputs, of a system that has any.
    weights : (float, float)
        d and v, such as typical sizes of disturbance and noise.
    seconds : float or Deadline
        How long this may take, about; what is known then is told, or that nothing is.

    Raises
    ------
    OptionError
        If the criterion, rho or the weights are not among or within what is allowed.
    SetError, ModelError
        As for `qpmhe.certificates.detectability.certify_detectability`.
    NotCertifiedError
        If there is no such gain, or none was found.
    """
    if criterion not in get_args(Criterion):
        raise OptionError(
            f"criterion is {criterion!r}; expected one of "
            f"{', '.join(map(repr, get_args(Criterion)))}."
        )
    checked_rate("rho", rho)
    first, second = checked_weights(weights)
    deadline = started(seconds)
    search = Search(
        system, bounded_region(system, region, inputs), "synthesis", (first, second),
        seconds=deadline.part(_SEARCH),
    )
    try:
        found = search.find_best(criterion) if rho is None else search.find(rho)
        made = stability(search, found)
    except (OutOfTimeError, JumpError):
        raise
    except NotCertifiedError as error:
        try:
            smallest = search.smallest_rate()
        except OutOfTimeError:
            raise error from None
        if np.isfinite(smallest):
            raise NotCertifiedError(
                f"{error.args[0]}. Feasible at the states tried: rho from {smallest:.4g} on",
                ("a larger rho", "a smaller region"), smallest,
            ) from error
        raise NotCertifiedError(
            "no constant gain is shown to contract on the whole region: the semidefinite program "
            "is infeasible for every rate below 1",
            ("a smaller region", "an observer with a varying gain", "other coordinates"),
        ) from error
    assert made.gain is not None
    observer = Luenberger(made.gain)
    try:
        # For the gain as it is now, another P may give smaller constants.
        again = certify_observer(
            system, observer, search.region, rho=made.rho, weights=weights, seconds=deadline
        )
    except NotCertifiedError:
        again = made

    def size(one: ObserverStability) -> float:
        return float(np.hypot(first * one.C_w, second * one.C_v))

    better = again.evidence is made.evidence and size(again) < size(made)
    return Synthesis(observer, again if better else made)
