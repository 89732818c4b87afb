"""The theorem's assumptions about cost, output and corrections, each examined alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, ShapeError
from ..model.system import System, checked_system
from ..observers import Observer
from ..terms.sum import further_terms
from .branch_and_bound import lipschitz
from .contraction import gain_if_constant
from .deadline import Deadline
from .evidence import CertificateError, Evidence, at_most
from .inequalities import Matrices, eigenvalue_bounds, norm_bound
from .regions import Region


@dataclass(frozen=True, eq=False)
class Assumption:
    """Whether an assumption of the theorem holds, and the evidence for it.

    Parameters
    ----------
    name, label : str
        What it is called, and its label in the paper.
    holds : bool or None
        None where it is not examined in advance.
    evidence : Evidence or None
        The evidence for the answer.
    text : str
        What was found, in words.
    value : float or None
        The constant: L_h, L_f or kappa in units of the system, or the cost's exponent.
    """

    name: str
    label: str
    holds: bool | None
    evidence: Evidence | None
    text: str
    value: float | None = None


def about_slope(
    system: System, region: Region, function: Literal["f", "h"], deadline: Deadline
) -> Assumption:
    """L_h; or L_f, which replaces kappa where the observer is projected."""
    slope = lipschitz(system, region, function, deadline)
    name, label = {
        "h": ("output Lipschitz", "ass:lipschitz"), "f": ("model Lipschitz", "in place of eq:kappa")
    }[function]
    text = f"L_{function} = {at_most(slope.value, 6)}, {slope.note}"
    return Assumption(name, label, True, slope.evidence, text, slope.value)


def about_corrections(system: System, observer: Observer) -> tuple[Assumption, Assumption]:
    """Whether the observer corrects where the output fits, and how much elsewhere."""
    none = partial(Assumption, "no correction without error", "ass:observer_0")
    bound = partial(Assumption, "correction bound", "eq:kappa")
    gain = gain_if_constant(observer, system)
    if gain is None:
        stated = f"{type(observer).__name__} has no constant gain: its constants are stated"
        return none(True, Evidence.ASSUMED, stated), bound(None, None, stated)
    kappa = float(norm_bound(Matrices.exact(gain[None]))[0])
    return none(True, Evidence.PROVED, "L(z, v) = L v vanishes with v"), bound(
        True, Evidence.PROVED, f"kappa = |L| = {at_most(kappa, 6)}, of a constant gain", kappa
    )


def about_cost(cost: Cost, observer: Observer) -> tuple[CostConstants | None, Assumption]:
    """The cost's constants, rounded outward where they could be, Assumption ass:stagecosts."""
    covariance, rule = observer.initial_covariance(), cost.observer_prior
    found = partial(Assumption, "cost bounds", "ass:stagecosts")
    constants = cost.constants_with(covariance)
    evidence, stated = Evidence.ASSUMED, ", as the cost states them"
    if constants is None:
        why = (
            f"the discount {cost.discount:.6g} makes the lower bounds shrink with a stage's age"
            if cost.discount < 1.0
            else f"its prior's weight comes from the observer's covariance, and "
            f"{type(observer).__name__} has none; give a weight, prior="
            if rule is not None and covariance is None
            else f"its prior's weight is relative to the initial covariance of "
            f"{type(observer).__name__}, which is singular; give it a regular one"
            if rule is not None and not cost.least_prior(covariance).any()
            else "its terms are not bounded by powers with one exponent, above and below"
        )
        return None, found(False, Evidence.PROVED, f"the cost has no constants: {why}")
    if cost.quadratic:
        evidence, stated = Evidence.PROVED, ""
        low, high = eigenvalue_bounds(cost.initial_weight(covariance))
        # The weight itself keeps twice the distance from the upper bound: rounding is within it.
        prior = (low, high) if rule is None else (low / rule.kappa, high * rule.kappa)
        constants = CostConstants(
            constants.exponent, prior, eigenvalue_bounds(cost.disturbance),
            eigenvalue_bounds(cost.noise),
        )
    terms = ", ".join(
        f"c_{letter} in [{low:.6g}, {high:.6g}]"
        for letter, (low, high) in zip(
            "pwv", (constants.prior, constants.disturbance, constants.noise), strict=True,
        )
    )
    text = f"a = {constants.exponent:.6g}, {terms}{stated}"
    return constants, found(True, evidence, text, constants.exponent)


def checked_ingredients(system: Any, observer: Any, cost: Any) -> None:
    """Check that system, observer and cost go together, and that the theorem covers them."""
    checked_system(system)
    if system.extensions:
        raise CertificateError(
            f"the system has {' and '.join(system.extensions)}, which the theorem does not cover; "
            "certify the system without them."
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
            "disturbance; expected a disturbance of each state. Certificates do not cover "
            "corrections that are no such disturbances, whose constants grow with the horizon: "
            "give each state its own small disturbance."
        )
    if (cost.n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {cost.n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, as the system has. Give its weights these sizes."
        )
    further = further_terms(system, cost)
    if further:
        raise CertificateError(
            f"J has a term for {further}, which the theorem does not cover; certify the system and "
            "the cost without it."
        )
