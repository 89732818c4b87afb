"""All estimators on the same windows, step by step in turn, judged by the same J."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter

import numpy as np
from peers import Array, Peer, UnavailableError, WindowData
from problems import Problem
from stopwatch import timed

from qpmhe.estimation.problem import Formulation
from qpmhe.estimation.problem import Problem as TrueProblem
from qpmhe.estimation.window import Window

__all__ = ["SAME", "Measurement", "Series", "measure"]

#: J of a converged estimator may differ by this share from Ipopt's.
SAME = 1e-6
# Untimed calls before the first timed one, for warm starts and caches.
_WARM = 5


@dataclass
class Series:
    """What one estimator did in the timed steps.

    Parameters
    ----------
    peer : Peer
        The estimator.
    setup_seconds : float
        Time to build it, once.
    times : dict of (seed, t) to float
        Seconds, without those in which another process had the processor.
    costs : dict of (seed, t) to float
        True J of its trajectory; infinite where it gave none.
    trajectories : dict of (seed, t) to array
        Its trajectories (K + 1, n).
    squares : list of float
        Squared errors of the state x(t+1).
    waited : float
        Seconds in which another process had the processor; they are not in the times.
    """

    peer: Peer
    setup_seconds: float
    times: dict[tuple[int, int], float] = field(default_factory=dict)
    costs: dict[tuple[int, int], float] = field(default_factory=dict)
    trajectories: dict[tuple[int, int], Array] = field(default_factory=dict)
    squares: list[float] = field(default_factory=list)
    waited: float = 0.0

    @property
    def spared(self) -> bool:
        """Whether it has had as many calls as it is to have."""
        most = self.peer.most_calls
        return most is not None and len(self.times) >= most

    def excess(self, reference: dict[tuple[int, int], float]) -> Array:
        """J over the reference's, less one, in all steps that both have."""
        return np.array([
            cost / reference[step] - 1.0 for step, cost in self.costs.items() if step in reference
        ])


@dataclass
class Measurement:
    """One problem's result.

    Parameters
    ----------
    problem : Problem
        The problem.
    series : list of Series
        Those that ran to the end.
    left_out : list of (str, str)
        Names of those that did not, and why.
    """

    problem: Problem
    series: list[Series]
    left_out: list[tuple[str, str]]

    @property
    def reference(self) -> Series | None:
        """The faster of Ipopt's forms without compiled functions, converged."""
        plain = [
            one for one in self.series
            if one.peer.name.startswith("CasADi Ipopt") and not getattr(one.peer, "compiled", True)
        ]
        return min(plain, key=lambda one: np.median([*one.times.values()]), default=None)

    @property
    def reference_costs(self) -> dict[tuple[int, int], float]:
        """J of the reference; without Ipopt, the lowest that any of the estimators found."""
        if self.reference is not None:
            return self.reference.costs
        lowest: dict[tuple[int, int], float] = {}
        for one in self.series:
            for step, cost in one.costs.items():
                lowest[step] = min(cost, lowest.get(step, math.inf))
        return lowest

    def difference(self, one: Series) -> float | None:
        """Its trajectories' largest difference from our converged ones, in deviations of the prior.

        None without either, and for what solves another problem.
        """
        ours = next((
            other for other in self.series
            if other.peer.kind == "qpmhe" and other.peer.converges
        ), None)
        if ours is None or one.peer.kind == "other":
            return None
        deviations = np.sqrt(np.diag(np.linalg.inv(self.problem.cost.prior)))
        return max((
            float(np.abs((found - ours.trajectories[step]) / deviations).max())
            for step, found in one.trajectories.items() if step in ours.trajectories
        ), default=None)

    @property
    def waited(self) -> float:
        """Share of the steps' time for which another process had the processor."""
        here = [one for one in self.series if not one.peer.outside]
        waited = sum(one.waited for one in here)
        return waited / max(1e-9, waited + sum(sum(one.times.values()) for one in here))

    def same_cost(self, one: Series) -> bool | None:
        """Whether it reached the reference's J in 95 % of the steps; None if it need not."""
        if not one.peer.converges:
            return None
        excess = np.abs(one.excess(self.reference_costs))
        return bool(excess.size and np.quantile(excess, 0.95) <= SAME)


