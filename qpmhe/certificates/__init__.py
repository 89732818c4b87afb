"""Which parts of the theorem hold for a given system, and with which constants."""

from .audit import Audit, audit
from .certificate import Certificate, certify
from .contraction import Synthesis, certify_detectability, certify_observer, synthesise_gain
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    OutOfTimeError,
)
from .monitor import Hypotheses, Monitor, MonitorSummary, monitor, monitored_run
from .properties import Detectability, ObserverStability
from .regions import Region
from .report import Report, certify_model
from .theorem import DecayingSums, Sizes, TheoremConstants

__all__ = [
    "Audit", "Certificate", "CertificateError", "DecayingSums", "Detectability", "Evidence",
    "Hypotheses", "MismatchError", "Monitor", "MonitorSummary", "NotCertifiedError",
    "ObserverStability", "OutOfTimeError", "Region", "Report", "Sizes", "Synthesis",
    "TheoremConstants", "audit", "certify", "certify_detectability", "certify_model",
    "certify_observer", "monitor", "monitored_run", "synthesise_gain",
]
