"""Whether an estimator is healthy, without knowing the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .._checks import positive
from .._linalg import inverse
from ..costs import RobustCost
from ..errors import InvalidInputError, ShapeError
from ..estimation.estimate import Status
from ..estimation.run import Run, RunSource
from .faults import search
from .filter_bank import Filtered, FilterBank, Hypothesis
from .findings import Finding, Names, describe, listed, number, percent
from .observability import Observability, observability, prior_shares
from .stuck import at_end_of_range, comes_back, is_dead, is_rounded, longest_repetition

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fewer measurements than this say nothing about a covariance.
_LEAST_SAMPLES = 30
# The search takes at most so many samples: of a longer record, those least like the model.
_MOST_SAMPLES = 6000
_LAGS = 20
# In deviations of the innovations.
_OUTLIER = 4.0
# The data do not see a direction in which they say so much less than the prior; nor has a filter
# seen it whose variance is still this share of the prior's. It matters if this share remains.
_UNSEEN, _UNLEARNT, _REMAINS = 0.1, 0.5, 0.5
# By how much the estimator's predictions may be worse than those of a Kalman filter.
_WORSE = 1.4
# A repeated number contradicts the filter if innovations are so many deviations off.
_OTHERWISE = 1.7
_FAILING, _KEPT, _WEAK_PRIOR = 0.02, 0.5, 0.1
# Correlations of innovations that matter, and how sure they must be.
_CORRELATED, _SURE = 0.2, 1e-6


@dataclass(frozen=True, eq=False)
class Correlations:
    """Correlations of the normalised innovations.

    Attributes
    ----------
    own : (L + 1, p) array
        Autocorrelation of each sensor's at lags 0, ..., L.
    inputs : (L + 1, p, 2 m) array
        With the inputs and with their changes, so many samples before.
    limit : float
        What 95 % of the correlations of white innovations are within.
    """

    own: Array
    inputs: Array
    limit: float


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `diagnose` has found; its text begins with the findings.

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
        What 99 % of the values lie within, for complete measurements.
    nis_mean, nis_mean_limits : float, (float, float)
        Mean of the NIS for each component measured, and what 99 % of such means lie within.
    correlations : Correlations
        Of the innovations.
    outliers, clipped : (p,) array
        Shares of outlying samples (beyond 4 standard deviations), and of those that are stuck.
    observability : Observability
        What each window says about its first state.
    prior_shares : (K + 1, n) array
        How much the prior still matters, for the horizons 0, ..., K.
    """

    findings: list[Finding]
    notes: list[Finding]
    run: Run
    names: Names
    first: int
    innovations: Array
    nis: Array
    nis_limits: tuple[float, float]
    nis_mean: float
    nis_mean_limits: tuple[float, float]
    correlations: Correlations
    outliers: Array
    clipped: Array
    observability: Observability
    prior_shares: Array

    @property
    def is_healthy(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def __str__(self) -> str:
        count = len(self.findings)
        head = f"{count} finding{'s' * (count != 1)}" if count else "No fault was found"
        lines = [f"{head} in {len(self.run)} samples."]
        lines += [f"{k}. {one}" for k, one in enumerate(self.findings, start=1)]
        if self.notes:
            lines += ["", "Worth knowing:", *(f"- {one}" for one in self.notes)]
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
    runs over the record from the N-th sample on. If all is well, its innovations are white and
    as large as it says. Where they are not, each fault below has a filter of its own, which
    takes the record for what it would be without the fault; the one under which the record is
    most likely is the first finding, and the search goes on beside it.

    * R or Q, of all or of one component, too small or too large by a factor;
    * a biased sensor, throughout or for a time; two sensors that are swapped;
    * a dead sensor, one that is saturated, and outliers;
    * steps of another length, measurements that are late or early, clocks that drift;
    * an input with the wrong sign, or another gain.

    Beside it, it reports directions of the state that the data do not see, innovations that are
    correlated with themselves or with the inputs, steps that kept the candidate, and why, and how
    much the prior still matters.

    Parameters
    ----------
    run : Run
        As `MovingHorizonEstimator.run` returns it.
    labels, outputs, inputs : sequence of str, optional
        Names of the states, of the sensors and of the inputs.
    dt : float, optional
        Length of a step, for the times in the text; the system's if left out, if it has one.
    time_unit : str, optional
        Its unit; ``s`` if left out.

    Returns
    -------
    Diagnosis
        ``print`` shows what was found; `Diagnosis.report` writes a page.

    Raises
    ------
    InvalidInputError, ShapeError
        If the run is none, was not made by `MovingHorizonEstimator.run`, has fewer than 30 samples
        with measurements, or if a name is missing.

    Notes
    -----
    The weights count as inverse covariances, also with a discount. A fault is reported if it
    makes the record more likely by a factor of :math:`e^{12}`, and by 4 % for each measurement
    where it concerns all of them; and if it is large enough to matter. Inputs that a controller
    computes from states that it does not measure can look like delays.

    References
    ----------
    Willsky, A survey of design methods for failure detection in dynamic systems, Automatica 12
    (1976). Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4.
    """
    source = _source(run)
    names = _names(source, len(run), labels, outputs, inputs, dt, time_unit)
    return _Examination(run, source, names).diagnosis()


def _source(run: Run) -> RunSource:
    if not isinstance(run, Run):
        raise InvalidInputError(
            f"run is of type {type(run).__name__}; expected a qpmhe.Run, as "
            "MovingHorizonEstimator.run returns it."
        )
    source = run.source
    if source is None:
        raise InvalidInputError(
            "the run does not know its measurements: it was put together from single estimates, or "
            "unpickled. Diagnose what MovingHorizonEstimator.run returns."
        )
    seen = np.isfinite(source.measurements).any(axis=1)
    if not seen.any():
        raise InvalidInputError(
            f"all measurements of the {len(run)} samples are missing; check the columns and units "
            "of the record: a diagnosis needs measurements."
        )
    if seen.sum() < _LEAST_SAMPLES:
        raise InvalidInputError(
            f"the run has {seen.sum()} samples with measurements; expected at least "
            f"{_LEAST_SAMPLES}, as fewer say nothing about noise. Diagnose a longer run."
        )
    return source


def _names(
    source: RunSource, total: int, labels: Sequence[str] | None, outputs: Sequence[str] | None,
    inputs: Sequence[str] | None, dt: float | None, time_unit: str | None,
) -> Names:
    system, sizes = source.system, {}
    for name, given, letter, size in (
        ("labels", labels, "x", system.n), ("outputs", outputs, "y", system.p),
        ("inputs", inputs, "u", system.m),
    ):
        found = [f"{letter}{i + 1}" for i in range(size)] if given is None else list(given)
        if name == "inputs" and given is not None:  # parameters behind the inputs have no name
            found += [f"u{i + 1}" for i in range(len(found), size)]
        if isinstance(given, str) or len(found) != size or not all(
            isinstance(one, str) for one in found
        ):
            raise ShapeError(f"{name} is {given!r}; expected {size} strings.")
        sizes[name] = found
    step = system.dt if dt is None else positive("dt", dt)
    if source.steps is not None:
        scale = 1.0 if dt is None or system.dt is None else dt / system.dt
        times = scale * np.append(0.0, np.cumsum(source.steps[:-1]))
    else:
        times = (step or 1.0) * np.arange(total)
    unit = "samples" if step is None else time_unit or "s"
    return Names(sizes["labels"], sizes["outputs"], sizes["inputs"], times, unit)


class _Examination:
    """Everything that is computed of a run before there are words."""

    def __init__(self, run: Run, source: RunSource, names: Names) -> None:
        self.run, self.source, self.names = run, source, names
        system, cost = source.system, source.cost
        n = system.n
        self.noise = inverse(cost.noise)
        directions, spread = cost.directions(system.disturbance_matrix), inverse(cost.disturbance)
        self.disturbance = spread if directions is None else directions @ spread @ directions.T
        given = source.observer.initial_covariance() if cost.observer_prior is not None else None
        self.prior = inverse(np.asarray(cost.prior)) if given is None else given
        total = len(run)
        self.first = min(source.settings.horizon, total // 5)
        u = np.zeros((total, 0)) if source.inputs is None else source.inputs
        self.inputs = _held(u)
        self.measurements = source.measurements.copy()
        self.clipped = np.zeros(system.p)
        part = slice(self.first, total)
        steps = None if source.steps is None else source.steps[part]
        start = run.states[self.first]
        if not np.isfinite(start).all():
            start = run.states[0]
        self.bank = FilterBank(system, steps, start, self.prior, self.first)
        self.base = Hypothesis(
            self.measurements[part], self.inputs[part], self.noise, self.disturbance
        )
        self.certain = [*self._failures(), *self._stuck()]
        self.base = replace(self.base, measurements=self.measurements[part])
        with np.errstate(all="ignore"):
            self.null = self.bank.run([self.base])
            self.found, self.best = self._search()
        self.deviations = np.sqrt(self.noise.diagonal())
        self.normalised = _normalised(self.null)
        self.information = self._information(self.null)
        n_windows = len(self.information) - source.settings.horizon + 1
        self.horizon = source.settings.horizon if n_windows > 0 else len(self.information)
        self.transitions = np.where(
            np.isfinite(self.null.transitions), self.null.transitions, np.eye(n)
        )
        self.view = observability(
            self.transitions, self.information, self.disturbance, self.prior, self.horizon
        )

    def _failures(self) -> Iterator[Finding]:
        run = self.run
        for flag, what, remedy in (
            (Status.MODEL_FAILED, "The model failed", "Bound the states, or make the model "
             "defined on all of them; an estimate's message says where it failed."),
            (Status.SOLVER_FAILED, "The QP solver failed", "Take another backend."),
        ):
            share = run.share(flag)
            if share > _FAILING:
                yield Finding("failing", f"{what} at {share:.0%} of the samples.", remedy)

    def _stuck(self) -> Iterator[Finding]:
        """Dead and saturated sensors; what they repeat is no measurement from here on."""
        names, y = self.names, self.measurements
        for j, name in enumerate(names.outputs):
            column = y[:, j]
            seen = np.isfinite(column)
            if not seen.any():
                yield Finding(
                    "missing", f"Sensor {name} has no measurement.",
                    "Check its column, or leave it out of the model.", "warning",
                )
                continue
            first, last = longest_repetition(column)
            at_end, is_saturated = at_end_of_range(column)
            row = np.zeros(column.size, np.bool_)
            row[first : last + 1] = True
            alone = is_dead(column, first, last)
            if (alone or is_saturated) and is_rounded(column[~(row | at_end)]):
                # A sensor with coarse steps repeats its numbers where little moves.
                alone &= self._contradicts(row, j)
                is_saturated &= self._contradicts(at_end, j)
            if is_saturated and (
                (at_end & ~row).any() or (at_end[first] and comes_back(column, first, last))
            ):
                value = column[at_end][0]
                which = "largest" if value == np.nanmax(column) else "smallest"
                self.clipped[j] = at_end[seen].mean()
                yield Finding(
                    "saturated",
                    f"Sensor {name} is saturated: {self.clipped[j]:.0%} of its samples are stuck "
                    f"at {number(value)}, the {which} one.",
                    "Pass NaN where it is at the end of its range, or take one with a wider range.",
                    where=names.span(*np.flatnonzero(at_end)[[0, -1]]),
                )
                column[at_end] = np.nan
                if not alone or at_end[first]:
                    continue
            if alone:
                self.clipped[j] += row[seen].mean()
                stretch = names.between(first, last) or " throughout"
                yield Finding(
                    "dead", f"Sensor {name} is dead: it repeats {number(column[first])}{stretch}.",
                    "Pass NaN for these samples, and check its cable and its power.",
                    where=names.span(first, last),
                )
                column[row] = np.nan

    def _contradicts(self, repeated: Mask, sensor: int) -> bool:
        """Whether the filter expects other numbers than those a sensor repeats."""
        part = repeated[self.first :]
        with np.errstate(all="ignore"):
            errors = _normalised(self.bank.run([self.base]))[part, sensor]
        return bool(part.any() and np.sqrt(np.nanmean(errors**2)) > _OTHERWISE)

    def _search(self) -> tuple[list[Any], Filtered]:
        """Faults of the whole record, or of the part of a long one that fits least."""
        total = len(self.base.measurements)
        if total <= _MOST_SAMPLES:
            faults, passes = search(self.bank, self.base)
            return faults, passes[-1]
        errors = np.nan_to_num(_normalised(self.null)) ** 2
        sums = np.append(0.0, np.cumsum(errors.sum(axis=1)))
        begin = int(np.argmax(sums[_MOST_SAMPLES:] - sums[:-_MOST_SAMPLES]))
        part = slice(begin, begin + _MOST_SAMPLES)
        steps = None if self.source.steps is None else self.source.steps[self.first :][part]
        start = self.run.states[self.first + begin]
        bank = FilterBank(self.source.system, steps, start, self.prior, self.first + begin)
        base = replace(
            self.base, measurements=self.base.measurements[part], inputs=self.base.inputs[part]
        )
        faults, passes = search(bank, base)
        moved = [
            replace(one, span=(begin, begin + _MOST_SAMPLES - 1) if one.span is None
                    else (one.span[0] + begin, one.span[1] + begin))
            for one in faults
        ]
        return moved, passes[-1]

    def _information(self, found: Filtered) -> Array:
        """C^T R C of each sample, with the weight R of what was measured."""
        seen = np.isfinite(found.innovations)
        information = np.zeros((len(seen), self.source.system.n, self.source.system.n))
        for pattern in np.unique(seen, axis=0):
            if pattern.any():
                at = (seen == pattern).all(axis=1)
                c = found.outputs[at][:, pattern]
                weight = inverse(self.noise[np.ix_(pattern, pattern)])
                information[at] = np.einsum("tji,jk,tkl->til", c, weight, c)
        return np.where(np.isfinite(information), information, 0.0)

    def diagnosis(self) -> Diagnosis:
        names, first = self.names, self.first
        total, p = self.measurements.shape
        nis, seen = self._nis()
        correlations = self._correlations(self.normalised)
        far = np.abs(self.normalised) > _OUTLIER
        outliers = far.sum(axis=0) / np.maximum(np.isfinite(self.normalised).sum(axis=0), 1)
        shares = self._prior_shares()
        findings, notes = list(self.certain), []
        for one in self.found:
            span = None if one.span is None else (one.span[0] + first, one.span[1] + first)
            if span is None and first:  # the start is no evidence, nor an exception
                span = None
            elif span is not None and span[0] == first:
                span = (0, span[1])
            told = describe(replace(one, span=span), names, self.deviations, outliers)
            if one.kind == "outliers" and isinstance(self.source.cost, RobustCost):
                notes.append(replace(told, severity="note", remedy="The cost is robust."))
            else:
                findings.append(told)
        findings += self._unseen()
        if not findings:
            findings += self._correlated(self._correlations(_normalised(self.best)))
            findings += self._worse()
        components = int(seen.sum())
        limits = tuple(chi2.ppf((0.005, 0.995), components) / components)
        mean = float(np.nansum(nis) / components)
        notes += self._notes(mean, limits, outliers, shares)
        if not findings:
            notes += self._input_notes(correlations)
        before = np.full((first, p), np.nan)
        return Diagnosis(
            findings, notes, self.run, names, first, np.vstack((before, self.normalised)),
            np.append(before[:, 0], nis), tuple(chi2.ppf((0.005, 0.995), p).tolist()), mean,
            (float(limits[0]), float(limits[1])), correlations, outliers, self.clipped,
            self.view, shares,
        )

    def _nis(self) -> tuple[Array, Mask]:
        seen = np.isfinite(self.null.innovations)
        errors = np.where(seen, self.null.innovations, 0.0)
        weighted = np.linalg.solve(self.null.innovation_covariances, errors[:, :, None])[:, :, 0]
        return np.where(seen.any(axis=1), np.einsum("ti,ti->t", errors, weighted), np.nan), seen

    def _correlations(self, normalised: Array) -> Correlations:
        """Correlations of innovations; outliers count as the limit that they exceed."""
        total, p = normalised.shape
        lags = min(_LAGS, total // 4)
        bounded = np.clip(normalised, -_OUTLIER, _OUTLIER)
        own = np.ones((lags + 1, p))
        signals = self.inputs[self.first :][: total]
        changes = np.diff(signals, axis=0, prepend=signals[:1])
        both = np.hstack((signals, changes))
        inputs = np.zeros((lags + 1, p, both.shape[1]))
        for j in range(p):
            # A controller may use y(t) for u(t): only earlier inputs are evidence.
            for lag in range(1, lags + 1):
                own[lag, j] = _correlation(bounded[lag:, j], bounded[: total - lag, j])
                for k in range(both.shape[1]):
                    inputs[lag, j, k] = _correlation(bounded[lag:, j], both[: total - lag, k])
        return Correlations(own, inputs, 1.96 / np.sqrt(total))

    def _correlated(self, found: Correlations) -> Iterator[Finding]:
        total, names = len(self.normalised), self.names
        lags = len(found.own) - 1
        for j, name in enumerate(names.outputs):
            own = found.own[1:, j]
            portmanteau = total * (total + 2) * np.sum(own**2 / (total - np.arange(1, lags + 1)))
            k = int(np.argmax(np.abs(own)))
            if chi2.sf(portmanteau, lags) < _SURE and abs(own[k]) > _CORRELATED:
                yield Finding(
                    "correlated",
                    f"The innovations of sensor {name} are not white: their correlation is "
                    f"{number(own[k])} over {names.samples(k + 1)}, where "
                    f"{number(found.limit)} is the limit.",
                    "The model lacks something slow: a bias, a parameter or a state.", "warning",
                )

    def _input_notes(self, found: Correlations) -> Iterator[Finding]:
        names = self.names
        signals = [*names.inputs, *(f"the change of {one}" for one in names.inputs)]
        sure = np.sqrt(chi2.isf(_SURE, 1) / len(self.normalised))
        for j, k in np.ndindex(*found.inputs.shape[1:]):
            strongest = float(np.abs(found.inputs[:, j, k]).max())
            if strongest > max(_CORRELATED, sure):
                yield Finding(
                    "correlated",
                    f"The innovations of sensor {names.outputs[j]} are correlated with "
                    f"{signals[k]}, by {number(strongest)}, where {number(found.limit)} is the "
                    "limit.",
                    "The model may lack an effect of this input, unless a controller computes it "
                    "from states that are not measured.", "note",
                )

    def _unseen(self) -> Iterator[Finding]:
        """Directions that the data do not see, that no filter has learnt, and that stay."""
        view, names, length = self.view, self.names, self.horizon
        units = np.sqrt(self.prior.diagonal())
        units = np.where(units > 0.0, units, 1.0)
        ends = self.null.covariances[length - 1 :]
        count = len(ends)
        vectors = view.directions[:count, :, 0]  # the weakest
        learnt = np.einsum("wi,wij,wj->w", vectors / units, ends, vectors / units)
        blind = (
            (view.values[:count, 0] < _UNSEEN) & (view.remaining[:count, 0] > _REMAINS)
            & (learnt > _UNLEARNT)
        )
        edges = np.flatnonzero(np.diff(np.concatenate(([0], blind.astype(int), [0]))))
        for begin, end in edges.reshape(-1, 2):
            last = end - 1 + length
            if last - begin < max(2 * length, 0.1 * count):
                continue
            middle = vectors[(begin + end) // 2]
            whole = begin == 0 and end == count
            span = (0, len(names.times) - 1) if whole else (begin + self.first, last + self.first - 1)
            yield Finding(
                "unseen",
                f"{_direction(middle, names.states)} is not seen by the data"
                f"{names.between(*span)}.",
                "Excite it, give the prior or Q of it less room, or leave it out of the state.",
                where=None if whole else names.span(*span),
            )

    def _worse(self) -> Iterator[Finding]:
        """Whether the estimator predicts worse than the filter, by the same measure."""
        part = slice(self.first, len(self.run))
        system = self.source.system
        states = self.run.states[:-1][part]
        with np.errstate(all="ignore"):
            expected, _ = self.bank.moves(states, self.bank.full_inputs(self.base.inputs))
        errors = self.base.measurements - expected
        if system.output_residual is not None:
            system.output_residual.wrap(errors, self.base.measurements)
        spread = np.sqrt(np.diagonal(self.null.innovation_covariances, axis1=1, axis2=2))
        own = np.nanmean(np.clip(errors / spread, -_OUTLIER, _OUTLIER) ** 2)
        filter_s = np.nanmean(np.clip(self.normalised, -_OUTLIER, _OUTLIER) ** 2)
        ratio = float(np.sqrt(own / filter_s)) if filter_s > 0.0 else 1.0
        if ratio > _WORSE:
            settings, kept = self.source.settings, self.run.share(Status.CANDIDATE)
            remedy = (
                "Raise max_qps." if settings.max_qps == 0 or kept > _KEPT
                else "Raise max_qps or the horizon, or let the observer's covariance weigh the prior."
            )
            yield Finding(
                "estimator",
                f"The estimator predicts its measurements {number(ratio)} times worse than an "
                "extended Kalman filter with the same weights.", remedy, "warning",
            )

    def _prior_shares(self) -> Array:
        usual = self.prior
        if self.source.cost.observer_prior is not None:
            # The filter's own covariance before a measurement is what weighs its prior.
            k = len(self.null.covariances) // 2
            a = self.transitions[k]
            usual = a @ self.null.covariances[k] @ a.T + self.disturbance
        longest = min(len(self.transitions), max(50, 5 * self.horizon), 500)
        return prior_shares(
            self.transitions, self.information, self.disturbance, usual,
            max(longest, self.horizon),
        )

    def _notes(
        self, mean: float, limits: Sequence[float], outliers: Array, shares: Array
    ) -> Iterator[Finding]:
        names, run = self.names, self.run

        def note(kind: str, text: str, remedy: str = "") -> Finding:
            return Finding(kind, text, remedy, "note")

        yield note(
            "innovations",
            f"The mean NIS of a measurement is {mean:.2f}; {limits[0]:.2f} to {limits[1]:.2f} is to "
            "be expected.",
        )
        missing = ~np.isfinite(self.source.measurements)
        some = [
            f"{share:.0%} of {name}"
            for name, share in zip(names.outputs, missing.mean(axis=0), strict=True) if share > 0.0
        ]
        if some:
            yield note("record", f"Missing: {listed(some)}.")
        yield self._prior_note(shares)
        kept = run.share(Status.CANDIDATE)
        if kept > 0.0:
            why = [
                f"{flag.name} ({share:.0%})"
                for flag in Status
                if flag not in (Status.CANDIDATE, Status.IMPROVED) and flag.name is not None
                and (share := run.share(Status.CANDIDATE | flag)) > 0.0
            ]
            because = f", with {listed(why)}" if why else ""
            yield note(
                "kept", f"The candidate was kept at {kept:.0%} of the samples{because}.",
                "Estimate.explain says what to do about each." if kept > _KEPT else "",
            )
        constant = self._constants()
        third = len(run) // 3
        for i in constant:
            early, late = (run.states[a:b, i].mean() for a, b in ((self.first, third), (-third, None)))
            sigma = float(np.sqrt(self.null.covariances[-1, i, i]))
            if np.isfinite(late - early) and sigma > 0.0 and abs(late - early) > 3.0 * sigma:
                yield note(
                    "drift", f"{names.states[i]} drifts from {number(early)} to {number(late)}, "
                    f"{number(abs(late - early) / sigma)} of its standard deviations.",
                )

    def _prior_note(self, shares: Array) -> Finding:
        names, horizon = self.names, self.horizon
        i = int(np.argmax(shares[horizon]))
        share, state = shares[horizon, i], names.states[i]
        enough = np.flatnonzero(shares.max(axis=1) < _WEAK_PRIOR)
        if share < _WEAK_PRIOR:
            text = (
                f"With N = {horizon} the prior carries {percent(share)} of the variance of {state}'s "
                "estimate, and less of the others'"
            )
            text += f"; from N = {enough[0]} on it is below 10 %."
            return Finding("prior", text, "", "note")
        text = f"With N = {horizon} the prior still carries {percent(share)} of the variance of {state}'s "
        text += "estimate; "
        text += (
            f"N = {enough[0]} would bring that below 10 %." if enough.size
            else f"no N up to {len(shares) - 1} brings that below 10 %."
        )
        remedy = "" if self.source.cost.observer_prior is not None else (
            "So its weight matters: let qpmhe.tune choose it, or a Kalman-type observer by "
            "qpmhe.ObserverPrior."
        )
        return Finding("prior", text, remedy, "note")

    def _constants(self) -> list[int]:
        """The states that the model keeps: parameters."""
        n = self.source.system.n
        inputs = self.bank.full_inputs(self.base.inputs)
        with np.errstate(all="ignore"):
            reached = self.bank.model.f.batch(self.null.corrected, inputs)
        kept = (reached == self.null.corrected).all(axis=0)
        moved = np.abs(self.transitions - np.eye(n)).max(axis=(0, 2))
        return [i for i in range(n) if kept[i] and moved[i] == 0.0]


def _normalised(found: Filtered) -> Array:
    spread = np.diagonal(found.innovation_covariances, axis1=1, axis2=2)
    normalised: Array = found.innovations / np.sqrt(spread)
    return normalised


def _held(inputs: Array) -> Array:
    """Inputs without gaps: the last value holds, and zero before the first."""
    held = inputs.copy()
    for column in held.T:
        there = np.isfinite(column)
        last = np.maximum.accumulate(np.where(there, np.arange(column.size), -1))
        column[...] = np.where(last >= 0, column[np.maximum(last, 0)], 0.0)
    return held


def _correlation(one: Array, other: Array) -> float:
    there = np.isfinite(one) & np.isfinite(other)
    if there.sum() < 3:
        return 0.0
    one, other = one[there] - one[there].mean(), other[there] - other[there].mean()
    size = float(np.sqrt(one.dot(one) * other.dot(other)))
    return float(one.dot(other)) / size if size > 0.0 else 0.0


def _direction(vector: Array, names: Sequence[str]) -> str:
    """A direction in deviations of the prior, by the states that it consists of."""
    shares = vector**2 / (vector @ vector)
    largest = np.argsort(-shares)
    if shares[largest[0]] > 0.8:
        return str(names[largest[0]])
    chosen = [i for i in largest if shares[i] > 0.1][:3]
    sign = np.sign(vector[chosen[0]])
    terms = [f"{sign * vector[i]:+.2g} {names[i]}" for i in chosen]
    return f"The combination {' '.join(terms).removeprefix('+')} (in deviations of the prior)"
