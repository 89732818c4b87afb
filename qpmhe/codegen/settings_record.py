"""The numbers and options of an estimator in C."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._linalg import inverse
from ..costs import Cost, LossForm
from ..errors import OptionError
from ..estimation.conditions import USUAL, Conditions
from ..estimation.settings import Settings
from ..model.sets import ConvexSet
from ..model.system import System
from ..terms.prior import PriorWeights
from ..terms.rows import Rows
from .directions import Directions
from .layout import LOSSES, SET_NAMES, TERMS, Layout, numbers_of

_MOST = int(np.iinfo(np.int32).max)
_PROJECTIONS = (None, "observer", "diagonal")


def settings_record(
    layout: Layout, directions: Directions, system: System, cost: Cost, settings: Settings,
    usual: Conditions = USUAL,
) -> NDArray[Any]:
    """The estimator's data and options as one ``mhe_settings``.

    System and cost, which is that of d, are those of the usual conditions.
    """
    # What single precision cannot hold becomes infinite, and is refused below.
    with np.errstate(over="ignore", under="ignore"):
        record = _filled(layout, directions, system, cost, settings, usual)
    given = [(name, record[name]) for name in (
        "prior_weight", "disturbance_weight", "noise_weight"
    )]
    if "observer" in (record.dtype.names or ()):
        own = record["observer"]
        given += [(name, own[name]) for name in own.dtype.names or ()]
    if layout.covariance:
        own = record["covariances"]
        given += [(f"observer's {name}", own[name]) for name in own.dtype.names or ()]
    if layout.constraints:
        factor = record["constraints"]["factor"]
        with np.errstate(divide="ignore"):
            given.append(("unit of constraints", np.append(factor, 1 / factor)))
    for name, numbers in given:
        if not np.isfinite(numbers).all():
            raise OptionError(
                f"{name.replace('_', ' ')} has entries beyond the range of real={layout.real!r}; "
                "take 'double', or other units."
            )
    return record


def _filled(
    layout: Layout, directions: Directions, system: System, cost: Cost, settings: Settings,
    usual: Conditions,
) -> NDArray[Any]:
    record, observer = np.zeros((), layout.settings_type()), directions.observer
    form, single = cost.c_form, layout.real == "float"
    assert form is not None
    record["discount"] = form.discount
    for name, loss in zip(TERMS, form.losses, strict=True):
        _fill(record, f"{name}_weight", getattr(form, name))
        part = record[f"{name}_loss"]
        part["kind"], part["parameter"] = _loss_number(name, loss), loss.parameter
        part["per_component"], part["graduation"] = loss.per_component, loss.graduation
    for name, residual in (("output", system.output_residual), ("state", system.state_residual)):
        if residual is not None and residual.periods is not None:
            periods = record[f"{name}_periods"]
            periods[residual.components] = residual.periods
    record["turn_middle"] = np.inf if system.turns is None else system.turns.middle
    record["noise_deviations"] = np.sqrt(inverse(form.noise).diagonal())
    record["sample_time"] = system.dt or 0.0
    # Single precision distinguishes less.
    record["tolerance"] = max(settings.tolerance, 1e-6 if single else 0.0)
    record["solver_tolerance"] = max(settings.solver_tolerance, 1e-4 if single else 0.0)
    initial = cost.initial_weight(observer.initial_covariance())
    prior = PriorWeights(system, observer, cost)
    regular = prior(observer.initial_covariance()).distance
    weights = form.disturbance, form.noise, regular
    for name, weight in zip(SET_NAMES, weights, strict=True):
        one: ConvexSet | None = system.set_of(name)
        if name == "disturbances" and cost.space is not None:
            _fill_rows(record[name], directions.rows_of(system, cost))
            continue
        if one is None:
            continue
        part, scaled = record[name], Rows(name, one, inverse(weight))
        for kind, values in (("scale", scaled.scale), ("deviation", scaled.deviation)):
            part[kind], part[f"row_{kind}"] = 1.0, 1.0
            part[kind][scaled.components] = values[: scaled.bounds]
            part[f"row_{kind}"][: one.matrix.shape[0]] = values[scaled.bounds :]
        part["lower"], part["upper"] = one.lower, one.upper
        rows = one.matrix.shape[0]
        part["rows"][: one.matrix.size] = one.matrix.ravel()
        part["row_lower"][:rows], part["row_upper"][:rows] = one.row_lower, one.row_upper
    terms = directions.terms_of(system, cost) if layout.terms else ()
    judged = layout.restarts * layout.horizon
    numbers = numbers_of(directions, system, cost, terms, layout.real, usual, judged)
    for name, data in numbers.items():
        for field, values in data.items():
            _fill(record[name], field, values)
    record["inner_lower"], record["inner_upper"] = system.f_jacobian.inner
    record["aside"] = system.f_jacobian.aside
    if system.states is not None:
        metric = observer.metric
        record["metric"] = inverse(initial if metric is None else metric).ravel()
        record["metric_weight"] = initial.ravel()
        record["metric_settled"] = metric is not None or layout.covariance
    record["project"] = _PROJECTIONS.index(settings.projection)
    record["max_qps"] = min(settings.qp_limit, _MOST)
    record["uncapped"], record["patience"] = settings.max_qps is None, settings.patience
    most = settings.max_solver_iterations
    record["max_iterations"] = 0 if settings.backend == "banded" else min(most or 50, _MOST)
    record["start_at_best"] = settings.warm_start
    record["reinitialize"] = settings.candidate == "reinitialized"
    record["smooth"] = settings.arrival == "smoothed"
    if layout.clock:
        record["time_budget"] = settings.time_budget
    return record


def _loss_number(term: str, loss: LossForm) -> int:
    return LOSSES.index(loss.kind) if loss.kind in LOSSES else len(LOSSES) + TERMS.index(term)


def _fill_rows(part: Any, rows: Rows | None) -> None:
    """Fill in the rows on d in place of the set W."""
    part["lower"], part["upper"] = -np.inf, np.inf
    for kind in ("scale", "deviation", "row_scale", "row_deviation"):
        part[kind] = 1.0
    if rows is not None:
        part["rows"][: rows.matrix.size] = rows.matrix.ravel()
        for name, values in (
            ("lower", rows.lower), ("upper", rows.upper), ("scale", rows.scale),
            ("deviation", rows.deviation), ("fixed", rows.fixed),
        ):
            part[f"row_{name}"][: values.size] = values


def _fill(record: NDArray[Any], name: str, value: NDArray[Any] | None) -> None:
    """Fill a field where there is something to fill in."""
    if value is not None and value.size:
        record[name] = value.ravel()
