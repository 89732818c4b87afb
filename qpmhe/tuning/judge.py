"""Blocks of the records that judge: which weights, and which estimator, are the better ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .._checks import Array
from .data import Data
from .score import Score
from .structures import Structure

# Standard errors by which a gain of the second search is beyond chance.
_CHANCE = 2.0
# By how many per cent predictions from the start must be better for it to stay: less says little
# of weights, which outliers, intervals and gaps depend on, too.
_MATTERS = 5.0


@dataclass(frozen=True)
class ObserverScore:
    """A row of `Tuning.observers`: an estimator with its own weights.

    Attributes
    ----------
    observer : str
        The observer's name, with its arguments.
    max_qps : int
        QPs per sample; 0 is the observer alone.
    title : str
        The estimator in words, with the observer's name as it was given.
    score : float
        The held-out score, as a share of the score of an extended Kalman filter with the start
        weights; NaN where the estimator fails.
    errors : dict
        Root mean square errors on the held-out blocks, by the name of the output or state, in its
        unit.
    seconds : float
        Per sample, the median over a record.
    failure : str
        Why it fails; blank where it does not.
    """

    observer: str
    max_qps: int
    title: str
    score: float = np.nan
    errors: dict[str, float] = field(default_factory=dict)
    seconds: float = np.nan
    failure: str = ""


class Blocks:
    """The blocks of the records, and those among them that judge: all, if none are held out."""

    def __init__(self, data: list[Data]) -> None:
        self._parts = [
            (k, one.block == number)
            for k, one in enumerate(data) for number in np.unique(one.block)
        ]
        #: Whether each block is held out.
        self.held = np.array([bool(data[k].held[inside].any()) for k, inside in self._parts])
        every = not self.held.any()
        self.name = "all blocks" if every else "held-out blocks"
        self._judge = self.held | every
        #: The samples of each record that judge.
        self.masks = [one.held | every for one in data]

    def means(self, samples: list[Array]) -> Array:
        """The mean score of each block, NaN where there is nothing to compare."""
        parts = [samples[k][inside] for k, inside in self._parts]
        return np.array([
            float(np.nanmean(one)) if np.isfinite(one).any() else np.nan for one in parts
        ])

    def mean(self, samples: list[Array]) -> float:
        """The mean score of the samples that judge."""
        return float(np.nanmean(self.chosen(samples)))

    def chosen(self, samples: list[Array]) -> Array:
        """The samples that judge, of all records."""
        return np.concatenate([one[mask] for one, mask in zip(samples, self.masks, strict=True)])

    def sizes(self, errors: list[Array], labels: Sequence[str]) -> dict[str, float]:
        """The root mean square of each component's errors that judge, where there are any."""
        every = self.chosen(errors)
        there = np.isfinite(every)
        with np.errstate(invalid="ignore"):
            squares = np.where(there, every, 0.0) ** 2
            sizes = np.sqrt(squares.sum(axis=0) / there.sum(axis=0)).tolist()
        return {one: size for one, size in zip(labels, sizes, strict=True) if np.isfinite(size)}

    def gain(self, old: list[Array], new: list[Array]) -> tuple[float, float, int]:
        """By how many per cent a score is better, its standard error, and how many blocks judge."""
        means = np.array([self.means(old), self.means(new)])[:, self._judge]
        before, after = means[:, np.isfinite(means[0])]
        if len(before) < 2:
            return np.nan, np.nan, len(before)
        gains = 100.0 / self.mean(old) * (before - after)
        error = float(np.std(gains, ddof=1) / np.sqrt(len(gains)))
        return float(np.mean(gains)), error, len(gains)


def judge(
    blocks: Blocks, score: Score, structure: Structure, theta: Array, refined: Array
) -> tuple[Array, str]:
    """The weights to take: those of a search where they are better beyond chance."""
    points = structure.start, theta, refined
    scores = [score.samples(structure.weights(at)) for at in points]
    share, doubt, count = blocks.gain(scores[1], scores[2])
    what = "error" if score.truth else "prediction error"
    if count < 2:
        return theta, (
            f"by the likelihood: {count} {blocks.name} cannot judge the estimator's {what}; record "
            "for longer."
        )
    best = 2 if share > _CHANCE * doubt else 1
    loss, spread, _ = blocks.gain(scores[best], scores[0])
    if loss > spread and (score.truth or loss > _MATTERS):
        return points[0], (
            f"as at the start: the estimator's mean square {what} on {blocks.name} is {loss:.2g} % "
            f"smaller with these than with the tuned weights (standard error {spread:.2g} %). The "
            "model's error is not white noise, or the records are too short; tune with the truth, "
            "fewer parameters, or a better model."
        )
    if best == 2:
        return refined, (
            f"by the likelihood, then by the estimator's {what}: its mean square on {blocks.name} "
            f"falls by {share:.2g} % more (standard error {doubt:.2g} %)."
        )
    return theta, (
        f"by the likelihood: tuning the estimator's {what} as well would change its mean "
        f"square on {blocks.name} by {0.0 - share:+.2g} % (standard error {doubt:.2g} %), no gain "
        "beyond chance."
    )
