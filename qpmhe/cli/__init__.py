"""The command line, ``qpmhe``."""

from .app import main

__all__ = ["main"]
