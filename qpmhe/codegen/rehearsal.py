"""Compiled estimators compared with the Python step on CasADi's interpreter, before their use.

Short records go through both. The Python step takes over the trajectories that C returns, and
judges them: everything that C computes is compared, and no formula is repeated here.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..costs import Cost
from ..errors import ModelError, QpmheError
from ..estimation.conditions import ConditionReader, Conditions, usual_conditions
from ..estimation.engine import PythonEngine, Tools
from ..estimation.estimate import Estimate, Status
from ..estimation.limits import FEASIBLE, LARGEST
from ..estimation.optimizer import Optimizer
from ..estimation.outcome import Outcome
from ..estimation.problem import Problem
from ..estimation.settings import Settings
from ..estimation.start import check_start
from ..model.evaluation import NAMES, RESIDUALS, Buffers, Evaluator, results_of
from ..model.functions import Trusted
from ..model.model import Functions, Origin
from ..model.system import System
from ..observers import Observer
from ..observers.base import KalmanType
from ..terms.base import Trial
from .comparison import ROUNDING, Interpreter, points
from .engine import CompiledEngine
from .library import EstimatorLibrary

Array = NDArray[np.float64]

# Relative change of all that goes in, which shows how rounding spreads, and its weight.
_NUDGE, _WEIGHT = 1e-11, 300.0
# Other changes that are tried before a difference is a fault.
_NUDGES = 8
# Samples of a record, and how many of them first go through the functions for many samples.
_SAMPLES, _BY_RUN, _BY_MEMBERS = 22, 7, 2
_MANY_STATES, _FEW_SAMPLES = 40, 12
# C takes for infinite what has no finite square.
_NO_SQUARE = 1e150
# Of a record on which the nudge has grown to this share of J, rounding decides.
_LOST = 1e-2
# Of one whose numbers or deviations grow to so many times the record's, too.
_AWAY = 1e8
# A projection onto X from so many times as far away loses the digits that are compared.
_BEYOND = 1e6
# Rounding of a projection, as a share of the observer's deviations.
_EPSILONS = 4.0 * float(np.finfo(np.float64).eps)
# Where fewer samples could be compared, another record is tried, from elsewhere and with inputs
# that are smaller by this factor: with large ones, some models run away at once.
_ENOUGH, _RECORDS, _SMALLER = 5, 3, 1e-2
# So many steps, of which the Python step halves the cost and C none, are no chance.
_MISSED = 3
# Where the terms of J are so much larger than J, not every factorisation of H succeeds.
_CANCELLED = 1e6


def checked_library(
    system: System, observer: Observer, cost: Cost, settings: Settings,
    patience: float | None = None,
) -> EstimatorLibrary:
    """The library of an estimator, compared with the Python step before its first use."""
    return EstimatorLibrary(system, observer, cost, settings, estimator_fault, patience)


def compiled_engine(
    system: System, observer: Observer, cost: Cost, settings: Settings, initial_state: Array
) -> CompiledEngine:
    """The compiled engine on such a library."""
    library = checked_library(system, observer, cost, settings)
    return CompiledEngine(system, observer, cost, settings, initial_state, library)


def estimator_fault(
    library: EstimatorLibrary, system: System, observer: Observer, cost: Cost, settings: Settings
) -> str:
    """Where a compiled estimator differs from the Python step; empty where it does not."""
    assert system.symbolic is not None
    interpreter = Interpreter(system.symbolic)
    system = _interpreted_system(system, interpreter)
    # Other estimators use the library with other options.
    usual = replace(
        settings, max_qps=min(max(settings.qp_limit, 1), 3), max_solver_iterations=None,
        time_budget=None if settings.time_budget is None else 1e9,
    )
    other = replace(
        usual, max_qps=2, warm_start=not settings.warm_start,
        candidate="observer" if settings.restart or settings.candidate == "reinitialized"
        else "reinitialized",
    )
    # Where no QP improves it, an estimate has the observer's measurement update.
    observing = replace(usual, max_qps=0)
    aging = copy(cost)
    aging.discount = 1.0 if cost.discount < 1.0 else 0.95
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an observer that is far off
        for is_wild, weighed, options in (
            (False, cost, usual), (True, aging, other), (False, cost, observing),
        ):
            varied = library.varied(system, observer, weighed, options)
            if varied is None:
                weighed, options = cost, usual
                varied = library.varied(system, observer, cost, usual) or library
            for attempt in range(_RECORDS):
                rehearsal = _Rehearsal(
                    varied, interpreter, system, observer, weighed, options, is_wild, attempt
                )
                if fault := rehearsal.fault():
                    return fault
                if rehearsal.compared >= _ENOUGH:
                    break
    return ""


def _interpreted_system(system: System, interpreter: Interpreter) -> System:
    """The system with its functions evaluated by CasADi's virtual machine."""

    def functions(timed: bool) -> Functions:
        evaluator = Evaluator(partial(_looped, interpreter, timed))
        one = {name: Trusted(partial(evaluator.one, name)) for name in NAMES}
        return System.made(
            one["f"], one["h"], Origin(kernel=evaluator), n=system.n, p=system.p,
            m=system.m + timed, f_jacobian=one["f_jacobian"], h_jacobian=one["h_jacobian"],
        ).evaluation.functions

    return system.evaluated_by(replace(
        system.evaluation, functions=functions(False), timed_functions=partial(functions, True)
    ))


