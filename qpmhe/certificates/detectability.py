"""Exponential detectability (e-IOSS) of a system on a region."""

from __future__ import annotations

import numpy as np

from ..model.sets import Box, ConvexSet
from ..model.system import System
from .deadline import PART_SECONDS, Deadline
from .evidence import NotCertifiedError
from .inequalities import OutputInjection, OutputWeight
from .properties import Detectability, Subject, sealed
from .regions import Region, bounded_region
from .sdp import started
from .search import Search

# Of an output in its own size, for a state in the region's.
_UNSEEN = 1e-9
_STEEP = 1e6
_STAY = "it holds for trajectories that stay in the region, both of a pair, with equal inputs"


def certify_detectability(
    system: System, region: ConvexSet | Region | None = None, *, eta: float | None = None,
    inputs: Box | None = None, weights: tuple[float, float] = (1.0, 1.0),
    seconds: float | Deadline = PART_SECONDS,
) -> Detectability:
    """Find and verify constants of e-IOSS, Definition def:eIOSS.

    A constant P with one of the inequalities of `qpmhe.certificates.inequalities` is sought by
    semidefinite programs at some states of the region, and then verified on all of it: the
    Jacobians are enclosed cell by cell with outward rounding, and each cell's matrices shown
    positive definite. The constants follow as in `euclidean_constants`. Proved is what f and
    h are as written, in real arithmetic with the constants that they have in double precision;
    how far their computed values are rounded belongs to the disturbance.

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    eta : float, optional
        The rate; left out, one is chosen between the smallest feasible one and 1 for which
        lasting disturbances are bounded best.
    weights : (float, float)
        How much the constants c_w and c_v matter, such as typical sizes of disturbance and
        noise; the programs minimise the sum of squares of the products.
    seconds : float or Deadline
        How long this may take, about; the result is then what was found so far, if anything.

    Returns
    -------
    Detectability
        PROVED only if the verification passed; SAMPLED, with the reason, if the functions
        cannot be run with intervals, or the region has too many cells for the time.

    Raises
    ------
    SetError, OptionError, ModelError
        If the region is no bounded set of states, eta, the weights or the seconds are out of
        range, or the Jacobians are not finite in the region.
    NotCertifiedError
        If there are no such constants, or none were found; the text gives the smallest feasible
        rate and what is not detected. An `OutOfTimeError` says that it is not known which.
    """
    search = Search(
        system, bounded_region(system, region, inputs), None, weights, seconds=started(seconds)
    )
    found = search.answer("eta", eta, (), _undetectable)
    form = found.form
    assert isinstance(form, (OutputWeight, OutputInjection))
    notes = (*found.notes, _STAY)
    if isinstance(form, OutputInjection):
        notes = (
            *notes,
            "h is not affine on the region, where the inequality with an output weight does not "
            "carry over from states to averages of Jacobians; that with output injection does",
        )
    return sealed(
        Detectability(
            form.rate, c_p, c_w, c_v, search.region, notes, form.P, form.P, form.R, search.kind,
            found.margin, found.cells,
        ),
        Subject.of(system, search.region), found.evidence,
    )


def _undetectable(search: Search, text: str) -> NotCertifiedError:
    """Why no rate is feasible."""
    mode = _undetected(search)
    if mode is not None:
        return NotCertifiedError(
            f"the system is not exponentially detectable by any constant P: {mode}",
            (
                "measure something that this mode acts on",
                "leave the mode out of the model if it is not to be estimated",
            ),
        )
    return NotCertifiedError(
        f"{text}: no constant P shows detectability on the whole region, although "
        f"every single linearisation may be detectable{_steepest(search)}",
        ("a smaller region", "other coordinates of the state"),
    )


def _steepest(search: Search) -> str:
    """Where f grows so fast that rounding alone may spoil a program; empty if nowhere."""
    n = search.system.n
    radii = np.abs(np.linalg.eigvals(search.jacobians[:, :n])).max(axis=1)
    worst = int(radii.argmax())
    if radii[worst] < _STEEP:
        return ""
    return (
        f"; f's Jacobian has an eigenvalue of size {radii[worst]:.3g} at "
        f"{np.round(search.points[worst], 4).tolist()}, where the model may not be meant to hold"
    )


def _undetected(search: Search) -> str | None:
    """A mode that does not decay and is not seen, at one of the states."""
    n = search.system.n
    states, outputs = search.scales.states, search.scales.outputs
    for point, jacobian in zip(search.points, search.jacobians, strict=True):
        A = jacobian[:n] * states / states[:, None]
        C = jacobian[n:] * states / outputs[:, None]
        for value in np.linalg.eigvals(A):
            if abs(value) < 1.0 - 1e-9:
                continue
            # Large rows are scaled down, so that no size of A can hide what C sees.
            rest = A - value * np.eye(n)
            rest = rest / np.maximum(1.0, np.abs(rest).max(axis=1, keepdims=True))
            _, sizes, vectors = np.linalg.svd(np.vstack((rest, C)))
            if sizes[-1] <= _UNSEEN:
                direction = states * vectors[-1].conj()
                direction = np.real_if_close(direction / np.linalg.norm(direction))
                return (
                    f"at {np.round(point, 4).tolist()} the mode with eigenvalue {value:.6g}, "
                    f"along {np.round(direction, 4).tolist()}, does not decay and is not in the "
                    "output"
                )
    return None
