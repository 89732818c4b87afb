"""Certificates: what of the theorem holds for a given system, and with which constants."""

from .audit import Audit, audit
from .certificate import Certificate
from .certification import certify
from .choices import Sizes, tighten
from .closed_runs import attack_estimator
from .decay import DecayingSums
from .detectability import certify_detectability
from .errors import (
    CertificateError,
    JumpError,
    MismatchError,
    NotCertifiedError,
    OutOfTimeError,
)
from .evidence import Evidence
from .falsification import attack_detectability, attack_observer
from .report import error_and_bounds
from .hypotheses import Hypotheses, MonitorSummary
from .monitor import Monitor, monitor, monitored_run
from .observer import certify_observer
from .regions import Region
from .properties import Detectability, ObserverStability
from .synthesis import Synthesis, synthesise_gain
from .theorem import theorem

__all__ = [
    "Audit",
    "Certificate",
    "CertificateError",
    "DecayingSums",
    "Detectability",
    "Evidence",
    "Hypotheses",
    "JumpError",
    "MismatchError",
    "Monitor",
    "MonitorSummary",
    "NotCertifiedError",
    "ObserverStability",
    "OutOfTimeError",
    "Region",
    "Sizes",
    "Synthesis",
    "attack_detectability",
    "attack_estimator",
    "attack_observer",
    "audit",
    "certify",
    "certify_detectability",
    "certify_observer",
    "error_and_bounds",
    "monitor",
    "monitored_run",
    "synthesise_gain",
    "theorem",
    "tighten",
]
