"""Estimators with every feature of the step, each with a record: one table for all tests of C."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import qpmhe
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.models.batch_reactor import casadi_output as reactor_output
from qpmhe.models.batch_reactor import casadi_rate as reactor_rate

from .conditions import with_changes, with_conditions, with_parameters

STEPS = 24


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
    start: np.ndarray
    samples: tuple[dict[str, Any], ...]
    options: dict[str, Any] = field(default_factory=lambda: {"horizon": 5, "max_qps": 2})
    tolerance: float = 1e-9
    changes: dict[int, dict[str, Any]] = field(default_factory=dict)

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

    def with_gaps(self) -> Case:
        """The case with missing components, missing samples and, of an ODE, other steps."""
        samples = []
        for t, sample in enumerate(self.samples):
            y = np.array(sample["y"], float)
            if t % 5 == 3:
                y[t % y.size] = np.nan
            if t % 11 == 7:
                y[:] = np.nan
            own = {"dt": 0.7 * self.system.dt} if self.system.dt and t % 6 == 4 else {}
            samples.append(sample | {"y": y} | own)
        return replace(self, samples=tuple(samples))


def recorded(
    system: qpmhe.System, start: Any, *, seed: int = 3, disturbance: float = 0.02,
    noise: float = 0.1, steps: int = STEPS,
) -> tuple[dict[str, Any], ...]:
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


def reactor(method: str = "rk4", **options: Any) -> qpmhe.System:
    """The paper's batch reactor in CasADi's language, evaluated by its virtual machine."""
    return qpmhe.from_casadi(
        reactor_rate, reactor_output, n=2, dt=0.1, method=method, compiled=False, **options
    )


def with_inputs(**options: Any) -> qpmhe.System:
    """Three states, two outputs, two inputs: f and h both take the inputs."""
    import casadi

    def f(x, u):
        return [0.9 * x[0] + 0.2 * casadi.sin(x[1]) + 0.1 * u[0],
                0.8 * x[1] - 0.1 * x[0] ** 2 + 0.1 * u[0] * u[1],
                0.7 * x[2] + 0.2 * x[0] * casadi.cos(x[1])]

    return qpmhe.from_casadi(
        f, lambda x, u: [x[0] + 0.3 * u[1] * x[1], x[2] + 0.1 * x[1] ** 2], n=3, m=2,
        compiled=False, **options,
    )


def _reactor() -> Case:
    _, observer, cost, scenario = batch_reactor("rk4")
    samples = tuple({"y": y} for y in scenario.simulate(1, STEPS).measurements)
    return Case(reactor(), observer, cost, np.array(scenario.initial_estimate), samples)


def _with_inputs() -> Case:
    system = with_inputs()
    cost = qpmhe.QuadraticCost(
        prior=spd(1, system.n), disturbance=10 * spd(2, system.n), noise=spd(3, system.p),
        discount=0.95,
    )
    start = np.array([0.5, 0.5, 0.2])
    gain = [[0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]
    return Case(system, qpmhe.Luenberger(gain), cost, start, recorded(system, start))


def _many_states(dense: bool) -> Case:
    """So many states that LAPACK factorises: neighbours in a row, or all in touch with all."""
    import casadi

    n, p = 42, 6
    generator = np.random.default_rng(5)
    mixing = generator.standard_normal((n, n)) / n**0.5
    outputs = generator.standard_normal((p, n)) / n**0.5

    def chain(x: Any) -> Any:
        return -0.5 * x + casadi.sin(casadi.vertcat(x[1:], x[0]))

    def mixed(x: Any) -> Any:
        return 0.9 * casadi.sin(casadi.mtimes(casadi.DM(mixing), x))

    system = qpmhe.from_casadi(
        mixed if dense else chain, lambda x: casadi.mtimes(casadi.DM(outputs), x), n=n,
        dt=None if dense else 0.1, compiled=False,
    )
    weight = spd(6, n) / n if dense else np.diag(generator.uniform(20.0, 50.0, n))
    cost = qpmhe.QuadraticCost(prior=np.eye(n), disturbance=weight, noise=40 * spd(7, p) / p)
    start = generator.standard_normal(n)
    observer = qpmhe.Luenberger(0.05 * outputs.T)
    return Case(
        system, observer, cost, start, recorded(system, start, steps=9),
        {"horizon": 4, "max_qps": 3},
    )


def with_outliers(one: Case, share: float = 0.2, size: float = 3.0) -> Case:
    """The case with a large error in some of its measurements."""
    generator = np.random.default_rng(9)
    samples = tuple(
        sample | {"y": sample["y"] + size * (generator.random(len(sample["y"])) < share)}
        for sample in one.samples
    )
    return replace(one, samples=samples)


def _robust(prior: Any = None, disturbance: Any = None, noise: Any = None, **options: Any) -> Case:
    """The case with inputs, diagonal weights, outliers, and these losses of the weights."""
    usual = case("inputs")
    weights = {
        "prior": (prior, [2.0, 1.0, 3.0]), "disturbance": (disturbance, [40.0, 20.0, 30.0]),
        "noise": (noise, [20.0, 50.0]),
    }
    terms = {
        name: np.diag(diagonal) if loss is None else loss(np.diag(diagonal))
        for name, (loss, diagonal) in weights.items()
    }
    return with_outliers(replace(usual, cost=qpmhe.RobustCost(**terms, **options)))


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


def _weighed(one: Case) -> Case:
    """The case with another noise weight at some samples."""
    p = one.system.p
    samples = tuple(
        sample | ({"noise_weight": np.diag(np.arange(3.0, 3.0 + p))} if t % 4 == 1 else {})
        for t, sample in enumerate(one.samples)
    )
    return replace(one, samples=samples)


def _boxed(one: Case, **options: Any) -> Case:
    """The case with sets of disturbances and noises, solved to convergence."""
    sets = {
        "disturbances": qpmhe.Box([-0.1] * 3, [0.1, 0.2, 0.1])
        & qpmhe.Polytope([[1.0, 1.0, -1.0]], [0.12]),
        "noises": qpmhe.Box([-3.2] * 2, [3.2] * 2),
    }
    changed = replace(one, system=with_inputs(**sets))
    return changed.with_options(max_qps=None, solver_tolerance=1e-9, **options)


def _narrow(one: Case, **options: Any) -> Case:
    """The case with sets that bind, solved to convergence."""
    sets = {
        "disturbances": qpmhe.Box([-0.05] * 3, [0.05] * 3)
        & qpmhe.Polytope([[1.0, 1.0, -1.0]], [0.06]),
        "noises": qpmhe.Box([-0.3, -0.4], [0.3, 0.4]),
    }
    changed = replace(one, system=with_inputs(**sets))
    return changed.with_options(max_qps=None, solver_tolerance=1e-9, **options)


def reaction(**options: Any) -> qpmhe.System:
    """2A -> B in pressures, of which the sum is measured; runs away from negative ones."""

    def f(x):
        rate = 0.016 * x[0] ** 2
        return [x[0] - 2.0 * rate, x[1] + rate]

    return qpmhe.from_casadi(f, lambda x: [x[0] + x[1]], n=2, compiled=False, **options)


def _in_states(states: qpmhe.model.sets.ConvexSet, start: Any = (0.1, 4.5), **sets: Any) -> Case:
    """The reaction in a set of states, which its observer leaves."""
    system, cost = reaction(states=states, **sets), qpmhe.QuadraticCost(
        prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)
    )
    samples = recorded(system, [3.0, 1.0], disturbance=0.0)
    options = {"horizon": 5, "max_qps": 2, "solver_tolerance": 1e-12}
    observer = qpmhe.Luenberger([0.8, -0.3])
    return Case(system, observer, cost, np.array(start), samples, options)


def _kalman_in_states(
    make: Callable[..., qpmhe.Observer], states: qpmhe.model.sets.ConvexSet, weight: Any = None,
    **options: Any,
) -> Case:
    """The reaction in a set of states, and an observer with a covariance."""
    one = _in_states(states)
    if make is qpmhe.SteadyStateKalman:
        observer = make(one.system, [2.0, 1.5], disturbance=0.1 * np.eye(2), noise=[[0.01]])
    else:
        covariances = {"prior": 36.0 * np.eye(2), "disturbance": 1e-3 * np.eye(2)} | options
        observer = make(**covariances, noise=[[0.01]])
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior() if weight is None else weight, disturbance=1e3 * np.eye(2),
        noise=[[100.0]],
    )
    return replace(one, observer=observer, cost=cost)


def _inputs_in(**sets: Any) -> Case:
    """The case with inputs in sets."""
    one = replace(case("inputs"), system=with_inputs(**sets))
    return one.with_options(solver_tolerance=1e-12)


def _inputs_in_states() -> Case:
    """Bounds on one side and on both, and an observer that leaves them."""
    states = qpmhe.Box([0.0, -np.inf, -0.2], [0.6, 0.4, np.inf])
    observer = qpmhe.Luenberger([[0.6, 0.0], [0.3, -0.4], [0.1, 0.7]])
    return replace(_inputs_in(states=states), observer=observer)


POSITIVE = qpmhe.Box([0.0, 0.0], [np.inf, np.inf])
WEDGE = qpmhe.Polytope([[-1.0, 0.1], [0.1, -1.0], [1.0, 1.0]], [0.0, 0.0, 4.2])


def _huber(threshold: float, per_component: bool = False) -> Callable[[Any], qpmhe.Huber]:
    return functools.partial(qpmhe.Huber, threshold=threshold, per_component=per_component)


def _barron(shape: float, threshold: float = 1.0) -> Callable[[Any], qpmhe.Barron]:
    return functools.partial(qpmhe.Barron, shape=shape, threshold=threshold)


def _power(exponent: float, per_component: bool = False) -> Callable[[Any], qpmhe.Power]:
    return functools.partial(qpmhe.Power, exponent=exponent, per_component=per_component)


def _tank() -> Case:
    """A tank whose outflow's coefficient is a parameter, with two gauges and a push."""
    import casadi

    system = qpmhe.from_casadi(
        lambda x, u: [u[0] - u[1] * casadi.sqrt(casadi.fmax(x[0], 0.01)) - 0.1 * x[1],
                      0.5 * x[0] - x[1]],
        lambda x, u: [x[0], x[0] + 0.3 * x[1] ** 2], n=2, m=2, dt=0.1, compiled=False,
        noises=qpmhe.Box([-0.25, -0.4], [0.25, 0.4]),
        disturbances=qpmhe.Box([-0.15, -0.2], [0.1, 0.15]),
    )
    cost = qpmhe.QuadraticCost(prior=spd(4, 2), disturbance=2500 * spd(5, 2), noise=40 * spd(6, 2))
    start = np.array([1.0, 0.5])
    samples = tuple(
        sample | {"u": np.array([0.6 + 0.2 * np.sin(t), 0.5])}
        for t, sample in enumerate(recorded(system, start))
    )
    one = Case(system, qpmhe.Luenberger([[0.2, 0.05], [0.0, 0.1]]), cost, start, samples)
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
    outputs: bool, states: bool, functions: bool = False,
    observer: type[qpmhe.Observer] | None = None, **sets: Any,
) -> Case:
    """A turning rover with a compass that sees distance and bearing of a beacon.

    Where states have angles, f keeps the heading in one turn. Where outputs have none, they are
    smooth functions of both. The angles may be stated by functions of two vectors. An observer with
    a covariance weighs the prior.
    """
    import casadi as ca

    def f(x):
        heading = x[2] + x[3]
        if states:
            heading = ca.atan2(ca.sin(heading), ca.cos(heading))
        return ca.vertcat(x[0] + 0.3 * ca.cos(x[2]), x[1] + 0.3 * ca.sin(x[2]), heading, x[3])

    def h(x):
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
    weighs = {} if observer is None else {"prior": qpmhe.ObserverPrior()}
    cost = qpmhe.QuadraticCost.from_covariances(**(covariances | weighs))
    generator, x, samples = np.random.default_rng(4), np.array([0.3, -0.2, 0.5, 1.7]), []
    for _ in range(3 * STEPS):
        y = system.h(x, np.zeros(0)) + generator.normal(0.0, deviations["noise"])
        if outputs:  # measured within one turn
            y = system.output_residual(y, np.zeros(3))
        samples.append({"y": y})
        x = system.f(x, np.zeros(0)) + generator.normal(0.0, deviations["disturbance"])
    turning = [[0.0, -0.2 / unit, 0.4], [0.0, 0.0, 0.1]] if outputs else np.zeros((2, 3))
    gain = [[0.2, 0.0, 0.0], [0.0, 0.0, 0.0], *turning]
    start = np.array([0.0, 0.0, 0.9, 1.6])
    filters = qpmhe.Luenberger(gain) if observer is None else observer(**covariances)
    return Case(
        system, filters, cost, start, tuple(samples), {"horizon": 6, "max_qps": 3}
    )


