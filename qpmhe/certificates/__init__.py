"""What is proved of an observer and an estimator on a set of states, and with which constants."""

from .audit import Assumption
from .certificate import Certificate, certify
from .content import Content
from .contraction import Synthesis, certify_detectability, certify_observer, synthesise_gain
from .evidence import (
    CertificateError,
    Evidence,
    MismatchError,
    NotCertifiedError,
    OutOfTimeError,
)
from .lyapunov import Design, design
from .monitor import Monitor, Reading
from .observer_bound import ObserverBound
from .properties import Detectability, ObserverStability
from .regions import Region
from .sizes import Sizes
from .stored import load, save
from .theorem import DecayingSums, TheoremConstants
from .tube import Band

__all__ = [
    "Assumption", "Band", "Certificate", "CertificateError", "Content", "DecayingSums", "Design",
    "Detectability", "Evidence", "MismatchError", "Monitor", "NotCertifiedError",
    "ObserverBound", "ObserverStability", "OutOfTimeError", "Reading", "Region", "Sizes",
    "Synthesis", "TheoremConstants", "certify", "certify_detectability",
    "certify_observer", "design", "load", "save", "synthesise_gain",
]
