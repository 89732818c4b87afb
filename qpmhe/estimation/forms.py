"""The choice how an estimator holds matrices: whole, or by their entries."""

from __future__ import annotations

import numpy as np

from qpmhe_solvers.solver import ContainedSolver

from ..costs import Cost, QuadraticCost
from ..model.evaluation import Places
from ..model.system import System
from ..observers import Observer
from ..terms.entries import has_enough_states
from ..terms.forms import SparseForm, WholeForm
from ..terms.sum import further_terms
from .conditions import Conditions
from .settings import Settings


def form_for(
    system: System, observer: Observer, cost: Cost, settings: Settings, solver: ContainedSolver
) -> WholeForm:
    """By entries, where these are known and few and all that reads the matrices can take them."""
    form, model = None, system.evaluation
    sets = system.states, system.disturbances, system.noises, system.constraints, cost.space
    if (
        has_enough_states(system.n) and settings.qp_limit and solver.takes_sparse
        and not settings.restart and not further_terms(system, cost)
        and type(cost) is QuadraticCost and cost.observer_prior is None
        and all(one is None for one in (*sets, observer.initial_covariance()))
        and not observer.needs_jacobians and model.pattern is not None
        and (not system.has_timed or _are_same(model.pattern, system.timed.evaluation.pattern))
    ):
        form = SparseForm.of(model.pattern, cost, settings.horizon + 1)
    return form or WholeForm(system.n, system.p)


def have_form(form: WholeForm, *own: Conditions) -> bool:
    """Whether the weights of samples have a form."""
    return all(form.fits(one.noise_weight, one.disturbance_weight) for one in own)


def _are_same(one: Places, other: Places | None) -> bool:
    """Whether two patterns are the same."""
    return other is not None and all(map(np.array_equal, one, other))
