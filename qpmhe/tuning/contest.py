"""Which estimator: observers, alone and with QPs, each with weights of its own, on one data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from .search import SearchProgress, refine

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
        """The one that a name stands for."""
        return cls(source.name, lambda problem: made(source, problem), limit)

    def about(self, score: Score, likely: Found) -> Kind:
        """A constant gain is made about the mean of the records, where nothing else is given."""
        if self.name != "steady":
            return self
        at, u = (
            [float(f"{one:.{_DIGITS}g}") for one in part.tolist()]
            for part in score.typical(likely.likelihood.structure.weights(likely.theta))
        )
        return Kind.named(_source(f"steady(at={at}{f', u={u}' * bool(u)})"))


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found for an estimator; `best` is what the blocks that judge prefer."""

    likelihood: Likelihood
    theta: Array
    hessian: Array
    score: Score
    refined: Array | None = None
    best: Array = None  # type: ignore[assignment]
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
        observer = made(source, problem)
        if arrival == "observer" and observer.initial_covariance() is None:
            raise OptionError(
                f"observer {source.name!r} returned {shown(observer)}, which has no covariance to "
                "weigh the prior, so it cannot be tuned; give arrival='constant', or another "
                "observer."
            )
        kinds.append(Kind.named(source, observer.innovation_limit))
    return kinds


def _source(name: Any) -> ModelSource:
    return find(name, kind="observer", known=KNOWN)


def settle(
    found: Found, objective: str, blocks: Blocks, kept: SearchProgress,
    advance: Callable[[str], None],
) -> Found:
    """Lower the estimator's own error, unless the likelihood alone is wanted, and judge."""
    if objective == "likelihood":
        return replace(found, best=found.theta)
    likelihood, theta, score = found.likelihood, found.theta, found.score
    refined = refine(score, likelihood, theta, kept, advance)
    best, judgement = judge(blocks, score, likelihood.structure, theta, refined)
    return replace(found, refined=refined, best=best, judgement=judgement)


def contest(
    kinds: Sequence[Kind], most_qps: int, likely: Callable[[float | None], Found],
    settled: Callable[[str, Found], Found], blocks: Blocks, labels: Sequence[str],
) -> tuple[Found, list[ObserverScore]]:
    """Tune each observer, alone and with QPs, and rank them on the blocks that judge.

    The simplest one, by its number of QPs and then by its place in the list, whose score is within
    one standard error or 1 % of the least is taken.
    """
    entries = list(_entries(kinds, most_qps, likely, settled, blocks, labels))
    usable = [one for one in entries if not one[0].failure]
    if not usable:
        reasons = "; ".join(f"{row.title}: {row.failure}" for row, _, _ in entries)
        raise ModelError(f"no observer can be tuned on these records: {reasons}")
    _, _, least = min(usable, key=lambda one: one[0].score)
    usable.sort(key=lambda one: one[0].max_qps)
    row, found, _ = next(one for one in usable if _is_close(one[2], least, blocks))
    rows = sorted((one[0] for one in entries), key=lambda one: (bool(one.failure), one.score))
    return replace(found, row=row), rows


def _is_close(samples: list[Array], least: list[Array], blocks: Blocks) -> bool:
    gain, error, _ = blocks.gain(samples, least)
    return samples is least or gain <= max(error, _ALIKE)


def _entries(
    kinds: Sequence[Kind], most_qps: int, likely: Callable[[float | None], Found],
    settled: Callable[[str, Found], Found], blocks: Blocks, labels: Sequence[str],
) -> Iterator[tuple[ObserverScore, Any, Any]]:
    for kind in kinds:
        begun = likely(kind.limit)
        for qps in range(most_qps + 1):
            row = ObserverScore(kind.name, qps)
            try:
                kind = kind.about(begun.score, begun)
                row = ObserverScore(kind.name, qps)
                found = settled(row.title, replace(begun, score=begun.score.of(kind.make, qps)))
                weights = begun.likelihood.structure.weights(found.best)
                samples = found.score.samples(weights)
                row = replace(
                    row, score=blocks.mean(samples), seconds=found.score.seconds,
                    errors=root_mean_squares(found.score.errors(weights), blocks, labels),
                )
                if not np.isfinite(row.score):
                    row = replace(row, failure="its estimates diverge")
                yield row, found, samples
            except (QpmheError, np.linalg.LinAlgError, FloatingPointError) as error:
                yield replace(row, failure=str(error)), None, None


def root_mean_squares(
    errors: list[Array], blocks: Blocks, labels: Sequence[str]
) -> dict[str, float]:
    """The root mean square of each component's errors on the blocks that judge, where there are."""
    every = blocks.chosen(errors)
    there = np.isfinite(every)
    with np.errstate(invalid="ignore"):
        squares = np.where(there, every, 0.0) ** 2
        sizes = np.sqrt(squares.sum(axis=0) / there.sum(axis=0)).tolist()
    return {one: size for one, size in zip(labels, sizes, strict=True) if np.isfinite(size)}


def plain(kind: Callable[..., Observer] = ExtendedKalman) -> Callable[[Problem], Observer]:
    """An observer that a function of the three covariances makes, for a problem."""
    return lambda problem: kind(**problem.covariances)
