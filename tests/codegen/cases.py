"""Estimators with every feature of the step, each with a record: one table for all tests of C."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

import qpmhe
from qpmhe import (
    Box,
    ExtendedKalman,
    Gate,
    HuberInnovation,
    Luenberger,
    ObserverPrior,
    Polytope,
    QuadraticCost,
    RobustCost,
    SteadyStateKalman,
    UnscentedKalman,
)
from qpmhe.model.sets import ConvexSet
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.models.batch_reactor import casadi_output as reactor_output
from qpmhe.models.batch_reactor import casadi_rate as reactor_rate

from .conditions import with_changes, with_conditions, with_parameters

STEPS = 24
Options = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """An estimator's arguments, and the arguments of each of its updates.

    ``options`` are those of the estimator beside engine and initial state, ``samples`` the
    arguments of `update`, by name, and ``changes`` those of `set` after the samples that are its
    keys. Both engines must agree to ``tolerance``, relative to the
    magnitude of what is compared.
    """

    system: qpmhe.System
    observer: qpmhe.Observer
    cost: qpmhe.Cost
    start: Any
    samples: tuple[Options, ...]
    options: Options = field(default_factory=lambda: {"horizon": 5, "max_qps": 2})
    tolerance: float = 1e-9
    changes: dict[int, Options] = field(default_factory=dict)

    def estimator(self, engine: str, **options: Any) -> qpmhe.MovingHorizonEstimator:
        """An estimator of this case."""
        with warnings.catch_warnings():
            # Of a start outside of the states, which some cases have.
            warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
            return qpmhe.MovingHorizonEstimator(
                self.system, self.observer, self.cost, initial_state=self.start, engine=engine,
                **(self.options | options),
            )

    def with_options(self, **options: Any) -> Case:
        """The case with other options."""
        return replace(self, options=self.options | options)


Table = dict[str, tuple[Any, ...]]


def gaps(one: Case) -> Case:
    """The case with missing components, missing samples and, of an ODE, other steps."""
    samples = []
    for t, sample in enumerate(one.samples):
        y = np.array(sample["y"], float)
        if t % 5 == 3:
            y[t % y.size] = np.nan
        if t % 11 == 7:
            y[:] = np.nan
        own = {"dt": 0.7 * one.system.dt} if one.system.dt and t % 6 == 4 else {}
        samples.append(sample | {"y": y} | own)
    return replace(one, samples=tuple(samples))


def recorded(
    system: qpmhe.System, start: Any, *, seed: int = 3, disturbance: float = 0.02,
    noise: float = 0.1, steps: int = STEPS,
) -> tuple[Options, ...]:
    """Samples of the system along a disturbed trajectory that starts near a state."""
    generator = np.random.default_rng(seed)
    x, samples = np.asarray(start) + noise * generator.standard_normal(system.n), []
    for u in generator.uniform(-1.0, 1.0, (steps, system.m)):
        y = system.h(x, u) + noise * generator.standard_normal(system.p)
        samples.append({"y": y, "u": u} if system.m else {"y": y})
        x = system.f(x, u) + disturbance * generator.standard_normal(system.n)
    return tuple(samples)


def spd(seed: int, n: int) -> np.ndarray:
    """A positive definite matrix that is not diagonal."""
    root = np.random.default_rng(seed).standard_normal((n, n))
    return root @ root.T + 0.5 * np.eye(n)


def own_weight(one: Case, observer: qpmhe.Observer, prior: Any = None) -> Case:
    """The case with an observer whose covariance weighs the prior, unless a weight is given."""
    kept = {name: getattr(one.cost, name) for name in ("disturbance", "noise", "discount")}
    cost = QuadraticCost(prior=ObserverPrior() if prior is None else prior, **kept)
    return replace(one, observer=observer, cost=cost)


def samples_with(one: Case, change: Callable[[int, np.ndarray], Options]) -> Case:
    """The case with what a function of time and measurement says of each sample."""
    return replace(one, samples=tuple(
        sample | change(t, np.array(sample["y"], float)) for t, sample in enumerate(one.samples)
    ))


def outliers(one: Case) -> Case:
    """The case with a large error in some of its measurements."""
    generator = np.random.default_rng(9)
    return samples_with(one, lambda t, y: {"y": y + 3.0 * (generator.random(y.size) < 0.2)})


def weighed(one: Case) -> Case:
    """The case with another noise weight at some samples."""
    own = {"noise_weight": np.diag(np.arange(3.0, 3.0 + one.system.p))}
    return samples_with(one, lambda t, y: own if t % 4 == 1 else {})


def looser(one: Case) -> Case:
    """The case whose engines agree to fewer digits, as rounding decides."""
    return replace(one, tolerance=1e-7)


# The systems.


def _reactor() -> Case:
    """The paper's batch reactor in CasADi's language, evaluated by its virtual machine."""
    _, observer, cost, scenario = batch_reactor("rk4")
    system = qpmhe.from_casadi(
        reactor_rate, reactor_output, n=2, dt=0.1, method="rk4", compiled=False
    )
    samples = tuple({"y": y} for y in scenario.simulate(1, STEPS).measurements)
    return Case(system, observer, cost, np.array(scenario.initial_estimate), samples)


def with_inputs(**options: Any) -> qpmhe.System:
    """Three states, two outputs, two inputs: f and h both take the inputs."""

    def f(x: Any, u: Any) -> Any:
        return [0.9 * x[0] + 0.2 * ca.sin(x[1]) + 0.1 * u[0],
                0.8 * x[1] - 0.1 * x[0] ** 2 + 0.1 * u[0] * u[1],
                0.7 * x[2] + 0.2 * x[0] * ca.cos(x[1])]

    return qpmhe.from_casadi(
        f, lambda x, u: [x[0] + 0.3 * u[1] * x[1], x[2] + 0.1 * x[1] ** 2], n=3, m=2,
        compiled=False, **options,
    )


def _inputs() -> Case:
    system, start = with_inputs(), np.array([0.5, 0.5, 0.2])
    cost = QuadraticCost(
        prior=spd(1, 3), disturbance=10 * spd(2, 3), noise=spd(3, 2), discount=0.95
    )
    return Case(system, Luenberger(OTHER_GAIN), cost, start, recorded(system, start))


def _inputs_in(**sets: Any) -> Case:
    """The case with inputs in sets."""
    return replace(case("inputs"), system=with_inputs(**sets)).with_options(solver_tolerance=1e-12)


def within(lower: Any, upper: Any, total: float, noise: Any) -> Callable[[Case], Case]:
    """A change to sets of disturbances and noises, solved to convergence."""
    disturbances = Box(lower, upper) & Polytope([[1.0, 1.0, -1.0]], [total])
    sets = {"disturbances": disturbances, "noises": Box(-np.array(noise), noise)}

    def changed(one: Case) -> Case:
        one = replace(one, system=with_inputs(**sets))
        return one.with_options(max_qps=None, solver_tolerance=1e-9)

    return changed


def _observed(make: Any, weight: Any = None, **options: Any) -> Case:
    """The system with inputs, and an observer with a covariance; options replace covariances."""
    covariances = {"prior": spd(4, 3), "disturbance": 0.05 * spd(5, 3), "noise": 0.05 * spd(6, 2)}
    return own_weight(case("inputs"), make(**covariances | options), weight)


def filtered_by(make: Any) -> Callable[[Case], Case]:
    """A change to a filter of the cost's covariances, which weighs the prior."""

    def changed(one: Case) -> Case:
        weights = {name: getattr(one.cost, name) for name in ("prior", "disturbance", "noise")}
        observer = make(**{name: np.linalg.inv(weight) for name, weight in weights.items()})
        return own_weight(one, observer)

    return changed


