"""One cell of a study: an estimator on a record."""

from __future__ import annotations

from dataclasses import dataclass

from qpmhe_solvers import Backend

from .sources import Source

__all__ = ["OBSERVER", "Cell", "Task"]

#: What the backend of a cell without QPs is called.
OBSERVER = "observer"


@dataclass(frozen=True)
class Cell:
    """What tells one run from all others.

    Parameters
    ----------
    model : str
        As the study names it.
    backend : str
        QP backend; `OBSERVER` where no QP is solved.
    qps : int or None
        QPs per sample; None is convergence.
    solver_iterations : int or None
        Cap inside each QP; None is the solver's default.
    horizon : int
        N.
    start : str
        Where the sequences of QPs start.
    seed : int
        Seed of the record.
    steps : int
        Samples of the record.
    """

    model: str
    backend: str
    qps: int | None
    solver_iterations: int | None
    horizon: int
    start: str
    seed: int
    steps: int

    @property
    def key(self) -> str:
        """A text that only this cell has."""
        return (
            f"{self.model}/{self.backend}/i={_or(self.qps, 'converged')}"
            f"/cap={_or(self.solver_iterations, 'none')}/N={self.horizon}/{self.start}"
            f"/T={self.steps}/seed={self.seed}"
        )

    @property
    def configuration(self) -> tuple[object, ...]:
        """Everything but the seed."""
        return (
            self.model, self.backend, self.qps, self.solver_iterations, self.horizon, self.start,
            self.steps,
        )


@dataclass(frozen=True)
class Task:
    """A cell on its way to a worker.

    Parameters
    ----------
    cell : Cell
        What to run.
    source : Source
        Where its model comes from.
    parts : frozenset of str
        What is wanted: "accuracy", "time", "covariance".
    timeout : float
        Seconds after which the cell gives up between two steps.
    keep : bool
        Whether the trajectory is wanted.
    shared : bool
        Whether other cells run on the same machine at the same time.
    entry : Backend, optional
        The backend's entry, for workers where it is not registered.
    notes : str, optional
        Folder in which the worker notes what it is at.
    parent : int, optional
        Process with which the worker ends.
    isolated : str
        Why its backend runs in a process of its own; empty where it does not.
    """

    cell: Cell
    source: Source
    parts: frozenset[str]
    timeout: float
    keep: bool = False
    shared: bool = False
    entry: Backend | None = None
    notes: str | None = None
    parent: int | None = None
    isolated: str = ""

    @property
    def hard_limit(self) -> float:
        """Seconds after which the process that runs it is ended."""
        return 1.5 * self.timeout + 1.0


def _or(value: int | None, nothing: str) -> str:
    return nothing if value is None else str(value)
