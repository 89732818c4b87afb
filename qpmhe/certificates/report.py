"""What the command certifies of a model: where, for which sizes, with which observer."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..costs import Cost
from ..errors import OptionError, SetError
from ..estimation.estimator import MovingHorizonEstimator
from ..model.sets import Box, ConvexSet
from ..model.system import System
from ..models.scenario import Record, Scenario
from ..observers import Observer
from .certificate import Certificate, examined, horizons_of
from .contraction import certify_observer, synthesise_gain
from .deadline import Deadline
from .evidence import CertificateError, NotCertifiedError
from .monitor import Monitor
from .observer_bound import ObserverBound
from .properties import ObserverStability
from .regions import Region, bounded_region
from .sdp import started
from .sizes import Sizes, stated_size

# Without a region: the simulated states, with this share of their extent on each side.
_ROOM = 0.75
# How much of the time the choice of an observer may take.
_OBSERVER = 0.6
_QPS = 2  # a sample, in the run on the simulated record
# An estimator's options that may bar a guard.
_BARRING = ("candidate", "restart", "infeasible")


class Report(NamedTuple):
    """What was certified about a model, and its estimator's error on a simulated record."""

    certificate: Certificate
    simulated: str
    replaced: str  # which observer took the place of the model's own, and why
    tried: str  # why there is no gain made for the region, where one was looked for in vain
    guard: str = ""  # what a guard did on the record, or why there is none
    refused: bool = False  # whether a guard was asked for, and there is none


def certify_model(
    system: System, observer: Observer, cost: Cost, scenario: Scenario | None, *,
    horizon: Any, region: ConvexSet | None, inputs: Box | None, seed: int, seconds: float,
    max_disturbance: ArrayLike | None = None, max_noise: ArrayLike | None = None,
    guard: bool = False, options: Mapping[str, Any] = MappingProxyType({}),
) -> Report:
    """Certify a model as far as possible, and compare the bound with a simulated record.

    The model's options count where they bar a ``guard``.
    """
    deadline = started(seconds)
    record = None if scenario is None else scenario.simulate(seed)
    place = region_of(system, scenario, region, inputs, record=record)
    horizons = horizons_of(horizon)
    sizes = sizes_of(system, cost, scenario, max_disturbance, max_noise)
    observer, stability, replaced, tried = _proved_observer(
        system, observer, place, sizes, deadline.part(_OBSERVER)
    )
    certificate = examined(
        system, observer, cost, place, horizons, sizes, deadline, stability=stability
    )
    found, proved = Report(certificate, "", replaced, tried), certificate.observer_bound
    if proved is None:
        text = "there is no guard: there is no bound of the observer."
        return found._replace(guard=text if guard else "", refused=guard)
    if record is None and not guard:
        return found
    middle = place.sample(1, np.random.default_rng(seed))[0, : system.n]
    start = middle if scenario is None else scenario.initial_estimate
    own = {name: options[name] for name in _BARRING if guard and name in options}
    mhe = MovingHorizonEstimator(
        system, observer, cost, horizon=horizons[-1], initial_state=start, max_qps=_QPS,
        engine="python", **own,
    )
    if guard:
        try:
            watch = Monitor(
                proved, mhe, initial_error=0.0 if scenario is None else initial_error(scenario),
                guard=True,
            )
        except CertificateError as error:
            return found._replace(guard=str(error), refused=True)
        text = "there is one; it was not tried, as there is no record without a scenario"
        if record is not None:
            text = f"seed {seed}: {_guarded(watch, mhe, record)}"
        found = found._replace(guard=text)
    if scenario is not None and record is not None:
        mhe.reset()
        run = mhe.run(record.measurements, record.inputs, may_compile=False)
        band = proved.along(run, initial_error=initial_error(scenario))
        errors = np.linalg.norm(record.states - run.states, axis=1)
        held = np.isfinite(band.error)
        found = found._replace(simulated=(
            f"seed {seed}: the largest |x - x_hat| is {errors[held].max():.3g}, and the largest "
            f"bound {band.error[held].max():.3g}; {band}"
        ))
    return found


def _guarded(watch: Monitor, mhe: MovingHorizonEstimator, record: Record) -> str:
    """What a guard does on a record, in words."""
    inputs = [None] * len(record.measurements) if record.inputs is None else record.inputs
    errors = []
    for t, (y, u) in enumerate(zip(record.measurements, inputs, strict=True)):
        reading = watch.check(mhe.update(y, u), u)
        if reading.unguarded:
            return f"{watch.moved} of {t} estimates were moved; it is off {reading.unguarded}"
        errors.append(np.linalg.norm(record.states[t + 1] - reading.state))
    return (
        f"{watch.moved} of {len(errors)} estimates were moved; the largest |x - x_hat| is "
        f"{max(errors):.3g}"
    )


