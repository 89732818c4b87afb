"""The user's model as an estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import ModelError, OptionError, QpmheError
from ..estimation.estimator import MovingHorizonEstimator
from ..model.system import System
from ..models import Scenario
from ..models.loading import ModelSource, build, check_parts, code_place, find

_SIZES = {"states": "n", "outputs": "p", "inputs": "m"}
_EXPECTED = (
    "expected (system, observer, cost), optionally followed by a scenario or a dict of options; "
    "or a MovingHorizonEstimator"
)


@dataclass(frozen=True, eq=False)
class RecordModel:
    """An estimator, its signals' names, its usual step and the unit, and what identifies it."""

    estimator: MovingHorizonEstimator
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float | None
    identity: dict[str, Any]
    time_unit: str = "s"
    scenario: Scenario | None = None


def load_record_model(
    model: str | ModelSource, engine_at_work: str | None = None, **options: Any
) -> RecordModel:
    """Make the estimator of a model from its name; `options` replace the model's own.

    Among them are ``observer`` and ``cost``.
    ``engine="auto"`` takes the engine `engine_at_work` of an earlier run, if there is one.
    """
    source = model if isinstance(model, ModelSource) else find(model)
    name = source.name
    parts, given = model_parts(name, build(source))
    scenario = given.pop("scenario", None)
    signals = {kind: given.pop(kind, None) for kind in _SIZES}
    dt, unit = given.pop("dt", None), str(given.pop("time_unit", "s"))
    chosen = given | options
    parts = (parts[0], chosen.pop("observer", parts[1]), chosen.pop("cost", parts[2]))
    for key in ("horizon", "initial_state"):
        if key not in chosen:
            raise OptionError(
                f"model {name!r} does not give its {key} (its options: "
                f"{', '.join(map(repr, given)) or 'none'}); give --{key.replace('_', '-')}, or let "
                f"the function return (system, observer, cost, {{{key!r}: ...}})."
            )
    try:
        estimator = MovingHorizonEstimator(*parts, **chosen)
        is_free = estimator.settings.engine == "auto"
        if is_free and engine_at_work not in (None, estimator.engine):
            estimator = MovingHorizonEstimator(*parts, **chosen | {"engine": engine_at_work})
    except QpmheError as error:
        place = code_place(error, source.file)
        kind = OptionError if isinstance(error, OptionError) else ModelError
        raise kind(f"{place}model {name!r} makes no estimator: {error}") from error
    identity = {
        # A file may be moved; its fingerprint identifies it.
        "model": source.where.rpartition(":")[2] if source.is_file else source.where,
        "arguments": source.arguments,
        "file": source.fingerprint,
        "engine at work": estimator.engine,
        "initial_state": estimator.initial_state.tolist(),
        **vars(estimator.settings), **({"engine": "auto"} if is_free else {}),
        "parameters": list(estimator.settings.parameters),  # as JSON has them
    }
    system = estimator.system
    sizes = {"states": system.n, "outputs": system.p, "inputs": estimator.inputs}
    names = {kind: _names(name, kind, signals[kind], size) for kind, size in sizes.items()}
    return RecordModel(
        estimator, **names, dt=dt, identity=identity, time_unit=unit, scenario=scenario
    )


def load_system(source: ModelSource) -> System:
    """The system of a model alone."""
    system: System = model_parts(source.name, build(source))[0][0]
    return system


def model_parts(name: str, made: Any) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """System, observer and cost, and the model's own options."""
    if isinstance(made, MovingHorizonEstimator):
        options = {**vars(made.settings), "initial_state": made.initial_state}
        return (made.system, made.observer, made.cost), options
    if not isinstance(made, (tuple, list)) or not 3 <= len(made) <= 5:
        shape = f" of {len(made)}" if isinstance(made, (tuple, list)) else ""
        raise ModelError(f"model {name!r} returned a {type(made).__name__}{shape}; {_EXPECTED}.")
    check_parts(name, made[:3], f" In all, {_EXPECTED}.")
    options = {}
    for extra in made[3:]:
        if isinstance(extra, Scenario):
            options |= {
                "horizon": extra.horizon, "initial_state": extra.initial_estimate,
                "states": extra.labels, "dt": extra.dt, "time_unit": extra.time_unit,
                "scenario": extra,
            }
        elif isinstance(extra, Mapping):
            options |= {str(key): value for key, value in extra.items()}
        else:
            raise ModelError(
                f"model {name!r} returned a {type(extra).__name__} after its cost; "
                "expected a qpmhe.models.Scenario or a dict of options."
            )
    return tuple(made[:3]), options


def _names(model: str, kind: str, names: Any, size: int) -> tuple[str, ...]:
    if names is None:
        letter = {"states": "x", "outputs": "y", "inputs": "u"}[kind]
        return tuple(f"{letter}{i + 1}" for i in range(size))
    given = tuple(str(one).strip() for one in ((names,) if isinstance(names, str) else names))
    if len(given) != size or len(set(given)) != size or not all(given):
        raise OptionError(
            f"model {model!r} names its {kind} {list(given)}; expected {size} different names "
            f"({_SIZES[kind]} = {size})."
        )
    return given
