"""The result of tuning: weights, their intervals, what is not identified, held-out scores."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from qpmhe_solvers.values import shown

from .._checks import Array, dimension
from ..costs import Cost
from ..diagnosis.findings import listed
from ..errors import OptionError
from ..observers import Observer
from ..plots.style import STYLES, panels
from .contest import Found
from .innovations import innovations_of
from .judge import Blocks, ObserverScore
from .search import NORMAL, limit
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
# An axis whose ends are further apart has only powers of ten.
_MANY_LABELS = 50.0
# Errors that the table of estimators shows, at most.
_COLUMNS = 4
# The step of a correlation's derivatives.
_DIFFERENCE = 1e-4
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
        Per sample.
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
        All that was tuned.
    start, values : dict
        The value of each name: standard deviations of disturbance, noise and prior in the units of
        state and output (a group has the unit of its first component); correlations, where whole
        matrices are tuned; parameters. At the start, and as tuned.
    intervals : dict
        The 95 % interval (low, high) of each, by the likelihood's curvature. It is reliable if the
        model is right; model errors make it too narrow.
    likeliest : dict
        The values of largest likelihood, around which the intervals lie.
    unidentified : tuple of str
        What the records do not determine, in words.
    judgement : str
        Whether the search on the estimator's own error was used, and why.
    innovations : Innovations or None
        Whether the innovations of the filter with the likeliest weights are white, and of the size
        that these say: if not, the intervals are too narrow. None where this filter fails.
    observers : tuple of ObserverScore
        The estimators compared, best first; empty unless `qpmhe.tune` was given ``observers``.
    seconds : dict
        How long each search took.
    notes : tuple of str
        What else the user should know.
    """

    def __init__(
        self, found: Found, blocks: Blocks, again: tuple[Array, Array], seconds: dict[str, float],
        labels: Mapping[str, Sequence[str]], constant: list[int],
        observers: Sequence[ObserverScore] = (),
    ) -> None:
        likelihood, self._score, self._blocks = found.likelihood, found.score, blocks
        structure = self._structure = likelihood.structure
        self._likelihood, self._data, self._labels = likelihood, likelihood.data, labels
        self.seconds, self.judgement, self.observers = seconds, found.judgement, tuple(observers)
        self._likeliest, hessian = again
        #: What the held-out blocks have judged, which is not yet tuned on them.
        self._judged_theta = found.best
        self._theta = self._likeliest if found.best is found.theta else found.best
        self._row = found.row
        self.weights = self._named(structure.weights(self._theta))
        self.start, self.values, self.likeliest = map(
            structure.values, (structure.start, self._theta, self._likeliest)
        )
        self._find_intervals(self._likeliest, hessian)
        outside = [
            name for name, (low, high) in self.intervals.items()
            if self._theta is found.refined and not low <= self.values[name] <= high
        ]
        one = len(outside) == 1
        where = "is outside of its interval" if one else "are outside of their intervals"
        self.notes = ((
            f"{listed(outside)} {where}: the estimator is better with weights that are less "
            "likely, so the model's error is not white noise.",
        ) if outside else ()) + tuple(
            f"input {j + 1} is constant in all records, so its effect cannot be identified; vary "
            "it." for j in constant
        ) + ((f"the model failed at some points of the search ({likelihood.failure}), which were "
              "avoided.",) if likelihood.failure else ()) + ((
            f"the likelihood was computed without C, which takes longer: {likelihood.not_compiled}",
        ) if likelihood.not_compiled else ())
        likeliest = structure.weights(self._likeliest)
        self.innovations = innovations_of(
            likelihood.system(likeliest), likeliest, self._data, labels["noise"])
        if self.innovations is not None:
            self.notes += tuple(self.innovations.notes(likeliest.threshold))

    def _named(self, weights: Weights) -> Weights:
        """The weights with the estimator that was chosen."""
        if self._row is None:
            return weights
        return replace(
            weights, observer_name=self._row.observer, max_qps=self._row.max_qps)

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
        """The negative log likelihood per sample at ``likeliest``, of all blocks.

        Of several starts or models for the same records, the one with the least cost is the
        likeliest.
        """
        samples = sum(int(mask.sum()) for mask in self._likelihood.tuned)
        return self._likelihood.value(self._likeliest) / samples

    def cost(self) -> Cost:
        """The cost of these weights, ready for `qpmhe.MovingHorizonEstimator`."""
        return self.weights.cost()

    def observer(self) -> Observer:
        """The observer with these weights."""
        problem = self._score.problem(self._likelihood.system(self.weights), self.weights)
        return self._score.kind(problem)

    def save(self, path: str | Path) -> Path:
        """Write the weights as TOML, for `qpmhe.tuning.load` and ``qpmhe estimate --weights``."""
        return self.weights.save(path, str(self))

    def _find_intervals(self, theta: Array, hessian: Array) -> None:
        structure = self._structure
        values, vectors = np.linalg.eigh(hessian)
        inverse = (vectors / np.maximum(values, _FLAT)) @ vectors.T
        deviations = np.sqrt(inverse.diagonal())
        correlations = inverse / np.outer(deviations, deviations)
        self.intervals: dict[str, tuple[float, float]] = {}
        unknown = []
        for k, width in enumerate((NORMAL * deviations).tolist()):
            (low, high), at = structure.limits[k], float(theta[k])
            ends = [at - width, at + width]
            if width > _CRUDE or ends[0] < low or ends[1] > high:
                for side, way in enumerate((-1.0, 1.0)):
                    end = limit(self._likelihood, theta, hessian, k, way)
                    ends[side] = way * np.inf if end is None else end
            widest = _WIDEST_LOG if structure.is_log(k) else _WIDEST
            if k in structure.correlations:
                at, ends = self._of_correlation(theta, k, ends, inverse)
            if max(at - ends[0], ends[1] - at) > widest:
                unknown.append(k)
            stands_for = [self._stands_for(theta, k, end) for end in ends]
            self.intervals[structure.names[k]] = min(stands_for), max(stands_for)
        texts: list[str] = []
        while unknown:
            k = unknown[0]
            members = [j for j in unknown if j == k or abs(correlations[k, j]) > _TOGETHER]
            unknown = [j for j in unknown if j not in members]
            texts.append(self._words(members, correlations))
        self.unidentified = tuple(texts)

    def _of_correlation(
        self, theta: Array, k: int, ends: list[float], inverse: Array
    ) -> tuple[float, list[float]]:
        """The arctanh of a correlation and of the ends of its interval.

        Where it depends on more than component k, its uncertainty follows from that of all.
        """
        name, values = self._structure.names[k], self._structure.values
        moves = _DIFFERENCE * np.eye(len(theta))[: len(inverse)]
        sides = np.arctanh([
            [values(theta + sign * move)[name] for move in moves] for sign in (-1.0, 1.0)
        ])
        slope = (sides[1] - sides[0]) / (2.0 * _DIFFERENCE)
        if not np.delete(slope, k).any():
            return float(theta[k]), ends
        middle = float(np.arctanh(values(theta)[name]))
        width = NORMAL * float(np.sqrt(slope @ inverse @ slope))
        return middle, [middle - width, middle + width]

    def _stands_for(self, theta: Array, k: int, end: float) -> float:
        """An end of an interval in the unit of what the component stands for."""
        if k in self._structure.correlations:
            return float(np.tanh(end))
        if np.isinf(end):
            return 0.0 if end < 0.0 and self._structure.is_log(k) else end
        at = theta.copy()
        at[k] = end
        return self._structure.values(at)[self._structure.names[k]]

    def _words(self, members: list[int], correlations: Array) -> str:
        """What the records do not determine, as a sentence."""
        names = [self._structure.names[k] for k in members]
        if len(members) > 1:
            same = all(correlations[members[0], k] > 0.0 for k in members)
            return (
                f"{', '.join(names[:-1])} and {names[-1]}: they can change "
                f"{'together' if same else 'in opposite directions'}, and fit the records as well; "
                "fix one of them, or tie them in a group."
            )
        (name,) = names
        low, high = self.intervals[name]
        of_two = members[0] in self._structure.correlations
        no_low = low == (-1.0 if of_two else 0.0) or np.isinf(low)
        no_high = np.isinf(high) or (of_two and high == 1.0)
        if no_low and no_high:
            return f"{name}: the records say nothing about it, any value fits."
        if no_low:
            return f"{name}: any value below {high:.3g} fits the records."
        if no_high:
            return f"{name}: any value above {low:.3g} fits the records."
        return f"{name}: the records fit anything from {low:.3g} to {high:.3g}."

    @cached_property
    def scores(self) -> dict[str, tuple[float, float]]:
        """(before, after) on the blocks held out, or on all if none are.

        The negative log likelihood per sample, and root mean square errors in units of output or
        state. Those after are of the weights before the last search, which uses these blocks, too.
        """
        structure, ahead = self._structure, self._score.ahead
        samples = sum(int(mask.sum()) for mask in self._blocks.masks)
        before, after = (
            self._likelihood.value(at, self._blocks.masks) / samples
            for at in (structure.start, self._judged_theta)
        )
        found = {"negative log likelihood per sample": (before, after)}
        first, second = (
            self._blocks.sizes(self._score.errors(weights), self._score.labels)
            for weights in (structure.first, structure.weights(self._judged_theta))
        )
        for label, one in first.items():
            name = f"error of {label}" if self._score.truth else f"{label}, {ahead} ahead"
            found[name] = one, second.get(label, np.nan)
        return found

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
        if not isinstance(horizons, Iterable):
            raise OptionError(f"horizons is {shown(horizons)}; expected several, such as (5, 10).")
        # Those that have not seen the blocks which judge.
        rows, weights = [], self._structure.weights(self._judged_theta)
        for horizon, arrival in product(horizons, arrivals):
            dimension("horizon", horizon, 1)
            began = perf_counter()
            samples = self._score.samples(replace(weights, horizon=horizon, arrival=arrival))
            spent = (perf_counter() - began) / sum(map(len, self._data))
            rows.append(HorizonScore(horizon, arrival, self._blocks.mean(samples), spent))
        return rows

    def __repr__(self) -> str:
        start = self.start
        values = [f"{name}: {start[name]:.4g} -> {one:.4g}" for name, one in self.values.items()]
        return f"Tuning({', '.join(values)})"

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(file=io.StringIO(), width=110, no_color=True)
        for heading, headings, rows in self._tables():
            console.print(_table(heading, headings, rows))
            console.print()
        for text in self._texts():
            console.print(text, highlight=False, markup=False)
        file = console.file
        assert isinstance(file, io.StringIO)
        return "\n".join(line.rstrip() for line in file.getvalue().splitlines())

    def _repr_html_(self) -> str:
        def row(cells: Iterable[str], tag: str = "td") -> str:
            return f"<tr>{''.join(f'<{tag}>{escape(one)}</{tag}>' for one in cells)}</tr>"

        tables = (
            f"<table><caption>{escape(heading)}</caption>"
            f"{row(headings, 'th')}{''.join(map(row, rows))}</table>"
            for heading, headings, rows in self._tables()
        )
        return "".join(tables) + "".join(f"<p>{escape(one)}</p>" for one in self._texts())

    def _tables(self) -> list[tuple[str, list[str], list[tuple[str, ...]]]]:
        """Heading, headings of the columns and rows of each table."""
        weights: list[tuple[str, ...]] = [
            (name, f"{self.start[name]:.4g}", f"{value:.4g}",
             " to ".join(f"{end:.3g}" for end in self.intervals.get(name, ())))
            for name, value in self.values.items()
        ]
        scores: list[tuple[str, ...]] = [
            (name, f"{a:.4g}", f"{b:.4g}") for name, (a, b) in self.scores.items()
        ]
        title = "Weights, as standard deviations"
        title += " and correlations" * bool(self._structure.correlations)
        headings = ["", "before", "after"]
        tables = [
            (title, [*headings, "95 % interval"], weights),
            (f"Scores on {self._blocks.name}, less is better", headings, scores),
        ]
        return [*tables, self._table_of_observers()] if self.observers else tables

    def _table_of_observers(self) -> tuple[str, list[str], list[tuple[str, ...]]]:
        named = {one for row in self.observers for one in row.errors}
        labels = [one for one in self._score.labels if one in named][:_COLUMNS]
        kind = "error" if self._score.truth else f"{self._score.ahead} ahead"
        rows = [
            (row.title + " *" * (row is self._row), *(
                ("failed", *[""] * len(labels), "") if row.failure else
                (f"{row.score:.4g}", *(f"{row.errors[one]:.3g}" for one in labels),
                 f"{1e6 * row.seconds:.3g}"))
            ) for row in self.observers
        ]
        headings = ["", "score", *(f"{one}, {kind}" for one in labels), "us a step"]
        return f"Estimators on {self._blocks.name}", headings, rows

    def _texts(self) -> list[str]:
        return [
            *([] if self._row is None else [
                f"Estimator (*): {self._row.title}, the simplest whose score is within one "
                "standard error, or 1 %, of the least. The weights above are its own."
            ]),
            *(f"{row.title} fails: {row.failure}" for row in self.observers if row.failure),
            f"Chosen {self.judgement}", *([self.innovations.text] if self.innovations else []),
            *(f"Not identified: {one}" for one in self.unidentified),
            *(f"Note: {one}" for one in self.notes),
        ]

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
        names, others = self._structure.names, self._structure.correlations
        shown = [
            name for k, name in enumerate(names)
            if name in self.intervals and start[name] > 0.0 and k not in others
        ]
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
        low, high = axes.get_xlim()
        # Over several decades there is room for the powers of ten alone.
        axes.xaxis.set_major_locator(
            LogLocator(subs=(1.0, 2.0, 5.0) if high < _MANY_LABELS * low else (1.0,))
        )
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_yticks(range(len(shown)), list(reversed(shown)))
        axes.set_xlabel("standard deviation, as a factor of the start")
        axes.legend(fontsize="small", loc="best", frameon=False)

    def _draw_blocks(self, axes: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        means = np.array([
            self._blocks.means(self._score.samples(weights))
            for weights in (self._structure.first, self._structure.weights(self._judged_theta))
        ])
        shown = np.isfinite(means[0])
        held = self._blocks.held[shown]
        for k, name in enumerate(("before", "after")):
            axes.plot(means[k, shown], marker="o", markersize=3.5, label=name, **STYLES[1 - k])
        for k in np.flatnonzero(held).tolist():
            axes.axvspan(k - 0.5, k + 0.5, color="0.93", zorder=0,
                         label="held out" if k == int(np.argmax(held)) else None)
        axes.set_xlabel("block")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        what = "error" if self._score.truth else f"error {self._score.ahead} ahead"
        axes.set_ylabel(f"mean square {what}, scaled")
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize="small", loc="best", frameon=False)


def _table(title: str, headings: list[str], rows: Sequence[Sequence[str]]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table
