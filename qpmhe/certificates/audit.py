"""The theorem's assumptions, each examined alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..observers import Observer, Sample
from .branch_and_bound import output_lipschitz
from .contraction import gain_if_constant
from .deadline import PART_SECONDS, Deadline
from .enclosures import evaluated
from .evidence import CertificateError, Evidence, json_ready
from .inequalities import Matrices, eigenvalue_bounds, norm_bound
from .regions import Region, bounded_region

_SAMPLES = 2000
_SEED = 20210829
_SETS = "candidate in the sets"
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

    @property
    def needed(self) -> bool:
        """Whether the bounds rest on it: they rest on no set, but hold for any w and v."""
        return self.name != _SETS

    def to_dict(self) -> dict[str, Any]:
        """The finding in types that JSON knows; numbers that are not finite become None."""
        content: dict[str, Any] = json_ready(vars(self) | {"needed": self.needed})
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
            None, None, f"{kind} has a gain that follows from what was measured: state its bound, "
            "ObserverStability.assumed(kappa=...)",
        )
    generator, sample = np.random.default_rng(_SEED), Sample(system, np.zeros(system.m))
    points = region.sample(_SAMPLES, generator)
    states = points[:, : system.n]
    size = np.ptp(evaluated("h", system.h, states, points[:, system.n :]), axis=0)
    scales = generator.choice(_SCALES, (len(states), 1)) * np.where(size > 0.0, size, 1.0)
    errors = scales * generator.uniform(-1.0, 1.0, (len(states), system.p))
    with np.errstate(all="ignore"):
        still, moved = (
            np.stack([
                np.array(observer.correct(z, v, sample)[0], np.float64)
                for z, v in zip(states, each, strict=True)
            ])
            for each in (np.zeros_like(errors), errors)
        )
        ratios = np.linalg.norm(moved, axis=1) / np.linalg.norm(errors, axis=1)
    unmoved = none(True, Evidence.SAMPLED, f"L(z, 0) = 0 at {len(states)} states")
    if still.any():
        k = int(still.any(axis=1).argmax())
        text = f"L(z, 0) = {still[k].tolist()} at z = {states[k].tolist()}"
        unmoved = none(False, Evidence.PROVED, text)
    k = int(np.where(np.isfinite(ratios), ratios, np.inf).argmax())
    kappa, where = float(ratios[k]), f"z = {states[k].tolist()}, v = {errors[k].tolist()}"
    how = f"the largest |L(z, v)| / |v| tried, at {where}"
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


@dataclass(frozen=True, eq=False)
class Audit:
    """All assumptions but detectability and the observer's stability, one a finding.

    The cost's constants are rounded outward where possible, and None where there are none.
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

    Arguments and errors are as for `certify`; ``seconds`` bounds the time for the output's
    Lipschitz constant. An assumption that does not hold raises nothing.
    """
    checked_ingredients(system, observer, cost)
    where = bounded_region(system, region, inputs)
    points = where.sample(_SAMPLES, np.random.default_rng(_SEED))
    evaluated("f", system.f, points[:, : system.n], points[:, system.n :])  # an error if it raises
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
        Finding(_SETS, "ass:observer", *candidate),
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