def _proved_observer(
    system: System, observer: Observer, region: Region, sizes: Sizes, deadline: Deadline
) -> tuple[Observer, ObserverStability | None, str, str]:
    """The observer or, where its bound says nothing, one with a gain made for the region; why.

    And why there is none, where one was looked for in vain.
    """
    widths, own = (region.upper - region.lower)[: system.n], None

    def limits(stability: ObserverStability) -> tuple[Any, bool]:
        bound = ObserverBound(stability, region, sizes).with_rows(system, deadline.part(0.5))
        limit = bound.settled.box
        return limit, bool((limit < widths)[widths > 0.0].all())

    try:
        own = certify_observer(
            system, observer, region, sizes=sizes.typical, seconds=deadline.part(0.5)
        )
        limit, says = limits(own)
        if says:
            return observer, own, "", ""
        why = f"its bound, {np.round(limit, 3).tolist()}, is vacuous in some state"
    except (NotCertifiedError, CertificateError) as error:
        why = str(error.args[0]).split(". ")[0].split(" What may help")[0]
    try:
        made = synthesise_gain(system, region, sizes=sizes.typical, seconds=deadline)
    except (NotCertifiedError, CertificateError) as error:
        return observer, own, "", str(error)
    if own is not None and not limits(made.stability)[1]:
        return observer, own, "", "the bound of the one found is vacuous, too"
    return made.observer, made.stability, (
        f"Luenberger({made.observer.gain.tolist()}, metric=P) with the certified P, made for the "
        f"region in place of the model's own: {why}"
    ), ""


def region_of(
    system: System, scenario: Scenario | None, region: ConvexSet | Region | None = None,
    inputs: Box | None = None, *, record: Record | None = None, option: str = "--box",
) -> Region:
    """The set that a model is certified on, and bounds on its inputs.

    What is left out is the scenario's; else the system's own X if that is bounded, or a box around
    the simulated record, and the box around its inputs. Errors name the region's ``option``.
    """
    if record is None and scenario is not None:
        record = scenario.simulate(0)
    if region is None and scenario is not None and scenario.region is not None:
        region, inputs = scenario.region, inputs or scenario.input_region
    bounded = inputs is not None or isinstance(region, Region)
    if not bounded and record is not None and record.inputs is not None:
        inputs = Box(record.inputs.min(axis=0), record.inputs.max(axis=0))
    if system.m and inputs is None and not isinstance(region, Region):
        raise OptionError(
            f"{option.replace('box', 'input-box')} is missing, and the model has no scenario with "
            f"inputs; give low:high for each of its {system.m} inputs: certificates hold only for "
            "inputs within bounds."
        )
    if region is not None:
        return bounded_region(system, region, inputs)
    if system.states is not None:
        try:
            return bounded_region(system, None, inputs)
        except SetError:
            pass  # not bounded: a box around the record bounds it
    if record is None or scenario is None:
        raise OptionError(
            f"{option} is missing, and the model has neither a bounded set of states nor a "
            "scenario to simulate; give the set in which the states stay."
        )
    points = np.vstack((record.states, scenario.initial_estimate))
    low, high = points.min(axis=0), points.max(axis=0)
    width = np.where(high > low, high - low, np.abs(high))
    room = _ROOM * np.where(width > 0.0, width, 1.0)
    around = Box(low - room, high + room)
    return bounded_region(
        system, around if system.states is None else system.states & around, inputs
    )


def sizes_of(
    system: System, cost: Cost, scenario: Scenario | None, disturbance: ArrayLike | None = None,
    noise: ArrayLike | None = None,
) -> Sizes:
    """The stated sizes, one number or one a component, or the usual ones.

    These are the system's W and V, or three standard deviations of the scenario's noises.
    """
    usual = Sizes.of(None, system, cost) if scenario is None else Sizes.usual(
        system, scenario.disturbance_covariance, scenario.noise_covariance, "the model's scenario"
    )
    if disturbance is None and noise is None:
        return usual
    w, v = usual.disturbance, usual.noise
    rest = disturbance is None or noise is None
    return Sizes(
        w if disturbance is None else stated_size("--max-disturbance", disturbance, system.r),
        v if noise is None else stated_size("--max-noise", noise, system.p),
        f"as stated and {usual.source}" if rest else "as stated", usual.deviations and rest,
    )


def initial_error(scenario: Scenario) -> Box:
    """Distance from the scenario's first state to its first estimate, in each component."""
    away = np.abs(scenario.initial_state - scenario.initial_estimate)
    return Box(-away, away)
