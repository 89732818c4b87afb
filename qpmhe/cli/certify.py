"""``qpmhe certify``: which of the theorem's assumptions hold for a model, and what follows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
from ..model.sets import Box
from ..models.loading import find, load


def certify(
    console: Console, model: str, box: str | None = None, horizon: str | None = None,
    report: Path | None = None, *, input_box: str | None = None, seed: int = 0,
    seconds: float = 60.0,
) -> bool:
    """Certify a model with `qpmhe.certificates.certify_model`, and show the result."""
    horizons = _horizons(horizon)
    if report is not None:
        _check_report(report)  # before any work
    example = load(find(model))
    system, title = example.system, example.scenario.title or model
    region = None if box is None else _box("--box", box, system.n, "states")
    inputs = None if input_box is None else _box("--input-box", input_box, system.m, "inputs")
    with console.status("looking for matrices, and verifying them"):
        found = certify_model(
            example, horizon=horizons or None, region=region, inputs=inputs, seed=seed,
            seconds=seconds, name=model,
        )
    console.print(f"[bold]{title}[/], on {_words(found.region)}", highlight=False)
    console.print(_assumptions_table(found.audit))
    if found.detectability is not None or found.stability is not None:
        console.print(_ingredients_table(found.detectability, found.stability))
    if found.certificate is None:
        _show_failures(console, found)
    else:
        console.print(_bounds_table(found.certificate))
        console.print(f"Simulated record, seed {seed}: {found.summary}", highlight=False)
        names = f"The bounds need: {', '.join(NEEDED)}. Reported only: {', '.join(UNNEEDED)}."
        console.print(names.replace("_", " "), highlight=False)
        for text in ASSUMED:
            console.print(f"Assumed: {text}.", highlight=False)
    if report is not None:
        for path in found.save(report):
            console.print(f"wrote {path}", highlight=False)
    return found.certificate is not None


def _show_failures(console: Console, found: Report) -> None:
    for text in found.failures:
        console.print(f"[bold red]Not certified:[/] {escape(text)}", highlight=False)
    console.print(
        "What holds without any certificate: the estimate costs no more than the observer's "
        "candidate, at each step and with any solver.", highlight=False,
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
    if any(each.holds is False and not each.needed for each in findings.findings):
        table.caption = (
            "The bounds rest on no set: what is certified holds for any w and v, and the region "
            "takes the place of X."
        )
    for finding in findings.findings:
        holds = {True: "yes", False: "[bold red]no[/]", None: "not examined"}[finding.holds]
        if finding.holds is False and not finding.needed:
            holds = "no, but not needed"
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
    sizes = certificate.sizes
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
            limit = certificate.limit(sizes.disturbance, sizes.noise, horizon=N, kind=kind)
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