def doubtful(
    innovation: Any, make: Any = ExtendedKalman, **options: Any
) -> Callable[[Case], Case]:
    """A change to outliers, a fault that lasts, and an observer that judges innovations."""

    def changed(one: Case) -> Case:
        generator, (n, p) = np.random.default_rng(17), (one.system.n, one.system.p)
        scale = np.std([np.array(sample["y"], float) for sample in one.samples], axis=0)

        def spoilt(t: int, y: np.ndarray) -> Options:
            y += (generator.random(p) < 0.15) * generator.choice([-1.0, 1.0], p) * 10.0 * scale
            y[0] += 8.0 * scale[0] * (9 <= t < 16)
            return {"y": y}

        covariances = {
            "prior": 0.01 * spd(4, n), "disturbance": 0.002 * spd(5, one.system.r),
            "noise": 0.01 * spd(6, p),
        }
        observer = make(innovation=innovation, **covariances | options)
        return replace(samples_with(one, spoilt), observer=observer)

    return changed


def _steady() -> Case:
    one = case("inputs")
    observer = SteadyStateKalman(
        one.system, one.start, [0.3, 0.2], disturbance=0.05 * spd(5, 3), noise=0.05 * spd(6, 2),
        prior=spd(4, 3),
    )
    cost = QuadraticCost(
        prior=ObserverPrior(0.5, 20.0), disturbance=one.cost.disturbance, noise=one.cost.noise
    )
    return replace(one, observer=observer, cost=cost)


def _many_states(dense: bool) -> Case:
    """So many states that LAPACK factorises: neighbours in a row, or all in touch with all."""
    n, p, generator = 42, 6, np.random.default_rng(5)
    mixing = generator.standard_normal((n, n)) / n**0.5
    outputs = generator.standard_normal((p, n)) / n**0.5
    system = qpmhe.from_casadi(
        (lambda x: 0.9 * ca.sin(ca.mtimes(ca.DM(mixing), x))) if dense
        else (lambda x: -0.5 * x + ca.sin(ca.vertcat(x[1:], x[0]))),
        lambda x: ca.mtimes(ca.DM(outputs), x), n=n, dt=None if dense else 0.1, compiled=False,
    )
    weight = spd(6, n) / n if dense else np.diag(generator.uniform(20.0, 50.0, n))
    cost = QuadraticCost(prior=np.eye(n), disturbance=weight, noise=40 * spd(7, p) / p)
    start = generator.standard_normal(n)
    samples, observer = recorded(system, start, steps=9), Luenberger(0.05 * outputs.T)
    return Case(system, observer, cost, start, samples, {"horizon": 4, "max_qps": 3})


def _plain(
    f: Any, h: Any, n: int, p: int, horizon: int = 4, steps: int = 14, **options: Any
) -> Case:
    """A system by itself: its size, its language or its method is what matters."""
    system = qpmhe.from_casadi(f, h, n=n, compiled=False, **options)
    cost = QuadraticCost(prior=2.0 * np.eye(n), disturbance=20.0 * spd(1, n), noise=10 * spd(2, p))
    start, observer = np.full(n, 0.2), Luenberger(0.1 * np.cos(np.arange(n * p)).reshape(n, p))
    samples = recorded(system, start, steps=steps)
    return Case(system, observer, cost, start, samples, {"horizon": horizon, "max_qps": 2})


def _rate(x: Any) -> Any:
    return ca.sin(ca.vertcat(x[1:], x[0])) - 1.4 * x


def _spline(x: Any) -> Any:
    grid = np.linspace(-3, 3, 9)
    turned = ca.solve(ca.MX(ca.DM([[2.0, 0.3], [0.1, 2.0]])), x + ca.sin(x))
    spline = ca.interpolant("s", "bspline", [grid], np.sin(grid))
    return turned + 0.1 * spline(x[0]) + 0.1 * ca.logsumexp(x)


def _underflowing() -> Case:
    """A stage that fails, whose discount is zero by the end of a long window."""
    one = _plain(lambda x: 0.9 * x, ca.sqrt, 1, 1, horizon=190)
    samples = [{"y": 0.3 + 0.01 * np.sin(t) * np.ones(1)} for t in range(220)]
    samples[5] = {"y": np.full(1, -40.0)}
    cost = QuadraticCost(prior=1.0, disturbance=5.0, noise=5.0, discount=0.01)
    return replace(
        one, observer=Luenberger([0.5]), cost=cost, start=np.full(1, 0.5), samples=tuple(samples),
    ).with_options(max_qps=1)


