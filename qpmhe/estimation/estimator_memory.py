"""What an estimator remembers, as its user reads, saves and restores it."""

from __future__ import annotations

import pickle
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qpmhe_solvers import Solver

from .._checks import vector
from ..costs import Cost
from ..errors import InvalidInputError
from ..memory.snapshot import read, written
from ..model.constraints import ConstraintFunctions
from ..model.system import System
from ..observers import Observer
from ..terms.hold import WindowHold
from .conditions import Conditions
from .engines import Engine, engine_of_snapshot
from .problem import Solved
from .sample_arguments import SampleArguments
from .settings import Settings
from .start import check_start, inside

if TYPE_CHECKING:
    from ..sensitivity import Sensitivity

Array = NDArray[np.float64]
Estimator = TypeVar("Estimator", bound="EstimatorMemory")


class EstimatorMemory:
    """The part of an estimator that takes no samples: see `MovingHorizonEstimator`."""

    #: Differentiates a solved problem; `qpmhe.sensitivity`, which stands on this room, has it.
    differentiate: ClassVar[type[Sensitivity]]

    system: System
    observer: Observer
    cost: Cost
    settings: Settings
    _engine: Engine
    _initial_state: Array
    _labels: list[str] | None
    _first_state: Array
    _arguments: SampleArguments
    _own_system: System

    def _checked_start(
        self, initial_state: ArrayLike, system: System
    ) -> tuple[Array, System]:
        state = vector("initial_state", initial_state, system.n)
        return check_start(
            system, self.observer, self.cost, state, u=self._arguments.usual_input,
            metric=self.settings.projection_metric,
        )

    def reset(self, initial_state: ArrayLike | None = None) -> None:
        """Forget all measurements and restart.

        Parameters
        ----------
        initial_state : (n,) array_like, optional
            A new initial estimate; the former one if left out. Both are projected onto the X that
            `set` has left.

        Raises
        ------
        InvalidInputError
            If the state is invalid; the estimator stays unchanged.
        """
        before, state, system = self._initial_state, self._initial_state, None
        if initial_state is not None:
            state, system = self._checked_start(initial_state, self._engine.system)
        try:
            self._initial_state = state
            # X may be another one than that in which the former state is.
            metric = self.settings.projection_metric
            start, _ = inside(self._engine.system, self.observer, self.cost, state, metric)
            self._engine.reset(start, system)
        except BaseException:
            self._initial_state = before
            raise

    @property
    def initial_state(self) -> Array:
        """The initial estimate, a copy."""
        return self._initial_state.copy()

    @property
    def state(self) -> Array:
        """The current estimate of x(t+1), or the initial one before the first measurement."""
        return self._engine.state

    @property
    def observer_state(self) -> Array:
        """z(t+1), the state from which the observer continues; at first the initial state."""
        return self._engine.observer_state

    @property
    def engine(self) -> str:
        """The engine in use, ``python`` or ``compiled``, also with ``engine="auto"``."""
        return self._engine.name

    @property
    def time(self) -> int:
        """Number of measurements taken so far."""
        return self._engine.time

    @property
    def horizon(self) -> int:
        """The horizon N."""
        return self.settings.horizon

    @property
    def inputs(self) -> int:
        """Number of inputs in the ``u`` of `update`: the system's inputs without the parameters."""
        return self._arguments.inputs

    @property
    def scaled_constraints(self) -> ConstraintFunctions | None:
        """The nonlinear constraints, traced and in the units that they had at construction."""
        return self._own_system.constraints

    @property
    def has_changed(self) -> bool:
        """Whether `set` has changed weights or bounds from those of ``cost`` and ``system``."""
        usual = self._engine.usual
        weights = usual.noise_weight, usual.disturbance_weight
        return usual.has_bounds or any(one is not None for one in weights)

    @property
    def usual(self) -> Conditions:
        """What `set` has changed, and the parameters."""
        return self._engine.usual

    @property
    def hold(self) -> WindowHold | None:
        """How the last step held parameters, see `augment_parameters`.

        None where nothing is held: without ``hold``, without QPs, or before the first measurement.
        """
        if not (self.system.held and self.time):
            return None
        return self._engine.solved().problem.hold

    def covariances(self) -> Array:
        """Covariances of the last estimate's trajectory, by linearisation along it.

        The inverse of the Gauss-Newton Hessian's diagonal blocks, computed in O(N n^3):
        with inverse covariances as weights, the covariance of the error of each state given
        the window's measurements and the prior. Inequalities do not enter; noise-free
        components do.

        Returns
        -------
        (N_t + 1, n, n) array
            The last belongs to ``estimate.state``, the one before to ``estimate.filtered``.

        Raises
        ------
        InvalidInputError
            Before the first measurement, if the model cannot be linearised there, or if the
            weights leave a direction of the states undetermined: a redescending loss takes
            the weight from outliers.
        """
        return self._engine.covariances()

    def sensitivity(self) -> Sensitivity:
        """Derivatives of the last estimate with respect to weights, data and parameters.

        Applies the implicit function theorem to the window's true cost, with its exact Hessian and
        fixed active rows, for any engine. This takes a few factorisations of a banded matrix, O(N
        n^3), and one solve per derivative.

        Returns
        -------
        Sensitivity
            Its `Sensitivity.adjoint` differentiates any function of the trajectory with respect to
            everything at once.

        Raises
        ------
        InvalidInputError
            Before the first measurement, or if second derivatives do not exist along the
            estimate or are not known: of a cost that the user wrote, or of an active nonlinear
            constraint of more than the state.
        """
        return self._sensitivity_of(self._engine.solved())

    def _sensitivity_of(self, solved: Solved) -> Sensitivity:
        second = solved.formulation.system.evaluation.second_derivatives
        with np.errstate(all="ignore"):
            return self.differentiate(
                solved, second, self.settings.tolerance, len(self.settings.parameters)
            )

    def known_covariances(self) -> Array:
        """The `covariances` of the last window, (K + 1, n, n); NaN where there are none."""
        try:
            return self.covariances()
        except InvalidInputError:  # bad luck: the record goes on
            n = self.system.n
            return np.full((self._engine.length + 1, n, n), np.nan)

    def state_dict(self) -> dict[str, Any]:
        """A snapshot of the estimator's memory: arrays by name, and one text for the rest.

        Save it with ``numpy.savez(file, **state)`` or ``json.dumps(state,
        default=numpy.ndarray.tolist)``. An estimator made with the same arguments continues from
        there after `load_state_dict`, in the same process or another: bit for bit, unless a QP
        solver was warm-started. What it keeps is not saved; see `forget_warm_start`. Taking a
        snapshot changes nothing in this estimator.

        Returns
        -------
        dict
            Copies, safe to keep, pickle or save.
        """
        return written(self._engine.state_dict())

    def forget_warm_start(self) -> None:
        """Have the next QP start without what the QP solver has kept of those before.

        An estimator that goes on after this call, and another that continues from its
        `state_dict`, give the same estimates to the last bit, whatever the solver. The compiled
        step needs no such call: snapshots have all that it keeps.
        """
        self._engine.forget_warm_start()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another estimator stopped.

        Parameters
        ----------
        state : dict
            The `state_dict` of an estimator with the same arguments, also as read by ``numpy.load``
            or ``json.load``.

        Raises
        ------
        InvalidInputError
            If the state is damaged, or from an estimator with another model, observer, cost, sets,
            candidate or engine. The estimator stays unchanged. QP caps, backend, tolerances,
            ``infeasible`` and ``warm_start`` may differ.

        Notes
        -----
        A digest shows damage. Functions are compared by their values at a few points. With
        ``engine="auto"`` the estimator continues with the snapshot's engine.
        """
        memory = read(state)
        pinned = memory.get("engine")
        # Whole or, if interrupted, not at all.
        if isinstance(pinned, str) and self.engine != pinned and self.settings.engine == "auto":
            own = self._own_system.evaluated_like(self._engine.system)
            engine = engine_of_snapshot(
                pinned, own, self.observer, self.cost, self.settings, self._initial_state,
            )
            engine.load_state_dict(memory)
            self._engine = engine
        else:
            self._engine.load_state_dict(memory)

    def __repr__(self) -> str:
        parts = {"system": self.system, "observer": self.observer, "cost": self.cost}
        chosen = {
            field.name: value for field in fields(self.settings)
            if (value := getattr(self.settings, field.name)) != field.default
            and field.name != "engine"
        }
        words = [f"{name}={value!r}" for name, value in (
            parts | chosen | {"engine": self.engine, "time": self.time}
        ).items()]
        return "MovingHorizonEstimator(\n    " + ",\n    ".join(words) + "\n)"

    def __getstate__(self) -> dict[str, Any]:
        solver = self.settings.backend
        if isinstance(solver, Solver):
            try:
                pickle.dumps(solver)
            except Exception as error:
                raise InvalidInputError(
                    f"the solver {solver!r} given as backend cannot be pickled "
                    f"({type(error).__name__}: {error}), nor can its estimator; name "
                    "a registered backend instead, or save state_dict()."
                ) from error
        return {
            "arguments": (self.system, self.observer, self.cost),
            "settings": self.settings,
            "first_state": self._first_state,
            "initial_state": self.initial_state,
            "labels": self._labels,
            "engine": self.engine,
            "state": self.state_dict(),
        }

    def __setstate__(self, saved: dict[str, Any]) -> None:
        # Construction checks everything again: a snapshot is input like any other.
        options = vars(saved["settings"]) | {"engine": saved["engine"]}
        self.settings = saved["settings"]  # what the first construction warned of is known
        self.__init__(  # type: ignore[misc]  # on a fresh, empty instance
            *saved["arguments"], initial_state=saved["first_state"], **options
        )
        self.settings, self._labels = saved["settings"], saved.get("labels")
        self.load_state_dict(saved["state"])
        if not np.array_equal(saved["initial_state"], saved["first_state"]):
            # How the model is called and scaled depends on both; X is that of `set` by now.
            self.reset(saved["initial_state"])
            self.load_state_dict(saved["state"])


def reweighted(known: Estimator, observer: Observer, cost: Cost) -> Estimator:
    """An estimator as a known one was at first, with another observer and cost.

    Neither the model nor the length of its steps is tried again, and no warning is given twice.
    """
    made = type(known).__new__(type(known))
    made.settings = known.settings
    made.__init__(  # type: ignore[misc]  # as `__setstate__` does
        known.system, observer, cost, initial_state=known.initial_state, **vars(known.settings)
    )
    return made
