"""Weights as covariances, and the TOML file that holds them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from .._checks import Array, checked_path, choice, count, dimension, numbers
from .._linalg import inverse
from .._version import __version__
from ..baselines import Problem
from ..baselines.observers import KNOWN, made
from ..costs import Cost, Huber, ObserverPrior, QuadraticCost, RobustCost
from ..errors import InvalidInputError, ModelError, OptionError, QpmheError
from ..model.system import System, checked_system
from ..models.loading import ModelSource, find
from ..observers import ExtendedKalman, Observer

_FORMAT = 1
KINDS = ("prior", "disturbance", "noise")
#: What may weigh the prior.
ARRIVALS = ("observer", "constant")


class WeightsError(QpmheError):
    """A file of weights that cannot be read or written."""


@dataclass(frozen=True, eq=False)
class Weights:
    """Covariances, and the other settings of a cost and an observer.

    Parameters
    ----------
    prior, disturbance, noise : (n, n), (r, r) and (p, p) array
        Covariances of the initial error, of w and of v, in squared units.
    horizon : int
        N.
    discount : float
        As for `qpmhe.QuadraticCost`.
    threshold : float or None
        Threshold of Huber's loss of the noise, in standard deviations; None for a quadratic loss.
    arrival : {"observer", "constant"}
        What weighs the prior: the observer's own covariance, or the one of the initial error.
    parameters : dict
        Parameters of the model, by name.
    observer_name : str, optional
        The observer, named as for `qpmhe.tune`; an extended Kalman filter if left out.
    max_qps : int, optional
        QPs per sample with which the weights were chosen, where `qpmhe.tune` compared them.
    """

    prior: Array
    disturbance: Array
    noise: Array
    horizon: int = 10
    discount: float = 1.0
    threshold: float | None = None
    arrival: str = "observer"
    parameters: dict[str, float] = field(default_factory=dict)
    observer_name: str | None = None
    max_qps: int | None = None

    @property
    def key(self) -> tuple[Any, ...]:
        """What is the same for equal weights alone."""
        return tuple(
            one.tobytes() if isinstance(one, np.ndarray)
            else tuple(one.items()) if isinstance(one, dict) else one
            for one in vars(self).values()
        )

    def observer(
        self, kind: Callable[..., Observer] | None = None, *, system: System | None = None
    ) -> Observer:
        """The observer that was chosen, or kind(prior=..., disturbance=..., noise=...).

        Parameters
        ----------
        kind : callable, optional
            `qpmhe.ExtendedKalman` if neither it nor ``observer_name`` is given.
        system : System, optional
            The model, for which an observer with a name is made. A function of the user gets it in
            a `qpmhe.baselines.Problem` with an initial state of 0 and without parameters.

        Raises
        ------
        OptionError, ModelError, ShapeError
            If the system is needed and not given, or does not fit; if the observer cannot be made.
        """
        if kind is None and self.observer_name is not None:
            if system is None:
                raise OptionError(
                    f"the weights are of the observer {self.observer_name!r}, which is made for a "
                    "system; give observer(system=system), or another kind."
                )
            problem = self.problem(system, np.zeros(checked_system(system).n))
            chosen: Observer = made(find_observer(self.observer_name), problem)
            return chosen
        return (kind or ExtendedKalman)(
            prior=self.prior, disturbance=self.disturbance, noise=self.noise)

    def problem(self, system: System, initial_state: Array, **options: Any) -> Problem:
        """The problem of estimating with these covariances."""
        return Problem(
            system, initial_state=initial_state, prior=self.prior, disturbance=self.disturbance,
            noise=self.noise, **options,
        )

    def cost(self) -> Cost:
        """The cost: quadratic, or with Huber's loss of the noise where there is a threshold."""
        constant = self.arrival == "constant"
        if self.threshold is None:
            return QuadraticCost.from_covariances(
                prior=self.prior if constant else None, disturbance=self.disturbance,
                noise=self.noise, discount=self.discount,
            )
        return RobustCost(
            prior=inverse(self.prior) if constant else None,
            disturbance=inverse(self.disturbance),
            noise=Huber(inverse(self.noise), threshold=self.threshold), discount=self.discount,
        )

    def save(self, path: str | Path, comment: str = "") -> Path:
        """Write a TOML file, which `load` and ``qpmhe estimate --weights`` read.

        Parameters
        ----------
        path : str or Path
            The file; one that exists is replaced.
        comment : str
            Text for the top of the file.
        """
        target = checked_path("the file of weights", path)
        lines = [f"# {line}".rstrip() for line in comment.splitlines()]
        lines += [
            f"format = {_FORMAT}", f'version = "{__version__}"', f"horizon = {self.horizon}",
            f"discount = {float(self.discount)!r}", f'arrival = "{self.arrival}"',
        ]
        if self.observer_name is not None:
            lines.append(f"observer_name = {json.dumps(self.observer_name)}")
        if self.max_qps is not None:
            lines.append(f"max_qps = {self.max_qps}")
        if self.threshold is not None:
            lines.append(f"threshold = {float(self.threshold)!r}")
        lines += ["", "# In squared units, one row per line.", "[covariances]"]
        for kind in KINDS:
            rows = ",\n".join(f"  {row}" for row in getattr(self, kind).tolist())
            lines.append(f"{kind} = [\n{rows},\n]")
        if self.parameters:
            lines += ["", "[parameters]"]
            lines += [f'"{name}" = {float(value)!r}' for name, value in self.parameters.items()]
        try:
            target.write_text("\n".join(lines) + "\n", encoding="utf-8")
        except OSError as error:
            raise WeightsError(f"cannot write {target}: {error.strerror or error}.") from error
        return target