def _starved() -> Case:
    """A model that inputs let fail at several samples in a row, whatever the state."""
    one = _plain(lambda x, u: 0.9 * x + 0.1 * ca.sqrt(x + 2.0 - u), lambda x, u: x, 1, 1, m=1)
    return samples_with(one, lambda t, y: {"u": np.array([9.0])} if t in (6, 7, 8) else {})


def _reaction_in(states: ConvexSet, start: Any = (0.1, 4.5), **sets: Any) -> Case:
    """2A -> B in pressures, of which the sum is measured; runs away from negative ones.

    In a set of states, which the observer leaves.
    """

    def f(x: Any) -> Any:
        rate = 0.016 * x[0] ** 2
        return [x[0] - 2.0 * rate, x[1] + rate]

    system = qpmhe.from_casadi(
        f, lambda x: [x[0] + x[1]], n=2, compiled=False, states=states, **sets
    )
    cost = QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1))
    samples = recorded(system, [3.0, 1.0], disturbance=0.0)
    options = {"horizon": 5, "max_qps": 2, "solver_tolerance": 1e-12}
    return Case(system, Luenberger([0.8, -0.3]), cost, np.array(start), samples, options)


def _kalman_in(states: ConvexSet, make: Any, weight: Any = None, **options: Any) -> Case:
    """The reaction in a set of states, and an observer with a covariance."""
    one = _reaction_in(states)
    if make is SteadyStateKalman:
        observer = make(one.system, [2.0, 1.5], disturbance=0.1 * np.eye(2), noise=[[0.01]])
    else:
        covariances = {"prior": 36.0 * np.eye(2), "disturbance": 1e-3 * np.eye(2)} | options
        observer = make(**covariances, noise=[[0.01]])
    cost = QuadraticCost(prior=np.eye(2), disturbance=1e3 * np.eye(2), noise=[[100.0]])
    return own_weight(replace(one, cost=cost), observer, weight)


def _robust(prior: Any = None, disturbance: Any = None, noise: Any = None, **options: Any) -> Case:
    """The case with inputs, diagonal weights, outliers, and these losses of the weights."""
    weights = {
        "prior": (prior, [2.0, 1.0, 3.0]), "disturbance": (disturbance, [40.0, 20.0, 30.0]),
        "noise": (noise, [20.0, 50.0]),
    }
    terms = {
        name: np.diag(diagonal) if loss is None else loss(np.diag(diagonal))
        for name, (loss, diagonal) in weights.items()
    }
    return outliers(replace(case("inputs"), cost=RobustCost(**terms, **options)))


class PseudoHuber(qpmhe.Loss):
    """Quadratic near zero, and linear far away."""

    def _value(self, q: np.ndarray) -> np.ndarray:
        return 2.0 * (np.sqrt(1.0 + q) - 1.0)

    def _slope(self, q: np.ndarray) -> np.ndarray:
        return 1.0 / np.sqrt(1.0 + q)


class Heavier(qpmhe.Huber):
    """Another multiple of Huber's loss for each threshold."""

    def _value(self, q: np.ndarray) -> np.ndarray:
        return self.threshold * super()._value(q)

    def _slope(self, q: np.ndarray) -> np.ndarray:
        return self.threshold * super()._slope(q)


def huber(threshold: float, per_component: bool = False) -> Callable[[Any], qpmhe.Loss]:
    return functools.partial(qpmhe.Huber, threshold=threshold, per_component=per_component)


def power(exponent: float, per_component: bool = False) -> Callable[[Any], qpmhe.Loss]:
    return functools.partial(qpmhe.Power, exponent=exponent, per_component=per_component)


def barron(shape: float, threshold: float = 1.0) -> Callable[[Any], qpmhe.Loss]:
    return functools.partial(qpmhe.Barron, shape=shape, threshold=threshold)


def cauchy(**options: Any) -> Callable[[Any], qpmhe.Loss]:
    return functools.partial(qpmhe.Cauchy, per_component=True, **options)


def geman(**options: Any) -> Callable[[Any], qpmhe.Loss]:
    return functools.partial(qpmhe.GemanMcClure, **options)


def _tank() -> Case:
    """A tank whose outflow's coefficient is a parameter, with two gauges and a push."""
    system = qpmhe.from_casadi(
        lambda x, u: [u[0] - u[1] * ca.sqrt(ca.fmax(x[0], 0.01)) - 0.1 * x[1], 0.5 * x[0] - x[1]],
        lambda x, u: [x[0], x[0] + 0.3 * x[1] ** 2], n=2, m=2, dt=0.1, compiled=False,
        noises=Box([-0.25, -0.4], [0.25, 0.4]), disturbances=Box([-0.15, -0.2], [0.1, 0.15]),
    )
    cost = QuadraticCost(prior=spd(4, 2), disturbance=2500 * spd(5, 2), noise=40 * spd(6, 2))
    start = np.array([1.0, 0.5])
    one = Case(
        system, Luenberger([[0.2, 0.05], [0.0, 0.1]]), cost, start, recorded(system, start)
    )
    one = samples_with(one, lambda t, y: {"u": np.array([0.6 + 0.2 * np.sin(t), 0.5])})
    return with_parameters(one, 0.5).with_options(max_qps=None, solver_tolerance=1e-9)


