"""The version, and nothing else: whoever needs it imports no more than this."""

__version__ = "0.1.0"
