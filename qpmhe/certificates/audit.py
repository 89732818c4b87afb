"""The theorem's assumptions about cost, output and corrections, each examined alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, ShapeError
from ..model.system import System, checked_system
from ..observers import Observer
from .branch_and_bound import Cells, output_lipschitz
from .contraction import gain_if_constant
from .deadline import Deadline
from .enclosures import SmoothModel, evaluated
from .evidence import CertificateError, Evidence, json_ready
from .inequalities import Matrices, eigenvalue_bounds, norm_bound
from .regions import Region

_SAMPLES, _SEED = 500, 20210829
_MOST_CELLS, _CHUNK, _ROOM = 4000, 256, 1.01  # for L_f, and how far it may be above what was seen


@dataclass(frozen=True, eq=False)
class Assumption:
    """Whether an assumption of the theorem holds, and what that rests on.

    Parameters
    ----------
    name, label : str
        What it is called, and its label in the paper.
    holds : bool or None
        None where it is not examined in advance.
    evidence : Evidence or None
        What the answer rests on.
    text : str
        What was found, in words.
    value : float or None
        The constant: L_h or kappa in units of the system, or the cost's exponent.
    """

    name: str
    label: str
    holds: bool | None
    evidence: Evidence | None
    text: str
    value: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """The finding in types that JSON knows; numbers that are not finite become None."""
        content: dict[str, Any] = json_ready(vars(self))
        return content


def about_output(system: System, region: Region, deadline: Deadline) -> Assumption:
    """L_h, Assumption ass:lipschitz."""
    slope = output_lipschitz(system, region, seconds=deadline)
    return Assumption(
        "output Lipschitz", "ass:lipschitz", True, slope.evidence,
        f"L_h = {slope.value:.6g} ({slope.note}); the gradient has the norm "
        f"{slope.attained:.6g} at {np.round(slope.at, 4).tolist()}", slope.value,
    )


def about_model(system: System, region: Region, deadline: Deadline) -> Assumption:
    """L_f, which takes the place of kappa where the observer is projected."""
    model, n = SmoothModel(system, region), system.n
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))
    slopes = evaluated("the Jacobian of f", system.f_jacobian, points[:, :n], points[:, n:])
    seen = float(np.linalg.norm(slopes, 2, axis=(1, 2)).max())
    found = partial(Assumption, "model Lipschitz", "in place of eq:kappa", True)
    cells, proved = Cells(region), 0.0 if not model.reason else np.inf
    while len(cells.lower) and not model.reason:
        if cells.taken and (deadline.passed or cells.taken > _MOST_CELLS):
            proved = max(proved, float(cells.inherited.max()))
            break
        low, high = cells.take(_CHUNK)
        corners, error = model.enclose(low, high).corners()
        with np.errstate(all="ignore"):
            each = norm_bound(Matrices(
                corners[:, :, :n].reshape(-1, n, n), np.repeat(error[:, :n], corners.shape[1], 0)
            )).reshape(len(low), -1).max(axis=1)
        each = np.where(np.isnan(each), np.inf, each)
        left = ~(each <= _ROOM * seen)
        proved = max(proved, float(each[~left].max(initial=0.0)))
        cells.halve(low[left], high[left], np.zeros_like(low[left]), each[left])
    if np.isfinite(proved):
        text = f"L_f = {proved:.6g}, bounded on {cells.taken} cells, for the projected observer"
        return found(Evidence.PROVED, text, proved)
    return found(Evidence.SAMPLED, f"L_f = {seen:.6g}, the largest of {len(points)} Jacobians; "
                 f"{model.reason or 'no bound was found in time'}", seen)


def about_corrections(system: System, observer: Observer) -> tuple[Assumption, Assumption]:
    """Whether the observer corrects where the output fits, and how much elsewhere."""
    none = partial(Assumption, "no correction without error", "ass:observer_0")
    bound = partial(Assumption, "correction bound", "eq:kappa")
    gain = gain_if_constant(observer, system)
    if gain is not None:
        kappa = float(norm_bound(Matrices.exact(gain[None]))[0])
        return none(True, Evidence.PROVED, "L(z, v) = L v vanishes with v"), bound(
            True, Evidence.PROVED, f"kappa = |L| = {kappa:.6g}, of a constant gain", kappa
        )
    stated = f"{type(observer).__name__} has no constant gain: its constants are stated"
    return none(True, Evidence.ASSUMED, stated), bound(None, None, stated)


def about_cost(cost: Cost) -> tuple[CostConstants | None, Assumption]:
    """The cost's constants, rounded outward where they could be, Assumption ass:stagecosts."""
    found = partial(Assumption, "cost bounds", "ass:stagecosts")
    constants = cost.constants
    if constants is None:
        why = (
            f"the discount {cost.discount:.6g} makes the lower bounds shrink with a stage's age"
            if cost.discount < 1.0
            else "its ObserverPrior has no bounds; give it some, ObserverPrior(minimum, maximum)"
            if cost.observer_prior is not None and cost.observer_prior.bounds is None
            else "its terms are not bounded by powers with one exponent, above and below"
        )
        return None, found(False, Evidence.PROVED, f"the cost has no constants: {why}")
    evidence, stated = Evidence.ASSUMED, ", as the cost states them"
    if cost.quadratic:
        evidence, stated, (low, high) = Evidence.PROVED, "", constants.prior
        prior = (
            eigenvalue_bounds(cost.least_prior) if cost.observer_prior is None
            else (low * (1.0 - 1e-12), high * (1.0 + 1e-12))
        )
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
