"""Whether a backend is what it says it is, and does what every backend must."""

from __future__ import annotations

from dataclasses import dataclass, fields

from .capabilities import Capabilities, measure
from .conformance_cases import run_cases
from .registry import backend, create

__all__ = ["Conformance", "Finding", "check"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one part of the battery.

    Parameters
    ----------
    check : str
        What was looked at.
    passed : bool
        Whether all was well.
    detail : str
        What was not; empty where it was.
    """

    check: str
    passed: bool
    detail: str = ""


@dataclass(frozen=True)
class Conformance:
    """Whether a backend is what it says, and does what is asked.

    Parameters
    ----------
    name : str
        The backend.
    declared, measured : Capabilities
        What it says of itself, and what was seen.
    findings : tuple of Finding
        All parts of the battery, passed or not.
    """

    name: str
    declared: Capabilities
    measured: Capabilities
    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        """Whether every part of the battery passed, and all was declared as measured."""
        return self.declared == self.measured and all(one.passed for one in self.findings)

    def __str__(self) -> str:
        lines = [f"{self.name}: {'conforms' if self.passed else 'does not conform'}"]
        for one in fields(Capabilities):
            says, does = getattr(self.declared, one.name), getattr(self.measured, one.name)
            if says != does:
                lines.append(f"  {one.name} is declared {says}, but measured {does}")
        lines += [f"  {one.check}: {one.detail}" for one in self.findings if not one.passed]
        return "\n".join(lines)


def check(name: str) -> Conformance:
    """Put a backend through the whole battery.

    Parameters
    ----------
    name : str
        A registered name; one's own, after `register`, too.

    Returns
    -------
    Conformance
        What it can do, and what it did wrong; printed, the latter only.

    Raises
    ------
    BackendError
        If there is no such backend, or its package is not installed.
    """
    create(name)
    measured = measure(name)
    findings = tuple(
        Finding(part, not detail, detail) for part, detail in run_cases(name, measured)
    )
    return Conformance(name, Capabilities.declared(backend(name)), measured, findings)
