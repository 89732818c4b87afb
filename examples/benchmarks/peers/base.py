"""What the benchmark asks of an estimator, and what it hands to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from problems import Problem

__all__ = ["Array", "Peer", "UnavailableError", "WindowData"]

Array = NDArray[np.float64]


class UnavailableError(Exception):
    """A peer that cannot be had here, with the reason."""


@dataclass(frozen=True)
class WindowData:
    """One window's problem, the same for all estimators, and a start for its solution.

    Parameters
    ----------
    newest : (p,) array
        y(t).
    newest_input : (m,) array
        u(t).
    prior : (n,) array
        The prior z(t+1-K), of our observer.
    measurements : (K, p) array
        y(t+1-K), ..., y(t).
    inputs : (K, m) array
        u(t+1-K), ..., u(t).
    candidate : (K + 1, n) array
        The observer's states z(t+1-K), ..., z(t+1).
    disturbances : (K, n) array
        w along the candidate.
    """

    newest: Array
    newest_input: Array
    prior: Array
    measurements: Array
    inputs: Array
    candidate: Array
    disturbances: Array


class Peer(ABC):
    """An estimator beside others.

    Attributes
    ----------
    name : str
        As in the tables.
    package : str
        Distribution on PyPI, whose version is printed.
    limitations : str
        What is not as in the others, or not as fast as it could be.
    kind : {"qpmhe", "peer", "other"}
        Ours; another tool on the same problem; or one that solves another problem.
    converges : bool
        Whether it says that its answers minimise J; this is checked.
    recursive : bool
        Whether it must see every sample from the first on, not only full windows.
    outside : bool
        Whether it computes in another process, so that only the wall clock sees it.
    most_calls : int or None
        Calls after which it is spared, where it is very slow.
    """

    name = ""
    package = ""
    limitations = ""
    kind = "peer"
    converges = True
    recursive = False
    outside = False
    most_calls: int | None = None

    @abstractmethod
    def setup(self, problem: Problem) -> None:
        """Build what can be built once.

        Raises
        ------
        UnavailableError
            If the tool is not installed or cannot do this problem.
        """

    def restart(self) -> None:
        """Get ready for another record."""

    @abstractmethod
    def update(self, window: WindowData) -> Array:
        """The trajectory (K + 1, n) of a window, or the state (n,) at its end."""

    def close(self) -> None:
        """Give back files and processes."""
