"""What a study compares: models, backends, caps, horizons and seeds; in Python or in a TOML file.

In a TOML file the keys are the parameters of `Study`. TOML has no None: ``"none"`` stands for it
in ``qps`` (iterate to convergence) and ``solver_iterations``, ``"default"`` in ``horizons``. Paths
of models and records are relative to the file.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from difflib import get_close_matches
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from qpmhe_solvers import available, backend, backends
from qpmhe_solvers.errors import report_unknown_options
from qpmhe_solvers.values import shown

from .._checks import choice, count, dimension, flag, positive
from ..baselines import Baseline, observers
from ..errors import BackendError, InvalidInputError, ModelError, OptionError
from ..estimation.estimator import MovingHorizonEstimator
from ..models.loading import ModelSource, check_named_in_file, find
from ..observers import Observer
from ..records.readers import ReadingOptions
from .experiment import Source, experiment
from .row import OBSERVER, USUAL_OBSERVER, Cell

if TYPE_CHECKING:
    from .store import Store

Measure = Literal["both", "accuracy", "time"]
#: Where the sequence of QPs begins: at the candidate, or warm-started where that is better.
Start = Literal["candidate", "best"]
#: What stands for None in files and on the command line.
WORDS = {"qps": "none", "solver_iterations": "none", "horizons": "default"}
#: How a record is read: the options and their defaults.
READING = {
    **dict.fromkeys(("time", "outputs", "inputs", "truth", "dt")), "time_scale": 1.0,
    **asdict(ReadingOptions()),
}


#: Short names of observers and estimators, and the functions that make them.
KNOWN = {
    "observers": observers.KNOWN,
    "estimators": {
        "ekf": "qpmhe.baselines:ExtendedKalmanFilter",
        "ukf": "qpmhe.baselines:UnscentedKalmanFilter",
        "enkf": "qpmhe.baselines:EnsembleKalmanFilter",
        "particles": "qpmhe.baselines:BootstrapParticleFilter",
    },
}
# What the functions return.
_RETURNS: dict[str, tuple[type, ...]] = {
    "observers": (Observer,), "estimators": (Baseline, MovingHorizonEstimator),
}


class StudyError(OptionError):
    """A study that cannot run as written, or not on the named cluster."""


@report_unknown_options
@dataclass(frozen=True)
class Study:
    """A grid of estimators, each run on simulated records of many seeds, or on measured ones.

    All cells run with ``engine="python"``, the only engine that calls the backends.

    Identical cells run once: with ``qps=0`` no QP is solved, so there is one cell, whose backend is
    called ``observer``; a backend without a cap has one cell for all ``solver_iterations``.

    Parameters
    ----------
    models : sequence of str
        Names of the catalogue, with arguments where wanted (``chain_of_masses(masses=2)``), or
        functions that return system, observer, cost and scenario: ``package.module:function`` or
        ``path/file.py:function``. With ``records``, a dict of options may stand in for the
        scenario, as for ``qpmhe estimate``.
    records : sequence of str or Path
        Measured records, files that `qpmhe.records.read` reads, to run each model on; seeds and
        noise levels do not apply. J and J / converged J judge the configurations, and errors where
        true states are known.
    reading : mapping
        How records are read: ``time``, ``outputs``, ``inputs``, ``truth`` (columns), ``dt``,
        ``time_scale``, and those of `qpmhe.records.ReadingOptions`.
    backends : sequence of str, optional
        QP backends; by default all that are installed, without the forms ``qpsolvers:...``.
    observers : sequence of str
        Observers: ``model`` for the model's own, ``ekf``, ``gated`` (with `qpmhe.Gate`), ``ukf``,
        ``steady`` (a constant gain), or functions, named as models are. Such a function gets a
        `qpmhe.baselines.Problem` and returns an observer. The cost, and what it says of the prior,
        stays the model's.
    estimators : mapping or sequence of str
        Other estimators, by the names that tables give them: ``ekf``, ``ukf``, ``enkf``,
        ``particles``, the filters of `qpmhe.baselines`, with arguments where wanted
        (``enkf(members=40)``), or functions, likewise. Such a function gets a
        `qpmhe.baselines.Problem` and returns any object that `qpmhe.baselines.follow` can run, such
        as one with ``update(y, u)``, which returns the estimate of x(t+1). Each is one cell beside
        those of the grid.
    qps, solver_iterations, horizons : sequence of int or None
        QPs per sample, the paper's i (0 is the observer; None iterates to convergence); caps on
        the solver's iterations in each QP (None: its default); N (None: the scenario's).
    noise_levels : sequence of float
        Factors on the standard deviations of the simulated disturbance and noise; the weights of
        the estimators stay those of the model.
    starts : sequence of {"candidate", "best"}
        Where the sequences of QPs start.
    seeds : int or sequence of int
        Seeds of the records; a number k stands for 0, ..., k-1.
    steps : int, optional
        Samples of a record; the scenario's by default, or all that were measured.
    measure : {"both", "accuracy", "time"}
        What is recorded. With "time" one cell runs at a time, unless you ask for more jobs.
    deadline : float, optional
        Seconds; the results report the share of steps that take longer.
    covariances : bool
        Whether to compute covariances, and judge errors by them (NEES).
    cell_timeout : float
        Seconds for one cell.
    folder : str or Path, optional
        The paths of models and records are relative to it; by default to the working directory.

    Raises
    ------
    StudyError, OptionError, BackendError, ModelError
        If the grid is empty, or a value is unknown, out of range or not installed.

    Examples
    --------
    >>> from qpmhe.studies import Study
    >>> study = Study(backends=["banded"], qps=[0, 1], seeds=3)
    >>> study.cells()[0].key
    'batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0'
    """

    models: Sequence[str] = ("batch_reactor",)
    records: Sequence[str | Path] = ()
    reading: Mapping[str, Any] = field(default_factory=dict, hash=False)
    backends: Sequence[str] | None = None
    observers: Sequence[str] = (USUAL_OBSERVER,)
    estimators: Mapping[str, str] | Sequence[str] = field(default_factory=dict, hash=False)
    qps: Sequence[int | None] = (0, 1, 2, 5, None)
    solver_iterations: Sequence[int | None] = (1, 2, 5, 10, None)
    horizons: Sequence[int | None] = (None,)
    noise_levels: Sequence[float] = (1.0,)
    starts: Sequence[str] = ("candidate",)
    seeds: int | Sequence[int] = 20
    steps: int | None = None
    measure: str = "both"
    deadline: float | None = None
    covariances: bool = False
    cell_timeout: float = 60.0
    folder: str | Path | None = field(default=None, repr=False, compare=False)
    sources: tuple[Source, ...] = field(init=False, repr=False, compare=False)
    makers: Mapping[str, Mapping[str, ModelSource]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, check in _CHECKS.items():
            if name != "backends":
                object.__setattr__(self, name, check(getattr(self, name)))
        if not (self.folder is None or isinstance(self.folder, (str, Path))):
            raise StudyError(
                f"folder is {shown(self.folder)}; expected the name of a folder, or None."
            )
        folder = None if self.folder is None else Path(self.folder)
        models = _distinct(find(text, folder) for text in self.models)
        if self.records and self.noise_levels != (1.0,):
            raise StudyError(
                f"noise_levels is {list(self.noise_levels)}, but the noise of measured records "
                "cannot be scaled; leave either out."
            )
        sources = tuple(Source(model) for model in models) if not self.records else tuple(
            Source.measured(model, str(record), self.reading, folder)
            for model, record in product(models, self.records)
        )
        for source in sources:
            experiment(source)
        # A model's file may register backends of its own.
        assert isinstance(self.estimators, Mapping)
        object.__setattr__(self, "backends", _backends(self.backends))
        taken = self.estimators.keys() & {OBSERVER, *(one.name for one in backends())}
        if taken:
            raise StudyError(
                f"estimators has the name {min(taken)!r}, which is taken by the observer or by a "
                "QP backend; give it another."
            )
        object.__setattr__(self, "sources", sources)
        named = {
            "observers": {one: one for one in self.observers if one != USUAL_OBSERVER},
            "estimators": self.estimators,
        }
        makers = {
            group: {
                name: find(text, folder, group[:-1], KNOWN[group]) for name, text in chosen.items()
            } for group, chosen in named.items()
        }
        object.__setattr__(self, "makers", makers)
        for maker in (one for group in makers.values() for one in group.values()):
            _check_maker(maker, sources)
        object.__setattr__(self, "models", tuple(model.name for model in models))

    @classmethod
    def from_toml(cls, path: str | Path) -> Study:
        """Read a study from the TOML file ``path``, and check it before anything runs.

        Its keys are the parameters of this class, without ``folder``. A `StudyError` names the
        file, the key with its line, and the value that does not fit. The file may name models of
        the catalogue, functions that a Python file in its folder defines, and functions of
        installed modules that are annotated to return a model.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
            found = tomllib.loads(text)
        except OSError as error:
            raise StudyError(f"cannot read the study file {path}: {error.strerror}.") from error
        except UnicodeDecodeError as error:
            raise StudyError(f"the study file {path} is no text in UTF-8 ({error}).") from error
        except tomllib.TOMLDecodeError as error:
            raise StudyError(f"the study file {path} is no valid TOML: {error}.") from error
        for key in found:
            if key not in _CHECKS:
                near = get_close_matches(key, _CHECKS, 1)
                raise StudyError(
                    f"{_place(path, text, key)}: unknown key {key!r}; expected some of "
                    f"{', '.join(_CHECKS)}.{f' Did you mean {near[0]}?' if near else ''}"
                )
        if not found:
            raise StudyError(
                f"the study file {path} is empty; name at least one of {', '.join(_CHECKS)}; "
                "what is left out has its default."
            )
        options = {key: _translated(key, value) for key, value in found.items()}
        data = {key: value for key, value in options.items() if key in _DATA}
        # One by one, so that the error names the line; models first, which may register backends.
        for key in sorted(options, key=lambda key: key not in _DATA):
            value = options[key]
            try:
                if key == "models" or key in _RETURNS:
                    names = _CHECKS[key](value)
                    for name in names.values() if isinstance(names, dict) else names:
                        check_named_in_file(name, path.parent, key[:-1], _RETURNS.get(key, ()))
                alone = {} if key in _DATA else {key: value}
                known = data if key in _DATA or key in ("backends", "estimators") else {}
                cls(**known, **alone, folder=path.parent)
            except InvalidInputError as error:
                words = str(error)
                if key in _DATA and data.keys() & {"records"} and not isinstance(error, ModelError):
                    key = next((one for one in data if words.startswith(one)), "records")
                if key in WORDS:
                    words = words.replace(" None ", f' "{WORDS[key]}" ')
                raise StudyError(f"{_place(path, text, key)}: {words}") from error
        return cls(**options, folder=path.parent)

    def settings(self) -> dict[str, Any]:
        """The grid as plain lists and numbers, as the store keeps it."""
        found = ((name, getattr(self, name)) for name in _CHECKS)
        return {key: list(one) if isinstance(one, tuple) else one for key, one in found}

    def cells(self) -> tuple[Cell, ...]:
        """All cells, each once, seed by seed, so that the first results cover the whole grid."""
        assert self.backends is not None
        assert not isinstance(self.seeds, int)
        made: dict[Cell, None] = {}
        found = {source: experiment(source) for source in self.sources}
        for seed, source, level, horizon, start in product(
            (0,) if self.records else self.seeds, self.sources, self.noise_levels, self.horizons,
            self.starts,
        ):
            usual = found[source]
            steps = usual.steps if self.steps is None else self.steps
            place = (
                usual.horizon if horizon is None else horizon, start, seed,
                min(steps, usual.steps) if self.records else steps, level,
            )
            # The same wherever the sequence would have started.
            without = None, place[0], "candidate", *place[2:]
            for observer, name, qps, cap in product(
                self.observers, self.backends, self.qps, self.solver_iterations
            ):
                if qps == 0:
                    cell = Cell(source.name, OBSERVER, 0, *without, observer)
                else:
                    own = cap if backend(name).iteration_cap else None
                    cell = Cell(source.name, name, qps, own, *place, observer)
                made[cell] = None
            for name in self.estimators:
                made[Cell(source.name, name, 0, *without, "")] = None
        return tuple(made)

    def to_latex(self, store: Store | str | Path) -> str:
        r"""The results of this study as LaTeX tables, one per model and horizon.

        Numbers are means ± standard errors of the means over the seeds,
        :math:`s / \sqrt n`, rounded to two digits of the error. Comments above each table say so,
        and name machine and versions. The tables need the package booktabs.

        Parameters
        ----------
        store : Store, str or Path
            The results.

        Raises
        ------
        StoreError, InvalidInputError
            If the store cannot be read, or has no results of this study.
        """
        from .export import tables

        return tables(store, {cell.key for cell in self.cells()})