def measure(
    problem: Problem,
    peers: list[Peer],
    seeds: int,
    steps: int,
    turn: int,
    tell: Callable[[str], None],
) -> Measurement:
    """Run all estimators on the same records.

    Parameters
    ----------
    problem : Problem
        The problem.
    peers : list of Peer
        Not set up yet; closed on return.
    seeds, steps : int
        Number of records, and samples of each. Timed are the steps from 2 N on.
    turn : int
        Steps that an estimator does before it is the next one's turn.
    tell : callable
        Takes what is being done.

    Returns
    -------
    Measurement
        All series, and the names of those that failed.
    """
    result = Measurement(problem, [], [])
    for peer in peers:
        tell(f"{problem.name}: building {peer.name}")
        began = perf_counter()
        try:
            peer.setup(problem)
        except UnavailableError as error:
            result.left_out.append((peer.name, str(error)))
        except Exception as error:  # whatever a peer raises: it is named, the others go on
            result.left_out.append((peer.name, f"setup: {type(error).__name__}: {error}"))
        else:
            result.series.append(Series(peer, perf_counter() - began))
    for seed in range(seeds):
        tell(f"{problem.name}: record {seed + 1} of {seeds}")
        _record(result, seed, steps, turn)
    for peer in peers:
        peer.close()
    return result


@dataclass
class _Sample:
    """A step's window, who judges it, and the state that is to be estimated."""

    data: WindowData
    judge: TrueProblem
    truth: Array


def _samples(problem: Problem, seed: int, steps: int) -> list[_Sample]:
    record = problem.scenario.simulate(seed, steps)
    window = Window(
        problem.system, problem.observer, problem.cost, problem.horizon,
        problem.scenario.initial_estimate, False, True,
    )
    formulation = Formulation(problem.system, problem.observer, problem.cost)
    samples = []
    inputs = np.zeros((steps, 0)) if record.inputs is None else record.inputs
    for y, u, truth in zip(record.measurements, inputs, record.states[1:], strict=True):
        window.push(y, u)
        data = WindowData(
            y.copy(), u.copy(), window.candidate[0].copy(), window.measurements.copy(),
            window.inputs.copy(), window.candidate.copy(),
            window.residuals[:, : problem.n].copy(),
        )
        judge = formulation.problem(window)
        # The window goes on: what the judge reads is copied.
        judge.prior, judge.measurements = data.prior, data.measurements
        judge.inputs = judge.inputs.copy()
        samples.append(_Sample(data, judge, truth))
    return samples


def _record(result: Measurement, seed: int, steps: int, turn: int) -> None:
    samples = _samples(result.problem, seed, steps)
    settled = 2 * result.problem.horizon
    first = settled - _WARM
    for one in list(result.series):
        _guarded(result, one, one.peer.restart)
    gc.collect()
    gc.disable()  # no collection falls into somebody's step
    try:
        for one in [one for one in result.series if one.peer.recursive]:
            _guarded(result, one, partial(_steps, one, samples, seed, range(first), False))
        for begin in range(first, steps, turn):
            for one in list(result.series):
                # One call is enough to warm up what is very slow.
                start = max(begin, settled - 1) if one.peer.most_calls else begin
                share = range(start, min(begin + turn, steps))
                for counted in (False, True):
                    part = [t for t in share if (t >= settled) == counted]
                    _guarded(result, one, partial(_steps, one, samples, seed, part, counted))
    finally:
        gc.enable()


def _steps(
    one: Series, samples: list[_Sample], seed: int, which: Iterable[int], counted: bool
) -> None:
    answers: dict[int, Array] = {}
    for t in which:
        if one.spared:
            break
        answer, seconds, waited = timed(one.peer.update, samples[t].data, one.peer.outside)
        if counted:
            one.times[seed, t] = seconds
            one.waited += waited
            answers[t] = answer.copy()
    for t, answer in answers.items():  # not between the steps, whose caches it would fill
        state = answer if answer.ndim == 1 else answer[-1]
        one.squares.append(float(np.sum((state - samples[t].truth) ** 2)))
        if answer.ndim == 2:
            one.costs[seed, t] = samples[t].judge.evaluate(answer).cost
            one.trajectories[seed, t] = answer


def _guarded(result: Measurement, one: Series, call: Callable[[], None]) -> None:
    if one not in result.series:
        return
    try:
        call()
    except Exception as error:  # it is named, the others go on
        result.series.remove(one)
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        result.left_out.append((one.peer.name, reason))
