"""``qpmhe certify``: what is proved of a model's observer, and what follows for estimates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich import box as boxes
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .._checks import make_folder
from ..certificates.certificate import ASSUMED, Certificate
from ..certificates.deadline import Deadline
from ..certificates.evidence import NotCertifiedError
from ..certificates.lyapunov import Design, Kind, design
from ..certificates.regions import Region
from ..certificates.report import Report, certify_model
from ..errors import OptionError
from ..models.loading import build, find
from ..records.record_model import model_parts
from .values import read_box

_MEANING: dict[Kind, str] = {
    "minimiser": "J(estimate) <= J(truth), as of a global minimiser",
    "measured": "J(estimate), known once it is there",
}


def certify(
    console: Console, model: str, box: str | None = None, horizon: str | None = None,
    report: Path | None = None, *, input_box: str | None = None, seed: int = 0,
    seconds: float = 60.0, details: bool = False, with_design: bool = False,
) -> bool:
    """Certify a model with `qpmhe.certificates.certify_model`, and show the result."""
    horizons = _horizons(horizon)
    if report is not None:
        _check_report(report)  # before any work
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
            region=region, inputs=inputs, seed=seed, seconds=seconds, name=model,
        )
    certificate = found.certificate
    other = "With a gain made for the region: " if found.replaced else ""
    _print(console, f"[bold]{other}{escape(certificate.headline)}[/]")
    title = model if scenario is None else scenario.title or model
    rows = Table.grid(padding=(0, 2))
    for name, text in (
        ("model", title), ("states", _words(certificate.region)),
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
    elif certificate.assumptions:
        _print(console, "[dim]The theorem's assumptions and constants: --details[/]")
    if with_design:
        found.design = _show_design(console, certificate, horizons, seconds)
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
        rows += [("for", str(proved.sizes)), ("stays", proved.condition)]
        if certificate.system.states is not None and not proved.projects:
            rows.append((
                "projection", "the observer is projected onto X in another metric than the "
                "certified one: samples at which it is end the bound. Luenberger(gain, "
                f"metric={np.array2string(proved.metric, separator=', ', floatmode='unique')})"
                .replace("\n", "") + " keeps it",
            ))
    if found.band is not None and found.run is not None and found.record is not None:
        errors = np.linalg.norm(found.record.states - found.run.states, axis=1)
        held = np.isfinite(found.band.error)
        rows.append((
            "simulated", f"seed {seed}: |x - x_hat| <= {found.band.error[held].max():.3g} was "
            f"guaranteed, and {errors[held].max():.3g} was the largest; {found.band}",
        ))
    for N in certificate.constants:
        vacuous = ""
        if certificate.vacuous(horizon=N, kind="paper"):
            vacuous = f": vacuous, the region's diameter is {certificate.diameter:.3g}"
        rows.append((
            f"N = {N}", f"|x - x_hat| <= {certificate.limit(horizon=N, kind='paper'):.3g} in the "
            f"limit by the paper's constants ({certificate.evidence}){vacuous}",
        ))
    return rows


def _show_details(console: Console, found: Report) -> None:
    certificate = found.certificate
    if certificate.assumptions:
        _show(
            console, "Assumptions", ("assumption", "holds", "evidence", "what was found"),
            [
                (f"{each.name} ({each.label})", {True: "yes", False: "no", None: "-"}[each.holds],
                 str(each.evidence or "-"), each.text)
                for each in certificate.assumptions
            ],
        )
    rows: list[tuple[Any, ...]] = []
    for name, part in (
        ("e-IOSS (eq:eIOSS)", certificate.detectability),
        ("observer (eq:RGES)", certificate.stability),
    ):
        if part is not None:
            rows.append((name, part.sums.rate, *part.sums.constants, str(part.evidence)))
    if rows:
        _show(
            console, "Detectability and observer", ("", "rate", "c_p", "c_w", "c_v", "evidence"),
            rows, "Rate per step; constants of initial error, disturbance and noise.",
        )
    if certificate.constants:
        _show(
            console, "The paper's bound (eq:RGES_result)",
            ("N", "C_1", "C_2", "C_3", "lambda", "limit", ""), [
                (str(N), *each.C, each.lam, certificate.limit(horizon=N, kind="paper"),
                 "vacuous" if certificate.vacuous(horizon=N, kind="paper") else "")
                for N, each in certificate.constants.items()
            ],
            f"Limit: for {certificate.sizes}. Vacuous: no less than {certificate.diameter:.4g}, "
            f"the diameter of the set. Evidence of all: {certificate.evidence}.",
        )
    if found.monitor is not None:
        _print(console, f"Simulated record: {found.monitor.summary()}")
    for text in ASSUMED:
        _print(console, f"Assumed: {text}.")


def _show_design(
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
    texts = ", ".join(
        f"{value:.3g}" if value < width else f"({value:.3g})"
        for value, width in zip(limits.tolist(), widths.tolist(), strict=True)
    )
    names = [f"x{j + 1}" for j in range(made.region.n)]
    if len(names) > 3:
        names[1:-1] = ["..."]
    _show(
        console, f"Lyapunov design ({made.evidence}), for {made.sizes}",
        ("what bounds J(estimate)", "N", "contraction", "least N", f"limit of {', '.join(names)}"),
        [
            (_MEANING[kind], str(made.horizon), made.contraction(kind=kind), *(
                (str(made.least_horizon() or "-"), texts) if kind == "minimiser" else ("1", "-")
            ))
            for kind in _MEANING
        ],
        "Contraction: by which factor the error shrinks over a window that starts at an estimate. "
        "Least N: from which it is below 1. Limit: of each state's error, for noises that always "
        "act in the worst direction; -, none in advance; in brackets, no less than the region's "
        "width, so that it says nothing.",
    )
    for note in made.notes:
        _print(console, f"Note: {escape(note)}")
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


def _show(
    console: Console, title: str, names: tuple[str, ...], rows: list[tuple[Any, ...]],
    caption: str | None = None,
) -> None:
    """A table; words give way where it is narrow, figures are never cut."""
    table = Table(
        title=escape(title), title_justify="left", caption=caption and escape(caption),
        caption_justify="left", box=boxes.SIMPLE, padding=(0, 1, 0, 0),
    )
    texts = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in row]
        for row in rows
    ]
    for j, name in enumerate(names):
        figures = name.endswith("N") or any(isinstance(row[j], float) for row in rows)
        width = max([len(name), *(len(row[j]) for row in texts)]) if figures else None
        table.add_column(
            name, justify="right" if figures else "left", overflow="fold", min_width=width
        )
    for row in texts:
        table.add_row(*map(escape, row))
    console.print(table)
