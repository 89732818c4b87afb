"""Robust exponential stability of observers with constant gain on a region, and such gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._checks import Array
from ..errors import InvalidInputError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..observers import Luenberger, Observer
from .deadline import DEFAULT_SECONDS, PART_SECONDS, Deadline
from .evidence import CertificateError, NotCertifiedError
from .inequalities import ErrorContraction, Matrices, euclidean_constants, norm_bound
from .properties import ObserverStability, sealed
from .regions import Region, bounded_region
from .sdp import started
from .search import Search

_STAY = "it holds while the states of system and observer stay in the region"


def constant_gain(observer: Observer, system: System) -> Array:
    """The gain L of an observer that corrects by L(z, v) = L v."""
    if not isinstance(observer, Observer):
        raise InvalidInputError(
            f"observer is {observer!r}; expected an observer, such as qpmhe.Luenberger(gain)."
        )
    gain, shape = observer.constant_gain, (system.n, system.p)
    if gain is not None:
        if gain.shape != shape:
            raise ShapeError(f"gain has shape {gain.shape}; expected (n, p) = {shape}.")
        return gain
    kind = type(observer).__name__
    reason = (
        "its gain follows from what was measured before"
        if observer.needs_jacobians or observer.initial_covariance() is not None
        else "its correction is a function of the state as well"
    )
    raise CertificateError(
        f"{kind} has no constant gain: {reason}. Detectability can be certified nevertheless; "
        "for the observer, take a Luenberger observer (synthesise_gain finds one), or state "
        "its constants yourself: ObserverStability.assumed(rho=..., C_p=..., C_w=..., C_v=..., "
        "kappa=...)."
    )


def gain_if_constant(observer: Observer, system: System) -> Array | None:
    """The gain of `constant_gain`, or None where the observer has none."""
    try:
        return constant_gain(observer, system)
    except CertificateError:
        return None


def certify_observer(
    system: System, observer: Observer, region: ConvexSet | Region | None = None, *,
    rho: float | None = None, inputs: Box | None = None, weights: tuple[float, float] = (1.0, 1.0),
    seconds: float | Deadline = PART_SECONDS,
) -> ObserverStability:
    """Find and verify constants of RGES, (eq:RGES), for an observer with constant gain.

    A constant P with the inequality of `qpmhe.certificates.inequalities.ErrorContraction` is sought
    and verified as in `certify_detectability`. It serves linear and nonlinear outputs.

    Parameters
    ----------
    system, region, inputs, weights, seconds
        As for `certify_detectability`; the weights are those of C_w and C_v.
    observer : Observer
        A `Luenberger` observer or one of its kind, or a `SteadyStateKalman`.
    rho : float, optional
        The rate; left out, it is chosen as for `certify_detectability`.

    Raises
    ------
    CertificateError
        If the observer has no constant gain.
    SetError, OptionError, ShapeError, ModelError
        As for `certify_detectability`.
    NotCertifiedError
        If there are no such constants, or none were found; the text gives the smallest feasible
        rate, and what to try. An `OutOfTimeError` says that it is not known which.
    """
    gain = constant_gain(observer, checked_system(system))
    search = Search(
        system, bounded_region(system, region, inputs), "observer", weights, gain, started(seconds)
    )
    _check_stability(search)
    return _stability(search, rho)


def _stability(search: Search, rho: float | None) -> ObserverStability:
    """The constants that follow from a verified contraction of the error."""
    others = () if search.gain is None else ("another gain, such as synthesise_gain finds",)
    found = search.answer("rho", rho, others, _unstable)
    form = found.form
    assert isinstance(form, ErrorContraction)
    V, allowance = _noise_weight(form.P, form.gain)
    V = V + allowance * np.eye(V.shape[0])
    kappa = float(norm_bound(Matrices.exact(form.gain[None]))[0])
    return sealed(
        ObserverStability(
            form.rate, *euclidean_constants(form.P, V, form.rate), kappa, gain=form.gain,
            region=search.region, notes=(*found.notes, _STAY), P=form.P, V=V, margin=found.margin,
            cells=found.cells,
        ),
        search.system, found.evidence,
    )


def _noise_weight(P: Array, gain: Array) -> tuple[Array, float]:
    """The product L^T P L, and what must be added to its diagonal for rounding."""
    exact = Matrices.exact(gain)
    product = exact.T @ Matrices.exact(P) @ exact
    symmetric = 0.5 * (product.middle + product.middle.T)
    return symmetric, float(2.0 * product.radius.sum())


def _radii(search: Search) -> Array:
    """The spectral radii of A - L C at the samples."""
    n = search.system.n
    assert search.gain is not None
    closed = search.jacobians[:, :n] - search.gain @ search.jacobians[:, n:]
    radii: Array = np.abs(np.linalg.eigvals(closed)).max(axis=1)
    return radii


def _check_stability(search: Search) -> None:
    """Spare the search for what cannot be: no P is for an A - L C that is not stable."""
    radii = _radii(search)
    worst = int(radii.argmax())
    if radii[worst] >= 1.0:
        search.check_jumps()
        raise NotCertifiedError(
            f"the observer's error does not contract: A - L C has the spectral radius "
            f"{radii[worst]:.6g} at {np.round(search.points[worst], 4).tolist()}, in the region",
            ("another gain, such as synthesise_gain finds", "a smaller region"),
        )


def _unstable(search: Search, text: str) -> NotCertifiedError:
    """Why no rate is feasible."""
    if search.gain is None:
        return NotCertifiedError(
            "no constant gain is shown to contract on the whole region: the semidefinite program "
            "is infeasible for every rate below 1",
            ("a smaller region", "an observer with a varying gain", "other coordinates"),
        )
    radii = _radii(search)
    return NotCertifiedError(
        f"{text}: no constant P shows contraction on the whole region, although A - L C "
        f"is stable at each of {radii.size} states (spectral radius up to {radii.max():.6g})",
        ("another gain, such as synthesise_gain finds", "a smaller region"),
    )


@dataclass(frozen=True, eq=False)
class Synthesis:
    """An observer made for a region, and its verified constants."""

    observer: Luenberger
    stability: ObserverStability


def synthesise_gain(
    system: System, region: ConvexSet | Region | None = None, *, criterion: Criterion = "trade",
    rho: float | None = None, inputs: Box | None = None, weights: tuple[float, float] = (1.0, 1.0),
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
    system, region, inputs, seconds
        As for `certify_detectability`.
    criterion : {"trade", "rate"}
        How to choose rho where it is not given: ``trade`` takes the one for which lasting
        disturbances and noise are bounded best, :math:`\sqrt{d^2 \kappa + v^2 r} / (1 - \rho)`;
        ``rate`` the smallest that is feasible, plus a hundredth of its distance from 1.
    rho : float, optional
        The rate.
    weights : (float, float)
        d and v, such as typical sizes of disturbance and noise.

    Raises
    ------
    OptionError
        If the criterion, rho or the weights are not among or within what is allowed.
    SetError, ModelError
        As for `certify_detectability`.
    NotCertifiedError
        If there is no such gain, or none was found.
    """
    choice("criterion", criterion, get_args(Criterion))
    search = Search(
        system, bounded_region(system, region, inputs), "synthesis", weights,
        seconds=started(seconds),
    )
    made = _stability(search, rho)
    assert made.gain is not None
    return Synthesis(Luenberger(made.gain), made)
