"""What tuning has found: weights, their intervals, what is not identified, held-out scores."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import Array, dimension
from ..costs import Cost
from ..errors import OptionError
from ..observers import Observer
from ..plots.style import STYLES, panels
from .data import Data
from .likelihood import Likelihood
from .score import Score
from .search import NORMAL, limit
from .structures import Structure
from .weights import Weights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Intervals that are wider than this factor, or share, come from the likelihood itself: its
# curvature is too crude for them.
_CRUDE = 0.3
# Wider 95 % intervals, either way: a factor for standard deviations, else a share or a number.
_WIDEST_LOG, _WIDEST = float(np.log(10.0)), 1.0
# Uncertainties that are as correlated as this are named in one sentence.
_TOGETHER = 0.8
# Eigenvalues of the Hessian below this count as it; an interval is infinite then.
_FLAT = 1e-6


@dataclass(frozen=True)
class HorizonScore:
    """A row of `Tuning.horizons`.

    Attributes
    ----------
    horizon : int
        N.
    arrival : str
        What weighs the prior, "observer" or "constant".
    score : float
        The held-out score, as a share of the start weights' score.
    seconds : float
        For a sample.
    """

    horizon: int
    arrival: str
    score: float
    seconds: float


class Tuning:
    """The answer of `qpmhe.tune`; printing it gives a table.

    Attributes
    ----------
    weights : Weights
        What was found, as a whole.
    start, values : dict
        What each name stands for: standard deviations of disturbance, noise and prior in the
        units of state and output (a group has the unit of its first component); parameters. At the
        start, and as tuned.
    intervals : dict
        Its 95 % interval (low, high) by the likelihood's curvature. That is honest where the
        model is right; errors of the model make intervals too narrow.
    likeliest : dict
        The values of largest likelihood, about which the intervals are.
    unidentified : tuple of str
        What the records do not determine, in words.
    judgement : str
        Whether the search on the estimator's own error was taken, and why.
    seconds : dict
        How long each search took.
    notes : tuple of str
        What else the user should know.
    """

    def __init__(
        self, structure: Structure, data: list[Data], likelihood: Likelihood, score: Score,
        weights_at: Callable[[Array], Weights], theta: Array, hessian: Array,
        refined: Array | None, objective: str, ahead: int, seconds: dict[str, float],
        labels: Mapping[str, Sequence[str]], constant: list[int],
    ) -> None:
        self._structure, self._data, self._likelihood = structure, data, likelihood
        self._score, self._weights_at = score, weights_at
        self._objective, self._ahead, self._labels = objective, ahead, labels
        self.seconds = seconds
        self._judged = [one.held if any(each.held.any() for each in data)
                        else np.ones(len(one), np.bool_) for one in data]
        chosen = theta
        self.judgement = "by the likelihood alone."
        if refined is not None:
            chosen, self.judgement = self._judge(theta, refined)
        self._likeliest, self._theta = theta, chosen
        self.weights = weights_at(chosen)
        self.start, self.values = structure.values(structure.start), structure.values(chosen)
        self.likeliest = structure.values(theta)
        self._find_intervals(theta, hessian)
        self.notes = tuple(
            f"input {j + 1} is constant in all records, so nothing that it acts by is identified; "
            "vary it." for j in constant
        ) + ((f"the model failed at some points of the search ({likelihood.failure}), which were "
              "avoided.",) if likelihood.failure else ())

    @property
    def prior(self) -> Array:
        """Covariance of the initial error (n, n)."""
        return self.weights.prior

    @property
    def disturbance(self) -> Array:
        """Covariance of w (r, r)."""
        return self.weights.disturbance

    @property
    def noise(self) -> Array:
        """Covariance of v (p, p)."""
        return self.weights.noise

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters of the model."""
        return self.weights.parameters

    @property
    def cost_per_sample(self) -> float:
        """The negative log likelihood per sample at ``likeliest``, of the blocks that tune.

        Among several starts or models for the same records, the least one is the likeliest.
        """
        chosen = [~one.held for one in self._data]
        samples = sum(int(mask.sum()) for mask in chosen)
        return self._likelihood.value(self._likeliest, chosen) / samples

    def cost(self) -> Cost:
        """The cost of these weights, ready for `qpmhe.MovingHorizonEstimator`."""
        return self.weights.cost()

    def observer(self) -> Observer:
        """The observer that goes with it."""
        return self.weights.observer(self._score.kind)

    def save(self, path: str | Path) -> Path:
        """Write the weights as TOML, for `qpmhe.tuning.load` and ``qpmhe estimate --weights``."""
        return self.weights.save(path, str(self))

    @cached_property
    def _samples(self) -> dict[str, list[Array]]:
        """The estimator's score of each sample, before and after."""
        first = self._weights_at(self._structure.start)
        return {"before": self._score.samples(first), "after": self._score.samples(self.weights)}

    @property
    def _judges(self) -> str:
        return "held-out blocks" if any(one.held.any() for one in self._data) else "all blocks"

    def _judge(self, theta: Array, refined: Array) -> tuple[Array, str]:
        """The weights to take: those of a search where they are better beyond chance."""
        start = self._structure.start
        found = [self._score.samples(self._weights_at(at)) for at in (start, theta, refined)]
        what = "error" if self._objective == "truth" else "prediction error"
        blocks = self._judges
        count = len(self._block_gains(found[0], found[1]))
        if count < 2:
            return theta, (
                f"by the likelihood: {count} {blocks} cannot judge the estimator's {what}; record "
                "for longer."
            )

        def gain(old: list[Array], new: list[Array]) -> tuple[float, float]:
            gains = self._block_gains(old, new)
            each = 100.0 / self._mean(old)
            spread = each * np.std(gains, ddof=1) / np.sqrt(count)
            return each * float(np.mean(gains)), float(spread)

        share, doubt = gain(found[1], found[2])
        best, chosen = (2, refined) if share > doubt else (1, theta)
        loss, spread = gain(found[best], found[0])
        if loss > spread:
            return start, (
                f"as at the start: the estimator's mean square {what} on {blocks} is larger with "
                "what was found. The model's error is no white noise, or the records are too "
                "short; tune with the truth, fewer parameters, or a better model."
            )
        if best == 2:
            return chosen, (
                f"by the likelihood, then by the estimator's {what}: its mean square on {blocks} "
                f"falls by {share:.2g} % more (standard error {doubt:.2g} %)."
            )
        return chosen, (
            f"by the likelihood: tuning the estimator's {what} as well would change its mean "
            f"square on {blocks} by {-share:+.2g} % (standard error {doubt:.2g} %), no gain "
            "beyond chance."
        )

    def _block_gains(self, old: list[Array], new: list[Array]) -> list[float]:
        """By how much each block that judges is better."""
        gains = []
        for one, mask, before, after in zip(self._data, self._judged, old, new, strict=True):
            for block in np.unique(one.block[mask]):
                inside = (before - after)[mask & (one.block == block)]
                if np.isfinite(inside).any():
                    gains.append(float(np.nanmean(inside)))
        return gains

    def _find_intervals(self, theta: Array, hessian: Array) -> None:
        structure, count = self._structure, self._structure.seen
        values, vectors = np.linalg.eigh(hessian)
        inverse = (vectors / np.maximum(values, _FLAT)) @ vectors.T
        deviations = np.sqrt(inverse.diagonal())
        self.intervals: dict[str, tuple[float, float]] = {}
        ends, unknown = {}, []
        for k in range(count):
            low, high = structure.limits[k]
            width, ways = float(NORMAL * deviations[k]), (-1.0, 1.0)
            ends[k] = [float(theta[k]) + way * width for way in ways]
            if width > _CRUDE or ends[k][0] < low or ends[k][1] > high:
                found = [
                    limit(self._likelihood, theta, hessian, structure, self._data, k, way)
                    for way in ways
                ]
                ends[k] = [
                    way * np.inf if one is None else one
                    for way, one in zip(ways, found, strict=True)
                ]
            widest = _WIDEST_LOG if structure.is_log(k) else _WIDEST
            if max(theta[k] - ends[k][0], ends[k][1] - theta[k]) > widest:
                unknown.append(k)
            self.intervals[structure.names[k]] = self._stands_for(theta, k, ends[k])
        correlations = inverse / np.outer(deviations, deviations)
        told: set[int] = set()
        texts = []
        for k in unknown:
            if k not in told:
                members = [
                    j for j in unknown if j == k or abs(correlations[k, j]) > _TOGETHER
                ]
                told.update(members)
                texts.append(self._words(members, correlations))
        self.unidentified = tuple(texts)

    def _stands_for(self, theta: Array, k: int, ends: list[float]) -> tuple[float, float]:
        """The ends of an interval in the unit of what the component stands for."""
        found = []
        for end in ends:
            if np.isinf(end):
                found.append(0.0 if end < 0.0 and self._structure.is_log(k) else end)
                continue
            at = theta.copy()
            at[k] = end
            found.append(self._structure.values(at)[self._structure.names[k]])
        return min(found), max(found)

    def _words(self, members: list[int], correlations: Array) -> str:
        """What the records do not determine, as a sentence."""
        names = [self._structure.names[k] for k in members]
        if len(members) > 1:
            same = all(correlations[members[0], k] > 0.0 for k in members)
            return (
                f"{', '.join(names[:-1])} and {names[-1]}: they can change "
                f"{'together' if same else 'one against the other'}, and fit the records as well; "
                "fix one of them, or tie them in a group."
            )
        (name,) = names
        low, high = self.intervals[name]
        no_low = low == 0.0 or np.isinf(low)
        if no_low and np.isinf(high):
            return f"{name}: the records say nothing about it, any value fits."
        if no_low:
            return f"{name}: any value below {high:.3g} fits the records."
        if np.isinf(high):
            return f"{name}: any value above {low:.3g} fits the records."
        return f"{name}: the records fit anything from {low:.3g} to {high:.3g}."

    @cached_property
    def scores(self) -> dict[str, tuple[float, float]]:
        """(before, after) on the blocks held out, or on all if none are.

        The negative log likelihood per sample, and root mean square errors in units of output or
        state.
        """
        start, found = self._structure.start, {}
        samples = sum(int(mask.sum()) for mask in self._judged)
        found["negative log likelihood per sample"] = tuple(
            self._likelihood.value(at, self._judged) / samples for at in (start, self._likeliest)
        )
        errors = [self._score.errors(self._weights_at(at)) for at in (start, self._theta)]
        truth = self._objective == "truth"
        labels = self._labels["prior" if truth else "noise"]
        for j, label in enumerate(labels):
            sizes = []
            for each in errors:
                part = np.concatenate(
                    [one[mask, j] for one, mask in zip(each, self._judged, strict=True)]
                )
                part = part[np.isfinite(part)]
                sizes.append(float(np.sqrt(np.mean(part * part))) if part.size else np.nan)
            name = f"error of {label}" if truth else f"{label}, {self._ahead} ahead"
            if np.isfinite(sizes[0]):
                found[name] = sizes[0], sizes[1]
        return {name: (float(a), float(b)) for name, (a, b) in found.items()}

    def horizons(
        self, horizons: Sequence[int] = (2, 5, 10, 20, 40),
        arrivals: Sequence[str] = ("observer", "constant"),
    ) -> list[HorizonScore]:
        """The held-out score against N, and against what weighs the prior.

        Take the shortest horizon whose score is about the best.

        Parameters
        ----------
        horizons : sequence of int
            N to try.
        arrivals : sequence of str
            "observer", "constant" or both.

        Returns
        -------
        list of HorizonScore
            In the order of ``horizons``; scores have the unit of those before tuning.
        """
        rows = []
        if not isinstance(horizons, Iterable):
            raise OptionError(f"horizons is {shown(horizons)}; expected several, such as (5, 10).")
        for horizon in horizons:
            dimension("horizon", horizon, 1)
            for arrival in arrivals:
                weights = Weights(**{
                    **vars(self.weights), "horizon": horizon, "arrival": arrival,
                })
                began = perf_counter()
                samples = self._score.samples(weights)
                spent = (perf_counter() - began) / sum(map(len, self._data))
                rows.append(HorizonScore(horizon, arrival, self._mean(samples), spent))
        return rows

    def _mean(self, samples: list[Array]) -> float:
        return float(np.nanmean(np.concatenate(
            [one[mask] for one, mask in zip(samples, self._judged, strict=True)]
        )))

    def __str__(self) -> str:
        from rich.console import Console
        from rich.table import Table

        weights = Table(box=None, pad_edge=False, title="Weights, as standard deviations",
                        title_justify="left")
        for title in ("", "before", "after", "95 % interval"):
            weights.add_column(title, justify="left" if not title else "right", no_wrap=True)
        for name, value in self.values.items():
            interval = self.intervals.get(name)
            text = "" if interval is None else f"{interval[0]:.3g} to {interval[1]:.3g}"
            weights.add_row(name, f"{self.start[name]:.4g}", f"{value:.4g}", text)
        scores = Table(box=None, pad_edge=False, title=f"Scores on {self._judges}, less is better",
                       title_justify="left")
        for title in ("", "before", "after"):
            scores.add_column(title, justify="left" if not title else "right", no_wrap=True)
        for name, (before, after) in self.scores.items():
            scores.add_row(name, f"{before:.4g}", f"{after:.4g}")
        console = Console(file=io.StringIO(), width=110, no_color=True)
        console.print(weights)
        console.print()
        console.print(scores)
        console.print()
        texts = [f"Chosen {self.judgement}"]
        texts += [f"Not identified: {one}" for one in self.unidentified]
        texts += [f"Note: {one}" for one in self.notes]
        for text in texts:
            console.print(text, highlight=False, markup=False)
        file = console.file
        assert isinstance(file, io.StringIO)
        return "\n".join(line.rstrip() for line in file.getvalue().splitlines())

    def plot(self, axes: Any = None) -> Any:
        """Draw how each value has changed with its interval, and the held-out scores.

        Parameters
        ----------
        axes : two matplotlib Axes, optional
            To draw into; a new figure if left out.

        Returns
        -------
        list of Axes
            Values as factors of the start; scores of the blocks.
        """
        if axes is None:
            from matplotlib import rc_context
            from matplotlib.figure import Figure

            from ..plots.style import LIGHT

            with rc_context(LIGHT):
                tall = 1.2 + 0.24 * len(self.intervals)
                figure = Figure(figsize=(8.4, max(3.2, tall)), layout="constrained")
                axes = figure.subplots(1, 2, width_ratios=(3, 2))
        left, right = panels(2, axes)
        self._draw_values(left)
        self._draw_blocks(right)
        return [left, right]

    def _draw_values(self, axes: Axes) -> None:
        from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

        start = self.start
        shown = [name for name in self.intervals if start[name] > 0.0]
        found, blue = STYLES[0]["color"], STYLES[1]["color"]
        for row, name in enumerate(reversed(shown)):
            low, high = (
                float(np.clip(end / start[name], 1e-4, 1e4)) for end in self.intervals[name]
            )
            axes.plot([low, high], [row, row], color=found, linewidth=5.0, alpha=0.3,
                      solid_capstyle="butt", label="95 % interval" if row == 0 else None)
            axes.plot(self.values[name] / start[name], row, "o", color=found, markersize=5.0,
                      label="after" if row == 0 else None)
        axes.axvline(1.0, color=blue, linestyle="--", linewidth=1.2, label="before")
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_yticks(range(len(shown)), list(reversed(shown)))
        axes.set_xlabel("standard deviation, as a factor of the start")
        axes.legend(fontsize="small", loc="best", frameon=False)

    def _draw_blocks(self, axes: Axes) -> None:
        where, rows = [], {"before": [], "after": []}  # type: ignore[var-annotated]
        for k, one in enumerate(self._data):
            for block in np.unique(one.block):
                inside = one.block == block
                if not np.isfinite(self._samples["before"][k][inside]).any():
                    continue
                where.append(bool(one.held[inside].any()))
                for name, found in rows.items():
                    found.append(float(np.nanmean(self._samples[name][k][inside])))
        at = np.arange(len(where))
        for k, (name, found) in enumerate(rows.items()):
            style = STYLES[1 - k]
            axes.plot(at, found, marker="o", markersize=3.5, label=name, **style)
        for k in np.flatnonzero(where).tolist():
            axes.axvspan(k - 0.5, k + 0.5, color="0.93", zorder=0,
                         label="held out" if k == int(np.argmax(where)) else None)
        axes.set_xlabel("block")
        what = "error" if self._objective == "truth" else f"error {self._ahead} ahead"
        axes.set_ylabel(f"mean square {what}, scaled")
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize="small", loc="best", frameon=False)
