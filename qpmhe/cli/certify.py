"""``qpmhe certify``: what is proved about a model's observer, and what follows for estimates."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .._checks import Array, make_folder
from ..certificates.certificate import ASSUMED, Certificate
from ..certificates.deadline import Deadline
from ..certificates.evidence import NotCertifiedError, at_most, json_ready
from ..certificates.lyapunov import Design, design
from ..certificates.regions import Region
from ..certificates.report import Report, certify_model
from ..certificates.sizes import intervals
from ..certificates.stored import save
from ..certificates.theorem import DecayingSums
from ..errors import OptionError
from ..models.loading import build, find
from ..records.record_model import model_parts
from .values import read_box, read_numbers

Rows = list[tuple[str, str]]


def certify(
    console: Console, model: str, box: str | None = None, horizon: str | None = None,
    report: Path | None = None, *, out: Path | None = None, input_box: str | None = None,
    seed: int = 0, seconds: float = 60.0, details: bool = False, with_design: bool = False,
    guard: bool = False, max_disturbance: str | None = None, max_noise: str | None = None,
) -> bool:
    """Certify a model, and show the result."""
    horizons = _horizons(horizon)
    for option, file in (("--report", report), ("--out", out)):  # before any work
        if file is not None and file.suffix != ".json":
            raise OptionError(
                f"{option} is {str(file)!r}; expected a file name that ends with .json."
            )
        if file is not None:
            make_folder(file.parent)
    source = find(model)
    (system, observer, cost), options = model_parts(source.name, build(source))
    scenario = options.get("scenario")
    region = None if box is None else read_box("--box", box, system.n, "states")
    inputs = None if input_box is None else read_box("--input-box", input_box, system.m, "inputs")
    if not horizons and "horizon" not in options:
        raise OptionError(f"model {source.name!r} does not give its horizon; give --horizon.")
    with console.status("looking for matrices, and verifying them"):
        found = certify_model(
            system, observer, cost, scenario, horizon=horizons or options["horizon"],
            region=region, inputs=inputs, seed=seed, seconds=seconds, guard=guard, options=options,
            max_disturbance=_numbers("--max-disturbance", max_disturbance),
            max_noise=_numbers("--max-noise", max_noise),
        )
    certificate = found.certificate
    other = "With a gain made for the region: " if found.replaced else ""
    _print(console, f"[bold]{other}{escape(certificate.headline)}[/]")
    title = model if scenario is None or not scenario.title else scenario.title
    _show(console, [("model", title), *_findings(found)])
    for text in certificate.failures:
        _print(console, f"[bold red]Not certified:[/] {escape(text)}")
    if found.refused:
        _print(console, f"[bold red]{escape(found.guard[:1].upper() + found.guard[1:])}[/]")
    if not certificate.holds:
        _print(
            console, "What holds without any certificate: the estimate costs no more than the "
            "observer's candidate, at each step and with any solver.",
        )
    if details:
        _show(console, _details(certificate), "The theorem's assumptions and constants")
        for text in ASSUMED:
            _print(console, f"Assumed: {text}.")
    elif certificate.assumptions:
        _print(console, "[dim]The theorem's assumptions and constants: --details[/]")
    plan = _designed(console, certificate, horizons, seconds) if with_design else None
    if report is not None:
        content = certificate.to_dict() | {
            "model": model, "certified": certificate.holds, "replaced": found.replaced,
            "simulated": found.simulated, "guard": found.guard, "design": json_ready(plan),
        }
        try:
            report.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")
        except OSError as error:
            raise OptionError(f"cannot write --report {report}: {error.strerror}.") from error
        _wrote(console, report)
    if out is not None and certificate.observer_bound is not None:
        save(certificate.observer_bound, out)
        _wrote(console, out)
    return certificate.holds and not found.refused


def _numbers(option: str, text: str | None) -> Array | None:
    return None if text is None else read_numbers(option, text)


def _wrote(console: Console, file: Path) -> None:
    console.print(f"wrote {escape(str(file))}", highlight=False, soft_wrap=True)


def _print(console: Console, text: str) -> None:
    console.print(text, highlight=False)


def _show(console: Console, rows: Rows, title: str = "") -> None:
    """Rows of a name and what there is to say of it."""
    table = Table.grid(padding=(0, 2))
    for name, text in rows:
        table.add_row(f"[dim]  {escape(name)}[/]", escape(text))
    if title:
        _print(console, f"\n[bold]{escape(title)}[/]")
    console.print(table, highlight=False)


def _findings(found: Report) -> Rows:
    """What the bounds are for, what they need, and what they are on the simulated record."""
    certificate, proved = found.certificate, found.certificate.observer_bound
    rows = [("states", _words(certificate.region))]
    if found.replaced:
        rows.append(("observer", found.replaced))
    if found.tried:
        rows.append(("gain", f"none was found for the region: {found.tried}"))
    if proved is not None:
        rows += [("sizes", str(proved.sizes)), ("region", proved.condition)]
        if certificate.system.states is not None and not proved.projects:
            rows.append((
                "projection", "the observer is projected onto X in another metric than the "
                "certified one, which ends the bound at that sample. To keep it, use "
                f"qpmhe.Luenberger({proved.gain.tolist()}, metric={proved.metric.tolist()})",
            ))
    if found.simulated:
        rows.append(("simulated", found.simulated))
    if found.guard and not found.refused:
        rows.append(("guard", found.guard))
    for each, limit in certificate.limits():
        vacuous = ""
        if not limit < certificate.diameter:
            vacuous = f": vacuous, the region's diameter is {certificate.diameter:.3g}"
        rows.append((
            f"N = {each.horizon}", f"|x - x_hat| <= {at_most(limit, 4)} in the limit by the "
            f"paper's constants ({certificate.evidence}){vacuous}",
        ))
    return rows


def _details(certificate: Certificate) -> Rows:
    """The theorem's assumptions and constants."""
    rows = [
        (each.name, " ".join(filter(None, (
            {True: "", False: "does not hold:", None: "not examined:"}[each.holds], each.text,
            f"({each.label})" if each.evidence is None else f"({each.evidence}, {each.label})",
        ))))
        for each in certificate.assumptions
    ]

    def add(name: str, sums: DecayingSums, symbols: tuple[str, ...], end: str = "") -> None:
        values = (at_most(value, 4) for value in (*sums.constants, sums.rate))
        pairs = zip(symbols, values, strict=True)
        rows.append((name, ", ".join(f"{symbol} {value}" for symbol, value in pairs) + end))

    for name, part, symbols in (
        ("e-IOSS (eq:eIOSS)", certificate.detectability, ("c_p", "c_w", "c_v", "eta")),
        ("observer (eq:RGES)", certificate.stability, ("C_p", "C_w", "C_v", "rho")),
    ):
        if part is not None:
            add(name, part.sums, symbols, f" ({part.evidence})")
    for N, each in certificate.constants.items():
        add(f"N = {N} (eq:RGES_result)", each.result, ("C_1", "C_2", "C_3", "lambda"))
    return rows


