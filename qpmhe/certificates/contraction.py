"""What contracts on a region: exponential detectability (e-IOSS), observers, and gains for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._checks import Array, positive, vector
from ..errors import InvalidInputError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..observers import Luenberger, Observer
from .deadline import DEFAULT_SECONDS, PART_SECONDS, Deadline
from .enclosures import evaluated
from .evidence import CertificateError, NotCertifiedError, at_most
from .inequalities import Matrices, congruence, euclidean_constants, norm_bound
from .properties import Detectability, ObserverStability, sealed
from .regions import Region, bounded_region
from .sdp import NoiseSizes, started
from .search import Search, embedded
from .theorem import checked_rate

# Of an output in its own size, for a state in the region's.
_UNSEEN = 1e-9
_FAST, _STEEP = 1e3, 1e6
_NEAR = 1e-9, 1e-12  # of the region's width: what changes as much over less jumps
_OTHER_GAIN = "another gain, such as synthesise_gain finds"
_PAIR_STAYS = "it holds for trajectories that stay in the region, both of a pair, with equal inputs"
_RUN_STAYS = "it holds while the states of system and observer stay in the region"
_NOT_AFFINE = (
    "h is not affine on the region: there the inequality with an output weight does not carry over "
    "from states to averages of Jacobians; the one with output injection does"
)


def certify_detectability(
    system: System, region: ConvexSet | Region | None = None, *, eta: float | None = None,
    inputs: Box | None = None, weights: tuple[float, float] = (1.0, 1.0),
    seconds: float | Deadline = PART_SECONDS,
) -> Detectability:
    """Find and verify constants of e-IOSS, Definition def:eIOSS.

    A constant P with one of the inequalities of `qpmhe.certificates.inequalities` is sought by
    semidefinite programs at some states of the region, and then verified on all of it, cell by
    cell. The proof is about f and h as written, in real arithmetic with their constants in double
    precision; the rounding of their computed values belongs to the disturbance.

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    eta : float, optional
        The rate; left out, the one between the smallest feasible rate and 1 that bounds lasting
        disturbances best.
    weights : (float, float)
        Weights of the constants c_w and c_v, such as typical sizes of disturbance and noise; the
        programs minimise the sum of squares of the products.
    seconds : float or Deadline
        Approximate time limit; the result is then what was found so far, if anything.

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
        rate and what is not detected. An `OutOfTimeError` means that it is not known which.
    """
    first, second = vector("weights", np.asarray(weights), 2).tolist()
    search = Search(
        system, bounded_region(system, region, inputs), None,
        (positive("weights[0]", first), positive("weights[1]", second)), seconds=started(seconds),
    )
    _check(search, "eta", eta)
    found = search.answer("eta", eta, (), _undetectable)
    form = found.form
    notes = (*found.notes, *_left_out(search), _PAIR_STAYS)
    P, W = _norms(search, form.P)
    return sealed(
        Detectability(
            form.rate, *euclidean_constants(form.P, form.R, form.rate, W), form=search.kind,
            region=search.region, notes=notes if form.injection is None else (*notes, _NOT_AFFINE),
            P=P, W=W, V=form.R, cells=found.cells, compared=found.compared,
        ),
        system, found.evidence,
    )


def _check(search: Search, name: str, rate: float | None) -> None:
    """Raise where no program is worth solving."""
    if rate is not None:
        checked_rate(name, rate)
    if search.gain is None:
        _check_modes(search)


def _check_modes(search: Search) -> None:
    """Raise where a mode neither decays nor appears in the output: then no program is feasible."""
    n, states, outputs = search.n, search.scales.states, search.scales.outputs
    for point, jacobian in zip(search.points, search.jacobians, strict=True):
        A = jacobian[:n] * states / states[:, None]
        C = jacobian[n:] * states / outputs[:, None]
        values = np.linalg.eigvals(A)
        for value in values[np.abs(values) >= 1.0 - 1e-9]:
            # Large rows are scaled down, so that no size of A can hide what C sees.
            rest = A - value * np.eye(n)
            rest = rest / np.maximum(1.0, np.abs(rest).max(axis=1, keepdims=True))
            _, sizes, vectors = np.linalg.svd(np.vstack((rest, C)))
            if sizes[-1] > _UNSEEN:
                continue
            direction = states * vectors[-1].conj()
            direction = np.real_if_close(direction / np.linalg.norm(direction))
            raise NotCertifiedError(
                "the system is not exponentially detectable by any constant P: at "
                f"{np.round(point, 4).tolist()} the mode with eigenvalue {value:.6g}, along "
                f"{np.round(direction, 4).tolist()}, does not decay and does not appear in the "
                "output",
                ("measure an output that this mode affects",
                 "leave the mode out of the model if it is not to be estimated"),
            )


def _undetectable(search: Search, text: str) -> NotCertifiedError:
    """Why no rate is feasible."""
    _check_modes(search)  # at more states by now
    steep = _steepest(search)
    return NotCertifiedError(
        f"{text}: no constant P shows detectability on the whole region, although every single "
        f"linearisation may be detectable{steep}",
        ("a smaller region", "other coordinates of the state"),
    )


def _steepest(search: Search) -> str:
    """Where f grows so fast that rounding alone may spoil a program; an error where it jumps."""
    radii, system = search.radii(), search.system
    point, largest = search.points[int(radii.argmax())], float(radii.max())
    if largest < _FAST:
        return ""
    width = search.region.upper - search.region.lower
    ends = [
        evaluated("f", system.f, np.clip(
            point + share * np.diag(width)[search.free], search.region.lower, search.region.upper
        ), system.n)
        for share in (*_NEAR, *(-each for each in _NEAR))
    ]
    near, nearer = (np.abs(ends[k] - ends[k + 2]) for k in range(2))
    where = np.round(point, 4).tolist()
    if (nearer > np.maximum(0.5 * near, _NEAR[0] * np.abs(ends).max(axis=0))).any():
        raise NotCertifiedError(
            f"f jumps at {where}: over {2.0 * _NEAR[1]:.0e} of the region's width it changes by "
            f"{nearer.max():.3g}", ("a model without the jump", "a smaller region"),
        )
    return "" if largest < _STEEP else (
        f"; f's Jacobian has an eigenvalue of size {largest:.3g} at {where}, where the model may "
        "not be meant to hold"
    )


def constant_gain(observer: Observer, system: System) -> Array:
    """The gain L of an observer that corrects by L(z, v) = L v."""
    if not isinstance(observer, Observer):
        raise InvalidInputError(
            f"observer is {observer!r}; expected an observer, such as qpmhe.Luenberger(gain)."
        )
    gain, shape = observer.constant_gain, (system.n, system.p)
    if gain is not None and gain.shape != shape:
        raise ShapeError(f"gain has shape {gain.shape}; expected (n, p) = {shape}.")
    if gain is None:
        varies = observer.needs_jacobians or observer.initial_covariance() is not None
        reason = (
            "its gain follows from what was measured before" if varies
            else "its correction is a function of the state as well"
        )
        raise CertificateError(
            f"{type(observer).__name__} has no constant gain: {reason}. Detectability can be "
            "certified nevertheless; for the observer, take a Luenberger observer "
            "(synthesise_gain finds one), or state its constants yourself: "
            "ObserverStability.assumed(rho=..., C_p=..., C_w=..., C_v=..., kappa=...)."
        )
    return gain


def gain_if_constant(observer: Observer, system: System) -> Array | None:
    """As `constant_gain`, but None where the observer has none."""
    varies = isinstance(observer, Observer) and observer.constant_gain is None
    return None if varies else constant_gain(observer, system)


def certify_observer(
    system: System, observer: Observer, region: ConvexSet | Region | None = None, *,
    rho: float | None = None, inputs: Box | None = None, sizes: NoiseSizes = (1.0, 1.0),
    seconds: float | Deadline = PART_SECONDS,
) -> ObserverStability:
    """Find and verify constants of RGES, (eq:RGES), for an observer with constant gain.

    Outputs may be linear or nonlinear. Of all P and all rates, it returns those with the smallest
    limit of the error for disturbances and noises of the given sizes, in units of the region's
    size.

    Parameters
    ----------
    system, region, inputs, seconds
        As for `certify_detectability`.
    observer : Observer
        A `Luenberger` observer or one of its kind, or a `SteadyStateKalman`.
    rho : float, optional
        The rate; left out, the best one.
    sizes : (float or (r,) array_like, float or (p,) array_like)
        The largest disturbance w and noise v: each a length, or half-widths by component. The
        certificate holds for all sizes; it is best for these.

    Raises
    ------
    CertificateError
        If the observer has no constant gain.
    ShapeError
        If the gain or the sizes do not fit. Other errors are those of `certify_detectability`.
    """
    gain = constant_gain(observer, checked_system(system))
    search = Search(
        system, bounded_region(system, region, inputs), "observer", sizes, gain, started(seconds)
    )
    radii = search.radii(search.gain)
    worst = int(radii.argmax())
    if radii[worst] >= 1.0:  # then there is no P
        steep = _steepest(search)
        raise NotCertifiedError(
            f"the observer's error does not contract: A - L C has the spectral radius "
            f"{radii[worst]:.6g} at {np.round(search.points[worst], 4).tolist()}, in the region"
            f"{steep}", (_OTHER_GAIN, "a smaller region"),
        )
    return _stability(search, rho)


def _stability(search: Search, rho: float | None) -> ObserverStability:
    """The constants that follow from a verified contraction of the error."""
    _check(search, "rho", rho)
    others = () if search.gain is None else (_OTHER_GAIN,)
    found = search.answer("rho", rho, others, _unstable)
    form = found.form
    assert form.gain is not None
    V, (P, W) = congruence(form.P, form.gain), _norms(search, form.P)
    kappa = float(norm_bound(Matrices.exact(form.gain[None]))[0])
    system = search.system
    full = np.zeros((system.n, system.p))
    full[search.free] = form.gain
    return sealed(
        ObserverStability(
            form.rate, *euclidean_constants(form.P, V, form.rate, W), kappa, gain=full,
            region=search.region,
            notes=(*found.notes, *search.notes, *_left_out(search), _RUN_STAYS),
            P=P, W=W, V=V,
            Q=embedded(form.Q, search.acting, system.r) if form.Q.size else None,
            R=form.R if form.R.size else None, room=search.room, cells=found.cells,
            compared=found.compared,
        ),
        system, found.evidence,
    )


def _norms(search: Search, P: Array) -> tuple[Array, Array | None]:
    """P as a norm of all states, and the one of the disturbances; None where it is P."""
    full, G = embedded(P, search.free, search.system.n), search.system.disturbance_matrix
    return full, None if G is None else congruence(full, G)


def _left_out(search: Search) -> tuple[str, ...]:
    """What to say of states that the region fixes."""
    return tuple(
        f"x[{j}] is known: the region has no width there, f keeps it, and no gain or disturbance "
        "may move it" for j in np.setdiff1d(np.arange(search.system.n), search.free)
    )


def _unstable(search: Search, text: str) -> NotCertifiedError:
    """Why no rate is feasible."""
    if search.gain is None:
        _check_modes(search)
        return NotCertifiedError(
            "no constant gain is shown to contract on the whole region: the semidefinite program "
            "is infeasible for every rate below 1",
            ("a smaller region", "other coordinates, in which the model is closer to linear"),
        )
    return NotCertifiedError(
        f"{text}: no constant P shows contraction on the whole region, although A - L C is stable "
        f"at each of {len(search.points)} states (spectral radius up to "
        f"{search.radii(search.gain).max():.6g})", (_OTHER_GAIN, "a smaller region"),
    )


@dataclass(frozen=True, eq=False)
class Synthesis:
    """An observer made for a region, and its verified constants.

    It is projected in the certified metric: where X is the region, it stays there, and the bound
    holds at projected samples as well.
    """

    observer: Luenberger
    stability: ObserverStability

    def __str__(self) -> str:
        gain = [[float(f"{each:.4g}") for each in row] for row in self.observer.gain]
        return (
            f"Constant gain {gain}: the error contracts at the rate "
            f"{at_most(self.stability.rho, 4)} a sample, or faster ({self.stability.evidence}); "
            f"{'; '.join(self.stability.notes)}."
        )


def synthesise_gain(
    system: System, region: ConvexSet | Region | None = None, *, rho: float | None = None,
    inputs: Box | None = None, sizes: NoiseSizes = (1.0, 1.0),
    seconds: float | Deadline = DEFAULT_SECONDS,
) -> Synthesis:
    """Find a constant gain L whose observer contracts on a region, and verify it.

    The gain and P are sought together, with Y = P L, for the smallest limit of the error in states
    of the region's size. The gain is rounded, and then verified like any other. Parameters and
    errors are those of `certify_observer`.
    """
    search = Search(
        system, bounded_region(system, region, inputs), "synthesis", sizes,
        seconds=started(seconds),
    )
    made = _stability(search, rho)
    assert made.gain is not None
    return Synthesis(Luenberger(made.gain, metric=made.P), made)