def _turned_outputs(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rover's difference of two outputs."""
    d = a - b
    degrees = (d[..., 1] + 180.0) % 360.0 - 180.0
    return np.stack((d[..., 0], degrees, np.arctan2(np.sin(d[..., 2]), np.cos(d[..., 2]))), -1)


def _turned_states(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rover's difference of two states."""
    d = a - b
    return d - np.array([0.0, 0.0, 2.0 * np.pi, 0.0]) * np.floor(d / (2.0 * np.pi) + 0.5)


def _rover(
    outputs: bool = True, states: bool = True, functions: bool = False, **sets: Any
) -> Case:
    """A turning rover with a compass that sees distance and bearing of a beacon.

    Where states have angles, f keeps the heading in one turn. Where outputs have none, they are
    smooth functions of both. The angles may be stated by functions of two vectors.
    """

    def f(x: Any) -> Any:
        heading = x[2] + x[3]
        if states:
            heading = ca.atan2(ca.sin(heading), ca.cos(heading))
        return ca.vertcat(x[0] + 0.3 * ca.cos(x[2]), x[1] + 0.3 * ca.sin(x[2]), heading, x[3])

    def h(x: Any) -> Any:
        bearing = ca.atan2(-3.0 - x[1], -2.0 - x[0]) - x[2]
        north, compass = ca.sqrt((2.0 + x[0]) ** 2 + (3.0 + x[1]) ** 2), x[2]
        if outputs:
            bearing *= 180.0 / ca.pi
            compass = ca.atan2(ca.sin(compass), ca.cos(compass))
        else:
            bearing, compass = ca.sin(bearing), ca.cos(compass)
        return ca.vertcat(north, bearing, compass)

    residuals = {}
    if outputs:
        angles = qpmhe.angles([1, 2], [360.0, 2.0 * np.pi])
        residuals["output_residual"] = _turned_outputs if functions else angles
    if states:
        residuals["state_residual"] = _turned_states if functions else qpmhe.angles([2])
    system = qpmhe.from_casadi(f, h, n=4, compiled=False, **residuals, **sets)
    unit = 57.3 if outputs else 1.0
    deviations = {
        "prior": [0.5, 0.5, 0.4, 0.1], "disturbance": [0.1, 0.1, 0.03, 0.02],
        "noise": [0.2, 0.1 * unit, 0.1],
    }
    covariances = {name: np.diag(np.square(one)) for name, one in deviations.items()}
    cost = QuadraticCost.from_covariances(**covariances)
    generator, x, samples = np.random.default_rng(4), np.array([0.3, -0.2, 0.5, 1.7]), []
    for _ in range(3 * STEPS):
        y = system.h(x, np.zeros(0)) + generator.normal(0.0, deviations["noise"])
        if outputs:  # measured within one turn
            y = system.output_residual(y, np.zeros(3))
        samples.append({"y": y})
        x = system.f(x, np.zeros(0)) + generator.normal(0.0, deviations["disturbance"])
    turning = [[0.0, -0.2 / unit, 0.4], [0.0, 0.0, 0.1]] if outputs else np.zeros((2, 3))
    gain = [[0.2, 0.0, 0.0], [0.0, 0.0, 0.0], *turning]
    start, options = np.array([0.0, 0.0, 0.9, 1.6]), {"horizon": 6, "max_qps": 3}
    return Case(system, Luenberger(gain), cost, start, tuple(samples), options)


def _compass(functions: bool = False) -> Case:
    """A ship whose heading, in degrees, is bounded across the seam."""

    def wrapped(angle: Any) -> Any:
        return angle - 360.0 * ca.floor(angle / 360.0 + 0.5)

    def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        d = a - b
        return np.stack(((d[..., 0] + 180.0) % 360.0 - 180.0, d[..., 1]), axis=-1)

    angle = turned if functions else qpmhe.angles([0], 360.0)
    system = qpmhe.from_casadi(
        lambda x: ca.vertcat(wrapped(x[0] + x[1]), 0.8 * x[1] - 0.1 * ca.sin(x[0] * ca.pi / 45)),
        lambda x: ca.vertcat(wrapped(x[0]), x[1] ** 2), n=2, compiled=False,
        states=Box([175.0, -4.0], [185.0, 2.0]), output_residual=angle, state_residual=angle,
    )
    cost = QuadraticCost.from_covariances(
        prior=np.diag([9.0, 1.0]), disturbance=np.diag([0.5, 0.5]), noise=np.diag([16.0, 4.0])
    )
    generator, x, samples = np.random.default_rng(11), np.array([178.0, 1.0]), []
    for _ in range(4 * STEPS):
        y = system.h(x, np.zeros(0)) + generator.normal(0.0, [4.0, 1.0])
        samples.append({"y": np.array([wrapped(y[0]), y[1]])})
        x = system.f(x, np.zeros(0)) + generator.normal(0.0, [0.7, 0.7])
        x = np.clip([x[0] % 360.0, x[1]], [175.0, -4.0], [185.0, 2.0])
    observer, start = Luenberger([[0.5, 0.0], [0.1, 0.0]]), np.array([-179.0, 0.0])
    return Case(system, observer, cost, start, tuple(samples), {"horizon": 5, "max_qps": None})


def _saturated(z: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A correction that large errors cannot drive far, and that depends on the state."""
    bounded = np.tanh(v)
    return np.array([[0.3, 0.0], [0.1, 0.05], [0.0, 0.3]]) @ bounded * (1.0 + 0.2 * np.cos(z))


def _failing(error: float = 12.0, make: Any = ExtendedKalman) -> Case:
    """A model that is not defined below zero, where errors lead the observer at times."""
    system = qpmhe.from_casadi(
        lambda x: [x[0] - 0.1 * ca.sqrt(x[0]) + 0.05 * x[1], 0.9 * x[1] + 0.1],
        lambda x: [x[0] + 0.1 * ca.sqrt(x[1])], n=2, compiled=False,
    )
    start = np.array([1.0, 1.0])
    samples = list(recorded(system, start, disturbance=0.01, noise=0.02))
    for t in (6, 7, 15):
        samples[t] = {"y": samples[t]["y"] - error}
    cost = QuadraticCost(
        prior=ObserverPrior(), disturbance=100.0 * np.eye(2), noise=[[100.0]]
    )
    observer = make(prior=0.1 * np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]])
    return Case(system, observer, cost, start, tuple(samples))


def _fewer(gain: Any = None, **options: Any) -> Case:
    """The system with inputs, with two disturbances on its three states; G is dense."""
    matrix = np.array([[1.0, 0.2], [0.5, -1.0], [0.3, 0.8]])
    system = with_inputs(disturbance_matrix=matrix, **options)
    cost = QuadraticCost(prior=spd(1, 3), disturbance=10 * spd(2, 2), noise=spd(3, 2))
    # Corrections within the range of G, where no other gain is given.
    gain = matrix @ [[0.2, 0.05], [-0.05, 0.2]] if gain is None else gain
    one = replace(case("inputs"), system=system, observer=Luenberger(gain), cost=cost)
    return one.with_options(solver_tolerance=1e-10)


def _singular() -> Case:
    """A covariance of the disturbance of rank one."""
    direction = np.array([1.0, -0.5, 2.0])
    cost = QuadraticCost.from_covariances(
        prior=np.linalg.inv(spd(1, 3)), disturbance=0.05 * np.outer(direction, direction),
        noise=np.linalg.inv(spd(3, 2)),
    )
    return replace(case("inputs"), cost=cost).with_options(solver_tolerance=1e-10, max_qps=3)


def own_w(one: Case) -> Case:
    """The case with weights and sides of the disturbance at some samples."""
    narrow = {"disturbances": Box([-0.02, -0.03], [0.02, 0.02])}

    def own(t: int, y: np.ndarray) -> Options:
        found = {"disturbance_weight": 5.0 * spd(t, 2)} if t % 4 == 3 else {}
        if one.system.disturbances is not None and t % 6 == 5:
            found["bounds"] = narrow
        return found

    return samples_with(one, own)


def _held(
    hold: Any = 0.2, drifting: bool = True, cost: Any = None, bounds: Any = None, **options: Any
) -> Case:
    """Two unknown parameters, which are seen only while the input acts."""
    system = qpmhe.from_casadi(
        lambda x, u: [0.8 * x[0] + 0.2 * u[1] * u[0] + 0.05 * x[1],
                      0.7 * x[1] + 0.3 * u[2] * ca.sin(x[0])],
        lambda x: [x[0], x[1] + 0.1 * x[0] ** 2], n=2, m=3, compiled=False, **options,
    )
    nominal, r = np.array([1.0, 0.5]), system.r + 2
    augmented = qpmhe.augment_parameters(
        system, nominal=nominal, drifting=drifting, parameter_bounds=bounds, hold=hold
    )
    weights = {
        "prior": spd(8, 4), "disturbance": np.diag([400.0] * (r - 2) + [2500.0, 900.0]),
        "noise": np.diag([100.0, 60.0]),
    }
    generator, x, samples = np.random.default_rng(12), np.array([0.2, 0.1]), []
    for t in range(3 * STEPS):
        u = np.array([np.sin(0.7 * t) if t < STEPS or t >= 2 * STEPS else 0.0])
        y = system.h(x, np.append(u, nominal)) + 0.1 * generator.standard_normal(2)
        samples.append({"y": y, "u": u})
        x = system.f(x, np.append(u, nominal + np.array([0.3, -0.2])))
    gain = [[0.3, 0.0], [0.0, 0.3], [0.02, 0.0], [0.0, 0.01]]
    return Case(
        augmented, Luenberger(gain), (cost or QuadraticCost)(**weights),
        np.append([0.0, 0.0], nominal), tuple(samples), {"horizon": 6, "max_qps": 2},
    )


OTHER_GAIN = [[0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]
POSITIVE = Box([0.0, 0.0], [np.inf, np.inf])
WEDGE = Polytope([[-1.0, 0.1], [0.1, -1.0], [1.0, 1.0]], [0.0, 0.0, 4.2])
BOXED = within([-0.1] * 3, [0.1, 0.2, 0.1], 0.12, [3.2, 3.2])
NARROW = within([-0.05] * 3, [0.05] * 3, 0.06, [0.3, 0.4])
SMALL = {"disturbances": Box([-0.05, -0.08], [0.1, 0.06])}
ROVER = {"disturbances": Box([-0.4, -0.4, -0.03, -0.02], [0.4, 0.4, 0.03, 0.02])}
SINGULAR = {"prior": np.diag([1.0, 0.0, 0.5]), "disturbance": np.diag([0.02, 0.0, 0.0])}
FLAT = {"prior": np.diag([1.0, 0.0]), "disturbance": np.diag([1e-3, 0.0])}
# Changes of options.
AGAIN, WARM, ALONE = {"candidate": "reinitialized"}, {"warm_start": True}, {"max_qps": 0}
ONE, MANY, SMOOTH = {"max_qps": 1}, {"max_qps": None}, {"arrival": "smoothed"}


def conditions(one: Case) -> Case:
    """The case with conditions of single samples, and others as usual from some samples on."""
    return with_changes(with_conditions(one))


def by(observer: Callable[[Case], qpmhe.Observer]) -> Callable[[Case], Case]:
    """A change to another observer."""
    return lambda one: replace(one, observer=observer(one))


# Each case is made when it is asked for, and kept by `case`: what it is made of, by a function or
# the name of another case, and its changes: functions, or options.
USUAL: Table = {
    "reactor": (_reactor,),
    "reactor with gaps": ("reactor", gaps),
    "reactor reinitialized": ("reactor", AGAIN, WARM),
    "reactor conditions": ("reactor with gaps", with_conditions),
    "inputs": (_inputs,),
    "inputs with gaps": ("inputs", gaps),
    "inputs converged": ("inputs", MANY, {"delay": 2}),
    "inputs observer": ("inputs", ALONE),
    "inputs reinitialized": ("inputs", AGAIN, WARM, ONE),
    "inputs conditions": ("inputs reinitialized", with_conditions),
    "inputs changes": ("inputs", with_changes),
    "parameters alone": ("inputs", lambda one: with_parameters(one, 0.2, -0.1), conditions),
    "one of each": (lambda: _plain(lambda x: 0.9 * ca.sin(x), lambda x: x, 1, 1, horizon=1), gaps),
    "euler": (lambda: _plain(_rate, lambda x: x[:1], 3, 1, dt=0.2, method="euler"), gaps, WARM),
    "runge-kutta": (
        lambda: _plain(_rate, lambda x: x[:2], 4, 2, 3, dt=0.2, method="rk4"), AGAIN, gaps,
    ),
    "matrix expressions": (lambda: _plain(_spline, lambda x: x[0] + 0.1 * x[1] ** 2, 2, 1), gaps),
}
ANGLES: Table = {
    "angles of outputs": (lambda: _rover(states=False), WARM),
    "angles of states": (lambda: _rover(outputs=False), gaps, AGAIN),
    "angles of both": (_rover, gaps),
    "angles, conditions": ("angles of both", conditions),
    "residual functions": (lambda: _rover(functions=True), gaps, WARM),
    "angles extended": (_rover, gaps, filtered_by(ExtendedKalman)),
    "angles smoothed": (_rover, filtered_by(ExtendedKalman), SMOOTH),
    "functions unscented": (
        lambda: _rover(functions=True), gaps, filtered_by(UnscentedKalman), SMOOTH, WARM,
    ),
    "unscented with angles": (_rover, by(lambda one: UnscentedKalman(
        prior=np.diag([0.5, 0.5, 0.4, 0.1]) ** 2, noise=np.diag([0.2, 5.73, 0.1]) ** 2,
        disturbance=np.diag([0.1, 0.1, 0.03, 0.02]) ** 2,
    ))),
    "angles across the seam": (_compass,),
    "angles across the seam, conditions": (_compass, conditions),
    "functions across the seam": (lambda: _compass(True), gaps, AGAIN, WARM),
    "angles in curved sets": (
        lambda: _rover(**ROVER, noises=Box([-0.2, -25.0, -0.25], [0.2, 25.0, 0.25])), MANY,
    ),
    "angles in sets": (
        lambda: _rover(
            **ROVER, noises=Polytope([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]], [20.0, 0.2])
        ), MANY,
    ),
}
DIRECTIONS: Table = {
    "fewer disturbances": (_fewer,),
    "fewer disturbances observer": (_fewer, ALONE),
    "fewer disturbances out of range": (lambda: _fewer(OTHER_GAIN), gaps, WARM),
    "fewer disturbances in sets": (
        lambda: _fewer(OTHER_GAIN, **SMALL, noises=Box([-0.4, -0.4], [0.4, 0.4])), MANY,
    ),
    "fewer disturbances reinitialized": (
        lambda: _fewer(OTHER_GAIN, **SMALL), own_w, AGAIN, MANY,
    ),
    "fewer disturbances extended": (_fewer, lambda one: own_weight(one, ExtendedKalman(
        prior=0.3 * np.eye(3), disturbance=0.05 * spd(2, 2), noise=0.05 * np.eye(2)
    )), gaps, own_w),
    "one fixed of two disturbances": (
        lambda: _fewer(OTHER_GAIN, disturbances=Box([0.01, -np.inf], [0.01, np.inf])), MANY,
    ),
    "singular covariance": (_singular, gaps),
}
HELD: Table = {
    "held": (_held,),
    "held with gaps": ("held", gaps, with_changes),
    "held observer": ("held", ALONE),
    "held constants": (lambda: _held([0.3, 0.1], drifting=False),),
    "held, one of two": (lambda: _held({1: 0.1}), filtered_by(ExtendedKalman), SMOOTH),
    "held in sets": (
        lambda: _held(
            {1: 0.1, 0: 0.4}, bounds=Box([0.9, 0.2], [1.2, 0.6]),
            noises=Box([-0.2, -0.3], [0.2, 0.3]),
        ), WARM, {"solver_tolerance": 1e-10},
    ),
    "held, fewer disturbances": (
        lambda: _held(disturbance_matrix=[[1.0], [0.5]]), filtered_by(UnscentedKalman), gaps,
    ),
    "held reinitialized": ("held", with_conditions, AGAIN, MANY),
    "held, graduated": (lambda: _held(cost=lambda prior, disturbance, noise: RobustCost(
        prior=huber(0.5)(prior), disturbance=disturbance, noise=geman(per_component=True)(noise),
        discount=0.9,
    )), outliers, WARM),
}
MANY_STATES: Table = {
    "many states": (lambda: _many_states(False),),
    "many states, dense": (lambda: _many_states(True),),
    "many states with gaps": ("many states", gaps),
}
LOSSES: Table = {
    "huber": (lambda: _robust(noise=huber(1.345)),),
    "huber with gaps": ("huber", gaps, weighed),
    "huber in sets": ("huber", BOXED),
    "huber everywhere": (lambda: _robust(huber(0.5), huber(0.3), huber(1.0), discount=0.9), WARM),
    "huber per component": (
        lambda: _robust(huber(0.5, True), huber(0.3, True), huber(1.0, True)), gaps,
    ),
    "huber conditions": ("huber per component", conditions),
    "mixed losses": (
        lambda: _robust(huber(1.0), power(1.5, True), huber(2.0, True)), gaps, weighed, AGAIN,
        WARM, {"max_qps": 4},
    ),
    "losses in sets": ("mixed losses", BOXED),
    "power": (lambda: _robust(power(1.5), power(1.8), power(1.2)), gaps),
    "power per component": (
        lambda: _robust(power(1.0, True), power(3.0, True), power(1.5, True), discount=0.9), AGAIN,
    ),
    "own losses": (lambda: _robust(PseudoHuber, Heavier, PseudoHuber), gaps),
    "own losses per component": (
        lambda: _robust(
            functools.partial(Heavier, threshold=0.4, per_component=True), huber(0.2),
            functools.partial(PseudoHuber, per_component=True), discount=0.95,
        ), WARM, {"max_qps": 4},
    ),
    "cauchy": (lambda: _robust(None, barron(0.0), cauchy(graduation=1.0)), gaps),
    "redescending": (
        lambda: _robust(geman(graduation=1.0), barron(-np.inf), barron(-3.0, 1.5), discount=0.95),
        WARM, {"max_qps": 4},
    ),
    "graduated": (lambda: _robust(noise=geman(per_component=True)), gaps, WARM, {"max_qps": 3}),
    "graduated, both terms": (
        lambda: _robust(huber(0.5), qpmhe.Cauchy, geman(graduation=30.0), discount=0.9), weighed,
        WARM, ONE,
    ),
    "graduated in sets": (lambda: _robust(noise=cauchy(threshold=0.8)), BOXED, WARM),
    "huber extended": (
        "inputs", lambda one: replace(_observed(ExtendedKalman), cost=RobustCost(
            prior=ObserverPrior(), disturbance=huber(1.0)(40.0 * np.eye(3)),
            noise=power(1.5)(spd(3, 2)), discount=0.95,
        )), gaps,
    ),
    "extended huber": (
        "huber", lambda one: replace(
            one, observer=_observed(ExtendedKalman).observer, cost=RobustCost(
                prior=ObserverPrior(), disturbance=10 * spd(2, 3),
                noise=huber(1.0)(np.diag([20.0, 50.0])),
            ),
        ), gaps,
    ),
}
STATES: Table = {
    "states in a box": (lambda: _reaction_in(POSITIVE),),
    "states in a box observer": ("states in a box", ALONE),
    "states in a box reinitialized": ("states in a box", AGAIN, WARM),
    "states in a box, conditions": ("states in a box", gaps, conditions),
    "states from outside": (lambda: _reaction_in(WEDGE, (-1.0, 4.5)), MANY),
    "states in a metric": ("states in a box", by(
        lambda one: Luenberger([0.8, -0.3], metric=[[2.0, 1.0], [1.0, 1.0]])
    ), gaps),
    "states in a polytope": (lambda: _reaction_in(WEDGE),),
    "states in a polytope with gaps": ("states in a polytope", gaps, AGAIN),
    "states, conditions reinitialized": ("states in a polytope", AGAIN, WARM, conditions),
    "states in both": (lambda: _reaction_in(
        Box([0.0, 0.0], [np.inf, 4.0]) & Polytope([[1.0, 1.0]], [4.2]), noises=Box([-0.15], [0.2])
    ),),
    "states, conditions observer": ("states in both", ALONE, conditions),
    # Bounds that a solution touches with a multiplier near zero: the solvers end apart.
    "states, disturbances and noises": (lambda: _reaction_in(
        POSITIVE, disturbances=Box([-0.05, -0.05], [0.05, 0.05]), noises=Box([-0.15], [np.inf])
    ), looser),
    # The window never is full of such samples, about which there is a warning.
    "states not projected": (
        "states in a polytope", {"project_observer": False, "horizon": STEPS + 1},
    ),
    "states not projected, kept": (
        "states in a polytope", {"project_observer": False, "infeasible": "keep_candidate"},
    ),
    "states not projected, conditions": ("states not projected", conditions),
    "extended in states": (lambda: _kalman_in(POSITIVE, ExtendedKalman), ONE),
    "extended in states observer": (lambda: _kalman_in(WEDGE, ExtendedKalman), gaps, ALONE),
    "extended singular in states": (
        lambda: _kalman_in(WEDGE, ExtendedKalman, np.eye(2), **FLAT), SMOOTH,
    ),
    "unscented in states": (lambda: _kalman_in(POSITIVE, UnscentedKalman, np.eye(2)), gaps),
    "unscented in states observer": (lambda: _kalman_in(WEDGE, UnscentedKalman), ALONE, AGAIN),
    "steady in states": (lambda: _kalman_in(WEDGE, SteadyStateKalman, np.eye(2)), gaps),
    "steady in states observer": ("steady in states", ALONE),
}
EQUATIONS: Table = {
    "noise-free": (
        lambda: _inputs_in(disturbances=Box([-0.05, 0.01, -0.05], [0.05, 0.01, 0.05])),
    ),
    "noise-free with gaps": ("noise-free", gaps),
    "noise-free reinitialized": ("noise-free", AGAIN, MANY),
    "no disturbances": (lambda: _inputs_in(disturbances=Box([0.0] * 3, [0.0] * 3)),),
    "a known noise": (lambda: _inputs_in(noises=Box([0.1, -3.0], [0.1, 3.0])),),
    "equations of disturbances": (lambda: _inputs_in(disturbances=ConvexSet(
        np.full(3, -np.inf), np.full(3, np.inf), np.array([[1.0, 1.0, -1.0]]), np.zeros(1),
        np.zeros(1),
    )),),
    "a known state": (
        lambda: _inputs_in(states=Box([-2.0, 0.2, -2.0], [2.0, 0.2, 2.0])), gaps,
    ),
    "states in a plane": (
        lambda: _inputs_in(states=Polytope([[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]], [0.5, -0.5])),
    ),
    "noise-free in states": (lambda: _inputs_in(
        states=Box([0.0, -0.2, -2.0], [0.6, 0.4, 2.0]),
        disturbances=Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]),
    ),),
    "noise-free conditions": ("noise-free in states", conditions),
}
CONDITIONS: Table = {
    # Bounds on one side and on both, and an observer that leaves them.
    "inputs and states": (
        lambda: _inputs_in(states=Box([0.0, -np.inf, -0.2], [0.6, 0.4, np.inf])),
        by(lambda one: Luenberger([[0.6, 0.0], [0.3, -0.4], [0.1, 0.7]])),
    ),
    "inputs and states with gaps": ("inputs and states", gaps),
    "inputs and states reinitialized": ("inputs and states", AGAIN, ONE),
    "states, conditions": ("inputs and states", conditions, MANY),
    "conditions of one sample": ("inputs and states", conditions, {"horizon": 1}),
    "states and covariance, conditions": (
        "inputs and states", by(lambda one: _observed(ExtendedKalman).observer), conditions,
    ),
    "states and sigma points, conditions": (
        "inputs and states", by(lambda one: _observed(UnscentedKalman).observer), AGAIN, conditions,
    ),
    "narrow conditions": ("inputs", NARROW, conditions),
    "narrow, reinitialized": ("inputs", NARROW, AGAIN, conditions),
    "tank": (_tank,),
    "tank conditions": ("tank", conditions),
    "tank observer": ("tank", gaps, conditions, ALONE),
    "tank kept": ("tank", conditions, {"infeasible": "keep_candidate"}, WARM),
    "tank in time": ("tank conditions", {"time_budget": 1e6}),
}
OBSERVERS: Table = {
    "smoothed": ("inputs", SMOOTH, {"horizon": 4}),
    "smoothed with gaps": ("smoothed", gaps, AGAIN),
    "smoothed changes": ("smoothed", with_changes),
    "extended": (lambda: _observed(ExtendedKalman, spd(1, 3)), weighed),
    "extended observer": ("extended", gaps, ALONE),
    "extended prior": (lambda: _observed(ExtendedKalman), gaps, weighed),
    "extended prior smoothed": ("extended prior", SMOOTH, WARM, {"delay": 1}),
    "extended prior reinitialized": ("extended prior", AGAIN, {"horizon": 2}),
    "extended prior bounded": (lambda: _observed(ExtendedKalman, ObserverPrior(0.8, 6.0)), gaps),
    "extended prior loosely bounded": (
        lambda: _observed(ExtendedKalman, ObserverPrior(1e-6, 1e9)),
    ),
    # Some covariances are then singular up to rounding, and the weights as large as can be.
    "extended singular": (lambda: _observed(ExtendedKalman, **SINGULAR), looser),
    "extended irregular": ("reactor", lambda one: own_weight(one, ExtendedKalman(
        prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]]
    )), gaps),
    "extended irregular reinitialized": ("extended irregular", AGAIN, WARM),
    "extended conditions": ("extended prior", conditions),
    "extended conditions reinitialized": ("extended irregular", conditions, AGAIN, WARM),
    "unscented": (lambda: _observed(UnscentedKalman, spd(1, 3)), weighed),
    "unscented prior": (lambda: _observed(UnscentedKalman), gaps, weighed),
    "unscented prior reinitialized": ("unscented prior", AGAIN, ONE, conditions),
    "unscented observer": ("unscented", gaps, ALONE),
    "unscented irregular": ("extended irregular", by(lambda one: UnscentedKalman(
        prior=0.01 * np.eye(2), disturbance=0.001 * np.eye(2), noise=[[0.01]], spread=1.2
    ))),
    # A covariance that is singular up to rounding has a root only up to that.
    "unscented singular": (lambda: _observed(UnscentedKalman, spd(1, 3), **SINGULAR), looser),
    "steady prior": (_steady,),
    "steady prior with gaps": (_steady, gaps, weighed),
    "steady conditions": (_steady, gaps, conditions),
}
INNOVATIONS: Table = {
    "gated": ("inputs", doubtful(Gate(reopen=3))),
    "gated prior": (lambda: _observed(ExtendedKalman), doubtful(Gate(0.95, reopen=2)), gaps),
    "gated group": (
        lambda: _observed(ExtendedKalman), doubtful(Gate(reopen=2, groups=[[1, 0]])), gaps,
        conditions,
    ),
    "gated reinitialized": (
        lambda: _observed(ExtendedKalman), doubtful(Gate(reopen=1)), gaps, conditions, AGAIN, WARM,
    ),
    "gated observer": ("gated prior", ALONE, {"horizon": 1}),
    "gated in states": ("inputs and states", doubtful(Gate(reopen=2)), gaps),
    "gated angles": (_rover, doubtful(Gate(reopen=2)), gaps),
    "gated singular": ("inputs", doubtful(
        Gate(reopen=2), prior=np.diag([1e-4, 0.0, 1e-4]), disturbance=np.diag([0.002, 0.0, 0.0])
    ), looser),
    "weighted": ("inputs", doubtful(HuberInnovation(reopen=2))),
    "weighted prior": (
        lambda: _observed(ExtendedKalman), doubtful(HuberInnovation(0.7, reopen=1)), gaps,
        conditions,
    ),
    "weighted smoothed": (
        lambda: _observed(ExtendedKalman), doubtful(HuberInnovation()), SMOOTH, {"delay": 1},
    ),
    "unscented gated": (
        lambda: _observed(UnscentedKalman), doubtful(Gate(reopen=2), UnscentedKalman), gaps,
    ),
    "unscented gated in states": (
        "inputs and states", doubtful(Gate(reopen=2, groups=[[0, 1]]), UnscentedKalman), gaps,
        conditions,
    ),
    "unscented weighted": (
        lambda: _observed(UnscentedKalman), doubtful(HuberInnovation(reopen=2), UnscentedKalman),
        gaps, conditions,
    ),
}
INJECTIONS: Table = {
    "injection": ("inputs", by(lambda one: qpmhe.OutputInjection(_saturated)), gaps),
    "injection reinitialized": ("injection", with_conditions, AGAIN, WARM, with_changes),
    "injection in sets": ("inputs and states", by(
        lambda one: qpmhe.OutputInjection(lambda z, v: 2.0 * _saturated(z, v))
    )),
}
FAILING: Table = {
    "failing inputs": (_starved,),
    "power failing": (
        lambda: _failing(1.8), lambda one: replace(
            one, observer=Luenberger([[0.5], [0.3]]), cost=RobustCost(
                prior=power(1.5)(10.0 * np.eye(2)), disturbance=power(1.2)(100.0 * np.eye(2)),
                noise=power(1.5)([[100.0]]),
            ),
        ),
    ),
    "extended failing": (_failing,),
    "extended failing reinitialized": (_failing, AGAIN),
    "unscented failing": (lambda: _failing(make=UnscentedKalman),),
    # Without QPs, as the observer is far from their estimates, of which there is a warning.
    "gated failing": (_failing, doubtful(Gate(reopen=2)), ALONE),
    "injection failing": (_failing, lambda one: own_weight(one, qpmhe.OutputInjection(
        lambda z, v: np.array([0.4 * v[0] / np.sqrt(z[0]), 0.0])
    ), np.eye(2))),
}
#: Of each, there is a case in every sample.
FEATURES = {
    "usual": USUAL, "angles": ANGLES, "directions": DIRECTIONS, "held": HELD,
    "many_states": MANY_STATES, "losses": LOSSES, "states": STATES, "equations": EQUATIONS,
    "conditions": CONDITIONS, "observers": OBSERVERS, "innovations": INNOVATIONS,
    "injections": INJECTIONS, "failing": FAILING,
}
CASES = {name: made for table in FEATURES.values() for name, made in table.items()}

#: In which rounding decides on trajectories, so that nothing but the promise holds.
ROUNDED: Table = {
    "failed stage": (_underflowing,),
    "more outputs than states": (
        lambda: _plain(
            lambda x: 0.9 * x + 0.2 * ca.sin(x),
            lambda x: ca.vertcat(*(ca.sin((1 + i) * x) + 0.3 * x**2 for i in range(3))), 1, 3,
            noises=Box([-0.12] * 3, [0.12] * 3),
        ), MANY, {"solver_tolerance": 1e-10},
    ),
}


@functools.cache
def case(name: str) -> Case:
    """The case of this name."""
    base, *changes = (CASES | ROUNDED)[name]
    one: Case = case(base) if isinstance(base, str) else base()
    for change in changes:
        one = one.with_options(**change) if isinstance(change, dict) else change(one)
    return one
