"""Evaluation of CasADi's solvers without the lines that they print where they fail."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_LOCK = threading.Lock()
_QUIET: dict[int, int] = {}  # how many evaluations go on in each thread, within each other
_KEPT: list[Any] = []  # the stream in whose place `_Stream` is


class _Stream:
    """Standard error, without what the threads in `_QUIET` write."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if self._stream is None or threading.get_ident() in _QUIET:
            return len(text)
        written: int = self._stream.write(text)
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def quiet() -> Iterator[None]:
    """Drop what this thread writes to ``sys.stderr``, where CasADi reports on failures."""
    own = threading.get_ident()
    with _LOCK:
        if not _QUIET:
            _KEPT.append(sys.stderr)
            sys.stderr = _Stream(sys.stderr)
        _QUIET[own] = _QUIET.get(own, 0) + 1
    try:
        yield
    finally:
        with _LOCK:
            _QUIET[own] -= 1
            if not _QUIET[own]:
                del _QUIET[own]
            if not _QUIET:
                kept = _KEPT.pop()
                if isinstance(sys.stderr, _Stream):  # nobody else has replaced it since
                    sys.stderr = kept
