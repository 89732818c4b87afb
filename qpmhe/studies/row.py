"""A row of a study: one dataclass, from which files, summaries, tables and reports take columns."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, fields, replace
from math import nan
from typing import Any

from .._checks import Array

#: Backend of a cell that solves no QP.
OBSERVER = "observer"
#: The observer that a model has.
USUAL_OBSERVER = "model"


@dataclass(frozen=True)
class Cell:
    """What distinguishes one run from all others of a study.

    ``backend`` is `OBSERVER` if no QP is solved, and the name of another
    estimator, which has no ``observer``; ``qps`` is 0 then. ``qps`` is None to iterate to
    convergence; ``solver_iterations``, the cap inside each QP, is None for the solver's default.
    ``noise_level`` multiplies the standard deviations of the simulated disturbance and noise.
    """

    model: str
    backend: str
    qps: int | None
    solver_iterations: int | None
    horizon: int
    start: str
    seed: int
    steps: int
    noise_level: float = 1.0
    observer: str = USUAL_OBSERVER

    @property
    def key(self) -> str:
        """A text that identifies the cell."""
        qps = "converged" if self.qps is None else self.qps
        cap = "none" if self.solver_iterations is None else self.solver_iterations
        level = "" if self.noise_level == 1.0 else f"/noise={self.noise_level:g}"
        observer = "" if self.observer in ("", USUAL_OBSERVER) else f"/observer={self.observer}"
        return (
            f"{self.model}/{self.backend}/i={qps}/cap={cap}/N={self.horizon}/{self.start}"
            f"/T={self.steps}{level}{observer}/seed={self.seed}"
        )

    @property
    def configuration(self) -> tuple[object, ...]:
        """Everything but the seed."""
        return astuple(replace(self, seed=0))


@dataclass(frozen=True)
class Column:
    """How tables show a number.

    Attributes
    ----------
    heading : str
        Its words on a page, without the unit; blank where no table shows it.
    kind : {"number", "seconds", "share", "count"}
        What it is.
    less : bool or None
        Whether less is better; None where neither is.
    rank : int
        Its place on a page. A terminal always shows those of rank 0, and others while there is
        room.
    short, latex : str or None
        Its headings in a terminal and in LaTeX, which show only columns that have one.
    """

    heading: str = ""
    kind: str = "number"
    less: bool | None = None
    rank: int = 0
    short: str | None = None
    latex: str | None = None

    @property
    def scale(self) -> float:
        """The factor to the unit of a page: microseconds or per cent."""
        return {"seconds": 1e6, "share": 100.0}.get(self.kind, 1.0)

    @property
    def title(self) -> str:
        """The heading with the unit."""
        return self.heading + {"seconds": " (µs)", "share": " (%)"}.get(self.kind, "")


def _metric(
    *args: Any, half: Column | None = None, stored: bool = True, **options: Any
) -> Any:
    """A number that is averaged over seeds, and the column of half the width of its limits."""
    return field(
        default=nan, metadata={"column": Column(*args, **options), "half": half, "stored": stored}
    )


@dataclass(frozen=True, kw_only=True)
class StudyRow(Cell):
    """A cell, how it ended, and what was measured in it; NaN or None where it was not.

    Attributes
    ----------
    outcome, reason : str
        ``done`` or ``failed``, and why.
    rmse, rmse_settled, rmse_states, rmse_settled_states, nees, cost, cost_ratio : float or list
        See `qpmhe.studies.metrics`.
    time_median, time_p95, time_p99, time_max : float
        Seconds for each step.
    improved, kept, fallback, reasons, cap_hits, qps_mean, solver_iterations_mean : float or dict
        See `qpmhe.studies.metrics.outcomes`.
    late : float
        Share of steps over the last study's deadline.
    failed_steps : float
        Share of steps at which solver or model failed.
    rmse_excess : float
        ``rmse`` relative to the most accurate configuration's on the same record, minus 1.
    times : array or None
        Seconds of each step.
    shared : bool
        Whether other cells ran meanwhile.
    environment : dict
        What `qpmhe.studies.environment` found; a store has its number.
    finished : str
        When it was stored, UTC.
    parts : set of str
        What was measured.
    trajectory : dict or None
        The run, where it is kept.
    """

    outcome: str
    reason: str = ""
    rmse: float = _metric(
        "RMSE", less=True, short="RMSE", latex="RMSE",
        half=Column("RMSE ±\u00a095\u00a0%", rank=3, short="± 95 %"),
    )
    rmse_settled: float = _metric("RMSE settled", less=True, rank=4, short="RMSE\nsettled")
    rmse_states: list[float] | None = None
    rmse_settled_states: list[float] | None = None
    nees: float = _metric("NEES", short="NEES")
    cost: float = _metric("mean J", less=True, rank=12, short="J", latex=r"$J$")
    cost_ratio: float = _metric(
        "J / converged", less=True, rank=1, short="J /\nconv.", latex=r"$J / J^*$"
    )
    time_median: float = _metric(
        "time median", "seconds", less=True, short="median", latex=r"time ($\mu$s)",
        half=Column("time ±\u00a095\u00a0%", "seconds", rank=13),
    )
    time_p95: float = _metric("time 95\u00a0%", "seconds", less=True, rank=9, short="95 %")
    time_p99: float = _metric("time 99\u00a0%", "seconds", less=True, rank=5, short="99 %")
    time_max: float = _metric("time max", "seconds", less=True, rank=11, short="max")
    late: float = _metric(
        "late", "share", less=True, short="late", latex=r"late (\%)", stored=False
    )
    improved: float = _metric(
        "improved", "share", less=False, rank=2, short="impr.", latex=r"improved (\%)"
    )
    kept: float = _metric("kept", "share", rank=10, short="kept")
    fallback: float = _metric("fallback", "share", less=True, rank=8, short="fall-\nback")
    failed_steps: float = _metric(
        "failed steps", "share", less=True, rank=6, short="failed\nsteps",
        latex=r"failed steps (\%)", stored=False,
    )
    cap_hits: float = _metric("cap hits", "share", rank=7, short="cap\nhits")
    qps_mean: float = _metric("QPs used", rank=14)
    solver_iterations_mean: float = _metric("solver iterations", rank=15)
    rmse_excess: float = _metric(stored=False)
    reasons: dict[str, int] | None = None
    times: Array | None = None
    shared: bool = False
    environment: dict[str, Any]
    finished: str = ""
    parts: frozenset[str]
    trajectory: dict[str, Any] | None = field(default=None, metadata={"stored": False})


#: What distinguishes configurations.
CONFIGURATION = tuple(one.name for one in fields(Cell) if one.name != "seed")
#: What is averaged over seeds.
METRICS = {
    one.name: one.metadata["column"] for one in fields(StudyRow) if "column" in one.metadata
}


def _shown() -> dict[str, Column]:
    found = {"failures": Column("failed runs", "count", rank=6)}
    for one in fields(StudyRow):
        if "column" in one.metadata:
            found[one.name] = one.metadata["column"]
            if one.metadata["half"] is not None:
                found[f"{one.name}_half"] = one.metadata["half"]
    return {name: one for name, one in found.items() if one.heading} | {
        "seeds": Column("seeds", "count", rank=16)
    }


#: The columns of a summary that tables show, in the order of a terminal.
SHOWN = _shown()
#: Those of which half the width of the limits is shown.
HALVES = tuple(name.removesuffix("_half") for name in SHOWN if name.endswith("_half"))
