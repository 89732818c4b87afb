"""Which estimator: observers, alone and with QPs, each with weights of its own, on one data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import Array
from ..baselines import Problem
from ..baselines.observers import KNOWN, made
from ..errors import ModelError, OptionError, QpmheError
from ..models.loading import ModelSource, find
from ..observers import ExtendedKalman, Observer
from .judge import Blocks, ObserverScore, judge
from .likelihood import Likelihood
from .score import Score
from .search import SearchProgress, TuningCheckpointError, polish, refine, search_all

# Per cent by which scores may differ that are the same for any purpose.
_ALIKE = 1.0
# Digits of the point about which a constant gain is made.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Kind:
    """An observer to make for a problem; its name is blank where the user gave a function."""

    name: str
    make: Callable[[Problem], Observer]
    limit: float | None = None

    @classmethod
    def named(cls, source: ModelSource, limit: float | None = None) -> Kind:
        """The one that a name stands for, made as from a file of weights: about the state 0."""
        def make(problem: Problem) -> Observer:
            about_zero = replace(problem, initial_state=np.zeros(problem.system.n))
            observer: Observer = made(source, about_zero)
            return observer

        return cls(source.name, make, limit)

    def about(self, likely: Found) -> Kind:
        """A constant gain is made about the mean of the records, where nothing else is given."""
        if self.name != "steady":
            return self
        at, u = (
            [float(f"{one:.{_DIGITS}g}") for one in part.tolist()]
            for part in likely.score.typical(likely.likelihood.structure.weights(likely.theta))
        )
        return Kind.named(_source(f"steady(at={at}{f', u={u}' * bool(u)})"))


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found for an estimator; `best` is what the blocks that judge prefer."""

    likelihood: Likelihood
    theta: Array
    hessian: Array
    score: Score
    best: Array
    refined: Array | None = None
    judgement: str = "by the likelihood alone."
    row: ObserverScore | None = None


def kinds_of(observers: Any, problem: Problem, arrival: str) -> list[Kind]:
    """The observers that a list names, each made once, so that what is wrong shows at once."""
    expected = (
        f"expected 'all', or a list of {', '.join(map(repr, KNOWN))} and functions such as "
        "'file.py:function', which take a qpmhe.baselines.Problem and return an observer."
    )
    if observers == "all":
        observers = list(KNOWN)
    if isinstance(observers, str) or not isinstance(observers, Sequence):
        raise OptionError(f"observers is {shown(observers)}; {expected}")
    if not observers:
        raise OptionError(f"observers is empty; {expected}")
    sources = [_source(one) for one in observers]
    names = [one.name for one in sources]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(f"observers has {name!r} more than once; name each once.")
    kinds = []
    for source in sources:
        if source.name == "steady":  # made once a typical state is known
            kinds.append(Kind.named(source))
            continue
        kind = Kind.named(source)
        observer = kind.make(problem)
        if arrival == "observer" and observer.initial_covariance() is None:
            raise OptionError(
                f"observer {source.name!r} returned {shown(observer)}, which has no covariance to "
                "weigh the prior, so it cannot be tuned; give arrival='constant', or another "
                "observer."
            )
        kinds.append(replace(kind, limit=observer.innovation_limit))
    return kinds


def _source(name: Any) -> ModelSource:
    return find(name, kind="observer", known=KNOWN)


@dataclass(eq=False)
class Searches:
    """The searches for the weights of estimators on the same data, and how long they take."""

    likelihoods: dict[float | None, Likelihood]
    score: Score
    objective: str
    blocks: Blocks
    beginnings: list[Array]
    jobs: int
    kept: SearchProgress
    advance: Callable[[str], None]
    seconds: dict[str, float] = field(default_factory=dict)
    _likely: dict[float | None, Found] = field(default_factory=dict)

    def likely(self, limit: float | None, part: str = "") -> Found:
        """Maximise the likelihood of a filter with this limit of its innovations, once."""
        if limit not in self._likely:
            since, self.kept.part, one = perf_counter(), part, self.likelihoods[limit]
            theta = search_all(one, self.beginnings, self.kept, self.jobs, self.advance)
            theta, hessian = polish(one, theta)
            self._likely[limit] = Found(one, theta, hessian, self.score, theta)
            self._spend("likelihood", since)
        return self._likely[limit]

    def settled(self, found: Found, part: str = "") -> Found:
        """Lower the estimator's own error, unless the likelihood alone is wanted, and judge."""
        if self.objective == "likelihood":
            return found
        since, self.kept.part = perf_counter(), part
        likelihood, theta, score = found.likelihood, found.theta, found.score
        refined = refine(
            score, likelihood, theta, self.kept, lambda text: self.advance(part + text))
        best, judgement = judge(self.blocks, score, likelihood.structure, theta, refined)
        self._spend("estimator", since)
        return replace(found, refined=refined, best=best, judgement=judgement)

    def contest(
        self, kinds: Sequence[Kind], most_qps: int
    ) -> tuple[Found, list[ObserverScore]]:
        """Tune each observer, alone and with QPs, and rank them on the blocks that judge.

        The simplest one, by its number of QPs and then by its place in the list, whose score is
        within one standard error or 1 % of the least is taken.
        """
        entries = list(self._entries(kinds, most_qps))
        usable = [one for one in entries if not one[0].failure]
        if not usable:
            reasons = "; ".join(f"{row.title}: {row.failure}" for row, _, _ in entries)
            raise ModelError(f"no observer can be tuned on these records: {reasons}")
        _, _, least = min(usable, key=lambda one: one[0].score)
        usable.sort(key=lambda one: one[0].max_qps)
        row, found, _ = next(one for one in usable if self._is_close(one[2], least))
        rows = sorted((one[0] for one in entries), key=lambda one: (bool(one.failure), one.score))
        return replace(found, row=row), rows

    def _spend(self, search: str, since: float) -> None:
        self.seconds[search] = self.seconds.get(search, 0.0) + perf_counter() - since

    def _is_close(self, samples: list[Array], least: list[Array]) -> bool:
        gain, error, _ = self.blocks.gain(samples, least)
        return samples is least or gain <= max(error, _ALIKE)

    def _entries(
        self, kinds: Sequence[Kind], most_qps: int
    ) -> Iterator[tuple[ObserverScore, Any, Any]]:
        for kind in kinds:
            name = kind.name
            for qps in range(most_qps + 1):
                title = f"MHE, {qps} QP{'s' * (qps > 1)} on {name}" if qps else name
                row = ObserverScore(name, qps, title)
                try:
                    begun = self.likely(kind.limit, f"limit {kind.limit}, ")
                    kind = kind.about(begun)
                    row = replace(row, observer=kind.name)
                    score = self.score.of(kind.make, qps)
                    found = self.settled(replace(begun, score=score), f"{title}, ")
                    errors = score.errors(begun.likelihood.structure.weights(found.best))
                    samples = score.scaled(errors)
                    row = replace(
                        row, score=self.blocks.mean(samples), seconds=score.seconds,
                        errors=self.blocks.sizes(errors, score.labels),
                    )
                    if not np.isfinite(row.score):
                        row = replace(row, failure="its estimates diverge")
                    yield row, found, samples
                except TuningCheckpointError:
                    raise
                except (QpmheError, np.linalg.LinAlgError, FloatingPointError) as error:
                    yield replace(row, failure=str(error)), None, None


def plain(kind: Callable[..., Observer] = ExtendedKalman) -> Callable[[Problem], Observer]:
    """An observer that a function of the three covariances makes, for a problem."""
    return lambda problem: kind(**problem.covariances)
