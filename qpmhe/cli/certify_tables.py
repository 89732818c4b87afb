"""The tables of ``qpmhe certify``."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from ..certificates.audit import Audit
from ..certificates.certificate import Certificate
from ..certificates.report import LABELS
from ..certificates.properties import Detectability, ObserverStability

__all__ = ["assumptions_table", "bounds_table", "ingredients_table"]


def assumptions_table(findings: Audit) -> Table:
    """The assumptions, one a row.

    Parameters
    ----------
    findings : Audit
        What was found.
    """
    table = _table("Assumptions")
    for name in ("assumption", "holds", "evidence", "what was found"):
        table.add_column(name, overflow="fold")
    if any(each.holds is False and not each.needed for each in findings.findings):
        table.caption = (
            "The bounds rest on no set: what is certified holds for any w and v, and the region "
            "takes the place of X."
        )
    for finding in findings.findings:
        holds = {True: "yes", False: "[bold red]no[/]", None: "not looked at"}[finding.holds]
        if finding.holds is False and not finding.needed:
            holds = "no, but not needed"
        table.add_row(
            f"{finding.name} ({finding.label})", holds, str(finding.evidence or "-"),
            escape(finding.text),
        )
    return table


def ingredients_table(
    detected: Detectability | None, observed: ObserverStability | None
) -> Table:
    """The constants of detectability and of the observer.

    Parameters
    ----------
    detected, observed : Detectability and ObserverStability, or None
        What could be certified.
    """
    table = _table(
        "Detectability and observer", "Rate per step; constants of initial error, disturbance and "
        "noise. The bounds below for other N may use other rates.",
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


def bounds_table(certificate: Certificate) -> Table:
    """The constants of the bounds, and what they come to.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    """
    sizes = certificate.sizes
    largest = {N: bounds.paper.dominating()[1] for N, bounds in certificate.bounds.items()}
    terms = "; ".join(
        f"{term} (N = {', '.join(str(N) for N in largest if largest[N] == term)})"
        for term in dict.fromkeys(largest.values())
    )
    table = _table(
        "Bounds of the error (eq:RGES_result)",
        f"Limit: for |w| <= {sizes.disturbance:.3g} and |v| <= {sizes.noise:.3g} at all "
        f"times. Vacuous: no less than {certificate.diameter:.4g}, the diameter of the set. Only "
        f"the first row of each N is the paper's; its largest term in C_2: {terms}. Evidence of "
        f"all: {certificate.evidence}.",
    )
    rows: list[tuple[Any, ...]] = []
    for N, bounds in certificate.bounds.items():
        for kind in certificate.kinds:
            if kind == "measured":
                continue
            window = {"summed": bounds.summed, "weighted": bounds.weighted}.get(kind)
            result = bounds.paper.result if window is None else window.result()
            limit = certificate.limit(sizes.disturbance, sizes.noise, horizon=N, kind=kind)
            vacuous = certificate.vacuous(horizon=N, kind=kind)
            rows.append((
                str(N) if kind == "paper" else "", LABELS[kind], *result.constants, result.rate,
                limit, "[yellow]vacuous[/]" if vacuous else "",
            ))
    _fill(table, ("N", "bound", "C_1", "C_2", "C_3", "lambda", "limit", ""), rows)
    return table


def _table(title: str, caption: str | None = None) -> Table:
    return Table(
        title=title, title_justify="left", caption=caption, caption_justify="left",
        box=box.SIMPLE, padding=(0, 1, 0, 0),
    )


def _fill(table: Table, names: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Columns and rows; words give way where it is narrow, figures are never cut."""
    told = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in row]
        for row in rows
    ]
    for j, name in enumerate(names):
        figures = name == "N" or any(isinstance(row[j], float) for row in rows)
        width = max([len(name), *(len(row[j]) for row in told)]) if figures else None
        table.add_column(
            name, justify="right" if figures else "left", overflow="fold", no_wrap=False,
            min_width=width,
        )
    for row in told:
        table.add_row(*row)