def _designed(
    console: Console, certificate: Certificate, horizons: list[int], seconds: float
) -> Design | None:
    """Design for a certificate's model, region and sizes, and print what is to be pasted."""
    with console.status("looking for a Lyapunov function"):
        try:
            made = design(
                certificate.system, certificate.region, sizes=certificate.sizes,
                horizon=horizons[0] if len(horizons) == 1 else None, seconds=Deadline(seconds),
            )
        except NotCertifiedError as error:
            _print(console, f"[bold red]No design:[/] {escape(str(error))}")
            return None
    limits = made.components(made.limit())
    widths = (made.region.upper - made.region.lower)[: limits.size]
    nothing = ", ".join(f"x{i + 1}" for i in np.flatnonzero(limits >= widths))
    rows = [
        ("sizes", str(made.sizes)),
        ("contraction", f"a window of N = {made.horizon} that starts at an estimate shrinks the "
         f"error to {at_most(made.contraction(), 3)} of itself, if J(estimate) <= J(truth), as "
         f"for a global minimiser; the least N is {made.least_horizon()}"),
        ("limit", "then "
         + ", ".join(
             f"|x{i + 1} - x_hat{i + 1}| <= {at_most(each, 3)}" for i, each in enumerate(limits)
         )
         + (f": it says nothing about {nothing}" if nothing else "")),
        ("any QPs", "Design.along bounds the error by the J(estimate) that each step returns"),
        *(("note", each) for each in made.notes),
    ]
    _show(console, rows, f"Lyapunov design ({made.evidence})")
    console.print()
    console.print(made.code(), highlight=False, markup=False, soft_wrap=True)
    return made


def _horizons(text: str | None) -> list[int]:
    if text is None:
        return []
    try:
        found = [int(item) for item in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) < 1:
        raise OptionError(f"--horizon is {text!r}; expected integers >= 1 separated by commas.")
    return found


def _words(region: Region) -> str:
    n, low, high = region.n, region.lower, region.upper
    parts = [intervals("x", low[:n], high[:n]), intervals("u", low[n:], high[n:])]
    return ", ".join(filter(None, parts)) + ("" if region.is_box else ", and general inequalities")
