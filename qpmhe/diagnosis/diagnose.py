"""Check whether an estimator is healthy, without knowing the truth."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import positive
from ..errors import InvalidInputError, OptionError, ShapeError
from ..estimation.run import Run, RunSource
from ..estimation.time_index import unit_name
from .examination import LEAST_SAMPLES, Examination
from .findings import Finding, Names

Array = NDArray[np.float64]

_WIDTH = 92  # of the text


class Diagnosis(Examination):
    """The result of `diagnose`; its text begins with the findings.

    Attributes
    ----------
    findings : list of Finding
        What is wrong, the worst first; empty for a healthy run.
    notes : list of Finding
        What else is worth knowing.
    run : Run
        What was diagnosed.
    names : Names
        Names of the signals, and times of the samples.
    first : int
        The sample from which on the filter ran: the start of the estimation is no evidence.
    innovations : (T, p) array
        Innovations of the Kalman filter in their standard deviations, NaN where there are none.
    nis : (T,) array
        Normalised innovation squared, e^T S^-1 e.
    nis_limits : (float, float)
        Limits that contain 99 % of the values, for complete measurements.
    nis_mean, nis_mean_limits : float, (float, float)
        Mean NIS per measured component, and limits that contain 99 % of such means.
    correlations : Correlations
        Of the innovations.
    outliers, clipped : (p,) array
        Shares of outlying samples (beyond 4 standard deviations), and of those that are stuck.
    observability : Observability
        What each window says about its first state.
    prior_shares : (K + 1, n) array
        How much the prior still matters, for the horizons 0, ..., K.
    """

    @property
    def is_healthy(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    @property
    def verdict(self) -> str:
        """How many findings there are, and which date is time 0, where the record has dates."""
        count = len(self.findings)
        head = f"{count} finding{'s' * (count != 1)}" if count else "No fault was found"
        dates = self.run.index if hasattr(self.run.index, "tz") else None
        since = "" if dates is None else f"; times are counted from {dates[0]}"
        return f"{head} in {len(self.run)} samples{since}."

    def __repr__(self) -> str:
        found = ", ".join(one.kind for one in self.findings)
        return f"Diagnosis({self.verdict.rstrip('.')}{f': {found}' if found else ''})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.verdict)}</p>" + "".join(
            f"<{tag}>{''.join(f'<li>{escape(str(one))}</li>' for one in group)}</{tag}>"
            for tag, group in (("ol", self.findings), ("ul", self.notes)) if group
        )

    def __str__(self) -> str:
        lines = [self.verdict]
        lines += [_wrapped(f"{k}. ", one) for k, one in enumerate(self.findings, start=1)]
        if self.notes:
            lines += ["", "Worth knowing:", *(_wrapped("- ", one) for one in self.notes)]
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw all figures of the report, one above the other; return the matplotlib figure."""
        from .health import draw

        return draw(self)

    def report(self, path: str | Path) -> Path:
        """Write an HTML page with the findings and the figures, which needs no other file.

        Parameters
        ----------
        path : str or Path
            The file to write; its folder is made, and a file of this name replaced.

        Raises
        ------
        InvalidInputError
            If it cannot be written.
        """
        from .health import write_page

        return write_page(self, path)


def _wrapped(mark: str, one: Finding) -> str:
    return fill(str(one), _WIDTH, initial_indent=mark, subsequent_indent=" " * len(mark))