def _place(path: Path, text: str, key: str) -> str:
    """File and line of a key, which tomllib does not keep."""
    for number, line in enumerate(text.splitlines(), 1):
        if re.match(rf"""\s*\[*\s*["']?{re.escape(key)}\b""", line):
            return f"{path}, line {number}"
    return str(path)


def _translated(key: str, value: Any) -> Any:
    """A value of a file with None in place of the words."""
    word = WORDS.get(key)
    if word is None:
        return value
    return [None if item == word else item for item in (
        value if isinstance(value, list) else [value]
    )]


def _check_maker(maker: ModelSource, sources: Sequence[Source]) -> None:
    """Raise a `ModelError` if an observer or estimator can be made for none of the models."""
    for source in sources:
        problem = experiment(source).problem
        try:
            observers.made(maker, problem)
            return
        except ModelError as error:
            failed = error
    raise failed


def _distinct(values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(values))


def _listed(value: Any) -> list[Any]:
    """The items of a value; one that has none, such as a number, is the only item."""
    return [value] if isinstance(value, str) or not np.iterable(value) else list(value)


def _several(name: str, value: Any, known: str) -> list[Any]:
    found = _listed(value)
    if not found:
        raise StudyError(f"{name} is empty, and so is the grid; {known}.")
    return found