def load(path: str | Path) -> Weights:
    """Read the weights that `Tuning.save` wrote.

    Parameters
    ----------
    path : str or Path
        The TOML file; a function that makes a model may name it relative to its own file.

    Returns
    -------
    Weights
        With ``cost()`` and ``observer()``, ready for `qpmhe.MovingHorizonEstimator`.

    Raises
    ------
    WeightsError
        If the file is missing, or is not such a file.
    """
    target = checked_path("the file of weights", path)
    try:
        content = tomllib.loads(target.read_text(encoding="utf-8"))
    except OSError as error:
        raise WeightsError(
            f"cannot read the weights {target} ({error.strerror or error}); make them with qpmhe "
            "tune, or Tuning.save."
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise WeightsError(
            f"{target} is no TOML file ({error}); save the weights again."
        ) from error
    try:
        if content.pop("format") != _FORMAT:
            raise ValueError(f"its format is not {_FORMAT}")
        content.pop("version", None)
        given = content.pop("covariances")
        content |= {kind: np.atleast_2d(numbers(kind, given[kind])) for kind in KINDS}
        unknown = sorted(set(content) - {one.name for one in fields(Weights)})
        if unknown:
            raise ValueError(f"it has {', '.join(map(repr, unknown))}, which weights do not have")
        found = Weights(**content)
        dimension("horizon", found.horizon, 1)
        choice("arrival", found.arrival, ARRIVALS)
        if found.max_qps is not None:
            count("max_qps", found.max_qps, 0)
        found.cost()
        found.observer(ExtendedKalman)
        if found.observer_name is not None:
            find_observer(found.observer_name)
    except (KeyError, TypeError, ValueError, InvalidInputError, ModelError) as error:
        raise WeightsError(
            f"{target} holds no weights of qpmhe ({_reason(error)}); save them again."
        ) from error
    return found


def find_observer(name: str) -> ModelSource:
    """Where an observer of this name comes from, as in studies."""
    return find(name, kind="observer", known=KNOWN)


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"{error} is missing"
    return str(error).rstrip(".")


def covariances_of(observer: Observer, cost: Cost) -> dict[str, Any]:
    """The covariances that the weights of a cost stand for, to start from."""
    first = observer.initial_covariance()
    if not isinstance(cost.prior, ObserverPrior):
        first = inverse(cost.prior)
    if first is None:
        raise InvalidInputError(
            f"{type(observer).__name__} has no covariance and the cost no prior weight to start "
            "from; let the model return a cost with one."
        )
    disturbance = inverse(cost.disturbance)
    if cost.disturbance_factor is not None:
        disturbance = cost.disturbance_factor @ disturbance @ cost.disturbance_factor.T
    return {"prior": first, "disturbance": disturbance, "noise": inverse(cost.noise)}
