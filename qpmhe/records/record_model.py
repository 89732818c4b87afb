"""The user's model as an estimator, and the samples at which the model itself failed."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._checks import Array
from ..errors import ModelError, OptionError, QpmheError
from ..estimation.estimate import Estimate, Status
from ..estimation.estimator import MovingHorizonEstimator
from ..model.functions import EvaluationError
from ..model.system import System
from ..models import Scenario
from ..models.loading import build, check_parts, code_place, find

_SIZES = {"states": "n", "outputs": "p", "inputs": "m"}
_EXPECTED = (
    "expected (system, observer, cost), optionally followed by a scenario or a dict of options; "
    "or a MovingHorizonEstimator"
)
# A mistake in the code raises these, a state at which the model has no value does not.
_MISTAKES = (TypeError, NameError, AttributeError, ImportError)
# The model is evaluated again only so often: it may be slow.
_ATTEMPTS = 10


@dataclass(frozen=True, eq=False)
class RecordModel:
    """An estimator, the names of its signals, its usual step, and what identifies it."""

    estimator: MovingHorizonEstimator
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float | None
    identity: dict[str, Any]
    file: Path | None


def load_record_model(text: str, **options: Any) -> RecordModel:
    """Make the estimator of a model from its name; `options` replace the model's own."""
    source = find(text)
    name = source.name
    parts, given = _parts(name, build(source))
    signals = {kind: given.pop(kind, None) for kind in _SIZES}
    dt = given.pop("dt", None)
    chosen = given | options
    for key in ("horizon", "initial_state"):
        if key not in chosen:
            raise OptionError(
                f"model {name!r} does not give its {key} (its options: "
                f"{', '.join(map(repr, given)) or 'none'}); give --{key.replace('_', '-')}, or let "
                f"the function return (system, observer, cost, {{{key!r}: ...}})."
            )
    try:
        estimator = MovingHorizonEstimator(*parts, **chosen)
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
        **{
            key: value.item() if hasattr(value, "item") else value
            for key, value in vars(estimator.settings).items()
        },
    }
    names = {
        kind: _names(name, kind, signals[kind], getattr(estimator.system, size))
        for kind, size in _SIZES.items()
    }
    return RecordModel(estimator, **names, dt=dt, identity=identity, file=source.file)


def _parts(name: str, made: Any) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """System, observer and cost, and the model's own options."""
    if isinstance(made, MovingHorizonEstimator):
        options = {**vars(made.settings), "initial_state": made.initial_state}
        return (made.system, made.observer, made.cost), options
    if not isinstance(made, (tuple, list)) or not 3 <= len(made) <= 5:
        shape = f" of {len(made)}" if isinstance(made, (tuple, list)) else ""
        raise ModelError(f"model {name!r} gave a {type(made).__name__}{shape}; {_EXPECTED}.")
    check_parts(name, made[:3], f" In all, {_EXPECTED}.")
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
            raise ModelError(
                f"model {name!r} gave a {type(extra).__name__} after its cost; "
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


class ModelFailures:
    """Counts steps with MODEL_FAILED (`failed`), and others with FAILED_STAGE (`stale`).

    `is_mistake` says that the model's code is wrong, rather than undefined at some states;
    `place` is where the first failure lies in the record, which the caller fills in.
    """

    def __init__(self, system: System, horizon: int, file: Path | None = None) -> None:
        self.failed = self.stale = 0
        self.is_mistake, self.place = False, ""
        self._why = self._then = ""
        self._system, self._file = system, file
        self._inputs: deque[tuple[Array, float | None]] = deque(maxlen=horizon)
        self._attempts = 0

    def note(self, estimate: Estimate, u: Array, length: float | None) -> bool:
        """Count a step with input u and unusual length; whether it is the first failure."""
        self._inputs.append((u, length))
        if Status.MODEL_FAILED not in estimate.status:
            self.stale += Status.FAILED_STAGE in estimate.status
            return False
        self.failed += 1
        if not self._why and self._attempts < _ATTEMPTS:
            self._attempts += 1
            self._why = self._evaluate_again(estimate)
            self._then = self._then or estimate.message
        return self.failed == 1

    def _evaluate_again(self, estimate: Estimate) -> str:
        """What the model does at the states of a step; blank if nothing is wrong any more."""
        for trajectory in (estimate.candidate, estimate.trajectory):
            # Most failures arise at the newest states.
            for x, (u, length) in zip(trajectory[-2::-1], reversed(self._inputs), strict=False):
                system = self._system
                if length is not None:
                    system, u = system.timed, np.append(u, length)
                for name, function, shape in (
                    ("f", system.f, (system.n,)),
                    ("h", system.h, (system.p,)),
                    ("the Jacobian of f", system.f_jacobian, (system.n, system.n)),
                    ("the Jacobian of h", system.h_jacobian, (system.p, system.n)),
                ):
                    at = f"at x = {np.array2string(x, precision=6, separator=', ')}"
                    try:
                        with np.errstate(all="ignore"):
                            value = np.asarray(function(x.copy(), u.copy()), dtype=np.float64)
                    except EvaluationError as error:
                        self.is_mistake = error.__cause__ is None  # a wrong shape or type
                        return f"{error} {at}"
                    except Exception as error:  # a user's function may raise anything
                        self.is_mistake = isinstance(error, _MISTAKES)
                        place = code_place(error, self._file)
                        return f"{place}{name} raised {type(error).__name__}: {error} {at}"
                    if value.shape != shape:
                        self.is_mistake = True
                        return f"{name} returned shape {value.shape}; expected {shape} {at}"
                    if not np.isfinite(value).all():
                        return f"{name} is {value.tolist()} {at}"
        return ""

    def report(self, samples: int) -> str:
        """All failures among so many samples in a few sentences; blank if there are none."""
        if not self.failed:
            return ""
        text = f"the model failed at {self.failed} of {samples} samples (MODEL_FAILED)"
        if self.stale:
            text += f", which affects the windows of {self.stale} more (FAILED_STAGE)"
        return f"{text}, first at {self.reason}"

    @property
    def reason(self) -> str:
        """Where the model failed first, why, and what to do."""
        then = f"{self._then.rstrip('.')}; " if self._then else ""
        why = self._why or f"{then}evaluated again, it has values there; is it random?"
        remedy = (
            "Correct the model." if self.is_mistake
            else "Bound the states, or make the model defined on all of them."
        )
        return f"{self.place}: {why}. {remedy}"
