"""The tables of ``qpmhe certify``."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Table

from ..certificates.audit import Audit
from ..certificates.certificate import Certificate
from ..certificates.figures import LABELS
from ..certificates.results import Detectability, ObserverStability

__all__ = ["assumptions_table", "bounds_table", "ingredients_table"]


def assumptions_table(findings: Audit) -> Table:
    """The assumptions, one a row.

    Parameters
    ----------
    findings : Audit
        What was found.
    """
    table = Table(title="Assumptions", title_justify="left")
    for name in ("assumption", "holds", "evidence", "what was found"):
        table.add_column(name)
    for finding in findings.findings:
        holds = {True: "yes", False: "[bold red]no[/]", None: "not looked at"}[finding.holds]
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
    table = Table(
        title="Detectability and observer", title_justify="left",
        caption="Rate per step; constants of initial error, disturbance and noise. The bounds "
        "below for other N may use other rates.", caption_justify="left",
    )
    for name in ("", "rate", "c_p", "c_w", "c_v", "evidence"):
        table.add_column(name, justify="left" if name in ("", "evidence") else "right")
    rows = []
    if detected is not None:
        rows.append(("e-IOSS (eq:eIOSS)", detected.eta, detected.c_p, detected.c_w, detected.c_v,
                     detected.evidence))
    if observed is not None:
        rows.append(("observer (eq:RGES)", observed.rho, observed.C_p, observed.C_w,
                     observed.C_v, observed.evidence))
    for name, *numbers, evidence in rows:
        table.add_row(name, *(f"{number:.4g}" for number in numbers), str(evidence))
    return table


def bounds_table(certificate: Certificate) -> Table:
    """The constants of the bounds, and what they come to.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    """
    sizes = certificate.sizes
    table = Table(
        title="Bounds of the error (eq:RGES_result)", title_justify="left",
        caption=f"Limit: for |w| <= {sizes.disturbance:.3g} and |v| <= {sizes.noise:.3g} at all "
        f"times. Vacuous: no less than {certificate.diameter:.4g}, the diameter of the set. Only "
        "the first row of each N is the paper's; evidence of all: "
        f"{certificate.evidence}.",
        caption_justify="left",
    )
    for name in ("N", "bound", "C_1", "C_2", "C_3", "lambda", "limit", "largest term", ""):
        table.add_column(name, justify="left" if name in ("bound", "largest term", "") else "right")
    for N, bounds in certificate.bounds.items():
        for kind in certificate.kinds:
            if kind == "measured":
                continue
            window = {"summed": bounds.summed, "weighted": bounds.weighted}.get(kind)
            result = bounds.paper.result if window is None else window.result()
            limit = certificate.limit(sizes.disturbance, sizes.noise, horizon=N, kind=kind)
            table.add_row(
                str(N) if kind == "paper" else "", LABELS[kind],
                *(f"{value:.4g}" for value in (*result.constants, result.rate, limit)),
                bounds.paper.dominating()[1] if kind == "paper" else "",
                "[yellow]vacuous[/]" if certificate.vacuous(horizon=N, kind=kind) else "",
            )
        table.add_section()
    return table