def _names(option: str, known: str) -> Callable[[Any], tuple[str, ...]]:
    def check(value: Any) -> tuple[str, ...]:
        names = _several(option, value, known)
        for name in names:
            if not isinstance(name, str):
                raise StudyError(f"{option} has {shown(name)}; {known}.")
        return _distinct(names)

    return check


def _backends(value: Any) -> tuple[str, ...]:
    if value is None:
        return tuple(name for name in available() if ":" not in name)
    names = _several("backends", value, f"expected some of {', '.join(available())}")
    for name in names:
        entry = backend(name)
        if not entry.available:
            raise BackendError(
                f"backend {name!r} is not installed; pip install "
                f"{entry.distribution or entry.module}, or use some of {', '.join(available())}."
            )
    return _distinct(names)


def _estimators(value: Any) -> dict[str, str]:
    given = isinstance(value, Mapping)
    items = list(value.items()) if given else [(one, one) for one in _listed(value)]
    for name, text in items:
        if not (isinstance(name, str) and isinstance(text, str) and name.strip()):
            raise StudyError(
                f"estimators has {f'{shown(name)}: ' * given}{shown(text)}; expected some of "
                f"{', '.join(KNOWN['estimators'])}, functions, or a dictionary of these by name."
            )
    return dict(items)


