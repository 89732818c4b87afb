"""What ``qpmhe certify`` can say of a model that was not certified."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from rich.console import Console
from rich.markup import escape

from ..certificates.audit import Audit, audit
from ..certificates.deadline import Deadline
from ..certificates.detectability import certify_detectability
from ..certificates.errors import CertificateError, NotCertifiedError
from ..certificates.observer import certify_observer
from ..certificates.regions import Region
from ..certificates.properties import Detectability, ObserverStability
from ..certificates.telling import result_dict
from ..errors import QpmheError
from ..models import Example
from ..models.scenario import Record
from .certify_tables import assumptions_table, ingredients_table

__all__ = ["Remainder"]

Result = TypeVar("Result")


@dataclass(eq=False)
class Remainder:
    """The assumptions, and the part that could be shown.

    Parameters
    ----------
    error : QpmheError
        Why there is no certificate.
    findings : Audit
        The assumptions.
    detected, observed : Detectability and ObserverStability, or None
        What could be shown by itself.
    failures : dict of str to QpmheError
        Why the other could not.
    """

    error: QpmheError
    findings: Audit
    detected: Detectability | None = None
    observed: ObserverStability | None = None
    failures: dict[str, QpmheError] = field(default_factory=dict)

    @classmethod
    def of(
        cls, example: Example, region: Region, record: Record, error: QpmheError,
        deadline: Deadline,
    ) -> Remainder:
        """Look at each assumption by itself.

        Parameters
        ----------
        example, region, record
            Model, set of states and simulated record.
        error : QpmheError
            Why there is no certificate.
        deadline : Deadline
            When to be done.
        """
        rest = cls(error, audit(
            example.system, example.observer, example.cost, region, record,
            initial_state=example.scenario.initial_estimate, seconds=deadline.part(0.2),
        ))
        rest.detected = rest._attempt("detectability", lambda: certify_detectability(
            example.system, region, seconds=deadline.part(0.5)))
        rest.observed = rest._attempt("the observer", lambda: certify_observer(
            example.system, example.observer, region, seconds=deadline.part(0.9)))
        return rest

    def _attempt(self, what: str, question: Callable[[], Result]) -> Result | None:
        try:
            return question()
        except (NotCertifiedError, CertificateError) as error:
            self.failures[what] = error
            return None

    @property
    def texts(self) -> list[str]:
        """What failed, in words."""
        return [f"{what}: {each}" for what, each in self.failures.items()] or [str(self.error)]

    def show(self, console: Console) -> None:
        """Print all of it.

        Parameters
        ----------
        console : rich.console.Console
            Where.
        """
        console.print(assumptions_table(self.findings))
        if self.detected is not None or self.observed is not None:
            console.print(ingredients_table(self.detected, self.observed))
        for text in self.texts:
            console.print(f"[bold red]Not certified:[/] {escape(text)}", highlight=False)
        console.print(
            "What holds without any certificate: the estimate costs no more than the observer's "
            "candidate, at each step and with any solver.", highlight=False,
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows.

        The smallest feasible rates are None where none is known.
        """
        errors = list(self.failures.values()) or [self.error]
        suggestions = [text for each in errors for text in getattr(each, "suggestions", ())]
        return {
            "failures": self.texts,
            "suggestions": list(dict.fromkeys(suggestions)),
            "smallest_rates": {
                name: getattr(self.failures.get(what), "smallest_rate", None)
                for name, what in (("eta", "detectability"), ("rho", "the observer"))
            },
            "assumptions": self.findings.to_dict(),
            "detectability": [] if self.detected is None else [result_dict(self.detected)],
            "observer": [] if self.observed is None else [result_dict(self.observed)],
        }
