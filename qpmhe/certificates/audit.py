"""The theorem's assumptions for a system with observer and cost on a region."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import record, vector
from ..costs import Cost, CostConstants
from ..errors import InvalidInputError
from ..models.scenario import Record
from ..observers import Observer
from ..sets import Box, ConvexSet
from ..system import System
from .arguments import checked_ingredients
from .assumptions import (
    Finding,
    candidate_finding,
    cost_finding,
    invariance_finding,
    kappa_finding,
    lipschitz_finding,
    no_correction_finding,
)
from .deadline import PART_SECONDS, Deadline
from .regions import Region, bounded_region
from .simulation import ObserverRun, observe

__all__ = ["Audit", "Finding", "audit"]


@dataclass(frozen=True, eq=False)
class Audit:
    """All assumptions but detectability and the observer's stability.

    Parameters
    ----------
    findings : tuple of Finding
        One for each.
    constants : CostConstants or None
        Those of the cost, rounded outward where they could be.
    region : Region
        Where.
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
    def lipschitz(self) -> float | None:
        """L_h."""
        return self["output Lipschitz"].value

    @property
    def kappa(self) -> float | None:
        """The constant of (eq:kappa)."""
        return self["correction bound"].value

    @property
    def violated(self) -> tuple[Finding, ...]:
        """The findings with a counterexample, or without constants."""
        return tuple(finding for finding in self.findings if finding.holds is False)

    def to_dict(self) -> list[dict[str, Any]]:
        """The findings in types that JSON knows."""
        return [finding.to_dict() for finding in self.findings]


def audit(
    system: System,
    observer: Observer,
    cost: Cost,
    region: ConvexSet | Region | None = None,
    run: Record | ArrayLike | None = None,
    *,
    initial_state: ArrayLike | None = None,
    inputs: Box | None = None,
    seconds: float | Deadline = PART_SECONDS,
) -> Audit:
    r"""Look at each assumption of the theorem, and show where it fails.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    region : Box, Polytope or Region, optional
        A bounded set of states; that of the system if left out.
    run : Record or (T, p) array_like, optional
        A record, simulated or measured, along which the candidate is checked; a record with
        inputs is needed for a system with inputs.
    initial_state : (n,) array_like, optional
        z(0) of that run; needed with it.
    inputs : Box, optional
        Bounds on the inputs, of a system that has any.
    seconds : float or Deadline
        How long the output's Lipschitz constant may take, about.

    Raises
    ------
    SetError, ShapeError, InvalidInputError, ModelError
        If an argument does not fit, or f or h raises in the region, or h is not finite. An
        assumption that does not hold raises nothing.
    """
    checked_ingredients(system, observer, cost)
    deadline = Deadline.of(seconds)
    place = bounded_region(system, region, inputs)
    observed = _observed(system, observer, run, initial_state)
    constants, about_cost = cost_finding(cost)
    findings = (
        lipschitz_finding(system, place, deadline),
        no_correction_finding(system, observer, place),
        kappa_finding(system, observer, place, observed),
        about_cost,
        invariance_finding(system, place),
        candidate_finding(system, place, observed),
    )
    return Audit(findings, constants, place)


def _observed(
    system: System, observer: Observer, run: Record | ArrayLike | None,
    initial_state: ArrayLike | None,
) -> ObserverRun | None:
    if run is None:
        return None
    if initial_state is None:
        raise InvalidInputError(
            "initial_state is missing; expected z(0), where the observer starts on the run."
        )
    y, u = (run.measurements, run.inputs) if isinstance(run, Record) else (run, None)
    if u is None and system.m:
        raise InvalidInputError(
            "the run has no inputs, but the system does; pass a record with inputs."
        )
    measured = record("run", y, system.p)
    used = np.empty((measured.shape[0], 0)) if u is None else record("inputs", u, system.m)
    start = vector("initial_state", initial_state, system.n)
    return observe(system, observer, start, measured, used)
