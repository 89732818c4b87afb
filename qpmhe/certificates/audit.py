"""The theorem's assumptions, each examined alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array, record, vector
from ..costs import Cost, CostConstants
from ..errors import InvalidInputError, ModelError, ShapeError
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..models.scenario import Record
from ..observers import Observer, Sample
from .branch_and_bound import output_lipschitz
from .deadline import PART_SECONDS, Deadline
from .evaluation import evaluated
from .evidence import Evidence
from .inequalities import Matrices, eigenvalue_bounds, norm_bound
from .observer import gain_if_constant
from .regions import Region, bounded_region

__all__ = ["Audit", "Finding", "audit", "checked_ingredients"]

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
        """The finding in types that JSON knows; numbers that are not finite as text."""
        return {
            "name": self.name, "label": self.label, "holds": self.holds, "needed": self.needed,
            "evidence": None if self.evidence is None else self.evidence.value,
            "text": self.text, "value": _plain(self.value),
            "counterexample": {key: _plain(value) for key, value in self.counterexample.items()},
        }


def _plain(value: Any) -> Any:
    """Numbers that JSON knows, and the names of those that it does not."""
    if isinstance(value, np.ndarray):
        return [_plain(each) for each in value.tolist()]
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def _lipschitz_finding(
    system: System, region: Region, seconds: float | Deadline = PART_SECONDS
) -> Finding:
    """The output's Lipschitz constant."""
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


def _no_correction_finding(system: System, observer: Observer, region: Region) -> Finding:
    """Whether the observer corrects where the output fits."""
    found = partial(Finding, "no correction without error", "ass:observer_0")
    if gain_if_constant(observer, system) is not None:
        return found(True, Evidence.PROVED, "L(z, v) = L v vanishes with v")
    correction = _correction(system, observer)
    if correction is None:
        return found(
            True, Evidence.ASSUMED,
            f"{type(observer).__name__} multiplies v by its gain of the moment",
        )
    points = region.sample(_SAMPLES, np.random.default_rng(_SEED))[:, : system.n]
    for z in points:
        value = correction(z, np.zeros(system.p))
        if value.any():
            return found(
                False, Evidence.PROVED,
                f"L(z, 0) = {value.tolist()} at z = {z.tolist()}", None, {"z": z, "L": value},
            )
    return found(True, Evidence.SAMPLED, f"L(z, 0) = 0 at {points.shape[0]} states")


def _kappa_finding(
    system: System, observer: Observer, region: Region, run: _ObserverRun | None
) -> Finding:
    """The bound on the correction."""
    found = partial(Finding, "correction bound", "eq:kappa")
    gain = gain_if_constant(observer, system)
    if gain is not None:
        kappa = float(norm_bound(Matrices.exact(gain[None]))[0])
        return found(True, Evidence.PROVED, f"kappa = |L| = {kappa:.6g}, of a constant gain", kappa)
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
        return found(
            None, None,
            f"{type(observer).__name__} has a gain that follows from what was measured: pass a "
            "run to see how large it gets",
        )
    if not np.isfinite(worst):
        return found(False, Evidence.SAMPLED, f"kappa is infinite: {how}")
    return found(True, Evidence.SAMPLED, f"kappa = {worst:.6g}, {how}", worst)


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
    lost = ~np.isfinite(following).all(axis=1)
    if lost.any():
        k = int(np.argmax(lost))
        return found(
            False, Evidence.PROVED,
            f"f is not finite: {following[k].tolist()} at x = {x[k].tolist()}"
            + (f", u = {u[k].tolist()}" if system.m else ""),
            None, {"x": x[k], "f(x)": following[k]} | ({"u": u[k]} if system.m else {}),
        )
    if system.states is None:
        return found(True, Evidence.PROVED, "X is the whole space")
    missed = np.array([system.states.violation(one) for one in following])
    worst = int(missed.argmax())
    if missed[worst] == 0.0:
        return found(
            True, Evidence.SAMPLED,
            f"f(x) is in X for {x.shape[0]} states x of X in the region",
        )
    counterexample: dict[str, Any] = {
        "x": x[worst], "f(x)": following[worst], "missed by": float(missed[worst])
    }
    if system.m:
        counterexample["u"] = u[worst]
    return found(
        False, Evidence.PROVED,
        f"f leaves X from {x[worst].tolist()}, which is in it, to {following[worst].tolist()}: by "
        f"{missed[worst]:.6g}; the disturbance must then lead back",
        None, counterexample,
    )


