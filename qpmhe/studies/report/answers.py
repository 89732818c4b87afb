"""The study's answers in plain sentences, and what limits them; all computed from the data."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..summary import PROBLEM, RANKED_BY, TOLERANCE, alone, measure, sequential
from .words import configuration_words, listed, missing, number, percent, seconds

if TYPE_CHECKING:
    from pandas import DataFrame

#: "Within 1 % of the best".
NEAR = 0.01
_FEW_SEEDS = 10
_RMSE = (
    "An RMSE has no unit: each state's is divided by the state's root mean square distance from "
    "its initial estimate over the record, and the states' mean square is taken. So 1 is the error "
    "of keeping the initial estimate for ever. The table gives the RMSE of each state in its "
    "unit."
)
_NO_TRUTH = (
    "The true states are not known, so J ranks the configurations, relative to the converged J of "
    "the same window. A lower J is not always a smaller error."
)
_MOST_NAMED = 6


@dataclass(frozen=True)
class Answer:
    """A question in a few words, and its answer."""

    question: str
    text: str


@dataclass(frozen=True)
class Case:
    """The configurations that can be compared: those of one model, horizon and record length.

    ``key`` names files and links.
    """

    key: str
    title: str
    summary: DataFrame

    @property
    def by(self) -> str:
        """The column by which they are ranked."""
        return measure(self.summary)

    @property
    def ranked_by(self) -> str:
        """The words for that column."""
        return RANKED_BY[self.by]

    @property
    def whole(self) -> DataFrame:
        """The configurations of which no cell failed, and whose rank is known."""
        return _whole(self.summary)

    def answers(self) -> list[Answer]:
        """Fastest near the best, most accurate, the observer alone, what is worse, what failed."""
        best = chosen(self.summary)
        if best is None:
            return [Answer("Result", "No configuration finished all its runs."), self._failed()]
        fastest, accurate = best
        found = []
        if fastest is not None:
            found.append(Answer(
                f"Fastest within {percent(NEAR)} of the best {self.ranked_by}",
                f"{configuration_words(fastest)}: {seconds(fastest['time_median'])} per step "
                f"(median), {self._value(fastest)}.",
            ))
        else:
            found.append(Answer("Fastest", "The study has no times: it measured accuracy only."))
        found.append(Answer("Most accurate", self._accurate(accurate, fastest)))
        observer = self._observer(fastest if fastest is not None else accurate)
        worse = self._worse()
        return [*found, *[one for one in (observer, worse) if one], self._failed()]

    def front(self) -> list[str]:
        """The Pareto front in words, the fastest first."""
        rows = self.summary[self.summary["pareto"]].sort_values("time_median")
        return [
            f"{configuration_words(row)} ({seconds(row['time_median'])}, "
            f"{self.ranked_by} {number(row[self.by])})"
            for _, row in rows.iterrows()
        ]

    def _value(self, row: Any) -> str:
        return f"{self.ranked_by} {_limited(row, self.by)}"

    def _accurate(self, accurate: Any, fastest: Any) -> str:
        same = fastest is not None and fastest.name == accurate.name
        text = (
            "The same one" if same
            else f"{configuration_words(accurate)}: {self._value(accurate)}"
            + ("" if fastest is None else f", {seconds(accurate['time_median'])} per step")
        )
        rest = self.whole.drop(accurate.name)
        equal = int((rest[self.by] <= self.whole[self.by].min() * (1 + TOLERANCE)).sum())
        apart = int((
            (rest["rmse_excess_low"] > 0) & (rest["rmse_excess"] > TOLERANCE)
        ).sum())
        reach = {0: "No other reaches", 1: "1 other reaches"}.get(equal, f"{equal} others reach")
        text += f". {reach} the same {self.ranked_by} within {percent(TOLERANCE)}"
        if rest["rmse_excess_low"].notna().any():
            text += (
                f"; {apart} of {len(rest)} {'is' if apart == 1 else 'are'} worse by more than "
                "chance (95 %, paired by seed)"
            )
        return text + "."

    def _observer(self, other: Any) -> Answer | None:
        rows = self.whole[alone(self.whole) & (self.whole["observer"] == other["observer"])]
        if rows.empty or other.name in rows.index:
            return None
        observer = rows.iloc[0]
        ratio = observer[self.by] / other[self.by] if other[self.by] > 0.0 else np.inf
        words = configuration_words(other)
        text = f"{self._value(observer)}, {number(ratio)} times the value of {words}"
        if np.isfinite(observer["time_median"]):
            share = observer["time_median"] / other["time_median"]
            text += (
                f", in {seconds(observer['time_median'])} per step ({percent(share)} of its time)"
            )
        return Answer("Observer alone (no QP)", text + ".")

    def _worse(self) -> Answer | None:
        """The configurations that estimate worse than the observer alone, the worst first."""
        observers = self.whole[alone(self.whole)].drop_duplicates("observer").set_index("observer")
        rows = self.summary[sequential(self.summary) & (self.summary["failures"] == 0)]
        rows = rows[rows["observer"].isin(observers.index)]
        if observers.empty or rows.empty or self.by != "rmse":
            return None
        question, found = "Worse than no QP", []
        for _, row in rows.iterrows():
            own = observers.loc[row["observer"]]
            for name, words in (("rmse", "RMSE"), ("rmse_settled", "RMSE after settling")):
                error, limit = float(row[name]), (1 + TOLERANCE) * float(own[name])
                if error > limit or (np.isnan(error) and not np.isnan(limit)):
                    ratio = error / float(own[name]) if own[name] > 0 else np.inf
                    times = f", {number(ratio)} times" if np.isfinite(ratio) else ""
                    text = f"{configuration_words(row)} ({words} {number(error)}{times})"
                    found.append((np.nan_to_num(ratio, nan=np.inf), text, name == "rmse"))
                    break
        if not found:
            return Answer(question, "No configuration.")
        found.sort(key=lambda one: -one[0])
        named = [text for _, text, _ in found[:_MOST_NAMED]]
        more = f"; and {len(found) - len(named)} more" if len(found) > len(named) else ""
        are = f"configuration{'s' * (len(rows) != 1)} {'has' if len(found) == 1 else 'have'}"
        over = "" if any(early for _, _, early in found) else "after settling "
        return Answer(
            question,
            f"{len(found)} of {len(rows)} {are} a larger error {over}than the observer alone, "
            f"although J is never above the candidate's: {'; '.join(named)}{more}.",
        )

    def _failed(self) -> Answer:
        rows = self.summary[~alone(self.summary)]
        never, failures = [], []
        for backend, mine in rows.groupby("backend"):
            cells, failed = int(mine["seeds"].sum()), int(mine["failures"].sum())
            share = mine["failed_steps"].max()
            if failed:
                failures.append(f"{backend}: {failed} of {cells} runs failed")
            elif share > 0:
                worst = configuration_words(mine.loc[mine["failed_steps"].idxmax()])
                failures.append(f"{worst}: {percent(share)} of the steps, but no run")
            else:
                never.append(str(backend))
        if not failures:
            everyone = "No backend failed" if len(never) != 1 else f"{never[0]} did not fail"
            return Answer("Failures", f"{everyone}, in any run or step.")
        text = f"Never: {listed(never)}. " if never else "Every backend failed somewhere. "
        return Answer("Failures", f"{text}Failed: {'; '.join(failures)}.")


def _limited(row: Any, name: str) -> str:
    """A mean with its confidence limits."""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    if missing(low) or missing(high):
        return number(row[name])
    return f"{number(row[name])} (95 %: {number(low)} to {number(high)})"


def cases(summary: DataFrame) -> list[Case]:
    """The summary, divided by problem, in its order."""
    found: list[Case] = []
    several = {name: summary[name].nunique(dropna=False) > 1 for name in PROBLEM}
    for place, ((model, level, horizon, steps), rows) in enumerate(
        summary.groupby(list(PROBLEM), dropna=False, sort=False)
    ):
        title = f"{model}, " + ("usual N" if missing(horizon) else f"N = {int(horizon)}")
        if several["steps"]:
            title += f", T = {int(steps)}"
        if several["noise_level"]:
            title += f", noise = {level:g}"
        name = file_name(title)
        key = name if name not in {case.key for case in found} else f"{name}-{place}"
        found.append(Case(key, title, rows))
    return found


def file_name(title: str) -> str:
    """A title as the name of files and links."""
    return re.sub(r"[\W_]+", "-", title).strip("-")


def chosen(summary: DataFrame) -> tuple[Any | None, Any] | None:
    """The fastest configuration near the best, and the most accurate, among equals the fastest.

    The first is None if there are no times; the result is None if no configuration finished all its
    runs.
    """
    rows, by = _whole(summary), measure(summary)
    if rows.empty:
        return None
    least = rows[by].min()
    timed = rows[rows["time_median"].notna()]

    def first(part: float) -> Any:
        near = timed[timed[by] <= least * (1 + part)]
        return None if near.empty else near.loc[near["time_median"].idxmin()]

    accurate = first(TOLERANCE)
    return first(NEAR), rows.loc[rows[by].idxmin()] if accurate is None else accurate


def _whole(rows: DataFrame) -> DataFrame:
    ranks = rows[measure(rows)].astype(float)
    return rows[(rows["failures"] == 0) & np.isfinite(ranks)]


def failures(frame: DataFrame) -> list[dict[str, Any]]:
    """Failed cells by ``model``, ``configuration`` and ``reason``, the most frequent first."""
    found: dict[tuple[str, str, str], list[int]] = {}
    for _, row in frame[frame["outcome"] != "done"].iterrows():
        reason = "unknown" if missing(row["reason"]) or not row["reason"] else str(row["reason"])
        key = (str(row["model"]), configuration_words(row), reason)
        found.setdefault(key, []).append(int(row["seed"]))
    ranked = sorted(found.items(), key=lambda item: (-len(item[1]), item[0]))
    return [
        {"model": model, "configuration": words, "reason": reason, "seeds": sorted(seeds)}
        for (model, words, reason), seeds in ranked
    ]


def limitations(frame: DataFrame, summary: DataFrame) -> list[str]:
    """What the reader must know before trusting the figures."""
    seeds = int(summary["seeds"].max())
    notes = [
        "A time covers a whole update: the observer's step, building the QPs, the solver, and the "
        "check of its iterate.",
        _RMSE if measure(summary) == "rmse" else _NO_TRUTH,
        f"Values within {percent(TOLERANCE)} count as equal on the Pareto front.",
    ]
    if seeds > 1:
        notes.append(
            "Confidence limits are of the mean over seeds (Student's, 95 %). They cover other "
            "noise, not another machine, model or tuning."
        )
    timed = frame[frame["time_median"].notna()]
    if timed["shared"].eq(True).any():
        share = float(timed["shared"].eq(True).mean())
        notes.append(
            f"Times were taken while cores were shared with other work in {percent(share)} of "
            "the runs: ratios of medians can be trusted; 99 % quantiles and maxima depend on the "
            "machine as much as on the solver."
        )
    if timed.empty:
        notes.append("No times were taken; there is no Pareto front.")
    if frame["environment"].nunique() > 1:
        notes.append(
            f"The runs were made in {frame['environment'].nunique()} environments (listed "
            "below); compare times within one of them only."
        )
    if seeds == 1:
        notes.append(
            "There is one run of each configuration only, on one seed or one measured record: no "
            "confidence limits, and luck cannot be ruled out."
        )
    elif seeds < _FEW_SEEDS:
        notes.append(f"There are {seeds} seeds only: the confidence limits are wide.")
    short = int((summary["seeds"] < seeds).sum())
    if short:
        notes.append(
            f"{short} of {len(summary)} configurations have fewer runs than {seeds}: the study "
            "is not finished, and their means are over fewer seeds than the others'."
        )
    failed = int((frame["outcome"] != "done").sum())
    if failed:
        notes.append(
            f"{failed} of {len(frame)} runs failed (listed below). A configuration with a "
            "failed run is in the table, with the means of its other runs, but neither on the "
            "Pareto front nor in the answers."
        )
    return notes
