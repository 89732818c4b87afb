"""``qpmhe certify``: which of the theorem's assumptions hold for a model, and what follows."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ..certificates.certificate import Certificate
from ..certificates.certification import certify as make
from ..certificates.choices import Sizes
from ..certificates.errors import CertificateError, NotCertifiedError
from ..certificates.report import LABELS, error_and_bounds
from ..certificates.hypotheses import NEEDED, UNNEEDED, MonitorSummary
from ..certificates.monitor import monitored_run
from ..certificates.sdp import started
from ..certificates.regions import Region, bounded_region
from ..certificates.properties import Detectability, ObserverStability
from ..certificates.telling import ASSUMED, region_dict
from ..errors import InvalidInputError, OptionError, SetError
from ..estimator import MovingHorizonEstimator
from ..models import Example
from ..models.scenario import Record
from ..plots import save
from ..sets import Box
from ..studies.sources import find, load
from .certify_failure import Remainder
from .certify_tables import assumptions_table, bounds_table, ingredients_table

__all__ = ["certify"]

Array = np.ndarray[Any, np.dtype[np.float64]]

# Without --box: the simulated states, with this share of their extent on each side.
_ROOM = 0.5
_SIGMAS = 3.0


def certify(
    console: Console,
    model: str,
    box: str | None = None,
    horizon: str | None = None,
    report: Path | None = None,
    *,
    input_box: str | None = None,
    seed: int = 0,
    seconds: float = 60.0,
) -> bool:
    """Audit a model, certify what can be, and show it.

    Parameters
    ----------
    console : rich.console.Console
        Where to print.
    model : str
        Name of the catalogue, ``package.module:function`` or ``file.py:function``.
    box : str, optional
        The set of states: ``low:high`` of each component between commas, such as
        ``0.1:9,-1:9``; left out, the model's own if bounded, or one about a simulated record.
    horizon : str, optional
        N, or several between commas; left out, the model's own.
    report : Path, optional
        JSON file of everything; the picture goes beside it, as PNG and SVG.
    input_box : str, optional
        Bounds on the inputs, in the same form; left out, those of the simulated record.
    seed : int
        Of the simulated record.
    seconds : float
        After about this long, what was found is told.

    Returns
    -------
    bool
        Whether the error could be bounded.

    Raises
    ------
    QpmheError
        If an option, the model or the set does not fit.
    """
    horizons, deadline = _horizons(horizon), started(seconds)
    if report is not None:
        _check_report(report)  # before any work
    example = load(find(model))
    record = example.scenario.simulate(seed)
    region = _region(example, record, box, input_box)
    sizes = _sizes(example)
    console.print(f"[bold]{example.scenario.title or model}[/], on {_words(region)}",
                  highlight=False)
    told: dict[str, Any] = {"model": model, "certified": False, "region": region_dict(region)}

    def attempt(share: float, **parts: Any) -> Certificate:
        with console.status("looking for matrices, and verifying them"):
            return make(
                example.system, example.observer, example.cost,
                horizon=horizons or [example.scenario.horizon], region=region, sizes=sizes,
                run=record, initial_state=example.scenario.initial_estimate,
                seconds=deadline.part(share), **parts,
            )

    try:
        certificate = attempt(0.5)
    except (NotCertifiedError, CertificateError) as error:
        rest = Remainder.of(example, region, record, error, deadline)
        found = None if rest.failures else _from_parts(attempt, rest)
        if found is None:
            rest.show(console)
            _write_json(console, report, told | rest.to_dict())
            return False
        certificate = found
    console.print(assumptions_table(certificate.audit))
    console.print(ingredients_table(*_used(certificate)))
    console.print(bounds_table(certificate))
    summary = _picture(console, example, certificate, record, report)
    console.print(f"Simulated record, seed {seed}: {summary}", highlight=False)
    console.print(
        f"The bounds need: {', '.join(NEEDED)}. Told only: {', '.join(UNNEEDED)}.".replace(
            "_", " "), highlight=False,
    )
    for text in ASSUMED:
        console.print(f"Assumed: {text}.", highlight=False)
    told |= {
        "certified": True, "monitor": str(summary), "monitored": summary.to_dict(),
    } | certificate.to_dict()
    _write_json(console, report, told)
    return True


def _from_parts(attempt: Callable[..., Certificate], rest: Remainder) -> Certificate | None:
    """The certificate of parts that were found by themselves, where that is enough."""
    try:
        return attempt(1.0, detectability=rest.detected, stability=rest.observed)
    except (NotCertifiedError, CertificateError):
        return None


def _used(certificate: Certificate) -> tuple[Detectability, ObserverStability]:
    """What the theorem's constants for the first horizon are made of."""
    paper = certificate.of(certificate.horizons[0]).paper
    return (
        min(certificate.detectabilities, key=lambda one: abs(one.eta - paper.detectability.rate)),
        # Its constants may be those of a slower rate than the proved one.
        min(
            certificate.stabilities,
            key=lambda one: (one.C_p != paper.observer.initial, one.rho > paper.observer.rate),
        ),
    )