def _candidate_finding(system: System, region: Region, run: _ObserverRun | None) -> Finding:
    """Whether the candidate lies in X, W and V along a run."""
    found = partial(Finding, "candidate in the sets", "ass:observer")
    sets = (("X", "z", system.states), ("W", "L", system.disturbances), ("V", "v_z", system.noises))
    if all(one is None for _, _, one in sets):
        return found(
            True, Evidence.PROVED, "X, W and V are the whole space"
            + ("" if run is None else f"; {_within(region, run)}"),
        )
    if run is None:
        return found(None, None, "pass a run, to check the candidate along it")
    outside: list[str] = []
    counterexample: dict[str, Any] = {}
    for letter, symbol, one in sets:
        if one is None:
            continue
        values = {"z": run.states, "L": run.corrections, "v_z": run.noises}[symbol]
        missed = np.array([one.violation(value) for value in values])
        if missed.max() > 0.0:
            t = int(np.argmax(missed > 0.0))
            outside.append(
                f"{symbol}({t}) = {values[t].tolist()} is not in {letter}, by {missed[t]:.6g}; it "
                f"is outside {int((missed > 0.0).sum())} times of {missed.size}"
            )
            counterexample = counterexample or {
                "t": t, symbol: values[t], "missed by": float(missed[t])
            }
    if outside:
        return found(False, Evidence.PROVED, ". ".join(outside), None, counterexample)
    return found(
        True, Evidence.SAMPLED,
        f"z, L and v_z are in X, W and V on a run of {run.noises.shape[0]} samples; "
        f"{_within(region, run)}",
    )


def _within(region: Region, run: _ObserverRun) -> str:
    inside = region.contains(run.states)
    if inside.all():
        return "the observer stays in the region on the run"
    t = int(np.argmin(inside))
    return f"the observer leaves the region: z({t}) = {run.states[t].tolist()}"


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
    system: System, observer: Observer, cost: Cost, region: ConvexSet | Region | None = None,
    run: Record | ArrayLike | None = None, *, initial_state: ArrayLike | None = None,
    inputs: Box | None = None, seconds: float | Deadline = PART_SECONDS,
) -> Audit:
    """Check each assumption of the theorem, and show where it fails.

    Parameters
    ----------
    system, observer, cost, region, inputs
        As for `certify`.
    run : Record or (T, p) array_like, optional
        A record, simulated or measured, along which the candidate is checked; a record with
        inputs is needed for a system with inputs.
    initial_state : (n,) array_like, optional
        z(0) of that run; needed with it.
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
    constants, about_cost = _cost_finding(cost)
    findings = (
        _lipschitz_finding(system, place, deadline),
        _no_correction_finding(system, observer, place),
        _kappa_finding(system, observer, place, observed),
        about_cost,
        _invariance_finding(system, place),
        _candidate_finding(system, place, observed),
    )
    return Audit(findings, constants, place)


def _observed(
    system: System, observer: Observer, run: Record | ArrayLike | None,
    initial_state: ArrayLike | None,
) -> _ObserverRun | None:
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
    return _observe(system, observer, start, measured, used)


@dataclass(frozen=True, eq=False)
class _ObserverRun:
    """What the observer did."""

    states: Array  # (T + 1, n): z(0), ..., z(T)
    corrections: Array  # (T, n): L(t)
    noises: Array  # (T, p): v_z(t)


def _observe(
    system: System, observer: Observer, initial_state: Array, y: Array, u: Array
) -> _ObserverRun:
    """Run an observer on complete measurements, (eq:observer)."""
    observer.check(system, initial_state)
    steps = y.shape[0]
    states = np.empty((steps + 1, system.n))
    corrections, noises = np.empty((steps, system.n)), np.empty((steps, system.p))
    states[0], covariance = initial_state, observer.initial_covariance()
    with np.errstate(all="ignore"):
        for t in range(steps):
            z = states[t]
            try:
                noises[t] = y[t] - system.h(z, u[t])
                sample = Sample(system, u[t], covariance=covariance)
                if observer.needs_jacobians:
                    sample.f_jacobian = system.f_jacobian(z, u[t])
                    sample.h_jacobian = system.h_jacobian(z, u[t])
                corrections[t], covariance = observer.correct(z, noises[t], sample)
                states[t + 1] = system.f(z, u[t]) + corrections[t]
            except Exception as error:  # a user's function may raise anything
                raise ModelError(
                    f"the model or the observer raises {type(error).__name__} along the run, at "
                    f"z({t}) = {z.tolist()}: {error}. Leave the run out, or make the model defined "
                    "there."
                ) from error
    return _ObserverRun(states, corrections, noises)


def checked_ingredients(system: Any, observer: Any, cost: Any) -> None:
    """Check that system, observer and cost go together."""
    checked_system(system)
    if not isinstance(observer, Observer):
        raise InvalidInputError(
            f"observer is {observer!r}; expected an observer, such as qpmhe.Luenberger(gain)."
        )
    if not isinstance(cost, Cost):
        raise InvalidInputError(
            f"cost is {cost!r}; expected a cost, such as qpmhe.QuadraticCost(prior=..., "
            "disturbance=..., noise=...)."
        )
    if (cost.n, cost.p) != (system.n, system.p):
        raise ShapeError(
            f"the cost is for {cost.n} states and {cost.p} outputs; expected {system.n} and "
            f"{system.p}, as the system has. Give its weights these sizes."
        )
