"""What a certificate cannot be given for."""

from __future__ import annotations

from ..errors import InvalidInputError, QpmheError

__all__ = ["CertificateError", "JumpError", "MismatchError", "NotCertifiedError", "OutOfTimeError"]


class CertificateError(InvalidInputError):
    """A question that no certificate can answer, such as one about an unbounded set."""


class MismatchError(CertificateError):
    """Something certified for one system, gain, region or estimator, and used for another."""


class NotCertifiedError(QpmheError):
    """A property that could not be certified, and perhaps does not hold.

    Parameters
    ----------
    message : str
        What was asked, and what was found.
    suggestions : sequence of str
        What may help.
    smallest_rate : float, optional
        The smallest rate that was found to be feasible, where the one asked for was not.

    Attributes
    ----------
    suggestions : tuple of str
        As given; the text of the error lists them.
    smallest_rate : float or None
        As given.
    """

    def __init__(
        self,
        message: str,
        suggestions: tuple[str, ...] = (),
        smallest_rate: float | None = None,
    ) -> None:
        self.suggestions = tuple(suggestions)
        self.smallest_rate = smallest_rate
        advice = f" What may help: {'; '.join(self.suggestions)}." if self.suggestions else ""
        super().__init__(message + advice)


class OutOfTimeError(NotCertifiedError):
    """A search that was stopped before it found anything: nothing is known of the property."""


class JumpError(NotCertifiedError):
    """A function that seems to jump, of which no property with derivatives can be shown."""
