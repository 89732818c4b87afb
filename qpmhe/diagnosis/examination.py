"""What is computed of a run to judge whether it is healthy, and the findings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from .._linalg import inverse
from ..costs import RobustCost
from ..estimation.estimate import Status
from ..estimation.observability import observability, prior_shares
from ..estimation.run import Run, RunSource
from ..model.residuals import difference
from ..model.system import System
from ..terms.information import prior_units
from .apparent import apparent_information
from .bank import Array, FilterBank, Filtered, Hypothesis, Mask
from .causes import in_words
from .correlations import OUTLIER, Correlations, coloured
from .faults import SCALED, Evidence, Fault
from .findings import Finding, Names, listed, number, percent
from .search import search
from .steps import finer
from .stuck import stuck

# The search takes at most so many samples: of a longer record, those least like the model.
_MOST_SAMPLES = 6000
# Filters that a search for faults runs, roughly, for each sensor and input.
_FILTERS = 40
# Fewer samples with measurements say nothing about a covariance. Where the model fails, so many of
# the longest stretches between are tried.
LEAST_SAMPLES, _STRETCHES = 30, 3
# By how much more than the noise outputs vary by the prior with which a filter begins: a vaguer one
# says no more, and leaves covariances, of a lag above all, without digits.
_VAGUE = 1e7
# The data do not see a direction in which they say so much less than the prior; nor has a filter
# seen it whose variance is still this share of the prior's. It matters if this share remains.
_UNSEEN, _UNLEARNT, _REMAINS = 0.1, 0.5, 0.5
# A filter that has lost the record is linearised nowhere near it: a step moves nothing that much.
_LOST = 1e3
# By how much information must seem to grow where there is none.
_APPARENT = 2.0
# By how much the estimator's predictions may be worse than those of a Kalman filter, and by how
# many standard errors they must be.
_WORSE, _CLEARLY = 1.4, 3.0
# A repeated number contradicts the filter if innovations are so many deviations off.
_OTHERWISE = 1.7
_FAILING, _KEPT, _WEAK_PRIOR, _REJECTED = 0.02, 0.5, 0.1, 0.02
# How far from one the observer's error may be, in deviations of the prior.
_SUITS = 0.3, 1.5
# Correlations of innovations that matter, and how sure they must be.
_CORRELATED, _SURE = 0.2, 1e-6
# Those that raise doubts about what was found if they remain with it.
_COLOURED, _DOUBTFUL = 0.1, 1e-5
_CAUSES = (
    "Possible causes: noise that is correlated in time, a sensor's lag, gain or bias, and a "
    "parameter or a state that the model lacks."
)
_DOUBT = "This is not certain: the innovations stay coloured with it."
# Samples at the start, at least, that are no evidence: a filter needs some to forget it.
_START = 10


class Examination:
    """What `diagnose` knows of a run: its attributes are those of a `Diagnosis`."""

    def __init__(self, run: Run, source: RunSource, names: Names) -> None:
        self.run, self.source, self.names = run, source, names
        system, cost, total = source.system, source.cost, len(run)
        self.noise, disturbance = inverse(cost.noise), inverse(cost.disturbance)
        directions = cost.directions(system.disturbance_matrix)
        if directions is not None:
            disturbance = directions @ disturbance @ directions.T
        given = source.observer.initial_covariance() if cost.observer_prior is not None else None
        self.prior = inverse(np.asarray(cost.prior)) if given is None else given
        self.first = min(max(source.settings.horizon, _START), total // 5)
        self.inputs = _held(np.zeros((total, 0)) if source.inputs is None else source.inputs)
        self.is_judged = True
        self._filter(disturbance)
        length, same = source.settings.horizon, self.best.states.shape == self.null.states.shape
        # What the windows see is examined along the states of the filter that explains the record.
        self.along = self.best if same and np.isfinite(self.best.logs).all() else self.null
        self.horizon = min(length, len(self.along.states))
        self._linearise()
        self.observability = observability(
            self.transitions, self.information, disturbance, self.prior, self.horizon
        )
        seen = np.isfinite(self.null.innovations)
        errors, count = np.where(seen, self.null.innovations, 0.0), max(1, int(seen.sum()))
        squares = np.einsum("ti,tij,tj->t", errors, self.null.weights, errors)
        blank = np.full((self.first, system.p), np.nan)
        self.innovations = np.vstack((blank, self.normalised))
        self.nis = np.append(blank[:, 0], np.where(seen.any(axis=1), squares, np.nan))
        self.nis_limits, self.nis_mean = _limits(system.p), float(np.nansum(self.nis) / count)
        low, high = _limits(count)
        self.nis_mean_limits = low / count, high / count
        self.correlations = Correlations.of(self.normalised, self._signals(self.normalised))
        far = np.abs(self.normalised) > OUTLIER
        if same:  # those that the search has left out, if any
            left_out = np.isfinite(self.base.measurements) & ~np.isfinite(self.along.innovations)
            far = left_out if left_out.any() else far
        self.outliers: Array = far.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        self.prior_shares = self._prior_shares(disturbance)
        self.findings = list(self._findings())
        if not self.findings and np.isfinite(self.normalised).any():
            self.findings += [*self._correlated(), *self._worse()]
        self.notes = list(self._notes())

    def _filter(self, disturbance: Array) -> None:
        """Filters of the record without and with its faults; what is stuck is no measurement."""
        run, source, part = self.run, self.source, slice(self.first, len(self.run))
        steps = None if source.steps is None else source.steps[part]
        # The system, by shorter steps where its own are too long, and the finding that they are.
        self.system, self.coarse = source.system, list[Finding]()
        self.bank = FilterBank(self.system, steps, self.first, filters=_expected(self.system))
        start = run.states[self.first]
        start = start if np.isfinite(start).all() else run.states[0]
        y = source.measurements.copy()
        base = Hypothesis(
            y[part], self.inputs[part], self.noise, disturbance, start, self.prior
        )
        base = replace(base, prior=self.bank.bounded_prior(base, _VAGUE))

        def contradicts(repeated: Mask, sensor: int) -> bool:
            errors = self.bank.run([base]).normalised[repeated[self.first :], sensor]
            errors = errors[np.isfinite(errors)]
            return bool(errors.size and np.sqrt(np.mean(errors**2)) > _OTHERWISE)

        self.stuck, self.clipped = [], np.zeros(y.shape[1])
        deviations = np.sqrt(self.noise.diagonal())
        for j, where, finding in stuck(y.copy(), deviations, self.names, contradicts):
            self.stuck.append(finding)
            self.clipped[j] += where.sum() / max(1, np.isfinite(source.measurements[:, j]).sum())
            y[where, j] = np.nan
        self.clipped[~np.isfinite(source.measurements).any(axis=0)] = 0.0
        self.base = base = replace(base, measurements=y[part])
        self.null = null = self.bank.run([base])
        own, found = self.bank, finer(self.bank, base, null, steps, self.names)
        if found is not None:
            self.system, self.bank, self.null = found.system, found.bank, found.filtered
            self.coarse, null = [found.finding], self.null
        self.normalised = null.normalised
        bank, base, null, begin = self._searched()
        self.faults, self.best, self.unexplained, corrected = self._verified(bank, base, null)
        if self.coarse and self.faults and not begin and finer(
            own, corrected, own.run([corrected]), steps, self.names) is None:
            self.coarse = []  # only the faults led to states where the steps are too long
        if not self.is_judged and not all(one.is_wrong_unit for one in self.faults):
            self.faults, self.best, self.unexplained = [], null, []
        whole = 0, len(base.measurements) - 1
        self.searched = begin + self.first if begin else 0, begin + self.first + whole[1]
        self.faults = [
            self._placed(
                replace(one, span=whole) if begin and one.span is None and not one.is_wrong_unit
                else one, begin)
            for one in self.faults
        ]

    def _placed(self, one: Fault, begin: int) -> Fault:
        """A fault with the samples of the run; before the filter began there is no evidence."""
        span = one.span
        if span is not None:
            low, high = span[0] + begin, span[1] + begin + self.first
            span = low + self.first if low else 0, high
        rows = tuple(row + begin + self.first for row in one.rows)
        return replace(
            one, span=span, rows=rows, equals=tuple(self._placed(k, begin) for k in one.equals)
        )

    def _verified(
        self, bank: FilterBank, base: Hypothesis, null: Filtered
    ) -> tuple[list[Fault], Filtered, list[tuple[int, int, float, str]], Hypothesis]:
        """Faults; factors of R and Q only if they explain the record.

        Also the filter with them, what correlation it leaves: sensor, lag, size, and what that
        tells; and the record without them.
        """
        evidence = Evidence(
            bank, base, null, self._starts(), len(self.source.settings.parameters or ())
        )
        faults, corrected = search(evidence)
        best, why = bank.run([corrected]), ""
        remains = self._colour(best.normalised, _COLOURED, _DOUBTFUL) if faults else []
        scaled = [k for k, one in enumerate(faults) if one.kind in SCALED]
        if scaled:
            before = faults[: scaled[0]]
            if remains:
                why = "Factors of Q and R do not make them white. "
                rest = before[-1].hypothesis if before else base
                if rest.noise.ndim == base.noise.ndim:
                    rest = replace(rest, noise=base.noise, disturbance=base.disturbance)
                faults, best, corrected = before, bank.run([rest]), rest
        return faults, best, [
            (*one, why) for one in sorted(remains, key=lambda one: -abs(one[2]))
        ], corrected

    def _searched(self) -> tuple[FilterBank, Hypothesis, Filtered, int]:
        """What is searched for faults, from which sample on: all that has to be, or can be."""
        base, null, total = self.base, self.null, len(self.base.measurements)
        failed = (self.run.flags[self.first :] & Status.MODEL_FAILED.value) != 0
        fails = bool(failed.any()) and not np.isfinite(null.logs).all()
        if fails:
            # Any fault with which the model does not fail would look like the cause.
            # Nor is the filter far from failing just before and after.
            failures = np.flatnonzero(failed)
            begins, ends = np.append(0, failures + _START), np.append(failures - _START, total)
            for k in np.argsort(begins - ends, kind="stable")[:_STRETCHES].tolist():
                first = int(begins[k])
                part = slice(first, max(first, min(int(ends[k]), first + _MOST_SAMPLES)))
                seen = np.isfinite(base.measurements[part]).any(axis=1)
                if seen.sum() >= LEAST_SAMPLES:
                    found = self._part(part)
                    if np.isfinite(found[2].logs).all():
                        return found
            self.is_judged = False
        elif total > _MOST_SAMPLES:
            sums = np.append(0.0, np.cumsum(np.nan_to_num(self.normalised**2).sum(axis=1)))
            first = int(np.argmax(sums[_MOST_SAMPLES:] - sums[:-_MOST_SAMPLES]))
            return self._part(slice(first, first + _MOST_SAMPLES))
        return self.bank, base, null, 0

    def _part(self, part: slice) -> tuple[FilterBank, Hypothesis, Filtered, int]:
        first, steps = self.first + part.start, self.source.steps
        bank = FilterBank(
            self.system, None if steps is None else steps[self.first :][part], first,
            filters=_expected(self.system),
        )
        base = replace(
            self.base, measurements=self.base.measurements[part], inputs=self.base.inputs[part],
            start=self.run.states[first],
        )
        return bank, base, bank.run([base]), part.start

    def _starts(self) -> list[Array]:
        """The user's own estimate, and where the model moves it until the filter begins."""
        found = [self.run.states[0], self.run.states[0]]
        steps = self.source.steps
        before = FilterBank(self.system, None if steps is None else steps[: self.first])
        try:
            for u in before.full_inputs(self.inputs[: self.first]):
                found[1] = np.asarray(before.model.f(found[1], u))
        except Exception:  # of a model that is not defined there
            found.pop()
        return [one for one in found if np.isfinite(one).all()]

    def _linearise(self) -> None:
        """A, and C^T R C with the weight R of what was measured, of each sample."""
        along, n = self.along, self.source.system.n
        seen = np.isfinite(along.innovations)
        information = np.zeros((len(seen), n, n))
        for pattern in np.unique(seen, axis=0):
            if pattern.any():
                at = (seen == pattern).all(axis=1)
                c = along.outputs[at][:, pattern]
                weight = inverse(self.noise[np.ix_(pattern, pattern)])
                information[at] = np.einsum("tji,jk,tkl->til", c, weight, c)
        units, inverse_units = prior_units(self.prior)
        sizes = np.abs(inverse_units @ along.transitions @ units).max(axis=(1, 2))
        lost = ~(sizes < _LOST) | ~np.isfinite(information).all(axis=(1, 2))
        self.information = np.where(lost[:, None, None], 0.0, information)
        self.transitions = np.where(lost[:, None, None], np.eye(n), along.transitions)

    def _findings(self) -> Iterator[Finding]:
        """What is certain first, but a wrong unit before what follows from it."""
        deviations, told = np.sqrt(self.noise.diagonal()), []
        for one in self.faults:
            finding = in_words(one, self.names, deviations, self.outliers)
            if self.unexplained and not one.is_wrong_unit:
                finding = replace(finding, remedy=f"{finding.remedy} {_DOUBT}")
            if one.kind != "outliers" or not isinstance(self.source.cost, RobustCost):
                told.append(finding)
        yield from self.stuck
        yield from self.coarse
        wrong_units = [one for one in told[:1] if self.faults[0].is_wrong_unit]
        yield from wrong_units
        for flag, what, remedy in (
            (Status.MODEL_FAILED, "The model failed", "Bound the states, or make the model "
             "defined on all of them; an estimate's message says where it failed."),
            (Status.SOLVER_FAILED, "The QP solver failed", "Take another backend."),
        ):
            share = self.run.share(flag)
            if share > _FAILING:
                yield Finding("failing", f"{what} at {share:.0%} of the samples.", remedy)
        yield from told[len(wrong_units) :]
        for sensor, lag, size, why in self.unexplained[:1]:
            yield self._not_white(sensor, lag, size, why + _CAUSES)
        if np.isfinite(self.along.logs).all():
            yield from self._unseen()
            yield from self._apparent()

    def _signals(self, normalised: Array) -> Array:
        """The inputs of these innovations."""
        return self.inputs[self.first :][: len(normalised)]

    def _colour(self, normalised: Array, least: float, sure: float) -> list[tuple[int, int, float]]:
        return coloured(normalised, self._signals(normalised), least, sure)

    def _correlated(self) -> Iterator[Finding]:
        for j, lag, size in self._colour(self.best.normalised, _CORRELATED, _SURE):
            yield self._not_white(
                j, lag, size, "The model lacks something slow: a bias, a parameter or a state.")

    def _not_white(self, sensor: int, lag: int, size: float, remedy: str) -> Finding:
        return Finding(
            "correlated",
            f"The innovations of sensor {self.names.outputs[sensor]} are not white: their "
            f"correlation is {number(size)} over {self.names.samples(lag)}, where "
            f"{number(self.correlations.limit)} is the limit.", remedy, "warning",
        )

    def _unseen(self) -> Iterator[Finding]:
        """Directions that the data do not see, that no filter has learnt, and that stay."""
        view, names, length = self.observability, self.names, self.horizon
        units, inverse_units = prior_units(self.base.prior)
        ends = inverse_units @ self.along.covariances[length - 1 :] @ inverse_units.T
        count = len(ends)
        vectors = view.directions[:count, :, 0]  # the weakest
        learnt = np.einsum("wi,wij,wj->w", vectors, ends, vectors)
        blind = (view.values[:count, 0] < _UNSEEN) & (learnt > _UNLEARNT)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], blind.astype(int), [0]))))
        for begin, end in edges.reshape(-1, 2):
            last = end - 1 + length
            moved = units @ vectors[begin]
            for a in self.transitions[begin:last]:
                moved = a @ moved
            stays = np.linalg.norm(inverse_units @ moved) > _REMAINS
            if last - begin < max(2 * length, 0.1 * count) or not stays:
                continue
            whole = begin == 0 and end == count
            span = (0, len(names.times) - 1) if whole else (
                begin + self.first, last + self.first - 1
            )
            direction = _direction(vectors[(begin + end) // 2], names.states)
            yield Finding(
                "unseen", f"{direction} is not seen by the data{names.between(*span)}.",
                "Excite it, give the prior or Q of it less room, or leave it out of the state.",
                where=None if whole else names.span(*span),
            )

    def _apparent(self) -> Iterator[Finding]:
        """Information of the points of linearisation, which the data do not have."""
        found = apparent_information(
            self.bank, self.along, self.bank.full_inputs(self.base.inputs), self.noise,
            self.base.prior,
        ) if self.along.states.shape[1] == self.bank.n else None
        if found is not None and found[0] > _APPARENT:
            growth, direction = found
            yield Finding(
                "apparent",
                f"{_direction(direction, self.names.states)} is not seen by the data, and the "
                "filter's information on it comes from its points of linearisation only: its "
                f"standard deviation there is too small by a factor of {number(np.sqrt(growth))} "
                "at least, and so are those of the estimates.",
                "Do not believe these standard deviations; add a measurement that shows this "
                "direction, or choose states relative to what is measured.", "warning",
            )

    def _worse(self) -> Iterator[Finding]:
        """Whether the estimator predicts worse than the filter, by the same measure."""
        states = self.run.states[:-1][self.first :]
        expected, _ = self.bank.moves(states, self.bank.full_inputs(self.base.inputs))
        errors = self.bank.errors(self.base.measurements, expected)
        errors[~np.isfinite(self.null.innovations)] = np.nan
        spread = np.sqrt(np.diagonal(self.null.spreads, axis1=1, axis2=2))
        squares = [np.clip(one, -OUTLIER, OUTLIER) ** 2
                   for one in (errors / spread, self.normalised)]
        own, filters = map(np.nanmean, squares)
        ratio = float(np.sqrt(own / filters)) if filters > 0.0 else 1.0
        apart = (squares[0] - squares[1])[np.isfinite(squares[1])]
        if ratio > _WORSE and apart.mean() * np.sqrt(apart.size) > _CLEARLY * apart.std():
            kept = self.run.share(Status.CANDIDATE)
            yield Finding(
                "estimator",
                f"The estimator predicts its measurements {number(ratio)} times worse than an "
                "extended Kalman filter with the same weights.",
                "Raise max_qps." if self.source.settings.max_qps == 0 or kept > _KEPT
                else "Raise max_qps or the horizon, or take a Kalman-type observer and a cost "
                "without prior.", "warning",
            )

    def _prior_shares(self, disturbance: Array) -> Array:
        usual = self.prior
        if self.source.cost.observer_prior is not None:
            # The filter's own covariance before a measurement is what weighs its prior.
            k = len(self.along.covariances) // 2
            a = self.transitions[k]
            usual = a @ self.along.covariances[k] @ a.T + disturbance
        longest = min(len(self.transitions), max(50, 5 * self.horizon), 500)
        return prior_shares(
            self.transitions, self.information, disturbance, usual, max(longest, self.horizon)
        )

    def _notes(self) -> Iterator[Finding]:
        names, run, (low, high) = self.names, self.run, self.nis_mean_limits

        def note(kind: str, text: str, remedy: str = "") -> Finding:
            return Finding(kind, text, remedy, "note")

        for one in self.faults:
            if one.kind == "outliers" and isinstance(self.source.cost, RobustCost):
                deviations = np.sqrt(self.noise.diagonal())
                told = in_words(one, names, deviations, self.outliers)
                yield note(one.kind, told.text, "The cost is robust.")
        is_followed = bool(np.isfinite(self.along.logs).all())
        judged = self._judged(is_followed)
        if judged:
            yield note("failing", judged)
        yield note(
            "innovations",
            f"The mean NIS of a measurement is {number(self.nis_mean)}; expected {low:.2f} to "
            f"{high:.2f}.",
        )
        missing = np.mean(~np.isfinite(self.source.measurements), axis=0)
        some = [f"{share:.0%} of {names.outputs[j]}" for j, share in enumerate(missing) if share]
        if some:
            yield note("record", f"Missing: {listed(some)}.")
        if is_followed:
            yield self._prior_note()
        if not self.findings and self.source.cost.observer_prior is None:
            yield from self._prior_weight_note()
        kept = run.share(Status.CANDIDATE)
        if kept > 0.0:
            why = [
                f"{flag.name} ({share:.0%})"
                for flag in Status
                if flag not in (Status.CANDIDATE, Status.IMPROVED)
                and (share := run.share(Status.CANDIDATE | flag)) > 0.0
            ]
            because = f", with {listed(why)}" if why else ""
            yield note(
                "kept", f"The candidate was kept at {kept:.0%} of the samples{because}.",
                "Estimate.explain says what to do about each." if kept > _KEPT else "",
            )
        yield from self._rejection_notes()
        yield from self._drifts()
        if not self.findings:
            yield from self._input_notes()

    def _judged(self, is_followed: bool) -> str:
        """What was not judged because the filter fails; blank if nothing."""
        if not self.is_judged:
            return "Only wrong units were looked for: at other faults the model fails too often."
        where = self.names.between(*self.searched)
        if is_followed or not where:
            return ""
        return f"Faults were looked for{where} only: elsewhere the model fails."

    def _rejection_notes(self) -> Iterator[Finding]:
        """What the observer's gate has rejected; this filter has no gate."""
        rejected, seen = self.run.rejected_sensors, np.isfinite(self.source.measurements)
        for k, sensor in enumerate(self.source.observer.sensors[: rejected.shape[1]]):
            outputs = list(sensor)
            count = seen[:, outputs].any(axis=1).sum()
            share = rejected[:, k].sum() / count if count else 0.0
            if share > _REJECTED:
                title = listed([self.names.outputs[j] for j in outputs])
                yield Finding(
                    "rejected",
                    f"The observer's gate rejected {title} at {share:.0%} of its samples.",
                    "If they are not outliers, raise the covariances of disturbance or noise.",
                    "note",
                )

    def _prior_note(self) -> Finding:
        horizon, shares = self.horizon, self.prior_shares
        i = int(np.argmax(shares[horizon]))
        enough = np.flatnonzero(shares.max(axis=1) < _WEAK_PRIOR)
        weak = shares[horizon, i] < _WEAK_PRIOR
        text = (
            f"With N = {horizon} the prior {'' if weak else 'still '}carries "
            f"{percent(shares[horizon, i])} of the variance of {self.names.states[i]}'s estimate"
        )
        if weak:
            text += f", and less of the others'; from N = {enough[0]} on it is below 10 %."
        elif enough.size:
            text += f"; N = {enough[0]} would bring that below 10 %."
        else:
            text += f"; no N up to {len(shares) - 1} brings that below 10 %."
        remedy = "" if weak or self.source.cost.observer_prior is not None else (
            "So its weight matters: let qpmhe.tune choose it, or a Kalman-type observer, with a "
            "cost without prior."
        )
        return Finding("prior", text, remedy, "note")

    def _prior_weight_note(self) -> Iterator[Finding]:
        """Whether the prior's weight suits the observer whose states it weighs.

        A filter's error is orthogonal to all that the data say, the observer's state included: so
        the mean square of the observer's error is the mean square of its distance from the filter
        plus the filter's variance.
        """
        z, along = self.run.observer_states[self.first : len(self.run)], self.along
        apart = difference(self.source.system.state_residual, z, along.corrected)
        late = len(apart) // 3  # the first error of the observer has decayed
        variances = np.diagonal(along.covariances[late:], axis1=1, axis2=2).mean(axis=0)
        own = np.mean(apart[late:] ** 2, axis=0) + variances
        ratios = np.sqrt(own / self.prior.diagonal())
        i = int(np.nanargmax(ratios))
        large = ratios[i] > 1.0
        matters = large or self.prior_shares[self.horizon].max() >= _WEAK_PRIOR
        if not np.isfinite(ratios[i]) or _SUITS[0] < ratios[i] < _SUITS[1] or not matters:
            return
        yield Finding(
            "prior",
            f"The prior says that the observer is off by {number(np.sqrt(self.prior[i, i]))} in "
            f"{self.names.states[i]}; by the data it is off by {number(np.sqrt(own[i]))}"
            + ("." if large else ", and by a smaller share in the other states."),
            f"The prior's weight may be {number(max(ratios[i], 1.0 / ratios[i]) ** 2)} times "
            + ("smaller." if large else "as large, once the start is forgotten."), "note",
        )

    def _drifts(self) -> Iterator[Finding]:
        """Parameters, which the model keeps, that move nevertheless."""
        along, states = self.along, self.run.states
        reached = self.bank.following(
            along.corrected, self.bank.full_inputs(self.base.inputs)
        )
        kept = (reached == along.corrected).all(axis=0)
        kept &= (self.transitions == np.eye(len(kept))).all(axis=(0, 2))
        third = len(self.run) // 3
        for i in np.flatnonzero(kept):
            early, late = states[self.first : third, i].mean(), states[-third:, i].mean()
            sigma = float(np.sqrt(along.covariances[-1, i, i]))
            if np.isfinite(late - early) and sigma > 0.0 and abs(late - early) > 3.0 * sigma:
                yield Finding(
                    "drift", f"{self.names.states[i]} drifts from {number(early)} to "
                    f"{number(late)}, {number(abs(late - early) / sigma)} of its standard "
                    "deviations.", "", "note",
                )

    def _input_notes(self) -> Iterator[Finding]:
        names, found = self.names, self.correlations
        signals = [*names.inputs, *(f"the change of {one}" for one in names.inputs)]
        counts = np.isfinite(self.normalised).sum(axis=0)
        for j, k in np.ndindex(*found.inputs.shape[1:]):
            sure = np.sqrt(chdtri(1, _SURE) / max(int(counts[j]), 1))
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


def _expected(system: System) -> int:
    """How many filters a search for faults runs, roughly."""
    return _FILTERS * (system.p + system.m)


def _limits(count: int) -> tuple[float, float]:
    """What 99 % of sums of so many squares lie within."""
    return float(chdtri(count, 0.995)), float(chdtri(count, 0.005))


def _held(inputs: Array) -> Array:
    """Inputs without gaps: the last value holds, and zero before the first."""
    held = inputs.copy()
    for column in held.T:
        there = np.isfinite(column)
        last = np.maximum.accumulate(np.where(there, np.arange(column.size), -1))
        column[...] = np.where(last >= 0, column[np.maximum(last, 0)], 0.0)
    return held


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
