"""A way to simulate a system from stated initial states and noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from qpmhe_solvers.values import finite, shown

from .._checks import (
    Array,
    count,
    dimension,
    positive,
    positive_definite,
    positive_semidefinite,
    vector,
)
from .._linalg import cholesky
from ..errors import InvalidInputError, ModelError, OptionError
from ..model.residuals import difference
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system

# Draws for one sample until it lies in the sets: more would mean that hardly any does.
_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class Record:
    """A simulated record; it unpacks into states, measurements and, if there are any, inputs.

    Parameters
    ----------
    states : (T + 1, n) array
        x(0), ..., x(T).
    measurements : (T, p) array
        y(0), ..., y(T-1).
    inputs : (T, m) array or None
        u(0), ..., u(T-1); None for a system without inputs.
    initial_estimate : (n,) array or None
        Where the estimation starts, if that is known.
    """

    states: Array
    measurements: Array
    inputs: Array | None = None
    initial_estimate: Array | None = None

    def __iter__(self) -> Iterator[Array]:
        yield self.states
        yield self.measurements
        if self.inputs is not None:
            yield self.inputs


@dataclass(frozen=True, eq=False)
class Scenario:
    r"""How a system is simulated and how its estimation starts.

    Disturbance and noise are normal and white. Where the system has sets, they are truncated:
    w(t) to those with :math:`w \in \mathbb W` and :math:`f(x, u) + G w \in \mathbb X`, v(t) to
    :math:`\mathbb V`, by drawing again. Where a set has zero width, the component has its value.
    Angles are recorded between minus and plus half a period, or in the turn about their bounds.

    Parameters
    ----------
    system : System
    initial_state, initial_estimate : (n,) array
        Where the simulation starts, and the estimation.
    disturbance_covariance, noise_covariance : array
        Covariances of w (r, r) and v (p, p), before any truncation. That of w may be singular;
        r is n, or the number of columns of the system's ``disturbance_matrix`` G.
    dt, time_unit : float and str
        Sampling time and its unit.
    horizon : int
        N of the published or recommended setting.
    steps : int
        Samples of a usual record.
    labels : tuple of str
        Names of the states with units, for figures.
    inputs : callable, optional
        inputs(t, x) -> u(t) (m,), from the sample's index t = 0, 1, ... and the true state
        x(t): known inputs ignore the state, a feedback controller does not. Needed exactly
        if the system has inputs.
    settling_time : float
        From this time on (in time_unit), the initial error counts as decayed.
    title : str
        A description in one line.
    resolution : (p,) array, optional
        Step of outputs that are digital, 0 where they are not. Such an output is h(x)
        rounded to the nearest multiple of its step, in place of normal noise; the matching
        variance is the step squared over 12.
    region, input_region : ConvexSet and Box, optional
        The states and inputs for which the model is meant, on which `qpmhe certify` certifies it.

    Raises
    ------
    ShapeError, WeightError, InvalidInputError, OptionError
        If something does not fit.
    """

    system: System
    initial_state: Array
    initial_estimate: Array
    disturbance_covariance: Array
    noise_covariance: Array
    dt: float
    horizon: int
    steps: int
    labels: tuple[str, ...]
    time_unit: str = "s"
    inputs: Callable[[int, Array], Array] | None = None
    settling_time: float = 0.0
    title: str = ""
    resolution: Array | None = None
    region: ConvexSet | None = None
    input_region: Box | None = None

    def __post_init__(self) -> None:
        checked_system(self.system)
        n, p = self.system.n, self.system.p
        for name in ("initial_state", "initial_estimate"):
            state = _within_turn(self.system, vector(name, getattr(self, name), n))
            _check_member(name, state, self.system.states)
            object.__setattr__(self, name, state)
        w, _ = positive_semidefinite(
            "disturbance covariance", self.disturbance_covariance, self.system.r
        )
        v = positive_definite("noise covariance", self.noise_covariance, p)
        object.__setattr__(self, "disturbance_covariance", w)
        object.__setattr__(self, "noise_covariance", v)
        positive("dt", self.dt)
        dimension("horizon", self.horizon, 1)
        dimension("steps", self.steps, 1)
        if not isinstance(self.labels, (tuple, list)) or len(self.labels) != n:
            raise OptionError(f"labels is {shown(self.labels)}; expected {n} names, one per state.")
        settling = finite(self.settling_time)
        if settling is None or settling < 0.0:
            raise OptionError(
                f"settling_time is {shown(self.settling_time)}; expected a finite number >= 0."
            )
        if (self.inputs is None) != (self.system.m == 0):
            raise OptionError(
                f"inputs is {shown(self.inputs)}, and the system has {self.system.m} inputs; "
                "expected a function of time and state exactly if there are any."
            )
        if self.resolution is not None:
            step = vector("resolution", self.resolution, p)
            if (step < 0.0).any():
                raise OptionError(f"resolution is {step.tolist()}; expected steps >= 0.")
            object.__setattr__(self, "resolution", step)
        for name, region, size in (
            ("region", self.region, n), ("input_region", self.input_region, self.system.m)
        ):
            if region is not None and (
                not isinstance(region, ConvexSet) or region.dimension != size
            ):
                raise OptionError(
                    f"{name} is {shown(region)}; expected a set of dimension {size}, such as "
                    "qpmhe.Box(lower, upper)."
                )

    def simulate(self, seed: int, steps: int | None = None) -> Record:
        """Simulate x(t+1) = f(x(t), u(t)) + G w(t), y(t) = h(x(t), u(t)) + v(t).

        Parameters
        ----------
        seed : int
            Seed of the random numbers; the same seed gives the same record.
        steps : int, optional
            Number T of measurements; ``self.steps`` if left out.

        Raises
        ------
        OptionError
            If the seed or the number of steps is not an integer >= 0.
        ModelError
            If no drawn disturbance keeps the state in its set, or the state is not finite.
        """
        generator = np.random.default_rng(count("seed", seed, 0))
        total = self.steps if steps is None else dimension("steps", steps, 0)
        system = self.system
        spread_w = cholesky(self.disturbance_covariance).T
        spread_v = cholesky(self.noise_covariance).T
        matrix = system.disturbance_matrix
        w = generator.standard_normal((total, system.r)) @ spread_w
        v = generator.standard_normal((total, system.p)) @ spread_v
        states, measurements = np.empty((total + 1, system.n)), np.empty((total, system.p))
        inputs = np.empty((total, system.m))
        states[0] = self.initial_state
        for t in range(total):
            x, u = states[t], inputs[t]
            if self.inputs is not None:
                u[:] = vector("inputs(t, x)", self.inputs(t, x.copy()), system.m)
            noise = _inside(v[t], spread_v, generator, (system.noises, 0.0, None))
            if noise is None:
                raise ModelError(f"no noise of sample {t} lies in {system.noises!r}; widen it.")
            measured = self._measured(system.h(x, u), noise)
            measurements[t] = difference(system.output_residual, measured, np.zeros(system.p))
            reached = _within_turn(system, system.f(x, u))
            disturbance = _inside(
                w[t], spread_w, generator, (system.disturbances, 0.0, None),
                (system.states, reached, matrix),
            )
            if disturbance is None or not np.isfinite(reached).all():
                raise ModelError(
                    f"the simulated state cannot stay inside the sets at sample {t}: without "
                    f"disturbance it is {reached.tolist()}. Widen the sets, or simulate fewer "
                    "samples."
                )
            if matrix is not None:
                disturbance = matrix @ disturbance
            states[t + 1] = _within_turn(system, reached + disturbance)
        return Record(
            states, measurements, inputs if system.m else None, self.initial_estimate)

    def _measured(self, output: Array, noise: Array) -> Array:
        step = self.resolution
        if step is None:
            return output + noise
        digital = step * np.round(output / np.where(step > 0.0, step, 1.0))
        return np.where(step > 0.0, digital, output + noise)


def _within_turn(system: System, state: Array) -> Array:
    if system.state_residual is None:
        return state
    state = system.state_residual(state, np.zeros(system.n))
    return state if system.turns is None else system.turns(state)


def _check_member(name: str, state: Array, states: ConvexSet | None) -> None:
    if states is not None and states.violation(state) > 0.0:
        raise InvalidInputError(
            f"{name} is {state.tolist()}, which is outside of the state set {states!r}."
        )


def _inside(
    drawn: Array, spread: Array, generator: np.random.Generator,
    *sets: tuple[ConvexSet | None, Any, Array | None],
) -> Array | None:
    """What was drawn, or drawn again until what each set bounds, G s + offset, lies in it."""
    bounded = [(each, offset, matrix) for each, offset, matrix in sets if each is not None]
    for _ in range(_DRAWS):
        for each, offset, matrix in bounded:
            fixed = each.fixed_components
            if fixed.size and matrix is None:
                drawn = drawn.copy()
                drawn[fixed] = (each.lower - offset)[fixed]
        if all(
            each.violation((drawn if matrix is None else matrix @ drawn) + offset) == 0.0
            for each, offset, matrix in bounded
        ):
            return drawn
        drawn = generator.standard_normal(drawn.size) @ spread
    return None
