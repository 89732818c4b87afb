"""The user's model as an estimator, with the names of its signals."""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..costs import Cost
from ..errors import OptionError, QpmheError
from ..estimator import MovingHorizonEstimator
from ..models import Scenario
from ..observers import Observer
from ..studies.errors import StudyError
from ..studies.sources import Source, _arguments, _function, find
from ..system import System
from .places import place

__all__ = ["RecordModel", "load_model"]

_PARTS = ((System, "system"), (Observer, "observer"), (Cost, "cost"))
_NAMES = {"states": "n", "outputs": "p", "inputs": "m"}
_OPTIONS = tuple(
    name
    for name, parameter in inspect.signature(MovingHorizonEstimator).parameters.items()
    if parameter.kind is parameter.KEYWORD_ONLY
)
_EXPECTED = (
    "expected (system, observer, cost), and behind it, if you like, a scenario or a dict of "
    "options; or a MovingHorizonEstimator"
)


@dataclass(frozen=True, eq=False)
class RecordModel:
    """An estimator, and what its signals are called.

    Parameters
    ----------
    estimator : MovingHorizonEstimator
        Before its first measurement.
    states, outputs, inputs : tuple of str
        Names of x, y and u.
    dt : float or None
        Usual step, if the model tells.
    identity : dict
        What a checkpoint must have been made with.
    file : Path or None
        Where the model is written down; None for one of the catalogue.
    """

    estimator: MovingHorizonEstimator
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float | None
    identity: dict[str, Any]
    file: Path | None


def load_model(text: str, **options: Any) -> RecordModel:
    """Make the estimator of a model.

    Parameters
    ----------
    text : str
        Name of the catalogue, ``package.module:function`` or ``path/file.py:function``, with
        arguments of the function in brackets if there are any.
    **options
        Options of `MovingHorizonEstimator` that replace the model's own.

    Raises
    ------
    StudyError
        If the model cannot be imported or made, or is of another form; the text names the
        file's line.
    OptionError
        If an option is missing or unknown.
    """
    source = find(text)
    with _neighbours(source):
        return _loaded(source, options)


def _loaded(source: Source, options: dict[str, Any]) -> RecordModel:
    name = source.name
    parts, given = _parts(source)
    file = _file(source)
    names = {kind: given.pop(kind, None) for kind in _NAMES}
    dt = given.pop("dt", None)
    for key in given:
        if key not in _OPTIONS:
            raise OptionError(
                f"model {name!r} gave the option {key!r}; expected {', '.join(_OPTIONS)}, dt, "
                "or names of states, outputs and inputs."
            )
    chosen = given | options
    for key in ("horizon", "initial_state"):
        if key not in chosen:
            raise OptionError(
                f"model {name!r} does not tell its {key}; give --{key.replace('_', '-')}, or let "
                f"the function return (system, observer, cost, {{{key!r}: ...}})."
            )
    try:
        estimator = MovingHorizonEstimator(*parts, **chosen)
    except QpmheError as error:
        raise StudyError(
            f"{place(error, file)}model {name!r} makes no estimator: {error}"
        ) from error
    system = estimator.system
    return RecordModel(
        estimator,
        _named(name, "states", names["states"], "x", system.n),
        _named(name, "outputs", names["outputs"], "y", system.p),
        _named(name, "inputs", names["inputs"], "u", system.m),
        dt,
        {
            # A file may be moved; its digest tells it.
            "model": source.where.rpartition(":")[2] if _is_file(source) else source.where,
            "arguments": source.arguments,
            "file": source.fingerprint,
            "engine at work": estimator.engine,
            "initial_state": estimator.initial_state.tolist(),
            **{key: _plain(value) for key, value in vars(estimator.settings).items()},
        },
        file,
    )


@contextlib.contextmanager
def _neighbours(source: Source) -> Iterator[None]:
    """Let a file import those beside it, as it can when Python runs it."""
    if not _is_file(source):
        yield
        return
    folder = str(Path(source.where.rpartition(":")[0]).parent)
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # the model may have put the path in order
            sys.path.remove(folder)


def _is_file(source: Source) -> bool:
    return source.where.rpartition(":")[0].endswith(".py")


def _file(source: Source) -> Path | None:
    """Where a model is written down, as far as it is known; None for the catalogue."""
    module = source.where.rpartition(":")[0]
    if _is_file(source):
        return Path(module)
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file else None


def _parts(source: Source) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """System, observer and cost, and the model's own options."""
    made = _made(source)
    if isinstance(made, MovingHorizonEstimator):
        options = {**vars(made.settings), "initial_state": made.initial_state}
        return (made.system, made.observer, made.cost), options
    if not isinstance(made, (tuple, list)) or not 3 <= len(made) <= 5:
        shape = f" of {len(made)}" if isinstance(made, (tuple, list)) else ""
        raise StudyError(
            f"model {source.name!r} gave a {type(made).__name__}{shape}; {_EXPECTED}."
        )
    for part, (kind, what) in zip(made, _PARTS, strict=False):
        if not isinstance(part, kind):
            raise StudyError(
                f"model {source.name!r} gave a {type(part).__name__} for its {what}; expected "
                f"qpmhe's {kind.__name__}. In all, {_EXPECTED}."
            )
    options = {}
    for extra in made[3:]:
        if isinstance(extra, Scenario):
            options |= {
                "horizon": extra.horizon, "initial_state": extra.initial_estimate,
                "states": extra.labels, "dt": extra.dt,
            }
        elif isinstance(extra, Mapping):
            options |= {str(key): value for key, value in extra.items()}
        else:
            raise StudyError(
                f"model {source.name!r} gave a {type(extra).__name__} behind its cost; "
                "expected a qpmhe.models.Scenario or a dict of options."
            )
    return tuple(made[:3]), options


def _made(source: Source) -> Any:
    try:
        return _function(source.name, source.where)(**_arguments(source.name, source.arguments))
    except StudyError as error:
        if error.__cause__ is None:
            raise
        raise StudyError(
            f"{place(error.__cause__, _file(source))}{error}"
        ) from error.__cause__
    except SystemExit as error:
        raise StudyError(
            f"{place(error, _file(source))}model {source.name!r} ends the program; put what is not "
            "the model behind if __name__ == '__main__'."
        ) from error
    except Exception as error:
        kind = "" if isinstance(error, QpmheError) else f"{type(error).__name__}: "
        said = str(error).rstrip(".")
        raise StudyError(
            f"{place(error, _file(source))}model {source.name!r} cannot be made: {kind}{said}."
        ) from error


def _named(model: str, kind: str, names: Any, letter: str, size: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{letter}{i + 1}" for i in range(size))
    if isinstance(names, str):
        names = (names,)
    given = tuple(str(one).strip() for one in names)
    if len(given) != size or len(set(given)) != size or not all(given):
        raise OptionError(
            f"model {model!r} names its {kind} {list(given)}; expected {size} different names "
            f"({_NAMES[kind]} = {size})."
        )
    return given


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value