def _horizons(text: str | None) -> list[int]:
    if text is None:
        return []
    try:
        found = [int(item) for item in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) < 1:
        raise OptionError(f"--horizon is {text!r}; expected integers >= 1 between commas.")
    return found


def _box(option: str, text: str, width: int, kind: str) -> Box:
    pairs = [item.split(":") for item in text.split(",")]
    try:
        if len(pairs) != width or any(len(pair) != 2 for pair in pairs):
            raise ValueError("the number of components")
        low, high = zip(*[(float(a), float(b)) for a, b in pairs], strict=True)
    except ValueError as error:
        raise OptionError(
            f"{option} is {text!r}; expected low:high for each of {width} {kind}, between "
            "commas, as in 0.1:9,-1:9."
        ) from error
    return Box(low, high)


def _region(
    example: Example, record: Record, box: str | None, input_box: str | None
) -> Region:
    system = example.system
    inputs = None
    if input_box is not None:
        inputs = _box("--input-box", input_box, system.m, "inputs")
    elif record.inputs is not None:
        inputs = Box(record.inputs.min(axis=0), record.inputs.max(axis=0))
    if box is not None:
        return bounded_region(system, _box("--box", box, system.n, "states"), inputs)
    if system.states is not None:
        try:
            return bounded_region(system, None, inputs)
        except SetError:
            pass  # not bounded: what the record fills is
    low, high = record.states.min(axis=0), record.states.max(axis=0)
    start = example.scenario.initial_estimate
    low, high = np.minimum(low, start), np.maximum(high, start)
    room = _ROOM * np.maximum(high - low, 1e-6)
    around = Box(low - room, high + room)
    return bounded_region(
        system, around if system.states is None else system.states & around, inputs
    )


def _sizes(example: Example) -> Sizes:
    """Three standard deviations of the scenario's noises, and its initial error."""
    scenario = example.scenario
    w, v = (
        _SIGMAS * float(np.sqrt(np.linalg.eigvalsh(matrix)[-1]))
        for matrix in (scenario.disturbance_covariance, scenario.noise_covariance)
    )
    return Sizes(
        float(np.linalg.norm(scenario.initial_state - scenario.initial_estimate)), w, v
    )


def _words(region: Region) -> str:
    parts = [
        f"{'x' if j < region.n else 'u'}{(j if j < region.n else j - region.n) + 1} in "
        f"[{low:.4g}, {high:.4g}]"
        for j, (low, high) in enumerate(zip(region.lower, region.upper, strict=True))
    ]
    return ", ".join(parts) + ("" if region.is_box else ", and general inequalities")


def _picture(
    console: Console, example: Example, certificate: Certificate, record: Record,
    report: Path | None,
) -> MonitorSummary:
    """Run the estimator on the record, watch it, and draw error and bounds."""
    system, scenario = example.system, example.scenario
    N = certificate.horizons[-1]
    mhe = MovingHorizonEstimator(
        system, example.observer, example.cost, horizon=N,
        initial_state=scenario.initial_estimate, max_qps=2,
    )
    run, summary = monitored_run(certificate, mhe, record.measurements, record.inputs)
    if report is not None:
        steps = len(record.measurements)
        u = np.zeros((steps, 0)) if record.inputs is None else record.inputs
        w = record.states[1:] - system.f.batch(record.states[:-1], u)
        v = record.measurements - system.h.batch(record.states[:-1], u)
        bounds = {
            LABELS[kind]: certificate.bound(
                run, w, v, initial_error=record.states[0] - run.states[0], kind=kind, source=mhe
            )
            for kind in certificate.kinds
        }
        axes = error_and_bounds(
            scenario.dt * np.arange(steps + 1.0),
            np.linalg.norm(record.states - run.states, axis=1), bounds,
            diameter=certificate.diameter, time_label=f"time t ({scenario.time_unit})",
            error_label=f"error, N = {N}, 2 QPs a sample",
        )
        for path in save(axes.get_figure(), report.with_suffix("")):
            console.print(f"wrote {path}", highlight=False)
    return summary


def _check_report(report: Path) -> None:
    if report.suffix != ".json":
        raise OptionError(
            f"--report is {str(report)!r}; expected a file name that ends with .json, beside which "
            "the picture goes as .png and .svg."
        )
    folder = report.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot write into {folder}: {error.strerror}.") from error


def _write_json(console: Console, report: Path | None, told: dict[str, Any]) -> None:
    if report is None:
        return
    path = report
    try:
        path.write_text(json.dumps(told, indent=1, allow_nan=False), encoding="utf-8")
    except OSError as error:
        raise InvalidInputError(f"cannot write {path}: {error.strerror}.") from error
    console.print(f"wrote {path}", highlight=False)