def _numbers(name: str, least: int, nothing: str) -> Callable[[Any], tuple[int | None, ...]]:
    def check(value: Any) -> tuple[int | None, ...]:
        items = [value] if value is None else _several(name, value, "give at least one number")
        return _distinct(
            None if item is None else count(name, item, least, nothing) for item in items
        )

    return check


def _records(value: Any) -> tuple[str, ...]:
    names = value if isinstance(value, (list, tuple)) else [value]
    for name in names:
        if not isinstance(name, (str, Path)):
            raise StudyError(f"records has {shown(name)}; expected the name of a file.")
    return _distinct(str(name) for name in names)


def _reading(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise StudyError(f"reading is {shown(value)}; expected a table of options.")
    for name in value:
        if name not in READING:
            near = get_close_matches(str(name), READING, 1)
            raise StudyError(
                f"reading has the key {shown(name)}; expected some of {', '.join(READING)}."
                f"{f' Did you mean {near[0]}?' if near else ''}"
            )
    return {name: given for name, given in value.items() if given != READING[name]}


def _levels(value: Any) -> tuple[float, ...]:
    items = _several("noise_levels", value, "give at least one number")
    return _distinct(positive("noise_levels", item) for item in items)


def _starts(value: Any) -> tuple[str, ...]:
    items = _several("starts", value, "expected 'candidate' or 'best'")
    return _distinct(choice("starts", item, get_args(Start)) for item in items)


def _seeds(value: Any) -> tuple[int, ...]:
    if isinstance(value, str) or not np.iterable(value):
        return tuple(range(dimension("seeds", value, 1)))
    items = _several("seeds", value, "give a number of seeds, or some of them")
    return _distinct(count("seeds", item, 0) for item in items)


# A record can be read only with its model, and a model may need a record.
_DATA = ("models", "records", "reading")
# The check of each option, in order; each returns the value in its standard form.
_CHECKS: dict[str, Callable[[Any], Any]] = {
    "models": _names("models", "name at least one model"),
    "records": _records,
    "reading": _reading,
    "backends": _backends,
    "observers": _names(
        "observers", f"expected some of {USUAL_OBSERVER}, {', '.join(KNOWN['observers'])}, or "
                     "functions"
    ),
    "estimators": _estimators,
    "qps": _numbers("qps", 0, " None iterates to convergence."),
    "solver_iterations": _numbers("solver_iterations", 1, " None leaves the solver's default."),
    "horizons": _numbers("horizons", 1, " None takes the model's."),
    "noise_levels": _levels,
    "starts": _starts,
    "seeds": _seeds,
    "steps": lambda value: None if value is None else dimension("steps", value, 1),
    "measure": lambda value: choice("measure", value, get_args(Measure)),
    "deadline": lambda value: None if value is None else positive("deadline", value),
    "covariances": lambda value: flag("covariances", value),
    "cell_timeout": lambda value: positive("cell_timeout", value),
}