def _looped(
    interpreter: Interpreter, timed: bool, count: int, names: tuple[str, ...]
) -> Buffers:
    """Evaluation at one state after the other."""
    model, along = interpreter.model, names == RESIDUALS
    n, m = model.n, model.m
    states, inputs = np.zeros((count + along, n)), np.zeros((count, m + timed))
    results = results_of(model, count, names)

    def evaluate() -> None:
        for k in range(count):
            x, u, dt = states[k], inputs[k, :m], inputs[k, m] if timed else model.dt or 0.0
            if along:
                row = results["residuals"][k]
                row[:n] = states[k + 1] - interpreter.value("f", x, u, dt)
                row[n:] = results["y"][k] - interpreter.value("h", x, u, dt)
                continue
            for name in names:
                results[name].reshape(count, -1)[k] = interpreter.value(name, x, u, dt).ravel()

    return states, inputs, results, evaluate


class _Guide:
    """Takes the place of the Python step's optimizer: the estimate is what C returned.

    Attributes
    ----------
    found : Estimate
        C's, set before each step.
    nudge : float or (n,) array
        A factor on its trajectory.
    violation : float
        Of the trajectory, as the Python step sees it.
    magnitudes : dict
        Sums of the absolute terms of J, by name of the cost: where they cancel, J is rounded.
    optimizer : Optimizer
        The Python step's own.
    improved, missed : int
        In how many steps C found a better trajectory than the candidate, and in how many it did
        not where the Python step halves the cost.
    """

    found: Estimate
    optimizer: Optimizer
    magnitudes: dict[str, float]
    violation = 0.0
    improved = missed = 0

    def __init__(self, nudge: Any) -> None:
        self.nudge = nudge

    def improve(
        self, problem: Problem, shifted: Callable[[], Array | None], deadline: float = math.inf,
        damping: float = 0.0,
    ) -> Outcome:
        """C's trajectory, evaluated by the problem."""
        found, outcome = self.found, Outcome(problem.candidate)
        self.violation, usual = 0.0, problem
        known = _magnitude(problem, problem.candidate)
        if found.status & (Status.IMPROVED | Status.RESTORED):
            self.improved += 1
            if Status.ROWS_DROPPED in found.status:
                problem = problem.without_violated()
            # C has rolled it out already. Done again, rounding could lead to another branch of a
            # loss, whose J is not that of this trajectory.
            outcome.trial = problem.evaluate(
                found.trajectory * self.nudge, roll_out=np.ndim(self.nudge) > 0
            )
            outcome.improved, outcome.dropped = True, found.dropped
            outcome.events |= found.status & Status.RESTORED
            self.violation = outcome.trial.violation
        elif not (self.improved or np.ndim(self.nudge) or known > _CANCELLED * abs(found.cost)):
            best = self.optimizer.improve(problem, shifted).trial.cost
            self.missed += best < 0.5 * found.candidate_cost < _NO_SQUARE
        self.magnitudes = {"candidate_cost": known, "cost": _magnitude(usual, outcome.trial)}
        return outcome


def _magnitude(problem: Problem, trial: Trial) -> float:
    return float(np.nan_to_num(sum(term.magnitude(trial) for term in problem.terms)))


class _Follower(PythonEngine):
    """The Python step, given the trajectories of the C step."""

    def __init__(self, nudge: Any, *arguments: Any) -> None:
        self.guide = _Guide(nudge)
        super().__init__(*arguments)

    def _tools_for(self, usual: Conditions, *more: Any) -> Tools:
        tools = super()._tools_for(usual, *more)
        self.guide.optimizer = tools.optimizer
        return tools._replace(optimizer=cast("Optimizer", self.guide))


class _Sample(NamedTuple):
    """Arguments of an engine's step."""

    y: Array
    u: Array
    dt: float | None = None
    own: Conditions | None = None


