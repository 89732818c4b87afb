"""The theorem's assumptions, each examined alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from .._checks import Array
from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..observers import Observer, Sample
from .branch_and_bound import output_lipschitz
from .contraction import gain_if_constant
from .deadline import PART_SECONDS, Deadline
from .enclosures import evaluated, place
from .evidence import CertificateError, Evidence, json_ready
from .inequalities import Matrices, eigenvalue_bounds, norm_bound
from .regions import Region, bounded_region

_SAMPLES = 2000
_SEED = 20210829
_SETS = ("states stay in X", "candidate in the sets")
_SCALES = (1e-3, 1e-1, 1.0, 10.0)  # of fitting errors that are tried, in sizes of the output


@dataclass(frozen=True, eq=False)
class Finding:
    """Whether one assumption holds, and what that rests on."""

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
        """The finding in types that JSON knows; numbers that are not finite become None."""
        content: dict[str, Any] = json_ready(vars(self) | {
            "needed": self.needed, "evidence": self.evidence and self.evidence.value,
        })
        return content


def _correction_findings(
    system: System, observer: Observer, region: Region
) -> tuple[Finding, Finding]:
    """Whether the observer corrects where the output fits, and how much elsewhere."""
    none = partial(Finding, "no correction without error", "ass:observer_0")
    bound = partial(Finding, "correction bound", "eq:kappa")
    gain, kind = gain_if_constant(observer, system), type(observer).__name__
    if gain is not None:
        kappa = float(norm_bound(Matrices.exact(gain[None]))[0])
        return none(True, Evidence.PROVED, "L(z, v) = L v vanishes with v"), bound(
            True, Evidence.PROVED, f"kappa = |L| = {kappa:.6g}, of a constant gain", kappa
        )
    if observer.initial_covariance() is not None or observer.needs_jacobians:
        varying = f"{kind} multiplies v by its gain of the moment"
        return none(True, Evidence.ASSUMED, varying), bound(
            None, None,
            f"{kind} has a gain that follows from what was measured: state its bound, "
            "ObserverStability.assumed(kappa=...)",
        )
    generator, sample = np.random.default_rng(_SEED), Sample(system, np.zeros(system.m))

    def correct(z: Array, v: Array) -> Array:
        return np.asarray(observer.correct(z, v, sample)[0], np.float64)

    points = region.sample(_SAMPLES, generator)
    states = points[:, : system.n]
    size = np.ptp(evaluated("h", system.h, states, points[:, system.n :]), axis=0)
    size = np.where(size > 0.0, size, 1.0)
    unmoved = none(True, Evidence.SAMPLED, f"L(z, 0) = 0 at {len(states)} states")
    worst = 0.0, states[0], size
    for z in states:
        still = correct(z, np.zeros(system.p))
        if still.any() and unmoved.holds:
            unmoved = none(
                False, Evidence.PROVED, f"L(z, 0) = {still.tolist()} at z = {z.tolist()}", None,
                {"z": z, "L": still},
            )
        v = generator.choice(_SCALES) * size * generator.uniform(-1.0, 1.0, system.p)
        with np.errstate(all="ignore"):
            ratio = float(np.linalg.norm(correct(z, v)) / np.linalg.norm(v))
        if not ratio <= worst[0]:
            worst = (ratio if np.isfinite(ratio) else np.inf), z, v
    kappa, z, v = worst
    how = f"the largest |L(z, v)| / |v| tried, at z = {z.tolist()}, v = {v.tolist()}"
    if not np.isfinite(kappa):
        return unmoved, bound(False, Evidence.SAMPLED, f"kappa is infinite: {how}")
    return unmoved, bound(True, Evidence.SAMPLED, f"kappa = {kappa:.6g}, {how}", kappa)


def _cost_finding(cost: Cost) -> tuple[CostConstants | None, Finding]:
    """The cost's constants, rounded outward where they could be."""
    found = partial(Finding, "cost bounds", "ass:stagecosts")
    constants = cost.constants
    if constants is None:
        why = (
            f"the discount {cost.discount:.6g} makes the lower bounds shrink with a stage's age"
            if cost.discount < 1.0
            else "its ObserverPrior has no bounds; give it some, ObserverPrior(minimum, maximum)"
            if cost.observer_prior is not None and cost.observer_prior.bounds is None
            else "its terms are not bounded by powers with one exponent, above and below"
        )
        return None, found(False, Evidence.PROVED, f"the cost has no constants: {why}", None)
    evidence = Evidence.ASSUMED
    if cost.quadratic:
        evidence, (low, high) = Evidence.PROVED, constants.prior
        prior = (
            eigenvalue_bounds(cost.least_prior) if cost.observer_prior is None
            else (low * (1.0 - 1e-12), high * (1.0 + 1e-12))
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
    return constants, found(True, evidence, text, constants.exponent)


def _invariance_finding(system: System, region: Region) -> Finding:
    """Whether f maps X to itself."""
    found = partial(Finding, "states stay in X", "eq:system")
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
    if system.states is not None:
        points = points[[system.states.violation(x) == 0.0 for x in points[:, : system.n]]]
    x, u = points[:, : system.n], points[:, system.n :]
    if not x.shape[0]:
        return found(None, None, "the region and X have no sample in common")
    following = evaluated("f", system.f, x, u)

    def where(k: int) -> dict[str, Any]:
        return {"x": x[k], "f(x)": following[k]} | ({"u": u[k]} if system.m else {})

    lost = ~np.isfinite(following).all(axis=1)
    if lost.any():
        k = int(np.argmax(lost))
        return found(
            False, Evidence.PROVED,
            f"f is not finite: {following[k].tolist()} at {place(x[k], u[k])}", None, where(k),
        )
    if system.states is None:
        return found(True, Evidence.PROVED, "X is the whole space")
    missed = np.array([system.states.violation(one) for one in following])
    k = int(missed.argmax())
    if missed[k] == 0.0:
        return found(
            True, Evidence.SAMPLED,
            f"f(x) is in X for {x.shape[0]} states x of X in the region",
        )
    return found(
        False, Evidence.PROVED,
        f"f leaves X from {x[k].tolist()}, which is in it, to {following[k].tolist()}: by "
        f"{missed[k]:.6g}; the disturbance must then lead back",
        None, where(k) | {"missed by": float(missed[k])},
    )


@dataclass(frozen=True, eq=False)
class Audit:
    """All assumptions but detectability and the observer's stability.

    Parameters
    ----------
    findings : tuple of Finding
        One for each.
    constants : CostConstants or None
        The cost's constants, rounded outward where possible.
    region : Region
    """

    findings: tuple[Finding, ...]
    constants: CostConstants | None
    region: Region

    def __getitem__(self, name: str) -> Finding:
        """A finding by its name."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        known = ", ".join(repr(finding.name) for finding in self.findings)
        raise InvalidInputError(f"there is no finding {name!r}; expected one of {known}.")

    @property
    def lipschitz(self) -> float:
        """L_h."""
        value = self["output Lipschitz"].value
        assert value is not None
        return value

    @property
    def violated(self) -> tuple[Finding, ...]:
        """The findings with a counterexample, or without constants."""
        return tuple(finding for finding in self.findings if finding.holds is False)

    def to_dict(self) -> list[dict[str, Any]]:
        """The findings in types that JSON knows."""
        return [finding.to_dict() for finding in self.findings]


def audit(
    system: System, observer: Observer, cost: Cost, region: ConvexSet | Region | None = None, *,
    inputs: Box | None = None, seconds: float | Deadline = PART_SECONDS,
) -> Audit:
    """Check each assumption of the theorem, and show where it fails.

    Parameters
    ----------
    system, observer, cost, region, inputs
        As for `certify`.
    seconds : float or Deadline
        How long the output's Lipschitz constant may take, about.

    Raises
    ------
    SetError, ShapeError, InvalidInputError, ModelError
        If an argument does not fit, or f or h raises in the region, or h is not finite. An
        assumption that does not hold raises nothing.
    """
    checked_ingredients(system, observer, cost)
    where = bounded_region(system, region, inputs)
    slope = output_lipschitz(system, where, seconds=Deadline.of(seconds))
    constants, about_cost = _cost_finding(cost)
    candidate: tuple[bool | None, Evidence | None, str] = (
        True, Evidence.PROVED, "X, W and V are the whole space"
    )
    if any(one is not None for one in (system.states, system.disturbances, system.noises)):
        candidate = None, None, "the monitor checks it at each step of a run"
    findings = (
        Finding(
            "output Lipschitz", "ass:lipschitz", True, slope.evidence,
            f"L_h = {slope.value:.6g} ({slope.note}); the gradient has the norm "
            f"{slope.attained:.6g} at {np.round(slope.at, 4).tolist()}",
            slope.value,
        ),
        *_correction_findings(system, observer, where),
        about_cost,
        _invariance_finding(system, where),
        Finding("candidate in the sets", "ass:observer", *candidate),
    )
    return Audit(findings, constants, where)


def checked_ingredients(system: Any, observer: Any, cost: Any) -> None:
    """Check that system, observer and cost go together."""
    checked_system(system)
    if system.extensions:
        raise CertificateError(
            f"the system has {' and '.join(system.extensions)}, which the theorem's cost and sets "
            "do not; certify the system without them."
        )
    if not isinstance(observer, Observer):
        raise InvalidInputError(
            f"observer is {observer!r}; expected an observer, such as qpmhe.Luenberger(gain)."
        )
    if not isinstance(cost, Cost):
        raise InvalidInputError(
            f"cost is {cost!r}; expected a cost, such as qpmhe.QuadraticCost(prior=..., "
            "disturbance=..., noise=...)."
        )
    if system.disturbance_matrix is not None or cost.disturbance_factor is not None:
        raise CertificateError(
            "the system has a disturbance_matrix, or the cost a singular covariance of the "
            "disturbance; expected a disturbance of each state. Its constants grow with the "
            "horizon where corrections are no such disturbances, which certificates do not cover: "
            "give each state a small disturbance of its own."
        )
    if (cost.n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {cost.n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, as the system has. Give its weights these sizes."
        )
