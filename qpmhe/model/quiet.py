"""Evaluation of CasADi's solvers without the lines that they print where they fail."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_LOCK = threading.RLock()  # the stream of a thread that holds it may be one of these
_QUIET: dict[int, int] = {}  # how many evaluations go on in each thread, within each other


class _Stream:
    """Standard error, without what the threads in `_QUIET` write."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if threading.get_ident() in _QUIET:
            return len(text)
        _leave()
        if self._stream is None:
            return len(text)
        written: int = self._stream.write(text)
        return written

    def __getattr__(self, name: str) -> Any:
        _leave()
        return getattr(self._stream, name)


def _leave() -> None:
    """Put the stream itself back, if no evaluation goes on.

    One that ends while another thread has redirected ``sys.stderr`` cannot: what that thread puts
    back does so when it is used.
    """
    with _LOCK:
        while not _QUIET and isinstance(sys.stderr, _Stream):
            sys.stderr = sys.stderr._stream


@contextmanager
def quiet() -> Iterator[None]:
    """Drop what this thread writes to ``sys.stderr``, where CasADi reports on failures."""
    own = threading.get_ident()
    with _LOCK:
        if not isinstance(sys.stderr, _Stream):
            sys.stderr = _Stream(sys.stderr)
        _QUIET[own] = _QUIET.get(own, 0) + 1
    try:
        yield
    finally:
        with _LOCK:
            _QUIET[own] -= 1
            if not _QUIET[own]:
                del _QUIET[own]
            _leave()