class _Nudged:
    """The Python step, given all that goes in and comes from C with relative changes.

    The changes have no pattern: equal ones would leave differences as they are.
    """

    def __init__(
        self, generator: np.random.Generator, system: System, observer: Observer, cost: Cost,
        settings: Settings, start: Array,
    ) -> None:
        nudge_x, self._nudge_y = (
            1 + _NUDGE * generator.uniform(-1.0, 1.0, size) for size in (system.n, system.p)
        )
        # Differences between sigma points that are far apart lose digits.
        if isinstance(observer, KalmanType):
            spread = np.outer(nudge_x, nudge_x) * observer.initial_covariance()
            observer = observer.with_prior(spread)
        self._step = _Follower(nudge_x, system, observer, cost, settings, start * nudge_x)
        self._generator = generator

    def after(self, sample: _Sample, found: Estimate) -> Estimate:
        """The estimate after one more sample, for which C has found this."""
        self._step.guide.found = found
        estimate = self._step.step(sample.y * self._nudge_y, *sample[1:], 0.0)
        self._round_covariance()
        return estimate

    def _round_covariance(self) -> None:
        """Change the observer's newest covariance, or the root of it, as rounding does.

        Where states are nearly dependent, a covariance has few digits of what distinguishes them.
        """
        _, window = self._step.memory
        k, P, roots = window.end, window.covariance, window.root
        if P is None:
            return
        change = 1 + _EPSILONS * np.triu(self._generator.uniform(-1.0, 1.0, P[k].shape))
        if roots is not None and window.is_vague[k]:
            roots[k] *= change
            P[k] = roots[k].T @ roots[k]
        else:
            P[k] *= np.sqrt(change * change.T)


