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
from .lyapunov import Design, design
from .monitor import Hypotheses, Monitor, MonitorSummary, monitor, monitored_run
from .observer_bound import Band, ObserverBound
from .observer_monitor import ObserverMonitor, Reading
from .properties import Detectability, ObserverStability
from .regions import Region
from .report import Report, certify_model
from .signal_bounds import SignalBounds
from .theorem import DecayingSums, Sizes, TheoremConstants

__all__ = [
    "Audit", "Band", "Certificate", "CertificateError", "DecayingSums", "Design", "Detectability",
    "Evidence", "Hypotheses", "MismatchError", "Monitor", "MonitorSummary", "NotCertifiedError",
    "ObserverBound", "ObserverMonitor", "ObserverStability", "OutOfTimeError", "Reading", "Region",
    "Report", "SignalBounds", "Sizes", "Synthesis",
    "TheoremConstants", "audit", "certify", "certify_detectability", "certify_model",
    "certify_observer", "design", "monitor", "monitored_run", "synthesise_gain",
]
