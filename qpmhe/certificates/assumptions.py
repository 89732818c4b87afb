"""The theorem's assumptions, each looked at by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost, CostConstants, ObserverPrior, QuadraticCost
from ..observers import Observer, Sample
from ..system import System
from .deadline import PART_SECONDS, Deadline
from .errors import CertificateError
from .evaluation import evaluated
from .evidence import Evidence
from .lipschitz import output_lipschitz
from .observer import constant_gain
from .regions import Region
from .simulation import ObserverRun
from .verification import Matrices, eigenvalue_bounds, norm_bound

__all__ = [
    "Finding",
    "candidate_finding",
    "cost_finding",
    "invariance_finding",
    "kappa_finding",
    "lipschitz_finding",
    "no_correction_finding",
]

Array = NDArray[np.float64]

_SAMPLES = 2000
_SEED = 20210829
_SETS = ("states stay in X", "candidate in the sets")
_SCALES = (1e-3, 1e-1, 1.0, 10.0)  # of fitting errors that are tried, in sizes of the output


@dataclass(frozen=True, eq=False)
class Finding:
    """What became of one assumption.

    Parameters
    ----------
    name : str
        Which: ``output Lipschitz``, ``no correction without error``, ``correction bound``,
        ``cost bounds``, ``states stay in X``, ``candidate in the sets``.
    label : str
        The paper's label.
    holds : bool or None
        Whether it holds, as far as the evidence goes; None if it was not looked at.
    evidence : Evidence or None
        What that rests on; a counterexample is a proof that it does not.
    text : str
        What was found, with its numbers.
    value : float or None
        The constant, where the assumption has one.
    counterexample : dict
        Where it fails: names to numbers.
    """

    name: str
    label: str
    holds: bool | None
    evidence: Evidence | None
    text: str
    value: float | None = None
    counterexample: Mapping[str, Any] = field(default_factory=dict)

    @property
    def needed(self) -> bool:
        """Whether the bounds rest on it.

        They rest on no set: what is certified holds for any w and v, so that the theorem is
        applied with the whole space in place of W and V, and the region in place of X.
        """
        return self.name not in _SETS

    def to_dict(self) -> dict[str, Any]:
        """The finding in types that JSON knows; numbers that are not finite as text."""
        return {
            "name": self.name, "label": self.label, "holds": self.holds, "needed": self.needed,
            "evidence": None if self.evidence is None else self.evidence.value,
            "text": self.text, "value": _plain(self.value),
            "counterexample": {
                key: _plain(value) for key, value in self.counterexample.items()
            },
        }


def _plain(value: Any) -> Any:
    """Numbers that JSON knows, and the names of those that it does not."""
    if isinstance(value, np.ndarray):
        return [_plain(each) for each in value.tolist()]
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def lipschitz_finding(
    system: System, region: Region, seconds: float | Deadline = PART_SECONDS
) -> Finding:
    """The output's Lipschitz constant.

    Parameters
    ----------
    system : System
        The system.
    region : Region
        Where.
    seconds : float or Deadline
        How long this may take, about.
    """
    found = output_lipschitz(system, region, seconds=seconds)
    return Finding(
        "output Lipschitz", "ass:lipschitz", True, found.evidence,
        f"L_h = {found.value:.6g} ({found.note}); the gradient has the norm {found.attained:.6g} "
        f"at {np.round(found.at, 4).tolist()}",
        found.value,
    )


def _correction(system: System, observer: Observer) -> Callable[[Array, Array], Array] | None:
    """A correction that is a function of z and v alone; None where there is more to it."""
    if observer.initial_covariance() is not None or observer.needs_jacobians:
        return None
    sample = Sample(system, np.zeros(system.m))
    return lambda z, v: np.asarray(observer.correct(z, v, sample)[0], np.float64)


def no_correction_finding(system: System, observer: Observer, region: Region) -> Finding:
    """Whether the observer corrects where the output fits.

    Parameters
    ----------
    system, observer
        Which.
    region : Region
        Where.
    """
    name, label = "no correction without error", "ass:observer_0"
    try:
        gain = constant_gain(observer, system)
    except CertificateError:
        gain = None
    if gain is not None:
        return Finding(name, label, True, Evidence.PROVED, "L(z, v) = L v vanishes with v")
    correction = _correction(system, observer)
    if correction is None:
        return Finding(
            name, label, True, Evidence.ASSUMED,
            f"{type(observer).__name__} multiplies v by its gain of the moment",
        )
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))[:, : system.n]
    for z in points:
        value = correction(z, np.zeros(system.p))
        if value.any():
            return Finding(
                name, label, False, Evidence.PROVED,
                f"L(z, 0) = {value.tolist()} at z = {z.tolist()}", None, {"z": z, "L": value},
            )
    return Finding(
        name, label, True, Evidence.SAMPLED, f"L(z, 0) = 0 at {points.shape[0]} states"
    )


def kappa_finding(
    system: System, observer: Observer, region: Region, run: ObserverRun | None
) -> Finding:
    """The bound on the correction.

    Parameters
    ----------
    system, observer
        Which.
    region : Region
        Where.
    run : ObserverRun or None
        What the observer did, for gains that depend on it.
    """
    name, label = "correction bound", "eq:kappa"
    try:
        gain = constant_gain(observer, system)
    except CertificateError:
        pass
    else:
        kappa = float(norm_bound(Matrices.exact(gain[None]))[0])
        return Finding(
            name, label, True, Evidence.PROVED, f"kappa = |L| = {kappa:.6g}, of a constant gain",
            kappa,
        )
    correction = _correction(system, observer)
    if correction is not None:
        worst, z, v = _steepest(correction, system, region)
        how = f"the largest |L(z, v)| / |v| tried, at z = {z.tolist()}, v = {v.tolist()}"
    elif run is not None:
        sizes = np.linalg.norm(run.noises, axis=1)
        ratios = np.linalg.norm(run.corrections, axis=1)[sizes > 0.0] / sizes[sizes > 0.0]
        worst = float(ratios.max(initial=0.0))
        how = f"the largest |L(t)| / |v_z(t)| on a run of {sizes.size} samples"
    else:
        return Finding(
            name, label, None, None,
            f"{type(observer).__name__} has a gain that follows from what was measured: pass a "
            "run to see how large it gets",
        )
    if not np.isfinite(worst):
        return Finding(name, label, False, Evidence.SAMPLED, f"kappa is infinite: {how}")
    return Finding(name, label, True, Evidence.SAMPLED, f"kappa = {worst:.6g}, {how}", worst)


def _steepest(
    correction: Callable[[Array, Array], Array], system: System, region: Region
) -> tuple[float, Array, Array]:
    generator = np.random.default_rng(_SEED)
    points = region.sample(_SAMPLES, generator)
    states, u = points[:, : system.n], points[:, system.n :]
    size = np.ptp(evaluated("h", system.h, states, u), axis=0)
    size = np.where(size > 0.0, size, 1.0)
    worst = 0.0, states[0], size
    for z in states:
        v = generator.choice(_SCALES) * size * generator.uniform(-1.0, 1.0, system.p)
        with np.errstate(all="ignore"):
            ratio = float(np.linalg.norm(correction(z, v)) / np.linalg.norm(v))
        if not ratio <= worst[0]:
            worst = (ratio if np.isfinite(ratio) else np.inf), z, v
    return worst


def cost_finding(cost: Cost) -> tuple[CostConstants | None, Finding]:
    """The cost's constants, rounded outward where they could be.

    Parameters
    ----------
    cost : Cost
        The cost.
    """
    name, label = "cost bounds", "ass:stagecosts"
    constants = cost.constants
    if constants is None:
        why = (
            f"the discount {cost.discount:.6g} makes the lower bounds shrink with a stage's age"
            if cost.discount < 1.0
            else "its terms are not bounded by powers with one exponent, above and below"
        )
        return None, Finding(
            name, label, False, Evidence.PROVED, f"the cost has no constants: {why}", None
        )
    evidence = Evidence.ASSUMED
    if isinstance(cost, QuadraticCost):
        evidence = Evidence.PROVED
        prior = (
            (cost.prior.minimum * (1.0 - 1e-12), cost.prior.maximum * (1.0 + 1e-12))
            if isinstance(cost.prior, ObserverPrior) else eigenvalue_bounds(cost.prior)
        )
        constants = CostConstants(
            constants.exponent, prior, eigenvalue_bounds(cost.disturbance),
            eigenvalue_bounds(cost.noise),
        )
    terms = ", ".join(
        f"{letter} in [{low:.6g}, {high:.6g}]"
        for letter, (low, high) in zip(
            ("c_p", "c_w", "c_v"),
            (constants.prior, constants.disturbance, constants.noise), strict=True,
        )
    )
    text = f"a = {constants.exponent:.6g}, {terms}"
    if evidence is Evidence.ASSUMED:
        text += ", as the cost states them"
    return constants, Finding(name, label, True, evidence, text, constants.exponent)


def invariance_finding(system: System, region: Region) -> Finding:
    """Whether f maps X to itself.

    Parameters
    ----------
    system : System
        The system.
    region : Region
        Where states are tried.

    Raises
    ------
    ModelError
        If f raises there.
    """
    name, label = "states stay in X", "eq:system"
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
    if system.states is not None:
        points = points[[system.states.violation(x) == 0.0 for x in points[:, : system.n]]]
    x, u = points[:, : system.n], points[:, system.n :]
    if not x.shape[0]:
        return Finding(name, label, None, None, "the region and X have no sample in common")
    following = evaluated("f", system.f, x, u)
    lost = ~np.isfinite(following).all(axis=1)
    if lost.any():
        k = int(np.argmax(lost))
        return Finding(
            name, label, False, Evidence.PROVED,
            f"f is not finite: {following[k].tolist()} at x = {x[k].tolist()}"
            + (f", u = {u[k].tolist()}" if system.m else ""),
            None, {"x": x[k], "f(x)": following[k]} | ({"u": u[k]} if system.m else {}),
        )
    if system.states is None:
        return Finding(name, label, True, Evidence.PROVED, "X is the whole space")
    missed = np.array([system.states.violation(one) for one in following])
    worst = int(missed.argmax())
    if missed[worst] == 0.0:
        return Finding(
            name, label, True, Evidence.SAMPLED,
            f"f(x) is in X for {x.shape[0]} states x of X in the region",
        )
    counterexample: dict[str, Any] = {
        "x": x[worst], "f(x)": following[worst], "missed by": float(missed[worst])
    }
    if system.m:
        counterexample["u"] = u[worst]
    return Finding(
        name, label, False, Evidence.PROVED,
        f"f leaves X from {x[worst].tolist()}, which is in it, to {following[worst].tolist()}: by "
        f"{missed[worst]:.6g}; the disturbance must then lead back",
        None, counterexample,
    )


def candidate_finding(system: System, region: Region, run: ObserverRun | None) -> Finding:
    """Whether the candidate lies in X, W and V along a run.

    Parameters
    ----------
    system : System
        The system.
    region : Region
        Where the observer should stay.
    run : ObserverRun or None
        What the observer did.
    """
    name, label = "candidate in the sets", "ass:observer"
    sets = (
        ("X", "z", system.states), ("W", "L", system.disturbances), ("V", "v_z", system.noises)
    )
    if all(one is None for _, _, one in sets):
        return Finding(
            name, label, True, Evidence.PROVED, "X, W and V are the whole space"
            + ("" if run is None else f"; {_within(region, run)}"),
        )
    if run is None:
        return Finding(name, label, None, None, "pass a run, to check the candidate along it")
    told: list[str] = []
    counterexample: dict[str, Any] = {}
    for letter, symbol, one in sets:
        if one is None:
            continue
        values = {"z": run.states, "L": run.corrections, "v_z": run.noises}[symbol]
        missed = np.array([one.violation(value) for value in values])
        if missed.max() > 0.0:
            t = int(np.argmax(missed > 0.0))
            told.append(
                f"{symbol}({t}) = {values[t].tolist()} is not in {letter}, by {missed[t]:.6g}; it "
                f"is outside {int((missed > 0.0).sum())} times of {missed.size}"
            )
            counterexample = counterexample or {
                "t": t, symbol: values[t], "missed by": float(missed[t])
            }
    if told:
        return Finding(
            name, label, False, Evidence.PROVED, ". ".join(told), None, counterexample
        )
    return Finding(
        name, label, True, Evidence.SAMPLED,
        f"z, L and v_z are in X, W and V on a run of {run.noises.shape[0]} samples; "
        f"{_within(region, run)}",
    )


def _within(region: Region, run: ObserverRun) -> str:
    inside = region.contains(run.states)
    if inside.all():
        return "the observer stays in the region on the run"
    t = int(np.argmin(inside))
    return f"the observer leaves the region: z({t}) = {run.states[t].tolist()}"
