"""`qpmhe.tune`: the weights of an estimator, from records."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers.values import shown

from .._checks import checked_path, choice, count, dimension
from ..baselines import Problem
from ..errors import InvalidInputError, ModelError, OptionError, QpmheError
from ..model.system import System
from ..observers import ExtendedKalman, Observer
from .answer import Tuning
from .contest import Kind, Searches, kinds_of, plain
from .data import Data, check_enough, checked_data, constant_inputs, hold_out
from .judge import Blocks
from .likelihood import Likelihood
from .score import Score
from .search import SearchProgress, identity_of, refit
from .structures import Structure, checked_start
from .weights import ARRIVALS

if TYPE_CHECKING:
    from rich.console import Console

_OBJECTIVES = ("auto", "likelihood", "prediction", "truth")
# Samples times parameters beyond which compiling the step takes less time than it saves; where it
# is implicit, Python takes ten times as long.
_WORTH_COMPILING, _IMPLICIT = 2000, 10
# Spread of the logarithms of further starts.
_SPREAD = 1.0


def tune(
    system: System | Callable[..., System],
    records: Any,
    *,
    prior: ArrayLike,
    disturbance: ArrayLike,
    noise: ArrayLike,
    horizon: int = 10,
    initial_state: ArrayLike | None = None,
    structure: str | Mapping[str, Any] = "diagonal",
    objective: str = "auto",
    parameters: Mapping[str, float] | None = None,
    threshold: float | None = None,
    discount: float = 1.0,
    observer: Callable[..., Observer] = ExtendedKalman,
    observers: str | Sequence[str] | None = None,
    arrival: str = "observer",
    ahead: int = 5,
    held_out: float = 0.25,
    names: Mapping[str, Sequence[str]] | None = None,
    starts: int | None = None,
    seed: int = 0,
    jobs: int = 1,
    checkpoint: str | Path | None = None,
    progress: bool | Console = True,
    **options: Any,
) -> Tuning:
    r"""Choose the covariances of disturbance and noise, and more, from records.

    First it maximises the likelihood of the innovations of an extended Kalman filter: that gives
    the size of each covariance, its 95 % interval, and what the records do not identify. Then it
    lowers the error of the estimator itself: of its predictions, or of its states where the
    records have the truth; what this hardly depends on, as a factor of all covariances, stays as
    likely as it was. Some blocks of the records are held out of both; they judge: the second
    search must improve on them by two standard errors, and the start stays if it is better by one.
    Once they have judged, the likelihood is maximised once more over all blocks: that gives the
    weights, where the likelihood was chosen, and the intervals. The scores are those before that.

    Parameters
    ----------
    system : System or callable
        The model; or a function ``make(**parameters)`` that makes it.
    records : list
        Of (Y,), (Y, U) or (Y, U, X), arrays of measurements (T, p), inputs (T, m) and true states
        (T, n) or (T + 1, n), Series or DataFrames; of `qpmhe.tuning.TuningRecord`, which also has
        lengths of steps; or of simulated records. One record without inputs may be a Series or
        DataFrame itself. NaN in Y is a missing measurement.
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array_like
        Covariances of the initial error, of w and of v to start from, in squared units. A guess
        within a factor of a hundred will do. Zero variances of a disturbance stay zero.
    horizon : int
        N of the estimator.
    initial_state : (n,) array_like, optional
        The estimate of x(0). If left out, it is the one of each record (`TuningRecord` and
        simulated records have one), else the values that the system's ``signals`` have at the
        start, as those of an FMU do.
    structure : str or dict
        What is tuned. ``"diagonal"``: each standard deviation of w and v, with the correlations
        of the start; ``"scalar"``: one factor for each of the two covariances; ``"full"``: their
        Cholesky factors. Or a dict by ``"prior"``, ``"disturbance"`` and ``"noise"``, of such a
        word or of groups of components that share a factor, ``{"positions": [0, 1]}``; what it
        does not name stays as it is. ``"threshold": True`` and ``"discount": True`` tune these.
    objective : {"auto", "likelihood", "prediction", "truth"}
        What the second search lowers; "likelihood" leaves it out, "auto" takes the truth where
        all records have it.
    parameters : dict, optional
        Parameters of the model to be tuned, with values to start from: arguments of the function
        that makes the system, or the last inputs of the system, in their order. Their signs do not
        change.
    threshold : float, optional
        Threshold of Huber's loss of the noise, in standard deviations, for records with outliers.
    discount : float
        As for `qpmhe.QuadraticCost`.
    observer : callable
        Makes the estimator's observer from ``prior``, ``disturbance`` and ``noise``. Where it
        judges innovations, as ``functools.partial(qpmhe.ExtendedKalman, innovation=qpmhe.Gate())``
        does, those beyond its limit count in the likelihood as those beyond ``threshold`` do.
    observers : sequence of str, optional
        Observers to compare, instead of ``observer``: ``ekf``, ``gated`` (an extended Kalman filter
        with `qpmhe.Gate`), ``ukf``, ``steady`` (a constant gain about the mean of the records), or
        functions, named as for `qpmhe.Study`; ``"all"`` for these four. A function gets a problem
        with the initial state 0, here and from the file of weights. Each is tuned alone and
        with 1 to ``max_qps`` QPs, and all are ranked on the blocks that judge. The result is the
        one of the simplest estimator whose score is within one standard error, or 1 %, of the
        least: the one with the fewest QPs, of those the first in the list.
    arrival : {"observer", "constant"}
        What weighs the prior: the observer's covariance, or ``prior`` at all times.
    ahead : int
        Steps from the newest measurement to the predicted one.
    held_out : float
        Share of the blocks that judge; 0 for none.
    names : dict, optional
        Names of ``"states"`` and ``"outputs"``.
    starts : int, optional
        Number of starts of the search, the first one at the covariances given; if left out, 2 with
        ``objective="likelihood"``, else 1.
    seed : int
        Of the other starts.
    jobs : int
        Processes for several starts.
    checkpoint : str or Path, optional
        File from which the same call resumes a stopped search; removed at the end.
    progress : bool or rich.console.Console
        Whether, and where, to show a progress bar.
    **options
        Options of `qpmhe.MovingHorizonEstimator`, such as ``engine`` and ``max_qps``, by default 2.

    Returns
    -------
    Tuning
        The covariances, their intervals and scores; print it for a table.

    Raises
    ------
    InvalidInputError
        If something does not fit: records too short, without measurements, or with gaps in the
        truth; an invalid covariance; a model that fails at the start.

    Examples
    --------
    >>> import qpmhe
    >>> system, _, cost, scenario = qpmhe.models.van_der_pol()
    >>> tuning = qpmhe.tune(
    ...     system, [scenario.simulate(0, 500).measurements], prior=[[1, 0], [0, 1]],
    ...     disturbance=[[0.01, 0], [0, 0.01]], noise=[[1.0]], initial_state=[0, 0],
    ...     objective="likelihood")
    >>> low, high = tuning.intervals["noise y1"]
    >>> low < 0.1 < high
    True
    """
    choice("objective", objective, _OBJECTIVES)
    choice("arrival", arrival, ARRIVALS)
    for name, value in (
        ("horizon", horizon), ("ahead", ahead), ("starts", 1 if starts is None else starts),
        ("jobs", jobs),
    ):
        dimension(name, value, 1)
    count("seed", seed, 0)
    kept_in = None if checkpoint is None else checked_path("checkpoint", checkpoint)
    started = _mapping("parameters", parameters, "{'mass': 0.5}")
    make, remade, first = _maker(system, started)
    inputs = _measured_inputs(first, remade, started)
    start = checked_start(
        {"prior": first.n, "disturbance": first.r, "noise": first.p}, prior, disturbance, noise,
        discount, threshold, started, horizon=horizon, arrival=arrival,
    )
    data = checked_data(records, first, inputs, initial_state)
    kinds = _kinds(observer, observers, start.problem(first, data[0].start), arrival)
    hold_out(data, held_out, 2 * ahead)
    labels = _labels(first, names)
    plan = Structure(start, structure, labels)
    noises = [j for j, one in enumerate(labels["noise"]) if f"noise {one}" in plan.names]
    check_enough(data, plan.names, noises)
    constant, objective = constant_inputs(data, bool(started)), _aim(objective, data)
    options = {"max_qps": 2, **options}
    if starts is None:  # a further one costs little where the filter alone is searched
        starts = 2 if objective == "likelihood" else 1
    likelihoods = {kind.limit: Likelihood(plan, data, make, remade, kind.limit) for kind in kinds}
    for one in likelihoods.values():
        one.compile()
    at_start = _likelihood_at_start(likelihoods[kinds[0].limit])
    truth = objective == "truth"
    score = Score(
        data, make, plain() if observers else kinds[0].make, start, ahead=ahead, truth=truth,
        begins=any(name.startswith("prior ") for name in plan.names),
        labels=labels["prior" if truth else "noise"], options=options,
    )
    score.follow = likelihoods[kinds[0].limit].follow
    how = first.origin.how
    factor = _IMPLICIT if how is not None and how.is_implicit else 1
    work = sum(map(len, data)) * len(plan.names) * factor
    if objective != "likelihood" and work > _WORTH_COMPILING:
        score.compile()
    if objective != "likelihood" or observers:
        _ = score.scale  # what is wrong with the options shows before the search
    kept = SearchProgress(kept_in, identity_of(likelihoods[kinds[0].limit], at_start, (
        objective, ahead, seed, starts, sorted(options.items(), key=str),
        *(one.name for one in kinds if observers),
    )))
    blocks = Blocks(data)
    with _interruptible(), _shown(progress) as advance:
        expected = starts * likelihoods[kinds[0].limit].expected_seconds()
        advance(f"likelihood, about {expected:.2g} s")
        searches = Searches(
            likelihoods, score, objective, blocks, _beginnings(plan, starts, seed), jobs, kept,
            advance,
        )
        if observers:
            best, rows = searches.contest(kinds, dimension("max_qps", options["max_qps"], 0))
        else:
            best, rows = searches.settled(searches.likely(kinds[0].limit)), []
        advance("all blocks")
        again = refit(best.likelihood, best.theta, best.hessian)
        tuning = Tuning(best, blocks, again, searches.seconds, labels, constant, rows)
    kept.remove()
    return tuning


def _kinds(observer: Any, observers: Any, problem: Problem, arrival: str) -> list[Kind]:
    """The observers to compare, or the only one."""
    if observers is None:
        made = _made_observer(observer, problem)
        return [Kind("", plain(observer), made.innovation_limit)]
    if observer is not ExtendedKalman:
        raise OptionError(
            "both observer and observers are given; give observers alone, which may name a "
            "function."
        )
    return kinds_of(observers, problem, arrival)


def _maker(
    system: Any, parameters: dict[str, float]
) -> tuple[Callable[[dict[str, float]], System], bool, System]:
    """What makes the system from its parameters, whether anew for each, and the first one."""
    if isinstance(system, System):
        return lambda _: system, False, system
    if not callable(system):
        raise ModelError(
            f"system is {shown(system)}; expected a qpmhe.System, or a function make(**parameters)."
        )
    try:
        made = system(**parameters)
    except QpmheError:
        raise
    except Exception as error:
        given = ", ".join(f"{name}={value!r}" for name, value in parameters.items())
        raise ModelError(
            f"system({given}) raised {type(error).__name__}: {error}; expected a function that "
            "makes a qpmhe.System of these parameters."
        ) from error
    if not isinstance(made, System):
        raise ModelError(
            f"the function given as system returned {shown(made)}; expected a qpmhe.System."
        )
    return lambda at: system(**at), bool(parameters), made


def _measured_inputs(first: System, remade: bool, parameters: dict[str, float]) -> int:
    """How many inputs records have: the parameters to be tuned may be the last ones."""
    inputs = first.m if remade else first.m - len(parameters)
    if inputs < 0:
        raise InvalidInputError(
            f"parameters names {len(parameters)}, and the system has {first.m} inputs, the last of "
            "which are the parameters; give a function make(**parameters) as system instead."
        )
    return inputs


def _aim(objective: str, data: Sequence[Data]) -> str:
    """What the second search lowers; "auto" depends on what the records have."""
    has_truth = all(one.truth is not None for one in data)
    if objective == "truth" and not has_truth:
        raise InvalidInputError(
            "objective is 'truth', and not all records have true states; give (Y, U, X)."
        )
    if objective != "auto":
        return objective
    return "truth" if has_truth else "prediction"


def _likelihood_at_start(likelihood: Likelihood) -> float:
    value = likelihood.value(likelihood.structure.start)
    if not np.isfinite(value):
        raise ModelError(
            "the likelihood is not finite at the start: "
            f"{likelihood.failure or 'the filter diverges'}. Start from larger covariances, "
            "another initial_state or other parameters, or bound the states by System(states=...)."
        )
    return value


def _beginnings(plan: Structure, starts: int, seed: int) -> list[NDArray[np.float64]]:
    """Where the searches begin: the start, and points around it."""
    spread = _SPREAD * np.random.default_rng(seed).standard_normal((starts - 1, len(plan.start)))
    return [plan.start, *map(plan.bounded, plan.start + spread)]


def _made_observer(kind: Any, problem: Problem) -> Observer:
    """Make one, so that what is wrong shows before the search."""
    expected = (
        "expected a callable that makes an observer from prior, disturbance and noise, such as "
        "qpmhe.ExtendedKalman."
    )
    if not callable(kind):
        raise OptionError(f"observer is {shown(kind)}; {expected}")
    try:
        made = plain(kind)(problem)
    except QpmheError:
        raise
    except Exception as error:
        raise OptionError(
            f"observer(prior=..., disturbance=..., noise=...) raised {type(error).__name__}: "
            f"{error}; {expected}"
        ) from error
    if not isinstance(made, Observer):
        raise OptionError(
            f"observer(prior=..., disturbance=..., noise=...) returned {shown(made)}; {expected}"
        )
    return made


def _mapping(name: str, given: Any, example: str) -> dict[str, Any]:
    """A dict, empty for None."""
    if not (given is None or isinstance(given, Mapping)):
        raise OptionError(f"{name} is {shown(given)}; expected a dict, such as {example}.")
    return dict(given or {})


def _labels(system: System, names: Mapping[str, Sequence[str]] | None) -> dict[str, list[str]]:
    given = _mapping("names", names, "{'states': ['position', 'speed']}")
    found = {}
    for kind, letter, size in (("states", "x", system.n), ("outputs", "y", system.p)):
        labels = [str(one) for one in given.pop(kind, [])] or [
            f"{letter}{i + 1}" for i in range(size)
        ]
        if len(labels) != size or len(set(labels)) != size:
            raise OptionError(f"names of {kind} are {labels}; expected {size} different ones.")
        found[kind] = labels
    if given:
        raise OptionError(f"names has {', '.join(map(repr, given))}; expected states, outputs.")
    w = found["states"] if system.r == system.n else [f"w{i + 1}" for i in range(system.r)]
    return {"prior": found["states"], "disturbance": w, "noise": found["outputs"]}


@contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C as a KeyboardInterrupt: within a call of CasADi, it comes out as another error."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    came = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        before(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    except Exception as error:
        if came:
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _shown(progress: bool | Console) -> Iterator[Callable[[str], None]]:
    """A progress bar, and the function that reports progress to it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    if not isinstance(progress, bool) and not hasattr(progress, "print"):
        raise OptionError(
            f"progress is {shown(progress)}; expected True, False or a rich.console.Console."
        )
    console = Console(stderr=True) if isinstance(progress, bool) else progress
    with Progress(
        TextColumn("tuning"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn(),
        console=console, transient=True, disable=progress is False or not console.is_terminal,
    ) as bar:
        task = bar.add_task("likelihood", total=None)
        yield lambda text: bar.update(task, description=text)