def _observed(make: Callable[..., qpmhe.Observer], weight: Any = None, **options: Any) -> Case:
    """The system with inputs, and an observer with a covariance.

    ``weight`` is the prior's, left out for the observer's own; options replace covariances.
    """
    base = _with_inputs()
    covariances = {
        "prior": spd(4, 3), "disturbance": 0.05 * spd(5, 3), "noise": 0.05 * spd(6, 2)
    } | options
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior() if weight is None else weight,
        disturbance=base.cost.disturbance, noise=base.cost.noise, discount=base.cost.discount,
    )
    return replace(base, observer=make(**covariances), cost=cost)


def _doubtful(
    base: Case, innovation: Any, make: Any = qpmhe.ExtendedKalman, **options: Any
) -> Case:
    """The case with outliers, a fault that lasts, and an observer that judges innovations."""
    generator, samples = np.random.default_rng(17), []
    n, p = base.system.n, base.system.p
    scale = np.std([np.array(sample["y"], float) for sample in base.samples], axis=0)
    for t, sample in enumerate(base.samples):
        y = np.array(sample["y"], float)
        y += (generator.random(p) < 0.15) * generator.choice([-1.0, 1.0], p) * 10.0 * scale
        y[0] += 8.0 * scale[0] * (9 <= t < 16)
        samples.append(sample | {"y": y})
    covariances = {
        "prior": 0.01 * spd(4, n), "disturbance": 0.002 * spd(5, base.system.r),
        "noise": 0.01 * spd(6, p),
    } | options
    observer = make(innovation=innovation, **covariances)
    return replace(base, observer=observer, samples=tuple(samples))


