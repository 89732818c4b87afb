"""Everything that is computed of a run to tell whether it is healthy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .._linalg import inverse
from ..costs import RobustCost
from ..estimation.estimate import Status
from ..estimation.observability import observability, prior_shares, prior_units
from ..estimation.run import Run, RunSource
from ..model.residuals import difference
from .faults import Fault, search
from .filter_bank import FilterBank, Filtered, Hypothesis
from .findings import Finding, Names, describe, listed, number, percent
from .stuck import at_end_of_range, comes_back, is_dead, is_rounded, longest_repetition

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
# How far from one the observer's error may be, in deviations of the prior.
_SUITS = 0.3, 1.5
# Correlations of innovations that matter, and how sure they must be.
_CORRELATED, _SURE = 0.2, 1e-6
# Samples at the start, at least, that are no evidence: a filter needs some to forget it.
_START = 10


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


class Examination:
    """What `diagnose` knows of a run: its attributes are those of a `Diagnosis`."""

    def __init__(self, run: Run, source: RunSource, names: Names) -> None:
        self.run, self.source, self.names = run, source, names
        system, cost = source.system, source.cost
        n = system.n
        self.noise = inverse(cost.noise)
        self.deviations = np.sqrt(self.noise.diagonal())
        directions = cost.directions(system.disturbance_matrix)
        self.disturbance = spread = inverse(cost.disturbance)
        if directions is not None:
            self.disturbance = directions @ spread @ directions.T
        given = source.observer.initial_covariance() if cost.observer_prior is not None else None
        self.prior = inverse(np.asarray(cost.prior)) if given is None else given
        total = len(run)
        self.first = min(max(source.settings.horizon, _START), total // 5)
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
        self.null = self.bank.run([self.base])
        self.found, self.best = self._search()
        self.normalised = _normalised(self.null)
        # What the windows see is examined along the states of the filter that explains the record.
        same = len(self.best.states) == len(self.null.states)
        self.along = self.best if same and np.isfinite(self.best.likelihoods[0]) else self.null
        self.information = self._information(self.along)
        n_windows = len(self.information) - source.settings.horizon + 1
        self.horizon = source.settings.horizon if n_windows > 0 else len(self.information)
        self.transitions = np.where(
            np.isfinite(self.along.transitions), self.along.transitions, np.eye(n)
        )
        self.view = observability(
            self.transitions, self.information, self.disturbance, self.prior, self.horizon
        )
        seen, p = np.isfinite(self.null.innovations), system.p
        self.nis = self._nis(seen)
        self.nis_limits, _ = _limits(p)
        count = max(1, int(seen.sum()))
        self.nis_mean = float(np.nansum(self.nis) / count)
        _, self.nis_mean_limits = _limits(count)
        self.correlations = self._correlations(self.normalised)
        far = np.abs(self.normalised) > _OUTLIER
        if self.along.innovations.shape == far.shape:  # those that the search has left out, if any
            left_out = np.isfinite(self.base.measurements) & ~np.isfinite(self.along.innovations)
            far = left_out if left_out.any() else far
        self.outliers: Array = far.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        self.prior_shares = self._prior_shares()
        self.findings: list[Finding] = []
        self.notes: list[Finding] = []
        self._conclude()

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
            is_coarse = is_rounded(column, row | at_end, self.deviations[j])
            if (alone or is_saturated) and is_coarse:
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
        errors = _normalised(self.bank.run([self.base]))[part, sensor]
        errors = errors[np.isfinite(errors)]
        return bool(errors.size and np.sqrt(np.mean(errors**2)) > _OTHERWISE)

    def _search(self) -> tuple[list[Fault], Filtered]:
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

    def _conclude(self) -> None:
        """Put everything into words, what is certain first."""
        found, first = self.found, self.first
        findings, notes = self.findings, self.notes
        findings += self.certain
        for one in found:
            span = None
            if one.span is not None:  # before the filter began there is no evidence, nor an end
                span = (one.span[0] + first if one.span[0] else 0, one.span[1] + first)
            told = describe(replace(one, span=span), self.names, self.deviations, self.outliers)
            if one.kind == "outliers" and isinstance(self.source.cost, RobustCost):
                notes.append(replace(told, severity="note", remedy="The cost is robust."))
            else:
                findings.append(told)
        findings += self._unseen()
        if not findings and np.isfinite(self.normalised).any():
            findings += self._correlated()
            findings += self._worse()
        notes += self._notes()
        if not findings:
            notes += self._input_notes()

    def _nis(self, seen: Mask) -> Array:
        errors = np.where(seen, self.null.innovations, 0.0)
        weighted = np.linalg.solve(self.null.innovation_covariances, errors[:, :, None])[:, :, 0]
        return np.where(seen.any(axis=1), np.einsum("ti,ti->t", errors, weighted), np.nan)

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
        seen = int(np.isfinite(normalised).any(axis=1).sum())
        return Correlations(own, inputs, 1.96 / np.sqrt(max(seen, 1)))

    def _correlated(self) -> Iterator[Finding]:
        innovations = _normalised(self.best)
        found, there = self._correlations(innovations), np.isfinite(innovations)
        total, names = len(self.normalised), self.names
        lags = len(found.own) - 1
        weights = total * (total + 2) / (total - np.arange(1, lags + 1)) ** 2
        for j, name in enumerate(names.outputs):
            own = found.own[1:, j]
            # Only pairs of which both were measured are evidence.
            pairs = [(there[lag:, j] & there[:-lag, j]).sum() for lag in range(1, lags + 1)]
            portmanteau = np.sum(weights * pairs * own**2)
            k = int(np.argmax(np.abs(own)))
            if chi2.sf(portmanteau, lags) < _SURE and abs(own[k]) > _CORRELATED:
                yield Finding(
                    "correlated",
                    f"The innovations of sensor {name} are not white: their correlation is "
                    f"{number(own[k])} over {names.samples(k + 1)}, where "
                    f"{number(found.limit)} is the limit.",
                    "The model lacks something slow: a bias, a parameter or a state.", "warning",
                )

    def _input_notes(self) -> Iterator[Finding]:
        names, found = self.names, self.correlations
        signals = [*names.inputs, *(f"the change of {one}" for one in names.inputs)]
        counts = np.isfinite(self.normalised).sum(axis=0)
        for j, k in np.ndindex(*found.inputs.shape[1:]):
            sure = np.sqrt(chi2.isf(_SURE, 1) / max(int(counts[j]), 1))
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
        _, inverse_units = prior_units(self.prior)
        ends = inverse_units @ self.along.covariances[length - 1 :] @ inverse_units.T
        count = len(ends)
        vectors = view.directions[:count, :, 0]  # the weakest
        learnt = np.einsum("wi,wij,wj->w", vectors, ends, vectors)
        blind = (view.values[:count, 0] < _UNSEEN) & (learnt > _UNLEARNT)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], blind.astype(int), [0]))))
        for begin, end in edges.reshape(-1, 2):
            last = end - 1 + length
            if last - begin < max(2 * length, 0.1 * count) or not self._stays(
                vectors[begin], begin, last
            ):
                continue
            middle = vectors[(begin + end) // 2]
            whole = begin == 0 and end == count
            span = 0, len(names.times) - 1
            if not whole:
                span = begin + self.first, last + self.first - 1
            yield Finding(
                "unseen",
                f"{_direction(middle, names.states)} is not seen by the data"
                f"{names.between(*span)}.",
                "Excite it, give the prior or Q of it less room, or leave it out of the state.",
                where=None if whole else names.span(*span),
            )

    def _stays(self, vector: Array, begin: int, end: int) -> bool:
        """Whether the model keeps a direction, given in deviations of the prior, for so long."""
        units, inverse_units = prior_units(self.prior)
        moved = units @ vector
        for a in self.transitions[begin:end]:
            moved = a @ moved
        return bool(np.linalg.norm(inverse_units @ moved) > _REMAINS * np.linalg.norm(vector))

    def _worse(self) -> Iterator[Finding]:
        """Whether the estimator predicts worse than the filter, by the same measure."""
        part = slice(self.first, len(self.run))
        system = self.source.system
        states = self.run.states[:-1][part]
        expected, _ = self.bank.moves(states, self.bank.full_inputs(self.base.inputs))
        errors = self.base.measurements - expected
        if system.output_residual is not None:
            system.output_residual.wrap(errors, self.base.measurements)
        errors[~np.isfinite(self.null.innovations)] = np.nan
        spread = np.sqrt(np.diagonal(self.null.innovation_covariances, axis1=1, axis2=2))
        own = np.nanmean(np.clip(errors / spread, -_OUTLIER, _OUTLIER) ** 2)
        filter_s = np.nanmean(np.clip(self.normalised, -_OUTLIER, _OUTLIER) ** 2)
        ratio = float(np.sqrt(own / filter_s)) if filter_s > 0.0 else 1.0
        if ratio > _WORSE:
            settings, kept = self.source.settings, self.run.share(Status.CANDIDATE)
            remedy = (
                "Raise max_qps." if settings.max_qps == 0 or kept > _KEPT
                else "Raise max_qps or the horizon, or take qpmhe.ObserverPrior."
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
            k = len(self.along.covariances) // 2
            a = self.transitions[k]
            usual = a @ self.along.covariances[k] @ a.T + self.disturbance
        longest = min(len(self.transitions), max(50, 5 * self.horizon), 500)
        return prior_shares(
            self.transitions, self.information, self.disturbance, usual,
            max(longest, self.horizon),
        )

    def _notes(self) -> Iterator[Finding]:
        names, run, limits = self.names, self.run, self.nis_mean_limits

        def note(kind: str, text: str, remedy: str = "") -> Finding:
            return Finding(kind, text, remedy, "note")

        yield note(
            "innovations",
            f"The mean NIS of a measurement is {number(self.nis_mean)}; {limits[0]:.2f} to "
            f"{limits[1]:.2f} is to be expected.",
        )
        missing = ~np.isfinite(self.source.measurements)
        some = [
            f"{share:.0%} of {name}"
            for name, share in zip(names.outputs, missing.mean(axis=0), strict=True) if share > 0.0
        ]
        if some:
            yield note("record", f"Missing: {listed(some)}.")
        yield self._prior_note()
        if not self.findings and self.source.cost.observer_prior is None:
            yield from self._prior_weight_note()
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
            early, late = run.states[self.first : third, i].mean(), run.states[-third:, i].mean()
            sigma = float(np.sqrt(self.along.covariances[-1, i, i]))
            if np.isfinite(late - early) and sigma > 0.0 and abs(late - early) > 3.0 * sigma:
                yield note(
                    "drift", f"{names.states[i]} drifts from {number(early)} to {number(late)}, "
                    f"{number(abs(late - early) / sigma)} of its standard deviations.",
                )

    def _prior_note(self) -> Finding:
        names, horizon, shares = self.names, self.horizon, self.prior_shares
        i = int(np.argmax(shares[horizon]))
        share, state = shares[horizon, i], names.states[i]
        enough = np.flatnonzero(shares.max(axis=1) < _WEAK_PRIOR)
        if share < _WEAK_PRIOR:
            text = (
                f"With N = {horizon} the prior carries {percent(share)} of the variance of "
                f"{state}'s estimate, and less of the others'"
            )
            text += f"; from N = {enough[0]} on it is below 10 %."
            return Finding("prior", text, "", "note")
        text = (
            f"With N = {horizon} the prior still carries {percent(share)} of the variance of "
            f"{state}'s estimate; "
        )
        text += (
            f"N = {enough[0]} would bring that below 10 %." if enough.size
            else f"no N up to {len(shares) - 1} brings that below 10 %."
        )
        remedy = "" if self.source.cost.observer_prior is not None else (
            "So its weight matters: let qpmhe.tune choose it, or a Kalman-type observer by "
            "qpmhe.ObserverPrior."
        )
        return Finding("prior", text, remedy, "note")

    def _prior_weight_note(self) -> Iterator[Finding]:
        """Whether the prior's weight suits the observer whose states it weighs.

        A filter's error is orthogonal to all that the data say, the observer's state included: so
        the mean square of the observer's error is the mean square of its distance from the filter
        plus the filter's variance.
        """
        z, names = self.run.observer_states[self.first : len(self.run)], self.names
        apart = difference(self.source.system.state_residual, z, self.along.corrected)
        late = len(apart) // 3  # the first error of the observer has decayed
        own = np.mean(apart[late:] ** 2, axis=0) + np.diagonal(
            self.along.covariances[late:], axis1=1, axis2=2
        ).mean(axis=0)
        ratios = np.sqrt(own / self.prior.diagonal())
        i = int(np.nanargmax(ratios))
        said, seen = np.sqrt(self.prior[i, i]), np.sqrt(own[i])
        if not np.isfinite(ratios[i]) or _SUITS[0] < ratios[i] < _SUITS[1]:
            return
        large = ratios[i] > 1.0
        if not large and self.prior_shares[self.horizon].max() < _WEAK_PRIOR:
            return  # it does not matter
        yield Finding(
            "prior",
            f"The prior says that the observer is off by {number(said)} in {names.states[i]}; by "
            f"the data it is off by {number(seen)}"
            + ("." if large else ", and by a smaller share in the other states."),
            f"The prior's weight may be {number(max(ratios[i], 1.0 / ratios[i]) ** 2)} times "
            + ("smaller." if large else "as large, once the start is forgotten."), "note",
        )

    def _constants(self) -> list[int]:
        """The states that the model keeps: parameters."""
        n = self.source.system.n
        inputs = self.bank.full_inputs(self.base.inputs)
        reached = self.bank.model.f.batch(self.along.corrected, inputs)
        kept = (reached == self.along.corrected).all(axis=0)
        moved = np.abs(self.transitions - np.eye(n)).max(axis=(0, 2))
        return [i for i in range(n) if kept[i] and moved[i] == 0.0]


def _limits(count: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """What 99 % of sums of so many squares lie within, and of their means."""
    low, high = (float(chi2.ppf(level, count)) for level in (0.005, 0.995))
    return (low, high), (low / count, high / count)


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