def diagnose(
    run: Run,
    *,
    labels: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    dt: float | None = None,
    time_unit: str | None = None,
) -> Diagnosis:
    r"""Look for faults in a run, its record, model and weights; no truth is needed.

    An extended Kalman filter with the model, and with the inverse weights Q, R as covariances,
    runs over the record from the N-th sample on, or from the tenth. If all is well, its
    innovations are white and have the predicted covariance. Where they do not, each fault below
    has filters that correct the record for this fault. All are judged by the likelihood of the same
    measurements; the best is the first finding, with those that the record cannot tell from it
    (`Finding.equals`). The search for others continues with it corrected. In the end factors of R
    and Q are searched together; they are named only if the innovations are white with them. The ten
    measurements after a gap of ten samples or more are no evidence.

    * an integration step that is too long for the disturbance's size;
    * R or Q, of all or of one component, too small or too large by a factor; R that changes once;
    * a biased sensor, throughout, for a time or growing, one in another unit; two that are swapped;
    * a dead sensor, one that is saturated or rounded, outliers;
    * noise of a sensor that is correlated in time, or a lag of the first order;
    * steps of another length, measurements that are late or early, clocks that drift, times that
      scatter, rows that are missing or there twice;
    * an input with the wrong sign, or another gain; one of the estimator's `parameters` that is
      wrong.

    It also reports directions of the state that the data do not see, or that seem to be seen at
    the points of linearisation alone, innovations that are
    correlated with themselves or with the inputs, steps that kept the candidate, with the reason,
    and how much the prior still matters.

    Parameters
    ----------
    run : Run
        As `MovingHorizonEstimator.run` returns it.
    labels, outputs, inputs : sequence of str, optional
        Names of the states, of the sensors and of the inputs.
    dt : float, optional
        Length of a step, for the times in the text; the system's if left out, if it has one.
    time_unit : str, optional
        Its unit; the run's if left out.

    Returns
    -------
    Diagnosis
        ``print`` shows what was found; `Diagnosis.report` writes a page.

    Raises
    ------
    InvalidInputError, ShapeError
        If this is not a run, or `MovingHorizonEstimator.run` did not make it; if it has fewer than
        30 samples with measurements, or a name is missing.

    Notes
    -----
    The weights count as inverse covariances, also with a discount. A fault is reported if it
    makes the record more likely by a factor of :math:`e^{12}`, up to :math:`e^{24}` where
    measurements are missing, and, where it concerns all of them, by 3.5 % for each, no sample
    counting for more than a factor of :math:`e^3`; and if it is large enough to matter. Where it
    may concern few samples, :math:`\tfrac12 k \log T` comes on top for k numbers that the record
    determines, such as a size and a beginning. `causes.py` has the table of all hypotheses.
    Inputs that a controller computes from states that it does not measure can look like delays.

    References
    ----------
    Willsky, A survey of design methods for failure detection in dynamic systems, Automatica 12
    (1976). Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4.
    """
    source = _source(run)
    names = _names(source, len(run), labels, outputs, inputs, dt, time_unit)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # A filter under a wrong hypothesis may diverge, and a sensor have no measurement.
        warnings.simplefilter("ignore", RuntimeWarning)
        return Diagnosis(run, source, names)


def _source(run: Run) -> RunSource:
    if not isinstance(run, Run):
        raise InvalidInputError(
            f"run is of type {type(run).__name__}; expected a qpmhe.Run, as "
            "MovingHorizonEstimator.run returns it."
        )
    source = run.source
    if source is None:
        raise InvalidInputError(
            "the run has no measurements: it was loaded from a file, unpickled, or assembled from "
            "single estimates, and such a run has no record, model and weights. Run the estimator "
            "over the record again, and diagnose the run that MovingHorizonEstimator.run returns."
        )
    seen = np.isfinite(source.measurements).any(axis=1)
    if not seen.any():
        raise InvalidInputError(
            f"all measurements of the {len(run)} samples are missing; check the columns and units "
            "of the record: a diagnosis needs measurements."
        )
    if seen.sum() < LEAST_SAMPLES:
        raise InvalidInputError(
            f"the run has {seen.sum()} samples with measurements; expected at least "
            f"{LEAST_SAMPLES}, as fewer say nothing about noise. Diagnose a longer run."
        )
    return source


def _names(
    source: RunSource, total: int, labels: Sequence[str] | None, outputs: Sequence[str] | None,
    inputs: Sequence[str] | None, dt: float | None, time_unit: str | None,
) -> Names:
    system, found = source.system, []
    for name, given, letter, size in (
        ("labels", labels, "x", system.n), ("outputs", outputs, "y", system.p),
        ("inputs", inputs, "u", system.m),
    ):
        usual = [f"{letter}{i + 1}" for i in range(size)]
        fits = given is None or (isinstance(given, Iterable) and not isinstance(given, str))
        texts = list(given or usual) if fits else []
        if name == "inputs":  # parameters behind the inputs have no name
            texts += usual[len(texts) :]
        if len(texts) != size or not all(isinstance(one, str) for one in texts):
            raise ShapeError(f"{name} is {given!r}; expected {size} strings.")
        found.append(texts)
    step = system.dt if dt is None else positive("dt", dt)
    times = (step or 1.0) * np.arange(total, dtype=np.float64)
    if source.steps is not None:
        scale = 1.0 if dt is None or system.dt is None else dt / system.dt
        times[1:] = np.cumsum(source.steps[:-1])
        times *= scale
    if not (time_unit is None or isinstance(time_unit, str)):
        raise OptionError(f"time_unit is {time_unit!r}; expected a string, such as 'h'.")
    unit = "samples" if step is None else time_unit or unit_name(source.time_unit)
    return Names(found[0], found[1], found[2], times, unit)