class _Rehearsal:
    """One record run through the library and the Python step.

    ``compared`` is the number of samples before rounding decided or numbers ran away.
    """

    def __init__(
        self, library: EstimatorLibrary, interpreter: Interpreter, system: System,
        observer: Observer, cost: Cost, settings: Settings, is_wild: bool,
        attempt: int,
    ) -> None:
        n, p = system.n, system.p
        self.compared, self._rounding = 0, ROUNDING
        self._library, self._generator = library, np.random.default_rng(int(is_wild))
        batches = points(interpreter, system.states, int(is_wild))
        first = next(islice(batches, attempt, None))[0][0]
        start = first * (1 + 0.1 * self._generator.uniform(-1.0, 1.0, n))
        with suppress(ModelError):  # of a model that has no finite values there
            start, system = check_start(system, observer, cost, start)
        self._start = start
        self._arguments = arguments = system, observer, cost, settings
        self._compiled = CompiledEngine(*arguments, start, library)
        self._first = observer.initial_covariance()
        self._python = _Follower(1.0, *arguments, start)
        self._nudged = _Nudged(self._generator, *arguments, start)
        most = _SAMPLES if n <= _MANY_STATES else _FEW_SAMPLES
        count = min(settings.horizon + _BY_RUN + _BY_MEMBERS, most)
        self._own = _own_conditions(system, cost, settings)
        states = self._states(first, count, interpreter, _SMALLER**attempt)
        self._size = max(abs(x).max() for x in (start, *(x for x, _ in states)))
        self._record = [
            self._sample(t, x, u, interpreter, is_wild) for t, (x, u) in enumerate(states)
        ]
        # What residuals as large as the states and measurements themselves would cost.
        sizes = np.full(len(cost.stage_weight), self._size)
        sizes[-p:] = max(np.nan_to_num(abs(one.y)).max() for one in self._record)
        self._cost = float(cost.stage_weight.diagonal() @ sizes**2)

    def _states(
        self, first: Array, count: int, interpreter: Interpreter, scale: float
    ) -> list[tuple[Array, Array]]:
        """Noisy states that stay near the first, and inputs."""
        model, generator, x, found = interpreter.model, self._generator, first, []
        for u in scale * generator.uniform(0.2, 1.0, (count, model.m)):
            found.append((x, u))
            x = interpreter.value("f", x, u, model.dt or 0.0)
            x = x * (1 + 0.05 * generator.standard_normal(model.n))
            if not abs(x).max() <= 1e3 * abs(first).max():  # NaN, too
                x = first
        return found

    def _sample(
        self, t: int, x: Array, u: Array, interpreter: Interpreter, is_wild: bool
    ) -> _Sample:
        """A measurement with noise, or far off; parts of some are missing or not as usual."""
        p, generator, dt = interpreter.model.p, self._generator, interpreter.model.dt
        factor = generator.uniform(-2.0, 2.0, p) if is_wild else (
            1 + 0.1 * generator.standard_normal(p)
        )
        y = interpreter.value("h", x, u, 0.0) * factor
        y[~(abs(y) < LARGEST)] = np.nan
        if t % 5 == 3:
            y[t % p] = np.nan
        if t % 11 == 7:
            y[:] = np.nan
        if t < _BY_RUN + _BY_MEMBERS or t % 3:
            return _Sample(y, u)
        own = self._own[t % len(self._own)]
        if own.sampled is not None:
            y[~own.sampled] = np.nan
        return _Sample(y, u, None if dt is None or t % 2 else 0.75 * dt, own)

    def fault(self) -> str:
        """What is wrong; empty if nothing is."""
        estimates: list[Estimate] = []
        for sample in self._record:
            found = self._compiled.step(*sample, 0.0)
            estimates.append(found)
            self._python.guide.found = found
            expected = self._python.step(*sample, 0.0)
            nudged = self._nudged.after(sample, found)
            self._note_roots()
            if self._is_lost(expected, nudged):
                estimates.pop()
                break
            fault = self._step_fault(found, expected, nudged, sample.y)
            if fault and self._is_rounding(estimates, expected):
                estimates.pop()
                break
            if fault:
                return fault
            if not math.isfinite(expected.candidate_cost):
                break
            self.compared += 1
        guide = self._python.guide
        if guide.missed >= _MISSED and not guide.improved:
            return "it improves no estimate where the Python step does"
        return self._many_fault(estimates)

    def _is_rounding(self, estimates: list[Estimate], expected: Estimate) -> bool:
        """Whether the last estimate is as far off as others that rounding may have led to.

        One nudge may miss the direction in which an ill-conditioned step is sensitive.
        """
        for _ in range(_NUDGES):
            other, nudged = _Nudged(self._generator, *self._arguments, self._start), expected
            for sample, found in zip(self._record, estimates, strict=False):
                nudged = other.after(sample, found)
            if self._is_lost(expected, nudged) or not self._step_fault(
                estimates[-1], expected, nudged, self._record[len(estimates) - 1].y
            ):
                return True
        return False

    def _note_roots(self) -> None:
        """Allow for the rounding of an observer's update by roots, which no nudge shows.

        A root, in units of its deviations, is rounded to shares of its least singular value. So is
        the inverse of a covariance, which may be the prior's weight, of its least eigenvalue.
        """
        _, window = self._python.memory
        here = slice(window.start, window.end + 1)
        if window.root is None:
            if window.covariance is not None and self._arguments[2].observer_prior is not None:
                P = window.covariance[here]
                scaled = P / np.sqrt(np.einsum("ki,kj->kij", *[P.diagonal(0, 1, 2)] * 2))
                if np.isfinite(scaled).all():
                    least = np.linalg.eigvalsh(scaled).min()
                    share = _EPSILONS / max(least, _EPSILONS)
                    self._rounding = max(self._rounding, min(share, _LOST))
            return
        roots = window.root[here][window.is_vague[here]]
        deviations = np.linalg.norm(roots, axis=-2, keepdims=True)
        if not (np.isfinite(deviations) & (deviations > 0.0)).all():
            self._rounding = _LOST
        elif len(roots):
            least = max(np.linalg.svd(roots / deviations, compute_uv=False).min(), _EPSILONS)
            self._rounding = max(self._rounding, min(_WEIGHT * _EPSILONS / least, _LOST))

    def _is_lost(self, expected: Estimate, nudged: Estimate) -> bool:
        """Whether the record is chaotic by now: two that nearly agreed have separate ways.

        Or its numbers have run away, so that they soon will.
        """
        largest = max(abs(expected.candidate).max(), abs(expected.observer_state).max())
        _, window = self._python.memory
        if window.covariance is not None and self._first is not None:
            # A candidate that is re-initialised goes through all stages of the window again.
            stages = window.covariance[window.start : window.end + 1]
            first, largest_of_all = (math.sqrt(abs(P).max()) for P in (self._first, stages))
            most = _BEYOND if window.projects else _AWAY
            if not largest_of_all <= most * max(first, self._size):
                return True
        apart = abs(nudged.candidate - expected.candidate).max()
        if not (
            largest <= _AWAY * self._size and apart <= _LOST * abs(expected.candidate).max()
        ) or _AWAY**2 * self._cost < expected.candidate_cost < math.inf:
            return True
        size = abs(expected.candidate_cost) + self._python.guide.magnitudes["candidate_cost"]
        return abs(nudged.candidate_cost - expected.candidate_cost) > _LOST * size

    def _step_fault(
        self, found: Estimate, expected: Estimate, nudged: Estimate, y: Array
    ) -> str:
        for name, what in (("candidate_cost", "the candidate"), ("cost", "the estimate")):
            got, true, other = (getattr(one, name) for one in (found, expected, nudged))
            if not (math.isfinite(true) and math.isfinite(other)):
                near_limit = name == "cost" and self._python.guide.violation <= 2 * FEASIBLE
                if math.isfinite(got) and not near_limit and true == other:
                    return f"J of {what} is {got:.6g}, but CasADi's interpreter has no number"
                return ""
            size = abs(true) + self._python.guide.magnitudes[name]
            if not abs(got - true) <= _WEIGHT * abs(other - true) + self._rounding * size:
                return f"J of {what} is {got:.6g}, by CasADi's interpreter {true:.6g}"
        limit, whose = found.candidate_cost, "the candidate"
        if Status.RESTORED in found.status:
            limit, whose = found.restored_cost, "the restored candidate"
        if not found.cost <= limit:
            return f"J of the estimate, {found.cost:.6g}, is above {limit:.6g}, that of {whose}"
        states = abs(np.vstack((expected.candidate, expected.trajectory))).max(axis=0)
        _, window = self._python.memory
        if window.projects and window.covariance is not None:
            # A projection moves by deviations of the observer, and rounds to a share of these.
            variances = window.covariance[window.start : window.end + 1].diagonal(0, 1, 2)
            states += _EPSILONS / self._rounding * np.sqrt(variances.max(axis=0))
        width = expected.disturbances.shape[1]
        outputs = np.nan_to_num(abs(expected.noises)).max(axis=0) + np.nan_to_num(abs(y))
        for name, sizes in (
            ("candidate", states), ("trajectory", states), ("filtered", states),
            ("observer_state", states),
            ("disturbances", states if width == states.size else states.max()),
            ("noises", outputs),
        ):
            got, true, other = (getattr(one, name) for one in (found, expected, nudged))
            allowed = _WEIGHT * np.nan_to_num(abs(other - true)) + self._rounding * sizes
            if _differs(got, true, allowed):
                return f"an estimate has other numbers in {name!r} than by CasADi's interpreter"
        return ""

    def _many_fault(self, estimates: list[Estimate]) -> str:
        """Whether the functions for many samples give what those for one have given."""
        library, count = self._library, min(_BY_RUN, len(estimates))
        if not count:
            return ""
        ys, us = (np.array([getattr(one, name) for one in self._record]) for name in ("y", "u"))
        memory, workspace = library.estimators(self._start[None]), library.workspace()
        log, out = library.log((count,)), np.zeros(1, library.estimate_type)
        library.run(
            memory.ctypes.data, 1, workspace.ctypes.data, count, ys.ctypes.data,
            us.ctypes.data if us.size else None, log.pointers(0),
        )
        made = [
            (
                log.states[t], log.filtered[t], log.observer_states[t], log.costs[t],
                log.candidate_costs[t],
            )
            for t in range(count)
        ]
        for t in range(count, min(count + _BY_MEMBERS, len(estimates))):
            library.update_members(
                memory.ctypes.data, 1, workspace.ctypes.data, ys[t].ctypes.data,
                us[t].ctypes.data, out.ctypes.data,
            )
            one = out[0].copy()
            made.append((
                one["trajectory"][one["length"]], one["filtered"], one["observer_state"],
                one["cost"], one["candidate_cost"],
            ))
        for found, one in zip(made, estimates, strict=False):
            expected = (
                one.state, one.filtered, one.observer_state, one.cost, one.candidate_cost
            )
            for got, true in zip(found, map(np.asarray, expected), strict=True):
                if _differs(np.asarray(got), true, ROUNDING * abs(true).max()):
                    return "samples of a run differ from single ones"
        return ""


def _own_conditions(system: System, cost: Cost, settings: Settings) -> list[Conditions]:
    """Conditions of single samples, as far as the estimator takes them."""
    reader, usual, found = ConditionReader(system, cost), usual_conditions(settings), []
    noise = 2.0 * cost.noise
    for disturbance in (0.5 * cost.disturbance, None):
        with suppress(QpmheError):  # of what the cost does not take
            found.append(reader.read(usual, noise_weight=noise, disturbance_weight=disturbance))
    if system.p > 1:
        found.append(Conditions(sampled=np.arange(system.p) > 0))
    return found or [Conditions()]


def _differs(got: Array, true: Array, allowed: Array | float) -> bool:
    """Whether numbers differ by more than allowed, or are finite where others are not."""
    finite = np.isfinite(true)
    if (np.isfinite(got) != finite).any():
        return True
    return bool((abs(got - true) > allowed)[finite].any())