def _reactor_extended() -> Case:
    base = _reactor()
    observer = qpmhe.ExtendedKalman(
        prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]]
    )
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=base.cost.disturbance, noise=base.cost.noise
    )
    return replace(base, observer=observer, cost=cost)


def _steady() -> Case:
    base = _with_inputs()
    observer = qpmhe.SteadyStateKalman(
        base.system, base.start, [0.3, 0.2], disturbance=0.05 * spd(5, 3), noise=0.05 * spd(6, 2),
        prior=spd(4, 3),
    )
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(0.5, 20.0), disturbance=base.cost.disturbance,
        noise=base.cost.noise,
    )
    return replace(base, observer=observer, cost=cost)


def _filtered(make: Callable[..., qpmhe.Observer], one: Case) -> Case:
    """The case with a filter of the cost's covariances, which weighs the prior."""
    weights = {name: getattr(one.cost, name) for name in ("prior", "disturbance", "noise")}
    observer = make(**{name: np.linalg.inv(weight) for name, weight in weights.items()})
    cost = qpmhe.QuadraticCost(**weights | {"prior": qpmhe.ObserverPrior()})
    return replace(one, observer=observer, cost=cost)


def _saturated(z: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A correction that large errors cannot drive far, and that depends on the state."""
    bounded = np.tanh(v)
    return np.array([[0.3, 0.0], [0.1, 0.05], [0.0, 0.3]]) @ bounded * (1.0 + 0.2 * np.cos(z))


def _failing(error: float = 12.0) -> Case:
    """A model that is not defined below zero, where errors lead the observer at times."""
    import casadi

    system = qpmhe.from_casadi(
        lambda x: [x[0] - 0.1 * casadi.sqrt(x[0]) + 0.05 * x[1], 0.9 * x[1] + 0.1],
        lambda x: [x[0] + 0.1 * casadi.sqrt(x[1])], n=2, compiled=False,
    )
    start, options = np.array([1.0, 1.0]), {"disturbance": 0.01, "noise": 0.02}
    samples = list(recorded(system, start, **options))
    for t in (6, 7, 15):
        samples[t] = {"y": samples[t]["y"] - error}
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=100.0 * np.eye(2), noise=[[100.0]]
    )
    observer = qpmhe.ExtendedKalman(
        prior=0.1 * np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]]
    )
    return Case(system, observer, cost, start, tuple(samples))


def _compass(functions: bool = False) -> Case:
    """A ship whose heading, in degrees, is bounded across the seam."""
    import casadi as ca

    def wrapped(angle):
        return angle - 360.0 * ca.floor(angle / 360.0 + 0.5)

    def turned(a, b):
        d = a - b
        return np.stack(((d[..., 0] + 180.0) % 360.0 - 180.0, d[..., 1]), axis=-1)

    angle = turned if functions else qpmhe.angles([0], 360.0)
    system = qpmhe.from_casadi(
        lambda x: ca.vertcat(wrapped(x[0] + x[1]), 0.8 * x[1] - 0.1 * ca.sin(x[0] * ca.pi / 45)),
        lambda x: ca.vertcat(wrapped(x[0]), x[1] ** 2), n=2, compiled=False,
        states=qpmhe.Box([175.0, -4.0], [185.0, 2.0]), output_residual=angle, state_residual=angle,
    )
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.diag([9.0, 1.0]), disturbance=np.diag([0.5, 0.5]), noise=np.diag([16.0, 4.0])
    )
    generator, x, samples = np.random.default_rng(11), np.array([178.0, 1.0]), []
    for _ in range(4 * STEPS):
        y = system.h(x, np.zeros(0)) + generator.normal(0.0, [4.0, 1.0])
        samples.append({"y": np.array([wrapped(y[0]), y[1]])})
        x = system.f(x, np.zeros(0)) + generator.normal(0.0, [0.7, 0.7])
        x = np.clip([x[0] % 360.0, x[1]], [175.0, -4.0], [185.0, 2.0])
    gain = [[0.5, 0.0], [0.1, 0.0]]
    return Case(
        system, qpmhe.Luenberger(gain), cost, np.array([-179.0, 0.0]), tuple(samples),
        {"horizon": 5, "max_qps": None},
    )


def _fewer(gain: Any = None, **options: Any) -> Case:
    """The system with inputs, with two disturbances on its three states; G is dense."""
    matrix = np.array([[1.0, 0.2], [0.5, -1.0], [0.3, 0.8]])
    system = with_inputs(disturbance_matrix=matrix, **options)
    cost = qpmhe.QuadraticCost(prior=spd(1, 3), disturbance=10 * spd(2, 2), noise=spd(3, 2))
    start = np.array([0.5, 0.5, 0.2])
    # Corrections within the range of G, where no other gain is given.
    gain = matrix @ [[0.2, 0.05], [-0.05, 0.2]] if gain is None else gain
    samples = recorded(with_inputs(), start)
    return Case(system, qpmhe.Luenberger(gain), cost, start, samples).with_options(
        solver_tolerance=1e-10
    )


def _fewer_extended() -> Case:
    """An extended Kalman filter whose covariance weighs the prior, for two disturbances."""
    one = _fewer()
    observer = qpmhe.ExtendedKalman(
        prior=0.3 * np.eye(3), disturbance=0.05 * spd(2, 2), noise=0.05 * np.eye(2)
    )
    cost = qpmhe.QuadraticCost(
        prior=qpmhe.ObserverPrior(), disturbance=one.cost.disturbance, noise=one.cost.noise
    )
    return replace(one, observer=observer, cost=cost)


def _singular() -> Case:
    """A covariance of the disturbance of rank one."""
    one = case("inputs")
    direction = np.array([1.0, -0.5, 2.0])
    cost = qpmhe.QuadraticCost.from_covariances(
        prior=np.linalg.inv(spd(1, 3)), disturbance=0.05 * np.outer(direction, direction),
        noise=np.linalg.inv(spd(3, 2)),
    )
    return replace(one, cost=cost).with_options(solver_tolerance=1e-10, max_qps=3)


def _with_own_w(one: Case) -> Case:
    """The case with weights and sides of the disturbance at some samples."""
    samples = list(one.samples)
    for t in range(3, len(samples), 4):
        samples[t] = samples[t] | {"disturbance_weight": 5.0 * spd(t, 2)}
    if one.system.disturbances is not None:
        for t in range(5, len(samples), 6):
            narrow = {"disturbances": qpmhe.Box([-0.02, -0.03], [0.02, 0.02])}
            samples[t] = samples[t] | {"bounds": narrow}
    return replace(one, samples=tuple(samples))


def _held(
    hold: Any = 0.2, drifting: bool = True, observer: Any = None, cost: Any = None,
    bounds: Any = None, **options: Any,
) -> Case:
    """Two unknown parameters, which are seen only while the input acts."""
    import casadi

    system = qpmhe.from_casadi(
        lambda x, u: [0.8 * x[0] + 0.2 * u[1] * u[0] + 0.05 * x[1],
                      0.7 * x[1] + 0.3 * u[2] * casadi.sin(x[0])],
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
    one = Case(
        augmented, qpmhe.Luenberger(gain), qpmhe.QuadraticCost(**weights),
        np.append([0.0, 0.0], nominal), tuple(samples), {"horizon": 6, "max_qps": 2},
    )
    if cost is not None:
        one = replace(one, cost=cost(weights))
    return one if observer is None else _filtered(observer, one)


OTHER_GAIN = [[0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]

#: Each is made when it is asked for; `case` keeps it.
CASES: dict[str, Callable[[], Case]] = {
    "reactor": _reactor,
    "reactor with gaps": lambda: case("reactor").with_gaps(),
    "reactor reinitialized": lambda: case("reactor").with_options(
        candidate="reinitialized", warm_start=True
    ),
    "inputs": _with_inputs,
    "inputs with gaps": lambda: case("inputs").with_gaps(),
    "inputs converged": lambda: case("inputs").with_options(max_qps=None, delay=2),
    "inputs observer": lambda: case("inputs").with_options(max_qps=0),
    "angles of outputs": lambda: _rover(True, False).with_options(warm_start=True),
    "angles of states": lambda: _rover(False, True).with_gaps().with_options(
        candidate="reinitialized"
    ),
    "angles of both": lambda: _rover(True, True).with_gaps(),
    "residual functions": lambda: _rover(True, True, True).with_gaps().with_options(
        warm_start=True
    ),
    "angles extended": lambda: _rover(True, True, observer=qpmhe.ExtendedKalman).with_gaps(),
    "angles smoothed": lambda: _rover(
        True, True, observer=qpmhe.ExtendedKalman
    ).with_options(arrival="smoothed"),
    "functions unscented": lambda: _rover(
        True, True, True, observer=qpmhe.UnscentedKalman
    ).with_gaps().with_options(arrival="smoothed", warm_start=True),
    "angles across the seam": lambda: _compass(),
    "functions across the seam": lambda: _compass(True).with_gaps().with_options(
        candidate="reinitialized", warm_start=True
    ),
    "angles in curved sets": lambda: _rover(
        True, True, disturbances=qpmhe.Box([-0.4, -0.4, -0.03, -0.02], [0.4, 0.4, 0.03, 0.02]),
        noises=qpmhe.Box([-0.2, -25.0, -0.25], [0.2, 25.0, 0.25]),
    ).with_options(max_qps=None),
    "angles in sets": lambda: _rover(
        True, True,
        disturbances=qpmhe.Box([-0.4, -0.4, -0.03, -0.02], [0.4, 0.4, 0.03, 0.02]),
        noises=qpmhe.Polytope([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]], [20.0, 0.2]),
    ).with_options(max_qps=None),
    "fewer disturbances": lambda: _fewer(),
    "fewer disturbances observer": lambda: _fewer().with_options(max_qps=0),
    "fewer disturbances out of range": lambda: _fewer(OTHER_GAIN).with_gaps().with_options(
        warm_start=True
    ),
    "fewer disturbances in sets": lambda: _fewer(
        OTHER_GAIN, disturbances=qpmhe.Box([-0.05, -0.08], [0.1, 0.06]),
        noises=qpmhe.Box([-0.4, -0.4], [0.4, 0.4]),
    ).with_options(max_qps=None),
    "fewer disturbances reinitialized": lambda: _with_own_w(_fewer(
        OTHER_GAIN, disturbances=qpmhe.Box([-0.05, -0.08], [0.1, 0.06]),
    )).with_options(candidate="reinitialized", max_qps=None),
    "fewer disturbances extended": lambda: _with_own_w(_fewer_extended().with_gaps()),
    "one fixed of two disturbances": lambda: _fewer(
        OTHER_GAIN, disturbances=qpmhe.Box([0.01, -np.inf], [0.01, np.inf])
    ).with_options(max_qps=None),
    "singular covariance": lambda: _singular().with_gaps(),
    "held": lambda: _held(),
    "held with gaps": lambda: with_changes(case("held").with_gaps()),
    "held observer": lambda: case("held").with_options(max_qps=0),
    "held constants": lambda: _held([0.3, 0.1], drifting=False),
    "held, one of two": lambda: _held(
        {1: 0.1}, observer=qpmhe.ExtendedKalman
    ).with_options(arrival="smoothed"),
    "held in sets": lambda: _held(
        {1: 0.1, 0: 0.4}, bounds=qpmhe.Box([0.9, 0.2], [1.2, 0.6]),
        noises=qpmhe.Box([-0.2, -0.3], [0.2, 0.3]),
    ).with_options(warm_start=True, solver_tolerance=1e-10),
    "held, fewer disturbances": lambda: _held(
        observer=qpmhe.UnscentedKalman, disturbance_matrix=[[1.0], [0.5]]
    ).with_gaps(),
    "held reinitialized": lambda: with_conditions(case("held")).with_options(
        candidate="reinitialized", max_qps=None
    ),
    "held, graduated": lambda: with_outliers(_held(cost=lambda weights: qpmhe.RobustCost(
        prior=_huber(0.5)(weights["prior"]), disturbance=weights["disturbance"],
        noise=qpmhe.GemanMcClure(weights["noise"], per_component=True), discount=0.9,
    ))).with_options(warm_start=True),
    "many states": lambda: _many_states(False),
    "many states, dense": lambda: _many_states(True),
    "many states with gaps": lambda: case("many states").with_gaps(),
    "huber": lambda: _robust(noise=_huber(1.345)),
    "huber with gaps": lambda: _weighed(case("huber").with_gaps()),
    "huber in sets": lambda: _boxed(case("huber")),
    "losses in sets": lambda: _boxed(case("mixed losses")),
    "huber everywhere": lambda: _robust(
        _huber(0.5), _huber(0.3), _huber(1.0), discount=0.9
    ).with_options(warm_start=True),
    "huber per component": lambda: _robust(
        _huber(0.5, True), _huber(0.3, True), _huber(1.0, True)
    ).with_gaps(),
    "power": lambda: _robust(_power(1.5), _power(1.8), _power(1.2)).with_gaps(),
    "power per component": lambda: _robust(
        _power(1.0, True), _power(3.0, True), _power(1.5, True), discount=0.9
    ).with_options(candidate="reinitialized"),
    "states in a box": lambda: _in_states(POSITIVE),
    "states in a box observer": lambda: case("states in a box").with_options(max_qps=0),
    "states in a box reinitialized": lambda: case("states in a box").with_options(
        candidate="reinitialized", warm_start=True
    ),
    "states from outside": lambda: _in_states(WEDGE, (-1.0, 4.5)).with_options(max_qps=None),
    "states in a metric": lambda: replace(
        case("states in a box"),
        observer=qpmhe.Luenberger([0.8, -0.3], metric=[[2.0, 1.0], [1.0, 1.0]]),
    ).with_gaps(),
    "states in a polytope": lambda: _in_states(WEDGE),
    "states in a polytope with gaps": lambda: case("states in a polytope").with_gaps().with_options(
        candidate="reinitialized"
    ),
    "extended in states": lambda: _kalman_in_states(qpmhe.ExtendedKalman, POSITIVE).with_options(
        max_qps=1
    ),
    "extended in states observer": lambda: _kalman_in_states(
        qpmhe.ExtendedKalman, WEDGE
    ).with_gaps().with_options(max_qps=0),
    "extended singular in states": lambda: _kalman_in_states(
        qpmhe.ExtendedKalman, WEDGE, np.eye(2), prior=np.diag([1.0, 0.0]),
        disturbance=np.diag([1e-3, 0.0]),
    ).with_options(arrival="smoothed"),
    "unscented in states": lambda: _kalman_in_states(
        qpmhe.UnscentedKalman, POSITIVE, np.eye(2)
    ).with_gaps(),
    "unscented in states observer": lambda: _kalman_in_states(
        qpmhe.UnscentedKalman, WEDGE
    ).with_options(max_qps=0, candidate="reinitialized"),
    "steady in states": lambda: _kalman_in_states(
        qpmhe.SteadyStateKalman, WEDGE, np.eye(2)
    ).with_gaps(),
    "steady in states observer": lambda: case("steady in states").with_options(max_qps=0),
    "unscented with angles": lambda: replace(
        _rover(True, True), observer=qpmhe.UnscentedKalman(
            prior=np.diag([0.5, 0.5, 0.4, 0.1]) ** 2,
            disturbance=np.diag([0.1, 0.1, 0.03, 0.02]) ** 2,
            noise=np.diag([0.2, 5.73, 0.1]) ** 2,
        ),
    ),
    "states in both": lambda: _in_states(
        qpmhe.Box([0.0, 0.0], [np.inf, 4.0]) & qpmhe.Polytope([[1.0, 1.0]], [4.2]),
        noises=qpmhe.Box([-0.15], [0.2]),
    ),
    # Bounds that a solution touches with a multiplier near zero: the solvers end apart.
    "states, disturbances and noises": lambda: replace(
        _in_states(
            POSITIVE, disturbances=qpmhe.Box([-0.05, -0.05], [0.05, 0.05]),
            noises=qpmhe.Box([-0.15], [np.inf]),
        ),
        tolerance=1e-7,
    ),
    # The window never is full of such samples, about which there is a warning.
    "states not projected": lambda: case("states in a polytope").with_options(
        project_observer=False, horizon=STEPS + 1
    ),
    "states not projected, kept": lambda: case("states in a polytope").with_options(
        project_observer=False, infeasible="keep_candidate"
    ),
    "noise-free": lambda: _inputs_in(
        disturbances=qpmhe.Box([-0.05, 0.01, -0.05], [0.05, 0.01, 0.05])
    ),
    "noise-free with gaps": lambda: case("noise-free").with_gaps(),
    "noise-free reinitialized": lambda: case("noise-free").with_options(
        candidate="reinitialized", max_qps=None
    ),
    "no disturbances": lambda: _inputs_in(disturbances=qpmhe.Box([0.0] * 3, [0.0] * 3)),
    "a known noise": lambda: _inputs_in(noises=qpmhe.Box([0.1, -3.0], [0.1, 3.0])),
    "equations of disturbances": lambda: _inputs_in(
        disturbances=qpmhe.model.sets.ConvexSet(
            np.full(3, -np.inf), np.full(3, np.inf), np.array([[1.0, 1.0, -1.0]]), np.zeros(1),
            np.zeros(1),
        )
    ),
    "a known state": lambda: _inputs_in(
        states=qpmhe.Box([-2.0, 0.2, -2.0], [2.0, 0.2, 2.0])
    ).with_gaps(),
    "states in a plane": lambda: _inputs_in(
        states=qpmhe.Polytope([[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]], [0.5, -0.5])
    ),
    "noise-free in states": lambda: _inputs_in(
        states=qpmhe.Box([0.0, -0.2, -2.0], [0.6, 0.4, 2.0]),
        disturbances=qpmhe.Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]),
    ),
    "inputs and states": _inputs_in_states,
    "inputs and states with gaps": lambda: case("inputs and states").with_gaps(),
    "inputs and states reinitialized": lambda: case("inputs and states").with_options(
        candidate="reinitialized", max_qps=1
    ),
    "own losses": lambda: _robust(PseudoHuber, Heavier, PseudoHuber).with_gaps(),
    "own losses per component": lambda: _robust(
        functools.partial(Heavier, threshold=0.4, per_component=True), _huber(0.2),
        functools.partial(PseudoHuber, per_component=True), discount=0.95,
    ).with_options(max_qps=4, warm_start=True),
    "cauchy": lambda: _robust(
        None, _barron(0.0), functools.partial(qpmhe.Cauchy, graduation=1.0, per_component=True)
    ).with_gaps(),
    "redescending": lambda: _robust(
        functools.partial(qpmhe.GemanMcClure, graduation=1.0), _barron(-np.inf), _barron(-3.0, 1.5),
        discount=0.95,
    ).with_options(max_qps=4, warm_start=True),
    "graduated": lambda: _robust(
        None, None, functools.partial(qpmhe.GemanMcClure, per_component=True)
    ).with_gaps().with_options(warm_start=True, max_qps=3),
    "graduated, both terms": lambda: _weighed(_robust(
        _huber(0.5), qpmhe.Cauchy, functools.partial(qpmhe.GemanMcClure, graduation=30.0),
        discount=0.9,
    )).with_options(warm_start=True, max_qps=1),
    "graduated in sets": lambda: _boxed(_robust(
        None, None, functools.partial(qpmhe.Cauchy, threshold=0.8, per_component=True)
    )).with_options(warm_start=True),
    "power failing": lambda: replace(
        _failing(1.8), observer=qpmhe.Luenberger([[0.5], [0.3]]), cost=qpmhe.RobustCost(
            prior=_power(1.5)(10.0 * np.eye(2)), disturbance=_power(1.2)(100.0 * np.eye(2)),
            noise=_power(1.5)([[100.0]]),
        ),
    ).with_options(max_qps=2),
    "huber extended": lambda: replace(
        _observed(qpmhe.ExtendedKalman), cost=qpmhe.RobustCost(
            prior=qpmhe.ObserverPrior(), disturbance=_huber(1.0)(40.0 * np.eye(3)),
            noise=_power(1.5)(spd(3, 2)), discount=0.95,
        ),
    ).with_gaps(),
    "mixed losses": lambda: _weighed(
        _robust(_huber(1.0), _power(1.5, True), _huber(2.0, True)).with_gaps()
    ).with_options(max_qps=4, candidate="reinitialized", warm_start=True),
    "reactor conditions": lambda: with_conditions(case("reactor").with_gaps()),
    "inputs conditions": lambda: with_conditions(case("inputs reinitialized")),
    "inputs reinitialized": lambda: case("inputs").with_options(
        candidate="reinitialized", warm_start=True, max_qps=1
    ),
    "inputs changes": lambda: with_changes(case("inputs")),
    "narrow conditions": lambda: with_changes(with_conditions(_narrow(case("inputs")))),
    "narrow, reinitialized": lambda: with_changes(with_conditions(
        _narrow(case("inputs"), candidate="reinitialized")
    )),
    "huber conditions": lambda: with_changes(with_conditions(case("huber per component"))),
    "tank": _tank,
    "tank conditions": lambda: with_changes(with_conditions(case("tank"))),
    "tank observer": lambda: with_changes(
        with_conditions(case("tank").with_gaps()).with_options(max_qps=0)
    ),
    "tank kept": lambda: with_changes(
        with_conditions(case("tank")).with_options(infeasible="keep_candidate", warm_start=True)
    ),
    "states, conditions": lambda: with_changes(
        with_conditions(case("inputs and states")).with_options(max_qps=None)
    ),
    "states in a box, conditions": lambda: with_changes(
        with_conditions(case("states in a box").with_gaps())
    ),
    "states, conditions observer": lambda: with_changes(
        with_conditions(case("states in both")).with_options(max_qps=0)
    ),
    "states, conditions reinitialized": lambda: with_changes(with_conditions(
        case("states in a polytope").with_options(candidate="reinitialized", warm_start=True)
    )),
    "states not projected, conditions": lambda: with_changes(with_conditions(
        case("states not projected")
    )),
    "noise-free conditions": lambda: with_changes(with_conditions(
        case("noise-free in states")
    )),
    "parameters alone": lambda: with_changes(with_conditions(
        with_parameters(case("inputs"), 0.2, -0.1)
    )),
    "angles, conditions": lambda: with_changes(with_conditions(case("angles of both"))),
    "angles across the seam, conditions": lambda: with_changes(with_conditions(
        case("angles across the seam")
    )),
    "conditions of one sample": lambda: with_changes(with_conditions(
        case("inputs and states")
    )).with_options(horizon=1),
    "states and covariance, conditions": lambda: with_changes(with_conditions(replace(
        case("inputs and states"), observer=_observed(qpmhe.ExtendedKalman).observer
    ))),
    "states and sigma points, conditions": lambda: with_changes(with_conditions(replace(
        case("inputs and states"), observer=_observed(qpmhe.UnscentedKalman).observer
    ).with_options(candidate="reinitialized"))),
    "tank in time": lambda: case("tank conditions").with_options(time_budget=1e6),
    "smoothed": lambda: case("inputs").with_options(arrival="smoothed", horizon=4),
    "smoothed with gaps": lambda: case("smoothed").with_gaps().with_options(
        candidate="reinitialized"
    ),
    "extended": lambda: _weighed(_observed(qpmhe.ExtendedKalman, spd(1, 3))),
    "extended observer": lambda: case("extended").with_gaps().with_options(max_qps=0),
    "extended prior": lambda: _weighed(_observed(qpmhe.ExtendedKalman).with_gaps()),
    "extended prior smoothed": lambda: case("extended prior").with_options(
        arrival="smoothed", warm_start=True, delay=1
    ),
    "extended prior reinitialized": lambda: case("extended prior").with_options(
        candidate="reinitialized", horizon=2
    ),
    "extended prior bounded": lambda: _observed(
        qpmhe.ExtendedKalman, qpmhe.ObserverPrior(0.8, 6.0)
    ).with_gaps(),
    "extended prior loosely bounded": lambda: _observed(
        qpmhe.ExtendedKalman, qpmhe.ObserverPrior(1e-6, 1e9)
    ),
    # Some covariances are then singular up to rounding, and the weights as large as can be.
    "extended singular": lambda: replace(_observed(
        qpmhe.ExtendedKalman, prior=np.diag([1.0, 0.0, 0.5]), disturbance=np.diag([0.02, 0.0, 0.0])
    ), tolerance=1e-7),
    "extended irregular": lambda: _reactor_extended().with_gaps(),
    "extended irregular reinitialized": lambda: case("extended irregular").with_options(
        candidate="reinitialized", warm_start=True
    ),
    "extended failing": _failing,
    "extended failing reinitialized": lambda: _failing().with_options(candidate="reinitialized"),
    "extended conditions": lambda: with_changes(with_conditions(case("extended prior"))),
    "extended conditions reinitialized": lambda: with_changes(
        with_conditions(_reactor_extended().with_gaps())
    ).with_options(candidate="reinitialized", warm_start=True),
    "steady conditions": lambda: with_changes(with_conditions(_steady().with_gaps())),
    "smoothed changes": lambda: with_changes(case("smoothed")),
    "unscented": lambda: _weighed(_observed(qpmhe.UnscentedKalman, spd(1, 3))),
    "unscented prior": lambda: _weighed(_observed(qpmhe.UnscentedKalman).with_gaps()),
    "unscented prior reinitialized": lambda: with_changes(with_conditions(
        case("unscented prior").with_options(candidate="reinitialized", max_qps=1)
    )),
    "unscented observer": lambda: case("unscented").with_gaps().with_options(max_qps=0),
    "unscented irregular": lambda: replace(
        case("extended irregular"),
        observer=qpmhe.UnscentedKalman(
            prior=0.01 * np.eye(2), disturbance=0.001 * np.eye(2), noise=[[0.01]], spread=1.2
        ),
    ),
    # A covariance that is singular up to rounding has a root only up to that.
    "unscented singular": lambda: replace(_observed(
        qpmhe.UnscentedKalman, spd(1, 3), prior=np.diag([1.0, 0.0, 0.5]),
        disturbance=np.diag([0.02, 0.0, 0.0]),
    ), tolerance=1e-7),
    "unscented failing": lambda: replace(
        _failing(), observer=qpmhe.UnscentedKalman(
            prior=0.1 * np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]]
        )
    ),
    "extended angles": lambda: _filtered(qpmhe.ExtendedKalman, _rover(True, True).with_gaps()),
    "unscented angles": lambda: _filtered(
        qpmhe.UnscentedKalman, _rover(True, True, True).with_gaps()
    ).with_options(arrival="smoothed"),
    "gated": lambda: _doubtful(_with_inputs(), qpmhe.Gate(reopen=3)),
    "gated prior": lambda: _doubtful(
        _observed(qpmhe.ExtendedKalman), qpmhe.Gate(0.95, reopen=2)
    ).with_gaps(),
    "gated group": lambda: with_changes(with_conditions(_doubtful(
        _observed(qpmhe.ExtendedKalman), qpmhe.Gate(reopen=2, groups=[[1, 0]])
    ).with_gaps())),
    "gated reinitialized": lambda: with_changes(with_conditions(_doubtful(
        _observed(qpmhe.ExtendedKalman), qpmhe.Gate(reopen=1)
    ).with_gaps())).with_options(candidate="reinitialized", warm_start=True),
    "gated observer": lambda: case("gated prior").with_options(max_qps=0, horizon=1),
    "gated in states": lambda: _doubtful(
        case("inputs and states"), qpmhe.Gate(reopen=2)
    ).with_gaps(),
    "gated angles": lambda: _doubtful(_rover(True, True), qpmhe.Gate(reopen=2)).with_gaps(),
    # Without QPs, as the observer is far from their estimates, of which there is a warning.
    "gated failing": lambda: _doubtful(_failing(), qpmhe.Gate(reopen=2)).with_options(max_qps=0),
    "gated singular": lambda: replace(_doubtful(
        _with_inputs(), qpmhe.Gate(reopen=2), prior=np.diag([1e-4, 0.0, 1e-4]),
        disturbance=np.diag([0.002, 0.0, 0.0]),
    ), tolerance=1e-7),
    "weighted": lambda: _doubtful(_with_inputs(), qpmhe.HuberInnovation(reopen=2)),
    "weighted prior": lambda: with_changes(with_conditions(_doubtful(
        _observed(qpmhe.ExtendedKalman), qpmhe.HuberInnovation(0.7, reopen=1)
    ).with_gaps())),
    "weighted smoothed": lambda: _doubtful(
        _observed(qpmhe.ExtendedKalman), qpmhe.HuberInnovation()
    ).with_options(arrival="smoothed", delay=1),
    "unscented gated": lambda: _doubtful(
        _observed(qpmhe.UnscentedKalman), qpmhe.Gate(reopen=2), qpmhe.UnscentedKalman
    ).with_gaps(),
    "unscented gated in states": lambda: with_changes(with_conditions(_doubtful(
        case("inputs and states"), qpmhe.Gate(reopen=2, groups=[[0, 1]]), qpmhe.UnscentedKalman
    ).with_gaps())),
    "unscented weighted": lambda: with_changes(with_conditions(_doubtful(
        _observed(qpmhe.UnscentedKalman), qpmhe.HuberInnovation(reopen=2), qpmhe.UnscentedKalman
    ).with_gaps())),
    "injection": lambda: replace(
        case("inputs"), observer=qpmhe.OutputInjection(_saturated)
    ).with_gaps(),
    "injection reinitialized": lambda: with_changes(
        with_conditions(case("injection")).with_options(candidate="reinitialized", warm_start=True)
    ),
    "injection in sets": lambda: replace(
        case("inputs and states"), observer=qpmhe.OutputInjection(
            lambda z, v: 2.0 * _saturated(z, v)
        )
    ),
    "injection failing": lambda: replace(
        _failing(), observer=qpmhe.OutputInjection(
            lambda z, v: np.array([0.4 * v[0] / np.sqrt(z[0]), 0.0])
        ), cost=qpmhe.QuadraticCost(
            prior=np.eye(2), disturbance=100.0 * np.eye(2), noise=[[100.0]]
        ),
    ),
    "steady prior": _steady,
    "steady prior with gaps": lambda: _weighed(_steady().with_gaps()),
    "extended huber": lambda: replace(
        case("huber"), observer=case("extended prior").observer,
        cost=qpmhe.RobustCost(
            prior=qpmhe.ObserverPrior(), disturbance=10 * spd(2, 3),
            noise=qpmhe.Huber(np.diag([20.0, 50.0]), 1.0),
        ),
    ).with_gaps(),
}


@functools.cache
def case(name: str) -> Case:
    """The case of this name."""
    return CASES[name]()
