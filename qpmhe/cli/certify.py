"""``qpmhe certify``: which of the theorem's assumptions hold for a model, and what follows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich import box as boxes
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .._checks import make_folder
from ..certificates.audit import Audit
from ..certificates.certificate import ASSUMED, Certificate
from ..certificates.monitor import NEEDED, UNNEEDED
from ..certificates.properties import Detectability, ObserverStability
from ..certificates.regions import Region
from ..certificates.report import LABELS, Report, certify_model
from ..errors import OptionError
from ..models.loading import find, load
from .design import show_design
from .values import read_box


def certify(
    console: Console, model: str, box: str | None = None, horizon: str | None = None,
    report: Path | None = None, *, input_box: str | None = None, seed: int = 0,
    seconds: float = 60.0, details: bool = False, design: bool = False,
) -> bool:
    """Certify a model with `qpmhe.certificates.certify_model`, and show the result."""
    horizons = _horizons(horizon)
    if report is not None:
        _check_report(report)  # before any work
    example = load(find(model))
    system, title = example.system, example.scenario.title or model
    region = None if box is None else read_box("--box", box, system.n, "states")
    inputs = None if input_box is None else read_box("--input-box", input_box, system.m, "inputs")
    with console.status("looking for matrices, and verifying them"):
        found = certify_model(
            example, horizon=horizons or None, region=region, inputs=inputs, seed=seed,
            seconds=seconds, name=model,
        )
    certificate = found.certificate
    other = "With a gain made for the region: " if found.replaced else ""
    _print(console, f"[bold]{other}{escape(certificate.headline)}[/]")
    rows = Table.grid(padding=(0, 2))
    for name, text in (
        ("model", title), ("states", _words(found.region)),
        *([("observer", found.replaced)] if found.replaced else []), *_findings(found, seed),
    ):
        rows.add_row(f"[dim]  {name}[/]", escape(text))
    console.print(rows, highlight=False)
    for text in certificate.failures:
        _print(console, f"[bold red]Not certified:[/] {escape(text)}")
    if not certificate.holds:
        _print(
            console, "What holds without any certificate: the estimate costs no more than the "
            "observer's candidate, at each step and with any solver.",
        )
    if details:
        _show_details(console, found)
    elif certificate.bounds or certificate.audit is not None:
        _print(console, "[dim]The theorem's assumptions and constants: --details[/]")
    if design:
        found.design = show_design(console, found, horizons, seconds)
    if report is not None:
        for path in found.save(report):
            console.print(f"wrote {escape(str(path))}", highlight=False, soft_wrap=True)
    return certificate.holds


def _print(console: Console, text: str) -> None:
    console.print(text, highlight=False)


def _findings(found: Report, seed: int) -> list[tuple[str, str]]:
    """What the bounds are for, what they need, and what they came to on the simulated record."""
    certificate, proved, rows = found.certificate, found.certificate.observer_bound, []
    if proved is not None:
        rows.append(("for", str(proved.sizes)))
        rows.append(("stays", proved.condition))
        if found.example.system.states is not None and not proved.projects:
            rows.append((
                "projection", "the observer is projected onto X in another metric than the "
                "certified one: samples at which it is end the bound. Luenberger(gain, "
                f"metric={np.array2string(proved.metric, separator=', ', floatmode='unique')})"
                .replace("\n", "") + " keeps it",
            ))
    if found.band is not None and found.run is not None:
        errors = np.linalg.norm(found.record.states - found.run.states, axis=1)
        held = np.isfinite(found.band.error)
        rows.append((
            "simulated", f"seed {seed}: |x - x_hat| <= {found.band.error[held].max():.3g} was "
            f"guaranteed, and {errors[held].max():.3g} was the largest; {found.band}",
        ))
    for N in certificate.horizons:
        limits = ", ".join(
            f"{certificate.limit(horizon=N, kind=kind):.3g} ({LABELS[kind]})"
            for kind in certificate.kinds if kind != "measured"
        )
        nothing = all(
            certificate.vacuous(horizon=N, kind=kind)
            for kind in certificate.kinds if kind != "measured"
        )
        rows.append((
            f"N = {N}", f"|x - x_hat| <= {limits} in the limit ({certificate.evidence})"
            + (f": vacuous, the region's diameter is {certificate.diameter:.3g}" if nothing
               else ""),
        ))
    return rows


def _show_details(console: Console, found: Report) -> None:
    certificate = found.certificate
    if certificate.audit is not None:
        console.print(_assumptions_table(certificate.audit))
    if certificate.detectability is not None or certificate.stability is not None:
        console.print(_ingredients_table(certificate.detectability, certificate.stability))
    if certificate.bounds:
        console.print(_bounds_table(certificate))
        _print(console, f"Simulated record: {found.summary}")
        names = f"The bounds need: {', '.join(NEEDED)}. Reported only: {', '.join(UNNEEDED)}."
        _print(console, names.replace("_", " "))
    for text in ASSUMED:
        _print(console, f"Assumed: {text}.")


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


def _words(region: Region) -> str:
    parts = [
        f"{'x' if j < region.n else 'u'}{(j if j < region.n else j - region.n) + 1} in "
        f"[{low:.4g}, {high:.4g}]"
        for j, (low, high) in enumerate(zip(region.lower, region.upper, strict=True))
    ]
    return ", ".join(parts) + ("" if region.is_box else ", and general inequalities")


def _check_report(report: Path) -> None:
    if report.suffix != ".json":
        raise OptionError(
            f"--report is {str(report)!r}; expected a file name that ends with .json, beside which "
            "the picture goes as .png and .svg."
        )
    make_folder(report.parent)


def _assumptions_table(findings: Audit) -> Table:
    """The assumptions, one a row."""
    table = _table("Assumptions")
    for name in ("assumption", "holds", "evidence", "what was found"):
        table.add_column(name, overflow="fold")
    for finding in findings.findings:
        holds = {True: "yes", False: "[bold red]no[/]", None: "not examined"}[finding.holds]
        table.add_row(
            f"{finding.name} ({finding.label})", holds, str(finding.evidence or "-"),
            escape(finding.text),
        )
    return table


def _ingredients_table(
    detected: Detectability | None, observed: ObserverStability | None
) -> Table:
    """The constants of detectability and of the observer."""
    table = _table(
        "Detectability and observer", "Rate per step; constants of initial error, disturbance and "
        "noise.",
    )
    rows = []
    if detected is not None:
        rows.append(("e-IOSS (eq:eIOSS)", detected.eta, detected.c_p, detected.c_w, detected.c_v,
                     detected.evidence))
    if observed is not None:
        rows.append(("observer (eq:RGES)", observed.rho, observed.C_p, observed.C_w,
                     observed.C_v, observed.evidence))
    _fill(table, ("", "rate", "c_p", "c_w", "c_v", "evidence"), [
        (name, *numbers, str(evidence)) for name, *numbers, evidence in rows
    ])
    return table


def _bounds_table(certificate: Certificate) -> Table:
    """The constants of the bounds, and what they come to."""
    sizes = certificate.sizes.lengths
    table = _table(
        "Bounds of the error (eq:RGES_result)",
        f"Limit: for |w| <= {sizes.disturbance:.3g} and |v| <= {sizes.noise:.3g} at all "
        f"times. Vacuous: no less than {certificate.diameter:.4g}, the diameter of the set. "
        f"Evidence of all: {certificate.evidence}.",
    )
    rows: list[tuple[Any, ...]] = []
    for N, bounds in certificate.bounds.items():
        for kind in certificate.kinds:
            if kind == "measured":
                continue
            paper = bounds.paper.result
            constants = (*paper.constants, paper.rate) if kind == "paper" else ("",) * 4
            limit = certificate.limit(horizon=N, kind=kind)
            vacuous = certificate.vacuous(horizon=N, kind=kind)
            rows.append((
                str(N) if kind == "paper" else "", LABELS[kind], *constants, limit,
                "[yellow]vacuous[/]" if vacuous else "",
            ))
    _fill(table, ("N", "bound", "C_1", "C_2", "C_3", "lambda", "limit", ""), rows)
    return table


def _table(title: str, caption: str | None = None) -> Table:
    return Table(
        title=title, title_justify="left", caption=caption, caption_justify="left",
        box=boxes.SIMPLE, padding=(0, 1, 0, 0),
    )


def _fill(table: Table, names: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Columns and rows; words give way where it is narrow, figures are never cut."""
    texts = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in row]
        for row in rows
    ]
    for j, name in enumerate(names):
        figures = name == "N" or any(isinstance(row[j], float) for row in rows)
        width = max([len(name), *(len(row[j]) for row in texts)]) if figures else None
        table.add_column(
            name, justify="right" if figures else "left", overflow="fold", no_wrap=False,
            min_width=width,
        )
    for row in texts:
        table.add_row(*row)
