"""The grid of a study: which models, backends, caps, horizons and seeds are compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from qpmhe_solvers import available, backend
from qpmhe_solvers.errors import tell_unknown_options

from .._checks import count, positive
from ..errors import BackendError
from ..settings import Start
from .cell import OBSERVER, Cell
from .errors import StudyError
from .sources import Source, find, load

__all__ = ["Measure", "Study"]

Measure = Literal["both", "accuracy", "time"]


@tell_unknown_options
@dataclass(frozen=True)
class Study:
    """A grid of estimators, each run on records of many seeds.

    Cells that would be the same are one: with ``qps=0`` no QP is solved, so that there is one
    cell, whose backend is called ``observer``; a backend without a cap has one cell for all
    ``solver_iterations``.

    Parameters
    ----------
    models : sequence of str
        Names of the catalogue, with keyword arguments where wanted
        (``chain_of_masses(masses=2)``), or functions that return system, observer, cost and
        scenario: ``package.module:function`` or ``path/file.py:function``.
    backends : sequence of str, optional
        QP backends; if left out, all that are installed, without the generic forms
        (``qpsolvers:...``) of those that have one of their own.
    qps : sequence of int or None
        QPs per sample, the paper's i; None goes on to convergence, 0 is the observer.
    solver_iterations : sequence of int or None
        Caps on the solver's own iterations in each QP; None leaves the solver's default.
    horizons : sequence of int or None
        N; None takes that of the model's scenario.
    starts : sequence of {"candidate", "best"}
        Where the sequences of QPs start.
    seeds : int or sequence of int
        Seeds of the records; a number k stands for 0, ..., k-1.
    steps : int, optional
        Samples of a record; those of the model's scenario if left out.
    measure : {"both", "accuracy", "time"}
        What is recorded. With "time" one cell runs at a time, unless more jobs are asked for.
    deadline : float, optional
        Seconds; the share of steps that take longer is told.
    covariances : bool
        Whether covariances are computed, and errors judged by them (NEES).
    cell_timeout : float
        Seconds for one cell.

    Raises
    ------
    StudyError, OptionError, BackendError
        If the grid is empty, or a value is unknown, out of range or not installed.

    Examples
    --------
    >>> from qpmhe.studies import Study
    >>> study = Study(backends=["banded"], qps=[0, 1], seeds=3)
    >>> study.cells()[0].key
    'batch_reactor/observer/i=0/cap=none/N=10/candidate/T=150/seed=0'
    """

    models: Sequence[str] = ("batch_reactor",)
    backends: Sequence[str] | None = None
    qps: Sequence[int | None] = (0, 1, 2, 5, None)
    solver_iterations: Sequence[int | None] = (1, 2, 5, 10, None)
    horizons: Sequence[int | None] = (None,)
    starts: Sequence[str] = ("candidate",)
    seeds: int | Sequence[int] = 20
    steps: int | None = None
    measure: str = "both"
    deadline: float | None = None
    covariances: bool = False
    cell_timeout: float = 60.0
    sources: tuple[Source, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._prepare(None)

    def _prepare(self, folder: Path | None) -> None:
        for name, check in CHECKS.items():
            object.__setattr__(self, name, check(getattr(self, name)))
        sources = _distinct(find(text, folder) for text in self.models)
        for source in sources:
            load(source)
        object.__setattr__(self, "sources", sources)
        object.__setattr__(self, "models", tuple(source.name for source in sources))

    @classmethod
    def from_toml(cls, path: str | Path) -> Study:
        """Read a study from a file; see `qpmhe.studies.study_file`.

        Parameters
        ----------
        path : str or Path
            A TOML file whose keys are the parameters of this class.

        Raises
        ------
        StudyError
            If it cannot be read, has an unknown key or a value that does not fit; the text
            has the line.
        """
        from .study_file import read

        return read(Path(path))

    @classmethod
    def within(cls, folder: Path, **options: Any) -> Study:
        """A study whose files are relative to a folder.

        Parameters
        ----------
        folder : Path
            What the paths of models are relative to.
        **options
            The parameters of the class.
        """
        study = object.__new__(cls)
        known = {item.name: item.default for item in fields(cls) if item.init}
        for name, value in {**known, **options}.items():
            object.__setattr__(study, name, value)
        study._prepare(folder)
        return study

    def settings(self) -> dict[str, Any]:
        """The grid as plain lists and numbers; what the store keeps of it."""
        found = {name: getattr(self, name) for name in CHECKS}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in found.items()
        }

    def cells(self) -> tuple[Cell, ...]:
        """All cells, each once, seed by seed: what is there early covers the whole grid."""
        assert self.backends is not None
        assert not isinstance(self.seeds, int)
        made: dict[Cell, None] = {}
        scenarios = {source: load(source).scenario for source in self.sources}
        for seed, source, horizon, start in product(
            self.seeds, self.sources, self.horizons, self.starts
        ):
            scenario = scenarios[source]
            place = (
                scenario.horizon if horizon is None else horizon, start, seed,
                scenario.steps if self.steps is None else self.steps,
            )
            for name, qps, cap in product(self.backends, self.qps, self.solver_iterations):
                if qps == 0:
                    # The observer is the same wherever the sequence would have started.
                    cell = Cell(source.name, OBSERVER, 0, None, place[0], "candidate", *place[2:])
                else:
                    own = cap if backend(name).iteration_cap else None
                    cell = Cell(source.name, name, qps, own, *place)
                made[cell] = None
        return tuple(made)

    def source(self, cell: Cell) -> Source:
        """Where a cell's model comes from.

        Parameters
        ----------
        cell : Cell
            One of this study.
        """
        return next(source for source in self.sources if source.name == cell.model)


def _distinct(values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(values))


def _several(name: str, value: Any, known: str) -> list[Any]:
    if isinstance(value, str) or not isinstance(value, Iterable):
        value = [value]
    found = list(value)
    if not found:
        raise StudyError(f"{name} is empty, and so is the grid; {known}.")
    return found


def _models(value: Any) -> tuple[str, ...]:
    return _distinct(_several("models", value, "name at least one model"))


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


def _numbers(name: str, least: int, nothing: str) -> Callable[[Any], tuple[int | None, ...]]:
    def check(value: Any) -> tuple[int | None, ...]:
        items = [value] if value is None else _several(name, value, "give at least one number")
        return _distinct(
            None if item is None else count(name, item, least, nothing) for item in items
        )

    return check


def _starts(value: Any) -> tuple[str, ...]:
    items = _several("starts", value, "expected 'candidate' or 'best'")
    for item in items:
        _one_of("starts", item, get_args(Start))
    return _distinct(items)


def _seeds(value: Any) -> tuple[int, ...]:
    if isinstance(value, Iterable) and not isinstance(value, str):
        items = _several("seeds", value, "give a number of seeds, or some of them")
        return _distinct(count("seeds", item, 0) for item in items)
    return tuple(range(count("seeds", value, 1)))


def _one_of(name: str, value: Any, known: Sequence[str]) -> str:
    if value not in known:
        raise StudyError(
            f"{name} is {value!r}; expected one of {', '.join(repr(item) for item in known)}."
        )
    return str(value)


def _switch(value: Any) -> bool:
    if not isinstance(value, bool):
        raise StudyError(f"covariances is {value!r}; expected True or False.")
    return value


#: The check of each option, in order; each gives the value in its standard form.
CHECKS: dict[str, Callable[[Any], Any]] = {
    "models": _models,
    "backends": _backends,
    "qps": _numbers("qps", 0, " None stands for convergence."),
    "solver_iterations": _numbers("solver_iterations", 1, " None leaves the solver's default."),
    "horizons": _numbers("horizons", 1, " None takes the model's."),
    "starts": _starts,
    "seeds": _seeds,
    "steps": lambda value: None if value is None else count("steps", value, 1),
    "measure": lambda value: _one_of("measure", value, get_args(Measure)),
    "deadline": lambda value: None if value is None else positive("deadline", value),
    "covariances": _switch,
    "cell_timeout": lambda value: positive("cell_timeout", value),
}
